"""Heads of ICT-FaceKit as a model: blinks that shut the eyes, lips that meet at rest, teeth in an open mouth."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import BlendshapeRig, Mesh
from torchface.mesh import Annotations
from torchface.modeling.rigging.eyelid_closure import BLINKS, SkinOfHead, eyes_seen, shut_blinks
from torchface.modeling.rigging.ict_heads import mended_head, with_meeting_lips, with_shut_lids, with_teeth_in_sight
from torchface.rendering.raycast import RayCaster
from torchface.synthetic import performer
from torchface.workflows.rig.actor_rig import load_template
from train.morphable import ict_head_model


@pytest.fixture(scope="module")
def actor() -> BlendshapeRig:
    """The performer with parts of ICT's names, all but the eyeballs skin."""
    rig = performer(texture=False).select([*BLINKS, "jawOpen"])
    annotations = rig.neutral.annotations
    skin = ~(annotations.regions["eyeball_left"] | annotations.regions["eyeball_right"])
    regions = annotations.regions | {"face": skin, "head_and_neck": skin}
    neutral = replace(rig.neutral, annotations=replace(annotations, regions=regions))
    return BlendshapeRig(neutral, rig.deltas, rig.names)


def gap(mesh: Mesh, vertices: Tensor) -> float:
    """Between the inner lips, millimetres."""
    upper, lower = mesh.landmarks[[61, 62, 63]], mesh.landmarks[[67, 66, 65]]
    return float((vertices[upper] - vertices[lower])[:, 1].abs().max())


def test_blinks_that_leave_the_eyes_open_shut_them(actor: BlendshapeRig) -> None:
    mesh, vertices = actor.neutral, actor.vertices.double()
    ball = mesh.regions["eyeball_left"].long() + 2 * mesh.regions["eyeball_right"].long()
    head = SkinOfHead(vertices, mesh.faces, ball > 0, ball)
    openings = eyes_seen(head, vertices[mesh.landmarks])
    scale = torch.tensor([0.6, 0.6, 1.0])[:, None, None]
    poor = BlendshapeRig(mesh, scale * actor.deltas, actor.names)
    shut = with_shut_lids(poor)
    for row, opening in enumerate(openings):
        lid = mesh.landmarks[[37, 38]] if row == 0 else mesh.landmarks[[43, 44]]
        lower = mesh.landmarks[[41, 40]] if row == 0 else mesh.landmarks[[47, 46]]
        height = float((opening.upper - opening.lower)[:, 1].max())
        for rig, low, high in ((poor, 0.3, 1.0), (shut, -0.1, 0.1)):
            pose = rig.vertices + rig.deltas[row]
            assert low < float((pose[lid] - pose[lower])[:, 1].mean()) / height < high
    assert torch.equal(shut.deltas[2], actor.deltas[2])
    again = shut_blinks(head, shut.deltas.double(), shut.names, openings)[1]
    assert max(again) < 0.08


def test_how_far_lips_are_parted_is_no_identity(actor: BlendshapeRig) -> None:
    mesh, jaw = actor.neutral, actor.deltas[2]
    one = jaw / gap(mesh, jaw)  # opens the mouth by a millimetre
    parted = mesh.with_vertices(mesh.vertices + 0.8 * one)
    wider = 0.02 * mesh.vertices * torch.tensor([1.0, 0.0, 0.0])
    assert gap(mesh, parted.vertices) > 0.6
    met, modes = with_meeting_lips(parted, torch.stack([one, wider]))
    for a in ([0.0, 0.0], [2.0, 1.0], [-1.0, 2.0]):
        assert gap(mesh, met.vertices + torch.tensordot(torch.tensor(a), modes, dims=1)) < 0.05
    torch.testing.assert_close(modes[1], wider, rtol=0, atol=1e-4)  # lips stay as wide
    far = (mesh.vertices - mesh.vertices[mesh.landmarks[48:]].mean(0)).norm(dim=1) > 42
    assert torch.equal(met.vertices[far], parted.vertices[far])


def test_of_an_open_mouth_both_rows_of_teeth_come_nearer_to_each_other_and_nothing_else_moves() -> None:
    vertices = torch.tensor([[0.0, 2.0, 0.0], [0.0, -2.0, 0.0], [0.0, 0.0, 9.0]])  # an upper tooth, a lower one, a lip
    teeth = torch.tensor([True, True, False])
    mesh = Mesh(vertices, torch.tensor([[0, 1, 2]]), annotations=Annotations(None, {"teeth": teeth}, None))
    opened = torch.zeros(2, 3, 3)
    opened[0, 1:, 1] = -30.0
    rig = with_teeth_in_sight(BlendshapeRig(mesh, opened, ("jawOpen", "mouthPucker")))
    pose = rig.vertices + rig.deltas
    assert pose[0, :, 1].tolist() == [0.0, -28.0, -30.0]
    assert pose[1, :, 1].tolist() == [0.0, -2.0, 0.0]
    face = rig.part(~rig.neutral.regions["teeth"])  # no row of teeth is looked for
    assert with_teeth_in_sight(face) is face


def seen(mesh: Mesh, vertices: Tensor, marks: slice, parts: tuple[str, ...], clear: Tensor) -> int:
    """How many of the rays from the front onto some landmarks' box, 0.25 mm apart, hit these parts first."""
    vertices = vertices.double()
    at = mesh.vertices.double()[mesh.landmarks[marks]]
    low, high = at.amin(0) - 2, at.amax(0) + 2
    x, y = (torch.arange(float(low[k]), float(high[k]), 0.25, dtype=torch.float64) for k in (0, 1))
    grid = torch.cartesian_prod(x, y)
    origins = torch.cat([grid, torch.full((len(grid), 1), 300.0, dtype=torch.float64)], dim=1)
    faces = mesh.faces[~clear[mesh.faces].any(1)]
    hits = RayCaster(vertices, faces).cast(origins, torch.tensor([0.0, 0.0, -1.0]).double().expand_as(origins))
    wanted = torch.stack([mesh.regions[name] for name in parts]).any(0)
    return int(wanted[faces[hits.triangle[hits.triangle >= 0], 0]].sum())


@pytest.mark.real
def test_no_eyeball_shows_in_a_blink_and_teeth_in_an_open_mouth_but_not_at_rest(ict_folder: Path) -> None:
    """Of the model of people, and of the template that ``rig`` puts on scans."""
    model, template = ict_head_model(ict_folder, components=6), load_template(ict_folder)
    rig = model.rig
    torch.testing.assert_close(template.deltas, rig.deltas)
    torch.testing.assert_close(template.vertices, rig.vertices)
    mesh = rig.neutral
    films = ("lacrimal", "eye_blend", "eye_occlusion", "eyelashes")
    clear = torch.stack([mask for name, mask in mesh.regions.items() if name.startswith(films)]).any(0)
    blink = rig.vertices + rig.deltas[[rig.names.index(f"eyeBlink_{side}") for side in "LR"]].sum(0)
    for marks in (slice(36, 42), slice(42, 48)):  # ICT's own: 150 of the rays
        assert seen(mesh, blink, marks, ("eyeball_left", "eyeball_right"), clear) < 5
    opened = rig.vertices + rig.deltas[rig.names.index("jawOpen")]  # ICT's own: 10 of the rays; drawn heads: 4300
    assert seen(mesh.with_vertices(opened), opened, slice(60, 68), ("teeth",), clear) > 800
    for seed in range(3):
        a = torch.randn(6, generator=torch.Generator().manual_seed(seed))
        assert seen(mesh, model(a[None]).vertices[0], slice(60, 68), ("teeth", "mouth_socket"), clear) < 5


def test_a_part_of_a_head_stays_as_it_is(actor: BlendshapeRig) -> None:
    """The performer has no teeth of that name, and `rig --part face` keeps no eyes."""
    modes = torch.ones(2, *actor.vertices.shape)
    assert mended_head(actor, modes) == (actor, modes)
    assert mended_head(actor)[1].shape == (0, *actor.vertices.shape)
