"""Loose parts of a head go with its skin, and shells of the eye stay before the eyeball."""

import torch

from torchface.modeling.rigging.eyelid_closure import stands_before
from torchface.modeling.rigging.loose_parts import moved_parts
from torchface.rendering.raycast import RayCaster
from torchface.synthetic import performer

SHAPES = ("eyeWideLeft", "eyeBlinkLeft", "eyeSquintLeft", "eyeLookUpLeft")


def test_a_tear_film_stays_before_the_eye_in_shapes_of_the_lids() -> None:
    actor = performer(texture=False).select(SHAPES)
    vertices, faces = actor.vertices.double(), actor.neutral.faces
    assert actor.neutral.annotations is not None
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
