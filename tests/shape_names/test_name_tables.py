"""Tables to other names bring back what they can carry, and name what they cannot."""

import pytest
import torch

from torchface.shape_names import ARKIT, METAHUMAN, UNIFIED, VISEMES, VRM0, VRM1, ClipTable, TwinTable, mapping

GENERATOR = torch.Generator().manual_seed(5)


@pytest.mark.parametrize("table", [UNIFIED, METAHUMAN])
def test_all_52_come_back_from_names_that_divide_them(table: TwinTable) -> None:
    weights = torch.rand(7, 52, generator=GENERATOR)
    torch.testing.assert_close(table.to_arkit(table.from_arkit(weights)), weights)
    assert table.lost() == ()
    assert len(set(table.names)) == len(table.names)
    assert set(table.twins) == set(ARKIT)


def test_what_arkit_does_not_know_is_said() -> None:
    lost = set(UNIFIED.lost_here())
    assert {"TongueUp", "CheekSuckLeft", "JawBackward", "CheekPuffLeft", "LipFunnelUpperRight"} <= lost
    assert not {"JawOpen", "EyeClosedLeft", "MouthFrownRight", "TongueOut"} & lost
    # Every whole shape that several halves drive is divided by those that are lost.
    divided = {twin for twins in UNIFIED.twins.values() if len(twins) > 1 for twin in twins}
    assert lost == divided | set(UNIFIED.others)


@pytest.mark.parametrize("table", [VRM0, VRM1, VISEMES])
def test_a_face_that_is_some_clips_gives_those_alone(table: ClipTable) -> None:
    clips = torch.eye(len(table.names))
    torch.testing.assert_close(table.from_arkit(table.to_arkit(clips)), clips, atol=2e-3, rtol=0)
    assert table.lost_here() == ()
    weights = torch.rand(20, 52, generator=GENERATOR)
    found = table.from_arkit(weights)
    assert found.shape == (20, len(table.names))
    assert 0 <= float(found.min()) <= float(found.max()) <= 1
    best = (table.to_arkit(found) - weights).square().sum(1)
    for _ in range(20):  # no other clips are nearer
        others = (found + 0.1 * torch.randn(found.shape, generator=GENERATOR)).clamp(0, 1)
        assert bool((best <= (others @ table._matrix - weights).square().sum(1) + 1e-4).all())


def test_lids_that_shut_together_are_one_clip_and_a_wink_is_the_sides() -> None:
    weights = torch.zeros(2, 52)
    weights[0, [ARKIT.index("eyeBlinkLeft"), ARKIT.index("eyeBlinkRight")]] = torch.tensor([0.9, 0.4])
    weights[1, ARKIT.index("eyeBlinkRight")] = 1.0
    clips = dict(zip(VRM0.names, VRM0.from_arkit(weights).T, strict=True))
    assert clips["Blink"].tolist() == pytest.approx([0.4, 0], abs=1e-3)
    assert clips["Blink_L"].tolist() == pytest.approx([0.5, 0], abs=1e-3)
    assert clips["Blink_R"].tolist() == pytest.approx([0, 1.0], abs=1e-3)
    assert {"eyeBlinkLeft", "eyeBlinkRight"} == set(ARKIT) - set(VRM0.lost())
    assert VRM1.from_arkit(weights)[1, VRM1.names.index("blinkRight")] == pytest.approx(1.0, abs=1e-3)


def test_a_mouth_at_rest_is_silent_and_a_jaw_that_opens_is_aa() -> None:
    weights = torch.zeros(2, 52)
    weights[1, ARKIT.index("jawOpen")] = 0.7
    silent, open_mouth = VISEMES.from_arkit(weights)
    assert silent[VISEMES.names.index("sil")] == 1
    assert open_mouth.argmax() == VISEMES.names.index("aa")


def test_poses_of_epics_asset_are_live_links_names() -> None:
    poses = [name[0].upper() + name[1:] for name in ARKIT]
    assert torch.equal(mapping(ARKIT, poses), torch.eye(52))
    assert "CTRL_expressions_eyeLookRightL" in METAHUMAN.twins["eyeLookInLeft"]
