"""Takes performed live and kept: frames logged as they come, then weights, Live Link Face CSV, animation, summary."""

import json
import math
import os
import shutil
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType, TracebackType

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError, TorchfaceError, ValueRangeError
from torchface.files.temporary_files import new_temporary, remove_left_over
from torchface.files.whole_files import all_or_none, make_folder, write_file
from torchface.files.write_errors import unwritten
from torchface.io.gltf.performance_animation import Performance, performed_glb
from torchface.io.weights.live_link_csv import save_live_link
from torchface.io.weights.weight_csv import ROTATIONS, save_weights_csv
from torchface.shape_names import ARKIT
from torchface.take import Take, Track
from torchface.workflows.browser_app.character import Character
from torchface.workflows.live.kept_takes import ANIMATION, LIVE_LINK, SUMMARY, WEIGHTS, printable
from torchface.workflows.live.live_frames import LiveFrame, Say
from torchface.workflows.live.take_film import FILM, TakeFilm
from torchface.workflows.live.take_times import take_times

_LOG = "frames"
_LOOK = 128  # frames between looks at how full the disk is
_RESERVE, _NUMBER_BYTES = (
    2**26,
    24,
)  # of the character in the animation; of a number as text, with its share of the rest


def _columns(names: Sequence[str]) -> int:
    return len(names) + len(ROTATIONS) + 2  # times and timecodes


class FrameLog:
    """A temporary file in a folder that exists, a row of numbers a frame; it goes when the log is closed."""

    def __init__(self, folder: Path, names: tuple[str, ...], columns: int | None = None) -> None:
        self.names, self.count = names, 0
        self.came = 0  # of these, how many somebody sent
        self._columns = _columns(names) if columns is None else columns
        numbers = (len(names),), (len(ROTATIONS),)
        times = ("time", "<f8"), ("sent", "<f8"), ("fresh", "<i4")  # all of a size that PyTorch can step by
        self._row = np.dtype([("weights", "<f4", *numbers[:1]), ("rotations", "<f4", *numbers[1:]), *times])
        self._first = 0.0
        try:
            handle, self._path = new_temporary(folder / _LOG)
        except OSError as error:
            raise unwritten(folder, error) from error
        self._file = os.fdopen(handle, "r+b", buffering=2**18)

    def append(
        self, came: float, weights: Tensor, rotations: Tensor, fresh: bool = True, sent: float = math.nan
    ) -> None:
        """Adds a frame: when it came in seconds of any clock, weights (N,), rotations (9,), and of what is received
        ``LiveFrame``'s fields."""
        if self.count % _LOOK == 0:
            self._check_room()
        if self.count == 0:
            self._first = came
        row = np.zeros(1, self._row)
        row["weights"], row["rotations"] = weights.detach().cpu().numpy(), rotations.detach().cpu().numpy()
        row["time"], row["sent"], row["fresh"] = came - self._first, sent, fresh
        try:
            self._file.write(row.tobytes())
        except OSError as error:
            raise unwritten(self._path, error) from error
        self.came += fresh
        self.count += 1  # last: of a frame at which an interrupt came in between nothing is read

    def _check_room(self) -> None:
        needed = _RESERVE + (self.count + 2 * _LOOK) * self._columns * _NUMBER_BYTES
        with suppress(OSError):  # a file system that does not say
            if (free := shutil.disk_usage(self._path.parent).free) < needed:
                raise FileFormatError(
                    f"{self._path.parent}: found {free / 1e6:,.0f} MB left, which the files of the {self.count} frames "
                    "so far may need; free some, or name a place on another disk"
                )

    def take(self, fps: float) -> Take:
        """The frames, as they lie on the disk: valid until the log is closed.

        Times and rate are those that a reader of any of its files finds. Frames of a time when nobody sent are left
        out; of a pause a few are kept, so that nothing moves towards what comes after it.

        Args:
            fps: the source's stated rate, which a take has whose times say nothing.
        """
        if self.count == 0:
            raise ValueRangeError("recording: found no frame, expected at least one")
        try:
            self._file.flush()
        except OSError as error:
            raise unwritten(self._path, error) from error
        rows = np.memmap(self._path, self._row, "c", shape=(self.count,))
        kept, fps, seconds = take_times(rows["time"], rows["fresh"] > 0, rows["sent"], fps)
        rows = rows if len(kept) == self.count else rows[kept]
        angles = torch.from_numpy(rows["rotations"].astype(np.float64))
        columns = {name: angles[:, i].clone() for i, name in enumerate(ROTATIONS)}
        track = Track(self.names, torch.from_numpy(rows["weights"])[..., None])
        return Take(fps, weights=track, extras={"columns": columns}, seconds=seconds)

    def close(self) -> None:
        """Deletes the file."""
        with suppress(OSError):  # of what could not be written nothing is kept
            self._file.close()
        with suppress(OSError):
            self._path.unlink()

    def __enter__(self) -> "FrameLog":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


_FORMAT = "torchface.live-summary/1"
_MAX_TAKES = 10_000


@dataclass(frozen=True)
class SavedTake:
    """One recording on the disk, or why it is not there; ``note`` says what is missing beside it."""

    folder: Path
    frames: int
    error: str = ""
    note: str = ""


class Recordings:
    """The takes of one session, in ``folder``, later ones in ``take_2`` of it; frames go to the disk as they come,
    files are made when a take ends."""

    def __init__(self, folder: Path, character: Character, source: str, fps: float) -> None:
        self._folder, self._given, self._source, self._fps = folder, character, source, fps
        self._character = character
        self._log: FrameLog | None = None
        self._film: TakeFilm | None = None
        self._place = folder
        self._begun: set[Path] = set()  # whose files may still be in the making
        self._began, self._found = 0.0, 0
        self._saving: list[threading.Thread] = []
        self.saved: list[SavedTake] = []

    @property
    def running(self) -> bool:
        """Whether frames are being kept."""
        return self._log is not None

    def seconds(self, now: float) -> float:
        """How long the take that runs is."""
        return now - self._began if self._log is not None and self._log.count else 0.0

    @property
    def frames(self) -> int:
        """How many frames of the take that runs have come."""
        return self._log.came if self._log is not None else 0

    @property
    def folder(self) -> Path:
        """Where the takes lie."""
        return self._folder

    def name_shapes(self, meanings: Mapping[str, str]) -> None:
        """Takes what names of the character's shapes mean, see :meth:`Character.renamed`."""
        self._character = self._given.renamed(meanings)

    def start(self, filmed: bool = False) -> Path:
        """Begins a take, maybe with the camera's film, and returns its folder, in which no take lies."""
        self._place = self._next()
        self._begun.add(self._place)
        self._log, self._found = self._new_log(self._place), 0
        self._film = TakeFilm(self._place / FILM) if filmed else None
        return self._place

    def keep(self, name: str, rows: Tensor) -> None:
        """Makes a take of rows (T,66): seconds, ARKit's weights, rotation and gaze."""
        if not len(rows) or not rows.isfinite().all() or not (rows[1:, 0] > rows[:-1, 0]).all():
            raise ValueRangeError("take: found times that do not rise, or no numbers, expected a take's rows")
        place = self._next()
        self._begun.add(place)
        with self._new_log(place) as log:
            for row in rows:  # as frames come
                rotation, gaze = row[53:62].reshape(3, 3), row[62:].reshape(2, 2)
                frame = LiveFrame(row[1:53].clamp(0, 1), rotation, torch.zeros(0, 2), gaze=gaze)
                log.append(float(row[0]), frame.weights, frame.rotations)
            self._write(log, place, len(rows), {"name": printable(name) or place.name})

    def _new_log(self, place: Path) -> FrameLog:
        columns = _columns(ARKIT) + 2 * _columns(self._character.names)  # Live Link, weights, animation
        return FrameLog(make_folder(place), ARKIT, columns)

    def add(self, came: float, frame: LiveFrame, picture: np.ndarray | None = None) -> None:
        """Keeps a frame, if a take runs, and its picture, if it is filmed."""
        if self._log is None:
            return
        if self._log.count == 0:
            self._began = came
        self._log.append(came, frame.weights, frame.rotations, frame.fresh, frame.sent)
        self._found += frame.seen and frame.fresh
        if self._film is not None and picture is not None:
            self._film.add(came, picture)

    def stop(self, say: Say | None = None) -> None:
        """Ends the take that runs; its files are made beside what goes on, and how that ends is said in another
        thread."""
        log, self._log = self._log, None
        film, self._film = self._film, None
        if log is None:
            return
        given = (log, self._place, self._found, film, say)
        thread = threading.Thread(target=self._save, args=given, name="torchface-recording")
        self._saving.append(thread)
        thread.start()

    def finish(self) -> list[SavedTake]:
        """Ends the take that runs and waits for all files; an interrupt meanwhile would lose them and is ignored."""
        with _no_interrupt():
            self.stop()
            for thread in self._saving:
                thread.join()
        return self.saved

    def _next(self) -> Path:
        remove_left_over(self._folder, _LOG)  # of sessions that were killed
        files = (SUMMARY, WEIGHTS, LIVE_LINK, ANIMATION)
        written = any((self._folder / name).exists() for name in files)
        written = written or any(self._folder.glob(f".{_LOG}.*"))  # by another session
        if self._folder not in self._begun and not written:
            return self._folder
        numbered = (self._folder / f"take_{number}" for number in range(2, _MAX_TAKES))
        return next(folder for folder in numbered if folder not in self._begun and not folder.exists())

    def _save(self, log: FrameLog, folder: Path, found: int, film: TakeFilm | None, say: Say | None) -> None:
        with log:
            try:
                if film is not None:  # before the summary, by which a take is listed
                    film.close()
                if log.count and found == 0:
                    none = f"found a face in none of its {log.came} frames" if log.came else "received no face"
                    raise ValueRangeError(f"{none}, expected one")
                frames, missing = self._write(log, folder, found) if log.count else (0, "")
                problems = [one for one in (missing, film.problem if film is not None else "") if one]
                self.saved.append(SavedTake(folder, frames, note="; ".join(problems)))
            except (TorchfaceError, OSError) as error:
                self.saved.append(SavedTake(folder, log.came, str(error)))
        if say is not None:
            done = self.saved[-1]
            say(done.error or f"recorded into {folder}: {done.frames} frames" + (f"; {done.note}" if done.note else ""))

    def _write(
        self, log: FrameLog, folder: Path, found: int, more: Mapping[str, str] = MappingProxyType({})
    ) -> tuple[int, str]:
        """Makes a take's files: how many frames they have, and why its animation is missing, where the others alone
        could be written."""
        take = log.take(self._fps)
        assert take.weights is not None
        driven = self._character.weights(take.weights.values[..., 0])
        moved = replace(take, weights=Track(self._character.names, driven[..., None]))
        summary = {
            "format": _FORMAT,
            "source": self._source,
            "character": self._character.name,
            "frames": len(take),
            "fps": round(take.fps, 3),
            "even": take.seconds is None,
            "seconds": round(float(take.times[-1]), 3),
            "found": found,
        }
        names, targets = self._character.targets(driven)
        turns = np.stack([take.extras["columns"][name].numpy() for name in ROTATIONS], 1)
        performance = Performance(take.times.numpy(), names, targets.numpy(), turns, take.fps)
        missing = ""
        for files in ([WEIGHTS, LIVE_LINK, ANIMATION], [WEIGHTS, LIVE_LINK]):
            try:
                with all_or_none():
                    save_weights_csv(moved, folder / WEIGHTS)
                    save_live_link(take, folder / LIVE_LINK)
                    if ANIMATION in files:
                        write_file(folder / ANIMATION, performed_glb(self._character.document, performance))
                    write_file(folder / SUMMARY, json.dumps({**summary, "files": files, **more}, indent=1).encode())
                break
            except TorchfaceError as error:  # on a full disk, or of a broken character, a take goes without animation
                if ANIMATION not in files:
                    raise
                missing = f"without {ANIMATION}: {error}"
        return len(take), missing


@contextmanager
def _no_interrupt() -> Iterator[None]:
    """Interrupts are ignored meanwhile, where this is the thread that gets them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
