"""The webcam's graph as a file, after ONNX Runtime has been compared with PyTorch over a rendered video."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from torchface.capture.anybody import WebcamControls
from torchface.errors import ValueRangeError
from torchface.files.whole_files import check_writable, write_file
from torchface.geometry.cameras.pinhole import look_at
from torchface.onnx.webcam.webcam_model import OUTPUTS, WebcamGraph
from torchface.onnx.webcam.webcam_session import WebcamSession
from torchface.progress import Progress, silent
from torchface.rendering.clay_shading import render
from torchface.synthetic import performer
from torchface.workflows.webcam.webcam_graph import webcam_graph, webcam_module

_FPS = 30.0
_SIZE = (240, 320)  # rows, columns
_SPAN = 320.0  # millimetres that the picture shows from top to bottom
_BACKGROUND = (0.35, 0.4, 0.45)
_MOVED = (("jawOpen", "mouthSmileLeft"), ("mouthSmileRight", "browInnerUp"), ("eyeBlinkLeft", "eyeBlinkRight"))
_FRAMES = 12
_LARGEST_GAP = {"landmarks": 0.01, "weights": 0.02}  # of the eyes' distance; of 1
_TIMED = (480, 640)  # rows, columns


@dataclass(frozen=True)
class WebcamReport:
    """What was written."""

    path: Path
    size: int
    frames: int
    # the largest mean distance of a frame's landmarks between ONNX Runtime and PyTorch, over that of the eyes' outer
    # corners
    landmarks: float
    weights: float  # the largest difference of a weight
    state: int  # numbers that one picture hands on to the next
    milliseconds: dict[str, float]  # of processor time a picture of 640 x 480, by one thread here, by what is in it

    def rows(self) -> list[tuple[str, str]]:
        """The report as pairs of what and how much."""
        gap = f"landmarks {self.landmarks:.1e} of the eyes' distance, weights {self.weights:.1e} apart at most"
        return [
            ("file", f"{self.path}, {self.size / 1e6:.2f} MB"),
            ("state", f"{self.state} numbers, {self.state * 4 / 1000:.0f} kB"),
            (f"ONNX Runtime against PyTorch over {self.frames} rendered frames", gap),
            *((f"640 x 480, {name}, one thread", f"{took:.1f} ms") for name, took in self.milliseconds.items()),
        ]


def export_webcam(out: str | Path, progress: Progress | None = None) -> WebcamReport:
    """Writes the graph from a webcam's picture to weights; the file appears only when it is complete and checked."""
    out, progress = Path(out), progress or silent
    check_writable(out)
    content = webcam_graph(progress)
    session = WebcamSession(content)
    progress("rendering a video to check it with")
    frames = _rendered_frames(_FRAMES)
    progress("comparing ONNX Runtime with PyTorch")
    landmarks, weights = webcam_parity(session, webcam_module(), frames)
    for name, gap in {"landmarks": landmarks, "weights": weights}.items():
        if not gap <= _LARGEST_GAP[name]:
            raise ValueRangeError(
                f"{out}: ONNX Runtime's {name} differ from PyTorch's by {gap:.2g}, expected {_LARGEST_GAP[name]} at "
                "most"
            )
    progress("measuring")
    took = {
        "face followed": _milliseconds(session, _enlarged(frames)),
        "nobody there": _milliseconds(session, _empty()),
    }
    write_file(out, content)
    return WebcamReport(out, len(content), len(frames), landmarks, weights, len(session.state), took)


def _rendered_frames(count: int) -> list[np.ndarray]:
    """The embedded performer before a camera, who talks, smiles, blinks and turns the head, uint8 (240,320,3) each."""
    rig = performer()
    phase = torch.arange(count) / max(count - 1, 1) * torch.pi
    weights = torch.zeros(count, len(rig.names))
    for number, names in enumerate(_MOVED):
        weights[:, rig.index(names)] = 0.6 * torch.sin((1 + number) * phase).clamp(min=0)[:, None]
    middle = rig.neutral.vertices[rig.neutral.landmarks].mean(0)
    frames = []
    for vertices, yaw in zip(rig(weights), 10 * phase.sin(), strict=True):
        camera = look_at(middle, float(yaw), span=_SPAN, width=_SIZE[1], height=_SIZE[0])
        image = render(rig.neutral.with_vertices(vertices), camera, background=_BACKGROUND)
        frames.append((image * 255).round().byte().permute(1, 2, 0).contiguous().numpy())
    return frames


def webcam_parity(session: WebcamSession, graph: WebcamGraph, frames: Sequence[np.ndarray]) -> tuple[float, float]:
    """How far the session is from the module in PyTorch, each frame from the session's own state.

    Args:
        session: runs the graph, from where it is.
        frames: uint8 (H,W,3).

    Returns:
        The largest mean distance of a frame's landmarks, over that of the eyes' outer corners; and the largest
        difference of a weight. Infinite where no face is followed.
    """
    gaps: list[tuple[float, float]] = []
    for frame in frames:  # each takes the state of the one before
        given = torch.from_numpy(frame), torch.tensor(1 / _FPS), WebcamControls().tensor(), session.state
        found = session.step(frame, 1 / _FPS)
        with torch.inference_mode():
            expected = dict(zip(OUTPUTS, graph(*given), strict=True))
        if found.presence > 0:
            marks = expected["landmarks"]
            apart = (found.landmarks - marks).norm(dim=1).mean() / (marks[36] - marks[45]).norm()
            gaps.append((float(apart), float((found.weights - expected["weights"]).abs().max())))
    return tuple(max(column) for column in zip(*gaps, strict=True)) if gaps else (float("inf"), float("inf"))


def _enlarged(frames: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The frames as large as webcams' are."""
    size = (_TIMED[1], _TIMED[0])
    return [cv2.resize(frame, size, interpolation=cv2.INTER_LINEAR) for frame in frames]


def _empty() -> list[np.ndarray]:
    return [np.full((*_TIMED, 3), 100, np.uint8)] * _FRAMES


def _milliseconds(session: WebcamSession, frames: Sequence[np.ndarray]) -> float:
    """Processor time a frame after the first."""
    session.reset()
    session.step(frames[0], 1 / _FPS)
    begun = time.process_time()
    for frame in frames[1:]:
        session.step(frame, 1 / _FPS)
    return 1000 * (time.process_time() - begun) / (len(frames) - 1)
