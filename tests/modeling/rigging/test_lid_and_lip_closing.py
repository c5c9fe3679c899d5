"""Contact on a cut sheet whose two lips or lids close: what is found, what it changes, and on a real head."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import Annotations, BlendshapeRig, Mesh
from torchface.geometry.meshes.contact import ContactFinder
from torchface.io import load_ict_facekit, load_identity_modes
from torchface.modeling import transfer_with_report
from torchface.modeling.rigging.lid_and_lip_closing import find_seams
from torchface.synthetic import performer

COLUMNS = 31
SKIN = torch.linspace(24, 0, 13, dtype=torch.float64)
DEPTH = torch.tensor([-1.0, -2.0, -3.0, -4.5], dtype=torch.float64)
ROWS = 2 * (len(SKIN) + len(DEPTH))
UPPER = ROWS // 2


def slit(gap: float, bulge: float = 0.0, corner: float = 3.0) -> Tensor:
    """A sheet (V,3) that turns inward along an opening: skin above, upper rim, back, lower rim, skin below.

    The opening is ``gap`` wide in the middle, ``corner`` at both ends; ``bulge`` lifts the skin above it.
    """
    x = torch.linspace(-20, 20, COLUMNS, dtype=torch.float64)
    half = 0.5 * (corner + (gap - corner) * (1 - (x / 20) ** 2))
    lift = bulge * torch.cos(x / 15)
    zero = torch.zeros_like(x)
    above = [torch.stack([x, half + height + lift * height / 24, zero], -1) for height in SKIN]
    inside = [torch.stack([x, half, zero + depth], -1) for depth in DEPTH]
    half_sheet = torch.stack([*above, *inside])
    mirrored = half_sheet.flip(0) * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    if bulge:
        heights = torch.cat([-DEPTH.flip(0) * 0, SKIN.flip(0)])
        mirrored[..., 1] += lift * heights[:, None] / 24
    return torch.cat([half_sheet, mirrored]).view(-1, 3)


def sheet_faces() -> Tensor:
    corner = (torch.arange(ROWS - 1)[:, None] * COLUMNS + torch.arange(COLUMNS - 1)).flatten()
    first = torch.stack([corner, corner + COLUMNS, corner + 1], dim=1)
    second = torch.stack([corner + 1, corner + COLUMNS, corner + COLUMNS + 1], dim=1)
    return torch.cat([first, second])


def upper_down(at: Tensor, amount: Tensor) -> Tensor:
    """The upper half moves down by ``amount`` (V,) at the rim, less and less above it."""
    delta = torch.zeros_like(at)
    weight = (1 - at[:, 1].clamp(min=0) / 24).clamp(min=0)
    weight[UPPER * COLUMNS :] = 0
    delta[:, 1] = -amount * weight**1.5
    return delta


def rim_gap(at: Tensor) -> Tensor:
    """From the upper rim to the lower, by column, (31,)."""
    rows = at.view(ROWS, COLUMNS, 3)
    front = len(SKIN) - 1
    return rows[front, :, 1] - rows[ROWS - 1 - front, :, 1]


def lids() -> BlendshapeRig:
    at = slit(9.0)
    opening = rim_gap(at).repeat(ROWS)
    return BlendshapeRig(Mesh(at, sheet_faces()), upper_down(at, opening - 0.4)[None], ["shut"])


def lips() -> BlendshapeRig:
    """A seam 0.8 mm wide: one shape drops the lower half, one lifts it again, one presses."""
    at = slit(0.8, corner=0.8)
    lower = torch.zeros_like(at)
    lower[UPPER * COLUMNS :, 1] = -20 * (1 + at[UPPER * COLUMNS :, 1] / 30).clamp(min=0)
    lower[UPPER * COLUMNS :, 2] = -6 * (1 + at[UPPER * COLUMNS :, 1] / 30).clamp(min=0)
    press = upper_down(at, torch.full((len(at),), 0.3, dtype=torch.float64))
    return BlendshapeRig(Mesh(at, sheet_faces()), torch.stack([lower, -0.98 * lower, press]), ["a", "b", "c"])


def test_the_finder_pairs_the_rims_of_a_closed_slit_and_nothing_else() -> None:
    rig = lids()
    finder = ContactFinder(rig.neutral.faces, len(rig.vertices))
    assert len(finder.find(rig.vertices, 1.5).pairs) == 0
    found = finder.find(rig.vertices + rig.deltas[0], 1.5)
    rows = found.pairs // COLUMNS
    front = len(SKIN) - 1
    assert len(found.pairs) > COLUMNS
    assert bool(((rows >= front) & (rows <= ROWS - 1 - front)).all())
    assert bool(((rows[:, 0] < UPPER) != (rows[:, 1] < UPPER)).all())
    assert bool((found.pairs[:, 0] % COLUMNS == found.pairs[:, 1] % COLUMNS).all())
    assert float(found.closeness.min()) > 0
    assert float(found.closeness.max()) <= 1


def test_lids_are_open_at_rest_and_lips_closed() -> None:
    for rig, closed in ((lids(), False), (lips(), True)):
        seams = find_seams(rig, rig.deltas.norm(dim=-1) > 0.01)
        assert (len(seams.closed) > 0) == closed
        assert (len(seams.closing[0].pairs) > 0) == (not closed)


def test_a_shape_that_only_makes_sense_on_top_of_another_is_recognised() -> None:
    assert transfer_with_report(lips(), lips().neutral).report.undoes == {"b": "a"}
    assert transfer_with_report(lids(), lids().neutral).report.undoes == {}


def test_with_contacts_a_rig_onto_its_own_neutral_still_returns_itself() -> None:
    for rig in (lids(), lips()):
        result = transfer_with_report(rig, rig.neutral)
        assert sum(result.report.contacts.values()) > 0
        torch.testing.assert_close(result.rig.deltas, rig.deltas, atol=1e-5, rtol=0)


def test_wider_lids_close_as_far_as_the_templates() -> None:
    rig = lids()
    target = rig.neutral.with_vertices(slit(13.0))
    template = rim_gap(rig.vertices + rig.deltas[0])

    def excess(weight: float) -> float:
        result = transfer_with_report(rig, target, contact_weight=weight).rig
        scale = float(transfer_with_report(rig, target).report.similarity.scale)
        return float((rim_gap(result.vertices + result.deltas[0]) - scale * template)[2:-2].max())

    assert excess(0.0) > 1.0
    assert excess(30.0) < 0.2 * excess(0.0)
    assert excess(300.0) < 0.1 * excess(0.0)


def test_named_contacts_are_used_instead_of_searched_ones() -> None:
    rig = lids()
    front = len(SKIN) - 1
    columns = torch.arange(10, 21)
    named = torch.stack([front * COLUMNS + columns, (ROWS - 1 - front) * COLUMNS + columns.flip(0)], dim=1)
    mesh = replace(rig.neutral, annotations=Annotations(contacts=named))
    finder = ContactFinder(mesh.faces, len(mesh.vertices), named)
    found = finder.find(mesh.vertices + rig.deltas[0], 1.5)
    assert bool(torch.isin(found.pairs[:, 0], named[:, 0]).all())
    assert bool(torch.isin(found.pairs[:, 1], named[:, 1]).all())
    # The partner is who lies opposite in the pose, not who was named in the same row.
    assert bool((found.pairs[:, 0] % COLUMNS == found.pairs[:, 1] % COLUMNS).all())
    target = mesh.with_vertices(slit(13.0))
    result = transfer_with_report(BlendshapeRig(mesh, rig.deltas, rig.names), target)
    assert result.report.contacts["shut"] == len(finder.find(mesh.vertices + rig.deltas[0], 3.0).pairs)


def test_lips_of_another_mouth_open_and_close_by_as_much() -> None:
    rig = lips()
    target = rig.neutral.with_vertices(slit(1.4, corner=1.0, bulge=3.0))
    result = transfer_with_report(rig, target)
    scale = float(result.report.similarity.scale)
    for weights in ([0.0, 0.0, 1.0], [0.3, 0.3, 0.0], [1.0, 1.0, 0.0]):
        source = (torch.tensor(weights, dtype=torch.float64) @ rig.deltas.flatten(1)).view(-1, 3)
        moved = (torch.tensor(weights, dtype=torch.float64) @ result.rig.deltas.flatten(1)).view(-1, 3)
        change = rim_gap(target.vertices + moved) - rim_gap(target.vertices)
        expected = scale * (rim_gap(rig.vertices + source) - rim_gap(rig.vertices))
        assert float((change - expected)[2:-2].max()) < 0.05


def test_lips_that_are_apart_at_rest_stay_apart() -> None:
    actor = performer(texture=False).select(["mouthFrownLeft", "mouthPucker", "jawOpen"])
    apart = actor.neutral.with_vertices(actor.vertices + 0.2 * actor.deltas[2])
    moved = transfer_with_report(actor, apart).rig
    assert lip_gap(apart) > 4
    for shape in moved.deltas[:2]:
        assert lip_gap(apart.with_vertices(apart.vertices + shape)) > 0.8 * lip_gap(apart)


def test_lips_a_little_further_apart_at_rest_press_like_the_templates() -> None:
    actor = performer(texture=False).select(["mouthFrownLeft", "jawOpen"])
    apart = actor.neutral.with_vertices(actor.vertices + 0.01 * actor.deltas[1])
    frown = transfer_with_report(actor, apart).rig.deltas[0]
    assert lip_gap(apart) > lip_gap(actor.neutral) + 0.2
    found, expected = apart.vertices + frown, actor.vertices + actor.deltas[0]
    assert abs(lip_gap(apart.with_vertices(found)) - lip_gap(apart.with_vertices(expected))) < 0.05


def lip_gap(mesh: Mesh) -> float:
    assert mesh.landmarks is not None
    upper, lower = mesh.landmarks[[62, 66]]
    return float(mesh.vertices[upper, 1] - mesh.vertices[lower, 1])


@pytest.mark.real
def test_the_lids_of_random_heads_close(ict_folder: Path) -> None:
    rig = load_ict_facekit(ict_folder, ["eyeBlink_L"], part="face")
    modes = load_identity_modes(ict_folder, part="face")
    finder = ContactFinder(rig.neutral.faces, len(rig.vertices))
    template = finder.find(rig.vertices + rig.deltas[0], 1.0, rig.deltas[0].norm(dim=-1) > 1.0)
    apart = (rig.vertices[template.pairs[:, 0]] - rig.vertices[template.pairs[:, 1]]).norm(dim=-1)
    upper, lower = template.pairs[apart > 4].T
    assert len(upper) > 15

    def gap(mesh: Tensor, delta: Tensor) -> Tensor:
        pose = mesh + delta
        return torch.cdist(pose[upper], pose[lower]).amin(1)

    for seed in (1, 2):
        head = modes.random_head(seed)
        gaps = {}
        for weight in (0.0, 30.0):
            result = transfer_with_report(rig, head, contact_weight=weight).rig
            gaps[weight] = gap(result.vertices, result.deltas[0]) - gap(rig.vertices, rig.deltas[0])
        assert float(gaps[30.0].max()) < 0.2
        assert float(gaps[0.0].abs().max()) > 2 * float(gaps[30.0].abs().max())
