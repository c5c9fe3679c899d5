"""A learned model as a folder: ``model.toml``, ``state.safetensors`` and ``CARD.md``."""

import hashlib
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load, save
from torch import Tensor, nn

from torchface.errors import FileFormatError, TorchfaceError, ValueRangeError
from torchface.files.documents import read_toml, write_toml
from torchface.files.state_renames import current_config, current_state_keys
from torchface.files.whole_files import all_or_none, made_folder, read_file, write_file
from torchface.number_checks import checked_number

FORMAT = 1
DESCRIPTION, STATE, CARD = "model.toml", "state.safetensors", "CARD.md"
MAX_CARD_BYTES = 2**18
_TEXTS = ("kind", "sha256", "licence", "data", "recipe", "url")


@dataclass(frozen=True)
class ModelRecord:
    """What is known of a saved model without loading it."""

    kind: str
    licence: str  # under which it may be used, such as MIT
    data: str
    metrics: dict[str, float] = field(default_factory=dict)  # what was measured on data held out
    recipe: str = ""  # the command that makes it again
    url: str = ""  # where it comes from
    settings: dict[str, Any] = field(default_factory=dict)  # of the recipe, the effective ones
    sha256: str = ""
    size: int = 0  # of the state, bytes
    config: dict[str, Any] = field(default_factory=dict)  # what its class is built from


def write_model(
    model: nn.Module, folder: str | Path, record: ModelRecord, card: str = "", half: Collection[str] = ()
) -> ModelRecord:
    """Writes a model into a folder, its files at once, ``model.toml`` last; the record as written.

    Args:
        record: kind, licence, data, metrics, recipe; size, hash and config are filled in.
        card: Markdown for ``CARD.md``: what the model is good for, measured how, its limits.
        half: names in the state that are stored in half precision.
    """
    metrics = {name: checked_number(f"metrics.{name}", value, -math.inf) for name, value in record.metrics.items()}
    folder = Path(folder)
    state = pack_state(model.state_dict(), half)
    sha256, config = hashlib.sha256(state).hexdigest(), dict(model.config)  # type: ignore[arg-type]
    record = replace(record, metrics=metrics, sha256=sha256, size=len(state), config=config)
    with made_folder(folder), all_or_none():
        write_file(folder / STATE, state)
        write_file(folder / CARD, card_text(folder.name, record, card).encode())
        write_toml(folder / DESCRIPTION, {"format": FORMAT, **vars(record)})
    return record


def read_record(folder: str | Path) -> ModelRecord:
    """What ``model.toml`` says."""
    document = read_toml(_inside(Path(folder), DESCRIPTION))
    version = document["format"].whole(1, expected=str(FORMAT))
    if version > FORMAT:
        raise document["format"].error(f"{FORMAT} at most: the file was made by a newer torchface")
    texts: dict[str, Any] = {name: document[name].text() for name in _TEXTS if document[name]}
    tables: dict[str, Any] = {name: document[name].plain_table() for name in ("settings", "config") if document[name]}
    metrics = document["metrics"].table(expected="a table of numbers") if document["metrics"] else {}
    return ModelRecord(
        **{"kind": "", "licence": "", "data": "", **texts},
        metrics={name: value.number(max_size=1e300) for name, value in metrics.items()},
        size=document["size"].whole(1, 2**48, f"the bytes of {STATE}"),
        **tables,
    )


def read_card(folder: str | Path) -> str:
    """What ``CARD.md`` says, as far as it is text; nothing where there is none."""
    path = _inside(Path(folder), CARD)
    return read_file(path, MAX_CARD_BYTES).decode("utf-8", "replace") if path.is_file() else ""


Model = TypeVar("Model", bound=nn.Module)


def read_model(folder: str | Path, kinds: Mapping[str, type[Model]]) -> Model:
    """The model of a folder, of one of these kinds.

    The kind is looked up in ``kinds``; no file names code. The module is built without memory first, and its state
    held against the file's size, header and hash, in this order, before anything is read into it.
    """
    folder = Path(folder)
    record = _known_record(folder, kinds)
    path, state_path = folder / DESCRIPTION, _state_path(folder)
    model, expected = _bare_model(path, record, kinds)
    state, data = read_state(state_path, expected, record.size, record.kind)
    digest = hashlib.sha256(data).hexdigest()
    if digest != record.sha256:
        raise FileFormatError(
            f"{state_path}: found sha256 {digest}, expected {record.sha256 or 'one'} as in {DESCRIPTION}: "
            "the file is damaged or of another model"
        )
    try:
        model.load_state_dict(state, assign=True)
        if check := getattr(model, "check_state", None):
            check()
    except (RuntimeError, TorchfaceError) as error:
        raise FileFormatError(f"{path}: config and state do not fit ({error})") from error
    return model.eval()


def check_claims(folder: Path, kinds: Mapping[str, type[nn.Module]]) -> ModelRecord:
    """The record of a folder whose state may not be there yet: of one of these kinds, its size no more than its config
    asks for.
    """
    record = _known_record(folder, kinds)
    _, expected = _bare_model(folder / DESCRIPTION, record, kinds)
    largest = sum(8 * tensor.numel() for tensor in expected.values()) + MAX_HEADER_BYTES
    if record.size > largest:
        raise FileFormatError(
            f"{folder / DESCRIPTION}: found size = {record.size}, expected at most {largest}, which its config asks for"
        )
    return record


def _bare_model(path: Path, record: ModelRecord, kinds: Mapping[str, type[Model]]) -> tuple[Model, dict[str, Tensor]]:
    """A model that has learned nothing yet, and the state that it wants; neither takes memory."""
    try:
        with torch.device("meta"):
            model = kinds[record.kind].from_config(current_config(record.kind, record.config))  # type: ignore[attr-defined]
        return model, model.state_dict()
    except (TypeError, ValueError, KeyError, IndexError, AttributeError) as error:
        raise FileFormatError(f"{path}: config cannot be used ({type(error).__name__}: {error})") from error
    except (RuntimeError, ArithmeticError, RecursionError, MemoryError, TorchfaceError) as error:
        raise FileFormatError(f"{path}: config cannot be used ({error})") from error


def model_fault(folder: str | Path, kinds: Collection[str]) -> str | None:
    """Why a model of these kinds cannot be loaded, as far as its description and its state's size show; else None."""
    folder = Path(folder)
    try:
        check_size(_state_path(folder), _known_record(folder, kinds).size)
    except (TorchfaceError, OSError) as error:
        return str(error)
    return None


def card_text(name: str, record: ModelRecord, text: str) -> str:
    """The card: what the author says of the model, then data, licence, figures and the command that makes it."""
    parts = [f"# {name}", text.strip()] if text.strip() else [f"# {name}"]
    parts += [f"**Data.** {record.data}", f"**Licence.** {record.licence}"]
    if record.metrics:
        rows = "\n".join(f"| {key} | {value:.4g} |" for key, value in record.metrics.items())
        parts.append(f"| measured | value |\n| --- | --- |\n{rows}")
    if record.recipe:
        parts.append(f"Made again by\n\n```sh\n{record.recipe}\n```")
    return "\n\n".join(parts) + "\n"


def _known_record(folder: Path, kinds: Collection[str]) -> ModelRecord:
    """What ``model.toml`` says, which must be of one of these kinds."""
    record = read_record(folder)
    if record.kind not in kinds:
        expected = " or ".join(map(repr, sorted(kinds)))
        raise FileFormatError(f"{folder / DESCRIPTION}: found kind {record.kind!r}, expected {expected}")
    return record


def _state_path(folder: Path) -> Path:
    """Where a model's state lies, which must be there."""
    path = _inside(folder, STATE)
    if not path.is_file():
        raise FileFormatError(f"{path}: found no such file, expected the state of {folder / DESCRIPTION}")
    return path


def _inside(folder: Path, name: str) -> Path:
    """A file of the folder; a link that leads out of it is refused."""
    path = folder / name
    try:
        if not path.resolve().is_relative_to(folder.resolve()):
            raise FileFormatError(f"{path}: found a link that leads out of the folder, expected a file in it")
    except (OSError, ValueError, RuntimeError) as error:  # a loop of links, a NUL
        raise FileFormatError(f"{path}: cannot be followed ({error})") from error
    return path


MAX_HEADER_BYTES = 2**20
_FAMILIES = {
    **dict.fromkeys(("F16", "F32", "F64"), "float"),
    **dict.fromkeys(("I8", "I16", "I32", "I64", "U8"), "int"),
    "BOOL": "bool",
}
"""Which types of a file fit which of a module: the width of a number may differ."""


def pack_state(state: Mapping[str, Tensor], half: Collection[str] = ()) -> bytes:
    """The bytes of a state of finite tensors, floats of ``half`` in half precision; integers take as few as they
    can."""
    unknown = sorted(set(half) - set(state))
    if unknown:
        raise ValueRangeError(f"half: found {', '.join(unknown)}, expected names among {', '.join(state)}")
    packed = {}
    for name, tensor in state.items():
        stored = tensor.detach().cpu()
        if stored.is_floating_point():
            stored = stored.half() if name in half else stored
            if not bool(torch.isfinite(stored).all()):
                kind = "in half precision" if name in half else "in the state"
                raise ValueRangeError(f"{name}: found NaN or infinity {kind}, expected finite numbers")
        elif stored.dtype != torch.bool:
            stored = stored.to(_smallest(stored))
        packed[name] = stored.contiguous()
    return save(packed)


def read_state(
    path: Path, expected: Mapping[str, Tensor], size: int, kind: str = ""
) -> tuple[dict[str, Tensor], bytes]:
    """A state in the shapes and types of ``expected``, maybe on the meta device, and the bytes, ``size``, it came
    from."""
    try:
        check_size(path, size)
        with path.open("rb") as file:
            if int.from_bytes(file.read(8), "little") > MAX_HEADER_BYTES:
                raise FileFormatError(f"{path}: no readable state (found a header above {MAX_HEADER_BYTES} bytes)")
            with safe_open(path, framework="pt") as stored:  # reads and checks the header alone
                names = current_state_keys(kind, stored.keys(), expected)
                _check(path, {names[key]: stored.get_slice(key) for key in stored.keys()}, expected)  # noqa: SIM118
            file.seek(0)
            data = file.read(size + 1)
        loaded = load(data)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror})") from error
    except (SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise FileFormatError(f"{path}: no readable state ({error})") from error
    state = {names[key]: tensor.to(expected[names[key]].dtype) for key, tensor in loaded.items()}
    for name, tensor in state.items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise FileFormatError(f"{path}: found NaN or infinity in {name}, expected finite numbers")
    return state, data


def check_size(path: Path, size: int) -> None:
    """Refuses a state that has not as many bytes as its description says."""
    bytes_there = path.stat().st_size
    if bytes_there != size:
        raise FileFormatError(f"{path}: found {bytes_there} bytes, expected {size}: cut off, or of another model")


def _smallest(values: Tensor) -> torch.dtype:
    for dtype in (torch.int8, torch.int16, torch.int32):
        limits = torch.iinfo(dtype)
        if values.numel() == 0 or (int(values.min()) >= limits.min and int(values.max()) <= limits.max):
            return dtype
    return torch.int64


def _check(path: Path, stored: Mapping[str, Any], expected: Mapping[str, Tensor]) -> None:
    if set(stored) != set(expected):
        odd = sorted(set(stored) ^ set(expected))
        raise FileFormatError(
            f"{path}: config and state do not fit (found {', '.join(sorted(stored)[:8])}; "
            f"expected {', '.join(sorted(expected)[:8])}; {', '.join(odd[:5])} in one of them only)"
        )
    for name, tensor in expected.items():
        dtype, shape = stored[name].get_dtype(), tuple(stored[name].get_shape())
        if shape != tuple(tensor.shape) or _FAMILIES.get(dtype) != _family(tensor.dtype):
            raise FileFormatError(
                f"{path}: config and state do not fit ({name}: found {dtype} {shape[:8]}, "
                f"expected {tensor.dtype} {tuple(tensor.shape)})"
            )


def _family(dtype: torch.dtype) -> str:
    return "float" if dtype.is_floating_point else "bool" if dtype == torch.bool else "int"
