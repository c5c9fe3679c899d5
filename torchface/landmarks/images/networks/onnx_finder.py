"""Landmarks by anybody's ONNX graph of the agreed inputs and outputs."""

import json
import math
import os
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError, TorchfaceError
from torchface.files.whole_files import read_file
from torchface.landmarks.images.face_crop import CROP_MARGIN
from torchface.landmarks.images.graph_session import graph_session
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.images.networks import graph_process
from torchface.landmarks.images.networks.crop_finder import CropFinder, CropNetwork
from torchface.landmarks.images.networks.graph_process import signature
from torchface.landmarks.images.networks.landmark_network import NetworkLandmarks

if TYPE_CHECKING:
    import onnxruntime


_MAX_BYTES = 2**28
_SIZES = (16, 1024)
_MARGINS = (0.5, 4.0)
_OUTPUTS: dict[str, tuple[int, ...]] = {
    "landmarks": (COUNT, 2), "deviation": (COUNT,), "visibility": (COUNT,), "presence": ()
}  # fmt: skip
_EXPECTED = (
    f"expected an input image (B,3,S,S) float32 and outputs landmarks (B,{COUNT},2), deviation (B,{COUNT}), visibility "
    f"(B,{COUNT}) and presence (B), all float32"
)


@dataclass(frozen=True)
class GraphLimits:
    """What a foreign graph may take."""

    load_seconds: float = 60.0  # until it is read, optimised and has answered one crop
    answer_seconds: float = 20.0  # for each crop after that
    megabytes: int = 2048  # of memory, beside ONNX Runtime's own; not enforced on macOS and Windows


def onnx_finder(path: str | Path, limits: GraphLimits | None = None) -> CropFinder:
    """A finder that runs an ONNX graph in ONNX Runtime, on one thread, in a process of its own.

    The graph takes ``image`` (B,3,S,S) float32 in [0,1], red first: the face's box, enlarged by the number that the
    graph's metadata hold as ``crop`` (1.25 if none) and turned upright. It gives ``landmarks`` (B,68,2), their standard
    ``deviation`` (B,68), both in the crop's pixels, ``visibility`` (B,68) and ``presence`` (B,) in [0,1].
    """
    path, limits = Path(path), limits or GraphLimits()
    runner = _ForeignGraph(read_file(path, _MAX_BYTES), path, limits)
    return _finder(runner.signature, runner, path)


def graph_finder(content: bytes, path: Path) -> CropFinder:
    """The finder of a graph of this library's own making, run in this process; see :func:`onnx_finder`."""
    session = graph_session(content)
    return _finder(signature(session), _OwnGraph(session), path)


def _finder(declared: dict[str, Any], network: CropNetwork, path: Path) -> CropFinder:
    """The finder of a graph that declares what is expected, and gives it for one crop."""
    size = _checked_size(declared, path)
    finder = CropFinder(network, size, _margin(declared["crop"], path), path.name)
    trial = finder.network(torch.full((1, 3, size, size), 0.5))
    for output, (name, shape) in zip(trial, _OUTPUTS.items(), strict=False):
        if output.shape != (1, *shape):
            raise FileFormatError(f"{path}: found {name} {tuple(output.shape)} for one crop; {_EXPECTED}")
    return finder


@dataclass(frozen=True, eq=False)
class _OwnGraph:
    """A graph as a function of crops."""

    session: "onnxruntime.InferenceSession"

    def __call__(self, crops: Tensor) -> NetworkLandmarks:
        names = [one.name for one in self.session.get_outputs()]
        outputs = self.session.run(names, {"image": crops.float().contiguous().numpy()})
        given = {name: torch.from_numpy(np.asarray(one)) for name, one in zip(names, outputs, strict=True)}
        least = NetworkLandmarks.of_68(*(given[name] for name in _OUTPUTS))
        return least._replace(**{name: given[name] for name in NetworkLandmarks._fields if name in given})


class _ForeignGraph:
    """A graph in a process of its own as a function of crops."""

    def __init__(self, content: bytes, path: Path, limits: GraphLimits) -> None:
        self.path, self.limits = path, limits
        self._folder = tempfile.TemporaryDirectory(prefix="torchface-graph-")  # files that it names are not there
        script = str(Path(graph_process.__file__).resolve())
        command = [sys.executable, "-I", script, str(limits.megabytes)]
        name = f"{path}: the graph, run in a process of at most {limits.megabytes} MB,"
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = AnsweringProcess(command, name, FileFormatError, environment, self._folder.name)
        self._seconds = limits.load_seconds
        head, _ = self._asked(content)
        if "error" in head:
            raise FileFormatError(
                f"{path}: cannot be used as an ONNX graph ({head['error']}); expected one that finds landmarks"
            )
        self.signature = head

    def __call__(self, crops: Tensor) -> NetworkLandmarks:
        head, content = self._asked(graph_process.packed(crops.float().numpy()))
        if "error" in head:
            raise FileFormatError(f"{self.path}: the graph cannot be run ({head['error']}); {_EXPECTED}")
        self._seconds = self.limits.answer_seconds
        numbers = np.frombuffer(content, "<f4").astype(np.float32)
        parts = np.split(numbers, np.cumsum([math.prod(shape) for shape in head["shapes"]])[:-1])
        return NetworkLandmarks.of_68(
            *(torch.from_numpy(part.reshape(shape)) for part, shape in zip(parts, head["shapes"], strict=True))
        )

    def _asked(self, content: bytes) -> tuple[dict[str, Any], bytes]:
        with self._process.within(self._seconds):
            self._process.send(struct.pack("<Q", len(content)) + content)
            (count,) = struct.unpack("<I", self._process.receive(4, "ended"))
            head = json.loads(self._process.receive(count))
            return head, self._process.receive(4 * sum(math.prod(shape) for shape in head.get("shapes", ())))


def _checked_size(declared: dict[str, Any], path: Path) -> int:
    """S, of a graph that declares what is expected."""
    inputs, outputs = declared["inputs"], {name: (shape, kind) for name, shape, kind in declared["outputs"]}
    fits = (
        [name for name, _, _ in inputs] == ["image"]
        and set(outputs) >= set(_OUTPUTS)
        and inputs[0][2] == "tensor(float)"
        and _is_shape(inputs[0][1], (3, None, None))
        and inputs[0][1][2] == inputs[0][1][3]
        and all(outputs[name][1] == "tensor(float)" for name in _OUTPUTS)
        and all(_is_shape(outputs[name][0], shape) for name, shape in _OUTPUTS.items())
    )
    if not fits:
        found = ", ".join(f"{name} {_told(shape)} {kind}" for name, shape, kind in inputs[:4])
        given = ", ".join(f"{name} {_told(shape)} {kind}" for name, (shape, kind) in list(outputs.items())[:6])
        raise FileFormatError(f"{path}: found inputs {found or 'none'}; outputs {given or 'none'}; {_EXPECTED}")
    size = inputs[0][1][2]
    if not (isinstance(size, int) and _SIZES[0] <= size <= _SIZES[1]):
        raise FileFormatError(f"{path}: found crops of {size!r} pixels, expected a fixed {_SIZES[0]} to {_SIZES[1]}")
    return size


def _is_shape(found: list[int | str | None], expected: tuple[int | None, ...]) -> bool:
    """Whether declared dimensions are a batch and what is expected; a name stands for any number."""
    return len(found) == 1 + len(expected) and all(
        want is None or not isinstance(have, int) or have == want
        for have, want in zip(found, (None, *expected), strict=True)
    )


def _told(shape: list[int | str | None]) -> str:
    return "(" + ",".join("?" if one is None else str(one)[:12] for one in shape[:6]) + ")"


def _margin(crop: str | None, path: Path) -> float:
    text = str(CROP_MARGIN) if crop is None else crop
    try:
        margin = float(text)
    except ValueError:
        margin = math.nan
    if not _MARGINS[0] <= margin <= _MARGINS[1]:
        raise FileFormatError(
            f"{path}: found the metadata crop {text[:40]!r}, expected a number from {_MARGINS[0]} to {_MARGINS[1]}"
        )
    return margin


_TO_END = 2.0  # seconds that a process has to end once nothing more comes in


class AnsweringProcess:
    """A process whose requests go in at its standard input and whose answers come out at its output; ``error`` is
    raised where it fails."""

    def __init__(
        self,
        command: Sequence[str],
        name: str,
        error: type[TorchfaceError],
        environment: Mapping[str, str] | None = None,
        folder: str | None = None,
    ) -> None:
        self.name, self.error = name, error
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  lives as long as the process that writes it
        self._process = subprocess.Popen(
            list(command),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env=None if environment is None else dict(environment),
            cwd=folder,
        )
        self.close = weakref.finalize(self, _stop, self._process, self._errors)
        self._late: threading.Timer | None = None
        self._seconds = 0.0

    @contextmanager
    def within(self, seconds: float) -> Iterator[None]:
        """What is sent and received here must take no longer; else the process is killed."""
        self._seconds, self._late = seconds, threading.Timer(seconds, self._process.kill)
        self._late.daemon = True
        self._late.start()
        try:
            yield
        finally:
            self._late.cancel()

    def send(self, content: bytes) -> None:
        """Hands it a request."""
        pipe = self._open(self._process.stdin)
        try:
            pipe.write(content)
            pipe.flush()
        except OSError as error:
            raise self._broken("has ended") from error

    def receive(self, count: int, what: str = "has ended in the midst of an answer") -> bytes:
        """The next bytes of an answer."""
        content = self._open(self._process.stdout).read(count)
        if len(content) < count:
            raise self._broken(what)
        return content

    def failed(self, what: str) -> TorchfaceError:
        """An error that says what is wrong, and what the process said last."""
        said = ""
        if not self._errors.closed:
            self._errors.seek(max(0, self._errors.seek(0, os.SEEK_END) - 4096))
            lines = self._errors.read().decode("utf-8", "replace").strip().splitlines()
            said = f": {lines[-1].strip()[:200]}" if lines else ""
        return self.error(f"{self.name} {what}{said}")

    def _broken(self, what: str) -> TorchfaceError:
        late = self._late is not None and self._late.finished.is_set()
        if late:
            return self.failed(f"gave no answer in {self._seconds:g} seconds")
        with suppress(subprocess.TimeoutExpired):
            code = self._process.wait(_TO_END)
            if code < 0:
                with suppress(ValueError):
                    what += f" with {signal.Signals(-code).name}"
        return self.failed(what)

    def _open(self, pipe: IO[bytes] | None) -> IO[bytes]:
        if pipe is None or pipe.closed:
            raise self.failed("was closed")
        return pipe


def _stop(process: subprocess.Popen[bytes], errors: IO[bytes]) -> None:
    """Ends the process: what comes in ends, and if that is not enough it is killed."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):  # it has ended before what was written was read
                pipe.close()
    try:
        process.wait(_TO_END)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    errors.close()
