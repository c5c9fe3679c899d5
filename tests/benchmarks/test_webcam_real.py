"""Real people before real webcams: do mouth, lids, brows and smile follow what another network sees?

The reference is MediaPipe's 68 landmarks of six clips, no truth: its package holds no network of blendshapes. Weights
move the embedded performer's landmarks, seen from the front, and the same distances are taken of both, each about its
own mean: a slope of 1 moves as far as MediaPipe says.
"""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from real_faces import clips, pooled
from torch import Tensor
from webcam_solvers import SOLVERS, Solver, read_faces

from planted.landmark_measures import Agreement, lid_openings, mouth_gap
from torchface.files.whole_files import make_folder
from torchface.landmarks.images.face_reading import FaceReading
from torchface.shape_names import ARKIT, mapping
from torchface.synthetic import performer

pytestmark = pytest.mark.real

FPS = {"head_pose_male": 12.0}  # the others have 30
KEPT = Path("out/webcam_clips")
SETTLED = 5  # frames that tell how a solver starts


def eyes_distance(landmarks: Tensor) -> Tensor:
    """Between the outer corners, (T,)."""
    return (landmarks[:, 45] - landmarks[:, 36]).norm(dim=1)


def brow_height(landmarks: Tensor) -> Tensor:
    """How far the brows lie above the eyes' corners, across the line through these, over its length, (T,)."""
    along = landmarks[:, 45] - landmarks[:, 36]
    up = torch.stack([along[:, 1], -along[:, 0]], -1)
    rise = landmarks[:, 17:27].mean(1) - landmarks[:, [36, 39, 42, 45]].mean(1)
    return (rise * up).sum(-1) / along.square().sum(-1)


def mouth_width(landmarks: Tensor) -> Tensor:
    """Between the corners of the mouth, over the eyes' distance, (T,): a smile is wide."""
    return (landmarks[:, 54] - landmarks[:, 48]).norm(dim=1) / eyes_distance(landmarks)


SEEN: dict[str, Callable[[Tensor], Tensor]] = {
    "mouth open": mouth_gap,
    "lids": lambda landmarks: lid_openings(landmarks).mean(-1),
    "brows": brow_height,
    "smile": mouth_width,
}


@pytest.fixture(scope="module")
def filmed(data: Path) -> list[tuple[str, list[FaceReading], Tensor, float, tuple[int, int]]]:
    """Clips with what is read of them, the reference (T,68,2), frames a second, and width and height."""
    torch.set_num_threads(1)
    make_folder(KEPT)
    rows = []
    for clip in clips(data):
        fps = FPS.get(clip.name, 30.0)
        frames = torch.stack(clip.frames)
        size = (frames.shape[-1], frames.shape[-2])
        rows.append((clip.name, read_faces(frames, fps, KEPT), clip.reference.float(), fps, size))
    return rows


def shown(weights: Tensor) -> Tensor:
    """Where the embedded performer's landmarks go by weights (T,52), seen from the front, y down, (T,68,2)."""
    rig = performer(texture=False)
    marks = rig.neutral.landmarks
    assert marks is not None
    moved = torch.einsum("tn,npc->tpc", weights @ mapping(ARKIT, rig.names).T, rig.deltas[:, marks])
    return (rig.vertices[marks] + moved)[..., :2] * torch.tensor([1.0, -1.0])


def test_motion(filmed: list[tuple[str, list[FaceReading], Tensor, float, tuple[int, int]]]) -> None:
    """The table: correlation and slope over all clips."""
    print(f"\n{'correlation, slope':26s}" + "".join(f"{name:>16s}" for name in SEEN))
    found = torch.stack([torch.isfinite(r.landmarks).all() for _, readings, *_ in filmed for r in readings])
    as_read = [torch.stack([one.landmarks for one in readings]) for _, readings, *_ in filmed]
    references = [reference for _, _, reference, *_ in filmed]
    table = {"the landmarks themselves": agreements(as_read, references)}
    for name, solve in SOLVERS.items():
        table[name] = agreements(_solved(solve, filmed), references)
    for name, row in table.items():
        print(f"{name:26s}" + "".join(f"{one.correlation:8.2f}, {one.slope:5.2f} " for one in row.values()))
    print(f"{len(found)} frames of {len(filmed)} clips, a face found in {int(found.sum())}")
    assert float(found.float().mean()) > 0.97


def agreements(moved: list[Tensor], references: list[Tensor]) -> dict[str, Agreement]:
    """How distances of landmarks (T,68,2) follow those of the references, each clip about its own mean."""
    return {
        name: pooled([(one(a[SETTLED:]), one(b[SETTLED:])) for a, b in zip(moved, references, strict=True)])
        for name, one in SEEN.items()
    }


def _solved(solve: Solver, filmed: list[tuple[str, list[FaceReading], Tensor, float, tuple[int, int]]]) -> list[Tensor]:
    return [shown(solve(readings, fps, size).weights) for _, readings, _, fps, size in filmed]
