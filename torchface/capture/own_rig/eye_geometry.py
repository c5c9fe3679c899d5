"""Geometry of eyes before a camera: how far lids are open, where eyeballs look, and which shapes say so."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.spheres import nearest_sphere
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, mapping

CORNERS = ((36, 39), (42, 45))
"""Corners of the right eye and the left one among the 68 landmarks."""
_LIDS = (((37, 41), (38, 40)), ((43, 47), (44, 46)))  # the lids' landmarks across from each other
LOOKS = (
    *("eyeLookInRight", "eyeLookOutRight", "eyeLookInLeft", "eyeLookOutLeft"),
    *("eyeLookUpRight", "eyeLookDownRight", "eyeLookUpLeft", "eyeLookDownLeft"),
)
"""The shapes that turn the eyes, in the order of :func:`look_weights`."""
SIDEWAYS, UPWARD = 0.52, 0.45
"""Rotation of an eye at weight 1 where no eyeball shows it, radians: 30 degrees to the side, 26 up and down."""

# Millimetres: an eyeball's middle lies behind the middle of its corners, above it and further out; its iris before it.
_BEHIND, _ABOVE, _OUTWARD, _IRIS = 9.5, 1.8, 1.8, 11.5
_WIDEST = 0.9  # of an eyeball's radius
_LEAST_TURN = 0.1  # radians; eyeballs that turn less are turned by something else than shapes
SURELY_OPEN, SURELY_SHUT = 0.3, 0.9
_LEAST_OPEN = 0.15  # of an eye that is surely not shut
_ASYMMETRY = 0.2  # how much a difference of two eyes counts that is no wink
_DRIFT = 0.2  # of the iris's way to the side, by which a network's corners of the eye follow it
_IRIS_SHOWS = (0.1, 0.35)  # openness, 0 shut and 1 as at rest, from which an iris begins to count, and counts fully
_FOLLOWERS = ("eyeWide", "eyeSquint")
_UNSEEN = 0.3  # of an eye that is hidden, its twin's openness counts for less


@dataclass(frozen=True, eq=False)
class Eyeballs:
    """Eyeballs of a rig, the right one first.

    Example:
        >>> from torchface.synthetic import performer
        >>> Eyeballs.of(performer(texture=False)).turns.rad2deg().round().tolist()
        [30.0, 30.0, 30.0, 30.0, 26.0, 26.0, 26.0, 26.0]
    """

    centre: Tensor  # beside the middle of the eye's corners, in the head's axes, (2,3) millimetres
    radius: Tensor  # from there to the iris, (2,) millimetres
    turns: Tensor  # by what each shape of `LOOKS` turns its eye at weight 1, (8,) radians

    @staticmethod
    def usual() -> "Eyeballs":
        """As people have them, float64."""
        out = torch.tensor([[-_OUTWARD, _ABOVE, -_BEHIND], [_OUTWARD, _ABOVE, -_BEHIND]]).double()
        return Eyeballs(out, torch.full((2,), _IRIS).double(), torch.tensor([SIDEWAYS] * 4 + [UPWARD] * 4).double())

    @staticmethod
    def of(rig: BlendshapeRig) -> "Eyeballs":
        """By a rig's regions ``eyeball_right`` and ``eyeball_left`` and its 68 landmarks; what those do not show is as
        people have it.

        Of shapes that are halves or have no twin among ARKit's, and of eyeballs that a joint turns, the turn is the
        usual one.
        """
        made, notes = Eyeballs.usual(), rig.neutral.annotations
        if notes is None or notes.landmarks is None or len(notes.landmarks) != COUNT:
            return made
        regions, marks = notes.regions, rig.vertices[notes.landmarks].detach().double()
        names = arkit_names(rig.names)
        for eye, (side, corners) in enumerate(zip(("right", "left"), CORNERS, strict=True)):
            mask = regions.get(f"eyeball_{side}")
            if mask is None or int(mask.sum()) < 4:
                continue
            ball = rig.vertices[mask].detach().double()
            middle = nearest_sphere(ball)[0]
            made.centre[eye] = middle - 0.5 * (marks[corners[0]] + marks[corners[1]])
            made.radius[eye] = (ball - middle).norm(dim=1).mean()
            for row, look in enumerate(LOOKS):
                if look.lower().endswith(side) and look in names:
                    moved = rig.deltas[names.index(look)][mask].detach().double()
                    angle = _turn(ball - middle, ball + moved - middle)
                    made.turns[row] = angle if angle > _LEAST_TURN else made.turns[row]
        return made


def _turn(before: Tensor, after: Tensor) -> float:
    """The angle between the sight of an eyeball's points (K,3) before and after they moved, radians."""
    left, _, right = torch.linalg.svd((before - before.mean(0)).T @ (after - after.mean(0)))
    turned = (left @ right)[2]  # where what looked along z looks now
    return float(torch.atan2(turned[:2].norm(), turned[2]))


def arkit_names(names: Sequence[str]) -> list[str]:
    """What ARKit calls each shape; its own name where ARKit knows none."""
    called = zip(names, mapping(names, ARKIT).T, strict=True)
    return [ARKIT[int(column.argmax())] if bool(column.any()) else name for name, column in called]


# What both lids move up by with eyes that look up, in weights of eyeWide and of eyeSquint a weight of eyeLookUp. The
# two together leave the eye as open as it is, so that a picture hardly shows them beside another person's lids. In six
# real takes eyeWide follows by 0.2 to 1.0 and eyeSquint by 0.2 to 0.8, of which a network reads a part. Eyes that close
# do not follow.
_FOLLOWED, _CLOSING = 0.25, 0.2


def lid_followers(names: Sequence[str]) -> Tensor:
    """Which shapes are eyeLookUp, which eyeBlink, and which are the lids that follow, of the right and the left eye,
    (3,2,N); zero where a rig lacks one of them."""
    called = arkit_names(names)
    tables = torch.zeros(3, 2, len(called))
    for eye, side in enumerate(("Right", "Left")):
        rows = [[f"{name}{side}" for name in kinds] for kinds in (("eyeLookUp",), ("eyeBlink",), _FOLLOWERS)]
        if all(name in called for some in rows for name in some):
            for table, some in zip(tables, rows, strict=True):
                table[eye, [called.index(name) for name in some]] = 1
    return tables


def with_following_lids(weights: Tensor, followers: Tensor) -> Tensor:
    """Weights (...,N) with lids that follow eyes which look up; ``followers`` (3,2,N) are of :func:`lid_followers`.

    Source: Becker, Fuchs 1988: lids move with the eyes up and down.
    """
    up, blink, lids = followers.to(weights)
    follow = _FOLLOWED * (weights @ up.T) * (1 - weights @ blink.T / _CLOSING).clamp(0, 1)
    return (weights + follow @ lids).clamp(0, 1)


def openness_of(landmarks: Tensor) -> Tensor:
    """The distance of the lids over that of the eye's corners, (B,2), of landmarks (B,68,C)."""
    eyes = []
    for (right, left), pairs in zip(CORNERS, _LIDS, strict=True):
        apart = sum((landmarks[:, a] - landmarks[:, b]).norm(dim=-1) for a, b in pairs) / len(pairs)
        eyes.append(apart / (landmarks[:, right] - landmarks[:, left]).norm(dim=-1))
    return torch.stack(eyes, dim=1)


def openness_rows(rest: Tensor, basis: Tensor, names: Sequence[str]) -> tuple[Tensor, Tensor]:
    """What a unit of each shape adds to each eye's openness, 0 shut and 1 at rest, (2,N); and the rig's at rest,
    (2,)."""
    at_rest = openness_of(rest[None])[0]
    moved = openness_of((rest[..., None] + basis).permute(2, 0, 1)).T - at_rest[:, None]
    blinks = [names.index(f"eyeBlink{side}") if f"eyeBlink{side}" in names else -1 for side in ("Right", "Left")]
    way = torch.stack([-moved[eye, row] if row >= 0 else at_rest[eye] for eye, row in enumerate(blinks)])
    return moved / way[:, None], at_rest


def seen_gaze(rays: Tensor, iris: Tensor, rotation: Tensor, depth: Tensor, eyes: Eyeballs | None = None) -> Tensor:
    """Where the eyes look beside the head, (...,2,2) radians: to the person's left, up.

    The line of sight goes from the middle of an eyeball, which lies behind the middle of the eye's corners, through
    the iris.

    Args:
        rays: of the 68 landmarks, (...,68,2), at depth 1.
        iris: of the irises, (...,2,2).
        rotation: head to camera, (...,3,3).
        depth: of the eyes, (...,2), millimetres.
    """
    eyes = eyes or Eyeballs.usual()
    radius = eyes.radius.to(rays)[:, None]
    middle = torch.stack([0.5 * (rays[..., a, :] + rays[..., b, :]) for a, b in CORNERS], dim=-2)
    centre = (eyes.centre.to(rays) @ rotation.transpose(-1, -2))[..., :2]
    across = (iris - middle) * depth[..., None] - centre
    length = across.square().sum(-1, keepdim=True).sqrt()
    across = across * (_WIDEST * radius / length.maximum(_WIDEST * radius))
    toward = -(radius.square() - across.square().sum(-1, keepdim=True)).sqrt()
    sight = torch.cat([across, toward], dim=-1) @ rotation / radius
    up = sight[..., 1].clamp(-0.95, 0.95)
    side = (sight[..., 0] / (1 - up.square()).sqrt()).clamp(-0.95, 0.95)
    # ONNX Runtime has the arc sine of float32 alone.
    return torch.asin(torch.stack([side, up], dim=-1).float()).to(rays)


def undrifted(rays: Tensor, iris: Tensor) -> Tensor:
    """Irises (...,2,2) as far from the middle of the eye's corners as they are, of landmarks (...,68,2) that a network
    found: its corners of the eye follow the iris to the side, by a fifth of its way.

    In 10 films of rendered people irises moved by 0.75 of their way beside the corners that were found, in the median,
    and by 1.0 beside the true ones.
    """
    middle = torch.stack([0.5 * (rays[..., a, :] + rays[..., b, :]) for a, b in CORNERS], dim=-2)
    along = torch.stack([rays[..., b, :] - rays[..., a, :] for a, b in CORNERS], dim=-2)
    share = ((iris - middle) * along).sum(-1, keepdim=True) / along.square().sum(-1, keepdim=True).clamp(min=1e-12)
    return iris + _DRIFT / (1 - _DRIFT) * share * along


def shown_iris(part: Tensor) -> Tensor:
    """How much of an iris is seen, in [0,1], of an eye that is open by a part, 0 shut and 1 as at rest: lids that close
    leave a network to guess it, somewhere between them."""
    low, high = _IRIS_SHOWS
    return ((part - low) / (high - low)).clamp(0, 1)


def look_weights(gaze: Tensor, turns: Tensor | None = None) -> Tensor:
    """Weights of ``LOOKS``, (...,8) in [0,1], of gaze (...,2,2); ``turns`` (8,) are a rig's, as is usual if absent."""
    side, up = gaze[..., 0], gaze[..., 1]
    # To the person's left is toward the nose for the right eye.
    made = torch.stack([side[..., 0], -side[..., 0], -side[..., 1], side[..., 1],
                        up[..., 0], -up[..., 0], up[..., 1], -up[..., 1]], dim=-1)  # fmt: skip
    turns = Eyeballs.usual().turns if turns is None else turns
    return (made / turns.to(gaze)).clamp(0, 1)


def gaze_of_looks(weights: Tensor, turns: Tensor) -> Tensor:
    """Where eyes look, (...,2,2) radians to the person's left and up, that have weights (...,8) of ``LOOKS``."""
    turned = weights * turns.to(weights)
    side = torch.stack([turned[..., 0] - turned[..., 1], turned[..., 3] - turned[..., 2]], dim=-1)
    up = torch.stack([turned[..., 4] - turned[..., 5], turned[..., 6] - turned[..., 7]], dim=-1)
    return torch.stack([side, up], dim=-1)


def judged_openness(part: Tensor, closed: Tensor, trust: Tensor) -> tuple[Tensor, Tensor]:
    """How open eyes are with what is known of whether they are shut and of each other, and how much that counts.

    An eye that is surely shut is at 0, one that surely is not is never near it, and a hidden one is about as its twin.
    Where no eye is shut and the other is not, what one is more open than the other counts little: in six real takes
    ``eyeBlink`` of both differs by more than 0.1 in one frame of 300.

    Args:
        part: openness beside the person's own, 0 shut and 1 at rest, (...,2).
        closed: how likely each is shut, (...,2); NaN where nobody said.
        trust: how much each openness counts, (...,2) in [0,1].
    """
    shut = torch.where(torch.isnan(closed), 0.0, closed)
    sure = ((shut - 0.5) / (SURELY_SHUT - 0.5)).clamp(0, 1)
    least = _LEAST_OPEN * (1 - shut / SURELY_OPEN).clamp(0, 1) * ~torch.isnan(closed)
    part = torch.maximum(part, least) * (1 - sure)
    twin, twin_trust = part.flip(-1), _UNSEEN * trust.flip(-1)
    total = trust + twin_trust * (1 - trust)
    part = (trust * part + twin_trust * (1 - trust) * twin) / total.clamp(min=1e-6)
    both = (total * part).sum(-1, keepdim=True) / total.sum(-1, keepdim=True).clamp(min=1e-6)
    apart = (shut - shut.flip(-1)).abs()
    wink = ((apart - 0.5) / (SURELY_SHUT - 0.5)).clamp(_ASYMMETRY, 1).where(~torch.isnan(closed), 1.0)
    return both + wink * (part - both), total
