"""An even grid has a place of its own near each frame, and is as coarse as that allows."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchface.errors import ValueRangeError
from torchface.temporal.frame_grid import FINEST, check_gaps, frame_grid


@given(st.lists(st.integers(1, 9), min_size=1, max_size=50))
def test_dropped_frames_leave_places_free(steps: list[int]) -> None:
    numbers = torch.tensor([0, *steps]).cumsum(0)
    rate, rows = frame_grid(7 + numbers / 59.94, 59.94)
    assert rate == 59.94
    assert rows.equal(numbers)


@given(st.lists(st.floats(0.01, 3), min_size=1, max_size=50))
def test_frames_at_any_times_keep_their_order_and_come_near_their_places(steps: list[float]) -> None:
    seconds = torch.tensor([0.0, *steps], dtype=torch.float64).cumsum(0) / 30
    rate, rows = frame_grid(seconds, 30.0)
    assert round(rate / 30) in range(1, FINEST + 1)
    assert bool((rows.diff() > 0).all())
    if bool((seconds.diff() * 30 * FINEST > 1).all()):
        assert float((rows / rate - seconds).abs().max()) <= 0.5 / (30 * FINEST) + 0.05 / 30


def test_a_take_that_is_nearly_all_gap_is_refused_before_the_memory_is_taken() -> None:
    with pytest.raises(ValueRangeError, match=r"found a gap of 1e\+09 s among 2 frames, .* cut the take there"):
        frame_grid(torch.tensor([0.0, 1e9]), 60.0)
    check_gaps(torch.tensor([0.0, 60.0]), 60.0)
