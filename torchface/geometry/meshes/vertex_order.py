"""Check that the vertices of a mesh stand in the order of another one with the same triangles."""

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.errors import AlignmentError
from torchface.geometry.meshes.operators import edges
from torchface.geometry.meshes.unit_check import extent

# Edges so many times as long as the source's, in one size, and their share: 0.4 % of ICT's heads four standard
# deviations from the mean head in each direction, 2.5 % of a head that is cut in two; 9 % where a twentieth of the
# vertices stands in another order.
_TORN, _TORN_SHARE = 5.0, 0.05
_TORN_LEAST = 0.001  # of which a shift is looked for: a sixteenth shifted by one tears 0.2 %
# How much nearer to the template's the edges of some consecutive vertices come where a shift is taken back: 0.05 to
# 0.52 of the distance is left where a sixteenth of all vertices or more are shifted; of 142 heads of people and
# characters, heads four times as unlike as people and heads with pieces moved or blown up, at least 0.98 is left.
_SHIFTS, _LEFT = (1, -1, 2, -2, 3, -3), 0.7
_STRETCHES, _LEAST_STRETCH = 32, 150  # that the vertices' numbers are cut into; vertices in each
_FOUND_SHIFTS = 16  # longer ones, which most vertices' nearest vertices of the template give
_SHORTEST = 1e-3  # of the template's extent: shorter edges count as so long
_LEAST_DIFFERENCE, _WORST = 0.2, 3.0  # of an edge's length: a smooth surface shifted by a row differs by less
KEEP_ORDER = "export it with the order kept (Maya, ZBrush and Blender have a setting for it)"


def check_vertex_order(name: str, rest: Tensor, goal: Tensor, faces: Tensor, other: str = "the template") -> None:
    """Refuses vertices (V,3) in another order than ``rest`` (V,3), to which they are aligned; float64."""
    ends = edges(faces)
    used = faces.unique()
    size, across = extent(goal[used]), extent(rest[used])
    lengths, there = (
        vertices[ends].diff(dim=1).norm(dim=-1)[:, 0] / scale for vertices, scale in ((rest, across), (goal, size))
    )
    share = float((there > _TORN * lengths)[lengths > 0].double().mean())
    if share > _TORN_LEAST and (shift := _shift(rest, goal, ends, across, other)):
        raise AlignmentError(f"{name}: found {shift}; {KEEP_ORDER}")
    if share > _TORN_SHARE:
        raise AlignmentError(
            f"{name}: found {100 * share:.1f} % of its edges more than {_TORN:g} times as long as {other}'s (both "
            f"in one size), as where vertices stand in another order than {other}'s; {KEEP_ORDER}"
        )


def _shift(rest: Tensor, goal: Tensor, ends: Tensor, across: float, other: str) -> str:
    """Which vertices of a goal (V,3) in the template's place are shifted, and by how much; "" where none are."""
    count = len(rest)
    stretch = max(_LEAST_STRETCH, -(-count // _STRETCHES))
    pairs = ends[ends.diff(dim=1)[:, 0].abs() < stretch]
    vectors, of = rest[pairs].diff(dim=1)[:, 0], pairs[:, 0] // stretch
    lengths = vectors.norm(dim=-1).clamp(min=_SHORTEST * across)
    edges_in = of.bincount(minlength=-(-count // stretch))

    def difference(vertices: Tensor) -> Tensor:
        off = ((vertices[pairs].diff(dim=1)[:, 0] - vectors).norm(dim=-1) / lengths).clamp(max=_WORST)
        return torch.zeros_like(edges_in, dtype=off.dtype).index_add(0, of, off) / edges_in.clamp(min=1)

    here = difference(goal)
    offsets = torch.from_numpy(cKDTree(rest).query(goal)[1]) - torch.arange(count)
    found, times = offsets[offsets != 0].unique(return_counts=True)
    longer = found[times.argsort(descending=True)[:_FOUND_SHIFTS]].tolist()
    judged = (here > _LEAST_DIFFERENCE) & (edges_in >= _LEAST_STRETCH)
    back = {shift: difference(goal.roll(shift, 0)) for shift in (*_SHIFTS, *longer)}
    mended = {shift: judged & (left < _LEFT * here) for shift, left in back.items()}
    shift = max(mended, key=lambda shift: float((here - back[shift])[mended[shift]].sum()))
    stretches = mended[shift].nonzero()[:, 0]
    if len(stretches) == 0:
        return ""
    first, last = int(stretches[0]) * stretch, min((int(stretches[-1]) + 1) * stretch, count)
    before, after = (100 * float(x[stretches].mean()) for x in (here, back[shift]))
    return (
        f"vertices in another order than {other}'s, from about {first} to {last} of {count}: their edges are "
        f"{before:.0f} % of their length off {other}'s, with a shift of {abs(shift)} taken back by {after:.0f} %"
    )
