"""Landmarks of one face through a video, frame by frame; a face that is lost is NaN and is found again."""

from __future__ import annotations

from collections.abc import Iterable, Sized
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.io.video import VideoFile, open_video
from torchface.landmarks.images.appearance_model import AppearanceModel
from torchface.landmarks.images.face_box import FaceDetector, HaarDetector, find_face, find_faces, grey_pixels, overlaps
from torchface.landmarks.images.ibug_68 import box_around
from torchface.landmarks.images.landmark_consensus import Consensus, ConsensusSettings, consensus, tilt_of
from torchface.landmarks.images.landmark_trees import LandmarkTrees
from torchface.progress import Progress, silent
from torchface.take import Track

COUNT = 68
LANDMARK_NAMES = tuple(str(number) for number in range(COUNT))
"""The channels of a track of landmarks: iBUG's numbers from 0."""

_PHOTOGRAPH = ConsensusSettings(starts=48)


@dataclass(frozen=True)
class TrackingSettings:
    """When a face counts as lost, and where it is looked for.

    Starts on a face end near each other, starts on anything else do not: with the shipped trees the mean dispersion was
    0.008 to 0.036 of the box's side on 19 photographed faces, 0.004 to 0.020 on drawn ones, and 0.057 to 0.10 on
    pieces of images without a face (5th to 95th percentile; the most on a photographed face was 0.045, the least
    without one 0.054).

    Args:
        sure: mean dispersion up to which a face is one without asking the detector, of the box's side.
        doubtful: mean dispersion up to which it is one where the detector sees a face too.
        check: frames after which the detector is asked anyway.
        checks: how often in a row it must see none, with a dispersion above half of ``sure``, for the face to be lost.
        patience: frames for which a lost face is waited for at its place before another is taken.
        smallest: side of a box, pixels, under which a face is lost.
    """

    sure: float = 0.045
    doubtful: float = 0.065
    check: int = 15
    checks: int = 3
    patience: int = 10
    smallest: float = 12.0


@dataclass(frozen=True, eq=False)
class TrackedFace:
    """One face in one frame.

    Args:
        landmarks: iBUG's 68, (68,2) float32 pixels; NaN where the face is lost.
        box: x, y, width, height round it as a detector draws it, (4,) pixels; NaN where it is lost.
        confidence: (68,) in [0,1]; one half where the trees' starts disagree by 0.02 of the box's side, 0
            where the face is lost.
    """

    landmarks: Tensor
    box: Tensor
    confidence: Tensor

    @property
    def found(self) -> bool:
        """Whether there is a face."""
        return bool(torch.isfinite(self.landmarks).all())

    @classmethod
    def lost(cls) -> TrackedFace:
        """No face."""
        return cls(torch.full((COUNT, 2), torch.nan), torch.full((4,), torch.nan), torch.zeros(COUNT))


class _Seen(NamedTuple):
    """What the trees found, and the box (4,) that they were given."""

    found: Consensus
    box: Tensor


class LandmarkTracker:
    """Follows one face, a frame at a time; a frame's landmarks depend on it and on those before it alone.

    The face is looked for in the box round the landmarks of the frame before, from several starts; their robust mean
    is steadier than any of them. Trees that place a face's landmarks a little too high would climb with every frame:
    so the box lies to the landmarks as it did when the face was found. Where the starts disagree the detector looks
    for the face, near where it was first.

    Args:
        trees: find 68 landmarks in a box.
        appearance: of the actor; refines what the trees find.
        detector: finds boxes; the shipped cascades if absent.
        face: which one, from 0, the largest first, where the first frame that shows one shows several. It stays with
            that face while others come and go.
        starts: from where the trees start.
        settings: when a face counts as lost.

    Raises:
        ValueRangeError: the trees find other landmarks than the 68, or ``face`` is negative.
    """

    def __init__(
        self,
        trees: LandmarkTrees,
        appearance: AppearanceModel | None = None,
        detector: FaceDetector | None = None,
        face: int = 0,
        starts: ConsensusSettings | None = None,
        settings: TrackingSettings | None = None,
    ) -> None:
        if trees.mean.shape != (COUNT, 2):
            raise ValueRangeError(f"trees: found a model of {len(trees.mean)} landmarks, expected the {COUNT} of iBUG")
        if face < 0:
            raise ValueRangeError(f"face: found {face}, expected a number from 0")
        self.trees, self.appearance, self.face = trees, appearance, face
        self.detector = detector or HaarDetector(smallest=0.1, step=1.15)
        self.starts, self.settings = starts or ConsensusSettings(), settings or TrackingSettings()
        self.reset()

    def reset(self) -> None:
        """Forgets the face, as before the first frame."""
        self._last = TrackedFace.lost()
        self._place: Tensor | None = None
        self._anchor: Tensor | None = None
        self._missed = self._frames = self._unseen = 0

    def resume(self, landmarks: Tensor, confidence: Tensor) -> None:
        """Goes on after a frame with these landmarks (68,2) and confidence (68,): the face near there is meant."""
        if landmarks.shape != (COUNT, 2) or confidence.shape != (COUNT,):
            raise ShapeError(
                f"resume: found {tuple(landmarks.shape)} and {tuple(confidence.shape)}, "
                f"expected ({COUNT},2) and ({COUNT},)"
            )
        self.reset()
        if bool(torch.isfinite(landmarks).all()):
            self._last = TrackedFace(landmarks.float(), box_around(landmarks.float()), confidence.float())
            self._place = self._last.box

    def step(self, frame: Tensor) -> TrackedFace:
        """The face in the next frame.

        Args:
            frame: uint8 (H,W), or (3,H,W) red first.

        Raises:
            ShapeError: no such frame.
        """
        grey = torch.from_numpy(grey_pixels(frame))
        seen = self._follow(grey) if self._last.found and self._anchor is not None else None
        if seen is None:
            seen = self._search(grey)
        if seen is None and self._last.found and self._anchor is None:  # resumed, and no face to the detector
            seen = self._follow(grey)
        if seen is None:
            self._missed += 1
            self._last, self._anchor = TrackedFace.lost(), None
            return self._last
        self._missed = 0
        self._frames += 1
        landmarks = seen.found.landmarks.float()
        if self.appearance is not None:
            landmarks = appearance_landmarks(self.appearance, grey, landmarks)
        self._last = TrackedFace(landmarks, box_around(landmarks), seen.found.confidence.float())
        self._place = self._last.box
        if self._anchor is None:
            self._anchor = _relation(self._last.box, seen.box)
        return self._last

    @torch.no_grad()
    def _follow(self, grey: Tensor) -> _Seen | None:
        """The face from where it was a frame ago; None where it is not there."""
        box = self._anchored(self._last.box)
        if not self._plausible(box, grey):
            return None
        seen = consensus(self.trees, grey, box, tilt_of(self.trees, self._last.landmarks), self.starts)
        moved = box_around(seen.landmarks)
        if not self._plausible(moved, grey) or not 0.6 < float(moved[2] / self._last.box[2]) < 1.6:
            return None
        if float(overlaps(self._last.box[None], moved[None])) < 0.75:  # it moved far: once more from where it is now
            box = self._anchored(moved)
            seen = consensus(self.trees, grey, box, tilt_of(self.trees, seen.landmarks), self.starts)
        dispersion, settings = float(seen.dispersion.mean()), self.settings
        if dispersion <= settings.sure and (self._frames + 1) % settings.check:
            return _Seen(seen, box)
        if self._confirmed(grey, box_around(seen.landmarks)):
            self._unseen = 0
            return _Seen(seen, box) if dispersion <= settings.doubtful else None
        self._unseen += 1
        if dispersion > settings.sure or (self._unseen >= settings.checks and dispersion > settings.sure / 2):
            return None
        return _Seen(seen, box)  # turned faces are none to the detector

    def _confirmed(self, grey: Tensor, box: Tensor) -> bool:
        """Whether the detector sees a face where the landmarks are; it is shown no more than their surroundings."""
        if not self._plausible(box, grey):
            return False
        x, y, side = (float(value) for value in (box[0], box[1], box[2]))
        left, top = max(0, int(x - side / 2)), max(0, int(y - side / 2))
        piece = grey[top : int(y + 1.5 * side) + 1, left : int(x + 1.5 * side) + 1]
        detector = HaarDetector(smallest=0.33, step=1.1) if isinstance(self.detector, HaarDetector) else self.detector
        faces = find_faces(piece, detector)
        corner = box.new_tensor([left, top, 0, 0])
        return len(faces) > 0 and bool((overlaps(faces.boxes + corner, box[None]) > 0.4).any())

    @torch.no_grad()
    def _search(self, grey: Tensor) -> _Seen | None:
        """The face wherever it is now; None where it is nowhere."""
        faces = find_faces(grey, self.detector)
        box = self._choose(faces.boxes)
        if box is None:
            return None
        self._anchor = None
        seen = _refined(self.trees, grey, box, self.starts)
        if not self._plausible(box_around(seen.found.landmarks), grey):
            return None
        self._unseen = 0
        return seen if float(seen.found.dispersion.mean()) <= self.settings.doubtful else None

    def _anchored(self, box: Tensor) -> Tensor:
        """Where the trees look for a face with this box (4,) round its landmarks."""
        if self._anchor is None:
            return box
        side = box[2] * self._anchor[2]
        middle = box[:2] + box[2:] / 2 + box[2] * self._anchor[:2]
        return torch.cat([middle - side / 2, side.expand(2)])

    def _choose(self, boxes: Tensor) -> Tensor | None:
        """Which of the faces (F,4), the largest first, is the one that was tracked; the one asked for at the start."""
        if self._place is not None and len(boxes):
            middle = boxes[:, :2] + boxes[:, 2:] / 2
            distance = (middle - self._place[:2] - self._place[2:] / 2).norm(dim=1) / self._place[2]
            ratio = boxes[:, 2] / self._place[2]
            distance = torch.where((ratio > 0.6) & (ratio < 1.6), distance, torch.inf)
            nearest = int(distance.argmin())
            if float(distance[nearest]) < 0.75:
                return boxes[nearest]
            if self._missed < self.settings.patience:
                return None
        return boxes[self.face] if self.face < len(boxes) else None

    def _plausible(self, box: Tensor, grey: Tensor) -> bool:
        """Whether a box is a size that a face can have, and its middle in the image."""
        if not bool(torch.isfinite(box).all()):
            return False
        x, y = (box[:2] + box[2:] / 2).tolist()
        height, width = grey.shape
        inside = 0 <= x < width and 0 <= y < height
        return inside and self.settings.smallest <= float(box[2]) <= 1.5 * max(height, width)


def track_landmarks(
    video: VideoFile | str | Path | Iterable[Tensor],
    tracker: LandmarkTracker,
    progress: Progress | None = None,
) -> Track:
    """Landmarks of one face in all frames.

    Args:
        video: a file, or frames, uint8 (H,W) or (3,H,W) each.
        tracker: what finds them; it goes on from its last frame.
        progress: called with each step and how far it is.

    Returns:
        Names ``"0"`` to ``"67"``, values (T,68,2) in pixels, NaN where the face is lost, confidence (T,68).

    Raises:
        FileFormatError: the video cannot be decoded, changes size, or has a variable frame rate.
        ShapeError: frames of another kind.
    """
    progress = progress or silent
    if isinstance(video, str | Path):
        video = open_video(video)
    frames = video.frames() if isinstance(video, VideoFile) else video
    total = video.count if isinstance(video, VideoFile) else len(video) if isinstance(video, Sized) else 0
    found = []
    for frame in frames:  # a frame's box is the one before's
        found.append(tracker.step(frame))
        progress("tracking landmarks", len(found), max(total, len(found)) if total else 0)
    if not found:
        return Track(LANDMARK_NAMES, torch.zeros(0, COUNT, 2), torch.zeros(0, COUNT))
    return Track(
        LANDMARK_NAMES, torch.stack([one.landmarks for one in found]), torch.stack([one.confidence for one in found])
    )


@torch.no_grad()
def find_landmarks(
    image: Tensor,
    trees: LandmarkTrees,
    face: int = 0,
    detector: FaceDetector | None = None,
    appearance: AppearanceModel | None = None,
) -> TrackedFace:
    """Landmarks of one face in a photograph.

    Args:
        image: uint8 (H,W), or (3,H,W) red first.
        trees: find 68 landmarks in a box.
        face: which one, from 0, the largest first.
        detector: finds boxes; the shipped cascades if absent.
        appearance: of this person; refines what the trees find.

    Raises:
        NoFaceError: there are not so many faces.
        ShapeError: no such image.
        ValueRangeError: the trees find other landmarks than the 68.
    """
    if trees.mean.shape != (COUNT, 2):
        raise ValueRangeError(f"trees: found a model of {len(trees.mean)} landmarks, expected the {COUNT} of iBUG")
    grey = torch.from_numpy(grey_pixels(image))
    seen = _refined(trees, grey, find_face(image, face, detector), _PHOTOGRAPH).found
    landmarks = seen.landmarks.float()
    if appearance is not None:
        landmarks = appearance_landmarks(appearance, grey, landmarks)
    return TrackedFace(landmarks, box_around(landmarks), seen.confidence.float())


def _refined(trees: LandmarkTrees, grey: Tensor, box: Tensor, starts: ConsensusSettings) -> _Seen:
    """Landmarks from a detector's box, then from the box round what was found: detectors' boxes fit loosely.

    Once, not until it stands still: where trees err, they err more from a box that follows them.
    """
    first = consensus(trees, grey, box, 0.0, starts)
    again = box_around(first.landmarks)
    if not bool(torch.isfinite(again).all()) or float(overlaps(box[None], again[None])) < 0.25:
        return _Seen(first, box)
    return _Seen(consensus(trees, grey, again, tilt_of(trees, first.landmarks), starts), again)


def _relation(box: Tensor, other: Tensor) -> Tensor:
    """Where another box (4,) lies: its middle from the box's (2,) in sides of that, and its size by that's; (3,)."""
    offset = (other[:2] + other[2:] / 2 - box[:2] - box[2:] / 2) / box[2]
    return torch.cat([offset.clamp(-0.3, 0.3), (other[2:3] / box[2:3]).clamp(0.7, 1.4)])


@torch.no_grad()
def appearance_landmarks(appearance: AppearanceModel, grey: Tensor, start: Tensor) -> Tensor:
    """Landmarks (68,2) where the face looks more as the person does; the start (68,2) where it does not.

    Args:
        appearance: of the person.
        grey: the image, uint8 (H,W).
        start: (68,2), pixels.
    """
    box = box_around(start)
    height, width = grey.shape
    low = (box[:2] - box[2:] / 2).clamp(min=0).long()
    high = (box[:2] + 1.5 * box[2:]).ceil().long()
    piece = grey[int(low[1]) : min(int(high[1]) + 1, height), int(low[0]) : min(int(high[0]) + 1, width)]
    if 0 in piece.shape:
        return start
    fit = appearance.refine(piece[None, None].float() / 255, (start - low)[None])
    better = bool(torch.isfinite(fit.landmarks).all()) and float(fit.error) <= float(fit.initial_error)
    near = float((fit.landmarks[0] + low - start).norm(dim=1).mean()) < 0.15 * float(box[2]) if better else False
    return (fit.landmarks[0] + low).to(start) if near else start


def landmark_jitter(landmarks: Tensor) -> Tensor:
    r"""How much landmarks tremble, in pixels.

    .. math:: \sqrt{\tfrac16\, \operatorname{mean} (x_{t-1} - 2 x_t + x_{t+1})^2}

    over all coordinates: the standard deviation of white noise on a motion of constant velocity. What accelerates
    counts too, so that a still face tells it best.

    Args:
        landmarks: (T,L,2), pixels; NaN for not seen.

    Returns:
        A number; NaN where no landmark is seen in three frames in a row.

    Raises:
        ShapeError: not (T,L,2).
    """
    if landmarks.ndim != 3 or landmarks.shape[2] != 2:
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (T,L,2)")
    second = (landmarks[2:] - 2 * landmarks[1:-1] + landmarks[:-2]).double()
    return (second.square().nanmean() / 6).sqrt()
