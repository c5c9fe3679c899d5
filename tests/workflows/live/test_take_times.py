"""Recordings of what phones send: one rate and the same times in all files, whatever the network did; none is lost."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from planted_faces import FRONTAL

from torchface import load_take
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.shape_names import ARKIT
from torchface.take import Take
from torchface.workflows.browser_app.character import load_character
from torchface.workflows.live.live_figures import LiveFigures
from torchface.workflows.live.live_frames import LiveFrame
from torchface.workflows.live.recordings import Recordings
from torchface.workflows.live.take_times import take_times

JAW = ARKIT.index("jawOpen")
COUNT = 960
EVEN = np.arange(COUNT) / 60
NOISE = np.random.default_rng(5).uniform(-1, 1, COUNT)
PAUSE = np.where(np.arange(COUNT) < COUNT // 2, 0.0, 5.0)


def at_once(count: int) -> np.ndarray:
    """Frames of 60 a second of which so many are delivered together."""
    return EVEN[np.arange(COUNT) // count * count + count - 1] + 2e-5 * (np.arange(COUNT) % count)


def shown(came: np.ndarray, end: float = 0.0) -> list[tuple[float, bool]]:
    """Frames of a source: when, and whether somebody sent it. While nobody does it ticks, from before the first one on,
    as ``ReceivedSource``."""
    frames, tick = list[tuple[float, bool]](), came[0] - 3.0
    for row, (one, after) in enumerate(zip([came[0], *came], [*came, came[-1] + end], strict=True)):
        frames += [(float(one), True)] if row else []
        tick = one + 0.1 if row else tick
        while tick < after:
            frames.append((float(tick), False))
            tick += 1 / 30 if row and tick - one < 4 else 0.2
    return frames


def recorded(came: np.ndarray, dome: Path, folder: Path) -> tuple[list[Take], float, float]:
    """The files that a take is read from, the rate in its summary and the one that is said; the jaw is wide open, and
    shut when a pause is over."""
    recordings, figures = Recordings(folder, load_character(dome), "planted", 60.0), LiveFigures()
    recordings.start()
    heard = came[0]
    for when, fresh in shown(came + 1000.0, end=10.0):
        weights = torch.zeros(len(ARKIT))
        heard = when if fresh else heard
        weights[JAW] = 0.8 * math.exp(-max(0.0, when - heard - 0.5) / 0.4) * (when < 1000 + came[len(came) // 2])
        frame = LiveFrame(weights, FRONTAL, torch.full((68, 2), torch.nan), found=True, fresh=fresh)
        recordings.add(when, frame)
        figures.add(when, when, frame.seen, fresh)
    (saved,) = recordings.finish()
    assert saved.error == ""
    takes = [load_take(folder / name) for name in ("weights.csv", "live_link.csv")]
    takes.append(read_gltf_weights(folder / "animation.glb"))
    assert {len(take) for take in takes} == {saved.frames}
    return takes, json.loads((folder / "summary.json").read_text())["fps"], figures.fps


CASES = [
    *[(np.arange(COUNT) / fps, fps) for fps in (24000 / 1001, 30000 / 1001, 60000 / 1001, 60.0)],
    *[(EVEN + 0.001 * NOISE, 60.0), (np.sort(EVEN + 0.03 * NOISE), 60.0)],
    *[(at_once(2), 60.0), (at_once(3), 60.0), (at_once(4), 60.0), (EVEN // (1 / 30) / 30, 60.0)],
    *[(EVEN + PAUSE, 60.0), (EVEN + 0.001 * NOISE + PAUSE, 60.0), (np.sort(EVEN + 0.03 * NOISE) + PAUSE, 60.0)],
    *[(at_once(2) + PAUSE, 60.0), (at_once(4) + PAUSE, 60.0), (EVEN + 20 * PAUSE, 60.0)],
    *[(np.arange(20.0) + 0.03 * NOISE[:20], 1.0), (np.array([0, 1 / 60]), 60.0), (np.array([0, 1.0]), 1.0)],
    (np.array([0.0, 0.0]), 60.0),  # times that say nothing: the source's rate
    (np.cumsum(1 + NOISE) / 30, COUNT / float((1 + NOISE).sum() / 30)),
]
WRITTEN = (0, 5, 8, 12, 19, 20)
"""The cases of which everyday tests write files."""


@pytest.mark.parametrize(("came", "fps"), CASES)
def test_a_take_has_the_senders_rate_and_its_length(came: np.ndarray, fps: float) -> None:
    times, sent = np.array(shown(came + 1000.0)[15:]).T  # what is before the first frame is no part of a take
    kept, found, seconds = take_times(times, sent.astype(bool), np.full(len(times), np.nan), 60.0)
    assert found == pytest.approx(fps, rel=0.01)
    longest = (len(kept) - 1) / found if seconds is None else float(seconds[-1])
    assert longest == pytest.approx(came[-1] - came[0] if came[-1] else 1 / 60, abs=0.03)


@pytest.mark.parametrize(
    ("came", "fps"),
    [pytest.param(*one, marks=() if number in WRITTEN else pytest.mark.bench) for number, one in enumerate(CASES)],
)
def test_all_files_of_a_take_have_the_senders_rate_and_the_same_times(
    came: np.ndarray, fps: float, dome: Path, tmp_path: Path
) -> None:
    takes, summary, said = recorded(came, dome, tmp_path / "out")
    rates = [summary, *(take.fps for take in takes)]
    assert rates == pytest.approx([fps] * 4, rel=0.01)
    assert max(rates) - min(rates) < 1e-3
    assert said == pytest.approx(fps if came[-1] else 0.0, rel=0.01)
    for take in takes[1:]:
        np.testing.assert_allclose(take.times, takes[0].times, atol=5e-5)
    longest = float(takes[0].times[-1])
    assert longest == pytest.approx(came[-1] - came[0] if came[-1] else 1 / 60, abs=0.03)


def test_a_pause_stays_one_and_nothing_moves_towards_what_comes_after_it(dome: Path, tmp_path: Path) -> None:
    (take, *_), _, _ = recorded(EVEN + 0.001 * NOISE + PAUSE, dome, tmp_path / "out")
    times, jaw = take.times.numpy(), take.weights.select(["jawOpen"]).values[:, 0, 0].numpy()
    half = COUNT // 2
    assert np.diff(times[:half]).max() < 0.02
    within = slice(half, half + len(take) - COUNT)
    assert 10 < len(take) - COUNT < 40
    before, after = half / 60, half / 60 + 5
    true = 0.8 * np.exp(-np.clip(times - before + 1 / 60 - 0.5, 0, None) / 0.4)
    np.testing.assert_allclose(jaw[within], true[within], atol=0.01)
    assert after - 0.25 < times[within][-1] < after - 0.001
    assert jaw[within][-1] < 0.001


def the_times(sent: np.ndarray, came: np.ndarray) -> tuple[float, np.ndarray | None]:
    kept, fps, seconds = take_times(came, np.ones(len(came), bool), sent, 60.0)
    assert len(kept) == len(came)
    return fps, None if seconds is None else seconds.numpy()


@pytest.mark.parametrize(
    "delays",
    [
        0.03 * NOISE,
        at_once(4) - EVEN,
        np.where((EVEN > 3) & (EVEN < 4), 4 - EVEN, 0.0),  # a second's frames are all delivered at its end
    ],
)
def test_a_senders_clock_is_kept_and_not_the_networks_delays(delays: np.ndarray) -> None:
    fps, seconds = the_times(5_000_000 / 60 + EVEN, 12.0 + EVEN + delays)
    assert (fps, seconds) == (60.0, None)
    fps, seconds = the_times(5_000_000 / 60 + EVEN + PAUSE, 12.0 + EVEN + delays + PAUSE)
    assert fps == 60.0
    np.testing.assert_allclose(seconds, EVEN + PAUSE, atol=1e-6)


@pytest.mark.parametrize(
    ("sent", "came"),
    [
        (EVEN / 2, EVEN + 0.002 * NOISE),  # it counts frames by another rate than that at which they come
        (EVEN, EVEN + 0.002 * NOISE + PAUSE),  # it stands while the app sleeps
        (EVEN % 3, EVEN + 0.002 * NOISE),  # it was set
        (np.zeros(COUNT), EVEN + 0.002 * NOISE),
        (np.where(EVEN < 1, np.nan, EVEN), EVEN + 0.002 * NOISE),
    ],
)
def test_a_clock_that_does_not_go_as_this_machines_is_not_used(sent: np.ndarray, came: np.ndarray) -> None:
    fps, seconds = the_times(sent, came)
    assert fps == 60.0
    np.testing.assert_allclose(seconds, came - came[0], atol=1e-5)  # of timecodes


@pytest.mark.parametrize("rate", [29.95, 30.04, 24.03])
def test_ten_minutes_of_a_camera_of_another_rate_are_not_stretched(rate: float) -> None:
    came = np.arange(int(600 * rate)) / rate
    fps, seconds = the_times(np.full(len(came), np.nan), came)
    assert seconds is None
    assert fps == pytest.approx(rate, rel=1e-6)


def test_frames_that_are_minutes_apart_keep_their_times() -> None:
    _, seconds = the_times(np.full(3, np.nan), np.array([0, 120.0, 250.0]))
    assert seconds.tolist() == [0, 120, 250]


@pytest.mark.parametrize("came", [[0.0], [0.0] * 5, [0.0, 1e-6, 2e-6], [0.0, 300.0], [0.0, 0.1, 0.1, 0.05, 0.2]])
def test_no_take_is_lost_by_its_times(came: list[float], dome: Path, tmp_path: Path) -> None:
    takes, _, _ = recorded(np.array(came), dome, tmp_path / "out")
    assert len(takes[0]) - len(came) == (came[-1] == 300)  # the end of a pause
