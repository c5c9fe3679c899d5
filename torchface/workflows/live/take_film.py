"""The camera's film of a take: written beside the session, and solved once more with all of its frames at once."""

import queue
import threading
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory
from warnings import catch_warnings, filterwarnings

import numpy as np

from torchface.files.temporary_files import temporary_name
from torchface.io.video.video_packets import pyav
from torchface.io.weights.live_link_csv import load_live_link
from torchface.take import Take

FILM = "film.mp4"

_TICKS = 90_000  # a second
_WAITING = 60  # pictures; of a disk or processor that is too slow those beyond are left out
_OPTIONS = {"preset": "ultrafast", "crf": "18"}


class TakeFilm:
    """A film that is written in a thread of its own, each picture at its time; nothing of it can end the session."""

    def __init__(self, path: Path) -> None:
        self.problem = ""
        self._path, self._temporary = path, temporary_name(path)
        self._waiting: queue.Queue[tuple[float, np.ndarray] | None] = queue.Queue(_WAITING)
        self._thread = threading.Thread(target=self._write, name="torchface-film", daemon=True)
        self._thread.start()

    def add(self, seconds: float, picture: np.ndarray) -> None:
        """Adds a picture, uint8 (H,W,3), red first, at a time of any clock."""
        with suppress(queue.Full):
            self._waiting.put_nowait((seconds, picture))

    def close(self) -> None:
        """Waits for what was added, and gives the film its name."""
        self._waiting.put(None)
        self._thread.join()
        with suppress(OSError):
            if self.problem:
                self._temporary.unlink()
            else:
                self._temporary.rename(self._path)

    def _write(self) -> None:
        try:
            self._encode()
        except Exception as error:  # FFmpeg's and the disk's have no common class; the take is complete without it
            self.problem = f"{self._path}: the film ends: {error}"
            while self._waiting.get() is not None:
                pass

    def _encode(self) -> None:
        first = self._waiting.get()
        if first is None:
            self.problem = f"{self._path}: no picture came"
            return
        (began, picture), av = first, pyav()
        height, width = (side - side % 2 for side in picture.shape[:2])
        with av.open(str(self._temporary), "w", format="mp4") as container:
            codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
            stream = container.add_stream(codec, rate=30, options=_OPTIONS if codec == "libx264" else {})
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.codec_context.time_base = Fraction(1, _TICKS)
            one: tuple[float, np.ndarray] | None = first
            before = -1
            while one is not None:
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(one[1][:height, :width]), "rgb24")
                frame.pts = before = max(before + 1, round(_TICKS * (one[0] - began)))
                frame.time_base = Fraction(1, _TICKS)
                container.mux(stream.encode(frame))
                one = self._waiting.get()
            container.mux(stream.encode(None))


def solved_again(film: Path) -> Take:
    """The take of a film, its head and all of its frames solved together, by ARKit's names."""
    from torchface.workflows.track.track_files import LIVE_LINK  # a session needs nothing of tracking
    from torchface.workflows.track.track_inputs import TrackSettings
    from torchface.workflows.track.track_video import track_video

    with TemporaryDirectory(prefix="torchface-") as folder, catch_warnings():
        filterwarnings("ignore", message=".*found a variable frame rate")  # a camera's times are never even
        track_video(film, None, Path(folder), TrackSettings(whole_take=True, overlay="none"))
        return load_live_link(Path(folder) / LIVE_LINK)
