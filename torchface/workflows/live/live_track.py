"""A face before a camera, solved frame by frame as it moves, and sent on."""

from __future__ import annotations

import re
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.video import VideoState
from torchface.capture.video.landmark_offsets import LandmarkOffsets
from torchface.capture.video.landmark_smoothing import LandmarkFilter
from torchface.errors import ValueRangeError
from torchface.files.whole_files import all_or_none, make_folder
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.distortion import undistort
from torchface.io.weights.udp_sending import find_receiver
from torchface.io.weights.weight_senders import open_sender
from torchface.landmarks.images.landmark_finder import trust_of
from torchface.landmarks.images.tracking import LandmarkTracker
from torchface.number_checks import checked_number
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track
from torchface.workflows.live.live_frames import Camera, PlayedVideo
from torchface.workflows.track.head_rotations import head_angles, rotation_columns
from torchface.workflows.track.track_files import OFFSETS, save_curves
from torchface.workflows.track.track_models import TrackModels, load_track_models
from torchface.workflows.track.track_video import TrackSettings, camera_of, load_actor, offsets_of, solver_for

_MIN_LANDMARKS = 6
_SHORTEST = 1e-3  # seconds between frames
_EYE_ANGLES = 6
_DEFAULT = TrackSettings()


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """One frame as it was solved.

    Args:
        weights: (N,).
        rotation: of the head, rig to camera, (3,3).
        landmarks: (68,2), pixels; NaN where the face is lost.
    """

    weights: Tensor
    rotation: Tensor
    landmarks: Tensor


@dataclass(frozen=True, eq=False)
class LiveReport:
    """What was sent.

    Args:
        weights: (T,N).
        found: frames with a face, (T,) bool.
        latency: from a frame's arrival to its packet on the way, (T,), milliseconds.
        dropped: frames that came while another was solved.
        fps: frames a second, as they came.
        path: of the curves, where they were kept.
    """

    weights: Tensor
    found: Tensor
    latency: Tensor
    dropped: int
    fps: float
    path: Path | None = None

    def lines(self) -> list[str]:
        """For people to read."""
        count = len(self.weights)
        return [
            f"{count} frames sent at {self.fps:.1f} a second, a face in {int(self.found.sum())}",
            f"{float(self.latency.median()):.1f} ms from frame to packet (99th percentile "
            f"{float(self.latency.quantile(0.99)):.1f} ms), {self.dropped} frames came too early and were left out",
        ]


class LiveSolver:
    """Landmarks, pose and weights one frame at a time.

    Args:
        rig: the actor's, with its 68 landmarks.
        models: what tracks and solves.
        calibration: of the camera.
        face: number of the face, the largest first.
        offsets: between the rig's landmarks and those that the models find.
    """

    def __init__(
        self,
        rig: BlendshapeRig,
        models: TrackModels,
        calibration: CameraCalibration,
        face: int = 0,
        offsets: LandmarkOffsets | None = None,
    ) -> None:
        self.names = rig.names
        if models.finder is None:
            raise ValueRangeError("--landmarks: found a table, expected what finds landmarks as the face moves")
        self._tracker = LandmarkTracker(models.finder, models.appearance, face=face)
        self._calibration, self._filter = calibration, LandmarkFilter()
        solver = solver_for(rig, models, calibration)
        self._solver = solver if offsets is None else solver.shifted(offsets)
        self._state: VideoState | None = None

    def step(self, frame: Tensor, interval: float | None = None) -> LiveFrame:
        """Solves the next frame, uint8 (H,W) or (3,H,W); before the first face all weights are 0.

        Args:
            frame: the picture.
            interval: seconds since the frame before, where they are known.
        """
        seen = self._tracker.step(frame)
        trust = trust_of(seen.confidence, seen.visibility)
        # What is hidden is a guess, that a filter would carry on into the frames after.
        shown = torch.where(trust[:, None] > 0, seen.landmarks, torch.nan)
        landmarks = self._filter.step(undistort(shown, self._calibration))
        enough = int(torch.isfinite(landmarks).all(1).sum()) >= _MIN_LANDMARKS
        if self._state is None and not enough:
            return LiveFrame(torch.zeros(len(self.names)), torch.full((3, 3), torch.nan), seen.landmarks)
        before = self._state or self._solver.start()
        self._state = self._solver.step(before, landmarks, confidence=trust, interval=interval)
        weights, rotation = self._state.weights.detach().float(), self._state.rotation.detach().float()
        return LiveFrame(weights, rotation, seen.landmarks)


def track_live(
    camera: str,
    rig: Path,
    address: str,
    out: Path | None = None,
    settings: TrackSettings = _DEFAULT,
    seconds: float | None = None,
    progress: Progress | None = None,
) -> LiveReport:
    """Solves what a camera sees and sends it in Live Link Face's packets, until it ends or is interrupted.

    Args:
        camera: a device's number, or a video file, which is played at its own rate.
        rig: the actor's.
        address: ``udp://HOST:PORT``.
        out: a folder for the curves of what was sent; none are kept without.
        settings: models, calibration, face.
        seconds: after which it ends; until it is interrupted (Ctrl-C) or the video ends if absent.
        progress: called with the number of frames sent.

    Raises:
        ValueRangeError: the address is none, the rig lacks landmarks, or no frame came.
        FileFormatError: the camera or the video cannot be opened.
    """
    progress = progress or silent
    find_receiver(address)
    if seconds is not None:
        checked_number("seconds", seconds, above=True)
    actor = load_actor(rig, settings.part)
    device = re.fullmatch("[0-9]{1,3}", camera)
    source: Camera | PlayedVideo = Camera(int(camera)) if device else PlayedVideo(Path(camera))
    with source:
        models = load_track_models(
            actor, settings.landmarks, settings.appearance, settings.prior, settings.dynamics, source.video.fps
        )
        calibration = camera_of(source.video, settings.camera)
        known = settings.offsets or (None if out is None or not (out / OFFSETS).is_file() else out / OFFSETS)
        offsets = None if known is None else offsets_of(known, actor, models)
        solver = LiveSolver(actor, models, calibration, settings.face, offsets)
        before: float | None = None
        rows: list[LiveFrame] = []
        latency: list[float] = []
        started = time.perf_counter()
        with closing(open_sender(address, actor.names, source.video.fps)) as sender:
            try:
                for came, frame in source.frames():
                    solved = solver.step(frame, None if before is None else max(came - before, _SHORTEST))
                    before = came
                    angles = head_angles(solved.rotation.double()).nan_to_num(0.0)
                    sender.send(solved.weights, torch.cat([angles, angles.new_zeros(_EYE_ANGLES)]))
                    now = time.perf_counter()
                    latency.append(1000 * (now - came))
                    rows.append(solved)
                    progress(f"sending to {address}", len(rows))
                    if seconds is not None and now - started >= seconds:
                        break
            except KeyboardInterrupt:  # how people end what has no end of its own
                pass
        took = time.perf_counter() - started
    if not rows:
        raise ValueRangeError(f"camera {camera}: found no frame, expected at least one")
    weights = torch.stack([row.weights for row in rows]).float()
    found = torch.stack([torch.isfinite(row.landmarks).all(1).any() for row in rows])
    path = None
    if out is not None:
        make_folder(out)
        rotations = torch.stack([row.rotation for row in rows])
        frontal = torch.eye(3).to(rotations) * rotations.new_tensor([1.0, -1, -1])
        rotations = torch.where(torch.isfinite(rotations), rotations, frontal)
        track, columns = Track(actor.names, weights[..., None]), rotation_columns(rotations)
        take = Take(source.video.fps, weights=track, extras={"columns": columns})
        with all_or_none():
            path = save_curves(take, out)["weights"]
    return LiveReport(weights, found, torch.tensor(latency), source.dropped, len(rows) / took, path)
