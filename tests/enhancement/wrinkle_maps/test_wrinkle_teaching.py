"""What wrinkle maps are learned from: the actor's poses as a rig's weights, mixtures of them, the model's detail."""

import pytest
import torch
from torch import Tensor

from tests.enhancement.conftest import Database
from torchface.enhancement import EnhancementModel
from torchface.enhancement.detail.detail_encodings import DisplacementDetail
from torchface.enhancement.wrinkle_maps.wrinkle_teaching import captured_poses, taught_details, teaching_poses
from torchface.rig import BlendshapeRig
from torchface.synthetic.head.performer import performer

SHAPES = ("browInnerUp", "mouthSmileLeft", "mouthSmileRight", "mouthPucker", "noseSneerLeft", "eyeBlinkRight")


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(texture=False).select(SHAPES)


@pytest.fixture(scope="module")
def captured(rig: BlendshapeRig, model: EnhancementModel) -> Tensor:
    return captured_poses(model, model.features(rig(torch.eye(len(SHAPES)))))


def test_the_weights_that_the_actor_was_posed_with_are_found(captured: Tensor) -> None:
    course = torch.linspace(0, torch.pi, 9).sin()
    extremes = torch.tensor(
        [[1, 0.5, 0, 0, 0, 0], [0, 1, 0.8, 0, 0.4, 0], [0.3, 0, 0, 1, 0, 0], [0, 0, 0.6, 0, 1.0, 0.9]]
    )
    posed = (course[None, :, None] * extremes[:, None]).flatten(0, 1)
    assert (captured - posed).square().mean().sqrt() < 0.05


def test_mixtures_take_each_region_from_one_frame() -> None:
    captured = torch.tensor([[0.5, 0.3, 0.2], [0.1, 0.6, 0.4]])
    poses = teaching_poses(captured, torch.tensor([[1.0, 0, 0], [0, 1, 1]]), 60)
    assert torch.equal(poses[:3], torch.eye(3))
    assert torch.equal(poses[3:5], captured)
    assert poses.shape == (60, 3)
    mixtures = poses[5:]
    torch.testing.assert_close(mixtures[:, 2], mixtures[:, 1] * 2 / 3)
    found = {round(ratio, 3) for ratio in (mixtures[:, 0] / mixtures[:, 1]).tolist()}
    assert found == {round(first / second, 3) for first in (0.5, 0.1) for second in (0.3, 0.6)}
    assert float(mixtures.max()) <= 1
    assert len(teaching_poses(captured, torch.ones(1, 3), 2)) == 2


def test_the_detail_is_what_the_model_adds(rig: BlendshapeRig, model: EnhancementModel, database: Database) -> None:
    frames = database.smooth[2:20:3]
    found = taught_details(model, lambda begin, end: frames[begin:end], len(frames))
    detail = DisplacementDetail(model.neutral, model.faces)
    rows = found.coefficients @ found.components.float()
    torch.testing.assert_close(detail.compose(frames, rows), model(frames), atol=2e-3, rtol=0)
