"""A rig's report of teeth, gums and eyes that stand out of the skin."""

from __future__ import annotations

from dataclasses import dataclass

from torchface.modeling import InnerParts, shape_depths
from torchface.modeling.rigging.penetration import TOLERANCE
from torchface.rig import BlendshapeRig


@dataclass(frozen=True)
class Penetration:
    """The parts inside a head before its skin, at rest and in every shape at weight 1.

    Args:
        deepest: how far a vertex of a part stands out at most, millimetres; see ``InnerParts.depth``.
        pose: the shape in which it does, or ``rest``.
        vertices: how many stand out by more than the tolerance, in the pose where most do.
        poses: the poses in which some do.
    """

    deepest: float
    pose: str
    vertices: int
    poses: tuple[str, ...]

    def line(self) -> str:
        """For people to read."""
        if not self.poses:
            return f"parts: teeth, gums and eyes stay behind the skin in every shape, to {TOLERANCE:g} mm"
        named = ", ".join(self.poses[:5]) + (", ..." if len(self.poses) > 5 else "")
        return (
            f"parts: up to {self.vertices} vertices of teeth, gums or eyes stand out of the skin by more than "
            f"{TOLERANCE:g} mm, by {self.deepest:.1f} mm in {self.pose}; in {named}"
        )


def penetration(rig: BlendshapeRig, parts: InnerParts) -> Penetration | None:
    """The penetration of a rig; None where the head has no parts inside."""
    if len(parts.vertices) == 0:
        return None
    depths = shape_depths(rig, parts)
    poses = ("rest", *rig.names)
    deepest, out = depths.amax(1), (depths > TOLERANCE).sum(1)
    worst = int(deepest.argmax())
    standing = tuple(name for name, count in zip(poses, out.tolist(), strict=True) if count)
    return Penetration(float(deepest[worst]), poses[worst], int(out.max()), standing)
