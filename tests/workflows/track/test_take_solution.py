"""Weights of a take are calmed by the frames around each: parabolas stay, noise does not, blinks are left alone."""

import torch

from torchface.workflows.track.take_solution import calmed


def test_a_take_is_calmed_without_lag() -> None:
    at = torch.linspace(0, 1, 61, dtype=torch.float64)
    names = ["jawOpen", "eyeBlinkLeft", "jawLeft", "jawRight"]
    blink = torch.zeros(61, dtype=torch.float64)
    blink[30:32] = 1
    noise = 0.02 * torch.randn(61, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    side = 0.3 * (9 * at).sin() + noise
    weights = torch.stack([0.9 * at * (1 - at), blink, side.clamp(min=0), (-side).clamp(min=0)], 1)
    calm = calmed(weights, names, 30.0)
    torch.testing.assert_close(calm[:, :2], weights[:, :2])
    assert float(torch.minimum(calm[:, 2], calm[:, 3]).max()) == 0  # of two antagonists one moves
    found = calm[:, 2] - calm[:, 3]
    assert float(found.diff(n=2).std()) < 0.35 * float(side.diff(n=2).std())
    assert float((found - 0.3 * (9 * at).sin()).abs().max()) < float(noise.abs().max())
    torch.testing.assert_close(calmed(weights[:4], names, 30.0), weights[:4])  # too few to tell
