"""Landmarks of the contour slide along the skin, not along what hangs beside it."""

import torch

from planted.characters import box_mesh
from torchface.capture.own_rig.face_points import FacePoints
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer


def test_hair_beside_the_jaw_is_no_contour() -> None:
    actor = performer(texture=False).select(["jawOpen"])
    vertices, faces = [actor.vertices], [actor.neutral.faces]
    for side in (-1.0, 1.0):
        strand, triangles = box_mesh(torch.tensor([side * 110.0, -60, 60]), torch.tensor([20.0, 160, 20]), 3)
        faces.append(triangles + sum(map(len, vertices)))
        vertices.append(strand.float())
    more = torch.zeros(1, sum(map(len, vertices[1:])), 3)
    both = BlendshapeRig.from_tensors(
        torch.cat(vertices), torch.cat(faces), torch.cat([actor.deltas, more], 1), actor.names
    )
    found, alone = (FacePoints.of(rig, actor.neutral.landmarks) for rig in (both, actor))
    assert torch.equal(found.rest, alone.rest)
    assert torch.equal(found.valid, alone.valid)
