"""From readings of all frames to weights: smoothed landmarks, fixed offsets of the rig's landmarks, the solve."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.antagonist_shapes import signed_difference, signed_quantities
from torchface.capture.own_rig import FaceMeasurements, VideoSolution, VideoSolver
from torchface.capture.own_rig.another_face import AnotherFace, FilmLooks, other_faces
from torchface.capture.own_rig.eye_geometry import (
    CORNERS,
    LOOKS,
    Eyeballs,
    arkit_names,
    lid_followers,
    openness_rows,
    undrifted,
    with_following_lids,
)
from torchface.capture.own_rig.face_points import LANDMARKS
from torchface.capture.own_rig.head_pose import measure_poses
from torchface.capture.own_rig.landmark_offset_estimate import estimate_offsets
from torchface.capture.own_rig.landmark_offsets import LandmarkOffsets
from torchface.capture.own_rig.outlier_landmarks import landmark_reach, landmark_residuals, outlier_landmarks
from torchface.capture.own_rig.resting_frames import activity_of_readings, resting_share
from torchface.capture.own_rig.take_eyes import TakeEyes, take_eyes
from torchface.capture.own_rig.take_solve import solve_take
from torchface.capture.own_rig.weight_walk import frame_intervals
from torchface.capture.weight_readings import WeightReadings
from torchface.errors import AlignmentError, FileFormatError, ValueRangeError
from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.files.content_keys import content_key
from torchface.files.whole_files import make_folder
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.distortion import undistort
from torchface.landmarks.images.face_reading import FaceReading
from torchface.progress import Progress
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT
from torchface.temporal import savitzky_golay
from torchface.temporal.adaptive_kalman import LANDMARK_SETTINGS, adaptive_filter, adaptive_smoother
from torchface.workflows.track.track_inputs import METHOD, TrackInputs
from torchface.workflows.track.track_models import identity_modes
from torchface.workflows.track.track_state import TrackState

OFFSETS = "landmark_offsets.json"
_SOLUTION = "solution.safetensors"
_LEAST_WINDOW = 5  # frames
MOTION = 2.4
"""How far a weight wanders in a second in a take's solve, standard deviation: the frames after calm what jitters."""
_CALM = 0.23  # seconds over which weights are calmed; those of blinks are not


def frame_times(inputs: TrackInputs, count: int) -> Tensor | None:
    """When each of the frames that could be decoded is shown, (T,) seconds; None where they are even.

    A file that was cut lacks some times at its end.
    """
    times = inputs.times
    if times is None:
        return None
    missing = torch.arange(1, max(count - len(times), 0) + 1, dtype=times.dtype)
    return torch.cat([times, times[-1] + missing / inputs.clip.fps])[:count]


@dataclass(frozen=True, eq=False)
class JudgedReading:
    """A reading (T,...) with no confidence in what is not the actor's face."""

    reading: FaceReading  # the rest of it as it was
    outliers: Tensor  # landmarks where no face has them, (T,68) bool; see `outlier_landmarks`
    others: list[AnotherFace]  # spans of frames that show another face than the first ones; see `other_faces`


def judged_reading(inputs: TrackInputs, reading: FaceReading, looks: FilmLooks | None) -> JudgedReading:
    """The reading without outliers and other faces; no looks where nobody looked at pictures."""
    rest, reach = landmark_reach(inputs.actor)
    outliers = outlier_landmarks(rest, reach, reading.landmarks, reading.trust, inputs.clip.fps)
    reading, others = reading.doubted(outliers), list[AnotherFace]()
    if looks is not None and not inputs.settings.one_person:
        relative = landmark_residuals(rest, reading.landmarks, reading.trust)
        others = other_faces(looks, relative, reading.trust, reading.box)
    for span in others:
        frames = torch.arange(len(outliers))
        reading = reading.doubted(((frames >= span.first) & (frames <= span.last))[:, None])
    return JudgedReading(reading, outliers, others)


def smoothed_landmarks(inputs: TrackInputs, reading: FaceReading, times: Tensor | None) -> Tensor:
    """The landmarks (T,68,2) as a camera without distortion has them, filtered along time."""
    fps, count = inputs.clip.fps, len(reading.landmarks)
    intervals = None if times is None else [fps * step for step in frame_intervals(times, count, 1 / fps)]
    smooth = adaptive_smoother if inputs.settings.whole_take else adaptive_filter
    landmarks = undistort(reading.trusted_landmarks.double(), inputs.calibration)
    return smooth(landmarks, LANDMARK_SETTINGS, intervals).float()


def known_offsets(inputs: TrackInputs, out: Path) -> LandmarkOffsets | None:
    """The offsets that the user gives, or those of this video in the folder of results; None where there are none."""
    if inputs.settings.offsets is not None:
        return offsets_of(inputs.settings.offsets, inputs)
    if not (out / OFFSETS).is_file():
        return None
    try:
        offsets = offsets_of(out / OFFSETS, inputs)
    except (FileFormatError, ValueRangeError):
        return None  # another rig's, or damaged: made anew
    return offsets if offsets.video == inputs.offsets_key else None


def offsets_of(path: Path, inputs: TrackInputs) -> LandmarkOffsets:
    """A file's offsets, which must be this rig's and this finder's."""
    offsets = LandmarkOffsets.load(path)
    offsets.require(rig_digest(inputs.actor), _finder_digest(inputs), path)
    return offsets


def new_offsets(
    inputs: TrackInputs, solver: VideoSolver, landmarks: Tensor, reading: FaceReading
) -> LandmarkOffsets | None:
    """The offsets of a take's smoothed landmarks (T,68,2) and their reading (T,...); None where it is too short."""
    read = None
    if inputs.models.expects and bool(torch.isfinite(reading.expression_deviation).any()):
        read = WeightReadings.of_expression(reading.expression, reading.expression_deviation, solver.names)
    offsets = estimate_offsets(
        solver, landmarks, reading.trust, known_rest(reading), identity_modes(), inputs.settings.neutral_frame, read
    )
    if offsets is None:
        return None
    return replace(
        offsets,
        rig=rig_digest(inputs.actor),
        finder=_finder_digest(inputs),
        video=inputs.offsets_key,
        source=inputs.clip.path.name,
    )


def known_rest(reading: FaceReading) -> Tensor | None:
    """How far the face rests in each frame (T,) by the expression that was read; None where none was."""
    activity = activity_of_readings(reading.expression, reading.expression_deviation, ARKIT)
    return resting_share(activity) if bool(torch.isfinite(activity).any()) else None


def seen_eyes(inputs: TrackInputs, solver: VideoSolver, landmarks: Tensor, reading: FaceReading) -> TakeEyes | None:
    """What a take shows of the eyes, with landmarks (T,68,2) smoothed; None where nobody looked at them."""
    if not bool(torch.isfinite(reading.openness).any()):
        return None
    K, rest = inputs.calibration.intrinsics.double(), solver.rest[:LANDMARKS].double()
    try:
        poses = measure_poses(rest, landmarks, K, reading.trust)
    except AlignmentError:
        return None
    depth = eye_depth(solver, poses.rotation, poses.translation)
    seen, iris = eye_rays(reading, inputs.calibration)
    resting, (looking, _) = known_rest(reading), lid_looks(solver)
    even = torch.ones(len(landmarks)) if resting is None else resting
    return take_eyes(reading, seen, iris, poses.rotation, depth, even, Eyeballs.of(inputs.actor), looking)


def eye_depth(solver: VideoSolver, rotation: Tensor, translation: Tensor) -> Tensor:
    """How far the middles of both eyes' corners lie from the camera, (T,2) millimetres, of poses (T,3,3) and (T,3)."""
    rest = solver.rest[:LANDMARKS].double()
    middles = torch.stack([0.5 * (rest[a] + rest[b]) for a, b in CORNERS])
    return torch.einsum("ti,ei->te", rotation[:, 2], middles) + translation[:, 2:]


def eye_rays(reading: FaceReading, calibration: CameraCalibration) -> tuple[Tensor, Tensor]:
    """Trusted landmarks (T,68,2) and irises (T,2,2) at depth 1, as a camera without distortion has them."""
    K = calibration.intrinsics.double()
    seen, iris = (
        (undistort(one.double(), calibration) - K[:2, 2]) / K.diagonal()[:2]
        for one in (reading.trusted_landmarks, reading.iris)
    )
    return seen, undrifted(seen, iris)


def lid_looks(solver: VideoSolver) -> tuple[Tensor, Tensor]:
    """What looking about adds to openness at weights of ``LOOKS``, (2,8), and the rig's openness at rest, (2,)."""
    called = arkit_names(solver.names)
    onto = torch.tensor([[float(name == look) for look in LOOKS] for name in called]).double()
    rows, usual = openness_rows(solver.rest[:LANDMARKS].double(), solver.basis[:LANDMARKS].double(), called)
    return rows @ onto, usual


def with_eyes(
    inputs: TrackInputs, solver: VideoSolver, measured: FaceMeasurements | None, eyes: TakeEyes
) -> FaceMeasurements:
    """What else is known of a take's frames, with its eyes."""
    points, measured = solver.points, measured or FaceMeasurements()
    rest, basis = points.rest[:LANDMARKS], points.basis[:LANDMARKS]
    read = eyes.readings(rest, basis, solver.names, Eyeballs.of(inputs.actor))
    return replace(measured, weights=read if measured.weights is None else measured.weights.beside(read))


def warn_of_offsets(given: LandmarkOffsets, estimated: LandmarkOffsets | None, inputs: TrackInputs) -> None:
    """Warns where the offsets that the user gives are not those that the take itself shows: another person's, say."""
    if estimated is not None and (off := given.mismatch(estimated)) is not None:
        of = f" of {given.source}" if given.source else ""
        warnings.warn(
            f"{inputs.settings.offsets}: the offsets{of} lie {off[0]:.1f} mm from those that {inputs.clip.path.name} "
            f"itself shows, and correlate by {off[1]:.2f}; those of one person's takes lie less than 0.6 mm apart or "
            "correlate by more than 0.9: are they another person's? They are used; without --offsets the take's are",
            stacklevel=2,
        )


def solution_key(
    inputs: TrackInputs, solver: VideoSolver, offsets: LandmarkOffsets | None, times: Tensor | None
) -> str:
    """Changes when the solution does."""
    return content_key(
        METHOD,
        landmarks=inputs.reading_key,
        models=inputs.models.solving,
        neutral=inputs.actor.neutral,
        rig=rig_digest(inputs.actor),
        calibration=inputs.calibration,
        whole_take=inputs.settings.whole_take,
        one_person=inputs.settings.one_person,
        neutral_frame=inputs.settings.neutral_frame,
        solver=solver.settings,
        offsets=torch.zeros(0) if offsets is None else offsets.millimetres,
        seconds=torch.zeros(0) if times is None else times,
    )


def kept_solution(state: TrackState, key: str) -> VideoSolution | None:
    """The solution of an earlier run of the same inputs, if it is whole."""
    tensors = read_checkpoint(state.folder / _SOLUTION, key)
    return None if tensors is None else VideoSolution(**tensors)


def new_solution(
    inputs: TrackInputs,
    solver: VideoSolver,
    landmarks: Tensor,
    trust: Tensor,
    times: Tensor | None,
    progress: Progress,
    measured: FaceMeasurements | None = None,
) -> VideoSolution:
    """Weights and poses of smoothed landmarks (T,68,2), trusted (T,68)."""
    try:
        solution = solve_take(solver, landmarks, trust, times, inputs.settings.whole_take, progress, measured)
    except ValueRangeError as error:
        raise ValueRangeError(f"{inputs.clip.path}: {error}") from error
    weights = calmed(solution.weights, solver.names, inputs.clip.fps)
    if inputs.models.expects:  # else the prior says what goes together
        following = with_following_lids(weights, lid_followers(solver.names))
        signed = signed_quantities(solver.names).to(weights.device)
        weights = signed_difference(following, signed)  # lids that rise take back a blink
    return solver.solution(landmarks, trust, weights, solution.rotation, solution.translation, measured)


def calmed(weights: Tensor, names: Sequence[str], fps: float) -> Tensor:
    """Weights (T,N) as parabolas through the frames on both sides of each have them, without lag; blinks as they are.

    Example:
        >>> noisy = torch.rand(60, 1, generator=torch.Generator().manual_seed(0))
        >>> bool(calmed(noisy, ["jawOpen"], 30.0).diff(dim=0).std() < 0.5 * noisy.diff(dim=0).std())
        True
    """
    window = calm_window(fps, len(weights))
    if window is None:
        return weights
    blinks = torch.tensor([name.startswith("eyeBlink") for name in arkit_names(names)], device=weights.device)
    calm = signed_difference(savitzky_golay(weights, window).clamp(0, 1), signed_quantities(names).to(weights.device))
    return torch.where(blinks, weights, calm)


def calm_window(fps: float, count: int) -> int | None:
    """How many frames a parabola goes through; None where a take has too few."""
    window = 2 * round(0.5 * _CALM * fps) + 1
    return window if _LEAST_WINDOW <= window <= count else None


def keep_solution(state: TrackState, key: str, solution: VideoSolution) -> None:
    """Keeps a solution for a later run."""
    tensors = {
        name: values if values.dtype == torch.bool else values.float() for name, values in vars(solution).items()
    }
    write_checkpoint(make_folder(state.folder) / _SOLUTION, tensors, key)


def rig_digest(rig: BlendshapeRig) -> str:
    """Changes when a rig does."""
    correctives = rig.correctives
    more = {} if correctives is None else {"correctives": correctives.deltas, "definitions": correctives.definitions}
    return content_key("rig", neutral=rig.neutral, deltas=rig.deltas, names=rig.names, **more)


def _finder_digest(inputs: TrackInputs) -> str:
    """Changes when what finds landmarks does; a table does not say what found it."""
    return "" if inputs.models.finder is None else inputs.models.seeing
