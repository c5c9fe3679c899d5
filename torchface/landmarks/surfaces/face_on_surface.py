"""A face found on a surface in any pose and unit: seen in pictures from around, its points placed by rays."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from torchface.errors import AlignmentError
from torchface.geometry.cameras.pinhole import Camera, look_at
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.landmarks.images.boxes.face_box import FaceBoxes, FaceDetector
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.ibug_68 import COUNT, INNER, box_around
from torchface.landmarks.images.landmark_finder import LandmarkFinder
from torchface.progress import Progress, silent
from torchface.rendering.textured_surface import TexturedSurface

_SIDE, _CLOSE_SIDE = 320, 384  # pixels of the pictures from around, and of those from near
_RINGS = ((0.0, 10), (28.0, 9), (-28.0, 9), (58.0, 5), (-58.0, 5), (90.0, 1), (-90.0, 1))  # pitch, directions in it
_SURE = 0.7  # score of a face from which no further ring is looked at
_CLOSE = ((0.0, 0.0), (-16.0, 0.0), (16.0, 0.0), (-32.0, 0.0), (32.0, 0.0), (0.0, 14.0), (0.0, -14.0))
_CLOSE_SPAN = 2.6  # of the picture, in extents of the reference's landmarks
_ROUNDS, _FEWER = 2, 5  # and how many of the close views the first has
_EYES = (36, 45)
_LEAST_POINTS = 12
_SLANTED = 0.25  # cosine between ray and normal below which a hit says nothing
_ASTRAY = 0.5  # of the eyes' distance: a view's hit that is further from the median of all is left out
_TRIED = 3  # places that are looked at from near
_HOLE, _AROUND_OPENING = 0.5, 0.25  # of the eyes' distance: behind where a face has a point, and round eyes and mouth
_OPENINGS = (slice(36, 42), slice(42, 48), slice(48, 68))
_LOST = 0.07  # of the eyes' distance: what is off by more on the reference is no habit of the finder
_PRESENCE = 0.7
MISFIT = 0.35
"""Of the eyes' distance: how far a face's landmarks may lie from a head's."""
_DOUBT = 0.2  # above it other places are looked at too, from all around and in clay; most faces are below
_FACE_OF_HEAD = 0.5  # side of the box round a face, in sides of a picture that frames the head


@dataclass(frozen=True, eq=False)
class ReferencePoints:
    """Where a reference head has what finders find, millimetres, upright and looking along z."""

    landmarks: Tensor  # iBUG's 68, (68,3)
    points: Tensor  # the other points of the finder, (P,3)
    # The head, painted (True) or in clay; where it is given, what the finder always has off on it is taken out of what
    # it finds on surfaces that are painted or not.
    surface: Callable[[bool], TexturedSurface] | None = None

    @property
    def all(self) -> Tensor:
        """The 68, then the others, (68+P,3) float64."""
        return torch.cat([self.landmarks, self.points]).double()


@dataclass(frozen=True, eq=False)
class FaceOnSurface:
    """A face on a surface."""

    points: Tensor  # of the reference on the surface, (68+P,3) in its unit, NaN where none was seen
    pose: Similarity  # the similarity that takes the reference to the surface; its scale holds the unit
    presence: float  # how likely the pictures from near show a face, their mean, in [0,1]
    misfit: float  # root mean square distance of the points from the reference in pose, in distances of the eyes
    views: tuple[Tensor, ...]  # pictures from near with what was found, (3,H,W) each
    others: Tensor  # middles of other faces on the surface, (K,3)

    @property
    def doubt(self) -> float:
        """How far the face is from one beyond doubt, at 0."""
        return 1 - self.presence + self.misfit

    @property
    def middle(self) -> Tensor:
        """Of brows, eyes, nose and mouth, (3,)."""
        inner = self.points[INNER]
        return inner[torch.isfinite(inner).all(-1)].mean(0)


class NoFaceOnSurfaceError(AlignmentError):
    """A surface shows no face; ``likeness`` is the score, from afar, of a face that pictures show though its form is
    none."""

    def __init__(self, message: str, views: Sequence[Tensor], likeness: float = 0.0) -> None:
        super().__init__(message)
        self.views, self.likeness = tuple(views), likeness


@dataclass(frozen=True, eq=False)
class FaceSearch:
    """What finds a face on surfaces."""

    detector: FaceDetector  # of faces in pictures, at any roll
    finder: LandmarkFinder
    reference: ReferencePoints  # where a head has those points
    # Of directions from which the surface is seen, the likeliest first: pitch in degrees and their number.
    rings: tuple[tuple[float, int], ...] = _RINGS

    def find(
        self, surface: TexturedSurface, framed: Tensor | None = None, progress: Progress | None = None
    ) -> FaceOnSurface:
        """The face on a surface of any unit and turn: the one that most pictures show; they frame the vertices
        ``framed`` (V,)."""
        progress = progress or silent
        pictures: list[Tensor] = []
        refused: NoFaceOnSurfaceError | None = None
        doubtful: list[tuple[FaceOnSurface, float]] = []
        # What is taken for a face for sure may be none from near, or hardly one; then all directions are looked at.
        painted = any(one.texture is not None for one in surface.materials) or len(surface.materials) > 1
        for sure, plain in product((_SURE, torch.inf), (False, True) if painted else (False,)):
            for group, others in self._candidates(surface, framed, sure, plain, pictures, progress):
                try:
                    found = self._from_near(surface, group, others, progress)
                except NoFaceOnSurfaceError as error:
                    refused = error if refused is None or error.likeness > refused.likeness else refused
                else:
                    if found.doubt < _DOUBT:
                        return found
                    doubtful.append((found, group.score))
            if refused is None and not doubtful and plain == painted:
                break
        if doubtful:
            best, score = min(doubtful, key=lambda one: one[0].doubt / max(one[1], 1e-6))
            # Beside a surer face of another form, such as one with a long muzzle, what is doubtful is a false one.
            if refused is None or refused.likeness < score:
                return best
        raise refused or NoFaceOnSurfaceError(
            f"found no face in {len(pictures)} pictures from around, expected a head", pictures
        )

    def _candidates(
        self,
        surface: TexturedSurface,
        framed: Tensor | None,
        sure: float,
        plain: bool,
        pictures: list[Tensor],
        progress: Progress,
    ) -> "list[tuple[_Sighting, Tensor]]":
        """The surest sightings, each of another place, and where other faces are."""
        seen: list[_Sighting] = []
        for frame in [framed, None] if framed is not None and bool(framed.any()) else [None]:
            seen = seen or self._around(surface, frame, plain, sure, pictures, progress)
        groups, found = _places(seen), []
        for group in groups[:_TRIED]:
            others = [one[0].middle for one in groups if one is not group and len(one) > 1 and one[0].score > 0.5]
            found.append((group[0], torch.stack(others) if others else torch.zeros(0, 3, dtype=torch.float64)))
        return found

    def _around(
        self,
        surface: TexturedSurface,
        framed: Tensor | None,
        plain: bool,
        sure: float,
        pictures: list[Tensor],
        progress: Progress,
    ) -> "list[_Sighting]":
        """The faces in pictures from around; from above and below only where those on the level show none for sure."""
        rows = surface.faces.unique() if framed is None else framed.nonzero()[:, 0]
        corners = surface.vertices[rows]
        low, high = corners.amin(0), corners.amax(0)
        middle, span = (low + high) / 2, 1.05 * float((corners - (low + high) / 2).norm(dim=-1).max()) * 2
        found: list[_Sighting] = []
        for number, (pitch, count) in enumerate(self.rings):
            if found and max(one.score for one in found) >= sure:
                break
            for step in range(count):
                progress("looking for the face", len(pictures), 0)
                camera = look_at(middle, 360 * (step + 0.5 * (number % 2)) / count, pitch, span, _SIDE, _SIDE)
                picture = surface.draw(camera, plain).picture
                pictures.append(picture)
                image = _bytes(picture)
                faces = self.detector(image)
                if framed is not None and not len(faces.boxes):
                    faces = _where_a_head_has_it()
                for box, score, tilt in zip(faces.boxes, faces.scores.tolist(), faces.tilts.tolist(), strict=True):
                    reading = self.finder(image, box, tilt)
                    sighting = self._sighting(surface, camera, reading, score, plain)
                    if sighting is not None and float(reading.presence) >= _PRESENCE:
                        found.append(sighting)
        return found

    def _sighting(
        self, surface: TexturedSurface, camera: Camera, reading: FaceReading, score: float, plain: bool
    ) -> "_Sighting | None":
        hits = _hits(surface, camera, reading.landmarks[INNER], plain)
        if int(torch.isfinite(hits).all(-1).sum()) < _LEAST_POINTS:
            return None
        eyes = float((self.reference.landmarks[_EYES[0]] - self.reference.landmarks[_EYES[1]]).norm())
        inner = self.reference.landmarks[INNER].double()
        pose, misfit = _robust_pose(inner, hits)
        holes = _through_holes(inner, pose.inverse().apply(hits)[0], self.reference.landmarks)
        if holes.any():
            pose, misfit = _robust_pose(inner, hits.masked_fill(holes[:, None], torch.nan))
        middle = pose.apply(self.reference.landmarks[INNER].double().mean(0)[None])[0, 0]
        size = float(pose.scale[0]) * eyes
        return _Sighting(
            pose, middle, size, score * float(reading.presence) / (1 + (misfit / eyes / MISFIT) ** 2), plain
        )

    def _from_near(
        self, surface: TexturedSurface, first: "_Sighting", others: Tensor, progress: Progress
    ) -> FaceOnSurface:
        reference = self.reference.all
        eyes = float((reference[_EYES[0]] - reference[_EYES[1]]).norm())
        pose = first.pose
        views: list[Tensor] = []
        points, presence, bias = torch.full_like(reference, torch.nan), 0.0, torch.zeros_like(reference)
        for attempt in range(_ROUNDS):
            # In the reference's place the face looks along z, whatever way the surface is turned.
            near = surface.moved(pose.inverse())
            cameras = _close_cameras(self.reference.landmarks)[: None if attempt else _FEWER]
            found, views, read = self._look(near, cameras, first.plain, progress)
            if attempt and self.reference.surface is not None:
                painted = not first.plain and _is_painted(near, cameras[0], self.reference.landmarks)
                bias = self._look(self.reference.surface(painted), cameras, False, progress)[0] - reference
                bias[bias.norm(dim=-1) > _LOST * eyes] = 0.0
                bias[:COUNT] = 0.0  # the 68 follow annotators' habits, not the reference's vertices
            found = found - torch.nan_to_num(bias)
            found[_through_holes(reference, found, self.reference.landmarks)] = torch.nan
            if int(torch.isfinite(found).all(-1).sum()) < _LEAST_POINTS:
                break
            better, _ = _robust_pose(reference[INNER.start :], found[INNER.start :])
            points = pose.apply(found)[0]
            pose = _after(pose, better)
            presence = sum(sorted(read)[-3:]) / 3
        fit = pose.inverse().apply(points)[0] - reference
        fit = fit[INNER.start :]
        misfit = float(fit[torch.isfinite(fit).all(-1)].square().sum(-1).mean().sqrt()) / eyes
        result = FaceOnSurface(points, pose, presence, misfit, tuple(views), others)
        if not (presence >= _PRESENCE and misfit <= MISFIT):
            raise NoFaceOnSurfaceError(
                f"found what looks like a face from afar but not from near: presence {presence:.2f} (expected at least "
                f"{_PRESENCE:g}), its landmarks lie {misfit:.0%} of the eyes' distance from a head's (expected at most "
                f"{MISFIT:.0%})",
                views,
                first.score if presence >= _PRESENCE else 0.0,
            )
        return result

    def _look(
        self, near: TexturedSurface, cameras: Sequence[Camera], plain: bool, progress: Progress
    ) -> tuple[Tensor, list[Tensor], list[float]]:
        """The points (68+P,3) on a surface in the reference's place, what was seen, and how likely each is a face."""
        eyes = float((self.reference.landmarks[_EYES[0]] - self.reference.landmarks[_EYES[1]]).norm())
        seen, views, read = [], [], []
        for number, camera in enumerate(cameras):
            progress("looking at the face", number, len(cameras))
            picture = near.draw(camera, plain, (-1.0) ** number).picture
            box = box_around(camera.project(self.reference.landmarks.double())).float()
            reading = self.finder(_bytes(picture), box, 0.0)
            seen.append(_placed(near, camera, reading, plain, eyes))
            views.append(_marked(picture, reading))
            read.append(float(reading.presence))
        return _together([one[0] for one in seen], [one[1] for one in seen], _ASTRAY * eyes), views, read


@dataclass(frozen=True, eq=False)
class _Sighting:
    """A face in one picture: its pose, middle and size on the surface, and how sure it is."""

    pose: Similarity
    middle: Tensor
    size: float
    score: float
    plain: bool


def _where_a_head_has_it() -> FaceBoxes:
    """The box in which a picture of a head alone shows its face: for faces that the detector does not know as such."""
    side = _FACE_OF_HEAD * _SIDE
    middle = 0.5 * _SIDE, 0.5 * _SIDE + 0.15 * side
    box = torch.tensor([[middle[0] - side / 2, middle[1] - side / 2, side, side]])
    return FaceBoxes(box, torch.tensor([0.5]))


def _places(seen: list[_Sighting]) -> list[list[_Sighting]]:
    """Sightings that agree on where a face is together, the surest first, in each too."""
    groups: list[list[_Sighting]] = []
    for one in sorted(seen, key=lambda sighting: -sighting.score):
        for group in groups:
            if float((one.middle - group[0].middle).norm()) < max(one.size, group[0].size):
                group.append(one)
                break
        else:
            groups.append([one])
    return sorted(groups, key=lambda group: -sum(one.score for one in group))


def _close_cameras(landmarks: Tensor) -> list[Camera]:
    inner = landmarks[INNER]
    middle = inner.double().mean(0)
    span = _CLOSE_SPAN * float((inner.amax(0) - inner.amin(0)).max())
    return [look_at(middle, yaw, pitch, span, _CLOSE_SIDE, _CLOSE_SIDE) for yaw, pitch in _CLOSE]


def _placed(
    surface: TexturedSurface, camera: Camera, reading: FaceReading, plain: bool, eyes: float
) -> tuple[Tensor, Tensor]:
    """Where a reading's points lie on the surface, (68+P,3), and their weights (68+P,)."""
    pixels = torch.cat([reading.landmarks, reading.points])
    deviation = torch.cat([reading.deviation, reading.point_deviation]).double()
    hits = _hits(surface, camera, pixels, plain)
    visible = torch.cat([reading.visibility.double(), torch.ones(len(reading.points), dtype=torch.float64)])
    weight = visible * float(reading.presence) / (deviation.square() + 1)
    away = (hits - camera.centre).norm(dim=-1)
    weight[away < 0.2 * eyes] = 0
    return hits, torch.where(torch.isfinite(hits).all(-1), weight, 0.0)


def _is_painted(surface: TexturedSurface, camera: Camera, landmarks: Tensor) -> bool:
    """Whether most of a face that is seen from the front has a texture."""
    hits, _ = surface.first_opaque(*_rays(camera, camera.project(landmarks.double()[INNER])))
    textured = torch.tensor([one.texture is not None for one in surface.materials])
    return bool(textured[surface.material[hits.triangle[hits.triangle >= 0]]].double().mean() > 0.5)


def _rays(camera: Camera, pixels: Tensor) -> tuple[Tensor, Tensor]:
    ones = torch.ones(len(pixels), 1, dtype=torch.float64)
    ways = torch.cat([pixels.double(), ones], 1) @ torch.linalg.inv(camera.intrinsics).T @ camera.rotation
    ways = torch.nn.functional.normalize(ways, dim=-1)
    return camera.centre.expand_as(ways), ways


def _hits(surface: TexturedSurface, camera: Camera, pixels: Tensor, plain: bool) -> Tensor:
    """Where rays through pixels (N,2) meet a surface, (N,3) float64; NaN for those that miss or graze it."""
    origins, ways = _rays(camera, pixels)
    hits, _ = surface.first_opaque(origins, ways, plain)
    points = origins + hits.distance[:, None] * ways
    missed = (hits.triangle < 0) | (surface.facing(hits, ways) < _SLANTED)
    return points.masked_fill(missed[:, None], torch.nan)


def _together(points: Sequence[Tensor], weights: Sequence[Tensor], astray: float) -> Tensor:
    """The views' points (N,3) as one: the weighted mean of those near the median; NaN where no view has one."""
    stacked, weight = torch.stack(list(points)), torch.stack(list(weights))
    known = torch.isfinite(stacked).all(-1)
    filled = torch.where(known[..., None], stacked, 0.0)
    order = filled.argsort(0)
    sorted_weight = torch.gather(weight[..., None].expand_as(filled), 0, order)
    half = sorted_weight.cumsum(0) >= sorted_weight.sum(0, keepdim=True) / 2
    median = torch.gather(torch.gather(filled, 0, order), 0, half.double().argmax(0, keepdim=True))[0]
    kept = weight * ((filled - median).norm(dim=-1) < astray)
    total = kept.sum(0)
    mean = (filled * kept[..., None]).sum(0) / total[:, None].clamp(min=1e-12)
    return mean.masked_fill((total <= 0)[:, None], torch.nan)


def _through_holes(reference: Tensor, points: Tensor, landmarks: Tensor) -> Tensor:
    """Which points (N,) of eyes and mouth lie so far behind a face that they are seen through holes; a head has them
    at ``reference`` (N,3)."""
    eyes = (landmarks[_EYES[0]] - landmarks[_EYES[1]]).norm()
    openings = torch.stack([landmarks[one].double().mean(0) for one in _OPENINGS])
    near = torch.cdist(reference, openings).amin(1) < _AROUND_OPENING * eyes
    return near & ((points - reference)[:, 2] < -_HOLE * eyes)


def _robust_pose(reference: Tensor, points: Tensor) -> tuple[Similarity, float]:
    """The similarity of reference points (N,3) to points (N,3) with NaN, few astray; and its residual in the
    reference's unit."""
    known = torch.isfinite(points).all(-1)
    x, y = reference[known], points[known]
    weights = torch.ones(len(x), dtype=torch.float64)
    pose, distance = similarity_transform(x[None], y[None]), weights
    for _ in range(8):
        pose = similarity_transform(x[None], y[None], weights[None])
        distance = (pose.inverse().apply(y)[0] - x).norm(dim=-1)
        scale = 1.5 * float(distance.median()) + 1e-9
        weights = 1 / (1 + (distance / scale).square())
    return pose, float(distance.square().mean().sqrt())


def _after(second: Similarity, first: Similarity) -> Similarity:
    """First one, then the other."""
    rotation = second.rotation @ first.rotation
    moved = second.apply(first.translation[:, None])[:, 0]
    return Similarity(second.scale * first.scale, rotation, moved)


def _bytes(picture: Tensor) -> Tensor:
    return (picture * 255).round().to(torch.uint8)


def _marked(picture: Tensor, reading: FaceReading) -> Tensor:
    """The picture with a dot at every landmark that was found."""
    marked = picture.clone()
    height, width = picture.shape[1:]
    for x, y in torch.cat([reading.points, reading.landmarks]).round().long().tolist():
        if 1 <= x < width - 1 and 1 <= y < height - 1:
            marked[:, y : y + 2, x : x + 2] = torch.tensor([0.1, 0.9, 0.3])[:, None, None]
    return marked
