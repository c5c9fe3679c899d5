"""The rigid motion of a helmet on the head, or of the head in a capture volume."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.geometry.rotations import rotation_matrix, rotation_vector
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.take import Take
from torchface.temporal import nearest_rows

# Rotations are scaled to the motion of a point this far from the pivot, in mm, so that all six columns are of one size.
_ARM = 30.0
_ENOUGH = 6  # markers from which a motion is known beside the expression's
_ROUNDS, _NEAR = 4, 2.0  # millimetres: what is nearer counts in full
_SHAPE_ROUNDS = 3
# Of the markers' mean distance from their centre: farther no helmet slips, and expressions alone seem to move a head by
# less than the second. In fewer frames than the last share markers are wrong.
_SLIPS, EXPRESSIONS, _SHARE_MOVES = 0.3, 0.2, 0.05


@dataclass(frozen=True, eq=False)
class HelmetMotion:
    r"""The motion of the helmet against the head: a point p of the face was seen at :math:`R (p - c) + c + t`.

    Args:
        rotation: :math:`R`, (T,3,3).
        translation: :math:`t`, (T,3), millimetres of rig space.
        pivot: :math:`c`, (3,), the mean of the marker sites at rest.

    Example:
        >>> slip = HelmetMotion(torch.eye(3)[None], torch.tensor([[0.0, 4.0, 0.0]]), torch.zeros(3))
        >>> slip.undo(slip.apply(torch.ones(1, 2, 3))).tolist()
        [[[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]]
    """

    rotation: Tensor
    translation: Tensor
    pivot: Tensor

    def apply(self, points: Tensor) -> Tensor:
        """Where points of the face (T,M,3) were seen."""
        centred = points - self.pivot.to(points)
        moved = centred @ self.rotation.transpose(1, 2).to(points)
        return moved + (self.pivot + self.translation)[:, None].to(points)

    def undo(self, markers: Tensor) -> Tensor:
        """Seen markers (T,M,3) without the helmet's motion."""
        return self.inverse().apply(markers)

    def after(self, first: "HelmetMotion") -> "HelmetMotion":
        """This motion of what another has moved, about that one's pivot."""
        turned = self.rotation @ (first.pivot + first.translation - self.pivot)[..., None]
        translation = turned[..., 0] + self.pivot + self.translation - first.pivot
        return HelmetMotion(self.rotation @ first.rotation, translation, first.pivot)

    def moved_by(self, alignment: Similarity) -> "HelmetMotion":
        """The same motion in the space that one similarity leads to."""
        turn, scale = alignment.rotation[0], alignment.scale[0]
        pivot = alignment.apply(self.pivot[None])[0, 0]
        return HelmetMotion(turn @ self.rotation @ turn.T, scale * self.translation @ turn.T, pivot)

    @staticmethod
    def none(seen: Tensor, pivot: Tensor) -> "HelmetMotion":
        """No motion in as many frames as ``seen`` (T,M,3) has."""
        still = torch.eye(3, dtype=seen.dtype, device=seen.device).repeat(len(seen), 1, 1)
        return HelmetMotion(still, seen.new_zeros(len(seen), 3), pivot)

    def inverse(self) -> Similarity:
        """The rigid motions (T,) that undo it."""
        back = self.rotation.transpose(1, 2)
        translation = self.pivot - (back @ (self.pivot + self.translation)[..., None])[..., 0]
        return Similarity(torch.ones_like(translation[:, 0]), back, translation)

    def degrees(self) -> Tensor:
        """The rotation vectors, (T,3), degrees."""
        return torch.rad2deg(rotation_vector(self.rotation))

    def extent(self) -> str:
        """The largest of it, for people to read."""
        angle = float(self.degrees().norm(dim=1).max())
        return f"{float(self.translation.norm(dim=1).max()):.1f} mm and {angle:.1f} degrees"


def rough_motion(seen: Tensor, rest: Tensor) -> tuple[HelmetMotion, Tensor]:
    """How a frame's markers (T,M,3) lie beside a shape (M,3) as a whole, and the frames (K,) that show it.

    The others have no motion: they show too few markers. Markers far from where most lie count little.
    """
    known = ~torch.isnan(rest).any(-1)
    pivot = rest[known].mean(0)
    found = HelmetMotion.none(seen, pivot)
    rows = ((~torch.isnan(seen).any(-1) & known).sum(1) >= _ENOUGH).nonzero()[:, 0]
    if len(rows):
        sites, marks = rest.expand_as(seen[rows]), seen[rows]
        placed = similarity_transform(sites, marks, scale=False)
        for _ in range(_ROUNDS):  # spikes and exchanged labels count little
            off = (placed.apply(sites) - marks).norm(dim=-1).nan_to_num(0.0)
            usual = off.median(1, keepdim=True).values.clamp(min=_NEAR)
            placed = similarity_transform(sites, marks, 1 / (1 + (off / usual).square()), scale=False)
        found.rotation[rows] = placed.rotation
        found.translation[rows] = placed.rotation @ pivot + placed.translation - pivot
    return found, rows


def free_motion(seen: Tensor, least: float = _SLIPS) -> HelmetMotion | None:
    """The motion of a head that moves freely in a volume, from its markers (T,M,3) alone; None where it moves them by
    less than ``least`` of their mean distance from their centre, as a helmet that slips.

    Frames are moved rigidly onto the shape that they have in the middle, which strong expressions bend: what is left is
    up to 20 degrees where the jaw opens wide, as a helmet's slip. Frames that show too few markers move as the nearest
    one that does not.
    """
    shape = seen[int((~torch.isnan(seen).any(-1)).sum(1).argmax())] if len(seen) else seen.new_zeros(0, 3)
    if int((~torch.isnan(shape).any(-1)).sum()) < _ENOUGH:
        return None
    for _ in range(_SHAPE_ROUNDS):
        found, rows = rough_motion(seen, shape)
        shape = found.undo(seen)[rows].nanmedian(0).values
    path = found.apply(shape.expand(len(seen), -1, -1))[rows]
    away = (path - path.median(0).values).norm(dim=-1).nanmean(1)
    if float(away.quantile(1 - _SHARE_MOVES)) < least * float((shape - shape.nanmean(0)).norm(dim=1).nanmean()):
        return None
    found, rows = rough_motion(seen, path[away.argmin()])
    nearest = rows[nearest_rows(rows, len(seen))]
    return HelmetMotion(found.rotation[nearest], found.translation[nearest], found.pivot)


def steady_take(take: Take) -> tuple[Take, HelmetMotion | None]:
    """A take without the rigid motion of its markers, and that motion; as it is where expressions may be all there is.

    A slipping helmet's motion is taken out, too: what is left of either is solved for with the weights.
    """
    assert take.markers is not None
    values = take.markers.values
    motion = free_motion(values.double(), EXPRESSIONS)
    if motion is None:
        return take, None
    return replace(take, markers=replace(take.markers, values=motion.undo(values.double()).to(values))), motion


def rigid_columns(rest: Tensor, pivot: Tensor) -> Tensor:
    """Six columns of rigid motion (M,3,6) for sites at rest (M,3): along x, y, z, then about them, each of 1 mm."""
    arm = (rest - pivot)[:, None, :].expand(-1, 3, -1)
    axes = torch.eye(3, dtype=rest.dtype, device=rest.device).expand(len(rest), 3, 3)
    rotations = torch.linalg.cross(axes, arm, dim=-1) / _ARM
    return torch.cat([axes, rotations.transpose(1, 2)], dim=2)


def rigid_rotation(weights: Tensor) -> Tensor:
    """The rotations (B,3,3) of weights (B,3) of the last three of ``rigid_columns``."""
    return rotation_matrix(weights / _ARM)
