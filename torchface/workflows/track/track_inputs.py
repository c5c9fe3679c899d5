"""Inputs of tracking, read and checked: settings, the video, the actor's rig, the camera, the models."""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote
from typing import Literal

from torch import Tensor

from torchface.capture.own_rig import VideoSettings, VideoSolver
from torchface.errors import ValueRangeError
from torchface.files.content_keys import content_key
from torchface.geometry.cameras.calibration import CameraCalibration, assumed_calibration
from torchface.io import load_rig
from torchface.io.camera_files import load_calibration
from torchface.io.landmarks.landmark_tables import load_landmark_table
from torchface.io.video import VideoFile, open_video
from torchface.io.video.blank_video import BlankVideo
from torchface.modeling import HeadModel
from torchface.number_checks import check_rate
from torchface.rig import BlendshapeRig
from torchface.workflows.named_heads import NamedHeads, load_head_model, matching
from torchface.workflows.named_priors import DEFAULT_PRIOR
from torchface.workflows.track.track_models import DEFAULT_LANDMARKS, TrackModels, is_table, load_track_models
from torchface.workflows.track.upright_rig import upright

METHOD = "track/17"
"""Of the keys; another number where the same inputs, or pieces of another length, come to give other results."""

Overlay = Literal["side", "over", "none"]
"""The opaque rig beside the picture, the mesh half through over it, or no video."""

_SIDES = (1, 2**16)
_AT_ITS_TIMES = "solved at the frames' own times"


@dataclass(frozen=True)
class TrackSettings:
    """How a video is tracked."""

    # what finds them, see `load_finder`; or a table that gives them, see `load_landmark_table`
    landmarks: str | Path = DEFAULT_LANDMARKS
    # appearance, prior, dynamics: models by name or folder; `prior` may be "none"
    appearance: str | Path | None = None
    prior: str | Path | None = DEFAULT_PRIOR
    dynamics: str | Path | None = None
    camera: Path | None = None  # a calibration; a focal length is assumed without
    face: int = 0  # which of several, from 0, the largest first
    # landmarks smoothed by all frames, those after each too; weights as well where there is a dynamics prior
    whole_take: bool = False
    part: str | None = None  # keep this region of the rig only
    overlay: Overlay = "side"  # the rig in a video beside the picture, half through over it, or no video
    fps: float | None = None  # frames a second of a table of landmarks without a video; by its times if absent
    # width and height of the pictures that such landmarks were found in; the camera's if absent
    size: tuple[int, int] | None = None
    # a file of fixed offsets between this rig's landmarks and this finder's; those in the folder of results, or
    # estimated with the take, if absent
    offsets: Path | None = None
    one_person: bool = False  # all frames show the actor, also those in which the face looks like another's
    # keep as few rows of weights and keys as stay within this of every frame's; all if absent
    reduce: float | None = None
    anybody: bool = False  # the rig is not the person's: the head is solved with the take
    heads: str | Path | None = None  # the head model for that, by name or folder; the best at hand if absent
    neutral_frame: int | None = None  # of the video, in which the face has no expression: offsets are estimated there
    # films of the same take by other cameras, in the order of `cameras`, whose first is the video's
    beside: tuple[Path, ...] = ()
    cameras: Path | None = None  # how these cameras lie, see `load_cameras`


@dataclass(frozen=True, eq=False)
class TrackInputs:
    """What tracking starts from."""

    settings: TrackSettings
    clip: VideoFile  # the video; or what stands for it, where a table gives the landmarks and there is none
    actor: BlendshapeRig  # the rig, with 68 landmarks
    calibration: CameraCalibration  # of the camera, at the video's resolution
    models: TrackModels
    times: Tensor | None = None  # when each frame is shown, (T,) seconds, where the frame rate varies
    rate_varies: str = ""  # how, in words
    # of the rig's topology, from which the person's is solved; None where the rig is the person's
    heads: HeadModel | None = None
    about: str = ""  # what there is to say of them, or of the rig
    rig: Path | None = None  # the actor's file, where the actor is all of it

    @property
    def reading_key(self) -> str:
        """Changes when what is read of the frames does."""
        return content_key(METHOD, video=self.clip.path, models=self.models.seeing, face=self.settings.face)

    @property
    def offsets_key(self) -> str:
        """Changes when the offsets that the video shows do."""
        neutral = self.settings.neutral_frame
        return self.reading_key if neutral is None else content_key(self.reading_key, neutral_frame=neutral)

    def solver(self, fps: float | None = None, motion: float | None = None) -> VideoSolver:
        """The solver of the rig, for landmarks that the models find, at a frame rate; ``motion`` as of its settings."""
        return solver_for(self.actor, self.models, self.calibration, fps, motion)

    def check_length(self, frames: int) -> None:
        """Raises a ``ValueRangeError`` where a take is too short for the dynamics prior's window."""
        dynamics = self.models.dynamics
        if dynamics is not None and frames <= dynamics.window:
            raise ValueRangeError(
                f"{self.clip.path}: found {frames} frames, expected more than the {dynamics.window} that the dynamics "
                "prior looks back"
            )


def load_inputs(video: Path | None, rig: Path | None, settings: TrackSettings) -> TrackInputs:
    """Reads and checks everything; warns of a video of variable frame rate. Without a rig anybody is tracked."""
    clip, times, rate_varies = with_times(_clip(video, settings))
    if rig is None or settings.anybody:
        named = NamedHeads.of(settings.heads)
        heads, actor = matching(load_head_model(named.name), rig, settings.part)
        inputs = replace(inputs_of(clip, actor, settings), heads=heads, about=named.line)
    else:
        actor, line = upright(load_actor(rig, settings.part))
        whole = rig if settings.part is None else None
        inputs = replace(inputs_of(clip, actor, settings), about=line, rig=whole)
    inputs.check_length(clip.count)
    if settings.neutral_frame is not None and settings.offsets is not None:
        raise ValueRangeError("--neutral-frame: found --offsets beside it, expected one of the two")
    return replace(inputs, times=times, rate_varies=rate_varies)


def with_times(clip: VideoFile) -> tuple[VideoFile, Tensor | None, str]:
    """A checked film at its mean rate, when its frames are shown where that varies, and how, of which it warns."""
    clip.check()
    times, varies = clip.uneven_seconds()
    if times is not None:
        clip = replace(clip, fps=check_rate(float((len(times) - 1) / times[-1]), str(clip.path)))
        warnings.warn(f"{clip.path}: found a variable frame rate: {varies}; {_AT_ITS_TIMES}", stacklevel=5)
    return clip, times, varies


def inputs_of(clip: VideoFile, actor: BlendshapeRig, settings: TrackSettings) -> TrackInputs:
    """The inputs of a video or a camera that is open: its calibration, and models for its frame rate."""
    calibration = _calibration(clip, settings.camera)
    models = load_track_models(
        actor, settings.landmarks, settings.appearance, settings.prior, settings.dynamics, clip.fps
    )
    return TrackInputs(settings, clip, actor, calibration, models)


def load_actor(rig: Path, part: str | None) -> BlendshapeRig:
    """The actor's rig, with its 68 landmarks."""
    actor = load_rig(rig, part=part)
    notes = actor.neutral.annotations
    count = 0 if notes is None or notes.landmarks is None else len(notes.landmarks)
    if count != 68:
        what = "no landmark vertices" if count == 0 else f"{count} landmark vertices"
        raise ValueRangeError(
            f"{rig}: found {what}, expected the 68 of iBUG: torchface rig {quote(str(rig))} --out "
            f"NEW{rig.suffix} finds them on a character's face, torchface pick takes them by hand; or track "
            f"without --rig, and torchface retarget OUT/weights.csv --to {quote(str(rig))} --animation TAKE.glb "
            "carries the weights over"
        )
    return actor


def solver_for(
    rig: BlendshapeRig,
    models: TrackModels,
    calibration: CameraCalibration,
    fps: float | None = None,
    motion: float | None = None,
) -> VideoSolver:
    """The solver of a rig, for landmarks that the models find, at a frame rate; see :meth:`TrackInputs.solver`."""
    settings = VideoSettings.of_found_landmarks(models.dynamics is not None, models.appearance is not None, fps)
    prior = models.prior
    if motion is not None and models.dynamics is None:
        settings = replace(settings, motion=motion)
    if models.expects:
        prior, settings = None, replace(settings, sparsity=0.0)
    return VideoSolver(rig, None, calibration.intrinsics, prior, models.dynamics, settings)


def _clip(video: Path | None, settings: TrackSettings) -> VideoFile:
    """The video, or a blank one for a table of landmarks."""
    if video is not None:
        if settings.fps is not None or settings.size is not None:
            raise ValueRangeError(f"{video}: found --fps or --size beside a video, expected them without one alone")
        return replace(open_video(video), even=False)
    if not is_table(settings.landmarks):
        raise ValueRangeError("track: found neither a video nor a table of landmarks, expected one at least")
    path = Path(settings.landmarks)
    table = load_landmark_table(path)
    rate = settings.fps or table.fps
    if rate is None:
        raise ValueRangeError(f"{path}: found no times, expected --fps RATE, the frames a second")
    if not 1 <= rate <= 1000:
        raise ValueRangeError(f"{path}: found {rate:g} frames a second, expected 1 to 1000")
    camera = None if settings.camera is None else load_calibration(settings.camera)
    size = settings.size or (None if camera is None else (camera.width, camera.height))
    if size is None:
        raise ValueRangeError(
            f"{path}: found no video, expected --size WIDTHxHEIGHT of the pictures that the landmarks were found in, "
            "or the --camera that took them"
        )
    if not all(_SIDES[0] <= side <= _SIDES[1] for side in size):
        raise ValueRangeError(f"--size: found {size[0]}x{size[1]}, expected {_SIDES[0]} to {_SIDES[1]} pixels a side")
    seconds = None if settings.fps is not None else table.seconds
    return BlankVideo(path, rate, *size, len(table.points), seconds=seconds)


def _calibration(clip: VideoFile, camera: Path | None) -> CameraCalibration:
    """The video's camera: as calibrated, brought to its resolution, or assumed."""
    if camera is None:
        return assumed_calibration(clip.width, clip.height)
    try:
        return load_calibration(camera).resized(clip.width, clip.height)
    except ValueRangeError as error:
        raise ValueRangeError(f"{camera}: {error}") from error
