"""Real faces for a comparison of landmark finders: photographs, clips, and photographs that were spoilt."""

import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from planted.landmark_measures import Agreement, agreement, find_blinks, lid_openings, mouth_gap
from torchface.io import load_image, load_landmark_points
from torchface.io.landmarks.dlib_xml import load_dlib_faces
from torchface.io.video import open_video
from torchface.landmarks import (
    FaceBoxes,
    FaceReading,
    LandmarkFinder,
    LandmarkTracker,
    NoFaceError,
    find_landmarks,
    landmark_jitter,
)
from torchface.landmarks.images.checked_detector import shipped_detector
from torchface.landmarks.images.ibug_68 import INNER, box_around, relative_errors, tilt_around, turned_box

GROUPS = {
    "jaw": slice(0, 17),
    "brows": slice(17, 27),
    "nose": slice(27, 36),
    "eyes": slice(36, 48),
    "lips": slice(48, 68),
}
MOUTH_HIDDEN = {"bird": slice(14, 42)}
"""Frames of clips in which a hand is before the mouth: there the reference follows the hand, and is left out."""

RIGHT = 0.1
"""Mean error of the inner landmarks up to which a face counts as right, of the eyes' distance: twice that of a good
finder beside another."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A face in a picture."""

    image: Tensor  # uint8 (3,H,W)
    landmarks: Tensor  # (68,2) pixels, of a person's hand or of another predictor
    tilt: float | None = None  # that the finder is given, radians; the face's own if absent

    @property
    def width(self) -> float:
        """Distance of the outer corners of the eyes, pixels."""
        return float((self.landmarks[36] - self.landmarks[45]).norm())


@dataclass(frozen=True, eq=False)
class Clip:
    """Frames uint8 (T,3,H,W) with a reference's landmarks (T,68,2)."""

    name: str
    frames: list[Tensor]
    reference: Tensor


@dataclass(frozen=True, eq=False)
class Follow:
    """A clip's landmarks (T,68,2) as they were tracked, NaN where the face was lost, and time a frame."""

    clip: Clip
    landmarks: Tensor
    milliseconds: float

    @property
    def width(self) -> Tensor:
        """Distance of the outer corners of the reference's eyes, (T,)."""
        return (self.clip.reference[:, 36] - self.clip.reference[:, 45]).norm(dim=-1)

    def difference(self) -> float:
        """Mean distance of the inner landmarks from the reference, of its eyes' distance."""
        found = torch.where(torch.arange(68)[:, None] >= INNER.start, self.landmarks, torch.nan)
        return float(relative_errors(found, self.clip.reference).nanmean())

    def lids(self) -> tuple[Tensor, Tensor]:
        """Openings found and of the reference, (T,2)."""
        return lid_openings(self.landmarks), lid_openings(self.clip.reference)

    def mouths(self) -> tuple[Tensor, Tensor]:
        """Gaps found and of the reference, (T,); NaN where a hand hides the mouth."""
        reference = mouth_gap(self.clip.reference)
        reference[MOUTH_HIDDEN.get(self.clip.name, slice(0))] = torch.nan
        return mouth_gap(self.landmarks), reference

    def blinks(self) -> tuple[int, int, int]:
        """Blinks of the reference, those of them found, and those found where the reference has none."""
        found, reference = (find_blinks(one.mean(-1)) for one in self.lids())
        meet = (found[None, :, 0] <= reference[:, None, 1] + 2) & (found[None, :, 1] >= reference[:, None, 0] - 2)
        return len(reference), int(meet.any(1).sum()), int((~meet.any(0)).sum())

    def closed(self) -> tuple[Tensor, Tensor]:
        """Openings at the reference's closed frames over their own median, found and of the reference, (C,)."""
        found, reference = (one.mean(-1) / one.mean(-1).nanmedian() for one in self.lids())
        return found[reference < 0.6], reference[reference < 0.6]

    def jitter(self) -> tuple[float, float]:
        """Of inner landmarks in the calmest third of frames, found and of the reference, of the eyes' distance."""
        inner = self.clip.reference[:, INNER]
        motion = (inner[2:] - inner[:-2]).norm(dim=-1).mean(1)
        middles = motion.argsort()[: max(1, len(motion) // 3)] + 1
        scale = float(self.width.mean())

        def trembling(landmarks: Tensor) -> float:
            triples = torch.cat([landmarks[middles + shift][:, INNER].flatten(1) for shift in (-1, 0, 1)])
            return float(landmark_jitter(triples.view(3, -1, 2))) / scale

        return trembling(self.landmarks), trembling(self.clip.reference)


class GivenBox:
    """A detector that is given where the face is, so that finders alone are compared."""

    def __init__(self) -> None:
        self.landmarks, self.shape = torch.full((68, 2), torch.nan), torch.Size()
        self.piece = shipped_detector()

    def __call__(self, image: Tensor) -> FaceBoxes:
        if image.shape[-2:] != self.shape:  # the tracker's look at the face's surroundings
            return self.piece(image)
        box, tilt = turned_box(self.landmarks)
        return FaceBoxes(box[None], torch.ones(1), tilt[None])


def follow(finder: LandmarkFinder, clip: Clip) -> Follow:
    """A clip's landmarks by the tracker; where it starts or loses the face it is given the reference's box."""
    detector = GivenBox()
    tracker = LandmarkTracker(finder, detector=detector)
    found, begin = [], time.perf_counter()
    for frame, reference in zip(clip.frames, clip.reference, strict=True):
        detector.landmarks, detector.shape = reference, frame.shape[-2:]
        found.append(tracker.step(frame).landmarks)
    return Follow(clip, torch.stack(found), 1000 * (time.perf_counter() - begin) / len(found))


def see(finder: LandmarkFinder, picture: Picture, seed: int = 0) -> FaceReading:
    """The landmarks of a picture from its face's box, moved and sized as a detector's is."""
    box, tilt = turned_box(picture.landmarks, None if picture.tilt is None else torch.tensor(picture.tilt))
    drawn = torch.randn(3, generator=torch.Generator().manual_seed(seed)).clamp(-2, 2)
    side = box[2] * (0.06 * drawn[2]).exp()
    middle = box[:2] + box[2:] * (0.5 + 0.04 * drawn[:2])
    moved = torch.cat([middle - side / 2, side.expand(2)])
    given = FaceBoxes(moved[None], torch.ones(1), tilt[None])
    try:
        return find_landmarks(picture.image, finder, detector=lambda _: given)
    except NoFaceError:  # the finder says so
        return FaceReading.lost()


def errors(finder: LandmarkFinder, pictures: list[Picture], seeds: int = 3) -> Tensor:
    """Offsets (P,S,68,2) from the given landmarks of several boxes each, along the eyes and down, of their distance;
    NaN where no face was seen."""
    offsets = torch.full((len(pictures), seeds, 68, 2), torch.nan)
    for number, picture in enumerate(pictures):
        along = (picture.landmarks[45] - picture.landmarks[36]) / picture.width
        axes = torch.stack([along, torch.stack([-along[1], along[0]])])
        for seed in range(seeds):
            found = see(finder, picture, seed)
            if found.presence >= 0.5:
                offsets[number, seed] = (found.landmarks - picture.landmarks) @ axes.T / picture.width
    return offsets


def verdict(picture: Picture, found: FaceReading) -> str:
    """``right``, ``said so`` or ``wrong``: of a face whose landmarks, or those that it vouches for, are off."""
    off = (found.landmarks - picture.landmarks)[INNER].norm(dim=1) / picture.width
    if found.presence < 0.5:
        return "said so"
    if float(off.mean()) <= RIGHT:
        return "right"
    vouched = (found.visibility >= 0.5)[INNER] & (found.confidence >= 0.5)[INNER]
    return "wrong" if bool(vouched.any()) and float(off[vouched].mean()) > RIGHT else "said so"


def by_hand(data: Path) -> list[Picture]:
    """Five photographs whose landmarks were set by hand."""
    kinds = (data / "images" / kind for kind in ("people", "ibug"))
    paths = sorted(path for kind in kinds for path in kind.iterdir() if path.suffix != ".pts")
    return [_picture(path, load_landmark_points(path.with_suffix(".pts")).ibug().float()) for path in paths]


def by_dlib(data: Path) -> list[Picture]:
    """18 faces whose landmarks are those of dlib's own predictor, in whole pixels: a reference, no truth."""
    folder = data / "images" / "dlib_faces"
    faces = load_dlib_faces(folder / "training_with_face_landmarks.xml")
    return [_picture(folder / one.image, one.points.float()) for one in faces]


def clips(data: Path) -> list[Clip]:
    """Six clips with what MediaPipe finds in them, another network: a reference, no truth."""
    stored = np.load(data / "landmarks" / "mediapipe_68.npz", allow_pickle=False)
    found = []
    for name in stored.files:
        path = next(path for path in sorted((data / "video").rglob("*")) if path.stem == name)
        reference = torch.from_numpy(stored[name])
        frames = _gif(path) if path.suffix == ".gif" else list(open_video(path).color_frames())
        count = min(len(frames), len(reference))
        found.append(Clip(name, frames[:count], reference[:count]))
    return found


def hostile(pictures: list[Picture]) -> Iterator[tuple[str, list[Picture]]]:
    """The pictures spoilt in all the ways of a bad day, a list a way."""
    yield "as they are", pictures
    for degrees in (30, 90, 180):
        turned = [_turned(one, math.radians(degrees)) for one in pictures]
        yield f"turned by {degrees} degrees", turned
        yield (
            f"turned by {degrees} degrees, tilt not given",
            [replace(one, tilt=float(tilt_around(old.landmarks))) for one, old in zip(turned, pictures, strict=True)],
        )
    yield "half the face black", [_half_black(one) for one in pictures]
    yield "mouth black", [_black(one, slice(48, 68)) for one in pictures]
    yield "eyes black", [_black(one, slice(36, 48)) for one in pictures]
    yield "dark (0.15)", [replace(one, image=(one.image * 0.15).to(torch.uint8)) for one in pictures]
    yield "blurred", [_blurred(one) for one in pictures]
    yield "small (24 pixels)", [_small(one) for one in pictures]


def spoilt(data: Path, filmed: list[Clip]) -> list[Picture]:
    """20 faces to be spoilt: by hand, the largest with dlib's landmarks, and a frame of each clip."""
    frames = [Picture(clip.frames[-5], clip.reference[-5]) for clip in filmed]
    return [*by_hand(data), *sorted(by_dlib(data), key=lambda one: -one.width)[:9], *frames]


def pooled(pairs: list[tuple[Tensor, Tensor]]) -> Agreement:
    """Agreement over all clips, each about its own means, so that how wide people's eyes are counts for nothing."""
    centred = []
    for found, reference in pairs:
        seen = torch.isfinite(found) & torch.isfinite(reference)
        hidden = torch.where(seen, 0.0, torch.nan)
        centred.append([one - (one + hidden).nanmean(0) for one in (found, reference)])
    found, reference = (torch.cat([one[side].flatten() for one in centred]) for side in (0, 1))
    return agreement(found, reference)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one finder does with all faces."""

    # hand, dlib: offsets, see `errors`
    hand: Tensor
    dlib: Tensor
    follows: list[Follow]  # of the clips
    verdicts: dict[str, Counter[str]]  # how many pictures are right, said so and wrong, a way of spoiling them
    milliseconds: float  # wall clock a face in a frame, its box and tilt given, the quickest of 30

    def rows(self) -> Iterator[tuple[str, str]]:
        """The table's rows."""
        for whose, offsets in (("hand", self.hand), ("dlib's predictor", self.dlib)):
            off = offsets.norm(dim=-1)
            groups = ", ".join(f"{name} {off[..., rows].nanmean():.1%}" for name, rows in GROUPS.items())
            unseen = int(off.isnan().any(-1).sum())
            yield (
                f"inner 51, {len(off)} faces, landmarks by {whose}",
                f"{inner_error(offsets):.2%}, median {_median(offsets):.2%} ({groups}; {unseen} of "
                f"{off[..., 0].numel()} boxes without a face)",
            )
        lids, mouths = [one.lids() for one in self.follows], [one.mouths() for one in self.follows]
        for one in self.follows:
            known, found, more = one.blinks()
            lid, mouth = pooled([one.lids()]), pooled([one.mouths()])
            own, reference = one.jitter()
            yield (
                one.clip.name,
                f"inner {one.difference():.1%} from MediaPipe; lids {lid.correlation:.2f}, {lid.slope:.2f}; mouth "
                f"{mouth.correlation:.2f}, {mouth.slope:.2f}; blinks {found} of {known} and {more} more; jitter "
                f"{own:.2%} ({reference:.2%}); lost {int(one.landmarks[:, 0, 0].isnan().sum())} of "
                f"{len(one.landmarks)}; {one.milliseconds:.1f} ms a frame with tracking",
            )
        yield "clips: inner landmarks from MediaPipe", f"{self.difference():.2%}"
        yield "clips: lids, correlation and slope", "{:.2f}, {:.2f}".format(*pooled(lids))
        yield "clips: mouth, correlation and slope", "{:.2f}, {:.2f}".format(*pooled(mouths))
        blinks = [one.blinks() for one in self.follows]
        yield "clips: blinks", "{1} of {0} found, {2} more".format(*(sum(each) for each in zip(*blinks, strict=True)))
        own, reference = (torch.cat(each) for each in zip(*(one.closed() for one in self.follows), strict=True))
        yield "opening of closed eyes, of open ones", f"{own.nanmean():.2f} (reference {reference.nanmean():.2f})"
        own, reference = torch.tensor([one.jitter() for one in self.follows]).nanmean(0).tolist()
        yield "jitter of calm frames, of the eyes' distance", f"{own:.2%} (MediaPipe, tracking: {reference:.2%})"
        for way, counts in self.verdicts.items():
            yield way, ", ".join(f"{counts[kind]} {kind}" for kind in ("right", "said so", "wrong"))
        yield "a face, one thread", f"{self.milliseconds:.1f} ms, the quickest of 30"

    def difference(self) -> float:
        """Mean difference of inner landmarks from the clips' reference, of the eyes' distance."""
        return float(torch.tensor([one.difference() for one in self.follows]).nanmean())


def inner_error(offsets: Tensor) -> float:
    """Mean length of offsets (...,68,2) of the inner landmarks."""
    return float(offsets[..., INNER, :].norm(dim=-1).nanmean())


def _median(offsets: Tensor) -> float:
    """Median over faces (F,S,68,2): one face where a neighbour was taken does not count for all."""
    return float(offsets[..., INNER, :].norm(dim=-1).nanmean((1, 2)).nanmedian())


def outcome(finder: LandmarkFinder, data: Path) -> Outcome:
    """Shows a finder all faces."""
    filmed = clips(data)
    verdicts = {
        way: Counter(verdict(one, see(finder, one)) for one in pictures)
        for way, pictures in hostile(spoilt(data, filmed))
    }
    face = Picture(filmed[0].frames[0], filmed[0].reference[0])
    box, spent = box_around(face.landmarks), []
    for _ in range(30):
        begin = time.perf_counter()
        finder(face.image, box, 0.0)
        spent.append(1000 * (time.perf_counter() - begin))
    return Outcome(
        errors(finder, by_hand(data)),
        errors(finder, by_dlib(data)),
        [follow(finder, clip) for clip in filmed],
        verdicts,
        min(spent),
    )


def _picture(path: Path, landmarks: Tensor) -> Picture:
    image = (load_image(path) * 255).round().to(torch.uint8)
    return Picture(image if image.ndim == 3 else image.expand(3, -1, -1).contiguous(), landmarks)


def _gif(path: Path) -> list[Tensor]:
    capture, frames = cv2.VideoCapture(str(path)), []
    while (read := capture.read())[0]:
        frames.append(torch.from_numpy(read[1][..., ::-1].copy()).permute(2, 0, 1))
    return frames


def _turned(picture: Picture, angle: float) -> Picture:
    """Turned about the face's middle, on a square that holds three faces."""
    middle = picture.landmarks[INNER].mean(0)
    side = math.ceil(3 * float(box_around(picture.landmarks)[2]))
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    shift = side / 2 - turn @ middle
    way = torch.cat([turn, shift[:, None]], 1).double().numpy()
    image = cv2.warpAffine(_rows(picture.image), way, (side, side), flags=cv2.INTER_LINEAR)
    return replace(picture, image=_planes(image), landmarks=picture.landmarks @ turn.T + shift)


def _half_black(picture: Picture) -> Picture:
    """What lies to the viewer's right of the face's middle line is black."""
    marks = picture.landmarks
    along = marks[45] - marks[36]
    middle = (marks[27] + marks[33]) / 2
    rows, columns = torch.meshgrid(*(torch.arange(float(n)) for n in picture.image.shape[1:]), indexing="ij")
    reach = float(box_around(marks)[2])
    aside = (columns - middle[0]) * along[0] + (rows - middle[1]) * along[1] > 0
    near = ((columns - middle[0]).abs() < reach) & ((rows - middle[1]).abs() < reach)
    return replace(picture, image=picture.image * ~(aside & near))


def _black(picture: Picture, rows: slice) -> Picture:
    """A black rectangle over some landmarks and a margin round them."""
    marks = picture.landmarks[rows]
    margin = 0.15 * picture.width
    low = (marks.amin(0) - margin).long().clamp(min=0).tolist()
    high = (marks.amax(0) + margin).long().clamp(min=0).tolist()
    image = picture.image.clone()
    image[:, low[1] : high[1], low[0] : high[0]] = 0
    return replace(picture, image=image)


def _blurred(picture: Picture) -> Picture:
    image = cv2.GaussianBlur(_rows(picture.image), (0, 0), 0.06 * picture.width)
    return replace(picture, image=_planes(image))


def _small(picture: Picture) -> Picture:
    """Made so small that the face's box has 24 pixels."""
    scale = min(1.0, 24 / float(box_around(picture.landmarks)[2]))
    size = tuple(max(1, round(n * scale)) for n in reversed(picture.image.shape[1:]))
    image = cv2.resize(_rows(picture.image), size, interpolation=cv2.INTER_AREA)
    ratio = torch.tensor([n / m for n, m in zip(size, reversed(picture.image.shape[1:]), strict=True)])
    return replace(picture, image=_planes(image), landmarks=(picture.landmarks + 0.5) * ratio - 0.5)


def _rows(image: Tensor) -> np.ndarray:
    return np.ascontiguousarray(image.permute(1, 2, 0).numpy())


def _planes(image: np.ndarray) -> Tensor:
    return torch.from_numpy(image).permute(2, 0, 1).contiguous()
