"""A planted person's rest and reach are learned, and lids are scaled without being shifted."""

import pytest
import torch

from torchface.capture.curve_calibration import HELD, CurveCalibration
from torchface.errors import ShapeError
from torchface.shape_names import ARKIT

GENERATOR = torch.Generator().manual_seed(3)
ROW = {name: i for i, name in enumerate(ARKIT)}


def person(pose: int) -> torch.Tensor:
    """Rests with brows up by 0.2 and lids shut by 0.15, and reaches half of each pose; trembles by 0.01."""
    weights = torch.zeros(52)
    weights[ROW["browInnerUp"]] = 0.2
    weights[[ROW["eyeBlinkLeft"], ROW["eyeBlinkRight"]]] = 0.15
    for name, row in ROW.items():
        if pose in HELD and name.startswith(HELD[pose]):
            weights[row] = 0.6
    return (weights + 0.01 * torch.randn(52, generator=GENERATOR)).clamp(0, 1)


def guided() -> CurveCalibration:
    calibration = CurveCalibration()
    for pose in range(1, 6):
        for _ in range(80):
            calibration.add(person(pose), pose, 1 / 60)
    return calibration


def test_guided_poses_reach_one_and_rest_is_none() -> None:
    calibration = guided()
    assert calibration.learned == 1
    assert calibration.missed == ()
    for pose, starts in HELD.items():
        corrected = calibration.correction(person(pose))
        reached = [corrected[row].item() for name, row in ROW.items() if name.startswith(starts)]
        assert min(reached) > 0.95
    rest = calibration.correction(person(0))
    assert rest[ROW["browInnerUp"]] < 0.05
    # Lids are scaled, not shifted: what is open by 0.85 of the way stays so in proportion.
    assert rest[ROW["eyeBlinkLeft"]].item() == pytest.approx(0.15 / 0.6, abs=0.04)


def test_who_does_nothing_keeps_their_gains_and_is_named() -> None:
    calibration = CurveCalibration()
    for pose in range(1, 6):
        for _ in range(80):
            calibration.add(person(0), pose, 1 / 60)
    assert calibration.missed == (2, 3, 4, 5)
    assert torch.equal(calibration.correction.gain, torch.ones(52))


def test_rest_is_learned_in_ten_seconds_without_being_asked_for() -> None:
    calibration, correction = CurveCalibration(), []
    for frame in range(900):
        weights = person(0)
        if frame % 3 == 0:  # talks a third of the time
            weights[ROW["jawOpen"]] = 0.8
        calibration.add(weights, 0, 1 / 60)
        correction.append(calibration.correction)
    assert calibration.learned == 1
    assert calibration.correction.rest[ROW["browInnerUp"]].item() == pytest.approx(0.2, abs=0.02)
    assert calibration.correction.rest[ROW["jawOpen"]] < 0.05
    assert correction[30].rest[ROW["browInnerUp"]] < 0.02  # the first moment is not taken for rest
    assert correction[650] is calibration.correction  # nothing is learned after ten seconds
    assert len(calibration._samples[0]) <= 600
    with pytest.raises(ShapeError, match=r"weights: found \(51,\), expected \(52,\)"):
        calibration.add(torch.zeros(51), 0, 0.1)
