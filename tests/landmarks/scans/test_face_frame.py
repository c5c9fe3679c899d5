"""The face frame on heads whose landmarks are known: learned from some, found on others in any pose."""

import pytest
import torch
import trimesh
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.similarity import Similarity
from torchface.landmarks.scans.face_frame import FaceFrame
from torchface.landmarks.scans.pose_search import nose_candidates, sample_surface
from torchface.landmarks.scans.uv_landmark_names import MIRRORED, UV_LANDMARK_NAMES, uv_landmarks_from_ibug
from torchface.mesh import Mesh
from torchface.synthetic import draw_identities, neutral_head

Example = tuple[Mesh, Tensor]


def posed(identity: Tensor, seed: int) -> Example:
    """A head turned any way, and its twelve landmarks."""
    mesh = neutral_head(identity, texture=False)
    generator = torch.Generator().manual_seed(seed)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    turn = turn * torch.linalg.det(turn)
    vertices = mesh.vertices.double() @ turn.T + 100 * torch.randn(3, generator=generator, dtype=torch.float64)
    return mesh.with_vertices(vertices.float()), uv_landmarks_from_ibug(vertices[mesh.landmarks])


@pytest.fixture(scope="module")
def examples() -> list[Example]:
    identities = draw_identities(7, torch.Generator().manual_seed(5))
    return [posed(identity, seed) for seed, identity in enumerate(identities)]


@pytest.fixture(scope="module")
def frame(examples: list[Example]) -> FaceFrame:
    return FaceFrame.fit([mesh for mesh, _ in examples[:5]], torch.stack([points for _, points in examples[:5]]))


@pytest.fixture(scope="module")
def poses(frame: FaceFrame, examples: list[Example]) -> list[Similarity]:
    """The poses found of the two heads that the frame was not learned from."""
    return [frame.locate(mesh) for mesh, _ in examples[5:]]


def residual(frame: FaceFrame, pose: Similarity, points: Tensor) -> float:
    return float((pose.apply(points[None])[0] - frame.landmarks).norm(dim=-1).mean())


def test_the_frame_stands_upright_and_symmetric(frame: FaceFrame) -> None:
    eyes, mouth = frame.landmarks[2:6].mean(0), frame.landmarks[8:10].mean(0)
    assert (eyes - mouth)[1] > 55
    assert (eyes - mouth)[[0, 2]].abs().max() < 2.0
    assert frame.landmarks[UV_LANDMARK_NAMES.index("nose"), 2] == frame.landmarks[:, 2].max()
    mirrored = frame.landmarks[list(MIRRORED)] * torch.tensor([-1.0, 1.0, 1.0])
    assert (mirrored - frame.landmarks).abs().max() < 1.5


def test_new_heads_are_found_in_any_pose(frame: FaceFrame, examples: list[Example], poses: list[Similarity]) -> None:
    errors = [residual(frame, pose, points) for pose, (_, points) in zip(poses, examples[5:], strict=True)]
    assert max(errors) < 9.0
    assert sum(errors) / len(errors) < 5.0


def test_a_scan_turned_and_smaller_has_the_pose_turned_and_larger(
    frame: FaceFrame, examples: list[Example], poses: list[Similarity]
) -> None:
    mesh, points = examples[6]
    turn = 0.92 * torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    first, second = poses[1], frame.locate(mesh.with_vertices(mesh.vertices @ turn.T + 50))
    here = first.apply(points[None])[0]
    there = second.apply((points @ turn.T.double() + 50)[None])[0]
    assert (here - there).norm(dim=-1).max() < 1.0
    assert float(second.scale / first.scale) == pytest.approx(1 / 0.92, rel=0.01)


def test_a_scan_inside_out_and_with_crumbs_is_found(frame: FaceFrame, examples: list[Example]) -> None:
    mesh, points = examples[5]
    crumb = trimesh.creation.icosphere(subdivisions=2, radius=6.0)
    extra = torch.tensor(crumb.vertices).float() + mesh.vertices.mean(0) + 200
    vertices = torch.cat([mesh.vertices, extra])
    faces = torch.cat([mesh.faces.flip(1), torch.tensor(crumb.faces).flip(1) + len(mesh.vertices)])
    assert residual(frame, frame.locate(Mesh(vertices, faces)), points) < 9.0


def test_the_nose_is_among_the_first_candidates(examples: list[Example]) -> None:
    for mesh, points in examples[:3]:
        found = nose_candidates(sample_surface(mesh))
        distance = (found.points - points[UV_LANDMARK_NAMES.index("nose")]).norm(dim=-1)
        assert int(distance.argmin()) < 25
        assert distance.min() < 9


def test_what_is_no_face_is_said(frame: FaceFrame) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=90.0)
    mesh = Mesh(torch.tensor(ball.vertices).float(), torch.tensor(ball.faces, dtype=torch.int64))
    with pytest.raises(ValueRangeError, match="found no face"):
        frame.locate(mesh)


def test_bad_input_is_named(examples: list[Example]) -> None:
    mesh, points = examples[0]
    with pytest.raises(ShapeError, match=r"\(2,12,3\)"):
        FaceFrame.fit([mesh, mesh], points[None])
    with pytest.raises(ValueRangeError, match="at least three"):
        FaceFrame.fit([mesh], torch.full((1, 12, 3), torch.nan))
    with pytest.raises(ValueRangeError, match="without area"):
        sample_surface(Mesh(torch.zeros(3, 3), torch.tensor([[0, 1, 2]])))
