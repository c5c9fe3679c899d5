"""The action unit classifier as an ONNX graph."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor

from torchface import __version__
from torchface.capture.action_units.classifier import ActionUnitClassifier, GroupClassifier
from torchface.capture.action_units.local_warps import local_warps
from torchface.errors import ValueRangeError
from torchface.files.whole_files import write_file
from torchface.onnx.graph_builder import GraphBuilder

_TEST_FRAMES = 64
# The share of frames in which rounding may turn a vote that hangs in the balance.
_ALLOWED = 0.05
_IN_THE_BALANCE = 1e-3


@dataclass(frozen=True)
class ActionUnitReport:
    """What was written, and how good it is.

    Args:
        path: the file.
        size: in bytes.
        agreement: share of test frames in which ONNX Runtime and PyTorch give the same intensities.
        milliseconds: median of one frame by one thread of ONNX Runtime here.
    """

    path: Path
    size: int
    agreement: float
    milliseconds: float

    def rows(self) -> list[tuple[str, str]]:
        """The report as pairs of what and how much."""
        return [
            ("file", f"{self.path}, {self.size / 1000:.0f} kB"),
            ("ONNX Runtime against PyTorch", f"the same in {self.agreement:.1%} of the frames"),
            ("one frame, one thread", f"{self.milliseconds:.3f} ms"),
        ]

    def __str__(self) -> str:
        return "\n".join(f"{name}: {value}" for name, value in self.rows())


def export_action_units(
    classifier: ActionUnitClassifier, path: str | Path, regions: Tensor | None = None
) -> ActionUnitReport:
    """Writes a classifier as ONNX, and checks it.

    The graph takes ``regions`` (B,R,h,w), patterns in [0,1], and ``rest`` (R,h,w), the same of the performer's face at
    rest, and gives ``intensities`` (B,A). The metadata holds the names of regions and ``units`` (JSON) and the
    ``version``.

    Args:
        classifier: a trained one.
        path: the file to write; it appears only when it is complete and checked.
        regions: patterns to check with, (T,R,h,w); its neutral ones warped at random if absent.

    Raises:
        ValueRangeError: ONNX Runtime and PyTorch disagree where no vote hangs in the balance; nothing is written.
    """
    classifier = classifier.cpu().float().eval()
    model = action_unit_model(classifier)
    session = _session(model)
    frames = _test_frames(classifier) if regions is None else regions.float()
    rest = classifier.neutral
    (found,) = session.run(None, {"regions": frames.numpy(), "rest": rest.numpy()})
    with torch.no_grad():
        same = (torch.from_numpy(np.asarray(found)) - classifier(frames, rest)).abs().amax(1) < 1e-6
        clear = _clear(classifier, frames)
    agreement = float(same.float().mean())
    if not bool(same[clear].all()) or agreement < 1 - _ALLOWED:
        raise ValueRangeError(f"{path}: ONNX Runtime agrees with PyTorch in {agreement:.1%} of frames, expected all")
    content = model.SerializeToString()
    write_file(path, content)
    return ActionUnitReport(Path(path), len(content), agreement, _milliseconds(session, frames, rest))


def action_unit_model(classifier: ActionUnitClassifier) -> onnx.ModelProto:
    """The graph: one convolution for all regions, then three products and a vote a group."""
    build = GraphBuilder()
    op = build.op
    parts = classifier.group_classifiers()
    gabor, count, size = parts[0].gabor, len(classifier.regions), classifier.size
    filters, places = len(gabor.even), gabor.places(size)
    reach = gabor.even.shape[-1] // 2
    build.constant("filters", torch.cat([gabor.even, gabor.odd]))
    build.constant("margins", (0, 0, reach, reach, 0, 0, reach, reach))
    build.constant("one_channel", (-1, 1, size, size))
    build.constant("merged", (-1, count, filters * places * places))
    build.constant("flat", (0, -1))
    build.constant("floor", 1e-8)
    build.constant("zero", 0.0)
    build.constant("one", 1.0)
    build.constant("three", 3.0)
    for name, value in (("begin", 0), ("middle", filters), ("end", 2 * filters), ("axis", 1)):
        build.constant(name, (value,))

    def magnitudes(regions: str) -> str:
        padded = op("Pad", op("Reshape", regions, "one_channel"), "margins", mode="edge")
        waves = op("Conv", padded, "filters", strides=[gabor.stride] * 2)
        even, odd = op("Slice", waves, "begin", "middle", "axis"), op("Slice", waves, "middle", "end", "axis")
        energy = op("Add", op("Add", op("Mul", even, even), op("Mul", odd, odd)), "floor")
        return op("Reshape", op("Sqrt", energy), "merged")

    features = op("Sub", magnitudes("regions"), magnitudes("rest"))
    intensities = []
    for i, part in enumerate(parts):
        rows = tuple(classifier.regions.index(name) for name in part.group.regions)
        own = op("Gather", features, build.constant(f"regions_{i}", rows), axis=1)
        intensities.append(_vote(build, part, i, op("Reshape", own, "flat")))
    op("Concat", *intensities, axis=1, output="intensities")
    return build.model(
        "action_units",
        {"regions": ("batch", count, size, size), "rest": (count, size, size)},
        {"intensities": ("batch", len(classifier.units))},
        {
            "task": "action_units",
            "regions": list(classifier.regions),
            "units": list(classifier.units),
            "version": __version__,
        },
    )


def _vote(build: GraphBuilder, part: GroupClassifier, number: int, features: str) -> str:
    """The intensities of one group; mean and deviations go into the components."""
    op = build.op

    def constant(name: str, value: Tensor) -> str:
        return build.constant(f"{name}_{number}", value)

    machine = part.machine
    components = (part.components.double() / part.deviations.double()[:, None]).T
    offset = -(part.mean.double() @ components)
    reduced = op("Gemm", features, constant("components", components), constant("offset", offset))
    distance = op("Gemm", reduced, constant("planes", machine.weight), constant("bias", machine.bias), transB=1)
    first = op("Cast", op("Greater", distance, "zero"), to=onnx.TensorProto.FLOAT)
    votes = op(
        "Add",
        op("MatMul", first, constant("for_first", machine.first_class)),
        op("MatMul", op("Sub", "one", first), constant("for_second", machine.second_class)),
    )
    margin = op("MatMul", distance, constant("between", machine.first_class - machine.second_class))
    bounded = op("Div", margin, op("Mul", "three", op("Add", op("Abs", margin), "one")))
    best = op("ArgMax", op("Add", votes, bounded), axis=1, keepdims=0)
    return op("Gather", constant("intensities", part.intensities), best, axis=0)


def _test_frames(classifier: ActionUnitClassifier) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    neutral = classifier.neutral.expand(_TEST_FRAMES, -1, -1, -1)
    return local_warps(neutral.contiguous(), 2.0, generator)


def _clear(classifier: ActionUnitClassifier, frames: Tensor) -> Tensor:
    """Frames (T,) in which no plane passes so near that rounding decides."""
    clear = torch.ones(len(frames), dtype=torch.bool)
    parts, still = classifier.group_classifiers(), classifier.split(classifier.neutral[None])
    for part, own, rest in zip(parts, classifier.split(frames), still, strict=True):
        reduced = (part.features(own, rest) - part.mean) @ part.components.T / part.deviations
        distance = reduced @ part.machine.weight.T + part.machine.bias
        best = part.scores(own, rest).topk(2, dim=1).values
        clear &= (distance.abs().amin(1) > _IN_THE_BALANCE) & (best[:, 0] - best[:, 1] > _IN_THE_BALANCE)
    return clear


def _session(model: onnx.ModelProto) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def _milliseconds(session: onnxruntime.InferenceSession, frames: Tensor, rest: Tensor) -> float:
    times = []
    for frame in frames.numpy():
        begin = time.perf_counter()
        session.run(None, {"regions": frame[None], "rest": rest.numpy()})
        times.append(time.perf_counter() - begin)
    return 1000 * float(np.median(times))
