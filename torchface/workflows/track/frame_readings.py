"""A reading of the face in each frame: by a tracker, kept piece by piece for a killed run; or given by a table."""

import warnings
from itertools import chain, islice
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.own_rig.another_face import FilmLooks
from torchface.errors import ValueRangeError
from torchface.io.landmarks.landmark_tables import load_landmark_table
from torchface.io.video import VideoFile
from torchface.io.video.blank_video import BlankVideo
from torchface.landmarks import FaceReading, LandmarkFinder, LandmarkTracker, find_faces
from torchface.landmarks.images.boxes.face_box import overlaps
from torchface.landmarks.images.face_mesh_478 import landmarks_of_mesh
from torchface.landmarks.images.ibug_68 import COUNT, box_around
from torchface.landmarks.images.tracking.video_landmarks import naming_the_frame
from torchface.progress import Progress
from torchface.workflows.named_finders import graph_detector
from torchface.workflows.track.track_inputs import TrackInputs
from torchface.workflows.track.track_state import TrackState

PIECE = 64
"""Frames whose readings are kept at a time: what a killed run loses at most."""

SHOWN = 12
"""Frames of a take that its report shows."""
_MOST_KEPT = 100 * 2**20  # bytes of their pictures that stay in memory until then

_COMPARED, _STEP = 5, 10  # frames of a table that are compared with pictures, and frames from one to the next


def shown_frames(count: int) -> list[int]:
    """Which of a take's frames its report shows."""
    return torch.linspace(0, count - 1, min(SHOWN, count)).round().long().unique().tolist()


def read_frames(
    inputs: TrackInputs, state: TrackState, progress: Progress, pictures: dict[int, Tensor] | None = None
) -> tuple[FaceReading, int]:
    """The face in all frames, (T,...), and how many faces the first frame shows; 0 where a table gives landmarks.

    Pictures that the report will show go into ``pictures`` by their numbers, if they are few enough to be kept.
    """
    clip, finder, faces = inputs.clip, inputs.models.finder, 0
    if finder is None:
        reading = given_reading(Path(inputs.settings.landmarks), clip)
    else:
        faces = _track(inputs, finder, state, progress, {} if pictures is None else pictures)
        reading = state.reading()
    inputs.check_length(len(reading.landmarks))
    if not reading.found.any():
        state.clear()
        raise ValueRangeError(f"{clip.path}: found no face in any of its {len(reading.found)} frames, expected one")
    return reading, faces


def _track(
    inputs: TrackInputs, finder: LandmarkFinder, state: TrackState, progress: Progress, pictures: dict[int, Tensor]
) -> int:
    """Readings of all frames into the state; how many faces the first frame shows."""
    clip = inputs.clip
    tracker = LandmarkTracker(finder, inputs.models.appearance, graph_detector(), inputs.settings.face, clip.fps)
    done, at, faces = state.done, 0, 0
    if done:  # a run that was killed goes on with all that it knew, and so gives the same landmarks
        tracker.resume(state.memory)
    frames, kept = clip.color_frames(), set(shown_frames(clip.count))
    if 3 * clip.width * clip.height * len(kept) > _MOST_KEPT:
        kept.clear()
    for first in frames:
        if at == 0:
            faces = len(find_faces(first, tracker.detector))
            if done >= clip.count:  # a run before has read all of them
                break
        piece = chain([first], islice(frames, PIECE - 1))  # one by one: 64 frames in 4K take half a gigabyte
        if at < done:
            at += sum(1 for _ in piece)
            progress("tracking landmarks", at, max(clip.count, at))
            continue
        readings, looks, changes = [], [], []
        for frame in piece:  # a frame's box is the one before's
            with naming_the_frame(at):
                readings.append(tracker.step(frame))
            looks.append(tracker.look)
            changes.append(tracker.change)
            if at in kept:
                pictures[at] = frame
            at += 1
            progress("tracking landmarks", at, max(clip.count, at))
        seen = FilmLooks(torch.stack(looks), torch.tensor(changes))
        state.append(FaceReading.stacked(readings), seen, tracker.memory)
    return faces


def given_reading(path: Path, clip: VideoFile) -> FaceReading:
    """A table's landmarks as a tracker of the video would have read them, (T,...)."""
    table = load_landmark_table(path)
    if len(table.points) != clip.count:
        raise ValueRangeError(
            f"{path}: found landmarks of {len(table.points)} frames, expected the {clip.count} of {clip.path.name}"
        )
    landmarks, confidence = table.pixels(clip.width, clip.height), table.confidence
    visibility = table.visibility
    if landmarks.shape[1] != COUNT:
        landmarks = landmarks_of_mesh(landmarks)
        confidence, visibility = (landmarks_of_mesh(one[..., None])[..., 0] for one in (confidence, visibility))
    _check_inside(landmarks, clip, path)
    if clip.pixel_aspect != 1 and not table.shares:
        warnings.warn(
            f"{path}: {clip.path.name} is anamorphic: its pixels are {clip.pixel_aspect:.3g} times as wide as high; "
            f"the landmarks are taken as of {clip.width} x {clip.height} square ones",
            stacklevel=2,
        )
    boxes = box_around(landmarks)
    if not isinstance(clip, BlankVideo):
        _compare_with_pictures(boxes, clip, path)
    # Of a jaw alone there is no box; any serves that confidence is measured in.
    return FaceReading.of_confidence(landmarks, confidence, visibility, table.presence, boxes.nan_to_num(1.0))


def _check_inside(landmarks: Tensor, clip: VideoFile, path: Path) -> None:
    known = landmarks[torch.isfinite(landmarks).all(2)]
    inside = ((known >= -0.5) & (known <= known.new_tensor([clip.width, clip.height]) - 0.5)).all(1)
    if len(known) and float(inside.float().mean()) < 0.5:
        x, y = known.median(0).values.tolist()
        raise ValueRangeError(
            f"{path}: found landmarks round ({x:.0f}, {y:.0f}), expected most of them in the {clip.width} x "
            f"{clip.height} pixels of {clip.path.name}: were they found in pictures of another size?"
        )


def _compare_with_pictures(boxes: Tensor, clip: VideoFile, path: Path) -> None:
    """Warns where early frames show faces, and none of them where the landmarks are (T,4): of a smaller copy, say."""
    apart = []
    numbers = range(0, min(len(boxes), _COMPARED * _STEP), _STEP)
    for number, frame in zip(numbers, islice(clip.frames(), 0, None, _STEP), strict=False):
        if not bool(torch.isfinite(boxes[number]).all()):
            continue
        faces = find_faces(frame, graph_detector()).boxes
        if len(faces):
            apart.append((float(overlaps(faces, boxes[number][None]).max()) < 0.1, faces[0], boxes[number]))
    if len(apart) > 1 and all(one[0] for one in apart):
        _, face, box = apart[0]
        warnings.warn(
            f"{path}: the landmarks lie round ({_middle(box)}), {float(box[2]):.0f} pixels wide, where "
            f"{clip.path.name} shows no face; it shows one at ({_middle(face)}), {float(face[2]):.0f} pixels wide: "
            "were they found in this video, and at its size?",
            stacklevel=2,
        )


def _middle(box: Tensor) -> str:
    return ", ".join(f"{float(value):.0f}" for value in box[:2] + box[2:] / 2)
