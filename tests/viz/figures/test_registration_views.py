"""A registration's picture shows scan, result and distance upright, whatever the scan's pose."""

import torch

from torchface.registration import Level, Schedule, Stage, register
from torchface.rig import BlendshapeRig
from torchface.viz.figures.registration_views import registration_sheet

SHORT = Schedule((Stage(Level.GRAPH, 5.0, 10.0, 20.0, iterations=1),), nodes=20)


def test_the_picture_is_the_same_in_any_pose_and_grey_where_nothing_matched(dome_rig: BlendshapeRig) -> None:
    template = dome_rig.neutral
    ids = torch.tensor([26, 300, 420, 590, 70])
    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    sheets = []
    for scan in (template, template.with_vertices(template.vertices @ turn.T + 50.0)):
        found = register(template, scan, (ids, scan.vertices[ids]), schedule=SHORT, texture_size=0)
        sheets.append(registration_sheet(scan, found, width=40, height=50, yaws=(0.0, 90.0)))
    assert sheets[0].shape == sheets[1].shape
    assert float((sheets[0] - sheets[1]).abs().mean()) < 0.01
    scan_column, own_column, heat = (sheets[0][:, :, 44 * i : 44 * i + 40] for i in range(3))
    assert float((scan_column - own_column)[:, 30:].abs().mean()) < 0.01
    assert float((own_column - heat).abs().mean()) > 0.05
