"""The weights of wrinkle maps by a rig's pose."""

import copy

import pytest
import torch
from torch import Tensor

from torchface import BlendshapeRig, Corrective, Correctives
from torchface.enhancement import EnhancementModel
from torchface.enhancement.detail.detail_basis import LearnedBasis
from torchface.enhancement.wrinkle_maps.wrinkle_basis import learn_wrinkle_basis
from torchface.enhancement.wrinkle_maps.wrinkle_weights import RigWrinkles, WrinkleWeights, nearest_rotation
from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix
from torchface.synthetic import performer

SHAPES = ("browInnerUp", "mouthSmileLeft", "mouthSmileRight", "mouthPucker", "mouthRollLower", "jawOpen")


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(texture=False).select(SHAPES)


@pytest.fixture(scope="module")
def shares(model: EnhancementModel) -> Tensor:
    return model.vertex_weights


@pytest.fixture(scope="module")
def poses() -> Tensor:
    return torch.rand(60, len(SHAPES), generator=seeded())


@pytest.fixture(scope="module")
def planted(poses: Tensor, model: EnhancementModel) -> Tensor:
    """Weights (60,R,2): what saturates with one shape, and a product of two, in every region."""
    pair = torch.stack([1 - (-3 * poses[:, 0]).exp(), poses[:, 1] * poses[:, 2]], dim=1)
    return (pair / pair.amax(0))[:, None].repeat(1, len(model.region_names), 1)


@pytest.fixture(scope="module")
def learned(rig: BlendshapeRig, poses: Tensor, planted: Tensor, shares: Tensor) -> WrinkleWeights:
    return WrinkleWeights.fit(rig.vertices, rig(poses), planted, shares, [f"region {i}" for i in range(len(shares))])


def test_poses_that_were_not_learned_get_the_planted_weights(
    rig: BlendshapeRig, learned: WrinkleWeights, poses: Tensor
) -> None:
    largest = 1 - (-3 * poses[:, 0].max()).exp()
    poses = 0.1 + 0.8 * torch.rand(30, len(SHAPES), generator=seeded(2))
    expected = 1 - (-3 * poses[:, 0]).exp()
    brow = int(
        learned.moments(rig.deltas[:1, learned.sites])[0, 3:].view(len(learned.region_names), -1).norm(dim=1).argmax()
    )
    found = learned.predict(rig(poses))[:, brow, 0]
    assert (found - expected / largest).abs().mean() < 0.05
    assert torch.corrcoef(torch.stack([found, expected]))[0, 1] > 0.99


def test_a_head_that_turns_keeps_its_weights_and_the_neutral_has_none(
    rig: BlendshapeRig, learned: WrinkleWeights, poses: Tensor
) -> None:
    vertices = rig(poses[:5])
    turned = vertices @ rotation_matrix(torch.tensor([0.4, -1.9, 0.7])).T + torch.tensor([300.0, -50.0, 900.0])
    torch.testing.assert_close(learned(turned), learned(vertices), atol=2e-3, rtol=0)
    assert float(learned(rig.vertices[None]).abs().max()) == 0


def test_large_coefficients_that_cancel_cost_no_digits(rig: BlendshapeRig, poses: Tensor, shares: Tensor) -> None:
    either = (torch.rand(60, len(shares), 2, generator=seeded(3)) > 0.5).float()  # no map of few components fits it
    names = [f"region {i}" for i in range(len(shares))]
    learned = WrinkleWeights.fit(rig.vertices, rig(poses), either, shares, names)
    learned.coefficients *= 50  # as of 300 poses of a face
    moments = learned.moments((rig(poses) - rig.vertices)[:, learned.sites])
    exact = copy.deepcopy(learned).double().of_moments(moments.double())
    torch.testing.assert_close(learned.of_moments(moments).double(), exact, atol=5e-6, rtol=0)


def test_blendshape_weights_give_what_the_vertices_give(
    rig: BlendshapeRig, learned: WrinkleWeights, poses: Tensor
) -> None:
    torch.testing.assert_close(RigWrinkles(learned, rig)(poses), learned(rig(poses)), atol=5e-4, rtol=0)
    both = Correctives(2 * torch.roll(rig.deltas[:1], 1, dims=2), (Corrective("smiles", (SHAPES[1], SHAPES[2])),))
    corrected = BlendshapeRig(rig.neutral, rig.deltas, rig.names, both)
    torch.testing.assert_close(RigWrinkles(learned, corrected)(poses), learned(corrected(poses)), atol=5e-4, rtol=0)
    assert not torch.allclose(learned(corrected(poses)), learned(rig(poses)), atol=1e-2)


def test_far_poses_stay_within_bounds(rig: BlendshapeRig, learned: WrinkleWeights) -> None:
    found = learned(rig(5 * torch.rand(10, len(SHAPES), generator=seeded(3))))
    assert float(found.min()) >= 0
    assert float(found.max()) <= 1


def test_the_nearest_rotation_is_the_polar_one() -> None:
    strain = torch.eye(3) + 0.2 * torch.randn(20, 3, 3, generator=seeded())
    u, _, vh = torch.linalg.svd(strain)
    torch.testing.assert_close(nearest_rotation(10 * strain), u @ vh, atol=1e-4, rtol=0)


def test_what_does_not_fit_is_refused(
    rig: BlendshapeRig, learned: WrinkleWeights, poses: Tensor, shares: Tensor
) -> None:
    vertices = rig(poses[:2])
    with pytest.raises(TopologyError, match=f"{len(rig.vertices)},3"):
        learned.predict(vertices[:, :-1])
    with pytest.raises(TopologyError, match=f"{len(rig.vertices)},3"):
        learned(torch.cat([vertices, vertices], 1))
    torch.testing.assert_close(learned.predict(vertices.double().numpy()), learned(vertices))
    vertices[1, 7] = torch.nan
    with pytest.raises(ValueRangeError, match="frame 1"):
        learned.predict(vertices)
    moved = BlendshapeRig(rig.neutral.with_vertices(1.1 * rig.vertices), rig.deltas, rig.names)
    with pytest.raises(TopologyError, match="mm from the one"):
        RigWrinkles(learned, moved)
    with pytest.raises(ValueRangeError, match="NaN"):
        WrinkleWeights.fit(rig.vertices, vertices, torch.zeros(2, len(shares), 1), shares, learned.region_names)
    with pytest.raises(ShapeError, match="regions"):
        WrinkleWeights.fit(rig.vertices, rig(poses), torch.zeros(60, 2, 1), shares, learned.region_names)
    flat = LearnedBasis(torch.zeros(1, 3 * len(rig.vertices)).half(), torch.zeros(4, 1), 0.0)
    areas = torch.ones(len(rig.vertices))
    with pytest.raises(ValueRangeError, match="without detail"):
        learn_wrinkle_basis(flat, shares, areas, 2)
    with pytest.raises(ValueRangeError, match="at most as many"):
        learn_wrinkle_basis(flat, shares, areas, 5)
    with pytest.raises(ShapeError, match="region weights"):
        learn_wrinkle_basis(flat, shares[:, 1:], areas, 2)
