"""Timecodes: rates recovered from clocks that were run, gaps found where frames were taken away."""

from pathlib import Path

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from torchface.errors import FileFormatError
from torchface.io.tables.timecode import read_timecodes, write_timecodes

_PATH = Path("take.csv")
_RATES = [24000 / 1001, 24.0, 25.0, 30000 / 1001, 30.0, 50.0, 60000 / 1001, 60.0, 120.0]


@pytest.mark.parametrize("fps", _RATES)
def test_a_rate_comes_back_from_its_clock(fps: float) -> None:
    timing = read_timecodes(write_timecodes(400, fps), _PATH)
    assert timing.fps == fps
    assert timing.seconds is None


def test_a_rate_that_no_camera_has_is_measured() -> None:
    assert read_timecodes(write_timecodes(2000, 61.3), _PATH).fps == pytest.approx(61.3, rel=1e-5)


def test_the_clock_counts_real_time() -> None:
    codes = write_timecodes(3600 * 60 + 1, 60.0)
    assert codes[0] == "00:00:00:00.000"
    assert codes[61] == "00:00:01:01.000"
    assert codes[-1] == "01:00:00:00.000"
    assert write_timecodes(60001, 60000 / 1001)[-1] == "00:16:41:00.000"  # 60,000 frames take 1,001 s


@given(
    st.sampled_from(_RATES),
    st.lists(st.integers(1, 9), min_size=5, max_size=40).map(lambda steps: [1] * 150 + steps + [1] * 5),
)
@example(24000 / 1001, [1] * 163 + [8] + [9] * 13 + [1] * 5)
def test_frames_keep_their_times_where_others_were_dropped(fps: float, steps: list[int]) -> None:
    frames = [0]
    for step in steps:
        frames.append(frames[-1] + step)
    codes = write_timecodes(frames[-1] + 1, fps)
    timing = read_timecodes([codes[frame] for frame in frames], _PATH)
    assert timing.fps == fps
    if max(steps) > 1:
        assert (timing.seconds - torch.tensor(frames) / fps).abs().max() < 1e-6
    else:
        assert timing.seconds is None


@pytest.mark.parametrize("share", [0.1, 0.4])
@pytest.mark.parametrize("digits", [0, 3])
def test_lost_frames_do_not_change_a_rate(share: float, digits: int) -> None:
    generator = torch.Generator().manual_seed(3)
    early = 0.1 * torch.rand(400, generator=generator) if digits else torch.zeros(400)
    kept = torch.rand(400, generator=generator) > share
    ticks = [(i, part) for i, part, keep in zip(range(400), early.tolist(), kept.tolist(), strict=True) if keep]
    codes = [f"00:00:{i // 30:02d}:{i % 30 + part:0{digits + 3 if digits else 2}.{digits}f}" for i, part in ticks]
    assert read_timecodes(codes, _PATH).fps == 30


def test_a_timecode_that_comes_twice_does_not_double_the_rate() -> None:
    assert read_timecodes(["00:00:00:05", "00:00:00:05", "00:00:00:06"], _PATH).fps == 60


def test_midnight_is_no_gap() -> None:
    codes = [f"23:59:59:{frame:02d}" for frame in range(20, 25)] + [f"00:00:00:{frame:02d}" for frame in range(10)]
    timing = read_timecodes(codes, _PATH)
    assert timing.fps == 25
    assert timing.seconds is None


def test_drop_frame_timecode_skips_numbers_and_not_frames() -> None:
    codes = [f"00:00:59;{frame:02d}" for frame in range(20, 30)] + [f"00:01:00;{frame:02d}" for frame in range(2, 12)]
    timing = read_timecodes(codes, _PATH)
    assert timing.fps == 30000 / 1001
    assert timing.seconds is None


def test_a_clock_set_back_is_refused() -> None:
    codes = [f"10:00:{frame // 60:02d}:{frame % 60:02d}.000" for frame in [*range(100, 160), *range(130, 200)]]
    with pytest.raises(FileFormatError, match=r"10:00:02:10.000 in frame 61 after 10:00:02:39.000, expected a clock"):
        read_timecodes(codes, _PATH)


@pytest.mark.parametrize("text", ["", "10:00:00", "25:00:00:00", "10:60:00:00", "10:00:00:00.", "10:00:00:٣", "noon"])
def test_what_is_no_timecode_is_refused(text: str) -> None:
    with pytest.raises(FileFormatError, match=r"take\.csv: frame 2: found the timecode .*expected HH:MM:SS:FF"):
        read_timecodes(["10:00:00:00.000", text], _PATH)


def test_a_clock_that_stands_still_is_refused() -> None:
    with pytest.raises(FileFormatError, match=r"take\.csv: found 3 timecodes from 10:00:00:00 on that never rise"):
        read_timecodes(["10:00:00:00"] * 3, _PATH)
