"""Fitting from disk gives what fitting in memory gives, and continues when it was stopped."""

from pathlib import Path

import pytest
import torch
from forked_runs import killed

from torchface.errors import ShapeError, ValueRangeError
from torchface.modeling import MorphableModel
from torchface.modeling.morphable import principal_components as module


class InMemory:
    """Samples that count how often they are read."""

    def __init__(self, values: torch.Tensor) -> None:
        self.values, self.shape, self.read_count = values, tuple(values.shape), 0

    def read(self, begin: int, end: int) -> torch.Tensor:
        self.read_count += 1
        return self.values[begin:end]


@pytest.fixture(scope="module")
def values() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    basis = torch.randn(30, 60, generator=generator) * torch.linspace(4, 1, 30)[:, None]
    noise = 0.05 * torch.randn(90, 60, generator=generator)
    return (100 + torch.randn(90, 30, generator=generator) @ basis + noise).reshape(90, 20, 3)


def test_the_same_as_in_memory(values: torch.Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = MorphableModel.fit(values, 10)
    monkeypatch.setattr(module, "_BLOCK_BYTES", 8 * 60 * 13)  # seven blocks of 13, the last of 12
    steps: list[tuple[int, int]] = []
    ours = MorphableModel.fit(InMemory(values), 10, progress=lambda _, done, of: steps.append((done, of)))
    assert (ours.components - whole.components).abs().max() < 1e-6
    assert (ours.standard_deviations / whole.standard_deviations - 1).abs().max() < 1e-6
    assert torch.allclose(ours.mean, whole.mean)
    assert float(ours.total_variance) == pytest.approx(float(whole.total_variance), rel=1e-6)
    assert ours.samples == 90
    assert [done for done, _ in steps] == list(range(1, steps[-1][1] + 1))


def test_samples_in_double_precision_are_left_as_they_are(
    values: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted, exact = MorphableModel.fit(values, 10), values.double()
    monkeypatch.setattr(module, "_BLOCK_BYTES", 8 * 60 * 13)
    for gram_samples in (module._GRAM_SAMPLES, 1):
        monkeypatch.setattr(module, "_GRAM_SAMPLES", gram_samples)
        found = MorphableModel.fit(exact, 10)
        assert torch.equal(exact, values.double())
        torch.testing.assert_close(found.standard_deviations, wanted.standard_deviations, rtol=1e-5, atol=0)


def test_passes_give_the_same_as_in_memory_and_go_on_where_they_were(
    values: torch.Tensor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = MorphableModel.fit(values, 10)
    monkeypatch.setattr(module, "_BLOCK_BYTES", 8 * 60 * 13)
    monkeypatch.setattr(module, "_GRAM_SAMPLES", 10)
    ours = MorphableModel.fit(InMemory(values), 10)
    assert (ours.standard_deviations / whole.standard_deviations - 1).abs().max() < 1e-5
    assert (ours.components * whole.components).sum((1, 2)).min() > 1 - 1e-3
    assert torch.allclose(ours.mean, whole.mean)
    assert float(ours.total_variance) == pytest.approx(float(whole.total_variance), rel=1e-6)

    def stop(step: str, done: int = 0, total: int = 0) -> None:
        if done == 17:  # in the third pass over seven blocks
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        MorphableModel.fit(InMemory(values), 10, tmp_path / "check", stop)
    again, from_start = InMemory(values), InMemory(values)
    continued = MorphableModel.fit(again, 10, tmp_path / "check")
    assert torch.equal(continued.components, MorphableModel.fit(from_start, 10).components)
    assert again.read_count == from_start.read_count - 2 * 7
    assert not (tmp_path / "check").exists()


def test_a_killed_fit_gives_the_same_and_never_takes_the_rows_of_others(
    values: torch.Tensor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_BLOCK_BYTES", 8 * 60 * 13)
    killed(
        lambda progress: MorphableModel.fit(InMemory(values), 10, tmp_path, progress),
        "fitting principal components",
        20,
    )
    left = sorted(tmp_path.glob("gram_*.safetensors"))
    assert len(left) == 4
    data = left[2].read_bytes()
    left[2].write_bytes(data[:-100] + bytes(100))  # finite numbers, of the right size
    again, whole = InMemory(values), InMemory(values)
    with pytest.warns(UserWarning, match=r"gram_00002\.safetensors: found a damaged checkpoint"):
        ours = MorphableModel.fit(again, 10, tmp_path)
    theirs = MorphableModel.fit(whole, 10)
    assert again.read_count < whole.read_count
    assert all(torch.equal(a, b) for a, b in zip(ours.state_dict().values(), theirs.state_dict().values(), strict=True))
    killed(
        lambda progress: MorphableModel.fit(InMemory(values), 10, tmp_path, progress),
        "fitting principal components",
        20,
    )
    turned = values.flip(0)  # the same mean, another order
    ours, theirs = MorphableModel.fit(InMemory(turned), 10, tmp_path), MorphableModel.fit(InMemory(turned), 10)
    assert torch.equal(ours.components, theirs.components)


def test_samples_that_teach_nothing_are_refused(values: torch.Tensor) -> None:
    with pytest.raises(ShapeError, match="found 1, expected at least two"):
        MorphableModel.fit(InMemory(values[:1]), 1)
    with pytest.raises(ValueRangeError, match="found 90, expected a whole number from 1 to 89"):
        MorphableModel.fit(InMemory(values), 90)
    with pytest.raises(ValueRangeError, match="all the same"):
        MorphableModel.fit(InMemory(values[:1].expand(40, -1, -1)), 5)
    with pytest.raises(ValueRangeError, match="found 5, expected at most 2"):
        MorphableModel.fit(InMemory(values[:3].repeat(20, 1, 1)), 5)
    broken = values.clone()
    broken[77, 3, 0] = float("inf")
    with pytest.raises(ValueRangeError, match="number 77 holds NaN or infinity"):
        MorphableModel.fit(InMemory(broken), 5)
