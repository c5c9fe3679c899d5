"""Views of other cameras that are fixed to the first: their films brought to its frames, and what they saw."""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.own_rig import CameraView, VideoSolver
from torchface.errors import ValueRangeError
from torchface.files.content_keys import content_key
from torchface.geometry.cameras.calibration import PlacedCamera
from torchface.io.camera_files import load_cameras
from torchface.io.video import open_video
from torchface.io.video.timecodes import start_of
from torchface.landmarks.images.face_reading import FaceReading
from torchface.progress import Progress
from torchface.temporal.interpolation import values_at
from torchface.workflows.track.frame_readings import read_frames
from torchface.workflows.track.take_measurements import take_measurements
from torchface.workflows.track.take_solution import frame_times, judged_reading, smoothed_landmarks
from torchface.workflows.track.track_inputs import METHOD, TrackInputs, inputs_of, with_times
from torchface.workflows.track.track_state import TrackState


@dataclass(frozen=True, eq=False)
class OtherCamera:
    """A camera beside the first, and its film."""

    inputs: TrackInputs
    camera: PlacedCamera  # where it stands
    begin: float  # when its film began after the first one's, seconds

    @property
    def key(self) -> str:
        """Changes when what it says of the first one's frames does."""
        camera, place = self.inputs.calibration, (self.camera.rotation, self.camera.translation)
        return content_key(METHOD, read=self.inputs.reading_key, camera=camera, place=place, begin=self.begin)

    @property
    def line(self) -> str:
        """For people to read."""
        beside = float((self.camera.rotation.T @ self.camera.translation).norm())
        film = f"{self.camera.name}: {self.inputs.clip.path.name}"
        return f"camera {film}, {beside:.0f} mm from the first, its film begins {self.begin:+.3f} s after the first's"

    def view(self, times: Tensor, out: Path, solver: VideoSolver, progress: Progress) -> CameraView:
        """What it saw in the first one's frames, which are shown at ``times`` (T,) seconds."""
        inputs, name = self.inputs, self.camera.name or self.inputs.clip.path.stem
        state = TrackState(out / "state" / name, inputs.reading_key)
        reading, _ = read_frames(inputs, state, lambda what, *count: progress(f"{name}: {what}", *count))
        found, count = int(reading.found.sum()), len(reading.landmarks)
        if 2 * found < count:
            film = inputs.clip.path.name
            warnings.warn(
                f"{film}: the face was found in {found} of its {count} frames: this camera adds little", stacklevel=2
            )
        own = frame_times(inputs, count)
        reading = judged_reading(inputs, reading, state.looks() if inputs.models.finder is not None else None).reading
        landmarks = smoothed_landmarks(inputs, reading, own).double()
        shown = torch.arange(len(landmarks)) / inputs.clip.fps if own is None else own
        shown = shown.double() + self.begin
        near = (times >= shown[0] - 0.5 / inputs.clip.fps) & (times <= shown[-1] + 0.5 / inputs.clip.fps)
        deviation = _deviation(inputs, solver, reading)
        marks, off = (values_at(x, shown, times.double()) for x in (landmarks, deviation))
        marks[~near] = torch.nan
        K = inputs.calibration.intrinsics
        return CameraView(marks, off.nan_to_num(torch.inf), K, self.camera.rotation, self.camera.translation)


def _deviation(inputs: TrackInputs, solver: VideoSolver, reading: FaceReading) -> Tensor:
    """What each landmark is expected to be off by, (T,68) pixels, more where it is trusted less; infinite for none."""
    measured = take_measurements(inputs, solver, reading)
    trust = reading.trust.double()
    if measured is None or measured.deviation is None:
        # What a trust of less than 1 adds to the solver's own noise, about one pixel.
        return torch.where(trust > 0, (1 / trust.clamp(min=1e-6) - 1).sqrt(), torch.inf)
    sure = reading.visibility.double().nan_to_num(0.0) * (reading.confidence > 0)
    return torch.where(sure > 0.5, measured.deviation.double() / sure.clamp(min=1e-6).sqrt(), torch.inf)


def other_cameras(first: TrackInputs) -> tuple[TrackInputs, list[OtherCamera]]:
    """The first film's inputs with its camera of the file, and the other cameras; none where no film is beside it."""
    settings = first.settings
    if not settings.beside and settings.cameras is None:
        return first, []
    if settings.cameras is None:
        raise ValueRangeError(
            "track: found several films of one take, expected --cameras FILE, which says how they lie"
        )
    wrong = {"no --rig": first.heads is not None, "--camera": settings.camera is not None}
    wrong["a table of landmarks"] = first.models.finder is None
    for found in [name for name, is_so in wrong.items() if is_so]:
        raise ValueRangeError(f"track: found --cameras with {found}, expected films and the actor's own rig")
    cameras, count = load_cameras(settings.cameras), 1 + len(settings.beside)
    if len(cameras) != count:
        named = ", ".join(camera.name for camera in cameras)
        raise ValueRangeError(
            f"{settings.cameras}: found {len(cameras)} cameras ({named}) and {count} films, expected a film of "
            "each, in this order"
        )
    films = [
        (first.clip, first.times, ""),
        *(with_times(replace(open_video(one), even=False)) for one in settings.beside),
    ]
    begins = _begins(cameras, [clip.path for clip, *_ in films], settings.cameras)
    others, length = [], first.clip.count / first.clip.fps
    for number, (camera, (clip, times, varies), begin) in enumerate(zip(cameras, films, begins, strict=True)):
        try:
            calibration = camera.calibration.resized(clip.width, clip.height)
        except ValueRangeError as error:
            raise ValueRangeError(f"{settings.cameras}: {camera.name}, {clip.path.name}: {error}") from error
        if number == 0:
            first = replace(first, calibration=calibration)
            continue
        if begin >= length or begin + clip.count / clip.fps <= 0:
            raise ValueRangeError(
                f"{clip.path}: found no common frame: it begins {begin:.2f} s after {first.clip.path.name}, which "
                f"lasts {length:.2f} s, and lasts {clip.count / clip.fps:.2f} s; expected films of one take (offset in "
                f"{settings.cameras})"
            )
        inputs = replace(inputs_of(clip, first.actor, settings), calibration=calibration)
        others.append(OtherCamera(replace(inputs, times=times, rate_varies=varies), camera, begin))
    return first, others


def _begins(cameras: tuple[PlacedCamera, ...], films: list[Path], file: Path) -> list[float]:
    """When each film began after the first, seconds: as the file of cameras says, by timecodes, or together."""
    starts = [start_of(film) for film in films]
    begins, silent = [0.0], []
    for camera, start in zip(cameras[1:], starts[1:], strict=True):
        if camera.offset is not None:
            begins.append(camera.offset - (cameras[0].offset or 0.0))
        elif start is not None and starts[0] is not None:
            begins.append((start - starts[0] + 43200) % 86400 - 43200)  # midnight may lie between
        else:
            begins.append(0.0)
            silent.append(camera.name)
    if silent:
        warnings.warn(
            f"{file}: found neither an offset nor timecodes of {', '.join(silent)}: the films are taken to begin "
            "together; `offset = SECONDS` in the file says when one began after the first",
            stacklevel=4,
        )
    return begins
