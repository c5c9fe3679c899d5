"""Priors for a rig of other names and a video of another rate: the same density, the same motion."""

import pytest
import torch
from scipy.stats import multivariate_t

from torchface.capture import DynamicsPrior, DynamicsSettings, ShapePrior
from torchface.capture.priors import (
    AdaptedDynamicsPrior,
    ParzenDensity,
    ReciprocalPrior,
    StudentDensity,
    adapt_dynamics,
    unlearned,
    windows_of,
)
from torchface.capture.priors.student_t import PARTING_VARIANCE
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.shape_names import mapping
from torchface.synthetic.stages.weight_curves import perform
from torchface.take import Take

NAMES = ("browInnerUp", "eyeBlinkLeft", "jawOpen", "cheekPuff", "tongueOut")
SPLIT = ("jawOpen", "browInnerUp_L", "browInnerUp_R", "eyeBlink_L", "cheekPuff")


def samples(count: int = 400, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    mixing = torch.rand(5, 5, generator=generator, dtype=torch.float64)
    return (0.2 * torch.randn(count, 5, generator=generator, dtype=torch.float64) @ mixing).abs()


def spread_of(factor: torch.Tensor, names: tuple[str, ...], whole: tuple[str, ...]) -> torch.Tensor:
    """The dispersion in other names; halves of one shape may part."""
    back = mapping(NAMES, names).double()
    spread = back @ torch.linalg.inv(factor.double() @ factor.double().T) @ back.T
    halves = torch.tensor([name not in whole for name in names])
    return spread + PARTING_VARIANCE * torch.diag(halves.double())


def test_a_student_density_in_other_names_is_scipys() -> None:
    prior = ShapePrior.fit([samples()], NAMES)
    (density,) = prior.densities
    assert isinstance(density, StudentDensity)
    renamed = prior.renamed(SPLIT)
    spread = spread_of(density.factor, SPLIT, ("jawOpen", "eyeBlink_L", "cheekPuff"))
    points = samples(6, seed=3) @ mapping(NAMES, SPLIT).double().T
    points[3:, 1] += 0.01
    wanted = multivariate_t(torch.zeros(5).numpy(), spread.numpy(), df=float(density.degrees_of_freedom)).logpdf(
        points.numpy()
    )
    torch.testing.assert_close(renamed.log_density(points), torch.from_numpy(wanted), rtol=1e-4, atol=1e-3)
    assert prior.renamed(NAMES) is prior
    assert renamed.config["strength"] == prior.strength


def test_a_parzen_window_keeps_its_distances_in_other_names() -> None:
    prior = ReciprocalPrior.fit([samples()], NAMES)
    same = ("tongueOut", "JawOpen", "eyeBlink_L", "browinnerup", "CheekPuff")
    renamed = prior.renamed(same)
    assert isinstance(renamed, ReciprocalPrior)
    assert all(isinstance(density, ParzenDensity) for density in renamed.densities)
    points = samples(7, seed=2)
    there = points @ mapping(NAMES, same).double().T
    torch.testing.assert_close(renamed.log_density(there), prior.log_density(points))


def test_shapes_that_a_prior_has_not_learned_stay_near_rest_and_strangers_are_refused() -> None:
    prior = ShapePrior.fit([samples()], NAMES)
    more = (*NAMES, "earWiggle")
    assert unlearned(NAMES, more) == ("earWiggle",)
    wide = prior.renamed(more)
    rest, away = torch.zeros(1, 6), torch.tensor([[0.0, 0, 0, 0, 0, 0.1]])
    assert float(wide.log_density(rest) - wide.log_density(away)) > 20
    with pytest.raises(NameMismatchError, match=r"has learned 1 of the rig's 3 shapes \(none of earWiggle, earFlap"):
        prior.renamed(("jawOpen", "earWiggle", "earFlap"))


@pytest.fixture(scope="module")
def learned() -> DynamicsPrior:
    takes, names = [], ()
    for seed in range(2):
        track = perform(500, torch.Generator().manual_seed(seed)).weights
        takes.append(track.values[..., 0])
        names = track.names
    settings = DynamicsSettings(inducing=40, subset=300, iterations=15)
    return DynamicsPrior.fit(takes, names, 3, settings=settings, input_noise=0.005)


def test_motion_in_other_names_is_the_same_motion(learned: DynamicsPrior) -> None:
    halves = [
        half for name in learned.names for half in ((f"{name}_L", f"{name}_R") if name == "browInnerUp" else [name])
    ]
    names = [f"{name.removesuffix('Left')}_L" if name.endswith("Left") else name for name in halves]
    adapted = adapt_dynamics(learned, names)
    back = mapping(learned.names, names)
    windows = torch.rand(4, 3, len(learned.names), generator=torch.Generator().manual_seed(0)).to(learned.center)
    mean, variance = learned(windows)
    there, spread = adapted(windows @ back.to(windows).T)
    torch.testing.assert_close(there, mean @ back.to(mean).T)
    torch.testing.assert_close(spread, variance @ back.to(mean).T)
    assert adapt_dynamics(learned, learned.names, 59.94) is learned
    assert adapt_dynamics(adapted, learned.names) is learned


def test_two_steps_are_one_frame_of_half_the_rate(learned: DynamicsPrior) -> None:
    adapted = adapt_dynamics(learned, learned.names, 30.0)
    assert isinstance(adapted, AdaptedDynamicsPrior)
    assert adapted.window == 2
    generator = torch.Generator().manual_seed(1)
    begin = torch.rand(5, 1, len(learned.names), generator=generator) * 0.4 + 0.2
    slope = 0.05 * torch.randn(begin.shape, generator=generator)
    fine = (begin + slope * torch.arange(3)[:, None] / 2).to(learned.center)  # straight, so frames between are known
    first, _ = learned(fine)
    second, _ = learned(torch.cat([fine[:, 1:], first[:, None]], 1))
    torch.testing.assert_close(adapted(fine[:, ::2])[0], second)


@pytest.mark.parametrize("fps", [24.0, 30.0, 120.0])
def test_another_rate_is_predicted_as_surely_as_it_says(learned: DynamicsPrior, fps: float) -> None:
    track = perform(800, torch.Generator().manual_seed(7)).weights
    adapted = adapt_dynamics(learned, track.names, fps)
    windows, following = windows_of(Take(60.0, weights=track).resampled(fps).weights.values[..., 0], adapted.window)
    windows = windows + 0.005 * torch.randn(windows.shape, generator=torch.Generator().manual_seed(2))
    mean, variance = adapted(windows.to(learned.center))
    error = mean - following
    assert error.square().mean() < 0.9 * (windows[:, -1] - following).square().mean()
    assert 0.6 < float((error.square() / variance).mean().sqrt()) < 1.4


def test_rates_too_far_away_and_windows_too_short_are_refused(learned: DynamicsPrior) -> None:
    with pytest.raises(ValueRangeError, match=r"found 2 frames a second, expected from 7\.5 to 480"):
        adapt_dynamics(learned, learned.names, 2.0)
    adapted = adapt_dynamics(learned, learned.names, 120.0)
    with pytest.raises(ShapeError, match=r"expected \(B,5,"):
        adapted(torch.zeros(1, 4, len(learned.names)))
