"""Times of frames: even where they are, as the file has them where not, repaired or refused where they are none."""

import warnings

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from torchface.errors import FileFormatError
from torchface.io.tables.frame_rates import FrameTimes, TimeSource, file_error, frame_times, key_times, typical_rate


def read(times: np.ndarray, numbers: np.ndarray | None = None, rate: float | None = None) -> FrameTimes:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return frame_times(times, TimeSource(file_error("take.csv"), numbers, rate))


@pytest.mark.parametrize("fps", [24.0, 25.0, 30000 / 1001, 30.0, 50.0, 60000 / 1001, 60.0, 120.0, 240.0])
@pytest.mark.parametrize("digits", [2, 3, 4, 12])
def test_an_even_rate_stays_even_however_times_are_rounded(fps: float, digits: int) -> None:
    if digits == 2 and fps > 60:
        return
    found = read(np.round(np.arange(500) / fps, digits), np.arange(500))
    assert found.seconds is None
    assert found.fps == pytest.approx(fps, rel=1e-3 if digits == 2 else 1e-4)


@given(st.lists(st.integers(1, 5), min_size=4, max_size=60), st.sampled_from([24.0, 60000 / 1001, 120.0]))
@example([1] * 16 + [3] + [5] * 11, 60000 / 1001)  # which 58,741 / 980 meets as exactly
def test_dropped_frames_are_on_the_grid_exactly(steps: list[int], fps: float) -> None:
    numbers = np.cumsum([0, *[1] * 60, *steps])
    for given_numbers in (numbers, None):
        found = read(np.round(numbers / fps, 6), given_numbers)
        assert found.fps == fps
        expected = torch.from_numpy(numbers / fps)
        assert (found.seconds is None) == (max(steps) == 1)
        if found.seconds is not None:
            torch.testing.assert_close(found.seconds, expected, atol=1e-9, rtol=0)


@given(st.lists(st.sampled_from([0.0, 1e-9, 1e-3, 1 / 60, 1.0, 1e6]), min_size=1, max_size=40).filter(any))
def test_any_steps_have_a_rate(steps: list[float]) -> None:
    assert 0.5 / max(steps) <= typical_rate(np.array(steps)) < float("inf")


@given(st.integers(0, 2**32 - 1))
def test_times_of_a_variable_rate_are_kept(seed: int) -> None:
    times = np.cumsum(np.random.default_rng(seed).uniform(0.2, 3, 50)) / 30
    found = read(times, np.arange(50))
    np.testing.assert_array_equal(found.seconds.numpy(), times)


@pytest.mark.parametrize(("scale", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")])
@pytest.mark.parametrize("fps", [24.0, 60.0, 240.0])
def test_finer_units_are_recognised_and_said(scale: float, unit: str, fps: float) -> None:
    with pytest.warns(UserWarning, match=rf"take.csv: found frames .* apart, expected seconds; .* taken for {unit}"):
        found = frame_times(np.arange(100) / fps * scale, TimeSource(file_error("take.csv"), np.arange(100)))
    assert found.fps == pytest.approx(fps, rel=1e-5)
    assert found.seconds is None


def of_frames(count: int, fps: float, jitter: float = 0.0, together: int = 1) -> np.ndarray:
    """Times at which frames come that are delayed by up to some seconds, or delivered several at once."""
    delays = np.random.default_rng(1).uniform(-jitter, jitter, count // together).repeat(together)
    last = np.arange(count) // together * together + together - 1
    return np.sort(last / fps + delays + 5e-4 * (np.arange(count) % together))


@pytest.mark.parametrize("pause", [0.0, 5.0, 60.0])
@pytest.mark.parametrize(
    ("fps", "jitter", "together"),
    [
        *[(fps, 0.001, 1) for fps in (24000 / 1001, 24.0, 25.0, 30000 / 1001, 30.0, 50.0, 60000 / 1001, 60.0, 120.0)],
        *[(60.0, 0.008, 1), (60.0, 0.03, 1), (30.0, 0.03, 1), (1.0, 0.03, 1)],
        *[(60.0, 0.0, 2), (60.0, 0.0, 3), (60.0, 0.0, 4), (30.0, 0.0, 2), (60.0, 0.03, 4)],
    ],
)
def test_a_rate_is_that_of_frames_while_they_come(fps: float, jitter: float, together: int, pause: float) -> None:
    times = of_frames(1200, fps, jitter, together)
    times[600:] += pause if fps > 1 else 10 * pause
    found = read(times, np.arange(1200))
    assert found.fps == pytest.approx(fps, rel=1e-9 if jitter == 0.001 else 0.01)
    np.testing.assert_array_equal(found.seconds.numpy(), times)


@pytest.mark.parametrize("fps", [24.0, 30000 / 1001, 60.0])
@pytest.mark.parametrize("delay", [0.002, 0.004, 0.008])
def test_delays_do_not_change_a_rate(fps: float, delay: float) -> None:
    generator = np.random.default_rng(2)
    for _ in range(5):
        times = np.maximum.accumulate(np.arange(1200) / fps + generator.exponential(delay, 1200))
        assert typical_rate(np.diff(times)) == pytest.approx(fps, rel=3e-4)


@pytest.mark.parametrize("jitter", [0.001, 0.008, 0.015])
def test_what_a_network_held_back_is_no_pause(jitter: float) -> None:
    times = of_frames(1200, 60.0, jitter)
    within = times % 3
    held = np.where((within > 1) & (within < 1.5), times - within + 1.5, times)
    assert typical_rate(np.diff(held)) == pytest.approx(60.0, rel=0.01)


@pytest.mark.parametrize(
    ("steps", "fps"),
    [
        ([1 / 60], 60.0),
        ([1.0], 1.0),
        ([1 / 60, 5.0], 60.0),
        ([0.033, 0.034, 0.133, 0.034, 0.032], 4 / 0.133),
        ([0.033, 0.05] * 50, 1 / 0.0415),  # no step of 40 ms among them
        (([1 / 60] * 4 + [2 / 60]) * 60, 60.0),  # one in six was lost
        ([5e-4, 2 / 60 - 5e-4, 2 / 60, 2 / 60, 2 / 60] * 60, 5 / (8 / 60)),  # pairs of which many lost one
        ([5e-4] * 7 + [8 / 30 - 35e-4], 30.0),  # few frames, eight at once
        ([1 / 30] * 200 + [1 / 15] * 50, 30.0),  # in the dark a camera takes half as many
    ],
)
def test_the_typical_rate_of_few_or_uneven_steps(steps: list[float], fps: float) -> None:
    assert typical_rate(np.array(steps)) == pytest.approx(fps)


@pytest.mark.parametrize("together", [4, 6, 8])
def test_few_frames_that_come_at_once_have_no_rate_of_thousands(together: int) -> None:
    for count in range(2 * together, 5 * together, together):
        times = of_frames(count, 30.0, together=together)
        assert typical_rate(np.diff(times)) < 60
        assert typical_rate(np.diff(times[: 1 - together])) < 60


def test_a_long_gap_makes_no_milliseconds() -> None:
    found = read(np.array([0, 0.033, 5000]), np.arange(3))
    assert found.seconds.tolist() == pytest.approx([0, 0.033, 5000], abs=1e-4)


def test_a_format_in_seconds_may_have_keys_far_apart() -> None:
    found = key_times(np.array([0, 4, 8, 20], np.float32), file_error("take.glb"))
    assert found.seconds.tolist() == [0, 4, 8, 20]


def test_frames_may_be_minutes_apart() -> None:
    for times in ([0, 120, 250], [0, 150]):
        assert key_times(np.array(times, np.float32), file_error("take.glb")).seconds.tolist() == times


def test_times_that_repeat_by_rounding_alone_are_even() -> None:
    found = read(np.round(np.arange(50) / 240, 2), np.arange(50))
    assert found.seconds is None
    assert found.fps == pytest.approx(240, rel=0.03)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0, 0.1, 0.05, 0.2], r"found time 0.05 after 0.1 in frame 3, expected rising times: sort the rows"),
        ([0.3, 0.2, 0.1, 0], "found time 0.2 after 0.3 in frame 2"),
        ([0, 0.1, np.nan, 0.2], "found no time in frame 3"),
        ([0, 0.1, 0.2, 0.2, 0.35], "found time 0.2 after 0.2 in frame 4, expected rising times: keep one row"),
        ([1, 1, 1, 1], "found one time, 1, in all of 4 frames"),
        ([0, 1e-6, 2e-6, 3e-6], "found 1e.06 frames a second"),
    ],
)
def test_what_is_no_time_is_refused(times: list[float], message: str) -> None:
    with pytest.raises(FileFormatError, match=rf"take.csv: {message}"):
        read(np.array(times))


def test_a_single_frame_has_the_rate_that_is_stated() -> None:
    assert read(np.array([0.0]), np.array([1.0]), 48.0) == FrameTimes(48.0, None)
    assert read(np.array([0.5]), np.array([12.0])) == FrameTimes(24.0, None)
    assert read(np.array([0.0])) == FrameTimes(60.0, None)
