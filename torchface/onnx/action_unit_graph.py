"""The action unit classifier as an ONNX graph."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor

from torchface.capture.action_units.classifier import ActionUnitClassifier
from torchface.capture.action_units.classifier_training import local_warps
from torchface.errors import ValueRangeError
from torchface.files.whole_files import write_file
from torchface.landmarks.images.graph_session import graph_session
from torchface.onnx.checked_export import WrittenGraph
from torchface.onnx.exported_model import exported_model

_TEST_FRAMES = 64
# The share of frames in which rounding may turn a vote that hangs in the balance.
_ALLOWED = 0.05
_IN_THE_BALANCE = 1e-3


@dataclass(frozen=True)
class ActionUnitReport(WrittenGraph):
    """What was written, and how good it is.

    Args:
        agreement: share of test frames in which ONNX Runtime and PyTorch give the same intensities.
        milliseconds: median of one frame by one thread of ONNX Runtime here.
    """

    agreement: float
    milliseconds: float

    def rows(self) -> list[tuple[str, str]]:
        """The report as pairs of what and how much."""
        return [
            *super().rows(),
            ("ONNX Runtime against PyTorch", f"the same in {self.agreement:.1%} of the frames"),
            ("one frame, one thread", f"{self.milliseconds:.3f} ms"),
        ]


def export_action_units(
    classifier: ActionUnitClassifier,
    path: str | Path,
    regions: Tensor | None = None,
    facts: Mapping[str, object] | None = None,
) -> ActionUnitReport:
    """Writes a classifier as ONNX, and checks it.

    The graph takes ``regions`` (B,R,h,w), patterns in [0,1], and ``rest`` (R,h,w), the same of the performer's face at
    rest, and gives ``intensities`` (B,A), NaN as the module's of what a pattern with NaN or infinity shows. Metadata
    hold the names of regions and ``units`` (JSON) and the ``version``.

    Args:
        classifier: a trained one.
        path: the file to write; it appears only when it is complete and checked.
        regions: patterns to check with, (T,R,h,w); its neutral ones warped at random if absent.
        facts: further metadata, such as licence and data.

    Raises:
        ValueRangeError: ONNX Runtime and PyTorch disagree where no vote hangs in the balance; nothing is written.
    """
    classifier = classifier.cpu().float().eval()
    model = action_unit_model(classifier, facts)
    content = model.SerializeToString()
    session = graph_session(content)
    frames = _test_frames(classifier) if regions is None else regions.float()
    rest = classifier.neutral
    (found,) = session.run(None, {"regions": frames.numpy(), "rest": rest.numpy()})
    with torch.no_grad():
        same = (torch.from_numpy(np.asarray(found)) - classifier(frames, rest)).abs().amax(1) < 1e-6
        clear = _clear(classifier, frames)
    agreement = float(same.float().mean())
    if not bool(same[clear].all()) or agreement < 1 - _ALLOWED:
        raise ValueRangeError(f"{path}: ONNX Runtime agrees with PyTorch in {agreement:.1%} of frames, expected all")
    write_file(path, content)
    return ActionUnitReport(Path(path), len(content), agreement, _milliseconds(session, frames, rest))


def action_unit_model(classifier: ActionUnitClassifier, facts: Mapping[str, object] | None = None) -> onnx.ModelProto:
    """The classifier as a graph; see :func:`export_action_units`."""
    rest = classifier.neutral
    return exported_model(
        classifier,
        {"regions": rest.expand(2, -1, -1, -1).contiguous(), "rest": rest},
        ["intensities"],
        {"task": "action_units", "regions": list(classifier.regions), "units": list(classifier.units), **(facts or {})},
        {"regions": ("batch",)},
    )


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


def _milliseconds(session: onnxruntime.InferenceSession, frames: Tensor, rest: Tensor) -> float:
    times = []
    for frame in frames.numpy():
        begin = time.perf_counter()
        session.run(None, {"regions": frame[None], "rest": rest.numpy()})
        times.append(time.perf_counter() - begin)
    return 1000 * float(np.median(times))
