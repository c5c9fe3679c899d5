"""A scan that has the template's triangles already: checked, and taken as it is."""

from dataclasses import replace

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.errors import AlignmentError
from torchface.geometry.meshes.operators import edges
from torchface.geometry.meshes.unit_check import check_unit, extent
from torchface.geometry.similarity import similarity_transform
from torchface.mesh import Mesh
from torchface.registration.nonrigid.registration_record import RegistrationRecord
from torchface.registration.scan_preparation import check_same_hand
from torchface.registration.scan_registration import Registration

_LEAST_EXTENT, _MOST_EXTENT = 0.2, 5.0  # of the source's: characters differ by less, units by more
# Edges so many times as long as the source's, in one size, and their share: 0.4 % of ICT's heads four standard
# deviations from the mean head in each direction, 2.5 % of a head that is cut in two; 9 % where a twentieth of the
# vertices stands in another order.
_TORN, _TORN_SHARE = 5.0, 0.05
# How much nearer to the template's the edges of some consecutive vertices come where a shift is taken back: 0.05 to
# 0.52 of the distance is left where a sixteenth of all vertices or more are shifted; of 142 heads of people and
# characters, heads four times as unlike as people and heads with pieces moved or blown up, at least 0.98 is left.
_SHIFTS, _LEFT = (1, -1, 2, -2, 3, -3), 0.7
_STRETCHES, _LEAST_STRETCH = 32, 150  # that the vertices' numbers are cut into; vertices in each
_FOUND_SHIFTS = 16  # longer ones, which most vertices' nearest vertices of the template give
_SHORTEST = 1e-3  # of the template's extent: shorter edges count as so long
_LEAST_DIFFERENCE, _WORST = 0.2, 3.0  # of an edge's length: a smooth surface shifted by a row differs by less
_KEEP_ORDER = "export it with the order kept (Maya, ZBrush and Blender have a setting for it)"


def as_it_is(template: Mesh, head: Mesh) -> Registration:
    """A head that has the template's triangles, as its registration; see ``check_own_topology``."""
    check_own_topology(template, head, "scan")
    known = torch.ones(len(head.vertices), dtype=torch.bool)
    pose = similarity_transform(template.vertices.double()[None], head.vertices.double()[None])
    painted = template if head.texture is None else head
    mesh = replace(template, vertices=head.vertices, colors=head.colors, texture=head.texture)
    mesh = replace(mesh, uvs=painted.uvs, uv_faces=painted.uv_faces)
    note = "taken as it is, for its triangles are the template's (no scan to register)"
    record = RegistrationRecord("its triangles", 0.0, (), (note,), 0.0, 1.0, 0.0, 0.0, 1.0, slid=0.0, bent=False)
    return Registration(mesh, pose, torch.zeros(len(head.vertices)).double(), known, record)


def check_own_topology(source: Mesh, target: Mesh, name: str = "neutral") -> None:
    """Refuses a target that has the source's triangles on other points.

    Raises:
        AlignmentError: it is a mirror image of the source, or its vertices stand in another order: so many edges are
            torn, or those of some consecutive vertices are the source's once a shift is taken back.
        ValueRangeError: it is in another unit.
    """
    used = source.faces.cpu().unique()
    rest, goal = (mesh.vertices.detach().cpu().double()[used] for mesh in (source, target))
    size, beside = extent(goal), extent(rest)
    if size == 0 or beside == 0:
        return  # the solve says it
    check_unit(name, goal, beside, "the template", _LEAST_EXTENT, _MOST_EXTENT)
    check_same_hand(rest, goal, name)
    ends = edges(source.faces.cpu())
    own, found = (mesh.vertices.detach().cpu().double() for mesh in (source, target))
    if shift := _find_shift(own, similarity_transform(goal[None], rest[None]).apply(found)[0], ends, beside):
        raise AlignmentError(f"{name}: found {shift}; {_KEEP_ORDER}")
    lengths, there = (
        vertices[ends].diff(dim=1).norm(dim=-1)[:, 0] / size for vertices, size in ((own, beside), (found, size))
    )
    share = float((there > _TORN * lengths)[lengths > 0].double().mean())
    if share > _TORN_SHARE:
        raise AlignmentError(
            f"{name}: found {100 * share:.1f} % of its edges more than {_TORN:g} times as long as the template's (both "
            f"in one size), as where vertices stand in another order than the template's; {_KEEP_ORDER}"
        )


def _find_shift(rest: Tensor, goal: Tensor, ends: Tensor, across: float) -> str:
    """Which vertices of a goal (V,3) in the template's place are shifted, and by how much; "" where none are."""
    count = len(rest)
    stretch = max(_LEAST_STRETCH, -(-count // _STRETCHES))
    pairs = ends[ends.diff(dim=1)[:, 0].abs() < stretch]
    vectors, of = rest[pairs].diff(dim=1)[:, 0], pairs.amin(1) // stretch
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
        f"vertices in another order than the template's, from about {first} to {last} of {count}: their edges are "
        f"{before:.0f} % of their length off the template's, with a shift of {abs(shift)} taken back by {after:.0f} %"
    )
