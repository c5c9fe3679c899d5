"""From a video of a face and the actor's rig on disk to weights, animation, landmarks and an overlay on disk."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.video import VideoSettings, VideoSolution, VideoSolver
from torchface.capture.video.even_frames import even_times, solution_at, values_at
from torchface.capture.video.landmark_offsets import LandmarkOffsets
from torchface.capture.video.landmark_smoothing import filter_landmarks, smooth_landmarks
from torchface.capture.video.offset_estimate import estimate_offsets
from torchface.capture.video.video_smoothing import interpolated, solve_whole_take
from torchface.capture.video.weight_walk import frame_intervals
from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.content_keys import content_key
from torchface.files.documents import write_json
from torchface.files.job_lock import within_job
from torchface.files.whole_files import all_or_none
from torchface.geometry.cameras.calibration import CameraCalibration, assumed_calibration
from torchface.geometry.cameras.distortion import undistort
from torchface.io import load_rig
from torchface.io.camera_files import load_calibration
from torchface.io.images.transparent_images import load_paint
from torchface.io.video import VideoFile, open_video
from torchface.landmarks.images.appearance_model import AppearanceModel
from torchface.landmarks.images.face_box import find_faces
from torchface.landmarks.images.landmark_finder import LandmarkFinder, trust_of
from torchface.landmarks.images.landmark_tracker import LandmarkTracker
from torchface.landmarks.images.video_landmarks import naming_the_frame
from torchface.number_checks import check_rate
from torchface.progress import Progress, silent
from torchface.rendering.point_light import PointLight
from torchface.rig import BlendshapeRig
from torchface.workflows.track.given_frames import blank_clip, given_frames, is_table
from torchface.workflows.track.overlay_video import Overlay, write_overlay
from torchface.workflows.track.track_files import (
    OFFSETS,
    OVERLAY,
    SUMMARY,
    keep_light,
    keep_solution,
    kept_light,
    kept_solution,
    summary,
    write_curves,
)
from torchface.workflows.track.track_models import (
    DEFAULT_LANDMARKS,
    DEFAULT_PRIOR,
    TrackModels,
    load_track_models,
)
from torchface.workflows.track.track_overlay import video_light
from torchface.workflows.track.track_result import MIN_STABLE, Tracked
from torchface.workflows.track.track_state import TrackedFrames, TrackState

PIECE = 64
"""Frames whose landmarks are kept at a time: what a killed run loses at most."""

_AT_ITS_TIMES = "solved at the frames' own times; the overlay and live_link.csv's timecodes run at the mean rate"
_METHOD = "track/4"
"""Of the keys; another number where the same inputs, or another ``PIECE``, come to give other results."""


@dataclass(frozen=True)
class TrackSettings:
    """How a video is tracked.

    Args:
        landmarks: what finds them, see :func:`~torchface.workflows.named_finders.load_finder`; or a table that gives
            them, see :func:`~torchface.io.landmarks.landmark_tables.load_landmark_table`.
        appearance, prior, dynamics: models by name or folder; ``prior`` may be "none".
        camera: a calibration; a focal length is assumed without.
        face: which of several, from 0, the largest first.
        whole_take: landmarks smoothed by all frames, those after each too; weights as well where there is a dynamics
            prior.
        part: keep this region of the rig only.
        texture: an image to put on the face in the overlay, in the rig's texture coordinates.
        overlay: the rig in a video "side" by side with the picture, "over" it half through, or "none"; a texture
            goes over the face.
        fps: frames a second of a table of landmarks without a video; by its times if absent.
        size: width and height of the pictures that such landmarks were found in; the camera's if absent.
        offsets: a file of fixed offsets between this rig's landmarks and this finder's; those in the folder of results,
            or estimated with the take, if absent.
    """

    landmarks: str | Path = DEFAULT_LANDMARKS
    appearance: str | Path | None = None
    prior: str | Path | None = DEFAULT_PRIOR
    dynamics: str | Path | None = None
    camera: Path | None = None
    face: int = 0
    whole_take: bool = False
    part: str | None = None
    texture: Path | None = None
    overlay: Overlay = "side"
    fps: float | None = None
    size: tuple[int, int] | None = None
    offsets: Path | None = None


def track_video(
    video: Path | None,
    rig: Path,
    out: Path,
    settings: TrackSettings = TrackSettings(),
    progress: Progress | None = None,
) -> Tracked:
    """Tracks, solves and writes; see ``torchface track --help`` for the arguments.

    Without a video the landmarks are those of a table, and no overlay is drawn.

    A video of variable frame rate is solved at its frames' own times, with a warning; with a dynamics prior at its mean
    rate, brought back to those times.

    A run killed at any moment leaves complete files only. Started again, it goes on behind the landmarks that it had,
    and makes anew what depends on something that has changed.

    Raises:
        FileFormatError: the video cannot be decoded, changes its size or repeats times of frames; or another file is
            broken.
        ValueRangeError: there is no face in the video, the rig has no 68 landmarks, the take is too short for the
            dynamics prior, or the offsets are another rig's or finder's; or another run is writing into ``out``.
        NameMismatchError: a model is missing, or a prior has learned other shapes than the rig has.
    """
    with within_job(out):
        return _track_video(video, rig, out, settings, progress or silent)


def _track_video(video: Path | None, rig: Path, out: Path, settings: TrackSettings, progress: Progress) -> Tracked:
    clip = _clip(video, settings)
    clip.check()
    times, rate_varies = clip.uneven_seconds()
    if times is not None:
        clip = replace(clip, fps=check_rate(float((len(times) - 1) / times[-1]), str(clip.path)))
        warnings.warn(f"{clip.path}: found a variable frame rate: {rate_varies}; {_AT_ITS_TIMES}", stacklevel=3)
    actor = load_actor(rig, settings.part)
    calibration = camera_of(clip, settings.camera)
    models = load_track_models(
        actor, settings.landmarks, settings.appearance, settings.prior, settings.dynamics, clip.fps
    )
    check_length(clip.count, models, clip.path)
    if settings.texture is not None:
        check_texture(actor, settings.texture)
    see_key = content_key(_METHOD, video=clip.path, models=models.seeing, face=settings.face)
    state = TrackState(out, see_key)
    reused = state.done
    seconds: dict[str, float] = {}
    begin, faces = time.perf_counter(), 0
    if models.finder is None:
        frames = given_frames(Path(settings.landmarks), clip)
    else:
        faces = _track(clip, models.finder, models.appearance, settings.face, state, progress)
        frames = state.frames()
    if state.done > reused:
        seconds["landmarks"] = time.perf_counter() - begin
    check_length(len(frames), models, clip.path)
    if not torch.isfinite(frames.landmarks).any():
        state.clear()
        raise ValueRangeError(f"{clip.path}: found no face in any of its {len(frames)} frames, expected one")
    begin = time.perf_counter()
    times = None if times is None else _times_of(times, len(frames), clip.fps)
    intervals = None
    if times is not None:
        intervals = [clip.fps * step for step in frame_intervals(times, len(frames), 1 / clip.fps)]
    steadied = smooth_landmarks if settings.whole_take else filter_landmarks
    trust = trust_of(frames.confidence, frames.visibility)
    # What is hidden is a guess, that a filter would carry on into the frames after.
    seen = torch.where(trust[..., None] > 0, frames.landmarks.double(), torch.nan)
    pinhole = steadied(undistort(seen, calibration), intervals=intervals).float()
    seconds["steadying"] = time.perf_counter() - begin
    solver = solver_for(actor, models, calibration, clip.fps)
    begin = time.perf_counter()
    offsets, known = _offsets(solver, actor, models, pinhole, trust, settings.offsets, out)
    if not known:
        seconds["offsets"] = time.perf_counter() - begin
    if offsets is not None:
        solver = solver.shifted(offsets)
    solve_key = content_key(
        _METHOD,
        landmarks=see_key,
        models=models.solving,
        neutral=actor.neutral,
        rig=rig_digest(actor),
        calibration=calibration,
        whole_take=settings.whole_take,
        solver=solver.settings,
        offsets=torch.zeros(0) if offsets is None else offsets.millimetres,
        seconds=torch.zeros(0) if times is None else times,
    )
    solution = kept_solution(state, solve_key, len(frames), len(actor.names))
    if solution is None:
        begin = time.perf_counter()
        solution = _solve(solver, pinhole, trust, settings.whole_take, progress, times)
        seconds["weights"] = time.perf_counter() - begin
        keep_solution(state, solve_key, solution)
    products: dict[str, Path] = {}
    tracked = Tracked(
        clip,
        actor,
        frames,
        pinhole,
        solution,
        calibration,
        faces,
        reused,
        seconds,
        products,
        models.unlearned,
        offsets=offsets,
        finder=Path(settings.landmarks).name,
        times=times,
        rate_varies=rate_varies,
    )
    with all_or_none():
        products |= write_curves(tracked, out)
    if settings.overlay != "none" and video is not None:
        overlay_key = content_key(_METHOD, solution=solve_key, texture=settings.texture, kind=settings.overlay)
        products["overlay"] = out / OVERLAY
        if settings.texture is not None:
            tracked = replace(tracked, light=_light(tracked, state, solve_key, progress))
        if not state.is_current(out / OVERLAY, overlay_key):
            begin = time.perf_counter()
            write_overlay(tracked, out / OVERLAY, settings.texture, progress, settings.overlay)
            seconds["overlay"] = time.perf_counter() - begin
            state.made(out / OVERLAY, overlay_key)
    write_json(out / SUMMARY, summary(tracked))
    return tracked


def load_actor(rig: Path, part: str | None) -> BlendshapeRig:
    """The actor's rig, with its 68 landmarks.

    Raises:
        ValueRangeError: it has no such landmarks.
        TorchfaceError: it cannot be read.
    """
    actor = load_rig(rig, part=part)
    notes = actor.neutral.annotations
    found = 0 if notes is None or notes.landmarks is None else len(notes.landmarks)
    if found != 68:
        what = "no landmark vertices" if found == 0 else f"{found} landmark vertices"
        raise ValueRangeError(
            f"{rig}: found {what}, expected the 68 of iBUG (torchface pick annotates them on the rig)"
        )
    return actor


def camera_of(clip: VideoFile, camera: Path | None) -> CameraCalibration:
    """The video's camera: as calibrated, brought to its resolution, or assumed.

    Raises:
        FileFormatError: the calibration is broken.
        ValueRangeError: it was made for another aspect.
    """
    if camera is None:
        return assumed_calibration(clip.width, clip.height)
    try:
        return load_calibration(camera).resized(clip.width, clip.height)
    except ValueRangeError as error:
        raise ValueRangeError(f"{camera}: {error}") from error


def check_length(frames: int, models: TrackModels, path: Path) -> None:
    """Raises a ``ValueRangeError`` where a take is too short for the dynamics prior's window."""
    if models.dynamics is not None and frames <= models.dynamics.window:
        raise ValueRangeError(
            f"{path}: found {frames} frames, expected more than the {models.dynamics.window} that the dynamics prior "
            "looks back"
        )


def check_texture(rig: BlendshapeRig, texture: Path) -> None:
    """Raises where the rig cannot wear a texture, or the image cannot be read."""
    load_paint(texture)
    if rig.neutral.uvs is None:
        raise ValueRangeError(f"{texture}: found a rig without texture coordinates, expected some to put it on")


def solver_for(
    rig: BlendshapeRig, models: TrackModels, calibration: CameraCalibration, fps: float | None = None
) -> VideoSolver:
    """The solver of a rig, for landmarks that the models find, at a frame rate."""
    settings = VideoSettings.of_found_landmarks(models.dynamics is not None, models.appearance is not None, fps)
    return VideoSolver(rig, None, calibration.intrinsics, models.prior, models.dynamics, settings)


def _clip(video: Path | None, settings: TrackSettings) -> VideoFile:
    """The video; or what stands for it, where a table gives the landmarks and there is none."""
    if video is not None:
        if settings.fps is not None or settings.size is not None:
            raise ValueRangeError(f"{video}: found --fps or --size beside a video, expected them without one alone")
        return replace(open_video(video), even=False)
    if not is_table(settings.landmarks):
        raise ValueRangeError("track: found neither a video nor a table of landmarks, expected one at least")
    if settings.texture is not None:
        raise ValueRangeError(f"{settings.texture}: found no video, expected one whose light falls on the texture")
    calibration = None if settings.camera is None else load_calibration(settings.camera)
    size = settings.size or (None if calibration is None else (calibration.width, calibration.height))
    return blank_clip(Path(settings.landmarks), settings.fps, size)


def _track(
    clip: VideoFile,
    finder: LandmarkFinder,
    appearance: AppearanceModel | None,
    face: int,
    state: TrackState,
    progress: Progress,
) -> int:
    """Landmarks of all frames into the state; how many faces the first frame shows."""
    tracker = LandmarkTracker(finder, appearance, face=face)
    kept, at, faces = state.done, 0, 0
    last = state.frames()
    if len(last):
        # A run that was killed goes on with all that it knew, and so gives the same landmarks.
        tracker.resume(last.landmarks[-1], last.confidence[-1], state.memory)
    frames = clip.color_frames()
    for first in frames:
        if at == 0:
            faces = len(find_faces(first))
        piece = chain([first], islice(frames, PIECE - 1))  # one by one: 64 frames in 4K take half a gigabyte
        if at < kept:
            at += sum(1 for _ in piece)
            progress("tracking landmarks", at, max(clip.count, at))
            continue
        found = []
        for frame in piece:  # a frame's box is the one before's
            with naming_the_frame(at):
                found.append(tracker.step(frame))
            at += 1
            progress("tracking landmarks", at, max(clip.count, at))
        state.append(TrackedFrames.of_faces(found), tracker.memory)
    return faces


def _times_of(times: Tensor, count: int, fps: float) -> Tensor:
    """Times of as many frames as could be decoded: a file that was cut lacks some at its end."""
    more = times[-1] + torch.arange(1, max(count - len(times), 0) + 1, dtype=times.dtype) / fps
    return torch.cat([times, more])[:count]


def rig_digest(rig: BlendshapeRig) -> str:
    """Changes when a rig does."""
    correctives = rig.correctives
    more = {} if correctives is None else {"correctives": correctives.deltas, "definitions": correctives.definitions}
    return content_key("rig", neutral=rig.neutral, deltas=rig.deltas, names=rig.names, **more)


def _finder_digest(models: TrackModels) -> str:
    """Changes when what finds landmarks does; a table does not say what found it."""
    return "" if models.finder is None else models.seeing


def offsets_of(path: Path, rig: BlendshapeRig, models: TrackModels) -> LandmarkOffsets:
    """A file's offsets, which must be this rig's and this finder's.

    Raises:
        FileFormatError: it is no such file.
        ValueRangeError: they are another rig's or finder's.
    """
    found = LandmarkOffsets.load(path)
    found.require(rig_digest(rig), _finder_digest(models), path)
    return found


def _offsets(
    solver: VideoSolver,
    rig: BlendshapeRig,
    models: TrackModels,
    landmarks: Tensor,
    trust: Tensor,
    given: Path | None,
    out: Path,
) -> tuple[LandmarkOffsets | None, bool]:
    """The offsets of a rig and a finder, and whether they were known: as given, of an earlier take, or of this one."""
    if given is not None:
        return offsets_of(given, rig, models), True
    if (out / OFFSETS).is_file():
        try:
            return offsets_of(out / OFFSETS, rig, models), True
        except (FileFormatError, ValueRangeError):
            pass  # another rig's, or damaged: made anew
    return estimate_offsets(solver, landmarks, trust, rig_digest(rig), _finder_digest(models)), False


def _light(tracked: Tracked, state: TrackState, key: str, progress: Progress) -> PointLight:
    kept = kept_light(state, key)
    if kept is not None:
        return kept
    progress("estimating the light")
    begin = time.perf_counter()
    found = video_light(tracked)
    tracked.seconds["light"] = time.perf_counter() - begin
    keep_light(state, key, found)
    return found


def _solve(
    solver: VideoSolver,
    landmarks: Tensor,
    confidence: Tensor,
    whole_take: bool,
    progress: Progress,
    times: Tensor | None,
) -> VideoSolution:
    """What the landmarks tell; ``times`` (T,) say when frames are shown, evenly if absent."""
    enough = torch.isfinite(landmarks).all(-1).sum(1) >= MIN_STABLE
    if times is not None and solver.dynamics is not None:  # which has learned how faces go on in frames of one length
        even = even_times(times)
        points, trust = (values_at(x, times, even) for x in (landmarks, confidence))
        if bool((torch.isfinite(points).all(-1).sum(1) >= MIN_STABLE).any()):
            solution = _solve(solver, points, trust, whole_take, progress, None)
            return solution_at(solution, solver, even, times, landmarks, confidence, enough)
    if whole_take and solver.dynamics is not None:
        progress("solving for weights")
        return solve_whole_take(solver, landmarks, confidence=confidence)
    first = int(enough.nonzero()[0, 0])
    intervals = frame_intervals(times, len(landmarks), solver.settings.interval)
    states, state = [], solver.start()
    for t in range(first, len(landmarks)):  # a frame leans on the one before
        state = solver.step(state, landmarks[t], confidence=confidence[t], interval=intervals[t])
        states.append(state)
        progress("solving for weights", t + 1, len(landmarks))
    states = [states[0]] * first + states
    weights, rotation, translation = (
        torch.stack([getattr(one, name) for one in states]).detach().to(landmarks)
        for name in ("weights", "rotation", "translation")
    )
    if whole_take:
        weights = interpolated(weights, enough, times)
    errors = solver.reprojection_errors(landmarks, weights, rotation, translation)
    told = solver.shape_confidence(solver.landmark_trust(landmarks, confidence)).to(landmarks)
    return VideoSolution(weights, rotation, translation, errors, enough, told)
