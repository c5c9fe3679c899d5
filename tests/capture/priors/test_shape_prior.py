"""Densities against scikit-learn and scipy, their quadratics against finite differences."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_t
from sklearn.cluster import estimate_bandwidth
from torch import Tensor

from torchface import zoo
from torchface.capture import DynamicsPrior, DynamicsSettings, ShapePrior
from torchface.capture.priors import ParzenDensity, ReciprocalPrior, StudentDensity, automatic_bandwidth, face_halves
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError

NAMES = ("browInnerUp", "eyeBlinkLeft", "jawOpen", "mouthPucker", "mouthClose")


def clusters(frames: int = 600, seed: int = 0) -> Tensor:
    """Weights around three poses, each with a covariance of its own."""
    generator = torch.Generator().manual_seed(seed)
    centers = torch.tensor([[0.1, 0.1, 0.1, 0.1, 0.1], [0.8, 0.2, 0.6, 0.1, 0.5], [0.2, 0.9, 0.2, 0.7, 0.1]]).double()
    spread = torch.randn(3, 5, 5, generator=torch.Generator().manual_seed(9), dtype=torch.float64) * 0.04
    member = torch.randint(3, (frames,), generator=generator)
    noise = torch.randn(frames, 5, generator=generator, dtype=torch.float64)
    return centers[member] + torch.einsum("tde,te->td", spread[member], noise)


def test_takes_and_groups_may_be_numpys(tmp_path: Path) -> None:
    x = clusters(300)
    groups = [np.array([0, 1]), np.array([2, 3, 4])]
    learned = ShapePrior.fit([x.numpy()], NAMES, groups)
    zoo.save_model(learned, tmp_path / "prior", zoo.ModelCard("MIT", "none", {}, "none"))
    kept = zoo.get_model(tmp_path / "prior", ShapePrior)
    wanted = ShapePrior.fit([x], NAMES, [(0, 1), (2, 3, 4)])
    torch.testing.assert_close(kept.log_density(x), wanted.log_density(x))
    quick = DynamicsSettings(inducing=8, subset=60, iterations=1)
    fitted = [DynamicsPrior.fit([take], NAMES, 2, groups=groups, settings=quick) for take in (x, x.numpy())]
    assert torch.equal(fitted[0].processes.weights, fitted[1].processes.weights)
    assert fitted[1].groups == ((0, 1), (2, 3, 4))
    assert all(type(row) is int for group in fitted[1].groups for row in group)


def test_the_bandwidth_is_scikit_learns() -> None:
    x = clusters(300)
    assert automatic_bandwidth(x) == pytest.approx(estimate_bandwidth(x.numpy()), rel=0.02)


def test_heavy_tails_are_scipys() -> None:
    generator = torch.Generator().manual_seed(2)
    shape = torch.tensor([[0.04, 0.03, 0.0], [0.03, 0.05, 0.01], [0.0, 0.01, 0.02]], dtype=torch.float64)
    true = multivariate_t(shape=shape.numpy(), df=5.0, seed=1)
    x = torch.from_numpy(true.rvs(20_000))
    density = StudentDensity.fit(x, degrees_of_freedom=5.0, floor=1e-9)
    found = torch.linalg.inv(density.factor.double() @ density.factor.double().T)
    torch.testing.assert_close(found, shape, rtol=0.05, atol=1e-3)
    ours = density.double().log_density(x[:50])
    theirs = multivariate_t(shape=found.numpy(), df=5.0).logpdf(x[:50].numpy())
    np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-3)
    far = torch.randn(1, 3, generator=generator, dtype=torch.float64) * 10
    pulls = [(density.bound(y)[0] @ y[0]).norm() for y in (far, 2 * far)]
    assert pulls[1] < 0.7 * pulls[0]  # a Gaussian's would double


@pytest.fixture(params=["parzen", "student"])
def density(request: pytest.FixtureRequest) -> ParzenDensity | StudentDensity:
    x = clusters()
    return ParzenDensity.fit(x) if request.param == "parzen" else StudentDensity.fit(x, degrees_of_freedom=4.0)


def test_bounds_touch_and_lie_above(density: ParzenDensity | StudentDensity) -> None:
    density = density.double()
    at = clusters(5, seed=3).requires_grad_()
    (slope,) = torch.autograd.grad(-density.log_density(at).sum(), at)
    H, f = density.bound(at.detach())
    torch.testing.assert_close((H @ at.detach()[..., None])[..., 0] + f, slope, rtol=1e-6, atol=1e-6)
    other = clusters(5, seed=4)

    def value(x: Tensor) -> Tensor:
        return 0.5 * (x[:, None] @ H @ x[..., None])[:, 0, 0] + (f * x).sum(1)

    rise = value(other) - value(at.detach())
    assert bool((rise >= (density.log_density(at) - density.log_density(other)).detach() - 1e-9).all())


def test_energies_have_the_value_that_they_touch() -> None:
    takes, groups, here, there = [clusters(200)], face_halves(NAMES), clusters(5, seed=3), clusters(5, seed=4)
    prior = ShapePrior.fit(takes, NAMES, groups).double()
    torch.testing.assert_close(prior.energy(here).value(here), -prior.strength * prior.log_density(here))
    assert (prior.energy(here).value(there) > -prior.strength * prior.log_density(there)).all()
    paper = ReciprocalPrior.fit(takes, NAMES, groups).double()
    parts = torch.stack([density.log_density(part).exp() for density, part in paper.parts(here)])
    wanted = paper.strength * (1 / (parts + paper.guard)).sum(0)
    torch.testing.assert_close(paper.energy(here).value(here), wanted)


@pytest.mark.parametrize("kind", [ShapePrior, ReciprocalPrior, DynamicsPrior])
def test_names_stand_once(kind: Any) -> None:
    with pytest.raises(NameMismatchError, match="more than once: jawOpen"):
        kind.fit([clusters(60)], (*NAMES[:3], "jawOpen", "mouthClose"))


def test_halves_are_independent() -> None:
    takes = [clusters(200, seed=i) for i in range(3)]
    prior = ShapePrior.fit(takes, NAMES, face_halves(NAMES)).double()
    assert prior.groups == face_halves(NAMES) == ((0, 1), (2, 3, 4))
    here = takes[0][:4]
    there = here.clone()
    there[:, 2:] = takes[1][:4, 2:]
    energy, other = prior.energy(here), prior.energy(there)
    torch.testing.assert_close(energy.H[:, :2, :2], other.H[:, :2, :2])
    assert not energy.H[:, :2, 2:].any()


def test_a_solve_with_the_prior_never_gets_worse() -> None:
    prior = ShapePrior.fit([clusters(120)], NAMES, face_halves(NAMES)).double()
    w = torch.rand(20, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    before = prior.log_density(w)
    for _ in range(10):
        energy = prior.energy(w)
        w = torch.linalg.solve(energy.H, -energy.f)
        after = prior.log_density(w)
        assert bool((after >= before - 1e-9).all())
        before = after


def test_the_papers_form_is_flat_near_the_data_and_guarded_far_from_it() -> None:
    prior = ReciprocalPrior.fit([clusters()], NAMES).double()
    at = clusters(3, seed=5).requires_grad_()
    density = torch.stack([d.log_density(part) for d, part in prior.parts(at)]).exp()
    (slope,) = torch.autograd.grad((1 / (density + prior.guard)).sum(), at)
    energy = prior.energy(at.detach())
    torch.testing.assert_close((energy.H @ at.detach()[..., None])[..., 0] + energy.f, slope, rtol=1e-6, atol=1e-6)
    assert bool(torch.isfinite(prior.energy(torch.full((1, 5), 30.0, dtype=torch.float64)).H).all())


def test_bad_input() -> None:
    with pytest.raises(ShapeError, match="no takes"):
        ShapePrior.fit([], NAMES)
    with pytest.raises(ShapeError, match="takes of \\(3, 2\\)"):
        ShapePrior.fit([torch.zeros(3, 2)], NAMES)
    with pytest.raises(ValueRangeError, match="no two frames"):
        ShapePrior.fit([torch.full((5, 5), torch.nan)], NAMES)
    with pytest.raises(ValueRangeError, match="all samples the same"):
        ParzenDensity.fit(torch.ones(9, 2))
    with pytest.raises(FileFormatError, match="expected one of parzen, student"):
        ShapePrior.from_config({"names": ["a"], "groups": [[0]], "densities": [{"kind": "os.system"}], "strength": 1.0})
    with pytest.raises(FileFormatError, match="at most"):
        StudentDensity.from_config({"dimensions": 10**5})
    prior = ShapePrior.fit([clusters(100)], NAMES)
    with pytest.raises(NameMismatchError, match="learned for other shapes"):
        prior.require(["jawOpen"])
