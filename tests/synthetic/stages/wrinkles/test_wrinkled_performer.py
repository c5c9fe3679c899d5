"""A performer whose skin wrinkles: neutral kept, depth with compression, lag in time, pores that move with the skin."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import Annotations, BlendshapeRig, load_rig
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.meshes.operators import triangle_normals, vertex_normals
from torchface.synthetic.stages.subdivision import catmull_clark
from torchface.synthetic.stages.wrinkles import FOLD_TIME, UNFOLD_TIME, WrinkledPerformer
from torchface.synthetic.stages.wrinkles.skin_texture_relief import pore_heights
from torchface.synthetic.stages.wrinkles.wrinkle_lines import wrinkle_lines

BROWS = ("browInnerUp", "browOuterUpLeft", "browOuterUpRight")


@pytest.fixture(scope="module")
def person() -> WrinkledPerformer:
    return WrinkledPerformer(vertices=12_000)


def brow_raise(person: WrinkledPerformer, amounts: Tensor) -> Tensor:
    weights = torch.zeros(len(amounts), len(person.names))
    weights[:, person.rig.index(BROWS)] = amounts[:, None]
    return weights


def at(person: WrinkledPerformer, place: str) -> Tensor:
    """Gauges of a place, (G,) bool."""
    return torch.tensor([line.place == place for line in person.lines])[person.gauge_lines]


def test_the_mesh_is_near_the_size_asked_for_and_keeps_texture_coordinates(person: WrinkledPerformer) -> None:
    assert len(person.neutral.vertices) == pytest.approx(12_000, rel=0.1)
    assert person.neutral.uvs is not None
    assert torch.equal(person.neutral.landmarks, person.rig.neutral.landmarks)


def test_neutral_weights_give_the_neutral(person: WrinkledPerformer) -> None:
    rest = torch.zeros(2, len(person.names))
    for frames in (person.frames(rest, 30.0), person.smooth(rest)):
        assert torch.equal(frames, person.neutral.vertices.expand(2, -1, -1))


def test_the_smooth_skin_is_the_subdivided_posed_rig(person: WrinkledPerformer) -> None:
    weights = torch.rand(1, len(person.names), generator=torch.Generator().manual_seed(1)) * 0.4
    values, polygons = person.rig(weights)[0].double(), person.rig.neutral.polygons
    while len(values) < len(person.neutral.vertices):
        values, polygons, _ = catmull_clark(values, polygons)
    ours = person.subdivided(weights)[0].double()
    assert torch.cdist(ours[::37], values).amin(1).max() < 1e-4


def test_forehead_folds_deepen_with_the_brow_raise(person: WrinkledPerformer) -> None:
    weights = brow_raise(person, torch.linspace(0, 1, 5))
    folding = torch.cat([person.folding(w[None], 30.0) for w in weights])[:, at(person, "forehead")].mean(1)
    assert (folding.diff() > 0.02).all()
    relief = torch.cat([person.frames(w[None], 30.0) - person.smooth(w[None]) for w in weights]).square().mean((1, 2))
    assert (relief.diff() > 0).all()


@pytest.mark.parametrize(("fps", "start", "end", "time"), [(60.0, 0.0, 1.0, FOLD_TIME), (120.0, 1.0, 0.0, UNFOLD_TIME)])
def test_a_step_is_followed_with_the_time_constant(
    person: WrinkledPerformer, fps: float, start: float, end: float, time: float
) -> None:
    amounts = torch.full((40,), end)
    amounts[0] = start
    folding = person.folding(brow_raise(person, amounts), fps)[:, at(person, "forehead")].mean(1)
    held = person.folding(brow_raise(person, torch.tensor([end])), fps)[:, at(person, "forehead")].mean()
    left = ((folding - held) / (folding[0] - held))[:12]
    expected = torch.exp(-torch.arange(12) / (fps * time))
    assert (left - expected).abs().max() < 0.02


def test_pores_move_with_the_skin(person: WrinkledPerformer) -> None:
    weights = brow_raise(person, torch.tensor([0.0, 0.8]))
    height = (person.smooth(weights) - person.subdivided(weights)).norm(dim=-1)
    assert height[0].quantile(0.99) > 0.02
    assert (height[0] - height[1]).abs().quantile(0.99) < 0.2 * height[0].quantile(0.99)


def test_the_same_seed_is_the_same_skin(person: WrinkledPerformer) -> None:
    again = WrinkledPerformer(vertices=12_000)
    weights = brow_raise(person, torch.ones(1))
    assert torch.equal(again.frames(weights, 30.0), person.frames(weights, 30.0))
    other = wrinkle_lines(person.neutral, seed=1)
    apart = torch.cdist(other[0].points, torch.cat([line.points for line in person.lines])).amin(1)
    assert apart.max() > 0.5
    assert (pore_heights(person.neutral, seed=1) - pore_heights(person.neutral, seed=0)).std() > 0.01


def test_wrong_input_is_named(person: WrinkledPerformer) -> None:
    with pytest.raises(ShapeError, match="51"):
        person.frames(torch.zeros(1, 3), 30.0)
    broken = torch.zeros(1, len(person.names))
    broken[0, person.rig.index(["jawOpen"])] = torch.nan
    with pytest.raises(ValueRangeError, match="jawOpen"):
        person.frames(broken, 30.0)
    with pytest.raises(ValueRangeError, match="frames a second"):
        person.frames(torch.zeros(1, len(person.names)), 0.0)
    with pytest.raises(ValueRangeError, match="coarse rig"):
        WrinkledPerformer(vertices=100)


def test_left_and_right_alone_wrinkle_their_own_side(person: WrinkledPerformer) -> None:
    weights = torch.zeros(2, len(person.names))
    for row, side in enumerate(("Left", "Right")):
        weights[row, person.rig.index([f"eyeSquint{side}", f"cheekSquint{side}"])] = 1.0
    held = torch.cat([person.folding(row[None], 30.0) for row in weights])
    left, right = at(person, "crows_feet_left"), at(person, "crows_feet_right")
    assert held[0, left].mean() > 0.3 > 0.15 > held[0, right].mean()
    assert held[1, right].mean() > 0.3 > 0.15 > held[1, left].mean()


@pytest.mark.real
def test_a_real_face_folds_where_it_smiles(ict_folder: Path) -> None:
    rig = load_rig(ict_folder, part="face")
    person = WrinkledPerformer(vertices=12_000, rig=rig)
    weights = torch.zeros(2, len(person.names))
    weights[1, rig.index(["mouthSmile_L", "mouthSmile_R"])] = 1.0
    rest, smiling = (person.folding(row[None], 30.0)[0] for row in weights)
    for place in ("nasolabial_left", "nasolabial_right", "smile_lines_left", "smile_lines_right"):
        assert smiling[at(person, place)].mean() > rest[at(person, place)].mean() + 0.2
    assert (smiling - rest)[at(person, "forehead")].abs().mean() < 0.05


def test_a_rig_without_the_68_landmarks_is_refused(person: WrinkledPerformer) -> None:
    few = replace(person.rig.neutral, annotations=Annotations(person.rig.neutral.landmarks[:5]))
    with pytest.raises(ValueRangeError, match="5 landmarks"):
        WrinkledPerformer(rig=BlendshapeRig(few, person.rig.deltas, person.names))
    with pytest.raises(ValueRangeError, match="one of them"):
        WrinkledPerformer(torch.zeros(3), rig=person.rig)


def test_folds_are_no_height_field_and_turn_no_triangle_over(person: WrinkledPerformer) -> None:
    weights = brow_raise(person, torch.ones(1))
    folded, smooth = person.frames(weights, 30.0)[0].double(), person.smooth(weights)[0].double()
    faces, moved = person.neutral.faces, folded - smooth
    normals = vertex_normals(smooth, faces)
    height = (moved * normals).sum(1)
    along = (moved - height[:, None] * normals).norm(dim=1)
    assert height.max() > 0.2
    assert height.min() < -0.3
    assert along.max() > 0.08
    assert ((triangle_normals(folded, faces) * triangle_normals(smooth, faces)).sum(1) > 0).all()
