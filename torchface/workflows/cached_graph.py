"""Cache of files that are made by code in seconds: each is made once, and anew where its models or its code have
changed."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from filelock import FileLock

import torchface
from torchface.errors import FileFormatError
from torchface.files.cache_folder import cache_folder
from torchface.files.content_keys import content_key
from torchface.files.whole_files import all_or_none, read_file, write_file

if TYPE_CHECKING:
    import onnx


def cached_graph(kind: str, make: "Callable[[], onnx.ModelProto]", code: Sequence[str], **models: object) -> bytes:
    """An ONNX graph's file; see :func:`cached_file`."""
    return cached_file(kind, ".onnx", lambda: make().SerializeToString(), code, **models)


def cached_file(kind: str, ending: str, make: Callable[[], bytes], code: Sequence[str], **models: object) -> bytes:
    """What ``make`` makes of models: from the cache where it is there and whole; kept if the cache can be written to.

    Of processes that ask for it at once one makes it, and the others wait.

    ``code`` are folders of this package that say what becomes of the models, ``models`` as of ``content_key``.
    """
    name = _name(kind, ending, code, models)
    content = _kept(kind, name)
    if content is not None:
        return content
    with ExitStack() as held:
        with suppress(FileFormatError, OSError):  # a cache that cannot be written to, a file system without locks
            held.enter_context(FileLock(cache_folder(kind) / f"{name}.lock", mode=0o666))
        content = _kept(kind, name)
        if content is None:
            content = make()
            with suppress(FileFormatError), all_or_none():
                path = cache_folder(kind) / name
                write_file(path, content)
                write_file(path.with_suffix(".sha256"), hashlib.sha256(content).hexdigest().encode())
        return content


def kept_file(kind: str, ending: str, code: Sequence[str], **models: object) -> bytes | None:
    """What :func:`cached_file` has kept; None where nothing whole is there."""
    return _kept(kind, _name(kind, ending, code, models))


def _name(kind: str, ending: str, code: Sequence[str], models: Mapping[str, object]) -> str:
    package = Path(torchface.__file__).parent
    sources = {one: sorted((package / one).rglob("*.py")) for one in code}
    return content_key(f"{kind} 2", torch=str(torch.__version__), sources=sources, models=models)[:32] + ending


def _kept(kind: str, name: str) -> bytes | None:
    with suppress(FileFormatError):  # not there, or damaged
        path = cache_folder(kind) / name
        content = read_file(path)
        if read_file(path.with_suffix(".sha256")).decode("ascii", "replace") == hashlib.sha256(content).hexdigest():
            return content
    return None
