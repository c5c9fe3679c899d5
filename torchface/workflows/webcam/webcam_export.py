"""The webcam's graph as a file, after ONNX Runtime has been compared with PyTorch over a rendered video."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.capture.anybody import WebcamControls, WebcamSolver
from torchface.errors import ValueRangeError
from torchface.files.whole_files import check_writable, write_file
from torchface.geometry.cameras.pinhole import look_at
from torchface.landmarks.images.face_crop import crop_transform, cut_crop, from_crop
from torchface.landmarks.images.face_reading import READ_BY_NETWORKS, FaceReading
from torchface.landmarks.images.networks.eye_finder import EyeFinder
from torchface.onnx.webcam.face_reader import STATE
from torchface.onnx.webcam.webcam_session import WebcamFrame, WebcamSession
from torchface.progress import Progress, silent
from torchface.rendering.clay_shading import render
from torchface.synthetic import performer
from torchface.workflows.webcam.default_solver import default_webcam_solver
from torchface.workflows.webcam.webcam_graph import WebcamNetworks, webcam_graph, webcam_networks

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
    """What was written.

    Args:
        path: the file.
        size: in bytes.
        frames: that it was checked with.
        landmarks: the largest mean distance of a frame's landmarks between ONNX Runtime and PyTorch, over that of the
            eyes' outer corners.
        weights: the largest difference of a weight.
        state: numbers that one picture hands on to the next.
        milliseconds: of processor time a picture of 640 x 480, by one thread here, by what is in it.
    """

    path: Path
    size: int
    frames: int
    landmarks: float
    weights: float
    state: int
    milliseconds: dict[str, float]

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
    """Writes the graph from a webcam's picture to weights, and checks it.

    Args:
        out: the file to write; it appears only when it is complete and checked.
        progress: called with each step.
    """
    out, progress = Path(out), progress or silent
    check_writable(out)
    content = webcam_graph(progress)
    session = WebcamSession(content)
    progress("rendering a video to check it with")
    frames = _rendered_frames(_FRAMES)
    progress("comparing ONNX Runtime with PyTorch")
    landmarks, weights = webcam_parity(session, webcam_networks(), default_webcam_solver(), frames)
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


def webcam_parity(
    session: WebcamSession, networks: WebcamNetworks, solver: WebcamSolver, frames: Sequence[np.ndarray]
) -> tuple[float, float]:
    """How far the graph is from the same networks and solver in PyTorch, each frame from the graph's own state.

    Args:
        session: runs the graph, from where it is.
        networks, solver: what the graph was made of.
        frames: uint8 (H,W,3), of a face that moves little from one to the next.

    Returns:
        The largest mean distance of a frame's landmarks, over that of the eyes' outer corners; and the largest
        difference of a weight. Infinite where no face is followed.
    """
    gaps: list[tuple[float, float]] = []
    for frame in frames:  # each takes the state of the one before
        before = session.state
        found = session.step(frame, 1 / _FPS)
        if before[8] > 0.5 and found.presence > 0:
            gaps.append(_gap(frame, before, found, networks, solver))
    return tuple(max(column) for column in zip(*gaps, strict=True)) if gaps else (float("inf"), float("inf"))


def _gap(
    frame: np.ndarray, before: Tensor, found: WebcamFrame, networks: WebcamNetworks, solver: WebcamSolver
) -> tuple[float, float]:
    """Of one frame, from the graph's state before it."""
    read = _read(torch.from_numpy(frame).permute(2, 0, 1), before[:STATE].double(), networks)
    given = [getattr(read, name).float() for name in READ_BY_NETWORKS]
    height, width = frame.shape[:2]
    extra = [torch.tensor([width, height]).float(), torch.tensor(1 / _FPS), WebcamControls().tensor(), before[STATE:]]
    with torch.inference_mode():
        weights = solver.layout.unpack(solver(*given, *extra).clone()).weights
    apart = (found.landmarks - read.landmarks).norm(dim=1).mean() / (read.landmarks[36] - read.landmarks[45]).norm()
    return float(apart), float((found.weights - weights).abs().max())


@torch.inference_mode()
def _read(image: Tensor, state: Tensor, networks: WebcamNetworks) -> FaceReading:
    """What PyTorch reads of a picture (3,H,W) where the graph looks for its face."""
    place, anchor = state[:5], state[5:8]
    turn = torch.stack([place[3], -place[4], place[4], place[3]]).view(2, 2)
    side = place[2] * anchor[2]
    middle = place[:2] + place[2] * (turn @ anchor[:2])
    box = torch.cat([middle - side / 2, side.expand(2)])
    network = networks.landmarks
    way = crop_transform(box, float(torch.atan2(place[4], place[3])), network.size, network.margin)
    crop = cut_crop(image, way, network.size)
    marks, deviation, visibility, presence = (one[0] for one in network(crop[None].float() / 255))
    scale = float(side) * network.margin / network.size
    face = FaceReading(from_crop(marks, way), deviation * scale, visibility, presence)
    return EyeFinder(networks.eyes, networks.eyes.width, networks.eyes.height)(image, face)


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
