"""Anybody before a camera: frames are solved, sent, recorded and shown, until it ends."""

import threading
import time
from collections import deque
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchface.capture.anybody import WebcamControls
from torchface.errors import FileFormatError, TorchfaceError, ValueRangeError
from torchface.progress import Progress, silent
from torchface.workflows.live.kept_takes import film_of, kept_takes, remove_take, rename_take, take_rows
from torchface.workflows.live.live_figures import LiveFigures
from torchface.workflows.live.live_frames import FaceSolver, FrameSource, LiveFrame, Say, solved_frames
from torchface.workflows.live.live_view import LiveView
from torchface.workflows.live.received_source import ReceivedSource
from torchface.workflows.live.recordings import Recordings
from torchface.workflows.live.session_prompts import GuidedCalibration, Watch
from torchface.workflows.live.take_film import solved_again
from torchface.workflows.live.weight_controls import WeightControls, read_weight_settings
from torchface.workflows.live.weight_streams import WeightStreams

_MAX_NOTES = 20
_SHOWN_NOTES = 3
_TAKES_INTERVAL = 1.0  # seconds


class Notes:
    """Notes for the user: each is said at once, the last few are kept."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self._kept: deque[str] = deque(maxlen=_MAX_NOTES)

    def __call__(self, note: str) -> None:
        """Says and keeps a sentence."""
        self._kept.append(note)
        self._say(note)

    def kept(self) -> tuple[str, ...]:
        """The last few, newest last."""
        return tuple(self._kept)


class LiveSession:
    """The loop over frames, and what a page may ask of it meanwhile.

    Args:
        notes: called with what the user should know.
        prompt: called with what a guided calibration asks for, each time that changes.
        watch: says what the user should know of the source.
    """

    def __init__(
        self,
        source: FrameSource,
        solver: FaceSolver,
        streams: WeightStreams,
        recordings: Recordings,
        notes: Notes,
        prompt: Say,
        watch: Watch | None = None,
    ) -> None:
        self.gain, self.smoothing = 1.0, 0.5
        self.figures = LiveFigures()
        self.ended = ""
        self.guided = False
        self._source, self._solver, self._streams = source, solver, streams
        self._recordings, self._notes, self._prompt, self._watch = recordings, notes, prompt, watch
        self._weights = WeightControls()
        self._calibration: GuidedCalibration | None = None
        self._pose = 0
        self._forget = False
        self._prompted = ""
        self._view: LiveView | None = None
        self._changed = threading.Condition()
        self._takes: tuple[float, list[dict[str, Any]]] = (float("-inf"), [])
        self._lock = threading.RLock()
        self._solving: threading.Thread | None = None
        self._closing = False

    def next_view(self, before: LiveView | None, seconds: float) -> LiveView | None:
        """The newest moment once there is another than ``before``; None where none came in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._view is not before, seconds)
            return self._view if self._view is not before else None

    def state(self) -> dict[str, Any]:
        """What the page shows beside the frames."""
        recordings = self._recordings
        running = recordings.running
        recording = (
            {"seconds": recordings.seconds(time.perf_counter()), "frames": recordings.frames} if running else None
        )
        return {
            "words": "" if self._watch is None else self._watch.words,
            "notes": self._notes.kept()[-_SHOWN_NOTES:],
            "recording": recording,
            "takes": self._listed(),
            "ended": self.ended,
            "calibrate": self._guided(),
        }

    def _guided(self) -> bool:
        asked, self.guided = self.guided, False
        return asked

    def _listed(self) -> list[dict[str, Any]]:
        at, takes = self._takes
        if time.monotonic() - at > _TAKES_INTERVAL:
            takes = [take.fields() for take in kept_takes(self._recordings.folder)]
            self._takes = time.monotonic(), takes
        return takes

    def asked(self, message: Mapping[str, Any]) -> None:
        """Does what a page asks for: `controls`, `reset`, `record`, `rename`, `remove`, `solve` or `names`."""
        try:
            if "controls" in message:
                self._set(message["controls"])
            if message.get("reset") is True:
                self.reset()
            if isinstance(on := message.get("record"), bool):
                self.record(on, message.get("film") is True)
            if isinstance(names := message.get("names"), dict):
                self._recordings.name_shapes({str(name): str(arkit) for name, arkit in names.items()})
            folder, forgotten = self._recordings.folder, float("-inf")
            if isinstance(names := message.get("rename"), list) and len(names) == 2:
                rename_take(folder, str(names[0]), str(names[1]))
                self._takes = forgotten, []
            if isinstance(place := message.get("remove"), str):
                remove_take(folder, place)
                self._takes = forgotten, []
            if isinstance(place := message.get("solve"), str):
                self._solve(film_of(folder, place), place)
        except TorchfaceError as error:
            self._notes(str(error))
            raise

    def keep(self, name: str, rows: np.ndarray) -> None:
        """Keeps a take that a page has made or was given, rows (T,66)."""
        try:
            self._recordings.keep(name, torch.from_numpy(rows.copy()))
        except TorchfaceError as error:
            self._notes(str(error))
            raise

    def _solve(self, film: Path, place: str) -> None:
        """Solves a film in a process of its own, beside what goes on."""
        if self._closing:
            raise ValueRangeError("solve again: found a session that is ending, expected one that goes on")
        if self._solving is not None and self._solving.is_alive():
            raise ValueRangeError("solve again: found a film that is being solved, expected one at a time")
        name = next((take.name for take in kept_takes(self._recordings.folder) if take.place == place), place)
        self._notes(f"{name}: being solved once more, with the whole take; this takes some minutes")

        def solve() -> None:
            try:
                with ProcessPoolExecutor(1, get_context("spawn")) as process:
                    rows = process.submit(solved_again, film).result()
                self.keep(f"{name}, solved again", take_rows(rows).float().numpy())
                self._notes(f"{name}: solved again")
            except (TorchfaceError, OSError, BrokenProcessPool) as error:
                why = "torchface ended before; its film stays with it" if self._closing else error
                self._notes(f"{name}: not solved again: {why}")

        self._solving = threading.Thread(target=solve, name="torchface-solve-again", daemon=True)
        self._solving.start()

    def close(self) -> None:
        """Breaks off the solve of a film, which may have minutes to go."""
        self._closing = True
        while self._solving is not None and self._solving.is_alive():  # it may not have begun its process yet
            for process in active_children():
                process.kill()
            self._solving.join(0.1)

    def left(self) -> None:
        """The page was closed that has asked for a pose."""
        self._pose = 0

    def _set(self, controls: object) -> None:
        solver = controls.get("solver") if isinstance(controls, dict) else None
        weights = controls.get("weights") if isinstance(controls, dict) else None
        if not isinstance(solver, dict) or not isinstance(weights, dict) or not isinstance(controls, dict):
            raise ValueRangeError("page: found controls without solver and weights, expected both")
        checked = WebcamControls(solver.get("pose"), solver.get("gain"), solver.get("smoothing"))  # type: ignore[arg-type]
        self._weights.settings = read_weight_settings(weights)
        self._pose, self.gain, self.smoothing = checked.pose, checked.gain, checked.smoothing

    def calibrate(self) -> None:
        """Begins a guided calibration."""
        self._calibration = GuidedCalibration()

    def reset(self) -> None:
        """Has the solver forget the person."""
        self._forget, self._calibration = True, None

    def record(self, on: bool, filmed: bool = False) -> None:
        """Begins or ends a recording, with the camera's film if asked; notes in words what happens."""
        with self._lock:
            if on == self._recordings.running:
                self._notes("already recording" if on else "nothing is being recorded")
            elif on:
                seen = filmed and not isinstance(self._source, ReceivedSource)  # which has no pictures
                self._notes(f"recording into {self._recordings.start(filmed=seen)}")
            else:
                self._notes("recorded; its files are being written")  # first: short takes are written at once
                self._recordings.stop(self._notes)

    def run(self, seconds: float | None = None, progress: Progress | None = None) -> None:
        """Goes through the frames until they or the seconds end, or an interrupt comes."""
        progress, before = progress or silent, None
        try:
            for came, picture, solved in solved_frames(self._source, self._solver, self._controls):
                wanted = self._weights.apply(solved, None if before is None else came - before)
                self._streams.send(wanted.weights, wanted.rotations)
                now = time.perf_counter()
                given = came + self._source.late
                self.figures.add(given, now, solved.seen, solved.fresh)
                interval = 0.0 if before is None else came - before
                with self._changed:
                    shown = picture if solved.drawn is None else solved.drawn
                    self._view = LiveView(given, interval, 1000 * (now - given), shown, wanted)
                    self._changed.notify_all()
                self._keep(came, wanted, picture)
                self._advance(interval, solved)
                before = came
                if self._watch is not None:
                    self._watch.look(picture, solved, now)
                progress("frames solved live", self.figures.frames)
                if seconds is not None and self.figures.seconds >= seconds:
                    self.ended = f"The {seconds:g} seconds are over"
                    break
            else:
                self.ended = f"{self._source.video.path.name} has ended after {self.figures.frames} frames"
            self._notes(self.ended)
        except KeyboardInterrupt:  # how people end what has no end of its own
            pass

    def _controls(self) -> WebcamControls:
        forget, self._forget = self._forget, False
        pose = self._pose if self._calibration is None else self._calibration.pose
        return WebcamControls(pose, self.gain, self.smoothing, reset=forget)

    def _keep(self, came: float, solved: LiveFrame, picture: np.ndarray) -> None:
        with self._lock:
            try:
                self._recordings.add(came, solved, picture)
            except FileFormatError as error:  # a full disk ends the recording and not the session
                self._notes(f"the recording ended: {error}")
                self._recordings.stop(self._notes)

    def _advance(self, interval: float, solved: LiveFrame) -> None:
        calibration = self._calibration
        if calibration is None:
            return
        words = calibration.words
        if words != self._prompted:
            self._prompted = words
            self._prompt(words)
        after = calibration.after(interval, solved)
        if self._calibration is calibration:  # else the page has begun another meanwhile
            self._calibration = after
        if after is None:
            self._prompted = ""
            self._prompt(calibration.result)
