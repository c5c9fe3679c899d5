"""What lies in a head's mouth: how it goes with the jaw, and its tongue."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import triangle_areas, vertex_normals
from torchface.geometry.meshes.shell_energies import stretching_energy
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.modeling.rigging.joined_vertices import JoinedHead, connected_labels
from torchface.optim.sparse import SparseCholesky
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig

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
_RISING = 0.2  # of a normal, upward
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


def in_the_mouth(head: JoinedHead, faces: Tensor, left: Tensor, lips: Tensor) -> tuple[Tensor, Tensor, Tensor]:
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
            of_gums += tongue_of_gums(head.vertices, faces, rows, below, share > 0.5, teeth)
        tongue = of_gums if of_gums.any() else tongue
        share = torch.maximum(share, of_gums)
    return inside, share, tongue


def _deep(head: JoinedHead, faces: Tensor, rows: Tensor) -> Tensor:
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


def tongue_of_gums(
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
    near = torch.full((len(points),), torch.inf)
    if teeth:
        tree = cKDTree(vertices[torch.stack(list(teeth)).any(0)].numpy())
        near = torch.from_numpy(tree.query(points.numpy())[0])
    # A tongue's back may rise over the line between the jaws.
    raised = (facing[:, 1] > _RISING) & (across < _BACK[1]) & (behind > _BEHIND_TEETH) & (near > _GUM[0])
    raised = _reached(own, back, raised)
    arch |= near < _GUM[0]
    back = (raised | (back & (near > _GUM[1]))) & ((points[:, 1] > lower - _FALLS) | (below < deeper + _FALLS))
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand_as(points)
    others = faces[(jaw & ~rows)[faces].all(1)]
    if len(others) and float(RayCaster(vertices, others).occluded(points, up)[back].double().mean()) > _COVERED:
        return none  # a bag's bottom
    under = RayCaster(points, own[low[own].all(1)]).occluded(points + 0.1 * up, up) & low & (facing[:, 1] > 0.5)
    arch |= under  # what a tongue lies on
    back &= ~under
    arch &= ~back
    weight = torch.where(back | arch, 1e3, 1e-6)
    system = sparse.diags_array(weight.double().numpy()) + stretching_energy(points, own)
    none[ids] = SparseCholesky(system).solve((weight * back).double()[:, None])[:, 0].clamp(0, 1)
    return none


def _reached(faces: Tensor, start: Tensor, allowed: Tensor) -> Tensor:
    """The vertices (n,) that edges among those ``allowed`` join to some of ``start``."""
    kept = faces[(start | allowed)[faces].all(1)]
    label = torch.from_numpy(connected_labels(torch.cat([kept[:, [0, 1]], kept[:, [1, 2]]]).T, len(start)))
    return allowed & torch.isin(label, label[start])


def jaw_motions(template: BlendshapeRig) -> Similarity:
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
