"""Cameras that are slow, change, hang or are pulled out, and videos that are played as cameras are."""

import threading
import time
from collections.abc import Iterator
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from torchface.errors import FileFormatError
from torchface.io.video import VideoFile, write_video
from torchface.workflows.live import camera as module
from torchface.workflows.live import live_frames
from torchface.workflows.live.camera import Camera
from torchface.workflows.live.camera_devices import list_cameras
from torchface.workflows.live.live_frames import PlayedVideo, SourceSettings, open_source, planes


class Planted:
    """OpenCV's capture, playing what a test wrote: sizes of pictures, None for a failure, waits (seconds or events)."""

    def __init__(self, script: list[Any], opens: bool = True) -> None:
        self.script, self.opens = iter(script), opens
        self.asked: dict[int, float] = {}
        self.released = threading.Event()

    def isOpened(self) -> bool:
        return self.opens

    def set(self, setting: int, value: float) -> bool:
        self.asked[setting] = value
        return True

    def get(self, setting: int) -> float:
        return 30.0 if setting == cv2.CAP_PROP_FPS else 0.0

    def read(self) -> tuple[bool, np.ndarray | None]:
        what = next(self.script, None)
        while isinstance(what, (float, threading.Event)):
            time.sleep(what) if isinstance(what, float) else what.wait(20)
            what = next(self.script, None)
        if what is None:
            return False, None
        width, height = what
        frame = np.zeros((height, width, 3), np.uint8)
        frame[...] = (10, 20, 200)  # blue, green, red
        time.sleep(0.004)
        return True, frame

    def release(self) -> None:
        self.released.set()


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Patience of a second, and a rate measured over a tenth."""
    times = {"_MAX_WAIT": 1.0, "_FIRST_WAIT": 20.0, "_RETRY": 0.01, "_TICK": 0.02, "_MEASURED": 0.1}
    for name, value in times.items():
        monkeypatch.setattr(module, name, value)
    return monkeypatch


def plug_in(patch: pytest.MonkeyPatch, planted: Planted) -> None:
    patch.setattr(cv2, "VideoCapture", lambda number: planted)


def test_a_camera_is_asked_for_little_delay_and_gives_red_first(quick: pytest.MonkeyPatch) -> None:
    planted = Planted([(64, 48)] * 500)
    plug_in(quick, planted)
    told: list[str] = []
    with closing(Camera(0, told.append, (640, 480))) as opened:
        came, frame = next(opened.frames())
        assert frame.shape == (48, 64, 3)
        assert frame[0, 0].tolist() == [200, 20, 10]
        assert 0 <= time.perf_counter() - came < 5
        assert (opened.video.width, opened.video.height, opened.video.fps) == (64, 48, 30.0)
    assert planted.asked[cv2.CAP_PROP_FRAME_WIDTH] == 640
    assert planted.asked[cv2.CAP_PROP_BUFFERSIZE] == 1
    assert planted.asked[cv2.CAP_PROP_FOURCC] == cv2.VideoWriter.fourcc(*"MJPG")
    assert planted.released.is_set()
    assert told == []


def test_pictures_of_another_size_are_fitted_and_told(quick: pytest.MonkeyPatch) -> None:
    seen, frames = threading.Event(), []
    plug_in(quick, Planted([(64, 48), (64, 48), seen, (128, 48), (128, 48)]))
    told: list[str] = []
    with closing(Camera(0, told.append)) as opened:
        for _, frame in opened.frames():
            frames.append(frame)
            seen.set()
    assert {frame.shape for frame in frames} == {(48, 64, 3)}
    last = frames[-1]
    assert last[24, 32].tolist() == [200, 20, 10]
    assert not last[:11].any()  # 128 x 48 in 64 x 48: 24 rows, 12 above and below stay black
    assert [note for note in told if "changed" in note] == [
        "camera 0 changed its pictures to 128 x 48 pixels; fitted into 64 x 48"
    ]


def test_one_that_is_pulled_out_ends_the_frames_and_is_told(quick: pytest.MonkeyPatch) -> None:
    planted = Planted([(64, 48)] * 3 + [None, None] + [(64, 48)] * 3)  # a short failure passes
    plug_in(quick, planted)
    told: list[str] = []
    with closing(Camera(3, told.append)) as opened:
        began = time.perf_counter()
        frames = list(opened.frames())
        assert time.perf_counter() - began < 3
    assert frames
    assert told == ["camera 3 gave no frame for 1 seconds: is it still plugged in?"]


def test_a_rate_that_changes_is_told_once(quick: pytest.MonkeyPatch) -> None:
    slow = [x for _ in range(10) for x in (0.04, (64, 48))]
    plug_in(quick, Planted([(64, 48)] * 60 + slow))
    told: list[str] = []
    with closing(Camera(0, told.append)) as opened:
        list(opened.frames())
    slower = [note for note in told if "frames a second" in note]
    assert slower
    assert "before)" in slower[0]


def test_no_camera_a_silent_one_and_what_to_do(quick: pytest.MonkeyPatch) -> None:
    plug_in(quick, Planted([], opens=False))
    quick.setattr(module, "list_cameras", lambda: {})
    with pytest.raises(FileFormatError, match=r"camera 0: cannot be opened; found no camera .* live film.mp4"):
        open_source("0", print)
    quick.setattr(module, "list_cameras", lambda: {0: "Front", 2: "Back"})
    with pytest.raises(FileFormatError, match=r"no other program holds, or another one's number: 2 \(Back\)"):
        open_source("0", print)
    plug_in(quick, Planted([]))
    quick.setattr(module, "_FIRST_WAIT", 0.25)
    with pytest.raises(FileFormatError, match="camera 1: gives no frame within"):
        open_source("1", print)
    with pytest.raises(FileFormatError, match=r"film\.mp4: .*no such file"):
        open_source("film.mp4", print)


def test_cameras_are_listed_by_number() -> None:
    assert all(isinstance(number, int) and isinstance(name, str) for number, name in list_cameras().items())


class Clock:
    """Time that passes when it is waited for, and no other way."""

    def __init__(self) -> None:
        self.now = 100.0

    def perf_counter(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    given = Clock()
    monkeypatch.setattr(live_frames, "time", given)
    return given


def test_a_video_is_played_in_its_own_time(tmp_path: Path, clock: Clock) -> None:
    shades = torch.tensor([10, 60, 110, 160, 210], dtype=torch.uint8)
    write_video([shades[:, None, None, None].expand(5, 3, 32, 48).contiguous()], tmp_path / "film.avi", 20.0)
    played = PlayedVideo(tmp_path / "film.avi")
    found = [(came, int(frame[0, 0, 0])) for came, frame in played.frames()]
    assert [shade for _, shade in found] == shades.tolist()
    assert [came for came, _ in found] == pytest.approx([100, 100.05, 100.1, 100.15, 100.2])
    assert clock.now == pytest.approx(100.2)
    assert played.dropped == 0


def test_frames_that_come_while_another_is_solved_are_dropped(tmp_path: Path, clock: Clock) -> None:
    write_video([torch.zeros(10, 3, 32, 48, dtype=torch.uint8)], tmp_path / "film.avi", 50.0)
    played = PlayedVideo(tmp_path / "film.avi")
    times = []
    for came, _ in played.frames():
        times.append(came)
        clock.sleep(0.07)  # three and a half frames long
    assert len(times) + played.dropped == 10
    assert times == pytest.approx([100.0, 100.06, 100.12])  # each given at most one frame late


def test_a_video_that_is_decoded_slower_than_it_plays_is_shown_all_the_same(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_video([torch.zeros(200, 3, 32, 48, dtype=torch.uint8)], tmp_path / "film.avi", 50.0)
    played = PlayedVideo(tmp_path / "film.avi")

    def slow(self: VideoFile) -> Iterator[torch.Tensor]:
        for _ in range(200):
            clock.sleep(0.05)
            yield torch.zeros(3, 32, 48, dtype=torch.uint8)

    monkeypatch.setattr(VideoFile, "color_frames", slow)
    gaps = [(came, clock.now - came) for came, _ in played.frames()]
    times, late = np.array(gaps).T
    assert len(times) >= 100  # as leaving more out gains no time
    assert np.diff(times).max() < 0.15
    assert late.max() < 0.021  # of the film's time, which goes on from there


def test_a_video_that_is_recorded_loses_no_frame(tmp_path: Path, clock: Clock) -> None:
    write_video([torch.zeros(10, 3, 32, 48, dtype=torch.uint8)], tmp_path / "film.avi", 50.0)
    played = open_source(str(tmp_path / "film.avi"), print, SourceSettings(every=True))
    times, waited = [], []
    for came, _ in played.frames():
        times.append(came)
        waited.append(clock.now - came - played.late)
        clock.sleep(0.07)
    assert played.dropped == 0
    assert times == pytest.approx([100 + number / 50 for number in range(10)])  # the film's own
    assert max(waited) <= 0.02 + 1e-6  # no frame waits for all that were late before it
    assert played.late == pytest.approx(9 * 0.05)


def test_a_video_that_loops_begins_anew_without_a_pause(tmp_path: Path, clock: Clock) -> None:
    write_video([torch.zeros(5, 3, 32, 48, dtype=torch.uint8)], tmp_path / "film.avi", 50.0)
    played = PlayedVideo(tmp_path / "film.avi", SourceSettings(loop=True))
    times = [came for came, _ in islice(played.frames(), 12)]
    assert times[:5] == pytest.approx([100 + number / 50 for number in range(5)])
    assert np.diff(times).max() <= 0.02 + 1e-6
    assert len(times) == 12


def test_planes_are_the_picture() -> None:
    picture = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    assert torch.equal(planes(picture), torch.from_numpy(picture).permute(2, 0, 1))
