"""The motion of a head's loose parts (eyeballs, teeth, gums, tongue, lashes) in shapes that its skin has."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import triangle_areas, vertex_normals
from torchface.geometry.meshes.shell_energies import stretching_energy
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.geometry.spheres import nearest_sphere
from torchface.optim.sparse import SparseCholesky
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig

_ROUND, _LEAST_BALL, _SMALLEST_BALL, _LARGEST_BALL = 0.12, 12, 0.4, 2.4
"""How far from a sphere an eyeball may be, in radii, its fewest vertices, and its size in the template's."""
_EYEBALL_REACH, _CORNEA = 1.35, 0.8  # radii; the cosine of how far it reaches from its middle
_IN_THE_MOUTH, _MOUTH_HEIGHT = 75.0, 25.0  # millimetres
_DEEP, _ENCLOSED = 3.0, 0.25  # millimetres behind the skin; the share of a part that lies so
_BITE, _BITE_BLEND = 0.2, 3.0
"""How much the line between upper and lower teeth rises toward the back, and the millimetres over which a part that
both jaws share, such as gums in one piece, passes from the one to the other."""
_BOTH_JAWS, _ARCH = 0.15, 30.0
_JAW = "jaw"
_ROW, _OFF_THE_LIPS, _RISES = 4, 10.0, (0.0, 0.1, _BITE, 0.3)  # least teeth of a row; millimetres from the lips' line
_TONGUE, _FILLED = 15.0, 0.2  # millimetres at least: teeth are smaller; and the share near the middle
_BACK, _BEHIND_TEETH, _TEETH, _LEAST_BACK, _FALLS = (0.3, 0.55), 12.0, 8.0, 8, 4.0  # of half the arch; millimetres
_MIDDLE = 5.0  # millimetres beside the middle: gums are an arch, a tongue lies there
_OVER_A_TRIANGLE = (
    torch.tensor(
        [[a + 1 / 3, b + 1 / 3, 3 - a - b + 1 / 3] for a in range(4) for b in range(4 - a)], dtype=torch.float64
    )
    / 4.0
)
_COVERED = 0.3  # the share of a tongue's back that may lie under other parts
_STANDS, _GUM = 1.0, (3.0, 6.0)  # millimetres from teeth: a part they stand in; gums at most, tongue at least
_TONGUE_OUT, _TONGUE_DOWN = 12.0, 8.0
_OPEN, _TONGUE_RISE, _TONGUE_DROP = 0.33, 2.0, 15.0  # of jawOpen; millimetres over the lower teeth, and at the tip
_ROOT, _LYING, _STIFF = 0.3, 2.0, 0.01


@dataclass(frozen=True, eq=False)
class _Head:
    """A head's joined mesh in the template's place, and its skin's deltas."""

    vertices: Tensor
    part: Tensor
    loose: Tensor
    deltas: Tensor


@dataclass(frozen=True, eq=False)
class LooseParts:
    """How a head moves with its loose parts.

    Args:
        deltas: (N,J,3), millimetres.
        bones: vertices of eyeballs and of what lies in the mouth, (J,) bool.
        tongue: how much each vertex is of the tongue, (J,) in [0,1].
    """

    deltas: Tensor
    bones: Tensor
    tongue: Tensor


def moved_parts(
    template: BlendshapeRig, vertices: Tensor, faces: Tensor, part: Tensor, loose: Tensor, deltas: Tensor
) -> LooseParts:
    """Deltas of a head's loose parts beside those of its skin.

    What lies within a template's eyeball turns as it does, about its own middle. What lies in the mouth is bone: above
    the line of the lips it stays, below it goes with the jaw. The rest goes with the nearest skin.

    Args:
        template: the template's rig on this head's face, with iBUG's 68 landmarks; without landmarks or eyeballs all
            parts go with the skin.
        vertices: of the head, (J,3) float64, in the template's place.
        part: connected part of each vertex, (J,).
        loose: vertices of parts that are no skin, (J,) bool.
        deltas: of the skin, (N,J,3).

    """
    deltas, tongue = deltas.clone(), torch.zeros(len(vertices), dtype=torch.float64)
    loose = loose & (torch.bincount(faces.flatten(), minlength=len(vertices)) > 0)
    if not loose.any():
        return LooseParts(deltas, tongue > 0, tongue)
    head = _Head(vertices, part, loose, deltas)
    left = loose.clone()
    for eyeball in _eyeballs(template):
        left &= ~_turned(head, template, eyeball, left)
    notes = template.neutral.annotations
    if notes is not None and notes.landmarks is not None and len(notes.landmarks) == 68:
        mouth = template.vertices.double().cpu()[notes.landmarks.cpu()[48:68]]
        inside, share, tongue = _in_the_mouth(head, faces, left, mouth)
        jaw = _jaw_motions(template)
        ids = inside.nonzero()[:, 0]
        if len(ids):
            deltas[:, ids] = share[ids, None] * (jaw.apply(vertices[ids]) - vertices[ids])
        left &= ~inside
    if left.any():
        _attached(head, faces, left)
    return LooseParts(deltas, loose & ~left, tongue)


def _attached(head: _Head, faces: Tensor, left: Tensor) -> None:
    """Lets parts go with the skin where they touch it, and the rest of each with that: lashes stay straight."""
    ids = left.nonzero()[:, 0]
    row = torch.full((len(left),), -1)
    row[ids] = torch.arange(len(ids))
    own = row[faces[left[faces].all(1)]]
    points = head.vertices[ids]
    place = SurfaceIndex(head.vertices, faces[~head.loose[faces].any(1)]).nearest(points)
    corner, distance = faces[~head.loose[faces].any(1)][place.triangle], place.distance
    part = head.part[ids].unique(return_inverse=True)[1]
    near = torch.stack([_root_reach(distance[part == one]) for one in range(int(part.max()) + 1)])
    root = distance <= near[part]
    weight = torch.where(root, 1.0, 1e-9).numpy()
    beside = torch.einsum("njkc,jk->njc", head.deltas[:, corner], place.barycentric)
    guess = (beside * root[:, None]).permute(1, 0, 2).flatten(1)
    matrix = sparse.diags_array(weight) + _STIFF * stretching_energy(points, own)
    solved = SparseCholesky(matrix).solve(guess)
    head.deltas[:, ids] = solved.unflatten(1, (-1, 3)).permute(1, 0, 2)


def _root_reach(distance: Tensor) -> Tensor:
    """How near the skin a part's vertices are that go with it: as far as the nearest, or those of its nearer half."""
    return torch.maximum(distance.min() + _ROOT, distance.median().clamp(max=_LYING))


def _eyeballs(template: BlendshapeRig) -> list[Tensor]:
    notes = template.neutral.annotations
    regions = {} if notes is None else notes.regions
    return [regions[name].cpu() for name in ("eyeball_left", "eyeball_right") if name in regions]


def _turned(head: _Head, template: BlendshapeRig, eyeball: Tensor, left: Tensor) -> Tensor:
    """Turns what lies within an eyeball of the template; which vertices that is, (J,)."""
    rest = template.vertices.double().cpu()[eyeball]
    centre = (rest.amax(0) + rest.amin(0)) / 2
    radius = float((rest - centre).norm(dim=-1).median())
    middle, size = _own_ball(head, left, centre, radius)
    inside = (head.vertices - middle).norm(dim=-1) < _EYEBALL_REACH * size
    own = torch.zeros_like(left)
    for one in head.part[inside & left].unique().tolist():  # a head has a handful of such parts
        rows = head.part == one
        if bool(inside[rows].all()) and _is_of_the_eye(head.vertices[rows] - middle, size):
            own |= rows
    ids = own.nonzero()[:, 0]
    if not len(ids):
        return own
    points = head.vertices[ids]
    sizes = head.part[ids].unique(return_counts=True)
    ball = points[head.part[ids] == sizes[0][sizes[1].argmax()]]
    middle = (ball.amax(0) + ball.amin(0)) / 2
    posed = rest + template.deltas.double().cpu()[:, eyeball]
    motion = similarity_transform(rest.expand_as(posed), posed, scale=False)
    shift = motion.apply(centre[None])[:, 0] - centre
    head.deltas[:, ids] = (points - middle) @ motion.rotation.transpose(1, 2) + middle + shift[:, None] - points
    return own


def _own_ball(head: _Head, left: Tensor, centre: Tensor, radius: float) -> tuple[Tensor, float]:
    """Middle and radius of the head's own eyeball, which may be larger or smaller than the template's; else its."""
    near = (head.vertices - centre).norm(dim=-1) < _LARGEST_BALL * radius
    best, found = _ROUND, (centre, radius)
    for one in head.part[near & left].unique().tolist():
        rows = head.part == one
        if not bool(near[rows].all()) or int(rows.sum()) < _LEAST_BALL:
            continue
        points = head.vertices[rows]
        middle, size = nearest_sphere(points)
        off = float(((points - middle).norm(dim=-1) - size).abs().mean()) / size
        around = float((points.mean(0) - middle).norm()) < 0.5 * size  # a shell before the eye lies on one side
        if around and off < best and float((middle - centre).norm()) < radius and size > _SMALLEST_BALL * radius:
            best, found = off, (middle, size)
    return found


def _is_of_the_eye(points: Tensor, radius: float) -> bool:
    """Whether a part is a ball, or lies on it as a cornea or an iris does; lashes and shells under lids do not."""
    middle = points.mean(0)
    if float(middle.norm()) < 0.5 * radius:
        return float((points.amax(0) - points.amin(0)).max()) > radius
    away = torch.nn.functional.normalize(points, dim=-1) @ torch.nn.functional.normalize(middle, dim=0)
    return float(away.min()) > _CORNEA


def _in_the_mouth(head: _Head, faces: Tensor, left: Tensor, lips: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices (J,) of parts behind the lips, how much each goes with the jaw (J,), and with the tongue (J,)."""
    middle = lips.mean(0)
    inside = torch.zeros_like(left)
    share, tongue = torch.zeros(2, len(left), dtype=torch.float64)
    widest, gums, found, deep = _FILLED, [], [], _deep(head, faces, left)
    held_tongue = torch.zeros_like(left)
    for one in head.part[left].unique().tolist():  # every tooth is a part
        rows = (head.part == one) & left
        away = head.vertices[rows] - middle
        at = away.mean(0)
        behind = float(at[2]) < 2.0 and abs(float(at[1])) < _MOUTH_HEIGHT
        near = float(at.norm()) < _IN_THE_MOUTH and float(away.norm(dim=-1).max()) < 2 * _IN_THE_MOUTH
        if behind and near and float(deep[rows].double().mean()) > _ENCLOSED:
            found.append((rows, away))
    teeth = [rows for rows, away in found if float(away[:, 0].amax() - away[:, 0].amin()) < _TONGUE]
    line, rise = _bite_plane([away for _, away in found])
    for rows, away in found:
        inside |= rows
        below = line - (away[:, 1] + rise * away[:, 2])
        low = (0.5 + below / (2 * _BITE_BLEND)).clamp(0, 1)
        width, _, depth = (away.amax(0) - away.amin(0)).tolist()
        above = float((low < 0.5).double().mean())
        both = width > _ARCH and _BOTH_JAWS < above < 1 - _BOTH_JAWS
        lower = float(below.mean()) > 0 and not both
        held = lower and width > _ARCH and _holds(head.vertices[rows], [head.vertices[one] for one in teeth])
        if both or held:
            gums.append((rows, below, away))
        share[rows] = low * low * (3 - 2 * low) if both else float(below.mean() > 0)
        filled = _share_in_the_middle(head.vertices - middle, faces[rows[faces].all(1)])  # gums are an arch
        if lower and width > _TONGUE and depth > _TONGUE and filled > widest:
            widest, tongue, held_tongue = filled, rows.double(), rows & held
    own = head.vertices[held_tongue] - middle
    if not tongue.any() or (len(own) and not any(_within(own, arch) for *_, arch in gums)):  # it is one with gums
        of_gums = torch.zeros_like(tongue)
        for rows, below, _ in gums:
            of_gums += _tongue_of_gums(head.vertices, faces, rows, below, share > 0.5, teeth)
        tongue = of_gums if of_gums.any() else tongue
    return inside, share, tongue


def _deep(head: _Head, faces: Tensor, rows: Tensor) -> Tensor:
    """Vertices (J,) of some that lie behind skin or between it, as much of a tooth does; roots of beards do not."""
    skin, points = faces[~head.loose[faces].any(1)], head.vertices[rows]
    found = rows.clone()
    if len(skin):
        caster = RayCaster(head.vertices, skin)
        ways = torch.tensor([[0.0, 0, 1], [1, 0, 0], [-1, 0, 0]], dtype=torch.float64)
        far = torch.stack([caster.distances(points, way.expand_as(points), 2 * _IN_THE_MOUTH) for way in ways])
        before, left, right = (far > _DEEP) & (far < 2 * _IN_THE_MOUTH)
        found[rows] = before | (left & right)
    return found


def _holds(points: Tensor, teeth: list[Tensor]) -> bool:
    """Whether teeth stand in a part (n,3), as in gums."""
    tree = cKDTree(points.numpy())
    return sum(float(tree.query(one.numpy())[0].min()) < _STANDS for one in teeth) >= _ROW


def _share_in_the_middle(vertices: Tensor, faces: Tensor) -> float:
    """The share of the area of triangles (n,3) that lies less than so many millimetres beside x = 0."""
    area = triangle_areas(vertices, faces)
    x = vertices[faces][..., 0] @ _OVER_A_TRIANGLE.T
    return float((area * (x.abs() < _MIDDLE).double().mean(1)).sum() / area.sum().clamp(min=1e-9))


def _within(points: Tensor, arch: Tensor) -> bool:
    """Whether a part (n,3) lies within gums (m,3) that are a part of their own, as a tongue does that touches teeth."""
    sides = points[:, 0].amin() > arch[:, 0].amin() and points[:, 0].amax() < arch[:, 0].amax()
    return bool(sides and points[:, 2].amax() < arch[:, 2].amax())


def _bite_plane(parts: list[Tensor]) -> tuple[float, float]:
    """How far over the lips' line the gap between two rows of single teeth lies, and how much it rises to the back.

    The widest gap counts, at any of the usual rises; without rows it is the lips' line.
    """
    small = [part.mean(0) for part in parts if float(part[:, 0].amax() - part[:, 0].amin()) < _TONGUE]
    best = _BITE_BLEND, 0.0, _BITE
    for rise in _RISES if len(small) >= 2 * _ROW else ():
        heights = sorted(float(middle[1] + rise * middle[2]) for middle in small)
        for lower, upper in list(pairwise(heights))[_ROW - 1 : len(heights) - _ROW]:
            if abs(lower + upper) < 2 * _OFF_THE_LIPS:
                best = max(best, (upper - lower, (lower + upper) / 2, rise))
    return best[1:]


def _tongue_of_gums(
    vertices: Tensor, faces: Tensor, rows: Tensor, below: Tensor, jaw: Tensor, teeth: Sequence[Tensor] = ()
) -> Tensor:
    """How much each vertex (J,) is of a tongue in one piece with gums: harmonic from its back to the arch around it.

    What is near teeth that are parts of their own is of the arch, and so is what lies under others of the ``jaw`` (J,):
    of a bag, its bottom.
    """
    none = torch.zeros(len(vertices), dtype=torch.float64)
    ids = rows.nonzero()[:, 0]
    place = torch.full((len(vertices),), -1)
    place[ids] = torch.arange(len(ids))
    own, points = place[faces[rows[faces].all(1)]], vertices[ids]
    facing = vertex_normals(points, own)
    across = (points[:, 0] - (points[:, 0].amax() + points[:, 0].amin()) / 2).abs()
    across = across / across.max().clamp(min=1e-6)
    behind = points[:, 2].max() - points[:, 2]
    low = below > 0
    back = low & (facing[:, 1] > 0.5) & (across < _BACK[0]) & (behind > _BEHIND_TEETH)
    arch = ~low | (across > _BACK[1]) | (behind < _TEETH)
    upper_side = arch & low & (facing[:, 1] > 0.5)
    if int(back.sum()) < _LEAST_BACK or not bool(upper_side.any()):
        return none
    lower, deeper = (float(one[upper_side].median()) for one in (points[:, 1], below))
    if float(points[back, 1].quantile(0.9)) < lower and float(below[back].quantile(0.1)) > deeper:  # the mouth's bottom
        return none
    back &= (points[:, 1] > lower - _FALLS) | (below < deeper + _FALLS)
    if teeth:
        nearby = cKDTree(vertices[torch.stack(list(teeth)).any(0)].numpy()).query(points.numpy())[0]
        arch |= torch.from_numpy(nearby < _GUM[0])
        back &= torch.from_numpy(nearby > _GUM[1])
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand_as(points)
    others = faces[(jaw & ~rows)[faces].all(1)]
    if len(others) and float(RayCaster(vertices, others).occluded(points, up)[back].double().mean()) > _COVERED:
        return none  # a bag's bottom
    under = RayCaster(points, own[low[own].all(1)]).occluded(points + 0.1 * up, up) & low & (facing[:, 1] > 0.5)
    arch |= under  # what a tongue lies on
    back &= ~under
    weight = torch.where(back | arch, 1e3, 1e-6)
    system = sparse.diags_array(weight.double().numpy()) + stretching_energy(points, own)
    none[ids] = SparseCholesky(system).solve((weight * back).double()[:, None])[:, 0].clamp(0, 1)
    return none


def _jaw_motions(template: BlendshapeRig) -> Similarity:
    """How the jaw's bone moves in each shape, a batch of N: as the chin's skin in shapes of the jaw, else not."""
    notes = template.neutral.annotations
    regions = {} if notes is None else notes.regions
    chin = regions.get("chin", regions.get("jaw"))
    rest = template.vertices.double().cpu()
    if chin is None:
        assert notes is not None
        assert notes.landmarks is not None
        chin = notes.landmarks.cpu()[[5, 6, 7, 8, 9, 10, 11]]
    posed = rest[chin] + template.deltas.double().cpu()[:, chin]
    motion = similarity_transform(rest[chin].expand_as(posed), posed, scale=False)
    jaw = torch.tensor([name.startswith(_JAW) for name in template.names])
    rotation = torch.where(jaw[:, None, None], motion.rotation, torch.eye(3, dtype=torch.float64))
    translation = torch.where(jaw[:, None], motion.translation, 0.0)
    return Similarity(torch.ones_like(motion.scale), rotation, translation)


def tongue_out(vertices: Tensor, tongue: Tensor, lips: Tensor, jaw_open: Tensor | None = None) -> Tensor:
    """What ``tongueOut`` adds to a head whose tongue is a part of its own, (V,3), millimetres.

    The jaw opens a third, without which the tongue would go through teeth and lip; the tongue's tip comes out over the
    lower lip and down, its root stays.

    Args:
        vertices: (V,3), millimetres, z toward the viewer.
        tongue: how much each vertex is of it, (V,) in [0,1], not all zero.
        lips: points of the lips, (L,3).
        jaw_open: the head's ``jawOpen``, (V,3); the jaw stays if absent.

    Source: ARKit's description of the shape.
    """
    weight = tongue.double()
    depth = vertices[:, 2].double()
    own = depth[weight > 0.5 * weight.max()]
    share = ((depth - own.min()) / (own.max() - own.min()).clamp(min=1e-6)).clamp(0, 1)
    share = weight * share * share * (3 - 2 * share)
    out = (lips[:, 2].double().max() + _TONGUE_OUT - own.max()).clamp(min=0.0)
    if jaw_open is None:
        return torch.stack([torch.zeros_like(share), -_TONGUE_DOWN * share.square(), out * share], 1).to(vertices)
    # Before the lips it falls; up to there it stays between teeth and lips, of which the lower ones go with the jaw.
    tip = (share > 0.5 * weight.max()) & (weight > 0.5 * weight.max())
    high = (vertices[tip, 1].double().quantile(0.9) - lips[:, 1].double().mean()).clamp(min=0.0)
    up = (_TONGUE_RISE - high) * share - _TONGUE_DROP * share**12
    over = torch.stack([torch.zeros_like(share), up, out * share], 1)
    return (over + _OPEN * (1 - share[:, None]) * jaw_open.double()).to(vertices)
