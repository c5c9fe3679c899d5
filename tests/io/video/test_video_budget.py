"""Videos are read within the budget of memory, however large their frames and however many their streams."""

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from image_bytes import riff_part
from reader_budget import check_budget
from video_samples import RATE

from torchface.errors import FileFormatError
from torchface.io.video import open_video, write_video
from torchface.io.video.video_packets import frames_beside

WIDTH, HEIGHT = 3840, 2160


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve frames in 4K of one grey each, in some kilobytes."""
    if "libx264" not in av.codecs_available:
        pytest.skip("this FFmpeg has no libx264")
    path = tmp_path_factory.mktemp("video") / "large.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=RATE, options={"preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for number in range(12):
            frame = av.VideoFrame(WIDTH, HEIGHT, "yuv420p")
            for plane, value in zip(frame.planes, (16 + 15 * number, 128, 128), strict=True):
                plane.update(np.full(plane.buffer_size, value, np.uint8))
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def read_grey(path: Path) -> None:
    for _ in open_video(path).chunks():
        pass


def read_colors(path: Path) -> None:
    for _ in open_video(path).color_chunks():
        pass


def test_chunks_are_counted_in_bytes(large: Path) -> None:
    video = open_video(large)
    chunks = [chunk[:, 0, 0].clone() for chunk in video.chunks()]
    assert {len(chunk) for chunk in chunks} == {32 * 2**20 // (WIDTH * HEIGHT)}
    assert len(torch.cat(chunks)) == 12
    assert (torch.cat(chunks).double().diff() - 15 * 255 / 219).abs().max() <= 1  # none is lost, none comes twice
    assert [len(chunk) for chunk in video.color_chunks()] == [1] * 12


@pytest.mark.parametrize("reader", [read_grey, read_colors])
def test_a_video_in_4k_is_read_within_the_budget(reader: object, large: Path) -> None:
    assert check_budget(reader, large).refused == ""


def test_no_frame_is_decoded_of_streams_that_are_not_read(large: Path, tmp_path: Path) -> None:
    """A frame of each of eighty would take a gigabyte."""
    path = tmp_path / "streams.mkv"
    with av.open(str(large)) as source, av.open(str(path), "w") as container:
        (template,) = source.streams.video
        packets = [bytes(packet) for packet in source.demux(template) if packet.size][:2]
        streams = [container.add_stream_from_template(template) for _ in range(80)]
        for number, data in enumerate(packets):
            for stream in streams:
                packet = av.Packet(data)
                packet.stream, packet.pts, packet.dts, packet.time_base = stream, number, number, Fraction(1, RATE)
                packet.is_keyframe = number == 0
                container.mux(packet)
    assert check_budget(read_grey, path).megabytes < 400


def test_how_many_frames_fit_into_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(bytes(1000))
    assert frames_beside(path, "h264", 1920, 1080, 12) > 100
    assert frames_beside(path, "h264", WIDTH, HEIGHT, 12) > 8
    assert frames_beside(path, "ffv1", 4096, 4096, 32) >= 1
    with pytest.raises(FileFormatError, match=r"4096 x 4096 pixels, 24 bits each, in a file of 1000 bytes.* ffmpeg -i"):
        frames_beside(path, "hevc", 4096, 4096, 24)
    path.write_bytes(bytes(64 * 2**20))  # what is no bomb may take more
    assert frames_beside(path, "hevc", 4096, 4096, 24) >= 1


def test_a_header_of_odd_sizes_takes_no_memory(tmp_path: Path) -> None:
    """Every field of the header and of the stream's format at its ends."""
    path = tmp_path / "whole.avi"
    write_video([torch.zeros(2, 8, 8, dtype=torch.uint8)], path, 25.0)
    content = path.read_bytes()
    (tmp_path / "odd").mkdir()
    for number, data in enumerate(odd_headers(content)):
        (tmp_path / "odd" / f"{number}.avi").write_bytes(data)
    assert check_budget(read_folder, tmp_path / "odd").refused == ""


def read_folder(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        try:
            read_grey(path)
        except FileFormatError:
            continue


def odd_headers(content: bytes) -> Iterator[bytes]:
    for part in (b"avih", b"strh", b"strf"):
        first = content.index(part) + 8
        size = int.from_bytes(content[first - 4 : first], "little")
        for at in range(first, first + min(size, 64) - 3, 4):
            for value in (0, 0x7FFFFFFF, 0xFFFFFFFF):
                yield content[:at] + value.to_bytes(4, "little") + content[at + 4 :]
    yield content + riff_part(b"idx1", b"00dc" + b"\xff" * 12) * 3
