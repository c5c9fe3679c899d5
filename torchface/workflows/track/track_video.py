"""From a video of a face and the actor's rig on disk to weights, animation, landmarks and an overlay on disk."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.own_rig import FaceMeasurements
from torchface.files.content_keys import content_key
from torchface.files.documents import write_json
from torchface.files.job_lock import holds_out, within_job
from torchface.files.whole_files import all_or_none
from torchface.io import save_rig
from torchface.landmarks.images.face_reading import FaceReading
from torchface.modeling import FitSettings
from torchface.modeling.photographs.image_fit import with_skin
from torchface.progress import Progress, silent
from torchface.synthetic.head.embedded_character import is_performers
from torchface.workflows.fit.fitted_character import dressed_rig
from torchface.workflows.fit.video_pictures import sharpness_of
from torchface.workflows.named_finders import part_finder
from torchface.workflows.track.camera_views import other_cameras
from torchface.workflows.track.followed_skin import followed_weights
from torchface.workflows.track.frame_readings import read_frames
from torchface.workflows.track.overlay_video import write_overlay
from torchface.workflows.track.person_head import HeadFrames, PersonHead, person_head
from torchface.workflows.track.take_measurements import (
    measured_trust,
    measuring_solver,
    take_measurements,
    with_own_brows,
)
from torchface.workflows.track.take_solution import (
    MOTION,
    OFFSETS,
    frame_times,
    judged_reading,
    keep_solution,
    kept_solution,
    known_offsets,
    known_rest,
    new_offsets,
    new_solution,
    rig_digest,
    seen_eyes,
    smoothed_landmarks,
    solution_key,
    warn_of_offsets,
    with_eyes,
)
from torchface.workflows.track.track_files import HEAD, OVERLAY, SUMMARY, summary, write_curves
from torchface.workflows.track.track_inputs import METHOD, TrackInputs, TrackSettings, load_actor, load_inputs
from torchface.workflows.track.track_result import Tracked
from torchface.workflows.track.track_state import TrackState
from torchface.workflows.track.upright_rig import upright


@holds_out(within_job)
def track_video(
    video: Path | None,
    rig: Path | None,
    out: Path,
    settings: TrackSettings | None = None,
    progress: Progress | None = None,
) -> Tracked:
    """Tracks, solves and writes; see ``torchface track --help`` for the arguments.

    Without a video the landmarks are those of a table, and no overlay is drawn. Without a rig the person's head is
    solved with the take, and written beside the weights.

    A video of variable frame rate is solved at its frames' own times, with a warning; with a dynamics prior at its mean
    rate, brought back to those times.

    A run killed at any moment leaves complete files only. Started again, it goes on behind the landmarks that it had,
    and makes anew what depends on something that has changed.
    """
    progress = progress or silent
    progress("reading the models; the first run makes their graphs, once, a minute or two")
    inputs, others = other_cameras(load_inputs(video, rig, settings or TrackSettings()))
    state = TrackState(out, inputs.reading_key)
    seconds: dict[str, float] = {}
    pictures: dict[int, Tensor] = {}
    reused = state.done
    with _timed(seconds, "landmarks"):
        reading, faces = read_frames(inputs, state, progress, pictures)
    if state.done == reused:
        seconds.clear()
    times = frame_times(inputs, len(reading.landmarks))
    with _timed(seconds, "smoothing"):
        judged = judged_reading(inputs, reading, None if inputs.models.finder is None else state.looks())
        reading = with_own_brows(judged.reading)
        landmarks = smoothed_landmarks(inputs, reading, times)
    head = None
    if inputs.heads is not None:
        with _timed(seconds, "head"):
            filmed = HeadFrames.of(inputs, landmarks, reading)
            head = person_head(inputs, inputs.heads, filmed, landmarks, reading, progress)
        if video is not None:
            with _timed(seconds, "skin"):
                head = with_filmed_skin(head, filmed.pictures, inputs, reading, progress)
        inputs = replace(inputs, actor=head.rig)
    trust, solver = reading.trust, inputs.solver(inputs.clip.fps, MOTION if inputs.models.expects else None)
    offsets = known_offsets(inputs, out)
    if offsets is None or offsets.video != inputs.offsets_key:
        with _timed(seconds, "offsets"):
            estimated = new_offsets(inputs, solver, landmarks, reading)
        if offsets is not None:
            warn_of_offsets(offsets, estimated, inputs)
        offsets = offsets or estimated
    solver = solver if offsets is None else solver.shifted(offsets)
    key = content_key(solution_key(inputs, solver, offsets, times), views=[other.key for other in others])
    eyes = seen_eyes(inputs, solver, landmarks, reading)
    solution = kept_solution(state, key)
    if solution is None:
        with _timed(seconds, "weights"):
            measured, sure = take_measurements(inputs, solver, reading), trust
            if measured is not None:
                solver, sure = measuring_solver(solver), measured_trust(landmarks, reading)
            if eyes is not None:
                measured, sure = with_eyes(inputs, solver, measured, eyes), eyes.agreed(sure)
            if others:
                shown = torch.arange(len(landmarks)) / inputs.clip.fps if times is None else times
                views = tuple(other.view(shown, out, solver, progress) for other in others)
                measured = replace(measured or FaceMeasurements(), views=views)
            solution = new_solution(inputs, solver, landmarks, sure, times, progress, measured)
        with _timed(seconds, "skin's motion"):
            weights = followed_weights(inputs, solution, known_rest(reading), progress)
            solution = solver.solution(landmarks, sure, weights, solution.rotation, solution.translation, measured)
        keep_solution(state, key, solution)
    tracked = Tracked(
        inputs,
        reading,
        landmarks,
        solution,
        times,
        offsets,
        faces,
        reused,
        seconds,
        outliers=judged.outliers,
        others=judged.others,
        head=head,
        eyes=eyes,
        cameras=[other.line for other in others],
        pictures=pictures,
    )
    if head is not None:  # before the animation, which is made of its file
        tracked.products["head"] = out / HEAD
        save_rig(tracked.shown, out / HEAD, head.surface)
    with all_or_none():
        tracked.products.update(write_curves(tracked, out))
    if head is not None and offsets is not None:  # other takes are tracked with the head's file
        replace(offsets, rig=rig_digest(upright(load_actor(out / HEAD, None))[0])).save(out / OFFSETS)
    if video is not None and inputs.settings.overlay != "none":
        _add_overlay(tracked, out, state, key, progress)
    write_json(out / SUMMARY, summary(tracked))
    return tracked


def _add_overlay(tracked: Tracked, out: Path, state: TrackState, key: str, progress: Progress) -> None:
    """Adds the overlay to what was tracked, drawn unless that of an earlier run is up to date."""
    path = out / OVERLAY
    tracked.products["overlay"] = path
    key = content_key(METHOD, solution=key, kind=tracked.inputs.settings.overlay)
    if not state.is_current(path, key):
        with _timed(tracked.seconds, "overlay"):
            write_overlay(tracked, path, progress)
        state.made(path, key)


@contextmanager
def _timed(seconds: dict[str, float], step: str) -> Iterator[None]:
    """Notes what a step took."""
    begin = time.perf_counter()
    yield
    seconds[step] = time.perf_counter() - begin


_SIDES = 15.0  # degrees from which a head shows another side
_SHARP = 0.6  # of the sharpest frame


def with_filmed_skin(
    head: PersonHead, filmed: Sequence[Tensor], inputs: TrackInputs, reading: FaceReading, progress: Progress
) -> PersonHead:
    """A head as it is shown, by the pictures of its frames: with skin of sharp frames from the front and from each
    side, and what belongs to it."""
    progress("finding the head's skin")
    rows = _chosen(head, filmed, reading)
    frames = head.frames[rows]
    pictures = [filmed[row] for row in rows]
    images = [picture.float() / 255 for picture in pictures]
    marks = head.fit.landmarks[rows].double()
    parts = [part_finder()(picture, one) for picture, one in zip(pictures, marks, strict=True)]
    whole = is_performers(head.rig)
    settings = FitSettings(parts=parts, paint_hair=not whole, irises=reading.iris[frames])
    views = replace(
        head.fit,
        posed=tuple(head.fit.posed[row] for row in rows),
        cameras=tuple(head.fit.cameras[row] for row in rows),
        landmarks=head.fit.landmarks[rows],
        residuals=head.fit.residuals[rows],
    )
    assert inputs.heads is not None
    fit = with_skin(views, inputs.heads, images, settings)
    dressed = dressed_rig(head.rig, inputs.actor, fit, images, parts, marks, whole)
    return replace(head, shown=dressed.rig.select(head.rig.names), surface=dressed.surface)


def _chosen(head: PersonHead, pictures: Sequence[Tensor], reading: FaceReading) -> list[int]:
    """Which of the head's frames show the skin: from the front, from the left and from the right, of the sharp ones
    that in which the face acts least, for a smile paints its folds and the light on its cheeks."""
    ahead = torch.stack([camera.rotation[2] for camera in head.fit.cameras])
    yaw = torch.rad2deg(torch.atan2(-ahead[:, 0], -ahead[:, 2]))
    sharp = torch.stack([
        sharpness_of(picture, reading.box[number])
        for picture, number in zip(pictures, head.frames.tolist(), strict=True)
    ])  # fmt: skip
    acts = head.fit.weights.sum(1)
    sides = (yaw.abs() <= _SIDES, yaw > _SIDES, yaw < -_SIDES)
    chosen = [side & (sharp >= _SHARP * sharp[side].amax()) for side in sides if bool(side.any())]
    return [int(torch.where(some, acts, torch.inf).argmin()) for some in chosen]
