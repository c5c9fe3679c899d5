"""An actor before a camera: landmarks, pose and the weights of the actor's own rig frame by frame, sent on."""

import time
from collections.abc import Sequence
from contextlib import closing, nullcontext
from pathlib import Path

import numpy as np
import torch

from torchface.capture.anybody import WebcamControls
from torchface.capture.anybody.eye_signals import EyeSignals, EyesRead, eye_signals
from torchface.capture.own_rig import VideoState
from torchface.capture.own_rig.eye_geometry import Eyeballs, seen_gaze
from torchface.capture.own_rig.face_points import LANDMARKS
from torchface.capture.own_rig.landmark_offsets import LandmarkOffsets
from torchface.capture.own_rig.outlier_landmarks import landmark_reach, outlier_landmarks
from torchface.capture.own_rig.take_eyes import TakeEyes
from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.whole_files import all_or_none, make_folder
from torchface.geometry.cameras.distortion import undistort
from torchface.io.protocols.weight_sender import find_receiver
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.tracking.landmark_tracker import LandmarkTracker
from torchface.number_checks import checked_number
from torchface.progress import Progress, silent
from torchface.temporal.adaptive_kalman import LANDMARK_SETTINGS, AdaptiveFilter
from torchface.workflows.live.live_figures import LiveFigures, LiveReport
from torchface.workflows.live.live_frames import LiveFrame, open_source, planes, solved_frames
from torchface.workflows.live.recordings import FrameLog
from torchface.workflows.live.weight_streams import WeightStreams
from torchface.workflows.named_finders import graph_detector
from torchface.workflows.track.take_measurements import measured_trust, measuring_solver, take_measurements
from torchface.workflows.track.take_solution import OFFSETS, eye_depth, eye_rays, lid_looks, offsets_of, with_eyes
from torchface.workflows.track.track_files import save_curves
from torchface.workflows.track.track_inputs import TrackInputs, TrackSettings, inputs_of, load_actor

_MIN_LANDMARKS = 6
_OPENNESS_NOISE = 0.1  # beside the open eye's


class ActorSolver:
    """Landmarks, pose and weights one frame at a time.

    Args:
        offsets: between the rig's landmarks and those that the models find.
    """

    def __init__(self, inputs: TrackInputs, offsets: LandmarkOffsets | None = None) -> None:
        self.names, models = inputs.actor.names, inputs.models
        if models.finder is None:
            raise ValueRangeError("--landmarks: found a table, expected what finds landmarks as the face moves")
        self._tracker = LandmarkTracker(models.finder, models.appearance, graph_detector(), inputs.settings.face)
        self._calibration, self._filter = inputs.calibration, AdaptiveFilter(68, 2, LANDMARK_SETTINGS)
        self._inputs, self._eyeballs = inputs, Eyeballs.of(inputs.actor)
        solver = inputs.solver()
        solver = solver if offsets is None else solver.shifted(offsets)
        self._solver, self._measuring = solver, measuring_solver(solver)
        self._looking, self._usual = lid_looks(solver)
        self._state: VideoState | None = None
        self._eyes = EyeSignals.start()
        # What runs for the first time takes a quarter of a second, in which a camera's frames would be lost.
        head = solver.rest[:LANDMARKS].double() * torch.tensor([1.0, -1.0, -1.0]) + torch.tensor([0.0, 0.0, 600.0])
        pixels = head @ inputs.calibration.intrinsics.double().T
        self._measuring.step(solver.start(), (pixels[:, :2] / pixels[:, 2:]).float())
        self._tracker.detector(torch.zeros(3, 128, 128, dtype=torch.uint8))
        self._reach = landmark_reach(inputs.actor)

    def step(self, picture: np.ndarray, interval: float | None, controls: WebcamControls) -> LiveFrame:
        """Solves the next frame; before the first face all weights are 0. Of an actor nothing is learned on the way."""
        reading = self._tracker.step(planes(picture))
        outliers = outlier_landmarks(*self._reach, reading.landmarks[None], reading.trust[None])[0]
        reading = reading.doubted(outliers)
        trust = reading.trust
        landmarks = self._filter.step(undistort(reading.trusted_landmarks, self._calibration)).to(reading.landmarks)
        enough = int((torch.isfinite(landmarks).all(1) & (trust > 0)).sum()) >= _MIN_LANDMARKS
        if self._state is None and not enough:
            return LiveFrame(torch.zeros(len(self.names)), torch.full((3, 3), torch.nan), reading.landmarks)
        before, solver = self._state or self._solver.start(), self._solver
        take = FaceReading.stacked([reading])
        measured = take_measurements(self._inputs, solver, take)
        if measured is not None:
            solver, trust = self._measuring, measured_trust(landmarks[None], take)[0]
        if enough and bool(torch.isfinite(take.openness).any()):
            # Where the head was a frame ago; of a face that has just come, where its landmarks alone put it.
            head = before if before.solved else solver.step(before, landmarks, None, None, trust, interval, measured)
            seen = self._seen_eyes(take, head, interval or 1 / self._inputs.clip.fps)
            measured = with_eyes(self._inputs, solver, measured, seen)
        self._state = solver.step(before, landmarks, None, None, trust, interval, measured)
        weights, rotation = self._state.weights.detach().float(), self._state.rotation.detach().float()
        return LiveFrame(weights, rotation, reading.landmarks)

    def _seen_eyes(self, take: FaceReading, head: VideoState, interval: float) -> TakeEyes:
        """The eyes of a take of one frame, (1,...), beside what was learned of them until then, as ``live`` does."""
        rotation, translation = head.rotation[None].double(), head.translation[None].double()
        depth = eye_depth(self._solver, rotation, translation)
        rays, iris = eye_rays(take, self._calibration)
        gaze = seen_gaze(rays, iris, rotation, depth, self._eyeballs)[0]
        read = EyesRead(*(one[0].double() for one in (take.openness, take.closed, take.eye_visibility)))
        asked, learns = torch.zeros(()).double(), torch.ones(()).double()
        since = torch.tensor(interval).double()
        eyes = eye_signals(read, gaze, self._usual, self._looking, self._eyes, since, asked, learns)
        self._eyes = eyes
        off = _OPENNESS_NOISE / eyes.open_trust.sqrt()
        return TakeEyes(
            eyes.open[None], off[None], take.closed, eyes.gaze[None], eyes.gaze_trust[None], torch.ones(1, 2)
        )


_DEFAULT = TrackSettings()


def track_live(
    camera: str,
    rig: Path,
    addresses: Sequence[str],
    out: Path | None = None,
    settings: TrackSettings = _DEFAULT,
    seconds: float | None = None,
    progress: Progress | None = None,
) -> LiveReport:
    """Solves what a camera sees and sends it, until it ends or is interrupted.

    Args:
        camera: a device's number, or a video file, which is played at its own rate.
        addresses: see :func:`torchface.io.open_sender`.
        out: a folder for the curves of what was sent; none are kept without.
        seconds: after which it ends; until it is interrupted (Ctrl-C) or the video ends if absent.
        progress: called with the number of frames sent.
    """
    progress, notes = progress or silent, list[str]()
    for address in addresses:
        find_receiver(address)
    if seconds is not None:
        checked_number("seconds", seconds, above=True)
    actor = load_actor(rig, settings.part)
    figures = LiveFigures()
    with closing(open_source(camera, notes.append)) as source:
        inputs = inputs_of(source.video, actor, settings)
        known = settings.offsets or (None if out is None or not (out / OFFSETS).is_file() else out / OFFSETS)
        offsets = None if known is None else offsets_of(known, inputs)
        solver = ActorSolver(inputs, offsets)
        log = running = None if out is None else FrameLog(make_folder(out), actor.names)
        with (
            log or nullcontext(),
            WeightStreams(addresses, actor.names, source.video.fps, lambda note: None) as streams,
        ):
            try:
                for came, _, solved in solved_frames(source, solver):
                    streams.send(solved.weights, solved.rotations)
                    figures.add(came, time.perf_counter(), solved.seen)
                    if running is not None:
                        try:
                            running.append(came, solved.weights, solved.rotations)
                        except FileFormatError as error:  # a full disk ends the curves and not the stream
                            notes.append(f"the curves end at frame {running.count}: {error}")
                            running = None
                    progress(f"sending to {', '.join(addresses)}", figures.frames)
                    if seconds is not None and figures.seconds >= seconds:
                        break
            except KeyboardInterrupt:  # how people end what has no end of its own
                pass
            if figures.frames == 0:
                raise ValueRangeError(f"camera {camera}: found no frame, expected at least one")
            if log is not None and out is not None:
                with all_or_none():
                    save_curves(log.take(source.video.fps), out)
            return LiveReport(figures, source.dropped, (*notes, *streams.notes()))
