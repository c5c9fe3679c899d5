"""Scores of expressions find what was planted: slope, lag, jitter, missed blinks, antagonists, shapes that stay on."""

import math

import pytest
import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.evaluation.expression_scores import MethodScore, expression_score, held
from torchface.shape_names import ARKIT

FPS = 30.0
JAW, SMILE, FROWN = (ARKIT.index(name) for name in ("jawOpen", "mouthSmileLeft", "mouthFrownLeft"))
LIDS = [ARKIT.index("eyeBlinkLeft"), ARKIT.index("eyeBlinkRight")]


@pytest.fixture
def true() -> Tensor:
    """Ten seconds: the jaw swings, the left smile too, three blinks, and the brows rest."""
    seconds = torch.arange(300) / FPS
    weights = torch.zeros(300, len(ARKIT))
    weights[:, JAW] = 0.5 * (2.1 * seconds).sin().square()
    weights[:, SMILE] = 0.4 * (1.3 * seconds).cos().square()
    for start in (40, 130, 220):
        shut = torch.tensor([0.3, 0.8, 1.0, 1.0, 0.7, 0.3])
        weights[start : start + len(shut), LIDS] = shut[:, None]
    return weights


def test_the_truth_is_without_fault(true: Tensor) -> None:
    score = expression_score(true, ARKIT, true, FPS)
    assert score.moved.sum() == 4
    torch.testing.assert_close(score.correlation[score.moved], torch.ones(4))
    torch.testing.assert_close(score.slope[score.moved], torch.ones(4))
    assert score.correlation[~score.moved].isnan().all()
    assert score.region_error() == 0
    assert (score.blinks.true, score.blinks.found, score.blinks.false) == (3, 3, 0)
    assert score.lag == pytest.approx(0, abs=0.1)
    assert score.both == 0
    assert score.jitter < 2e-4  # slow motion counts as rest
    assert not score.restless.any()


def test_slope_and_offset(true: Tensor) -> None:
    score = expression_score(0.6 * true + 0.1, ARKIT, true, FPS)
    torch.testing.assert_close(score.slope[score.moved], torch.full((4,), 0.6))
    torch.testing.assert_close(score.correlation[score.moved], torch.ones(4))
    assert score.restless.sum() == len(ARKIT)  # an offset of 0.1 never lets go
    wanted = (0.6 * true[:, JAW] + 0.1 - true[:, JAW]).square().mean().sqrt()
    torch.testing.assert_close(score.error[JAW], wanted)


@pytest.mark.parametrize("frames", [-2, 1, 4])
def test_lag(true: Tensor, frames: int) -> None:
    late = true.roll(frames, 0)
    assert expression_score(late, ARKIT, true, FPS).lag == pytest.approx(1000 * frames / FPS, abs=8)


def test_lag_between_frames(true: Tensor) -> None:
    fine = torch.nn.functional.interpolate(true.T[None], scale_factor=4.0, mode="linear")[0].T
    smooth = torch.nn.functional.avg_pool1d(fine.T[None], 41, 1, 20, count_include_pad=False)[0].T
    late, smooth = smooth.roll(2, 0)[4::4], smooth[4::4]
    assert expression_score(late, ARKIT, smooth, FPS).lag == pytest.approx(500 / FPS, abs=250 / FPS)


def test_jitter_is_that_of_white_noise_where_the_truth_rests(true: Tensor) -> None:
    noise = 0.01 * torch.randn(true.shape, generator=torch.Generator().manual_seed(0))
    assert expression_score(true + noise, ARKIT, true, FPS).jitter == pytest.approx(0.01, rel=0.05)


def test_blinks_are_counted(true: Tensor) -> None:
    found = true.clone()
    found[125:140, LIDS] *= 0.4  # one is missed
    found[180:184, LIDS] = 0.9  # one is false
    count = expression_score(found, ARKIT, true, FPS).blinks
    assert (count.true, count.found, count.reported, count.false) == (3, 2, 3, 1)


def test_antagonists_that_the_truth_has_are_no_fault(true: Tensor) -> None:
    found = true.clone()
    found[:30, FROWN] = 0.3
    smiles = (true[:30, SMILE] > 0.1).float().sum() / 300
    assert expression_score(found, ARKIT, true, FPS).both == pytest.approx(float(smiles))
    assert expression_score(found, ARKIT, found, FPS).both == 0


def test_what_is_not_given_counts_as_nothing(true: Tensor) -> None:
    kept = [row for row in range(len(ARKIT)) if row != JAW]
    fewer = expression_score(true[:, kept], [ARKIT[row] for row in kept], true, FPS)
    empty = true.clone()
    empty[:, JAW] = torch.nan
    for score in (fewer, expression_score(empty, ARKIT, true, FPS)):
        assert (~score.supported).nonzero().flatten().tolist() == [JAW]
        assert score.correlation[JAW] == 0
        torch.testing.assert_close(score.error[JAW], true[:, JAW].square().mean().sqrt())


def test_a_lost_face_stays_as_it_was() -> None:
    nan = math.nan
    weights = torch.tensor([[nan, 0.1], [0.2, nan], [nan, nan], [0.5, 0.3]])
    torch.testing.assert_close(held(weights), torch.tensor([[0.0, 0.1], [0.2, 0.1], [0.2, 0.1], [0.5, 0.3]]))


def test_means_over_films_are_of_those_in_which_a_shape_moves(true: Tensor) -> None:
    still = true.clone()
    still[:, JAW] = 0
    films = {"a": expression_score(0.5 * true, ARKIT, true, FPS), "b": expression_score(0.7 * still, ARKIT, still, FPS)}
    method = MethodScore(films)
    slope = method.shape_mean("slope")
    assert slope[JAW] == pytest.approx(0.5)
    assert slope[SMILE] == pytest.approx(0.6)
    assert method.blinks.true == 6
    assert method.unsupported == ()
    assert math.isnan(method.error("brows"))


def test_frames_must_be_as_many(true: Tensor) -> None:
    with pytest.raises(ShapeError, match="expected"):
        expression_score(true[:-1], ARKIT, true, FPS)
