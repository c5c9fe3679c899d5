"""Weights of a take are calmed by the frames around each: parabolas stay, noise does not, blinks are left alone."""

from types import SimpleNamespace

import pytest
import torch

from torchface.shape_names import ARKIT
from torchface.workflows.track import take_solution
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


def test_lids_that_follow_take_back_a_blink(monkeypatch: pytest.MonkeyPatch) -> None:
    """An eye looks up from under lids a bit lower than at rest: these rise, and of two antagonists one moves."""
    weights = torch.zeros(3, 52)
    weights[:, ARKIT.index("eyeLookUpLeft")] = 0.8
    weights[:, ARKIT.index("eyeBlinkLeft")] = torch.tensor([0.0, 0.08, 0.9])
    solved = SimpleNamespace(weights=weights, rotation=None, translation=None)
    monkeypatch.setattr(take_solution, "solve_take", lambda *_: solved)
    solver = SimpleNamespace(names=ARKIT, solution=lambda _landmarks, _trust, found, *_: found)
    inputs = SimpleNamespace(
        clip=SimpleNamespace(fps=30.0), models=SimpleNamespace(expects=True), settings=SimpleNamespace(whole_take=False)
    )
    found = take_solution.new_solution(inputs, solver, None, None, None, None)
    blink, wide = (found[:, ARKIT.index(name)] for name in ("eyeBlinkLeft", "eyeWideLeft"))
    assert float(torch.minimum(blink, wide).max()) == 0
    assert float(wide[0]) > float(wide[1]) > 0
    assert float(blink[2]) == pytest.approx(0.9)
