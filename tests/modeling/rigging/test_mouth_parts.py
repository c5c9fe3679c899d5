"""Tongues are found where they are one piece with gums, and come out; a mouth's floor is none."""

import torch
from torch import Tensor

from torchface.modeling.rigging.joined_vertices import JoinedHead
from torchface.modeling.rigging.mouth_parts import in_the_mouth, tongue_of_gums, tongue_out


def gums(height: float) -> tuple[Tensor, Tensor, Tensor]:
    """A floor of 60 by 60 mm with a rim (the arch) and a hill of a height in its middle; the hill's vertices."""
    side = 31
    across, depth = torch.meshgrid(
        torch.linspace(-30, 30, side).double(), torch.linspace(-62, -2, side).double(), indexing="ij"
    )
    rim = (across.abs() > 22) | (depth > -8)
    hill = (across.abs() < 12) & (depth < -14)
    up = torch.where(rim, -6.0, torch.where(hill, -18.0 + height, -18.0))
    grid = torch.arange(side * side).view(side, side)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    faces = torch.cat([torch.stack(one, -1).reshape(-1, 3) for one in ((a, c, b), (a, d, c))])
    return torch.stack([across, up, depth], -1).reshape(-1, 3), faces, hill.flatten()


def test_a_tongue_in_one_piece_with_gums_comes_out_and_the_arch_stays() -> None:
    points, faces, hill = gums(18.0)
    whole = torch.ones(len(points), dtype=torch.bool)
    tongue = tongue_of_gums(points, faces, whole, -points[:, 1] - 0.2 * points[:, 2], whole)
    assert float(tongue[hill].min()) > 0.8
    assert float(tongue[(points[:, 0].abs() > 20) | (points[:, 2] > -8)].max()) < 0.01
    out = tongue_out(points, tongue, torch.zeros(20, 3, dtype=torch.float64))
    tip = points + out
    assert 8.0 < float(tip[hill, 2].max()) < 12.5  # before the lips
    assert float(tip[hill, 1].max()) < float(points[hill, 1].max()) + 1e-6


def test_the_back_of_a_tongue_is_of_it_though_it_rises_over_the_line_between_the_jaws() -> None:
    """ICT-FaceKit's: a strip of its front came out, and its back stayed with the upper jaw as the mouth opened."""
    points, faces, hill = gums(18.0)
    points[hill, 1] += (0.5 * (-18 - points[hill, 2])).clamp(0, 20)  # the back rises
    below = -points[:, 1] - 0.2 * points[:, 2]
    assert bool((below[hill] < -3).any())
    whole = torch.ones(len(points), dtype=torch.bool)
    tongue = tongue_of_gums(points, faces, whole, below, whole)
    back = hill & (points[:, 0].abs() < 9) & (points[:, 2] < -20) & (points[:, 2] > -55)
    assert float(tongue[back].min()) > 0.9
    assert float(tongue[(points[:, 0].abs() > 20) | (points[:, 2] > -8)].max()) < 0.01
    head = JoinedHead(points, torch.zeros(len(points)).long(), whole, torch.zeros(1, len(points), 3))
    _, share, _ = in_the_mouth(head, faces, whole, torch.zeros(20, 3).double())
    assert float(share[back].min()) > 0.9


def test_what_is_near_teeth_is_gums_and_stays() -> None:
    points, faces, hill = gums(18.0)
    below = -points[:, 1] - 0.2 * points[:, 2]
    near = (points - torch.tensor([0.0, 0.0, -16.0])).norm(dim=-1) < 2.5  # of the hill's front edge
    whole = torch.ones(len(points), dtype=torch.bool)
    assert float(tongue_of_gums(points, faces, whole, below, whole)[near].min()) > 0.8
    tongue = tongue_of_gums(points, faces, whole, below, whole, [near])
    assert float(tongue[near].max()) < 0.01
    assert float(tongue[hill & (points[:, 2] < -24)].min()) > 0.8


def test_tufts_of_a_beard_are_not_in_the_mouth_though_their_roots_are_under_the_skin() -> None:
    cube = torch.tensor([[x, y, z] for x in (-2, 2) for y in (-3, 3) for z in (-2, 2)]).double()
    skin = torch.tensor([[-60, -60, 0], [60, -60, 0], [60, 60, 0], [-60, 60, 0]]).double()
    tuft = torch.tensor([[0, 0, -1], [1, 0, -1], [0, -8, 5]]).double() + torch.tensor([9.0, 12.0, 0.0])
    points = torch.cat([skin, cube - torch.tensor([0.0, 6.0, 8.0]), tuft - torch.tensor([0.0, 0.0, 1.0])])
    part = torch.tensor([0] * 4 + [1] * 8 + [2] * 3)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    head = JoinedHead(points, part, part > 0, torch.zeros(1, len(points), 3))
    inside, _, _ = in_the_mouth(head, faces, part > 0, torch.zeros(20, 3).double())
    assert torch.equal(inside, part == 1)


def test_a_mouths_floor_is_no_tongue() -> None:
    points, faces, _ = gums(0.0)
    below = -points[:, 1] - 0.2 * points[:, 2]
    whole = torch.ones(len(points), dtype=torch.bool)
    assert not bool(tongue_of_gums(points, faces, whole, below, whole).any())


def test_what_lies_under_gums_is_a_bag_and_no_tongue() -> None:
    points, faces, _ = gums(18.0)
    cover, triangles, _ = gums(18.0)
    cover[:, 1] += 3.0
    both = torch.cat([points, cover])
    first = torch.arange(len(both)) < len(points)
    own = -points[:, 1] - 0.2 * points[:, 2]
    faces = torch.cat([faces, triangles + len(points)])
    assert bool(tongue_of_gums(both, faces, first, own, first).any())
    assert not bool(tongue_of_gums(both, faces, first, own, torch.ones(len(both), dtype=torch.bool)).any())


def test_teeth_that_sit_low_behind_the_lips_belong_to_the_jaws_of_their_rows() -> None:
    cube = torch.tensor([[x, y, z] for x in (-2, 2) for y in (-3, 3) for z in (-2, 2)]).double()
    across = torch.linspace(-22, 22, 12).double()
    teeth = [
        cube + torch.stack([x, torch.tensor(height) + 0.02 * x.abs(), -8 - x.abs()])
        for height in (-2.0, -10.0)  # the lips' line is at 0: the gap between the rows lies 6 mm under it
        for x in across
    ]
    part = torch.arange(len(teeth)).repeat_interleave(8)
    points = torch.cat(teeth)
    whole = torch.ones(len(points), dtype=torch.bool)
    head = JoinedHead(points, part, whole, torch.zeros(1, len(points), 3))
    _, share, _ = in_the_mouth(head, torch.zeros(0, 3).long(), whole, torch.zeros(20, 3).double())
    assert torch.equal(share, (part >= len(across)).double())


def test_a_tongue_that_touches_teeth_comes_out_whole_where_gums_are_a_part_of_their_own() -> None:
    floor, triangles, hill = gums(12.0)
    rim = ((floor[:, 0].abs() > 22) | (floor[:, 2] > -8)) & (floor[:, 2] > -50)
    pieces = [(floor[rim], triangles[rim[triangles].all(1)]), (floor[hill], triangles[hill[triangles].all(1)])]
    pieces[0] = pieces[0][0], (rim.cumsum(0) - 1)[pieces[0][1]]
    pieces[1] = pieces[1][0] * torch.tensor([1.8, 1.0, 1.0]).double(), (hill.cumsum(0) - 1)[pieces[1][1]]
    cube = torch.tensor([[x, y, z] for x in (-2, 2) for y in (-3, 3) for z in (-2, 2)]).double()
    ahead = torch.tensor([[x, -3.0, -4.0] for x in (-20.0, -12.0, 12.0, 20.0)]).double()  # stand on the gums
    beside = pieces[1][0][[0, 1, 2, 3]]  # touch the tongue
    teeth = [cube + one for one in torch.cat([ahead, beside + torch.tensor([2.0, 3.0, 2.0])])]
    points = torch.cat([pieces[0][0], pieces[1][0], *teeth])
    sizes = [len(pieces[0][0]), len(pieces[1][0]), *[8] * len(teeth)]
    part = torch.arange(len(sizes)).repeat_interleave(torch.tensor(sizes))
    faces = torch.cat([pieces[0][1], pieces[1][1] + sizes[0]])
    whole = torch.ones(len(points), dtype=torch.bool)
    head = JoinedHead(points, part, whole, torch.zeros(1, len(points), 3))
    _, _, tongue = in_the_mouth(head, faces, whole, torch.zeros(20, 3).double())
    assert torch.equal(tongue, (part == 1).double())


def test_gums_of_few_triangles_are_no_tongue_beside_a_longer_one() -> None:
    """The share of a part near the middle is one of area, not of its few vertices."""
    floor, triangles, hill = gums(12.0)
    rim = ((floor[:, 0].abs() > 22) | (floor[:, 2] > -8)) & (floor[:, 2] > -50)
    front = rim & (floor[:, 0].abs() < 5)
    dense = torch.cat([floor[rim], floor[front].repeat(30, 1)])  # vertices in the middle that bear no area
    faces = (rim.cumsum(0) - 1)[triangles[rim[triangles].all(1)]]
    tongue = floor[hill]
    points = torch.cat([dense, tongue])
    part = (torch.arange(len(points)) >= len(dense)).long()
    both = torch.cat([faces, (hill.cumsum(0) - 1)[triangles[hill[triangles].all(1)]] + len(dense)])
    whole = torch.ones(len(points), dtype=torch.bool)
    head = JoinedHead(points, part, whole, torch.zeros(1, len(points), 3))
    _, _, found = in_the_mouth(head, both, whole, torch.zeros(20, 3).double())
    assert torch.equal(found, part.double())
