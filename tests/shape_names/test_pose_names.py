"""Action units and morphs of MikuMikuDance move the shapes that they mean."""

import pytest
import torch

from torchface.shape_names import ARKIT, VRM1, is_action_unit
from torchface.shape_names.pose_names import posed_weights
from torchface.shape_names.recognised_names import recognised_mapping


@pytest.mark.parametrize(
    ("names", "pose"),
    [
        (["AU12"], {"mouthSmileLeft": 1.0, "mouthSmileRight": 1.0}),
        (["AU12_r"], {"mouthSmileLeft": 1.0, "mouthSmileRight": 1.0}),
        (["AU12R"], {"mouthSmileRight": 1.0}),
        (["AU_02_L"], {"browOuterUpLeft": 1.0}),
        (["AU1L", "AU1R"], {"browInnerUp": 1.0}),
        (["AU26"], {"jawOpen": 1.0}),
        (["AU23", "AU25_r", "AU33", "AU12_c"], {}),
        (["まばたき"], {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0}),
        (["ウィンク右"], {"eyeBlinkRight": 1.0}),
        (["あ"], dict(VRM1.poses["aa"])),
        (["AUDIO", "jawOpen"], {}),
    ],
)
def test_a_name_moves_the_shapes_that_it_means(names: list[str], pose: dict[str, float]) -> None:
    moved = posed_weights(names).sum(1)
    assert {ARKIT[row]: pytest.approx(float(moved[row])) for row in moved.nonzero()[:, 0].tolist()} == pose


def test_presences_are_no_intensities() -> None:
    assert is_action_unit("AU12_r")
    assert not is_action_unit("AU12_c")


def test_action_units_drive_other_programs_names_and_what_has_a_name_of_its_own_stays() -> None:
    to = ["browInnerUp_L", "Mouth_Smile_R", "mouthSmile_R", "CTRL_expressions_jawOpen", "AU26"]
    matrix = recognised_mapping(["AU01", "AU12", "AU26"], to)
    expected = torch.tensor([[1.0, 0, 0], [0, 0, 0], [0, 1.0, 0], [0, 0, 0], [0, 0, 1.0]])
    assert torch.equal(matrix, expected)
