"""Damaged models are named and refused; pickles are never loaded."""

import contextlib
import hashlib
import json
import re
import shutil
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch
import tomli_w
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutation import check_reader
from torch import Tensor, nn

from tests.zoo.conftest import CARD, morphable, noise
from torchface import BlendshapeRig, TorchfaceError, zoo
from torchface.capture import MarkerSolver
from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.landmarks import UVLandmarkDetector
from torchface.modeling import HeadModel, MorphableModel

REPOSITORY = Path(__file__).resolve().parents[2]


def test_what_is_no_model_cannot_be_saved(tmp_path: Path) -> None:
    with pytest.raises(NameMismatchError, match=r"found a Linear, expected one of .*HeadModel"):
        zoo.save_model(nn.Linear(2, 2), tmp_path / "x", CARD)
    with pytest.raises(NameMismatchError, match="letters from a to z, digits"):
        zoo.save_model(morphable(), tmp_path / "..", CARD)
    broken = morphable()
    broken.mean[3, 1] = torch.nan
    with pytest.raises(ValueRangeError, match="mean: found NaN"):
        zoo.save_model(broken, tmp_path / "x", CARD)
    with pytest.raises(ValueRangeError, match=r"metrics\.error: found nan"):
        zoo.save_model(morphable(), tmp_path / "x", replace(CARD, metrics={"error": float("nan")}))
    assert not (tmp_path / "x").exists()


def test_one_damaged_model_is_named_and_the_others_load(home: Path) -> None:
    names = zoo.list_models()
    damage: dict[str, Callable[[Path], object]] = {
        "cut": _state(lambda data: data[:-4]),
        "empty": lambda folder: (folder / "model.toml").write_bytes(b""),
        "foreign": _text(lambda text: text.replace('"morphable"', '"os.system"')),
        "newer": _text(lambda text: text.replace("format = 1", "format = 2")),
        "stateless": lambda folder: (folder / zoo.STATE).unlink(),
        "torn": lambda folder: (folder / "model.toml").write_bytes(b"\xff = ["),
    }
    for name, change in damage.items():
        shutil.copytree(home / "mine", home / name)
        change(home / name)
    with pytest.warns(UserWarning, match="is left out") as told:
        assert zoo.list_models() == names
    for name, warning in zip(damage, told, strict=True):
        assert f"model {name!r} is left out: {home / name}" in str(warning.message)
        with pytest.raises(FileFormatError, match=name):
            zoo.get_model(name)
    assert list(zoo.damaged_models()) == list(damage)
    for name in ("empty", "newer", "torn"):
        with pytest.raises(FileFormatError, match=name):
            zoo.describe(name)
    assert zoo.describe("mine").folder == home / "mine"
    hub = {"repo_or_dir": str(REPOSITORY), "source": "local"}
    assert torch.equal(torch.hub.load(model="mine", **hub).mean, morphable().mean)
    with pytest.raises(FileFormatError, match=r"torn/model\.toml: not TOML"):
        torch.hub.load(model="torn", **hub)


def _text(change: Callable[[str], str]) -> Callable[[Path], object]:
    return lambda folder: (folder / "model.toml").write_text(change((folder / "model.toml").read_text()))


def _state(change: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    return lambda folder: (folder / zoo.STATE).write_bytes(change((folder / zoo.STATE).read_bytes()))


def _retold(tensors: dict[str, Tensor]) -> Callable[[Path], object]:
    """Another state, with the size and hash that belong to it."""

    def change(folder: Path) -> None:
        state = safetensors.torch.save(tensors)
        record = zoo.describe(folder)
        text = (folder / "model.toml").read_text().replace(record.sha256, hashlib.sha256(state).hexdigest())
        (folder / "model.toml").write_text(text.replace(f"\nsize = {record.size}\n", f"\nsize = {len(state)}\n"))
        (folder / "state.safetensors").write_bytes(state)

    return change


def _claims_gigabytes(state: bytes) -> bytes:
    header = json.dumps({"mean": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}).encode()
    return (len(header).to_bytes(8, "little") + header).ljust(len(state), b"\0")


STATE = morphable().state_dict()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_state(lambda data: data[:-4]), r"state.safetensors: found \d+ bytes, expected \d+: cut off"),
        (_state(lambda data: data[:-1] + bytes([data[-1] ^ 1])), r"state.safetensors: found sha256 \w+, expected"),
        (_state(lambda data: b"\xff" * len(data)), "state.safetensors: no readable state"),
        (_state(_claims_gigabytes), r"state.safetensors: no readable state \(.*not fully covered"),
        (lambda folder: (folder / "state.safetensors").unlink(), "state.safetensors: found no such file"),
        (lambda folder: (folder / "model.toml").write_text("= 1"), "model.toml: not TOML"),
        (lambda folder: (folder / "model.toml").write_bytes(b"\xff\xfe"), "model.toml: not TOML"),
        (_text(lambda text: text.replace("format = 1", "format = 2")), "format = 2, .* newer torchface"),
        (_text(lambda text: text.replace("format = 1\n", "")), "found format = None, expected 1"),
        (_text(lambda text: text.replace('"morphable"', '"os.system"')), "found kind 'os.system', expected"),
        (_text(lambda text: text.replace('"MIT"', "7")), "found licence = 7, expected text"),
        (_text(lambda text: text.replace("error = 0.25", 'error = "low"')), "metrics.error = 'low', expected a"),
        (_text(lambda text: text.replace("vertices = 30", "vertices = 31")), "config and state do not fit"),
        (_text(lambda text: text.replace("vertices = 30", "vertices = 300000000")), "config cannot be used|do not fit"),
        (_text(lambda text: text.replace("vertices = 30\n", "")), "config cannot be used"),
        (_retold({**STATE, "mean": STATE["mean"] * torch.inf}), "found NaN or infinity in mean"),
        (_retold({**STATE, "mean": STATE["mean"].long()}), "mean: found I64"),
        (_retold({**STATE, "more": torch.zeros(2)}), "config and state do not fit .*more in one of them only"),
    ],
)  # fmt: skip
def test_a_damaged_model_is_named(home: Path, damage: Callable[[Path], object], message: str) -> None:
    damage(home / "mine")
    with pytest.raises(FileFormatError, match=message):
        zoo.get_model("mine")


def test_pickles_are_refused(home: Path) -> None:
    torch.save(STATE, home / "mine" / "state.safetensors")
    data = (home / "mine" / "state.safetensors").read_bytes()
    record = zoo.describe("mine")
    text = (home / "mine" / "model.toml").read_text().replace(record.sha256, hashlib.sha256(data).hexdigest())
    (home / "mine" / "model.toml").write_text(text.replace(f"size = {record.size}", f"size = {len(data)}"))
    with pytest.raises(FileFormatError, match="no readable state"):
        zoo.get_model("mine")


_BETWEEN = b"\n# state follows\n"


def read_bundle(path: Path) -> object:
    """Reads a case as a description and a state, whose size and hash are made to fit."""
    folder = path.parent / "model"
    folder.mkdir(exist_ok=True)
    text, _, state = path.read_bytes().partition(_BETWEEN)
    text = re.sub(rb'sha256 = "\w{64}"', f'sha256 = "{hashlib.sha256(state).hexdigest()}"'.encode(), text)
    (folder / "model.toml").write_bytes(re.sub(rb"\nsize = \d{3,}\n", f"\nsize = {len(state)}\n".encode(), text))
    (folder / "state.safetensors").write_bytes(state)
    return zoo.get_model(folder)


def test_a_mutated_model_is_loaded_or_refused(solver: MarkerSolver, dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    shape = MorphableModel.fit(dome_rig.vertices + noise(4, *dome_rig.vertices.shape))
    detector = UVLandmarkDetector(2, 64, frame={"points": 9, "count": 12})
    bundles = []
    for model in (morphable(), solver, HeadModel.on(dome_rig.neutral, shape), detector):
        folder = tmp_path / type(model).__name__
        zoo.save_model(model, folder, CARD)
        bundles.append(tmp_path / f"{folder.name}.bundle")
        bundles[-1].write_bytes(
            (folder / "model.toml").read_bytes() + _BETWEEN + (folder / "state.safetensors").read_bytes()
        )
    report = check_reader(read_bundle, bundles, ".bundle")
    assert report.refused > report.cases * 2 / 3
    assert report.read > 0


_VALUES = st.recursive(
    st.booleans() | st.integers() | st.text() | st.floats(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=5,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(field=st.sampled_from(["kind", "size", "config", "metrics", "format", "sha256", "licence"]), value=_VALUES)
def test_no_value_of_a_field_breaks_the_reader(home: Path, field: str, value: object) -> None:
    document = tomllib.loads((home / "mine" / "model.toml").read_text())
    try:
        text = tomli_w.dumps({**document, field: value}).encode()
    except UnicodeError:  # half a surrogate pair
        return
    folder = home / "changed"
    folder.mkdir(exist_ok=True)
    (folder / "model.toml").write_bytes(text)
    (folder / zoo.STATE).write_bytes((home / "mine" / zoo.STATE).read_bytes())
    with contextlib.suppress(TorchfaceError):
        zoo.get_model(folder)
