"""Videos of every codec come back whole, in order and upright; what no take can be made of is refused."""

import os
import resource
import struct
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from mutation import check_reader
from video_samples import RATE, encode, pattern

from torchface.errors import FileFormatError
from torchface.io.video import open_video, write_video
from torchface.io.video.video_packets import read_packets

FORMATS = [
    ("libx264", "mp4"), ("libx264", "mkv"), ("libx264", "avi"), ("libx265", "mp4"), ("libx265", "mkv"),
    ("libsvtav1", "mp4"), ("libsvtav1", "webm"), ("libvpx-vp9", "webm"), ("libvpx-vp9", "mp4"), ("libvpx", "webm"),
    ("mpeg4", "avi"), ("mpeg4", "mov"), ("mjpeg", "avi"),
]  # fmt: skip
PIXELS = {"mjpeg": "yuvj420p"}


def read_by_opencv(path: Path) -> np.ndarray:
    """All frames (T,3,H,W), red first."""
    capture, frames = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG), []
    while (found := capture.read())[0]:
        frames.append(found[1][..., ::-1].transpose(2, 0, 1))
    return np.stack(frames)


def read_whole(path: Path) -> None:
    for chunk in open_video(path).chunks():
        assert chunk.dtype == torch.uint8


@pytest.mark.parametrize("ending", ["mkv", "webm"])
@pytest.mark.parametrize("start", [0, 90])
def test_sound_that_goes_on_and_a_late_start_are_no_frames(ending: str, start: int, tmp_path: Path) -> None:
    """Matroska has the length of the film alone: with its sound, and with what lies before its first frame."""
    path = tmp_path / f"film.{ending}"
    with av.open(str(path), "w") as container:
        video = container.add_stream("libvpx", rate=30)
        sound = container.add_stream("libopus", rate=48_000)
        video.width, video.height, video.pix_fmt = 160, 120, "yuv420p"
        for number in range(20):
            frame = av.VideoFrame.from_ndarray(pattern(number), "rgb24")
            frame.pts = start + number
            container.mux(video.encode(frame))
        container.mux(video.encode(None))
        for number in range(150):
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 960), np.int16), layout="mono")
            silence.sample_rate, silence.pts = 48_000, 960 * number
            container.mux(sound.encode(silence))
        container.mux(sound.encode(None))
    film = open_video(path)
    assert film.count == 20
    assert sum(1 for _ in film.frames()) == 20
    assert film.uneven_seconds() == (None, "")


@pytest.mark.parametrize(("codec", "ending"), FORMATS)
def test_every_frame_comes_in_order_and_as_opencv_decodes_it(codec: str, ending: str, tmp_path: Path) -> None:
    video = open_video(encode(tmp_path / f"a.{ending}", codec, pixels=PIXELS.get(codec, "yuv420p")))
    assert not hasattr(os, "sched_getscheduler") or os.sched_getscheduler(0) == os.SCHED_OTHER
    assert (video.width, video.height, video.count, video.fps) == (160, 120, 30, RATE)
    frames = torch.cat(list(video.color_chunks(8))).numpy()
    assert np.array_equal(frames, read_by_opencv(video.path))
    true = np.stack([pattern(i).transpose(2, 0, 1) for i in range(30)]).astype(float)
    distance = np.abs(frames[:, None, :, ::4, ::4] - true[None, ..., ::4, ::4]).mean((2, 3, 4))
    assert np.array_equal(distance.argmin(1), np.arange(30))  # each frame is the one of its number
    assert distance.diagonal().max() < 8


def test_ten_bits_and_no_subsampling_are_near(tmp_path: Path) -> None:
    for name, codec, pixels in (("ten.mp4", "libx265", "yuv420p10le"), ("full.mp4", "libx264", "yuv444p")):
        video = open_video(encode(tmp_path / name, codec, 5, pixels=pixels))
        frames = torch.cat(list(video.color_chunks())).numpy().astype(float)
        assert np.abs(frames - read_by_opencv(video.path)).mean() < 2
        assert np.abs(frames[3] - pattern(3).transpose(2, 0, 1)).mean() < 5


@pytest.mark.parametrize("rotation", [90, 180, -90])
@pytest.mark.parametrize("ending", ["mp4", "mkv"])
def test_a_phone_held_upright_gives_upright_frames(rotation: int, ending: str, tmp_path: Path) -> None:
    video = open_video(encode(tmp_path / f"a.{ending}", "libx264", 6, rotation=rotation))
    turned = np.rot90(pattern(4), rotation // 90).transpose(2, 0, 1)
    assert (video.height, video.width) == turned.shape[1:]
    frames = torch.cat(list(video.color_chunks())).numpy()
    assert np.abs(frames[4] - turned.astype(float)).mean() < 6
    assert np.array_equal(frames, read_by_opencv(video.path))


def test_what_an_edit_list_hides_is_neither_counted_nor_shown(tmp_path: Path) -> None:
    whole = open_video(encode(tmp_path / "whole.mp4", "libx264"))
    video = open_video(encode(tmp_path / "cut.mp4", "libx264", shift=7))
    assert read_packets(video.path).hidden == 7
    assert (video.count, video.fps) == (23, RATE)
    frames = torch.cat(list(video.color_chunks()))
    assert torch.equal(frames, torch.cat(list(whole.color_chunks()))[7:])


@pytest.mark.parametrize(("codec", "ending"), [case for case in FORMATS if case[1] in ("mp4", "mkv", "webm", "mov")])
def test_variable_rates_are_refused_and_jitter_passes(codec: str, ending: str, tmp_path: Path) -> None:
    jitter = np.arange(60) / RATE + 0.003 * np.abs(np.sin(1.7 * np.arange(60)))
    open_video(encode(tmp_path / f"jitter.{ending}", codec, 60, (64, 64), times=jitter)).check()
    slower = np.concatenate([np.arange(40) / RATE, 40 / RATE + np.arange(20) * 2 / RATE])
    video = open_video(encode(tmp_path / f"slower.{ending}", codec, 60, (64, 64), times=slower))
    with pytest.raises(FileFormatError, match=r"variable frame rate.*-vf fps="):
        next(video.color_frames())


@pytest.mark.parametrize(
    ("codec", "ending"), [case for case in FORMATS if case not in (("libx265", "mp4"), ("libx264", "mp4"))]
)
def test_frames_that_change_their_size_are_refused(codec: str, ending: str, tmp_path: Path) -> None:
    pixels = PIXELS.get(codec, "yuv420p")
    video = open_video(encode(tmp_path / f"a.{ending}", codec, 6, pixels=pixels, second_size=(176, 144)))
    for read in (video.check, lambda: next(video.chunks()), lambda: next(video.color_chunks())):
        with pytest.raises(FileFormatError, match="frame 6 is 176 x 144 pixels, expected 160 x 120 as the first"):
            read()


@pytest.mark.parametrize("ending", ["mp4", "mkv", "avi"])
def test_a_file_that_is_cut_off_is_refused(ending: str, tmp_path: Path) -> None:
    options = {"movflags": "faststart"} if ending == "mp4" else {}
    content = encode(tmp_path / f"a.{ending}", "mpeg4", options=options).read_bytes()
    cut = tmp_path / f"cut.{ending}"
    cut.write_bytes(content[: len(content) * 2 // 3])
    with pytest.raises(FileFormatError, match=r"frames could be decoded, expected 30|cannot be opened"):
        read_whole(cut)


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
    form = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, 24, b"MJPG", 0, 0, 0, 0, 0)
    streams = chunk(b"LIST", b"strl" + chunk(b"strh", stream) + chunk(b"strf", form))
    header = chunk(b"LIST", b"hdrl" + chunk(b"avih", head) + streams)
    movie = chunk(b"LIST", b"movi" + b"".join(chunk(b"00dc", frame) for frame in frames))
    path.write_bytes(chunk(b"RIFF", b"AVI " + header + movie))
    return path


def jpeg(width: int, height: int) -> bytes:
    return cv2.imencode(".jpg", pattern(0, width, height))[1].tobytes()


def test_absurd_sizes_are_refused_before_memory_is_taken(tmp_path: Path) -> None:
    small = jpeg(64, 48)
    huge = small.replace(struct.pack(">HH", 48, 64), struct.pack(">HH", 65500, 65500), 1)
    assert huge != small
    lossless = encode(tmp_path / "lossless.avi", "ffv1", 8, pixels="bgr0").read_bytes()
    for name, width, height in (("wide", 10_000, 40), ("tall", 100_000, 100_000)):
        changed = lossless.replace(struct.pack("<ii", 160, 120), struct.pack("<ii", width, height))
        (tmp_path / f"{name}.avi").write_bytes(changed)
    motion_jpeg(tmp_path / "frames.avi", [huge] * 8, 64, 48)
    motion_jpeg(tmp_path / "both.avi", [huge] * 8, 100_000, 100_000)
    motion_jpeg(tmp_path / "later.avi", [small] * 8 + [huge] * 8, 64, 48)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for name, message in (
        ("wide", "found frames of 10000 x 40 pixels, expected at most 8192 a side"),
        ("tall", "no frame can be decoded"),
        ("frames", "no frame can be decoded"),
        ("both", "no frame can be decoded"),
        ("later", "8 frames could be decoded, expected 16"),
    ):
        with pytest.raises(FileFormatError, match=message):
            read_whole(tmp_path / f"{name}.avi")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB
    lying = open_video(motion_jpeg(tmp_path / "lying.avi", [small] * 8, 100_000, 100_000))
    assert (lying.width, lying.height) == (64, 48)  # as the frames are


def test_an_empty_frame_within_an_avi_does_not_end_it(tmp_path: Path) -> None:
    frames = [jpeg(64, 48)] * 150
    frames[70] = b""
    video = open_video(motion_jpeg(tmp_path / "a.avi", frames, 64, 48))
    assert sum(len(chunk) for chunk in video.chunks()) == 149


def test_a_mutated_video_is_read_or_refused(tmp_path: Path) -> None:
    for codec, ending in (("libx264", "mp4"), ("libx264", "mkv"), ("mpeg4", "avi"), ("libsvtav1", "mp4")):
        good = encode(tmp_path / f"good.{ending}", codec, 6, size=(64, 48), rotation=90 if ending == "mp4" else 0)
        report = check_reader(read_whole, [good], f".{ending}")
        assert report.read > 0
        assert report.refused > 0


def test_what_is_written_as_mp4_plays_in_browsers(tmp_path: Path) -> None:
    frames = torch.from_numpy(np.stack([pattern(i, 320, 240) for i in range(8)])).permute(0, 3, 1, 2)
    video = write_video([frames], tmp_path / "a.mp4", 30000 / 1001)
    assert video == open_video(video.path)
    with av.open(str(video.path)) as container:
        context = container.streams.video[0].codec_context
        assert (context.name, context.pix_fmt) == ("h264", "yuv420p")
        assert (context.colorspace, context.color_primaries, context.color_trc, context.color_range) == (1, 1, 1, 1)
    read = torch.cat(list(video.color_chunks()))
    assert (read.float() - frames.float()).abs().mean() < 3
    for shape in ((4, 121, 161), (4, 3, 121, 161)):  # 4:2:0 knows even sizes alone
        odd = (torch.linspace(0, 255, 161).expand(shape)).to(torch.uint8)
        video = write_video([odd], tmp_path / "odd.mp4", 25.0)
        assert (video.width, video.height) == (161, 121)
        assert (torch.cat(list(video.chunks())).float() - odd.float().reshape(4, -1, 121, 161)[:, 0]).abs().mean() < 2


def test_an_ffmpeg_without_x264_writes_mpeg4(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(av, "codecs_available", av.codecs_available - {"libx264"})
    frames = torch.from_numpy(np.stack([pattern(i, 161, 121) for i in range(8)])).permute(0, 3, 1, 2)
    video = open_video(write_video([frames], tmp_path / "a.mp4", 120000 / 1001).path)
    with av.open(str(video.path)) as container:
        assert container.streams.video[0].codec_context.name == "mpeg4"
    assert (video.width, video.height, video.count) == (161, 121, 8)
    assert video.fps == pytest.approx(120000 / 1001, rel=1e-5)
    assert (torch.cat(list(video.color_chunks())).float() - frames.float()).abs().mean() < 5


def test_an_empty_video_and_a_folder_are_named(tmp_path: Path) -> None:
    empty, folder = tmp_path / "a.mp4", tmp_path / "b.mp4"
    empty.touch()
    folder.mkdir()
    for path, words in ((empty, "found an empty file, expected content"), (folder, "found a folder")):
        with pytest.raises(FileFormatError, match=f"{path.name}: {words}"):
            open_video(path)
