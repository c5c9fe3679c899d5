"""A rig drawn fast: its lips in its own texture, and teeth that a shut mouth hides in light."""

from dataclasses import replace

import torch

from torchface.geometry.cameras.pinhole import Camera
from torchface.mesh import Mesh
from torchface.rendering.quick_clay import QuickClay
from torchface.synthetic import Look, character, performer

BLUE = torch.tensor([0.1, 0.2, 0.8])


def test_lips_are_drawn_in_the_texture() -> None:
    head = performer(texture=False).neutral
    painted = replace(head, texture=BLUE[:, None, None].expand(3, 8, 8).contiguous())
    intrinsics = torch.tensor([[900.0, 0, 160], [0, 900, 160], [0, 0, 1]]).double()
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    lip = head.vertices[head.landmarks[57]].double()
    camera = Camera(intrinsics, flip, torch.tensor([0.0, 0, 400]).double() - flip @ lip, 320, 320)
    red, _, blue = QuickClay.of(painted, skin=True).draw(head.vertices, camera)[160, 160].tolist()
    assert blue > 2 * red
    red, _, blue = QuickClay.of(painted).draw(head.vertices, camera)[160, 160].tolist()  # clay
    assert red > blue


def test_a_tint_shows_on_a_texture_too() -> None:
    head = performer(texture=False).neutral
    painted = replace(head, texture=BLUE[:, None, None].expand(3, 8, 8).contiguous())
    intrinsics = torch.tensor([[900.0, 0, 160], [0, 900, 160], [0, 0, 1]]).double()
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    nose = head.vertices[head.landmarks[30]].double()
    camera = Camera(intrinsics, flip, torch.tensor([0.0, 0, 400]).double() - flip @ nose, 320, 320)
    clay = QuickClay.of(painted, skin=True)
    tints = [torch.full((len(head.vertices),), tint) for tint in (0.0, 0.67, 1.0)]
    plain, half, full = (clay.draw(head.vertices, camera, tint) for tint in tints)
    assert (plain == clay.draw(head.vertices, camera)).all()
    redder = [int(image[160, 160, 0]) - int(image[160, 160, 2]) for image in (plain, half, full)]
    assert redder[0] + 80 < redder[1] < redder[2] - 30


def test_irises_have_the_colour_of_a_texture_that_shows_some() -> None:
    head = performer(texture=False).neutral
    intrinsics = torch.tensor([[3000.0, 0, 160], [0, 3000, 160], [0, 0, 1]]).double()
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    eye = head.vertices[head.landmarks[36:42]].mean(0).double()
    camera = Camera(intrinsics, flip, torch.tensor([0.0, 0, 400]).double() - flip @ eye, 320, 320)
    for look in (Look(iris=(0.2, 0.3, 0.6)), Look(iris=(0.4, 0.25, 0.1))):
        shown = character(look=look, size=256).rig.neutral
        drawn = QuickClay.of(shown, skin=True).draw(shown.vertices, camera).astype(float)
        ring = drawn[[160, 160, 160], [142, 178, 182]].mean(0)  # between pupil and white
        assert (ring[2] > 1.2 * ring[0]) == (look.iris[2] > look.iris[0])


def test_what_lies_within_keeps_light_for_when_it_is_seen() -> None:
    """A plate closely behind a larger one, as teeth behind lips, of no region."""
    grid = torch.cartesian_prod(torch.linspace(-40, 40, 21), torch.linspace(-40, 40, 21))
    rows = torch.arange(20 * 21).view(20, 21)[:, :20].flatten()
    faces = torch.cat([torch.stack([rows, rows + 21, rows + 1], 1), torch.stack([rows + 1, rows + 21, rows + 22], 1)])
    front = torch.cat([grid, torch.zeros(len(grid), 1)], 1)
    teeth = torch.cat([grid[:105] * 0.5, torch.full((105, 1), -2.0)], 1)
    both = Mesh(torch.cat([front, teeth]), torch.cat([faces, faces[(faces < 105).all(1)] + len(front)]))
    clay = QuickClay.of(both)
    assert float(clay.openness[len(front) :].min()) >= 0.6


def test_teeth_are_dark_behind_lips_that_are_hardly_apart() -> None:
    rig = performer(texture=False)
    head, clay = rig.neutral, QuickClay.of(rig.neutral)
    intrinsics = torch.tensor([[3000.0, 0, 160], [0, 3000, 160], [0, 0, 1]]).double()
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    for jaw in (0.05, 0.4):
        posed = rig(jaw * torch.eye(len(rig.names))[[rig.names.index("jawOpen")]])[0]
        middle = posed[head.landmarks[[62, 66]]].mean(0).double()
        camera = Camera(intrinsics, flip, torch.tensor([0.0, 0, 400]).double() - flip @ middle, 320, 320)
        drawn, evenly = (one.draw(posed, camera).astype(float) for one in (clay, replace(clay, mouth=None)))
        assert (drawn <= evenly).all()
        changed = evenly.sum(2) - drawn.sum(2) > 60
        assert changed.sum() > 200 if jaw < 0.1 else not changed.any()


def test_irises_end_without_stairs() -> None:
    """Beside the whites, in the row through an eye's middle, lies a pixel of a colour between."""
    head = performer(texture=False).neutral
    intrinsics = torch.tensor([[3000.0, 0, 160], [0, 3000, 160], [0, 0, 1]]).double()
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    eye = head.vertices[head.landmarks[36:42]].mean(0).double()
    camera = Camera(intrinsics, flip, torch.tensor([0.0, 0, 400]).double() - flip @ eye, 320, 320)
    row = QuickClay.of(head).draw(head.vertices, camera)[160, :, 2].astype(float)
    iris, white = row[140], row[100:220].max()
    assert white > iris + 100
    assert abs(row[101:220] - row[100:219]).max() < 0.7 * (white - iris)
