"""Frame rates that vary are distinguished from those of cameras that jitter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchface.errors import FileFormatError
from torchface.io.video.even_rate import check_even_rate

FILE = Path("clip.mov")


def times(lasts: np.ndarray) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(lasts)])


@given(
    fps=st.sampled_from([24.0, 25.0, 29.97, 30.0, 50.0, 59.94, 60.0, 120.0]),
    jitter=st.floats(0, 0.2),
    seed=st.integers(0, 2**31),
    milliseconds=st.booleans(),
)
def test_jitter_and_rounding_pass(fps: float, jitter: float, seed: int, milliseconds: bool) -> None:
    generator = np.random.default_rng(seed)
    seconds = np.arange(300) / fps + generator.uniform(-jitter, jitter, 300) / fps
    seconds -= seconds[0]
    check_even_rate(FILE, np.round(seconds, 3) if milliseconds else seconds, fps)
    check_even_rate(FILE, generator.permutation(seconds), fps)  # packets come in the order of decoding


def test_a_lost_frame_in_a_hundred_passes() -> None:
    lasts = np.full(400, 1 / 30)
    lasts[[50, 160, 300]] *= 2
    check_even_rate(FILE, times(lasts), 30.0)


@pytest.mark.parametrize(
    ("lasts", "message"),
    [
        (np.repeat([1 / 30, 1 / 24], 100), "last (33.3|41.7) ms each"),
        (np.where(np.arange(300) == 100, 10 / 30, 1 / 30), "1 of 300 last more than half"),
        (np.repeat([1 / 30, 1 / 15], [100, 40]), r"40 of 140 .* \(33.3 to 66.7 ms\)"),
        (np.where(np.random.default_rng(0).random(300) < 0.1, 2 / 30, 1 / 30), "last more than half a frame longer"),
        (np.full(100, 1 / 15), "its header says 30 frames a second"),
        (np.linspace(1 / 30, 1 / 20, 200), "ms each"),
        (np.tile([1 / 30, 2 / 30], 24), "differ by 33 %"),
    ],
)
def test_variable_rates_are_named(lasts: np.ndarray, message: str) -> None:
    with pytest.raises(FileFormatError, match=f"variable frame rate: .*{message}.*ffmpeg -i clip.mov -vf fps="):
        check_even_rate(FILE, times(lasts), 30.0)


def test_times_that_are_not_told_are_no_evidence() -> None:
    check_even_rate(FILE, np.zeros(100), 30.0)
    check_even_rate(FILE, np.full(100, np.nan), 30.0)
    check_even_rate(FILE, np.concatenate([np.arange(60) / 30, [0.0, 0.0]]), 30.0)
