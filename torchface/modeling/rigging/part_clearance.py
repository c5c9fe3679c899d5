"""Shapes in which no part of a head comes through the skin: shells give way to the lids, skin gives way to bone."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import triangle_normals
from torchface.modeling.rigging.penetration import TOLERANCE, InnerParts, shape_depths
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping

_BONE_MARGIN, _SHELL_MARGIN = 0.15, 0.5
_ALLOWED = 0.1
_MAX_ITERATIONS = 6
_MAX_STEP = 2.0
_SHELL_REACH, _SKIN_REACH = 2.0, 4.0
_STILL = 0.01
_LIFTED, _MAX_DEPTH = 0.3, 3.0
_MIXED_POSES, _MIXED, _MIN_WEIGHT, _MAX_WEIGHT = 32, 3, 0.2, 0.6
_MOVES, _BESIDE = 1.5, 3.0


def clear_parts(rig: BlendshapeRig, parts: InnerParts, poses: Tensor | None = None) -> BlendshapeRig:
    """The rig with deltas in which parts stay behind the skin.

    What has come through goes back along the line to the middle of its group: a shell of the eye moves itself, with
    its neighbourhood, and also leaves the slot between lids that close; before teeth, gums and eyeballs, which are
    hard, the skin moves out. What a pose asks for is shared by its shapes according to their weights; one that is in
    many poses, a blink, takes less, else the demands of all would bend it. Vertices that a shape leaves still stay
    still in it, and shapes in which nothing comes through keep their deltas bit by bit. Lips that close over an open
    jaw (``mouthClose``) are tested there and not by themselves.

    Args:
        rig: N shapes, V vertices.
        parts: of a head in the rig's topology; see ``inner_parts``.
        poses: weights to test, (K,N), in this order; every shape by itself and mixtures of the shapes that move the
            skin before the eyes if absent.

    Example:
        >>> from torchface.modeling import inner_parts, shape_depths
        >>> from torchface.synthetic import performer
        >>> actor = performer(texture=False)
        >>> parts, jaw = inner_parts(actor), actor.select(["jawOpen"])
        >>> before, after = (shape_depths(rig, parts).max() for rig in (jaw, clear_parts(jaw, parts)))
        >>> bool(after <= before)
        True
    """
    poses = clearance_poses(rig, parts) if poses is None else poses
    rest, deltas = rig.vertices.detach().cpu().double(), rig.deltas.detach().cpu().double().clone()
    moving = deltas.norm(dim=-1) > _STILL
    clearance, under = Clearance(rest, parts), _closing_over_jaw(rig)
    changed = _cleared(deltas, moving, poses.double(), clearance, under)
    # What mixtures ask of a shape may bring parts out again in its own pose.
    again = torch.eye(len(deltas), dtype=torch.float64)[changed]
    changed |= _cleared(deltas, moving, again, clearance, under)
    whole = rig.deltas.detach().clone()
    whole[changed.to(whole.device)] = deltas[changed].to(whole)
    return BlendshapeRig(rig.neutral, whole, rig.names, rig.correctives) if bool(changed.any()) else rig


def _closing_over_jaw(rig: BlendshapeRig) -> dict[int, int]:
    """The row of a shape that undoes an open jaw at the lips, and the jaw's; none where it opens the jaw itself."""
    closing, opening = ((row > 0.5).nonzero()[:, 0].tolist() for row in mapping(rig.names, ["mouthClose", "jawOpen"]))
    return {
        close: opening[0]
        for close in closing
        if len(opening) == 1 and float((rig.deltas[close] * rig.deltas[opening[0]]).sum()) < 0
    }


def _cleared(deltas: Tensor, moving: Tensor, poses: Tensor, clearance: "Clearance", under: Mapping[int, int]) -> Tensor:
    """Changes deltas (N,V,3) in place until each pose (K,N) in turn is clear; which shapes were changed, (N,) bool.

    ``under`` are the rows of shapes that stand on another's pose, and that other's.
    """
    changed, often = torch.zeros(len(deltas), dtype=torch.bool), (poses != 0).sum(0).clamp(min=1)
    for weights in poses:  # each pose builds on the changes of the one before
        active = weights.nonzero()[:, 0]
        pose = clearance.rest + torch.tensordot(weights[active], deltas[active], dims=1)
        if len(active) == 1 and int(active) in under:
            pose = pose + deltas[under[int(active)]]
        step = clearance.step(pose, closing=len(active) == 1)
        ids = step.abs().amax(1).nonzero()[:, 0]
        if len(ids) == 0:
            continue
        part = (weights / often.square())[active, None] * moving[active][:, ids]
        share = part / (weights[active] @ part).clamp(min=1e-9)
        deltas[active[:, None], ids] += share[..., None] * step[ids]
        changed[active] |= part.any(1)
    return changed


def clearance_poses(rig: BlendshapeRig, parts: InnerParts) -> Tensor:
    """Every shape at weight 1, then random mixtures of three of those that move the skin before each small group.

    A tongue that is put out belongs before the skin: ``tongueOut`` is no pose to clear.

    Groups are independent: one pose mixes shapes for all of them. The largest group, the mouth, is left out:
    lips part where they are mixed, and so many of them do that no few mixtures stand for all.

    Returns:
        Weights (K,N).
    """
    count = len(rig.names)
    deltas = rig.deltas.detach().cpu().double()
    points = rig.vertices.detach().cpu().double()
    skin = parts.skin.unique()
    generator = torch.Generator().manual_seed(0)
    mixed = torch.zeros(_MIXED_POSES, count, dtype=torch.float64)
    sizes = parts.group.bincount()
    for group in sizes.argsort()[:-1].tolist() if len(sizes) > 1 else []:  # two eyes
        own = cKDTree(points[parts.vertices[parts.group == group]].numpy())
        beside = skin[torch.from_numpy(own.query(points[skin].numpy(), distance_upper_bound=_BESIDE)[0] < _BESIDE)]
        motion = deltas[:, beside].norm(dim=-1).amax(1) if len(beside) else torch.zeros(count)
        movers = motion.argsort(descending=True)[: int((motion > _MOVES).sum())]
        if len(movers) < 2:
            continue
        for number, row in enumerate(mixed):  # each draws shapes of its own, every other with the strongest, a blink
            if number + 1 < len(movers):  # first a whole blink with each other shape, such as a whole look up
                row[movers[[0, number + 1]]] = 1.0
                continue
            others = 1 + torch.randperm(len(movers) - 1, generator=generator)
            drawn = movers[torch.cat([torch.zeros(1 - number % 2, dtype=torch.int64), others])[:_MIXED]]
            strength = torch.rand(len(drawn), generator=generator, dtype=torch.float64)
            row[drawn] = _MIN_WEIGHT + (_MAX_WEIGHT - _MIN_WEIGHT) * strength
    return torch.cat([torch.eye(count, dtype=torch.float64)[~_put_out(rig)], mixed[mixed.any(1)]])


def _put_out(rig: BlendshapeRig) -> Tensor:
    """The shapes that put the tongue out, (N,) bool."""
    return mapping(rig.names, ["tongueOut"])[0] > 0.5


class Clearance:
    """What may give way in a head: the shells' vertices and the skin near the parts."""

    def __init__(self, rest: Tensor, parts: InnerParts) -> None:
        self.rest, self.parts, self.hard = rest, parts, parts.hard
        self.skin = parts.skin.unique()
        self.shells = parts.vertices[~parts.hard]
        self.height_at_rest = self._height(rest)

    def step(self, pose: Tensor, closing: bool) -> Tensor:
        """How far each vertex of a pose (V,3) has to go, (V,3); ``closing``: lids may close."""
        parts, start = self.parts, pose
        if closing and len(self.shells):
            pose = self._shells_on_bone(pose)
        for _ in range(_MAX_ITERATIONS):
            standing = parts.standing(pose)
            through = standing.depth > _ALLOWED
            if not through.any():
                break
            pose = pose.clone()
            normals = triangle_normals(pose, parts.skin)[standing.triangle]
            margin = torch.where(self.hard, _BONE_MARGIN, _SHELL_MARGIN)
            back = normals * (standing.depth + margin).clamp(max=_MAX_STEP)[:, None]
            shells, bones = through & ~self.hard, through & self.hard
            if bones.any():
                met = pose[parts.vertices[bones]] - standing.way[bones, None] * standing.outward[bones]
                pose[self.skin] += _spread(pose[self.skin], met, back[bones], _SKIN_REACH)
            if shells.any():
                at = pose[parts.vertices[shells]]
                pose[self.shells] -= _spread(pose[self.shells], at, back[shells], _SHELL_REACH)
        return pose - start

    def _shells_on_bone(self, pose: Tensor) -> Tensor:
        """Shells that closing lids squeeze off the eyeball give way below them instead, as far as they were lifted."""
        lifted = self._height(pose) - self.height_at_rest
        group = self.parts.group[~self.hard]
        closing = torch.zeros(len(group), dtype=torch.bool)
        for one in group.unique().tolist():  # two eyes
            closing |= (group == one) & (lifted[group == one].median() > _LIFTED)
        sink = torch.where(closing, 2 * lifted, 0.0).clamp(0, _MAX_DEPTH)
        pose = pose.clone()
        pose[self.shells] -= sink[:, None] * self._outward(pose)
        return pose

    def _height(self, pose: Tensor) -> Tensor:
        """How far each shell's vertex is from the middle of its group, (S,)."""
        return (pose[self.shells] - self.parts.middles(pose)[self.parts.group[~self.hard]]).norm(dim=-1)

    def _outward(self, pose: Tensor) -> Tensor:
        offsets = pose[self.shells] - self.parts.middles(pose)[self.parts.group[~self.hard]]
        return torch.nn.functional.normalize(offsets, dim=-1)


def _spread(points: Tensor, at: Tensor, steps: Tensor, reach: float) -> Tensor:
    """What steps (K,3) at some places (K,3) mean for points (n,3): the mean of those near, less with distance."""
    share = torch.exp(-((torch.cdist(points, at) / reach) ** 2))
    most = share.amax(1, keepdim=True)
    return torch.where(most > 0.01, most, 0.0) * (share @ steps) / share.sum(1, keepdim=True).clamp(min=1e-9)


@dataclass(frozen=True)
class Penetration:
    """The parts inside a head before its skin, at rest and in every shape at weight 1."""

    deepest: float  # how far a vertex of a part stands out at most, millimetres; see `InnerParts.depth`
    pose: str  # the shape in which it does, or `rest`
    vertices: int  # how many stand out by more than the tolerance, in the pose where most do
    poses: tuple[str, ...]  # the poses in which some do

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
    """The penetration of a rig, a tongue put out aside; None where the head has no parts inside."""
    if len(parts.vertices) == 0:
        return None
    depths = shape_depths(rig, parts)
    depths[1:][_put_out(rig)] = 0
    poses = ("rest", *rig.names)
    deepest, out = depths.amax(1), (depths > TOLERANCE).sum(1)
    worst = int(deepest.argmax())
    standing = tuple(name for name, count in zip(poses, out.tolist(), strict=True) if count)
    return Penetration(float(deepest[worst]), poses[worst], int(out.max()), standing)
