"""Follows one face through a video, frame by frame; a face that is lost is NaN and is found again."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.images.appearance.appearance_model import AppearanceModel
from torchface.landmarks.images.boxes.face_box import (
    FaceBoxes,
    FaceDetector,
    HaarDetector,
    check_image,
    find_faces,
    overlaps,
)
from torchface.landmarks.images.boxes.turned_search import find_turned_faces
from torchface.landmarks.images.face_place import box_relation, face_place, upright_box, upright_turn
from torchface.landmarks.images.ibug_68 import box_around, tilt_around
from torchface.landmarks.images.landmark_finder import COUNT, LandmarkFinder, find_in_box
from torchface.landmarks.images.tracking.face_signature import LOOK_SIZE, face_signature, updated_signature
from torchface.landmarks.images.tracking.tracked_face import SeenFace, TrackedFace, refined_face, settled_face
from torchface.landmarks.images.trees.landmark_trees import LandmarkTrees
from torchface.landmarks.images.trees.tree_finder import TreeFinder

_NEAR, _STILL, _OTHER = 0.75, 0.5, 0.3
_MOST_OTHERS = 4
_LEARNED = 0.1  # of how a face looks now that is taken up by what is known of its look


@dataclass(frozen=True)
class TrackingSettings:
    """When a face counts as lost, and where it is looked for.

    Args:
        sure: presence from which a face is one without asking the detector.
        doubtful: presence from which it is one where the detector sees a face too.
        vague: mean confidence under which a face that the detector misses ``checks`` times in a row is lost.
        check: frames after which the detector is asked anyway.
        checks: how often in a row it must see none.
        patience: frames for which a lost face is waited for at its place before another is taken.
        smallest: side of a box, pixels, under which a face is lost.
        turned: frames in a row without a face after which turned faces are looked for again; the first is such a frame.
        alike: correlation of a face's look with how it looked before, under which it is another's where there are
            several.
        closer: how much more another face must look as this one did to be taken for it.
    """

    sure: float = 0.9
    doubtful: float = 0.1
    vague: float = 0.44
    check: int = 16
    checks: int = 3
    patience: int = 10
    smallest: float = 12.0
    turned: int = 4
    alike: float = 0.6
    closer: float = 0.15


class LandmarkTracker:
    """Follows one face, a frame at a time; a frame's landmarks depend on it and on those before it alone.

    The face is looked for in the box round the landmarks of the frame before, turned as they are. A finder that places
    landmarks a little too high would climb with every frame: so the box lies to the landmarks as it did when the face
    was found. Where the finder doubts that the box shows a face the detector looks for it, near where it was first.

    Args:
        finder: finds 68 landmarks in a box; landmark trees do so from several starts.
        appearance: of the actor; refines what the finder finds.
        detector: finds boxes; the shipped cascades if absent.
        face: which one, from 0, the largest first, where the first frame that shows one shows several. It stays with
            that face while others come and go.
        settings: when a face counts as lost.

    Raises:
        ValueRangeError: trees find other landmarks than the 68, or ``face`` is negative.

    Example:
        >>> from torchface import zoo
        >>> tracker = LandmarkTracker(zoo.get_model("face_landmarks"))
        >>> tracker.step(torch.full((120, 160), 128, dtype=torch.uint8)).found
        False
    """

    def __init__(
        self,
        finder: LandmarkFinder | LandmarkTrees,
        appearance: AppearanceModel | None = None,
        detector: FaceDetector | None = None,
        face: int = 0,
        settings: TrackingSettings | None = None,
    ) -> None:
        if face < 0:
            raise ValueRangeError(f"face: found {face}, expected a number from 0")
        self.finder: LandmarkFinder = TreeFinder(finder) if isinstance(finder, LandmarkTrees) else finder
        self.appearance, self.face = appearance, face
        self.detector = detector or HaarDetector(smallest=0.1, step=1.15)
        self.settings = settings or TrackingSettings()
        self.reset()

    def reset(self) -> None:
        """Forgets the face, as before the first frame."""
        self._last = TrackedFace.lost()
        self._place: Tensor | None = None  # the upright box (4,) of the face, and its tilt: (5,)
        self._anchor: Tensor | None = None
        self._look: Tensor | None = None
        self._crowded = False
        self._missed = self._frames = self._unseen = 0

    @property
    def memory(self) -> Tensor:
        """What the next frame needs beside the last landmarks and confidence, (1212,) float64; NaN for unknown."""
        unknown = torch.full((LOOK_SIZE,), torch.nan)
        place = unknown[:5] if self._place is None else self._place.cpu()
        anchor = unknown[:3] if self._anchor is None else self._anchor.cpu()
        look = unknown if self._look is None else self._look.cpu()
        counts = torch.tensor([self._missed, self._frames, self._unseen, int(self._crowded)], dtype=torch.float64)
        return torch.cat([place.double(), anchor.double(), look.double(), counts])

    def resume(self, landmarks: Tensor, confidence: Tensor, memory: Tensor | None = None) -> None:
        """Goes on after a frame with these landmarks (68,2) and confidence (68,): the face near there is meant.

        Args:
            landmarks, confidence: of that frame.
            memory: the tracker's after that frame, (1212,); with it all goes on as if it had never stopped.
        """
        if landmarks.shape != (COUNT, 2) or confidence.shape != (COUNT,):
            raise ShapeError(
                f"resume: found {tuple(landmarks.shape)} and {tuple(confidence.shape)}, "
                f"expected ({COUNT},2) and ({COUNT},)"
            )
        self.reset()
        if bool(torch.isfinite(landmarks).all()):
            self._last = TrackedFace(landmarks.float(), box_around(landmarks.float()), confidence.float())
            self._place = face_place(self._last.landmarks)
        if memory is not None:
            if memory.shape != (LOOK_SIZE + 12,):
                raise ShapeError(f"resume: found a memory of {tuple(memory.shape)}, expected ({LOOK_SIZE + 12},)")
            parts = memory.float().split([5, 3, LOOK_SIZE, 4])
            self._place, self._anchor, self._look = (
                one if bool(torch.isfinite(one).all()) else None for one in parts[:3]
            )
            counts = [int(count) for count in parts[3].nan_to_num(0.0)]
            self._missed, self._frames, self._unseen, self._crowded = *counts[:3], counts[3] > 0

    def step(self, frame: Tensor) -> TrackedFace:
        """The face in the next frame.

        Args:
            frame: uint8 (H,W), or (3,H,W) red first.

        Raises:
            ShapeError: no such frame, or a finder that gives other landmarks than the 68.
            ValueRangeError: a finder that gives landmarks that are not finite.
        """
        check_image(frame)
        self._frames += 1
        followed = self._follow(frame) if self._last.found and self._anchor is not None else None
        seen = None if followed is None else self._same_person(frame, followed)
        if seen is None:
            seen = self._search(frame)
        if seen is None and self._last.found and self._anchor is None:  # resumed, and no face to the detector
            seen = self._follow(frame)
        if seen is None:
            self._missed += 1
            self._last, self._anchor = TrackedFace.lost(), None
            return self._last
        self._missed = 0
        self._last = refined_face(seen.found, frame, self.appearance)
        self._place = face_place(self._last.landmarks)
        if seen is not followed:
            self._anchor = box_relation(self._place[:4], seen.box, self._place[4])
        look = face_signature(frame, self._last.landmarks)
        if self._look is None or not self._crowded or float(self._look @ look) >= self.settings.alike:
            self._look = updated_signature(self._look, look, _LEARNED)
        return self._last

    def _likeness(self, frame: Tensor, seen: SeenFace) -> float:
        """How much a face looks like the one that is followed; 1 where nothing is known of that."""
        return 1.0 if self._look is None else float(self._look @ face_signature(frame, seen.found.landmarks))

    def _same_person(self, frame: Tensor, seen: SeenFace) -> SeenFace | None:
        """What was followed, if it still looks as it did or nobody else is about; else another face near that does;
        None where none does: it is hidden behind somebody."""
        alike = self._likeness(frame, seen)
        if alike >= self.settings.alike or not self._crowded:
            return seen
        best = self._most_alike(frame, find_faces(frame, self.detector))
        return best if best is not None and self._likeness(frame, best) >= alike + self.settings.closer else None

    def _most_alike(self, frame: Tensor, faces: FaceBoxes) -> SeenFace | None:
        """Of the faces about where the person was the one that looks most like it, if any looks like it at all."""
        seen = [self._looked_at(frame, faces, number) for number in self._near(faces.boxes)]
        alike = [(self._likeness(frame, one), one) for one in seen if one is not None]
        best = max(alike, key=lambda pair: pair[0], default=(-1.0, None))
        return best[1] if best[0] >= self.settings.alike else None

    def _looked_at(self, frame: Tensor, faces: FaceBoxes, number: int) -> SeenFace | None:
        """Landmarks of one of the detector's faces, if it is one."""
        seen = settled_face(self.finder, frame, faces.boxes[number], float(faces.tilts[number]))
        there = self._plausible(box_around(seen.found.landmarks), frame)
        return seen if there and seen.found.presence >= self.settings.doubtful else None

    def _note_others(self, frame: Tensor, faces: FaceBoxes, box: Tensor) -> None:
        """Notes whether somebody else than the face in a box (4,) is about, who might be taken for it."""
        if self._crowded or len(faces) < 2:
            return
        apart = (overlaps(faces.boxes, box[None])[:, 0] < _OTHER).nonzero()[:_MOST_OTHERS, 0].tolist()
        others = [find_in_box(self.finder, frame, faces.boxes[i], float(faces.tilts[i])) for i in apart]
        self._crowded = any(one.presence >= self.settings.sure for one in others)

    def _follow(self, frame: Tensor) -> SeenFace | None:
        """The face from where it was a frame ago; None where it is not there."""
        before, tilt = upright_box(self._last.landmarks), tilt_around(self._last.landmarks)
        box = self._sought(before, tilt)
        if not self._plausible(box, frame):
            return None
        seen = find_in_box(self.finder, frame, box, float(tilt))
        moved = upright_box(seen.landmarks)
        if not self._plausible(moved, frame) or not 0.6 < float(moved[2] / before[2]) < 1.6:
            return None
        if float(overlaps(before[None], moved[None])) < 0.75:  # it moved far: once more from where it is now
            tilt = tilt_around(seen.landmarks)
            box = self._sought(moved, tilt)
            seen = find_in_box(self.finder, frame, box, float(tilt))
        settings = self.settings
        if seen.presence >= settings.sure and self._frames % settings.check:
            return SeenFace(seen, box)
        if self._confirmed(frame, box_around(seen.landmarks)):
            self._unseen = 0
            return SeenFace(seen, box) if seen.presence >= settings.doubtful else None
        self._unseen += 1
        vague = float(seen.confidence.mean()) < settings.vague
        if seen.presence < settings.sure or (self._unseen >= settings.checks and vague):
            return None
        return SeenFace(seen, box)  # turned faces are none to the detector

    def _confirmed(self, frame: Tensor, box: Tensor) -> bool:
        """Whether the detector sees a face where the landmarks are; it is shown no more than their surroundings."""
        if not self._plausible(box, frame):
            return False
        x, y, side = (float(value) for value in (box[0], box[1], box[2]))
        left, top = max(0, int(x - side / 2)), max(0, int(y - side / 2))
        piece = frame[..., top : int(y + 1.5 * side) + 1, left : int(x + 1.5 * side) + 1]
        detector = HaarDetector(smallest=0.33, step=1.1) if isinstance(self.detector, HaarDetector) else self.detector
        faces = find_faces(piece, detector)
        corner = box.new_tensor([left, top, 0, 0])
        faces = FaceBoxes(faces.boxes + corner, faces.scores, faces.tilts)
        self._note_others(frame, faces, box)
        return len(faces) > 0 and bool((overlaps(faces.boxes, box[None]) > 0.4).any())

    def _search(self, frame: Tensor) -> SeenFace | None:
        """The face wherever it is now; None where it is nowhere."""
        seen = self._chosen(frame, find_faces(frame, self.detector))
        if seen is None and self._place is not None and 0 < self._missed < self.settings.patience:
            seen = self._still_there(frame, self._place)
        if self._missed % self.settings.turned == 0 and not self._is_clear(seen):
            turned = self._chosen(frame, find_turned_faces(frame, self.detector))
            seen = turned if turned is not None and self._is_clearer(turned, seen) else seen
        if seen is not None:
            self._unseen = 0
        return seen

    def _is_clear(self, seen: SeenFace | None) -> bool:
        """Whether a face is one beyond doubt."""
        sure = seen is not None and seen.found.presence >= self.settings.sure
        return sure and seen is not None and float(seen.found.confidence.mean()) >= self.settings.vague

    def _is_clearer(self, seen: SeenFace, other: SeenFace | None) -> bool:
        """Whether a face that was found turned is one, rather than what was found upright."""
        confidence = float(seen.found.confidence.mean())
        better = other is None or confidence > float(other.found.confidence.mean())
        return seen.found.presence >= self.settings.sure and better

    def _chosen(self, frame: Tensor, faces: FaceBoxes) -> SeenFace | None:
        """The one of these faces that is meant, if it is one."""
        near = self._near(faces.boxes)
        if near and self._crowded:
            return self._most_alike(frame, faces)
        waits = self._place is not None and self._missed < self.settings.patience
        if not near and (waits or self.face >= len(faces)):
            return None
        number = near[0] if near else self.face
        seen = self._looked_at(frame, faces, number)
        if seen is not None:
            self._look = self._look if near else None  # a face elsewhere may be anybody's
            self._note_others(frame, faces, faces.boxes[number])
        return seen

    def _still_there(self, frame: Tensor, place: Tensor) -> SeenFace | None:
        """The face where it was lost (5,), though the detector sees none: turned or half hidden."""
        box = place[:4]
        seen = settled_face(self.finder, frame, box, float(place[4]))
        moved = upright_box(seen.found.landmarks)
        if seen.found.presence < self.settings.sure or not self._plausible(moved, frame):
            return None
        near = float(overlaps(box[None], moved[None])) > _STILL
        return seen if near and self._likeness(frame, seen) >= self.settings.alike else None

    def _sought(self, box: Tensor, tilt: Tensor) -> Tensor:
        """Where a face with this box (4,) and tilt is looked for."""
        anchor = self._anchor
        if anchor is None:
            return box
        side = box[2] * anchor[2]
        middle = box[:2] + box[2:] / 2 + box[2] * (upright_turn(tilt) @ anchor[:2])
        return torch.cat([middle - side / 2, side.expand(2)])

    def _near(self, boxes: Tensor) -> list[int]:
        """Which of the boxes (F,4) lie about where the face was last, and are about of its size, the nearest first."""
        if self._place is None or not len(boxes):
            return []
        place = self._place
        middle = boxes[:, :2] + boxes[:, 2:] / 2
        distance = (middle - place[:2] - place[2:4] / 2).norm(dim=1) / place[2]
        ratio = boxes[:, 2] / place[2]
        near = (distance < _NEAR) & (ratio > 0.6) & (ratio < 1.6)
        return [i for i in distance.argsort(stable=True).tolist() if near[i]]

    def _plausible(self, box: Tensor, frame: Tensor) -> bool:
        """Whether a box is a size that a face can have, and its middle in the image."""
        if not bool(torch.isfinite(box).all()):
            return False
        x, y = (box[:2] + box[2:] / 2).tolist()
        height, width = frame.shape[-2:]
        inside = 0 <= x < width and 0 <= y < height
        return inside and self.settings.smallest <= float(box[2]) <= 1.5 * max(height, width)
