"""Dynamics against scikit-learn's Gaussian processes and planted motion; the variance is what errors have."""

from pathlib import Path

import numpy as np
import pytest
import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from torch import Tensor

from torchface.capture import DynamicsPrior, DynamicsSettings
from torchface.capture.energy import Quadratic
from torchface.capture.priors import face_regions, windows_of
from torchface.capture.priors.dynamics_training import LeftOutProcess, fitted_kernel
from torchface.capture.priors.gaussian_process import GaussianProcesses, Kernel, Statistics, posterior, whitening_of
from torchface.capture.priors.motion_features import motion_basis
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.io import load_take
from torchface.synthetic.stages.weight_curves import perform

NAMES = ("browInnerUp", "eyeBlinkLeft", "eyeLookInLeft", "jawOpen", "mouthPucker")
QUICK = DynamicsSettings(inducing=40, subset=300, iterations=15)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def springs(frames: int = 900, seed: int = 0, kick: float = 0.01) -> Tensor:
    """Damped swings (T,5), each on its own, kicked at random: the next frame is linear in the last two."""
    kicks = kick * normal(frames, len(NAMES), seed=seed)
    place, before, rows = torch.full((5,), 0.4).double(), torch.full((5,), 0.4).double(), []
    for push in kicks:  # a recursion
        place, before = 0.4 + 1.6 * (place - 0.4) - 0.7 * (before - 0.4) + push, place
        rows.append(place)
    return torch.stack(rows)


def performance(frames: int, seed: int) -> tuple[Tensor, tuple[str, ...]]:
    track = perform(frames, torch.Generator().manual_seed(seed)).weights
    return track.values[..., 0], track.names


@pytest.fixture(scope="module")
def prior() -> DynamicsPrior:
    takes = [performance(400, seed)[0] for seed in range(2)]
    return DynamicsPrior.fit(takes, performance(2, 0)[1], 3, settings=QUICK)


@pytest.fixture(scope="module")
def swinging() -> DynamicsPrior:
    return DynamicsPrior.fit([springs(seed=seed) for seed in range(3)], NAMES, 3, settings=QUICK)


def test_a_process_with_all_points_is_scikit_learns() -> None:
    inputs, targets, new = normal(60, 3), normal(60, 2, seed=1), normal(20, 3, seed=2)
    lengths = torch.tensor([0.8, 1.3, 0.6]).double()
    kernel = Kernel(0.7, 1 / lengths, 0.1)
    whitening = whitening_of(kernel, inputs)
    features = kernel.between(inputs, inputs) @ whitening
    learned = posterior(kernel, inputs, whitening, Statistics(features.T @ features, features.T @ targets), 1.0)
    mean, variance = GaussianProcesses.stacked([learned], [kernel])(new)
    kernels = ConstantKernel(0.7, "fixed") * RBF(lengths.numpy(), "fixed") + WhiteKernel(0.1, "fixed")
    theirs = GaussianProcessRegressor(kernels, optimizer=None).fit(inputs.numpy(), targets.numpy())
    expected, deviation = theirs.predict(new.numpy(), return_std=True)
    np.testing.assert_allclose(mean.numpy(), expected, atol=1e-4)
    # Theirs is the variance of a target, ours of the function.
    np.testing.assert_allclose(variance[:, 0].numpy() + 0.1, deviation[:, 0] ** 2, atol=1e-4)


def test_inducing_points_come_near_the_whole_process() -> None:
    inputs, new = normal(400, 2), 0.5 * normal(50, 2, seed=2)
    targets = torch.sin(inputs.sum(1, keepdim=True)) + 0.1 * normal(400, 1, seed=3)
    kernel = Kernel(1.0, torch.ones(2).double(), 0.01)
    found = []
    for points in (inputs[:80], inputs):
        whitening = whitening_of(kernel, points)
        features = kernel.between(inputs, points) @ whitening
        statistics = Statistics(features.T @ features, features.T @ targets)
        learned = posterior(kernel, points, whitening, statistics, 1.0)
        found.append(GaussianProcesses.stacked([learned], [kernel])(new))
    np.testing.assert_allclose(found[0][0].numpy(), found[1][0].numpy(), atol=0.02)
    assert float((found[0][0] - torch.sin(new.sum(1, keepdim=True))).abs().mean()) < 0.05


def test_hyperparameters_come_back() -> None:
    inputs = normal(300, 2)
    planted = Kernel(1.0, torch.tensor([1 / 0.9, 1 / 0.9]).double(), 0.04)
    covariance = planted.between(inputs, inputs) + 1e-8 * torch.eye(300)
    targets = torch.linalg.cholesky(covariance) @ normal(300, 12, seed=1) + 0.2 * normal(300, 12, seed=2)
    found = fitted_kernel(inputs, targets, inputs[:100], torch.ones(1, 2).double(), 120)
    assert found.noise == pytest.approx(0.04, rel=0.15)
    assert found.signal == pytest.approx(1.0, rel=0.35)
    assert float(found.inverse_lengths[0]) == pytest.approx(1 / 0.9, rel=0.2)


def test_a_process_that_tells_nothing_is_not_trusted() -> None:
    inputs, noise = [normal(200, 3, seed=i) for i in range(3)], [normal(200, 2, seed=5 + i) for i in range(3)]
    kernel = Kernel(1.0, torch.full((3,), 2.0).double(), 0.1)

    def gain(targets: list[Tensor]) -> float:
        process = LeftOutProcess(kernel, inputs[0][:50], 2, 3)
        for fold, (part, target) in enumerate(zip(inputs, targets, strict=True)):
            process.learn(fold, part, target)
        process.settle(1.0)
        for fold, (part, target) in enumerate(zip(inputs, targets, strict=True)):
            process.compare(process.predict(fold, part)[0], target)
        return process.gain

    assert gain(noise) < 0.1
    assert gain([torch.sin(2 * part[:, :2]) for part in inputs]) > 0.8


def test_planted_motion_is_recovered(swinging: DynamicsPrior) -> None:
    windows, following = windows_of(springs(seed=9), 3)
    exact = 0.4 + 1.6 * (windows[:, -1] - 0.4) - 0.7 * (windows[:, -2] - 0.4)
    mean, variance = swinging(windows.float())
    kick = 0.01
    assert float((mean - exact).square().mean().sqrt()) < 0.45 * kick
    assert float((mean - following).square().mean().sqrt()) < 1.1 * kick
    assert float(variance.mean().sqrt()) == pytest.approx(kick, rel=0.15)
    last, line = windows[:, -1], 2 * windows[:, -1] - windows[:, -2]
    for other in (last, line):
        assert float((mean - following).square().mean()) < 0.8 * float((other - following).square().mean())


def test_planted_noise_is_covered(swinging: DynamicsPrior) -> None:
    windows, following = windows_of(springs(2000, seed=9), 3)
    mean, variance = swinging(windows.float())
    scaled = (following - mean) / variance.sqrt()
    for k, share in ((1, 0.683), (2, 0.954), (3, 0.997)):
        assert float((scaled.abs() < k).double().mean()) == pytest.approx(share, abs=0.04)


def test_variance_follows_the_motion(prior: DynamicsPrior) -> None:
    rest = prior.center.expand(1, 3, -1)
    moving = rest + 0.1 * torch.arange(3)[:, None]
    assert bool((prior(moving)[1] > prior(rest)[1]).all())
    assert bool((prior(rest)[1] > 0).all())


def test_noisy_windows_are_expected_where_asked_for() -> None:
    takes = [springs(500, seed=seed, kick=0.002) for seed in range(2)]
    windows, following = windows_of(springs(600, seed=9, kick=0.002), 5)
    seen = windows + 0.02 * normal(*windows.shape, seed=4)
    errors, promised = [], []
    for noise in (0.0, 0.02):
        prior = DynamicsPrior.fit(takes, NAMES, 5, input_noise=noise, settings=QUICK)
        mean, variance = prior(seen.float())
        errors.append(float((mean - following).square().mean().sqrt()))
        promised.append(float(((mean - following) / variance.sqrt()).square().mean().sqrt()))
    assert errors[1] < 0.8 * errors[0]
    assert promised[1] == pytest.approx(1.0, abs=0.15)
    assert promised[0] > 1.5


def test_the_energys_minimum_is_the_mean(prior: DynamicsPrior) -> None:
    windows, _ = windows_of(performance(40, 8)[0], prior.window)
    mean, variance = prior(windows)
    told = prior.energy(windows)
    energy = Quadratic(told.H.double(), told.f.double(), told.constant.double())
    best = torch.linalg.solve(energy.H, -energy.f[..., None])[..., 0]
    torch.testing.assert_close(best.float(), mean, rtol=1e-4, atol=1e-5)
    # Half a deviation away in each of N shapes: N/8 of -log p.
    rise = energy.value(best + 0.5 * variance.sqrt()) - energy.value(best)
    np.testing.assert_allclose(rise.numpy(), len(prior.names) / 8, rtol=1e-3)
    assert float(energy.value(best).abs().max()) < 0.05


def test_more_frames_than_the_window_do_not_matter(prior: DynamicsPrior) -> None:
    windows = torch.rand(4, 9, 52, generator=torch.Generator().manual_seed(0))
    for given, expected in zip(prior(windows), prior(windows[:, -3:]), strict=True):
        assert torch.equal(given, expected)


def test_a_face_at_rest_stays_where_no_take_was(swinging: DynamicsPrior) -> None:
    raised = torch.full((1, 3, 5), 0.95)
    mean, _ = swinging(raised)
    assert float((mean - 0.95).abs().max()) < 0.05


@pytest.mark.bench
@pytest.mark.real
def test_real_takes_are_predicted_better_than_by_a_line(performances: list[Path]) -> None:
    tracks = [load_take(path).weights for path in performances]
    takes = [track.values[..., 0] for track in tracks if track is not None]
    settings = DynamicsSettings(inducing=30, subset=300, iterations=8)
    prior = DynamicsPrior.fit(takes[:4], tracks[0].names, 3, settings=settings)
    windows, following = (torch.cat(parts) for parts in zip(*(windows_of(take, 3) for take in takes[4:]), strict=True))
    mean, variance = prior(windows)
    last, before = windows[:, -1], windows[:, -2]

    def error(predicted: Tensor) -> float:
        return float((predicted - following).square().mean().sqrt())

    assert error(mean) < 0.85 * error(2 * last - before)
    assert error(mean) < 0.95 * error((2 * last - before).clamp(0, 1))
    assert error(mean) < 0.7 * error(last)
    within = ((mean - following).abs() < 3 * variance.sqrt()).double().mean()
    assert float(within) > 0.985


def test_windows_and_their_basis() -> None:
    basis = motion_basis(5)
    torch.testing.assert_close(basis.T @ basis, torch.eye(3, dtype=torch.float64))
    line = torch.arange(5).double()
    assert float((line @ basis[:, 2]).abs()) < 1e-12
    assert float(line @ basis[:, 1]) > 0
    windows, following = windows_of(torch.arange(12.0).reshape(6, 2), 2)
    assert windows.shape == (4, 2, 2)
    assert torch.equal(following[0], torch.tensor([4.0, 5.0]))
    gap = torch.arange(12.0).reshape(6, 2)
    gap[0, 1] = torch.nan
    assert len(windows_of(gap, 2)[0]) == 3


def test_regions_hold_every_shape_once() -> None:
    names = performance(2, 0)[1]
    regions = face_regions(names)
    assert sorted(row for region in regions for row in region) == list(range(52))
    assert [len(region) for region in regions] == [8, 6, 5, 5, 28]


def test_bad_input(prior: DynamicsPrior, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ShapeError, match="no takes"):
        DynamicsPrior.fit([], NAMES)
    with pytest.raises(ShapeError, match=r"takes of \(9, 2\)"):
        DynamicsPrior.fit([torch.zeros(9, 2)], NAMES)
    with pytest.raises(ShapeError, match=r"takes of \(5,\), expected \(T,5\) each"):
        DynamicsPrior.fit(torch.zeros(30, 5), NAMES)
    with pytest.raises(ShapeError, match="at least 9 frames for a window of 8"):
        DynamicsPrior.fit([torch.zeros(8, 5), torch.zeros(30, 5)], NAMES, 8)
    with pytest.raises(ShapeError, match="one take of 9 frames, expected at least 12 for a window of 4"):
        DynamicsPrior.fit([torch.zeros(9, 5)], NAMES)
    with pytest.raises(ValueRangeError, match="NaN in every window"):
        DynamicsPrior.fit([torch.full((30, 5), torch.nan)], NAMES)
    with pytest.raises(ValueRangeError, match="window of 0"):
        DynamicsPrior.fit([torch.zeros(30, 5)], NAMES, 0)
    with pytest.raises(ValueRangeError, match="input noise of -1"):
        DynamicsPrior.fit([torch.zeros(30, 5)], NAMES, input_noise=-1)
    with pytest.raises(ValueRangeError, match="positive numbers"):
        DynamicsSettings(inducing=0)
    with pytest.raises(ShapeError, match=r"windows: found \(1, 2, 52\)"):
        prior(torch.zeros(1, 2, 52))
    with pytest.raises(NameMismatchError, match=r"52 that the rig lacks .*none of 1 that it has \(jawWide\)"):
        prior.require(["jawWide"])
    with pytest.raises(NameMismatchError, match="in place 0 where the rig has tongueOut"):
        prior.require(prior.names[::-1])
    for change in ({"window": 0}, {"inducing": 10**9}, {"fps": 0.0}, {"groups": 3}, {"window": 10**6}):
        with pytest.raises(FileFormatError, match="dynamics prior"):
            DynamicsPrior.from_config({**prior.config, **change})
