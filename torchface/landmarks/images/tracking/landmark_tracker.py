"""Follows one face through a video, frame by frame; a face that is lost is NaN and is found again."""

import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.landmarks.images.appearance.appearance_model import AppearanceModel
from torchface.landmarks.images.box_landmarks import refined_face, settled_face
from torchface.landmarks.images.boxes.face_box import FaceBoxes, FaceDetector, at_most, check_image, overlaps
from torchface.landmarks.images.checked_detector import shipped_detector
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.find_faces import find_faces
from torchface.landmarks.images.ibug_68 import turned_box
from torchface.landmarks.images.landmark_finder import LandmarkFinder, find_in_box
from torchface.landmarks.images.tracking.followed_face import LOOK, FollowedFace, face_place
from torchface.landmarks.images.trees.landmark_trees import LandmarkTrees
from torchface.landmarks.images.trees.tree_finder import TreeFinder

_SAME_PLACE, _UNMOVED, _CONFIRMED, _APART = 0.5, 0.75, 0.4, 0.3  # overlaps of boxes
_MOST_OTHERS = 4
_MOST_TRIED = 4  # boxes of a search beside those of the larger faces

# The detector's, from which a box elsewhere than where a face was shows one; the network's, from which a face is one
# without asking the detector, and where the detector sees one too.
_NEW_PRESENCE, _SURE_PRESENCE, _LEAST_PRESENCE = 0.5, 0.9, 0.1
# The mean under which a face that the detector misses so many times in a row is lost; frames after which it is asked.
_LEAST_CONFIDENCE, _CHECKS, _CHECK_EVERY = 0.44, 3, 16
_FRAMES_WAITED = 10  # for a lost face at its place before another is taken
_CHECKED = 320  # pixels of the longer side of a copy that the detector is asked about, about twice the face's
_LEAST_SIDE = 12.0  # of a box, pixels, under which a face is lost
# Correlation of a face's look with how it looked before, under which it is another's where there are several, and how
# much more another must look as this one did to be taken for it.
_LEAST_LIKENESS, _LIKENESS_GAIN = 0.6, 0.15


class LandmarkTracker:
    """Follows one face, a frame at a time; a frame's landmarks depend on it and on those before it alone.

    The face is looked for in the box round the landmarks of the frame before, turned as they are. A finder that places
    landmarks a little too high would climb with every frame: so the box lies to the landmarks as it did when the face
    was found. Where the finder doubts that the box shows a face the detector looks for it, near where it was first.

    Args:
        finder: finds 68 landmarks in a box; landmark trees do so from several starts.
        appearance: of the actor; refines what the finder finds.
        detector: finds boxes; see ``find_faces``.
        face: which one, from 0, the largest first, where the first frame that shows one shows several. It stays with
            that face while others come and go.

    Raises:
        ValueRangeError: trees find other landmarks than the 68, or ``face`` is negative.

    Example:
        >>> from torchface import zoo
        >>> tracker = LandmarkTracker(zoo.get_model("face_landmarks"))
        >>> bool(tracker.step(torch.full((120, 160), 128, dtype=torch.uint8)).found)
        False
    """

    def __init__(
        self,
        finder: LandmarkFinder | LandmarkTrees,
        appearance: AppearanceModel | None = None,
        detector: FaceDetector | None = None,
        face: int = 0,
    ) -> None:
        if face < 0:
            raise ValueRangeError(f"face: found {face}, expected a number from 0")
        self.finder: LandmarkFinder = TreeFinder(finder) if isinstance(finder, LandmarkTrees) else finder
        self.appearance, self.face = appearance, face
        self.detector = detector or shipped_detector()
        self.reset()

    def reset(self) -> None:
        """Forgets the face, as before the first frame."""
        self._followed = FollowedFace()
        self._moved = torch.zeros(0), torch.zeros(0)
        """Landmarks of the latest frame's face, and its place."""

    @property
    def memory(self) -> Tensor:
        """What the next frame needs of those before it, (1212,) float64."""
        return self._followed.pack()

    @property
    def look(self) -> Tensor:
        """How the face looks in the latest frame, (1200,) of unit length; NaN where it was not found."""
        look = self._followed.latest_look
        return torch.full((LOOK,), torch.nan) if look is None or self._followed.missed > 0 else look

    def resume(self, memory: Tensor) -> None:
        """Goes on as a tracker would that has just had this :attr:`memory`, (1212,).

        Raises:
            ShapeError: another shape.
        """
        self._followed = FollowedFace.unpack(memory)

    def step(self, frame: Tensor) -> FaceReading:
        """The face in the next frame.

        Args:
            frame: uint8 (H,W), or (3,H,W) red first.

        Raises:
            ShapeError: no such frame, or a finder that gives other landmarks than the 68.
            ValueRangeError: a finder that gives landmarks that are not finite.
        """
        check_image(frame)
        followed = self._followed
        followed.frames += 1
        before = self._follow(frame) if followed.missed == 0 else None
        face = None if before is None else self._same_person(frame, before)
        if face is None:
            face = self._search(frame)
        if face is None:
            followed.missed += 1
            followed.anchor = None
            return FaceReading.lost()
        followed.missed = 0
        refined = refined_face(face, frame, self.appearance)
        known = refined.landmarks is self._moved[0]
        place = followed.place = self._moved[1] if known else face_place(refined.landmarks)
        if face is not before:
            followed.set_anchor(face.search_box)
        followed.learn_look(frame, place, _LEAST_LIKENESS)
        return refined

    def _likeness(self, frame: Tensor, face: FaceReading) -> float:
        return self._followed.likeness(frame, face.landmarks)

    def _same_person(self, frame: Tensor, face: FaceReading) -> FaceReading | None:
        """What was followed, if it still looks as it did or nobody else is about; else another face near that does;
        None where none does: it is hidden behind somebody."""
        if not self._followed.crowded:
            return face
        alike = self._likeness(frame, face)
        if alike >= _LEAST_LIKENESS:
            return face
        best = self._most_alike(frame, find_faces(frame, self.detector))
        return best if best is not None and self._likeness(frame, best) >= alike + _LIKENESS_GAIN else None

    def _most_alike(self, frame: Tensor, faces: FaceBoxes) -> FaceReading | None:
        """Of the faces about where the person was the one that looks most like it, if any looks like it at all."""
        read = [self._face_in(frame, faces, number) for number in self._followed.near(faces.boxes)]
        alike = [(self._likeness(frame, one), one) for one in read if one is not None]
        best = max(alike, key=lambda pair: pair[0], default=(-1.0, None))
        return best[1] if best[0] >= _LEAST_LIKENESS else None

    def _face_in(self, frame: Tensor, faces: FaceBoxes, number: int) -> FaceReading | None:
        """One of the detector's faces with its landmarks, if it is one."""
        face = settled_face(self.finder, frame, faces.boxes[number], float(faces.tilts[number]))
        return face if self._plausible(face.box, frame) and face.presence >= _LEAST_PRESENCE else None

    def _note_others(self, frame: Tensor, faces: FaceBoxes, box: Tensor) -> None:
        """Notes whether somebody else than the face in a box (4,) is about, who might be taken for it."""
        if self._followed.crowded or len(faces) < 2:
            return
        apart = (overlaps(faces.boxes, box[None])[:, 0] < _APART).nonzero()[:_MOST_OTHERS, 0].tolist()
        others = [find_in_box(self.finder, frame, faces.boxes[i], float(faces.tilts[i])) for i in apart]
        self._followed.crowded = any(float(one.presence) >= _SURE_PRESENCE for one in others)

    def _follow(self, frame: Tensor) -> FaceReading | None:
        """The face from where it was a frame ago; None where it is not there."""
        followed = self._followed
        if followed.place is None:
            return None
        before, tilt = followed.place[:4], followed.place[4]
        box = followed.anchored_box(before, tilt)
        if not self._plausible(box, frame):
            return None
        face = find_in_box(self.finder, frame, box, float(tilt))
        place = face_place(face.landmarks)
        moved, self._moved = place[:4], (face.landmarks, place)
        if not self._plausible(moved, frame) or not 0.6 < float(moved[2] / before[2]) < 1.6:
            return None
        if float(overlaps(before[None], moved[None])) < _UNMOVED:  # it moved far: once more from where it is now
            face = find_in_box(self.finder, frame, followed.anchored_box(moved, place[4]), float(place[4]))
        sure = float(face.presence) >= _SURE_PRESENCE
        if sure and followed.frames % _CHECK_EVERY:
            return face
        if self._confirmed(frame, face.box):
            followed.unconfirmed = 0
            return face if float(face.presence) >= _LEAST_PRESENCE else None
        followed.unconfirmed += 1
        vague = float(face.confidence.mean()) < _LEAST_CONFIDENCE
        lost = not sure or (followed.unconfirmed >= _CHECKS and vague)
        return None if lost else face  # turned faces are none to the detector

    def _confirmed(self, frame: Tensor, box: Tensor) -> bool:
        """Whether the detector sees a face where the landmarks are; it is shown no more than their surroundings."""
        if not self._plausible(box, frame):
            return False
        x, y, side = (float(value) for value in (box[0], box[1], box[2]))
        left, top = max(0, int(x - side / 2)), max(0, int(y - side / 2))
        piece, ratio = at_most(frame[..., top : int(y + 1.5 * side) + 1, left : int(x + 1.5 * side) + 1], _CHECKED)
        faces = find_faces(piece, self.detector)
        corner = box.new_tensor([left, top, 0, 0])
        faces = FaceBoxes(ratio * faces.boxes + corner, faces.scores, faces.tilts)
        self._note_others(frame, faces, box)
        return len(faces) > 0 and bool((overlaps(faces.boxes, box[None]) > _CONFIRMED).any())

    def _search(self, frame: Tensor) -> FaceReading | None:
        """The face wherever it is now; None where it is nowhere."""
        followed = self._followed
        face = self._chosen(frame, find_faces(frame, self.detector))
        if face is None and followed.place is not None and 0 < followed.missed < _FRAMES_WAITED:
            face = self._still_there(frame, followed.place)
        if face is not None:
            followed.unconfirmed = 0
        return face

    def _is_sure(self, face: FaceReading) -> bool:
        return float(face.presence) >= _SURE_PRESENCE

    def _chosen(self, frame: Tensor, faces: FaceBoxes) -> FaceReading | None:
        """The one of these faces that is meant, if it is one."""
        followed = self._followed
        near = followed.near(faces.boxes)
        if near and followed.crowded:
            return self._most_alike(frame, faces)
        waits = followed.place is not None and followed.missed < _FRAMES_WAITED
        if not near and (waits or self.face >= len(faces)):
            return None
        skipped = 0 if near else self.face
        for number in near[:1] or range(min(len(faces), self.face + _MOST_TRIED)):  # a box may show no face
            face = self._face_in(frame, faces, number)
            if face is None or not (near or float(face.presence) >= _NEW_PRESENCE):
                continue
            if skipped == 0:
                followed.look = followed.look if near else None  # a face elsewhere may be anybody's
                self._note_others(frame, faces, faces.boxes[number])
                return face
            skipped -= 1
        return None

    def _still_there(self, frame: Tensor, place: Tensor) -> FaceReading | None:
        """The face where it was lost (5,), though the detector sees none: turned or half hidden."""
        face = settled_face(self.finder, frame, place[:4], float(place[4]))
        moved, _ = turned_box(face.landmarks)
        if not self._is_sure(face) or not self._plausible(moved, frame):
            return None
        near = float(overlaps(place[None, :4], moved[None])) > _SAME_PLACE
        return face if near and self._likeness(frame, face) >= _LEAST_LIKENESS else None

    def _plausible(self, box: Tensor, frame: Tensor) -> bool:
        """Whether a box is a size that a face can have, and its middle in the image."""
        if not bool(torch.isfinite(box).all()):
            return False
        x, y = (box[:2] + box[2:] / 2).tolist()
        height, width = frame.shape[-2:]
        inside = 0 <= x < width and 0 <= y < height
        return inside and _LEAST_SIDE <= float(box[2]) <= 1.5 * max(height, width)
