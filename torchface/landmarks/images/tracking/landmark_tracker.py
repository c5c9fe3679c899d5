"""Follows one face through a video, frame by frame; a face that is lost is NaN and is found again."""

import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.landmarks.images.appearance.appearance_model import AppearanceModel
from torchface.landmarks.images.box_landmarks import refined_face, settled_face
from torchface.landmarks.images.boxes.face_box import FaceBoxes, FaceDetector, at_most, check_image, overlaps
from torchface.landmarks.images.checked_detector import CheckedDetector, shipped_detector
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.find_faces import find_faces
from torchface.landmarks.images.ibug_68 import turned_box
from torchface.landmarks.images.landmark_finder import LandmarkFinder, find_in_box
from torchface.landmarks.images.person_identity import (
    CANDIDATES,
    LOOK_SIZE,
    SAME,
    after_boxes,
    after_face,
    counted_beside,
    is_awaited,
    is_beside,
    is_other,
    known_look,
)
from torchface.landmarks.images.tracking.followed_face import LOOK, FollowedFace, face_place, look_at
from torchface.landmarks.images.trees.landmark_trees import LandmarkTrees
from torchface.landmarks.images.trees.tree_finder import TreeFinder
from torchface.number_checks import check_rate

_SAME_PLACE, _UNMOVED, _CONFIRMED = 0.5, 0.75, 0.4  # overlaps of boxes
_MOST_TRIED = 4  # boxes of a search beside those of the larger faces

# The detector's, from which a box elsewhere than where a face was shows one; the network's, from which a face is one
# without asking the detector, and where the detector sees one too.
_NEW_PRESENCE, _SURE_PRESENCE, _LEAST_PRESENCE = 0.5, 0.9, 0.1
_LIKELY_SCORE = 0.6  # of the detector's box in a small copy that confirms a face of which the network is sure
# The mean under which a face that the detector misses so many times in a row is lost; frames after which it is asked.
_LEAST_CONFIDENCE, _CHECKS, _CHECK_EVERY = 0.44, 3, 16
# Frames after which it is asked who else is about, and after which where a landmark is less visible than the third; and
# pixels of the followed face's side in the copy that it is shown for that.
_COUNT_EVERY, _COVERED_EVERY, _HIDDEN, _ENOUGH = 4, 2, 0.3, 48.0
_WAITED = 1 / 3  # seconds for a lost face at its place before another is taken
_LEAST_SIDE = 12.0  # of a box, pixels, under which a face is lost


class LandmarkTracker:
    """Follows one face, a frame at a time; a frame's landmarks depend on it and on those before it alone.

    The face is looked for in the box round the landmarks of the frame before, turned as they are. A finder that places
    landmarks a little too high would climb with every frame: so the box lies to the landmarks as it did when the face
    was found. Where the finder doubts that the box shows a face the detector looks for it, near where it was first.
    After a cut it may be anywhere: of several that were not there before the one is taken that looks most alike.

    Args:
        finder: finds 68 landmarks in a box; landmark trees do so from several starts.
        appearance: of the actor; refines what the finder finds.
        detector: finds boxes; see ``find_faces``.
        face: which one, from 0, the largest first, where the first frame that shows one shows several. It stays with
            that face while others come and go.
        fps: frames a second.

    Raises:
        ValueRangeError: trees find other landmarks than the 68, ``face`` is negative, or ``fps`` is no camera's.

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
        fps: float = 30.0,
    ) -> None:
        if face < 0:
            raise ValueRangeError(f"face: found {face}, expected a number from 0")
        check_rate(fps, "fps", ValueRangeError)
        self._interval = torch.tensor(1 / fps)
        self.finder: LandmarkFinder = TreeFinder(finder) if isinstance(finder, LandmarkTrees) else finder
        self.appearance, self.face = appearance, face
        self.detector = detector or shipped_detector()
        self._quick = self.detector.detector if isinstance(self.detector, CheckedDetector) else self.detector
        self.reset()

    def reset(self) -> None:
        """Forgets the face, as before the first frame."""
        self._followed = FollowedFace()
        self._faces: FaceBoxes | None = None  # of the frame, if it was searched
        self._nearby = torch.zeros(CANDIDATES, 4)  # faces in a small copy of it; see _about
        self._placed = torch.zeros(0), torch.zeros(0)  # the latest landmarks, and their place

    @property
    def memory(self) -> Tensor:
        """What the next frame needs of those before it, (1758,) float64."""
        return self._followed.pack()

    @property
    def look(self) -> Tensor:
        """How the face looks in the latest frame, (1200,) of unit length; NaN where it was not found."""
        look = self._followed.latest_look
        return torch.full((LOOK,), torch.nan) if look is None or self._followed.missed > 0 else look

    @property
    def change(self) -> float:
        """By how much the latest frame's picture differs from the one before, 1 less their correlation."""
        return self._followed.change

    @property
    def beside(self) -> Tensor:
        """How many other people stand to the left of the face in the picture, and to the right, smoothed, (2,)."""
        return counted_beside(self._followed.people)

    def resume(self, memory: Tensor) -> None:
        """Goes on as a tracker would that has just had this :attr:`memory`, (1758,).

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
        self._faces = None
        followed.take_picture(frame)
        every = _COVERED_EVERY if followed.covered else _COUNT_EVERY
        check = followed.missed > 0 or followed.frames % every == 0 or bool(is_beside(followed.people))
        self._nearby = self._about(frame) if check else torch.zeros(CANDIDATES, 4)
        followed.people = after_boxes(followed.people, self._nearby, torch.tensor(check), self._interval)
        before = self._follow(frame) if followed.missed == 0 and not followed.cut else None
        face = before if before is not None and self._is_person(frame, before) else self._search(frame)
        if face is None:
            followed.missed += 1
            followed.anchor = None
            return FaceReading.lost()
        followed.missed = 0
        refined = refined_face(face, frame, self.appearance)
        place = followed.place = self._place(refined.landmarks)
        if face is not before:
            followed.set_anchor(face.search_box)
        followed.shown, followed.cut = followed.picture, False
        followed.covered = bool(face.visibility.amin() < _HIDDEN)
        followed.latest_look = look_at(frame, place)
        return refined

    def _place(self, landmarks: Tensor) -> Tensor:
        if landmarks is not self._placed[0]:
            self._placed = landmarks, face_place(landmarks)
        return self._placed[1]

    def _found(self, frame: Tensor) -> FaceBoxes:
        """The frame's faces, which are looked for once."""
        if self._faces is None:
            self._faces = find_faces(frame, self.detector)
        return self._faces

    def _about(self, frame: Tensor) -> Tensor:
        """Who is about: x and y of the middle, side and score of the likeliest faces, (CANDIDATES,4), then zeros."""
        followed = self._followed
        if followed.missed == 0 and followed.place is not None:  # who is about as large is seen in a small copy too
            small, ratio = at_most(frame, max(1, round(max(frame.shape[1:]) * _ENOUGH / float(followed.place[2]))))
            faces = find_faces(small, self._quick)
        else:
            faces, ratio = self._found(frame), 1.0
        rows = faces.scores.argsort(descending=True, stable=True)[:CANDIDATES]
        boxes, scores = ratio * faces.boxes[rows].float(), faces.scores[rows, None].float()
        found = torch.cat([boxes[:, :2] + boxes[:, 2:] / 2, boxes[:, 2:3], scores], 1)
        return torch.cat([found, torch.zeros(CANDIDATES - len(rows), 4)])

    def _is_person(self, frame: Tensor, face: FaceReading) -> bool:
        """Whether a face is the followed person's, and not somebody's who passes before them; notes whose it is."""
        people, place = self._followed.people, self._place(face.landmarks)
        around = torch.cat([place[:2] + place[2:4] / 2, place[2:3], place[4:].cos(), place[4:].sin()])
        look = look_at(frame, place, LOOK_SIZE)
        other = is_other(people, around, look, self._interval)
        self._followed.people = after_face(people, around, look, (~other, other), self._interval)
        return not bool(other)

    def _face_in(self, frame: Tensor, faces: FaceBoxes, number: int) -> FaceReading | None:
        """One of the detector's faces with its landmarks, if it is one."""
        face = settled_face(self.finder, frame, faces.boxes[number], float(faces.tilts[number]))
        return face if self._plausible(face.box, frame) and face.presence >= _LEAST_PRESENCE else None

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
        place = self._place(face.landmarks)
        moved = place[:4]
        if not self._plausible(moved, frame) or not 0.6 < float(moved[2] / before[2]) < 1.6:
            return None
        if float(overlaps(before[None], moved[None])) < _UNMOVED:  # it moved far: once more from where it is now
            face = find_in_box(self.finder, frame, followed.anchored_box(moved, place[4]), float(place[4]))
        sure = float(face.presence) >= _SURE_PRESENCE
        if sure and followed.frames % _CHECK_EVERY:
            return face
        if (sure and self._is_nearby(face.box)) or self._confirmed(frame, face.box):
            followed.unconfirmed = 0
            return face if float(face.presence) >= _LEAST_PRESENCE else None
        followed.unconfirmed += 1
        vague = float(face.confidence.mean()) < _LEAST_CONFIDENCE
        lost = not sure or (followed.unconfirmed >= _CHECKS and vague)
        return None if lost else face  # turned faces are none to the detector

    def _is_nearby(self, box: Tensor) -> bool:
        """Whether a likely face of those that were looked for in a small copy lies where the landmarks are."""
        likely = self._nearby[self._nearby[:, 3] >= _LIKELY_SCORE]
        boxes = torch.cat([likely[:, :2] - likely[:, 2:3] / 2, likely[:, 2:3].expand(-1, 2)], 1)
        return bool((overlaps(boxes, box[None]) > _CONFIRMED).any())

    def _confirmed(self, frame: Tensor, box: Tensor) -> bool:
        """Whether the detector sees a face where the landmarks are."""
        boxes = self._found(frame).boxes if self._plausible(box, frame) else box[:0].view(0, 4)
        return bool((overlaps(boxes, box[None]) > _CONFIRMED).any())

    def _search(self, frame: Tensor) -> FaceReading | None:
        """The face wherever it is now; None where it is nowhere."""
        followed = self._followed
        face = self._chosen(frame, self._found(frame))
        if face is None and followed.place is not None and (followed.missed > 0 or followed.cut) and self._waits():
            face = self._still_there(frame, followed.place)
        if face is not None:
            followed.unconfirmed = 0
        return face

    def _is_sure(self, face: FaceReading) -> bool:
        return float(face.presence) >= _SURE_PRESENCE

    def _waits(self) -> bool:
        """Whether the face is expected where it was, and nobody elsewhere is taken for it yet."""
        followed = self._followed
        if followed.place is None:
            return False
        if bool(is_beside(followed.people)):  # whoever is hidden behind somebody comes out again
            return bool(is_awaited(followed.people))
        return followed.missed * float(self._interval) < _WAITED

    def _chosen(self, frame: Tensor, faces: FaceBoxes) -> FaceReading | None:
        """The one of these faces that is meant, if it is one."""
        near = (self._face_in(frame, faces, number) for number in self._followed.near(faces.boxes))
        own = next((face for face in near if face is not None and self._is_person(frame, face)), None)
        if own is not None:
            return own
        known, waits = known_look(self._followed.people), self._waits()
        skipped = 0 if known.any() else self.face  # who is known is chosen by the look
        if skipped >= len(faces):
            return None
        shown = self._shown(frame, faces)
        if known.any():
            looks = [float(known @ look_at(frame, self._place(face.landmarks), LOOK_SIZE)) for face in shown]
            alike = sorted(zip(looks, shown, strict=True), key=lambda one: -one[0])
            shown = [face for look, face in alike if not waits or self._came(frame, face, look)]
        shown = shown[skipped:]
        if waits and shown:
            self._followed.forget_place()
        return next((face for face in shown if self._is_person(frame, face)), None)

    def _shown(self, frame: Tensor, faces: FaceBoxes) -> list[FaceReading]:
        """The largest of these faces with their landmarks, those that are faces."""
        numbers = range(min(len(faces), self.face + _MOST_TRIED))  # a box may show no face
        found = (self._face_in(frame, faces, number) for number in numbers)
        return [face for face in found if face is not None and float(face.presence) >= _NEW_PRESENCE]

    def _came(self, frame: Tensor, face: FaceReading, likeness: float) -> bool:
        """Whether a face elsewhere came with a cut, or looks like the one that is missed and was not there before."""
        own = self._followed.cut or (likeness >= SAME and self._is_person(frame, face))
        return own and self._followed.is_new(face.box, frame.shape)

    def _still_there(self, frame: Tensor, place: Tensor) -> FaceReading | None:
        """The face where it was lost (5,), though the detector sees none: turned or half hidden."""
        face = settled_face(self.finder, frame, place[:4], float(place[4]))
        moved, _ = turned_box(face.landmarks)
        if not self._is_sure(face) or not self._plausible(moved, frame):
            return None
        near = float(overlaps(place[None, :4], moved[None])) > _SAME_PLACE
        return face if near and self._is_person(frame, face) else None

    def _plausible(self, box: Tensor, frame: Tensor) -> bool:
        """Whether a box is a size that a face can have, and its middle in the image."""
        if not bool(torch.isfinite(box).all()):
            return False
        x, y = (box[:2] + box[2:] / 2).tolist()
        height, width = frame.shape[-2:]
        inside = 0 <= x < width and 0 <= y < height
        return inside and _LEAST_SIDE <= float(box[2]) <= 1.5 * max(height, width)
