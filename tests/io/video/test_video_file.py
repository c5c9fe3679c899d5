"""Videos come back as they were written; what is no whole video, or has uneven frames, is refused in words."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchface.errors import FileFormatError, MissingExtraError, ShapeError, ValueRangeError
from torchface.io.video import open_video, write_video
from torchface.io.video.video_file import check_even_rate

FILE = Path("clip.mov")


@pytest.fixture(scope="module")
def frames() -> torch.Tensor:
    return torch.randint(0, 256, (20, 60, 80), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


@pytest.mark.parametrize("suffix", [".avi", ".mkv"])
def test_frames_come_back_bit_for_bit(suffix: str, frames: torch.Tensor, tmp_path: Path) -> None:
    written = write_video(frames.split(7), tmp_path / f"a{suffix}", 60.0)
    video = open_video(written.path)
    assert video == written
    assert (video.fps, video.width, video.height, video.count) == (60.0, 80, 60, 20)
    chunks = list(video.chunks(8))
    assert [len(chunk) for chunk in chunks] == [8, 8, 4]
    assert torch.equal(torch.cat(chunks), frames)
    assert torch.equal(video.frame(13), frames[13])
    assert {path.name for path in tmp_path.iterdir()} == {f"a{suffix}"}  # no temporary file stays


def test_floats_become_the_nearest_of_256_greys(tmp_path: Path) -> None:
    ramp = torch.linspace(-0.1, 1.1, 64 * 48).view(48, 64)
    video = write_video([ramp, ramp], tmp_path / "ramp.avi", 25.0)
    assert (video.frame(1) / 255 - ramp.clamp(0, 1)).abs().max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize("suffix", [".avi", ".mkv"])
def test_colours_come_back_bit_for_bit(suffix: str, tmp_path: Path) -> None:
    colors = torch.randint(0, 256, (11, 3, 60, 80), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)
    video = write_video(colors.split(4), tmp_path / f"a{suffix}", 24.0)
    assert video == open_video(video.path)
    chunks = list(video.color_chunks(4))
    assert [tuple(chunk.shape) for chunk in chunks] == [(4, 3, 60, 80), (4, 3, 60, 80), (3, 3, 60, 80)]
    assert torch.equal(torch.cat(chunks), colors)
    assert torch.equal(torch.stack(list(video.color_frames())), colors)
    grey = torch.cat(list(video.chunks())).float()
    weights = torch.tensor([0.299, 0.587, 0.114])[:, None, None]  # BT.601
    assert (grey - (colors * weights).sum(1)).abs().max() <= 1.0


def test_grey_frames_are_read_in_colour_too(frames: torch.Tensor, tmp_path: Path) -> None:
    video = write_video([frames], tmp_path / "a.avi", 24.0)
    colors = torch.cat(list(video.color_chunks()))
    assert torch.equal(colors, frames[:, None].expand(-1, 3, -1, -1))


def test_lossy_colours_are_near(tmp_path: Path) -> None:
    y, x = torch.meshgrid(torch.linspace(0, 1, 96), torch.linspace(0, 1, 128), indexing="ij")
    frame = torch.stack([x, y, 1 - x])
    video = write_video([frame.expand(5, -1, -1, -1)], tmp_path / "a.mp4", 25.0)
    read = torch.cat(list(video.color_chunks())) / 255
    assert read.shape == (5, 3, 96, 128)
    assert (read - frame).abs().mean() < 0.01


def test_a_coarser_film_is_smaller(tmp_path: Path) -> None:
    noise = torch.randint(0, 256, (8, 3, 64, 64), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    sizes = [write_video([noise], tmp_path / f"{crf}.mp4", 30.0, crf=crf).path.stat().st_size for crf in (16, 28)]
    assert sizes[1] < 0.6 * sizes[0]


def test_a_broken_video_is_refused(frames: torch.Tensor, tmp_path: Path) -> None:
    path = tmp_path / "whole.avi"
    write_video([frames], path, 60.0)
    content = path.read_bytes()
    cut = tmp_path / "cut.avi"
    cut.write_bytes(content[: len(content) // 2])
    with pytest.raises(FileFormatError, match=r"frames could be decoded, expected 20"):
        list(open_video(cut).chunks())
    for name, start, message in (
        ("empty.avi", b"", "an empty file, expected content"),
        ("header.avi", content[:64], "cannot be opened"),
        ("text.avi", b"this is no video, whatever its name says", "begins as no video does"),
        ("playlist.avi", b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n", "begins as no video does"),
    ):
        (tmp_path / name).write_bytes(start)
        with pytest.raises(FileFormatError, match=message):
            open_video(tmp_path / name)
    with pytest.raises(FileFormatError, match="no such file"):
        open_video(tmp_path / "missing_%03d.png")


def test_damaged_bytes_end_in_an_error_or_in_frames(frames: torch.Tensor, tmp_path: Path) -> None:
    path = tmp_path / "whole.avi"
    write_video([frames[:4]], path, 60.0)
    content = np.frombuffer(path.read_bytes(), np.uint8)
    generator = np.random.default_rng(0)
    read = 0
    for _ in range(60):
        damaged = content.copy()
        places = generator.integers(0, len(damaged), 8)
        places[:4] = generator.integers(0, 400, 4)  # the headers
        damaged[places] = generator.integers(0, 256, 8)
        (tmp_path / "damaged.avi").write_bytes(damaged.tobytes())
        try:
            for chunk in open_video(tmp_path / "damaged.avi").chunks():
                assert chunk.dtype == torch.uint8
                read += 1
        except FileFormatError:
            pass
    assert read > 5


def test_what_cannot_be_written_is_said(frames: torch.Tensor, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="ending"):
        write_video([frames], tmp_path / "a.gif", 60.0)
    with pytest.raises(ShapeError, match="no frame"):
        write_video([], tmp_path / "a.avi", 60.0)
    with pytest.raises(ShapeError, match="as the first"):
        write_video([frames, frames[:, :30]], tmp_path / "a.avi", 60.0)
    with pytest.raises(ShapeError, match="as the first"):
        write_video([frames[:2], frames[:2, None].expand(-1, 3, -1, -1)], tmp_path / "a.avi", 60.0)
    with pytest.raises(ShapeError, match="in colour"):
        write_video([frames[:2, None]], tmp_path / "a.avi", 60.0)
    with pytest.raises(ValueRangeError, match="fps"):
        write_video([frames], tmp_path / "a.avi", float("nan"))
    with pytest.raises(FileFormatError, match="cannot be written"):
        write_video([frames], tmp_path / "missing" / "a.avi", 60.0)
    assert not list(tmp_path.iterdir())


def test_without_pyav_a_video_asks_for_it(
    frames: torch.Tensor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    video = write_video([frames], tmp_path / "a.avi", 30)
    monkeypatch.setitem(sys.modules, "av", None)
    for use in (lambda: open_video(video.path), lambda: write_video([frames], tmp_path / "b.avi", 30)):
        with pytest.raises(MissingExtraError, match=r"video needs av, .* -m pip install 'av'"):
            use()
    assert [path.name for path in tmp_path.iterdir()] == ["a.avi"]


@pytest.mark.parametrize("suffix", [".avi", ".mkv", ".mp4"])
@pytest.mark.parametrize("kept", [0.0, 0.4, 0.9])
def test_a_video_cut_off_without_a_word_does_not_replace_the_one_before(
    suffix: str, kept: float, frames: torch.Tensor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An encoder that reports success on a full disk."""
    path = tmp_path / f"a{suffix}"
    write_video([frames[:3]], path, 60.0)
    before, opened = path.read_bytes(), av.open

    @contextmanager
    def cut_off(file: str, container_format: str) -> Iterator[object]:
        with opened(file, "w", format=container_format) as container:
            yield container
        os.truncate(file, int(kept * Path(file).stat().st_size))

    def on_a_full_disk(file: str, mode: str, format: str, **options: object) -> object:
        return cut_off(file, format) if mode == "w" else opened(file, mode, format, **options)

    with monkeypatch.context() as patch:
        patch.setattr(av, "open", on_a_full_disk)
        with pytest.raises(FileFormatError, match=rf"a{suffix}: cannot be written.*read back.*is the disk full"):
            write_video([frames], path, 60.0)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.real
def test_a_real_video_is_read_whole(data: Path) -> None:
    video = open_video(data / "video" / "single_face.mp4")
    assert (video.width, video.height, video.count) == (640, 360, 72)
    frames = torch.cat(list(video.chunks(32)))
    assert frames.shape == (72, 360, 640)
    assert 0.1 < (frames / 255).mean() < 0.9


def squeezed(path: Path, aspect: Fraction) -> Path:
    """A white disc of 40 pixels in a black frame of 96 x 64 square ones, stored in pixels of an aspect."""
    wide, high = (96 / aspect, 64) if aspect > 1 else (96, 64 * aspect)
    x, y = np.meshgrid((np.arange(int(wide)) + 0.5) * 96 / wide - 48, (np.arange(int(high)) + 0.5) * 64 / high - 32)
    pixels = np.repeat(((x**2 + y**2 < 400) * np.uint8(255))[..., None], 3, -1)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = int(wide), int(high), "yuv420p", 2**24
        stream.codec_context.sample_aspect_ratio = aspect
        for _ in range(2):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, "rgb24")))
        container.mux(stream.encode(None))
    return path


@pytest.mark.parametrize("ending", ["mp4", "mkv"])
@pytest.mark.parametrize("aspect", [Fraction(2), Fraction(3, 2), Fraction(1, 2), Fraction(1)])
def test_anamorphic_pixels_become_square(aspect: Fraction, ending: str, tmp_path: Path) -> None:
    video = open_video(squeezed(tmp_path / f"film.{ending}", aspect))
    assert (video.width, video.height, video.pixel_aspect) == (96, 64, float(aspect))
    for frame in video.frames():
        disc = frame > 127
        assert abs(int(disc.any(0).sum()) - 40) <= 2
        assert abs(int(disc.any(1).sum()) - 40) <= 2


def moving_disc(number: float) -> np.ndarray:
    """A soft white disc (96,128,3) that moves by 6 pixels a frame."""
    y, x = np.mgrid[:96, :128]
    edge = np.hypot(x - 30 - 6 * number, y - 48) - 20
    return np.repeat((255 / (1 + np.exp(edge / 2))).astype(np.uint8)[..., None], 3, -1)


@pytest.mark.parametrize(("codec", "ending"), [("libx264", "mp4"), ("mpeg2video", "mkv")])
def test_frames_of_two_fields_become_whole(codec: str, ending: str, tmp_path: Path) -> None:
    """Each is of the time of its first field, the lower one here; what the other shows lies three pixels further on."""
    path = tmp_path / f"fields.{ending}"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25, options={"flags": "+ilme+ildct", "b": "8000000"})
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
        for number in range(8):
            woven = moving_disc(number)
            woven[::2] = moving_disc(number + 0.5)[::2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(woven, "rgb24")))
        container.mux(stream.encode(None))
    video = open_video(path)
    frames = torch.cat(list(video.color_chunks())).numpy().transpose(0, 2, 3, 1).astype(float)
    with av.open(str(path)) as container:
        woven = np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]).astype(float)
    true = np.stack([moving_disc(number) for number in range(8)])
    assert video.interlaced
    assert len(frames) == len(woven) == 8
    assert np.abs(frames - true).mean() < 0.35 * np.abs(woven - true).mean()


def test_pixels_of_an_absurd_aspect_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"found pixels 6 times as wide as high, expected 0.25 to 4"):
        open_video(squeezed(tmp_path / "film.mkv", Fraction(6)))


@pytest.mark.parametrize(("layout", "height"), [("yuv420p", 64), ("yuv420p10le", 64), ("yuv422p", 63), ("yuv444p", 63)])
def test_colours_are_interpolated_smoothly(layout: str, height: int, tmp_path: Path) -> None:
    """The usual format is converted quickly into the bytes of FFmpeg's bicubic way, which others take."""
    shades = np.random.default_rng(0).integers(0, 256, (16, 24, 3)).astype(np.uint8)
    pixels = cv2.resize(shades, (96, height), interpolation=cv2.INTER_CUBIC)
    path = tmp_path / "film.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 96, height, layout
        coded = av.VideoFrame.from_ndarray(pixels, "rgb24").reformat(format=layout)
        for packet in (*stream.encode(coded), *stream.encode(None)):
            container.mux(packet)
    with av.open(str(path)) as container:
        decoded = next(container.decode(video=0))
        smooth = decoded.reformat(format="rgb24", interpolation=av.video.reformatter.Interpolation.BICUBIC).to_ndarray()
    assert np.array_equal(next(open_video(path).color_frames()).permute(1, 2, 0).numpy(), smooth)


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "count", "fps"),
    [("no_face.mp4", 95, 24.0), ("single_face.mp4", 72, 30.0), ("webcam/brother.mkv", 65, 30.0)],
)
def test_real_videos_come_as_opencv_decodes_them(name: str, count: int, fps: float, data: Path) -> None:
    video = open_video(data / "video" / name)
    assert (video.count, video.fps) == (count, fps)  # three more frames of the first are hidden by its edit list
    capture = cv2.VideoCapture(str(video.path), cv2.CAP_FFMPEG)
    for frame in video.color_frames():
        found, pixels = capture.read()
        assert found
        assert np.array_equal(frame.permute(1, 2, 0).numpy(), pixels[..., ::-1])
    assert not capture.read()[0]


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
