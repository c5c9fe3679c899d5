"""Anybody before a camera: frames are solved, sent, recorded and shown, until it ends."""

from __future__ import annotations

import threading
import time
from collections import deque

import numpy as np

from torchface.capture.anybody import WebcamControls
from torchface.errors import FileFormatError
from torchface.progress import Progress, silent
from torchface.viz.browser.live_view import LiveView
from torchface.workflows.live.live_figures import LiveFigures
from torchface.workflows.live.live_frames import FaceSolver, FrameSource, LiveFrame, Say, solved_frames
from torchface.workflows.live.recordings import Recordings
from torchface.workflows.live.session_prompts import GuidedCalibration, Watch
from torchface.workflows.live.weight_streams import WeightStreams

_MAX_NOTES = 20
_FIGURES_INTERVAL = 0.25  # seconds


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
        source: of frames.
        solver: by ARKit's names.
        streams: where weights are sent to.
        recordings: what keeps them when asked to.
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
        self._source, self._solver, self._streams = source, solver, streams
        self._recordings, self._notes, self._prompt, self._watch = recordings, notes, prompt, watch
        self._calibration: GuidedCalibration | None = None
        self._forget = False
        self._prompted = ""
        self._recent, self._recent_at = (0.0, 0.0), float("-inf")
        self._view: LiveView | None = None
        self._lock = threading.RLock()

    def view(self) -> LiveView | None:
        """The newest moment; None before the first frame."""
        return self._view

    def calibrate(self) -> None:
        """Begins a guided calibration."""
        self._calibration = GuidedCalibration()

    def reset(self) -> None:
        """Has the solver forget the person."""
        self._forget, self._calibration = True, None

    def record(self, on: bool) -> str:
        """Begins or ends a recording; says in words what happened.

        Raises:
            FileFormatError: nothing can be written there.
        """
        with self._lock:
            if on == self._recordings.running:
                return "already recording" if on else "nothing is being recorded"
            if on:
                return f"recording into {self._recordings.start()}"
            self._recordings.stop()
            return "recorded; its files are being written"

    def run(self, seconds: float | None = None, progress: Progress | None = None) -> None:
        """Goes through the frames until they or the seconds end, or an interrupt comes.

        Args:
            seconds: after which it ends.
            progress: called with the number of frames.
        """
        progress, before = progress or silent, None
        try:
            for came, picture, solved in solved_frames(self._source, self._solver, self._controls):
                rotations = solved.rotations
                self._streams.send(solved.weights, rotations)
                now = time.perf_counter()
                self.figures.add(came, now, solved.seen)
                self._keep(came, solved)
                self._advance(0.0 if before is None else came - before, solved.seen)
                before = came
                if self._watch is not None:
                    self._watch.look(picture, solved.seen, now)
                self._view = self._moment(picture, solved, now)
                progress("live", self.figures.frames)
                if seconds is not None and self.figures.seconds >= seconds:
                    break
        except KeyboardInterrupt:  # how people end what has no end of its own
            pass

    def _controls(self) -> WebcamControls:
        forget, self._forget = self._forget, False
        pose = 0 if self._calibration is None else self._calibration.pose
        return WebcamControls(pose, self.gain, self.smoothing, reset=forget)

    def _keep(self, came: float, solved: LiveFrame) -> None:
        with self._lock:
            try:
                self._recordings.add(came, solved)
            except FileFormatError as error:  # a full disk ends the recording and not the session
                self._recordings.stop()
                self._notes(f"the recording ended: {error}")

    def _advance(self, interval: float, seen: bool) -> None:
        calibration = self._calibration
        if calibration is None:
            return
        words = calibration.words
        if words != self._prompted:
            self._prompted = words
            self._prompt(words)
        after = calibration.after(interval, seen)
        if self._calibration is calibration:  # else the page has begun another meanwhile
            self._calibration = after
        if after is None:
            self._prompted = ""
            self._prompt("Calibrated: thank you")

    def _moment(self, picture: np.ndarray, solved: LiveFrame, now: float) -> LiveView:
        if now - self._recent_at > _FIGURES_INTERVAL:
            self._recent, self._recent_at = self.figures.recent(), now
        calibration, (fps, latency) = self._calibration, self._recent
        return LiveView(
            picture,
            solved.landmarks,
            solved.iris,
            solved.weights,
            solved.rotation,
            solved.seen,
            self._watch.words if self._watch is not None else "",
            fps,
            latency,
            solved.calibrated,
            "" if calibration is None else calibration.words,
            0.0 if calibration is None else calibration.left,
            self._recordings.seconds(now) if self._recordings.running else None,
            self._notes.kept(),
        )
