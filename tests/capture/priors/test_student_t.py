"""Student's distributions with a center: their energies are least there, in solvers and in exported graphs."""

from __future__ import annotations

import torch

from torchface.capture.priors import ShapePrior, StudentDensity

NAMES = ("jawOpen", "browInnerUp", "mouthPucker", "eyeBlinkLeft", "mouthFunnel")


def test_a_center_is_where_the_energy_is_least() -> None:
    generator = torch.Generator().manual_seed(4)
    factor = torch.linalg.cholesky(torch.cov(torch.randn(5, 50, generator=generator))).double()
    center = torch.tensor([0.3, 0.0, 0.1, 0.5, 0.2])
    prior = ShapePrior(NAMES, [(0, 2, 4), (1, 3)], [
        StudentDensity(factor[:3, :3], 1e6, center[[0, 2, 4]]), StudentDensity(factor[:2, :2], 10.0, center[[1, 3]])
    ])  # fmt: skip
    assert prior.centered
    weights = torch.rand(1, 5, dtype=torch.float64, generator=generator)
    energy, exported = prior.energy(weights), prior.prepared().energy(weights)
    torch.testing.assert_close(exported.H, energy.H)
    torch.testing.assert_close(exported.f, energy.f)
    least = -torch.linalg.solve(energy.H[0], energy.f[0])
    torch.testing.assert_close(least, center.double(), atol=1e-6, rtol=0)
    varied = weights.clone().requires_grad_()
    (slope,) = torch.autograd.grad(-prior.log_density(varied).sum(), varied)  # the bound touches
    torch.testing.assert_close(slope, (energy.H @ weights[..., None])[..., 0] + energy.f, atol=1e-6, rtol=1e-6)
    other = ShapePrior.from_config(prior.config)
    other.load_state_dict(prior.state_dict())
    torch.testing.assert_close(other.energy(weights).f, energy.f)
    split = prior.renamed([name for name in NAMES if name != "browInnerUp"] + ["browInnerUp_L", "browInnerUp_R"])
    found = split.energy(torch.zeros(1, 6, dtype=torch.float64))
    torch.testing.assert_close(
        -torch.linalg.solve(found.H[0], found.f[0]), torch.tensor([0.3, 0.1, 0.5, 0.2, 0.0, 0.0]).double(),
        atol=1e-4, rtol=0,
    )  # fmt: skip
