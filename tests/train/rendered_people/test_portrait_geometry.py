"""Pieces of a portrait beside the bare head."""

import torch

from torchface.rendering.raycast import RayCaster
from torchface.synthetic import draw_identities, performer
from train.rendered_people.portrait_geometry import teeth

# Lips that stay shut; a chin that lies far back, and a lower lip that is pushed up, leave little room for teeth.
SHUT = ({}, {"mouthShrugLower": 0.6}, {"mouthSmileLeft": 0.6, "mouthSmileRight": 0.6, "mouthRollLower": 0.5})


def test_no_tooth_stands_before_shut_lips_or_the_chin() -> None:
    for identity in draw_identities(12, torch.Generator().manual_seed(1)):
        rig = performer(identity, texture=False)
        rest = rig.vertices.double()
        for pose in SHUT:
            weights = torch.zeros(1, len(rig.names))
            for name, weight in pose.items():
                weights[0, rig.names.index(name)] = weight
            moved = rig(weights)[0].double()
            points = torch.cat([points for points, _ in teeth(rest, moved, rig.neutral.faces)]).float()
            forward = torch.tensor([0.0, 0, 1]).expand(len(points), 3)
            hidden = RayCaster(moved.float(), rig.neutral.faces).occluded(points, forward)
            lips = moved[rig.neutral.landmarks[[62, 66]], 1].mean()
            assert bool((hidden | ((points[:, 1] - lips).abs() < 1.0)).all())  # through the gap of shut lips one sees
