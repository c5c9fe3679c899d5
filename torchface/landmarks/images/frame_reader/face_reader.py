"""Reading of one face in a camera's pictures, frame after frame."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from torchface.landmarks.images.boxes.box_network import INPUT_SIZE, BoxNetwork
from torchface.landmarks.images.face_reading import LEAST_VISIBLE, FaceReading, confidence_of
from torchface.landmarks.images.folded_normalisation import without_normalisation
from torchface.landmarks.images.frame_reader.face_place import overlap, place_around, plausible, relation, sought
from torchface.landmarks.images.frame_reader.face_search import FOUND, search
from torchface.landmarks.images.frame_reader.picture_pieces import (
    AROUND,
    cut_square,
    from_square,
    picture_size,
    sampled,
)
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.images.networks.eye_crop import eye_transforms, moved, picture_transforms
from torchface.landmarks.images.networks.eye_finder import LEAST, merged_lids
from torchface.landmarks.images.networks.eye_network import EyeNetwork
from torchface.landmarks.images.networks.landmark_network import LandmarkNetwork
from torchface.landmarks.images.person_identity import (
    CANDIDATES,
    IDENTITY,
    LOOK_MARGIN,
    LOOK_SIZE,
    after_boxes,
    after_face,
    counted_beside,
    face_look,
    is_awaited,
    is_beside,
    is_other,
    known_look,
    look_alone,
)
from torchface.landmarks.images.picture_cut import PARTS, cut_between, small_copy
from torchface.shape_names import ARKIT

_PLACED = 16
_SEEN = _PLACED + IDENTITY
_COPY = 3 * PARTS**2
STATE = _SEEN + 2 * _COPY + 2
"""Numbers that a reader hands on."""

_FAR, _LOOSE = 0.75, 0.25  # shared share of two places
_LONGEST = 0.5  # seconds: after a longer break the face may be elsewhere
_ANYWHERE = (32.0, 32.0, 64.0, 1.0, 0.0)  # a place, where there is none to look at
_SHRUNK, _GROWN = 0.6, 1.6  # of a face from one picture to the next
_LONG = 1e3  # seconds
_DOUBT = 0.25  # seconds of presence below ``sure`` and the like after which the box network is asked, again and again
_EMPTY = 0.1  # mean visibility of the landmarks where nothing of a face is left: the box network is asked at once
_PATIENCE = 0.3  # seconds for which a lost face is waited for at its place before another of several is taken
# Seconds after which the box network is asked who else is about: usually, and where a landmark is less visible than the
# third. Where somebody is near it is asked in every picture: else the other is taken for the followed one at times. And
# pixels of the followed face's side in the copy of the picture for that.
_COUNTED, _COVERED, _HIDDEN, _ENOUGH = 0.25, 0.06, 0.3, 48.0
_EAGER, _PAUSE = 0.5, 0.1  # seconds after a face was lost in which every frame is searched; between searches afterwards


@dataclass(frozen=True)
class ReaderSettings:
    """When a face counts as found and as lost."""

    new: float = 0.6  # presence from which what the box network finds is a face
    # Mean confidence of the landmarks under which it is none, and under which one that is followed is doubted.
    vague: float = 0.5
    sure: float = 0.9  # presence from which nothing is asked about a face that is followed
    likely: float = 0.5  # presence from which it is kept though the box network sees none
    least: float = 0.1  # presence under which it is lost at once
    smallest: float = 12.0  # pixels a side of the box round a face, at least
    score: float = 0.3  # of the box network that a face has at least
    again: float = 0.25  # score that confirms a face which is followed


@dataclass(frozen=True, eq=False)
class WebcamNetworks:
    """What read faces."""

    boxes: BoxNetwork
    landmarks: LandmarkNetwork
    eyes: EyeNetwork  # finds lids and irises in an eye


class FaceReader(nn.Module):
    """One face in the next picture of a camera.

    A face is looked for in the square round where it was in the picture before, turned as it was and as it lay to the
    landmarks when it was found: one that moved far is looked at once more. Without one the box network looks for it.
    Tensor operations alone: it is exported as it is.
    """

    def __init__(self, networks: WebcamNetworks, settings: ReaderSettings | None = None) -> None:
        super().__init__()
        self.settings = settings or ReaderSettings()
        self.boxes, self.landmarks = without_normalisation(networks.boxes), without_normalisation(networks.landmarks)
        self.eyes = without_normalisation(networks.eyes)

    def forward(self, image: Tensor, interval: Tensor, state: Tensor) -> tuple[FaceReading, Tensor]:
        """The face in a picture, and what the reader of the next picture takes.

        Args:
            image: uint8 (H,W,C), 3 channels or 4, red first.
            interval: seconds since the picture before, (), finite and positive.
            state: what the reader of the picture before left, (STATE,); zeros before the first.

        Returns:
            The reading, landmarks and irises of NaN, visibility and presence of 0 without a face; the state (STATE,).
        """
        settings = self.settings
        place, anchor, size = state[:5], state[5:8], picture_size(image)
        following, missing, doubt, since, attempt, covered = state[8:14].unbind()
        same = (size == state[14:_PLACED]).all()
        # Another picture size is another camera: its face may be anywhere. So may that of another picture after a cut,
        # until the picture with the face comes back: it may have been a flash, a hand, a faulty frame.
        picture = small_copy(image)
        *copies, change, away = state[_SEEN:].split([_COPY, _COPY, 1, 1])
        last, showing = (one.view(3, PARTS, PARTS) for one in copies)
        cut, change = cut_between(last, picture, change[0])
        away = ((away[0] > 0.5) | cut) & same
        another, _ = cut_between(showing, picture, torch.zeros(()))
        missing = torch.where(away & ~another, 0.0, missing)
        away = away & another
        cut = cut & away
        place, people = place * same, state[_PLACED:_SEEN] * same
        known = (following > 0.5) & same
        late = known & ((interval > _LONGEST) | cut)
        followed = known & ~late
        crowded = is_beside(people) & ~away
        hidden = crowded & is_awaited(people)
        waiting = ~crowded & ~away & (missing < _PATIENCE)
        doubted = followed & (doubt >= _DOUBT)
        lost_now = ~followed & ((missing <= _EAGER) | (since >= _PAUSE) | hidden)
        pause = torch.where(covered > 0.5, _COVERED, _COUNTED)
        searched = (doubted & (since >= _DOUBT)) | lost_now | cut | (followed & (crowded | (since >= pause)))
        asked = doubted & searched
        # Who is about as large as the face that is followed is seen in a small copy too.
        enough = (size.amax(0) * _ENOUGH / place[2].clamp(min=1)).clamp(max=INPUT_SIZE)
        longest = torch.where(followed, enough, float(INPUT_SIZE))
        found = _either(
            searched,
            self.search,
            lambda image, place, waiting, attempt, longest: torch.zeros(FOUND),
            (image, place, waiting, attempt, longest),
        )
        there, confirmed = found[5] > 0.5, found[6] > 0.5
        # After a long while too it is where it was, if it is seen there, or nowhere.
        followed, asked = followed | (late & ((confirmed & ~cut) | ~there)), asked | late
        people = after_boxes(people, found[7:].view(CANDIDATES, 4), searched & ~away, interval)
        expected = torch.where(away, look_alone(people), people)
        begin = torch.where(followed, sought(place, anchor), found[:5])
        ready = plausible(begin, size, settings.smallest) & (followed | there)
        first = torch.where(ready, begin, torch.tensor(_ANYWHERE))
        # The network runs on every picture, as ONNX Runtime makes it half as fast inside of a branch.
        seen = self.look(image, first)
        moved = place_around(seen[: 2 * COUNT].view(COUNT, 2))
        before = torch.where(followed, place, first)
        shared = overlap(before[:2], before[2], moved)
        # Boxes of the box network fit loosely, but what lies beside them is not their face.
        again = (followed & (shared < _FAR)) | (~followed & (shared >= _LOOSE))
        again = again & ready & plausible(moved, size, settings.smallest)
        shown = torch.where(again, torch.where(followed, sought(moved, anchor), moved), first)
        seen = _either(
            again,
            lambda image, shown, seen: self.look(image, shown),
            lambda image, shown, seen: seen.clone(),
            (image, shown, seen),
        )
        looked = self._unpacked(seen)
        marks, deviation, presence = looked.landmarks, looked.deviation, looked.presence
        own = place_around(marks)
        growth = own[2] / place[2].clamp(min=1)
        around = torch.where(plausible(own, size, settings.smallest), own, first)
        appearance = _either(
            searched,
            lambda image, around, known: face_look(cut_square(image, around, LOOK_SIZE, LOOK_MARGIN)),
            lambda image, around, known: known.clone(),
            (image, around, known_look(people)),
        )
        stranger = is_other(expected, own, appearance, interval)
        vague = confidence_of(deviation / own[2].clamp(min=1)).mean() < settings.vague
        kept = ((presence >= settings.likely) & ~vague) | ~asked | confirmed
        kept = kept & (presence >= settings.least) & (growth > _SHRUNK) & (growth < _GROWN)
        seen_well = looked.visibility.sum() >= LEAST_VISIBLE
        is_face = ~vague & seen_well & (presence >= settings.new)
        good = (followed & kept) | (~followed & is_face)
        good = good & ready & ~stranger & plausible(own, size, settings.smallest)
        empty = looked.visibility.mean() < _EMPTY
        clear = ((presence >= settings.sure) & ~vague) | confirmed
        refused = lost_now & ~followed & there & ~good
        counts = [
            good.float(),
            torch.where(good, 0.0, (missing + interval).clamp(max=_LONG)),
            torch.where(good & ~clear, torch.where(empty, doubt.clamp(min=_DOUBT), doubt + interval), 0.0),
            torch.where(searched, 0.0, (since + interval).clamp(max=_LONG)),
            torch.where(good, 0.0, attempt + refused),  # kept between searches: else the same is tried each time
            (looked.visibility.amin(0) < _HIDDEN).float(),
        ]
        anchor = torch.where(good & ~followed, relation(own, shown), anchor)
        people = torch.where(good, expected, people)
        people = after_face(people, own, appearance, (good, stranger & ready & is_face), interval)
        own = torch.where(good, own, place)
        pictures = [picture.flatten(), torch.where(good, picture, showing).flatten()]
        changes = torch.stack([change, (away & ~good).float()])
        after = torch.cat([own, anchor, torch.stack(counts), size, people, *pictures, changes])
        face = read_eyes(image, looked, self.eyes)
        nothing = dict.fromkeys(("landmarks", "iris", "openness", "closed", "expression"), torch.nan)
        nothing |= dict.fromkeys(("visibility", "presence", "eye_visibility"), 0.0)
        nothing["expression_deviation"] = torch.inf
        parts = {name: torch.where(good, getattr(face, name), value) for name, value in nothing.items()}
        return FaceReading(deviation=face.deviation, **parts), after

    def search(self, image: Tensor, place: Tensor, *asked: Tensor) -> Tensor:
        """See :func:`~torchface.landmarks.images.frame_reader.face_search.search`."""
        return search(image, self.boxes, (self.settings.score, self.settings.again), place, asked)

    def look(self, image: Tensor, place: Tensor) -> Tensor:
        """What the network finds in the square round a place, one after the other; see :meth:`_unpacked`."""
        network = self.landmarks
        found = network(cut_square(image, place, network.size, network.margin))
        pixel = place[2] * (network.margin / network.size)
        marks = from_square(found[0][0], place, network.size, network.margin)
        parts = (
            marks, pixel * found.deviation, found.visibility, found.presence, found.expression,
            found.expression_deviation,
        )  # fmt: skip
        return torch.cat([part.flatten() for part in parts])

    def _unpacked(self, seen: Tensor) -> FaceReading:
        marks, deviation, visibility, presence, expression, uncertain = seen.split(
            [2 * COUNT, COUNT, COUNT, 1, len(ARKIT), len(ARKIT)]
        )
        return FaceReading(
            marks.view(COUNT, 2),
            deviation,
            visibility,
            presence[0],
            expression=expression,
            expression_deviation=uncertain,
        )


def people_beside(state: Tensor) -> Tensor:
    """How many other people a reader that left a state (STATE,) has seen beside the face; see
    :func:`~torchface.landmarks.images.person_identity.counted_beside`."""
    return counted_beside(state[_PLACED:_SEEN])


def _either(
    condition: Tensor, then: Callable[..., Tensor], otherwise: Callable[..., Tensor], given: tuple[Tensor, ...]
) -> Tensor:
    """What one of two functions gives, of which the other does not run."""
    if torch.compiler.is_exporting():
        return torch.cond(condition, then, otherwise, given)  # type: ignore[no-any-return]
    return (then if bool(condition) else otherwise)(*given)


def read_eyes(image: Tensor, face: FaceReading, network: EyeNetwork) -> FaceReading:
    """A face with its eyes, of which the network is shown the left in a mirror, and lids where both networks put them.

    Eyes that are too small have irises and openness of NaN and a visibility of 0.
    """
    width, height = network.width, network.height
    back = picture_transforms(eye_transforms(face.landmarks, width, height))
    across, down = torch.arange(width).float(), torch.arange(height).float()
    grid = torch.stack(torch.meshgrid(across, down, indexing="xy"), -1).reshape(-1, 2)
    spacing = back[0, :, 0].square().sum().sqrt()  # pixels of the picture a pixel of the crop
    points = moved(grid, back).flatten(0, 1).nan_to_num()
    colors = sampled(image, points, spacing, spacing.new_full((), AROUND))
    eyes = network(colors.view(3, 2, height, width).transpose(0, 1))
    placed = moved(torch.cat([eyes.landmarks, eyes.iris[:, None]], 1), back)
    large = spacing * width >= LEAST
    visibility = torch.where(large, eyes.visibility, 0.0)
    landmarks, deviation = merged_lids(
        face.landmarks, face.deviation, placed[:, :6], eyes.deviation[:, :6] * spacing, visibility
    )
    iris, openness, closed = (torch.where(large, one, torch.nan) for one in (placed[:, 6], eyes.openness, eyes.closed))
    return replace(
        face, landmarks=landmarks, deviation=deviation, iris=iris, openness=openness, closed=closed,
        eye_visibility=visibility,
    )  # fmt: skip
