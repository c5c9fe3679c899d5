"""Frames of a video as photographs: sharp ones of several angles and expressions."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.io.video import open_video
from torchface.landmarks import FaceReading, LandmarkTracker, find_faces
from torchface.landmarks.images.tracking.video_landmarks import naming_the_frame
from torchface.modeling.photographs.frame_choice import choose_frames
from torchface.progress import Progress
from torchface.workflows.fit.fit_landmarks import PhotographLandmarks
from torchface.workflows.named_finders import DEFAULT_LANDMARKS, load_finder

FRAMES = 6
"""How many frames of a video are fitted at most."""

_READ = 200  # frames in which the face is followed, at even distances


@dataclass(frozen=True, eq=False)
class VideoPictures:
    """Frames of a video: names ``NAME_000123`` for people to read, images (3,H,W) in [0,1], their landmarks."""

    names: list[Path]
    images: list[Tensor]
    found: list[PhotographLandmarks]


def video_pictures(
    video: Path, rest: Tensor, progress: Progress, model: str | Path = DEFAULT_LANDMARKS, face: int | None = None
) -> VideoPictures:
    """Chooses frames of a video to fit a head, of landmarks (68,3) at rest, to; ``face`` is which of several, the
    largest first. The first picture knows all faces of the frame in which the face was first seen."""
    clip = open_video(video)
    clip.check()
    named = load_finder(model, option="landmark model")
    step = max(-(-clip.count // _READ), 1)
    which_face = face or 0
    tracker = LandmarkTracker(named.finder, face=which_face, fps=clip.fps / step)
    readings, sharpness, numbers = [], [], []
    several: Tensor | None = None
    for number, frame in enumerate(clip.color_frames()):  # a frame's box is the one before's
        if number % step:
            continue
        with naming_the_frame(number):
            readings.append(tracker.step(frame))
        if several is None and bool(readings[-1].found):
            several = find_faces(frame).boxes
        numbers.append(number)
        sharpness.append(sharpness_of(frame, readings[-1].box) if bool(readings[-1].found) else torch.zeros(()))
        progress("finding the face in the video", number + 1, max(clip.count, number + 1))
    taken = FaceReading.stacked(readings)
    try:
        chosen = choose_frames(rest, taken.landmarks, taken.trust, FRAMES, torch.stack(sharpness)).tolist()
    except ValueRangeError as error:
        raise ValueRangeError(f"{video}: {error}") from error
    wanted = {numbers[row]: readings[row] for row in chosen}
    pictures = VideoPictures([], [], [])
    for number, frame in enumerate(clip.color_frames()):
        if (reading := wanted.get(number)) is None:
            continue
        name = Path(f"{video.stem}_{number:06d}")
        pictures.names.append(name)
        pictures.images.append(frame.float() / 255)
        size = (frame.shape[2], frame.shape[1])
        which, boxes = 0, reading.box[None]
        if several is not None and len(several) > which_face:
            which, boxes, several = which_face, several, None
        pictures.found.append(
            PhotographLandmarks(name, str(model), reading, which, boxes, size, face is not None, named.places)
        )
    return pictures


def sharpness_of(frame: Tensor, box: Tensor) -> Tensor:
    """How much of the detail of a face in a box (x, y, width, height) a frame (3,H,W) keeps, (): the second differences
    beside the first."""
    height, width = frame.shape[1:]
    low = box[:2].long().clamp(min=0)
    high = (box[:2] + box[2:]).long().minimum(torch.tensor([width, height]))
    face = frame[:, low[1] : high[1], low[0] : high[0]].float().mean(0)
    if min(face.shape) < 4:
        return torch.zeros(())
    first = face.diff(dim=0).abs().mean() + face.diff(dim=1).abs().mean()
    second = face.diff(n=2, dim=0).abs().mean() + face.diff(n=2, dim=1).abs().mean()
    return second / first.clamp(min=1e-3)
