"""Videos of variable frame rate and of changing size are told from those of cameras that jitter."""

from __future__ import annotations

import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchface.errors import FileFormatError
from torchface.io.video import VideoFile, open_video, write_video
from torchface.io.video.decoding import opencv
from torchface.io.video.packets import coded_size, read_packets
from torchface.io.video.timing import check_even_rate

FILE = Path("clip.mov")
needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")


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


def jpegs(width: int, height: int, count: int) -> list[bytes]:
    cv2 = opencv()
    grey = np.random.default_rng(0).integers(0, 256, (height, width), dtype=np.uint8)
    good, content = cv2.imencode(".jpg", cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    assert good
    return [content.tobytes()] * count


def motion_jpeg(path: Path, frames: list[bytes], width: int, height: int, fps: int = 25) -> Path:
    """An AVI whose frames are JPEG files, whatever their size is."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return name + struct.pack("<I", len(content)) + content + b"\0" * (len(content) % 2)

    head = struct.pack(
        "<14I", 1_000_000 // fps, 0, 0, 0x10, len(frames), 0, 1, 0, width, height, 0, 0, 0, 0
    )  # fmt: skip
    stream = (
        b"vidsMJPG" + struct.pack("<10I", 0, 0, 0, 1, fps, 0, len(frames), 0, 0, 0) + struct.pack("<4H", 0, 0, 0, 0)
    )
    form = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, 24, b"MJPG", 3 * width * height, 0, 0, 0, 0)
    streams = chunk(b"LIST", b"strl" + chunk(b"strh", stream) + chunk(b"strf", form))
    header = chunk(b"LIST", b"hdrl" + chunk(b"avih", head) + streams)
    movie = chunk(b"LIST", b"movi" + b"".join(chunk(b"00dc", frame) for frame in frames))
    path.write_bytes(chunk(b"RIFF", b"AVI " + header + movie))
    return path


def test_frames_that_change_their_size_are_refused(tmp_path: Path) -> None:
    even = open_video(motion_jpeg(tmp_path / "even.avi", jpegs(64, 48, 12), 64, 48))
    assert sum(len(chunk) for chunk in even.chunks()) == 12
    frames = jpegs(64, 48, 7) + jpegs(96, 80, 5)
    video = open_video(motion_jpeg(tmp_path / "grows.avi", frames, 64, 48))
    for read in (video.check, lambda: next(video.chunks()), lambda: next(video.color_chunks())):
        with pytest.raises(FileFormatError, match="frame 7 is 96 x 80 pixels, expected 64 x 48 as the first"):
            read()


def test_packets_say_what_frames_are(tmp_path: Path) -> None:
    frames = torch.randint(0, 256, (9, 48, 64), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    video = write_video([frames], tmp_path / "a.mp4", 25.0)
    packets = read_packets(video.path)
    assert packets is not None
    assert np.allclose(np.sort(packets.seconds), np.arange(9) / 25)
    assert packets.resized() is None


@given(content=st.binary(max_size=80), code=st.sampled_from([b"h264", b"hevc", b"fmp4", b"vp80", b"vp90", b"mjpg"]))
def test_any_bytes_have_a_size_or_none(content: bytes, code: bytes) -> None:
    for start in (b"", b"\0\0\1\x67", b"\0\0\1\x42\1", b"\0\0\1\x20", b"\xff\xd8", b"\x82\x49\x83\x42"):
        size = coded_size(code, start + content)
        assert size is None or len(size) == 2


def encoded(folder: Path, name: str, *arguments: str, source: str = "testsrc=s=160x120:r=30:d=3") -> VideoFile:
    """A video that ffmpeg makes of a test pattern."""
    path = folder / name
    command = ["ffmpeg", "-y", "-loglevel", "error", "-f", "lavfi", "-i", source, *arguments, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    if done.returncode:
        pytest.skip(f"this ffmpeg cannot make it: {done.stderr.strip()[:100]}")
    return open_video(path)


@needs_ffmpeg
@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_encoded_videos_of_variable_rate_are_refused(name: str, tmp_path: Path) -> None:
    encoded(tmp_path, "even" + name).check()
    jitter = "settb=1/90000,setpts='PTS+floor(270*sin(N*1.7))+270'"
    shaken = encoded(tmp_path, "jitter" + name, "-vf", jitter, "-fps_mode", "vfr", "-enc_time_base", "1/90000")
    shaken.check()
    slower = "select='if(lt(t,2),1,not(mod(n,2)))'"
    video = encoded(tmp_path, name, "-vf", slower, "-fps_mode", "vfr")
    with pytest.raises(FileFormatError, match=r"variable frame rate.*-vf fps=30"):
        next(video.color_frames())


@needs_ffmpeg
@pytest.mark.parametrize(
    ("ending", "codec"),
    [("mp4", "libx264"), ("mkv", "libx264"), ("mp4", "libx265"), ("webm", "libvpx"), ("webm", "libvpx-vp9"),
     ("avi", "mpeg4")],
)  # fmt: skip
def test_joined_videos_of_two_sizes_are_refused(ending: str, codec: str, tmp_path: Path) -> None:
    for number, size in enumerate(("160x120", "320x240")):
        part = encoded(tmp_path, f"{number}.{ending}", "-c:v", codec, source=f"testsrc=s={size}:r=30:d=0.5")
        part.check()
    (tmp_path / "list.txt").write_text(f"file 0.{ending}\nfile 1.{ending}\n")
    command = ["ffmpeg", "-y", "-loglevel", "error", "-f", "concat", "-i", "list.txt", "-c", "copy", f"both.{ending}"]
    subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=120, check=True)
    if codec == "libx265":  # its second header stays outside of the stream
        return
    with pytest.raises(FileFormatError, match="frame 15 is 320 x 240 pixels, expected 160 x 120 as the first"):
        open_video(tmp_path / f"both.{ending}").check()
