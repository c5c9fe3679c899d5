"""A written film has the sound of the film that it was made from, in step with its pictures."""

from fractions import Fraction
from pathlib import Path
from shlex import split

import av
import numpy as np
import pytest
import torch

from torchface.errors import FileFormatError, ValueRangeError
from torchface.io.video import open_video, write_video
from torchface.io.video.film_sound import sound_codec, sound_line

RATE, EVENT = 48000, 0.8  # of the sound; seconds after the first frame at which it turns white, and a tone begins
CODECS = {".webm": "libvpx-vp9", ".avi": "mpeg4"}
EVEN = [t / 30 for t in range(45)]
SLOWER = [t / 30 if t < 24 else 0.8 + (t - 24) / 15 for t in range(45)]


def film(path: Path, codec: str, times: list[float], begin: float = 0.0, silent: float = 0.0) -> Path:
    """A film whose first frame is shown at ``begin`` seconds, and whose sound begins at ``silent``."""
    tick = Fraction(1, 1000)
    with av.open(str(path), "w") as container:
        pictures = container.add_stream(CODECS.get(path.suffix, "libx264"), rate=30)
        pictures.width, pictures.height, pictures.pix_fmt = 64, 48, "yuv420p"
        pictures.codec_context.time_base = tick
        sound = container.add_stream(codec, rate=RATE)
        sound.layout = "mono"
        for time in times:
            level = 250 if time >= EVENT - 1e-6 else 20
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), level, np.uint8), format="rgb24")
            frame.pts, frame.time_base = round(1000 * (begin + time)), tick
            container.mux(pictures.encode(frame))
        container.mux(pictures.encode(None))
        at = np.arange(round(RATE * silent), int(RATE * (begin + times[-1]))) / RATE
        wave = (np.sin(2 * np.pi * 880 * at) * 0.5 * (at >= begin + EVENT)).astype(np.float32)
        samples = av.AudioFrame.from_ndarray(wave[None], format="fltp", layout="mono")
        samples.sample_rate, samples.pts, samples.time_base = RATE, round(RATE * silent), Fraction(1, RATE)
        resampler = av.AudioResampler(sound.codec_context.format.name, "mono", RATE, sound.codec_context.frame_size)
        for piece in [*resampler.resample(samples), *resampler.resample(None)]:
            container.mux(sound.encode(piece))
        container.mux(sound.encode(None))
    return path


def events(path: Path) -> tuple[float, float]:
    """When the picture turns white and when the tone begins, seconds."""
    with av.open(str(path)) as container:
        frames = ((float(frame.time), frame.to_ndarray(format="gray").mean()) for frame in container.decode(video=0))
        seen = next(time for time, level in frames if level > 128)
    with av.open(str(path)) as container:
        for frame in container.decode(audio=0):
            wave = frame.to_ndarray().astype(np.float64).ravel()
            loud = np.nonzero(np.abs(wave / (32768 if frame.format.name.startswith("s16") else 1)) > 0.1)[0]
            if len(loud):
                return seen, float(frame.time) + int(loud[0]) / RATE
    raise AssertionError("no tone")


@pytest.mark.parametrize("ending", [".mp4", ".mkv"])
@pytest.mark.parametrize(
    ("name", "codec", "times", "begin"),
    [
        ("plain.mp4", "aac", EVEN, 0.0),
        ("late.mkv", "aac", EVEN, 0.7),
        ("varied.mp4", "aac", SLOWER, 0.0),
        ("browser.webm", "libopus", EVEN, 0.0),
        ("camera.mov", "pcm_s16le", EVEN, 0.0),
        ("recorder.avi", "pcm_s16le", EVEN, 0.0),  # AVI names no layout of channels
    ],
)
def test_sound_goes_with_its_pictures(
    name: str, codec: str, times: list[float], begin: float, ending: str, tmp_path: Path
) -> None:
    source = film(tmp_path / name, codec, times, begin)
    kept = None if times is EVEN else torch.tensor(times, dtype=torch.float64)
    pictures = torch.full((len(times), 3, 48, 64), 20, dtype=torch.uint8)
    pictures[24:] = 250
    out = tmp_path / f"out{ending}"
    write_video([pictures], out, 30.0, kept, source)
    assert sound_codec(out) == sound_codec(source)
    assert sound_line(source, out) == []
    seen, heard = events(out)
    assert seen == pytest.approx(EVENT, abs=0.002)
    assert heard == pytest.approx(seen, abs=0.005)
    assert open_video(out).count == len(times)


def test_frames_are_shown_at_their_own_times(tmp_path: Path) -> None:
    times = torch.tensor(SLOWER, dtype=torch.float64)
    for ending in (".mp4", ".mkv"):
        out = write_video(torch.zeros(len(times), 48, 64), tmp_path / f"out{ending}", 20.0, times)
        found, _ = open_video(out.path).uneven_seconds()
        assert found is not None
        torch.testing.assert_close(found, times, atol=0.001, rtol=0)
    with pytest.raises(FileFormatError, match=r"out\.avi: \.avi holds frames at an even rate alone"):
        write_video(torch.zeros(len(times), 48, 64), tmp_path / "out.avi", 20.0, times)


@pytest.mark.parametrize(
    ("times", "found"),
    [
        ([0.0, 0.1, 0.2], "found 3, expected one for each frame, which are more"),
        ([0.0, 0.1, 0.2, 0.3, 0.4, 0.5], "found 6, expected one for each of 5 frames"),
        ([0.0, 0.1, 0.05, 0.2, 0.3], "found 0.05 s after 0.1 s for frame 2, expected seconds that rise"),
        ([0.0, 0.1, 0.1, 0.2, 0.3], "found 0.1 s after 0.1 s for frame 2"),
        ([0.0, 0.03, 0.1, float("nan"), 0.3], "found nan s after 0.1 s for frame 3"),
        ([1.0, 1.1, 1.2, 1.3, 1.4], "found 1 s for frame 0, expected seconds that rise from 0"),
    ],
)
def test_times_that_are_none_of_these_frames_are_refused(times: list[float], found: str, tmp_path: Path) -> None:
    for ending in (".mp4", ".mkv"):
        with pytest.raises(ValueRangeError, match=f"times: {found}"):
            write_video(torch.zeros(5, 32, 32), tmp_path / f"out{ending}", 10.0, torch.tensor(times))
    assert not list(tmp_path.iterdir())


def test_sound_that_a_file_cannot_hold_is_left_out_and_said(tmp_path: Path) -> None:
    source = film(tmp_path / "browser.webm", "libopus", EVEN)
    write_video(torch.zeros(45, 48, 64), tmp_path / "out.avi", 30.0, sound=source)
    assert sound_codec(tmp_path / "out.avi") == ""
    assert sound_line(source, tmp_path / "out.avi")[0].startswith("sound: .avi cannot hold browser.webm's (opus)")


def test_sound_that_begins_later_than_its_pictures_is_not_written_into_avi(tmp_path: Path) -> None:
    """AVI holds no times: it would be heard from the first frame on."""
    pictures = torch.full((45, 3, 48, 64), 20, dtype=torch.uint8)
    pictures[24:] = 250
    late, early = tmp_path / "late.mkv", tmp_path / "early.mkv"
    for source, kept in ((film(late, "aac", EVEN, silent=0.5), ""), (film(early, "aac", EVEN, begin=0.7), "aac")):
        write_video([pictures], tmp_path / "out.avi", 30.0, sound=source)
        assert sound_codec(tmp_path / "out.avi") == kept
        assert len(sound_line(source, tmp_path / "out.avi")) == (not kept)
    seen, heard = events(tmp_path / "out.avi")
    assert (seen, heard) == (pytest.approx(EVENT, abs=0.002), pytest.approx(EVENT, abs=0.03))
    write_video([pictures], tmp_path / "out.mkv", 30.0, sound=late)
    assert events(tmp_path / "out.mkv")[1] == pytest.approx(EVENT, abs=0.005)


def test_a_film_is_written_without_sound_that_cannot_be_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = film(tmp_path / "camera.mov", "pcm_s16le", EVEN)
    monkeypatch.setattr("av.container.OutputContainer.add_stream_from_template", refuse)
    assert write_video(torch.zeros(45, 48, 64), tmp_path / "out.mp4", 30.0, sound=source).count == 45
    assert len(sound_line(source, tmp_path / "out.mp4")) == 1


def refuse(*_: object) -> None:
    raise ValueError("refused")


def test_the_command_that_adds_sound_can_be_pasted(tmp_path: Path) -> None:
    folder = tmp_path / "an actor's takes"
    folder.mkdir()
    source = film(folder / "take 1.webm", "libopus", EVEN, begin=0.7)
    write_video(torch.zeros(45, 48, 64), folder / "out.avi", 30.0, sound=source)
    command = split(sound_line(source, folder / "out.avi")[0].split("anew coded: ")[1])
    assert command[:7] == ["ffmpeg", "-i", str(folder / "out.avi"), "-ss", "0.700", "-i", str(source)]
    assert command[-1] == str(folder / "out_sound.avi")
