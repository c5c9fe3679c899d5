"""Video files, a few frames at a time, grey or in colour."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError, ValueRangeError
from torchface.io.tables.frame_rates import COMMON_RATES
from torchface.io.video.numbered_pictures import film_of_pictures
from torchface.io.video.video_packets import (
    frames_beside,
    is_interlaced,
    key_frame_sizes,
    open_container,
    packets_of,
    pyav,
    quarter_turns,
    read_packets,
    reason,
    square_size,
    without_fields,
)
from torchface.number_checks import check_rate

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream

VIDEO_ENDINGS = (".avi", ".mkv", ".webm", ".mp4", ".mov", ".gif")
"""What films are called; :func:`open_video` goes by their content."""

_MAX_FRAMES = 2**31 - 1
_CHUNK_BYTES = 32 * 2**20
_WINDOW = 15
_PLAIN_FORMATS = ("yuv420p", "yuvj420p")
_MAX_RATE_CHANGE = 0.1
_ROUNDING = 0.0005  # seconds: Matroska counts whole milliseconds
_HOLE = 0.5  # frames by which a duration differs from the usual one
_MAX_MISSING = 0.01
_MAX_DEVIATION = 0.25  # a jitter of ±0.2 frames in the times makes 0.16 in the durations


@dataclass(frozen=True)
class VideoFile:
    """A video file: size, rate, number of frames, and access to the frames.

    Args:
        path: the file.
        fps: frames a second.
        width, height: pixels, upright and square: a phone's rotation and an anamorphic video's aspect are applied.
        count: frames that are shown; of a file that is cut off, those its header promises.
        even: whether frames must come at an even rate; else what reads them asks ``uneven_seconds`` when they come.
        pixel_aspect: how many times as wide as high the stored pixels are.
        interlaced: whether the header says that frames are stored as two fields; those that are given are whole.

    Example:
        >>> from torchface.io.video import write_video
        >>> video = write_video([torch.full((10, 16, 32), 0.5)], "grey.avi", fps=25.0)
        >>> video.width, video.height, video.count, video.fps
        (32, 16, 10, 25.0)
    """

    path: Path
    fps: float
    width: int
    height: int
    count: int
    even: bool = True
    pixel_aspect: float = 1.0
    interlaced: bool = False

    def uneven_seconds(self) -> tuple[Tensor | None, str]:
        """When each frame is shown, (count,) float64 from 0, and how the rate varies; None where it is even.

        Raises:
            FileFormatError: the rate varies, and times are missing or repeated.
        """
        seconds = read_packets(self.path).seconds
        changes = rate_changes(seconds, self.fps)
        if not changes:
            return None, ""
        if len(seconds) != self.count or not np.all(np.diff(seconds) > 0):  # NaN rises nowhere
            check_even_rate(self.path, seconds, self.fps)
        return torch.from_numpy(seconds - seconds[0]), changes

    def check(self) -> None:
        """Goes through the file, decoding key frames alone, and refuses what cannot become a take.

        ``chunks`` and ``color_chunks`` do so before their first frame.

        Raises:
            FileFormatError: frames change their size on the way, or come at a variable rate where it must be ``even``.
        """
        if self.even:
            check_even_rate(self.path, read_packets(self.path).seconds, self.fps)
        first: tuple[int, int] | None = None
        for seconds, width, height in key_frame_sizes(self.path):
            first = first or (width, height)
            if (width, height) != first:
                number = int((read_packets(self.path).seconds < seconds).sum())
                raise self._resized(number, width, height, *first)

    def chunks(self, frames: int = 64) -> Iterator[Tensor]:
        """The frames as uint8 tensors (t,H,W), up to ``frames`` at a time: fewer where they take more than 32 MiB.

        Raises:
            FileFormatError: the video ends before it should, changes its frames' size, or has a variable frame rate.
            ValueRangeError: ``frames`` is not positive.
        """
        yield from self._chunks(frames, (self.height, self.width), _grey_into)

    def color_chunks(self, frames: int = 16) -> Iterator[Tensor]:
        """The frames in colour as uint8 tensors (t,3,H,W), red first, up to ``frames`` at a time, as ``chunks``.

        Raises:
            FileFormatError: the video ends before it should, changes its frames' size, or has a variable frame rate.
            ValueRangeError: ``frames`` is not positive.
        """
        yield from self._chunks(frames, (3, self.height, self.width), _planes_into)

    def frames(self) -> Iterator[Tensor]:
        """The frames one by one, uint8 (H,W)."""
        for chunk in self.chunks(16):
            yield from chunk

    def color_frames(self) -> Iterator[Tensor]:
        """The frames in colour one by one, uint8 (3,H,W), red first; a pixel's colours lie side by side in memory."""
        return (torch.from_numpy(frame).permute(2, 0, 1) for frame in self._decoded())

    def frame(self, number: int) -> Tensor:
        """One frame, uint8 (H,W).

        Raises:
            ValueRangeError: the video is shorter.
        """
        if not 0 <= number < self.count:
            raise ValueRangeError(f"{self.path}: asked for frame {number}, found {self.count} frames")
        for i, frame in enumerate(self.frames()):  # codecs seek wrongly too often to jump there
            if i == number:
                return frame
        raise ValueRangeError(f"{self.path}: asked for frame {number}, found fewer")

    def _chunks(
        self, most: int, shape: tuple[int, ...], fill: Callable[[np.ndarray, np.ndarray], None]
    ) -> Iterator[Tensor]:
        """Up to ``most`` frames together and as many of this shape as 32 MiB hold, each copied to where it stays."""
        if most < 1:
            raise ValueRangeError(f"frames: found {most}, expected at least 1")
        size = max(1, min(most, _CHUNK_BYTES // math.prod(shape)))
        decoded = self._decoded()
        while True:
            chunk, count = np.empty((size, *shape), np.uint8), 0
            for count, frame in enumerate(islice(decoded, size), 1):  # a decoder gives one frame at a time
                fill(frame, chunk[count - 1])
            if count:
                yield torch.from_numpy(chunk[:count])
            if count < size:
                return

    def _decoded(self) -> Iterator[np.ndarray]:
        """Checked frames, red first, (H,W,3)."""
        self.check()
        count, errors = 0, list[str]()
        with open_container(self.path) as (container, stream):
            for frame in _rgb_frames(container, stream, errors):
                if frame.shape[:2] != (self.height, self.width):
                    raise self._resized(count, frame.shape[1], frame.shape[0], self.width, self.height)
                count += 1
                yield frame
        # Recordings that were cut lose a frame or two at their ends.
        if count == 0 or self.count - count > 1 + (0 if errors else 0.01 * self.count):
            raise FileFormatError(
                f"{self.path}: {count} frames could be decoded, expected {self.count}: the file is cut off or "
                f"damaged{''.join(errors[:1])}"
            )

    def _resized(self, number: int, width: int, height: int, first_width: int, first_height: int) -> FileFormatError:
        return FileFormatError(
            f"{self.path}: frame {number} is {width} x {height} pixels, expected {first_width} x {first_height} as the "
            f"first. To convert it: ffmpeg -i {self.path.name} -vf scale={first_width}:{first_height} "
            f"{self.path.stem}_even.mp4"
        )


def open_video(path: str | Path) -> VideoFile:
    """Opens a video, counts its frames and decodes the first one, so that a bad file is refused at once.

    Args:
        path: an ``.avi``, ``.mkv``, ``.webm``, ``.mp4``, ``.mov`` or ``.gif`` file; recognised by its content.

    Raises:
        FileFormatError: the file is missing, no video, of a codec that is not there, or claims absurd sizes.

    Example:
        >>> from torchface.io.video import write_video
        >>> _ = write_video([torch.zeros(10, 16, 32)], "black.avi", fps=25.0)
        >>> sum(int(frame.max()) for frame in open_video("black.avi").frames())
        0
    """
    path = Path(path)
    if path.is_dir():
        raise FileFormatError(f"{path}: found a folder, expected a video{film_of_pictures(path)}")
    packets = read_packets(path)
    with open_container(path) as (container, stream):
        rates = [float(rate) for rate in (stream.average_rate, stream.guessed_rate, stream.base_rate) if rate] or [0.0]
        times = packets.seconds[np.isfinite(packets.seconds)]
        spacing = float(np.diff(times).mean()) if len(times) > 1 else 0.0
        # The average in the header counts frames that an edit list hides.
        fps = check_rate(min(rates, key=lambda rate: abs(rate * spacing - 1)), str(path))
        errors: list[str] = []
        frame = next(_rgb_frames(container, stream, errors), None)
        if frame is None:
            raise FileFormatError(
                f"{path}: no frame can be decoded{''.join(errors[:1])}; expected a video of a codec that FFmpeg knows"
            )
        aspect, fields = float(stream.sample_aspect_ratio or 1), is_interlaced(stream)
        # Some containers have the length of the film alone, with its sound and what lies before its first frame.
        missing = (container.duration or 0) / pyav().time_base - packets.end
        declared = stream.frames or len(packets.seconds) + packets.hidden + round(max(missing, 0.0) * fps)
    whole = len(packets.seconds) + packets.hidden >= 0.99 * declared - 1
    count = len(packets.seconds) if whole else declared - packets.hidden
    if not 1 <= count <= _MAX_FRAMES:
        raise FileFormatError(f"{path}: its header says {count} frames, expected a positive number")
    return VideoFile(path, fps, frame.shape[1], frame.shape[0], count, pixel_aspect=aspect, interlaced=fields)


def _rgb_frames(container: "InputContainer", stream: "VideoStream", errors: list[str]) -> Iterator[np.ndarray]:
    """Upright frames (H,W,3) of the packets that can be decoded; what is wrong with the others goes to ``errors``."""
    av, path, codec = pyav(), Path(container.name), stream.codec_context.name
    reformatter, ways = av.video.reformatter.VideoReformatter(), av.video.reformatter.Interpolation

    def decoded() -> Iterator["VideoFrame"]:
        for packet in packets_of(container, stream, errors):  # a decoder takes one packet at a time
            try:
                for frame in stream.decode(packet):
                    frames_beside(path, codec, frame.width, frame.height, frame.format.padded_bits_per_pixel)
                    yield frame
            except (av.FFmpegError, ValueError) as error:
                errors.append(f" ({reason(error)})")

    for frame in without_fields(stream, decoded(), errors):
        width, height = square_size(path, stream, frame.width, frame.height)
        even = (width, height) == (frame.width, frame.height) and width % 2 == height % 2 == 0
        # Of such frames both ways give the same bytes, this one in a quarter of the time.
        way = ways.POINT if even and frame.format.name in _PLAIN_FORMATS else ways.BICUBIC
        try:
            rgb = reformatter.reformat(frame, width, height, format="rgb24", interpolation=way).to_ndarray()
        except (av.FFmpegError, ValueError) as error:
            errors.append(f" ({reason(error)})")
            continue
        yield np.ascontiguousarray(np.rot90(rgb, quarter_turns(frame)))


def _grey_into(frame: np.ndarray, target: np.ndarray) -> None:
    cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY, dst=target)


def _planes_into(frame: np.ndarray, target: np.ndarray) -> None:
    cv2.split(frame, list(target))


def check_even_rate(path: Path, seconds: np.ndarray, fps: float) -> None:
    """Refuses a video of variable frame rate, where what reads it counts in frames of one length."""
    changes = rate_changes(seconds, fps)
    if changes:
        usual = float(np.median(np.diff(np.unique(seconds[np.isfinite(seconds)]))))
        rate = min(COMMON_RATES, key=lambda other: abs(other - 1 / usual))
        raise FileFormatError(
            f"{path}: found a variable frame rate: {changes}; expected an even rate. "
            f"To convert it: ffmpeg -i {path.name} -vf fps={rate:.5g} {path.stem}_even.mp4"
        )


def rate_changes(seconds: np.ndarray, fps: float) -> str:
    """How a video's frame rate varies, in words; empty where it is even.

    Phone cameras jitter by some milliseconds and lose a frame now and then: that passes. What does not: a rate that
    changes by more than a tenth, averaged over fifteen frames, durations that deviate by more than a quarter (root mean
    square), and holes in which more than one frame in a hundred is missing.
    """
    durations = np.diff(np.unique(seconds[np.isfinite(seconds)]))
    if len(durations) < 3:
        return ""
    usual = float(np.median(durations))
    holes = np.abs(durations / usual - 1) > _HOLE
    usual = float(durations[~holes].mean())
    missing = int(np.maximum(np.rint(np.abs(durations[holes] / usual - 1)), 1).sum())
    window = min(_WINDOW, len(durations))
    means = np.convolve(np.where(holes, usual, durations), np.full(window, 1 / window), mode="valid")
    allowed = _MAX_RATE_CHANGE * usual + _ROUNDING
    deviation = float(np.sqrt(np.mean((durations[~holes] / usual - 1) ** 2)))
    if missing > 1 + _MAX_MISSING * len(durations):
        what = f"{int(holes.sum())} of {len(durations)} last more than half a frame longer or shorter"
    elif deviation > _MAX_DEVIATION:
        what = f"they differ by {100 * deviation:.0f} %"
    elif means.max() - means.min() > allowed:
        worst = int(np.abs(means - usual).argmax())
        what = f"from frame {worst} to {worst + window} they last {1000 * means[worst]:.1f} ms each"
    elif abs(float(durations.mean()) - 1 / fps) > allowed:
        what = f"its header says {fps:g} frames a second"
    else:
        return ""
    return (
        f"frames last {1000 * usual:.1f} ms as a rule, but {what} "
        f"({1000 * durations.min():.1f} to {1000 * durations.max():.1f} ms)"
    )
