"""The line between lips is found on the skin, however far off the lips are that pictures show."""

import pytest
import torch
from torch import Tensor

from planted.characters import decimated, subdivided
from torchface.landmarks.surfaces.eye_openings import Opening
from torchface.landmarks.surfaces.lip_line import lip_line
from torchface.mesh import submesh
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer


@pytest.fixture(scope="module")
def actor() -> BlendshapeRig:
    return performer(texture=False).select(["jawOpen"])


def skin_of(rig: BlendshapeRig) -> Tensor:
    regions = rig.neutral.annotations.regions
    return rig.neutral.faces[~(regions["eyeball_left"] | regions["eyeball_right"])[rig.neutral.faces].any(1)]


def corners(line: Opening) -> Tensor:
    """Where along x its shares are 0 and 1."""
    x = line.upper[[0, -1], 0]
    width = (x[1] - x[0]) / (line.share[-1] - line.share[0])
    return x[0] + width * (torch.tensor([0.0, 1.0]).double() - line.share[0])


@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (4.0, -7.0, 5.0), (-3.0, 8.0, -5.0)])
def test_line_lies_where_lips_meet(actor: BlendshapeRig, off: tuple[float, ...]) -> None:
    vertices, marks = actor.vertices.double(), actor.vertices[actor.neutral.landmarks].double()
    line = lip_line(vertices, skin_of(actor), marks[48:68] + torch.tensor(off))
    upper, lower = line.at(torch.tensor([0.0, 0.5, 1.0]).double())
    assert torch.allclose(upper[1], marks[62], atol=0.8)
    assert torch.allclose(lower[1], marks[66], atol=0.8)
    assert torch.allclose(corners(line), marks[[48, 54], 0], atol=1.0)


def test_open_lips_have_two_edges(actor: BlendshapeRig) -> None:
    posed = actor(torch.tensor([[0.5]]))[0].double()
    marks = posed[actor.neutral.landmarks]
    line = lip_line(posed, skin_of(actor), marks[48:68])
    upper, lower = line.at(torch.tensor([0.5]).double())
    assert float(marks[62, 1] - marks[66, 1]) > 8
    assert abs(float(upper[0, 1] - marks[62, 1])) < 1.5
    assert abs(float(lower[0, 1] - marks[66, 1])) < 1.5


def test_corners_of_finer_lips_are_where_they_were(actor: BlendshapeRig) -> None:
    marks = actor.vertices[actor.neutral.landmarks].double()
    vertices, faces, _ = subdivided(actor.vertices, skin_of(actor))
    line = lip_line(vertices.double(), faces, marks[48:68])
    assert torch.allclose(corners(line), marks[[48, 54], 0], atol=1.5)


def test_lips_that_are_joined_at_their_sides_have_no_line(actor: BlendshapeRig) -> None:
    face = submesh(actor.neutral, actor.neutral.annotations.regions["face"])
    coarse = decimated(BlendshapeRig(face.mesh, actor.deltas[:, face.vertex_ids], actor.names), 2000)
    lips = actor.vertices[actor.neutral.landmarks[48:68]].double()
    for weight in (0.0, 0.6):  # the jaw does not part them
        posed = coarse(torch.tensor([[weight]]))[0].double()
        assert lip_line(posed, coarse.neutral.faces, lips) is None


def test_skin_in_one_piece_has_no_line() -> None:
    y, x = torch.meshgrid(torch.linspace(-60, 60, 61), torch.linspace(-60, 60, 61), indexing="ij")
    vertices = torch.stack([x, y, 80 - (x.square() + y.square()) / 200], -1).reshape(-1, 3).double()
    grid = torch.arange(61 * 61).view(61, 61)
    quads = torch.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], -1).reshape(-1, 4)
    faces = torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    lips = torch.tensor([[-25.0, 0, 75], [0, 5, 80], [25, 0, 75], [0, -5, 80]]).double()
    assert lip_line(vertices, faces, lips) is None
