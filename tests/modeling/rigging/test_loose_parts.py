"""Loose parts of a head go with its skin, and shells of the eye stay before the eyeball."""

import torch

from torchface.geometry.meshes.operators import components, vertex_normals
from torchface.mesh import submesh
from torchface.modeling.rigging.eyelid_closure import stands_before
from torchface.modeling.rigging.loose_parts import moved_parts
from torchface.rendering.raycast import RayCaster
from torchface.synthetic import performer

SHAPES = ("eyeWideLeft", "eyeBlinkLeft", "eyeSquintLeft", "eyeLookUpLeft")


def test_a_tear_film_stays_before_the_eye_in_shapes_of_the_lids() -> None:
    actor = performer(texture=False).select(SHAPES)
    vertices, faces = actor.vertices.double(), actor.neutral.faces
    ball = actor.neutral.annotations.regions["eyeball_left"]
    middle, front = vertices[ball].mean(0), ball & (vertices[:, 2] > vertices[ball][:, 2].median())
    ids, film = front.nonzero()[:, 0], faces[front[faces].all(1)]
    place = torch.full((len(vertices),), -1)
    place[ids] = len(vertices) + torch.arange(len(ids))
    all_vertices = torch.cat([vertices, middle + 1.03 * (vertices[ids] - middle)])
    part = torch.cat([ball.long(), torch.full((len(ids),), 2)])
    deltas = torch.cat([actor.deltas.double(), torch.zeros(len(SHAPES), len(ids), 3, dtype=torch.float64)], 1)
    moved = moved_parts(actor, all_vertices, torch.cat([faces, place[film]]), part, part > 0, deltas).deltas
    used = place[film.unique()]
    eye = RayCaster(vertices, faces[ball[faces].all(1)])
    for delta in moved:
        assert float(stands_before(eye, (all_vertices + delta)[used]).max()) < 0


def test_a_beard_that_stands_off_the_skin_goes_with_the_jaw() -> None:
    """A shell a centimetre before chin and cheeks, which the skin touches nowhere; its tip hangs from it."""
    actor = performer(texture=False).select(["jawOpen"])
    regions, vertices = actor.neutral.annotations.regions, actor.vertices.double()
    chin = (regions["chin"] | regions["jaw"]) & (vertices[:, 2] > 20)
    piece = submesh(actor.neutral, chin)
    off = vertices[chin] + 10 * vertex_normals(vertices, actor.neutral.faces)[chin]
    low = off[:, 1] < off[:, 1].median()
    off[low, 1] -= (off[:, 1].median() - off[low, 1]) * 2
    count = len(vertices)
    both, faces = torch.cat([vertices, off]), torch.cat([actor.neutral.faces, piece.mesh.faces + count])
    loose = torch.arange(len(both)) >= count
    deltas = torch.zeros(1, len(both), 3, dtype=torch.float64)
    deltas[:, :count] = actor.deltas.double()
    moved = moved_parts(actor, both, faces, components(faces, len(both)), loose, deltas).deltas[0]
    under = moved[:count][chin]
    front = (vertices[chin][:, 2] > 60) & ~low
    assert float(under[front].norm(dim=1).mean()) > 25
    assert torch.allclose(moved[count:][front], under[front], atol=6.0)  # millimetres
    before_the_neck = low & (off[:, 2] > off[:, 2].quantile(0.9))
    assert float(moved[count:][before_the_neck][:, 1].mean()) < -15
