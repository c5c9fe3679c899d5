"""From a video of a face and the actor's rig on disk to weights, animation, landmarks and an overlay on disk."""

from __future__ import annotations

import time
import warnings
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.own_rig.landmark_smoothing import filter_landmarks, smooth_landmarks
from torchface.capture.own_rig.take_solve import solve_take
from torchface.capture.own_rig.weight_walk import frame_intervals
from torchface.errors import ValueRangeError
from torchface.files.content_keys import content_key
from torchface.files.documents import write_json
from torchface.files.job_lock import within_job
from torchface.files.whole_files import all_or_none
from torchface.geometry.cameras.distortion import undistort
from torchface.landmarks.images.landmark_finder import trust_of
from torchface.number_checks import check_rate
from torchface.progress import Progress, silent
from torchface.rendering.point_light import PointLight
from torchface.workflows.track.frame_landmarks import track_frames
from torchface.workflows.track.given_frames import given_frames
from torchface.workflows.track.overlay_video import write_overlay
from torchface.workflows.track.take_offsets import rig_digest, take_offsets
from torchface.workflows.track.track_files import (
    OVERLAY,
    SUMMARY,
    keep_light,
    keep_solution,
    kept_light,
    kept_solution,
    summary,
    write_curves,
)
from torchface.workflows.track.track_inputs import (
    camera_of,
    check_length,
    check_texture,
    load_actor,
    solver_for,
    video_clip,
)
from torchface.workflows.track.track_models import (
    load_track_models,
)
from torchface.workflows.track.track_overlay import video_light
from torchface.workflows.track.track_result import Tracked
from torchface.workflows.track.track_settings import TrackSettings
from torchface.workflows.track.track_state import TrackState

_AT_ITS_TIMES = "solved at the frames' own times; the overlay and live_link.csv's timecodes run at the mean rate"
_METHOD = "track/4"
"""Of the keys; another number where the same inputs, or another ``PIECE``, come to give other results."""


def track_video(
    video: Path | None,
    rig: Path,
    out: Path,
    settings: TrackSettings | None = None,
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
        return _track_video(video, rig, out, settings or TrackSettings(), progress or silent)


def _track_video(video: Path | None, rig: Path, out: Path, settings: TrackSettings, progress: Progress) -> Tracked:
    clip = video_clip(video, settings)
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
        faces = track_frames(clip, models.finder, models.appearance, settings.face, state, progress)
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
    offsets, known = take_offsets(solver, actor, models, pinhole, trust, settings.offsets, out)
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
        try:
            solution = solve_take(solver, pinhole, trust, times, settings.whole_take, progress)
        except ValueRangeError as error:
            raise ValueRangeError(f"{clip.path}: {error}") from error
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


def _times_of(times: Tensor, count: int, fps: float) -> Tensor:
    """Times of as many frames as could be decoded: a file that was cut lacks some at its end."""
    more = times[-1] + torch.arange(1, max(count - len(times), 0) + 1, dtype=times.dtype) / fps
    return torch.cat([times, more])[:count]


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
