"""A scan that has the template's triangles already: checked, and taken as it is."""

from dataclasses import replace

import torch
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
# vertices stands in another order, but 3 % where all are shifted by one in the embedded performer, whose numbers follow
# its surface, and 2 % where half are.
_TORN, _TORN_SHARE = 5.0, 0.05
# A shift that is taken back in the part of the numbers where it mends edges leaves none torn where all vertices are
# shifted, at most 0.76 of them where a half or two thirds are; of heads with pieces cut out and moved at least 1.04.
_SHIFTS, _SHIFTED_SHARE, _MENDED, _LEFT_TORN = (1, -1, 2, -2, 3, -3), 0.005, 0.6, 0.9
_EDGE_OF_PART = 0.05  # of the mended edges' ends at either end, which others may be among


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
            torn, or some are and fewer would be without a shift of all vertices or of a half by up to three places.
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
    lengths = own[ends].diff(dim=1).norm(dim=-1)[:, 0] / beside

    def torn(vertices: Tensor) -> Tensor:
        return (vertices[ends].diff(dim=1).norm(dim=-1)[:, 0] / size > _TORN * lengths) & (lengths > 0)

    here = torn(found)
    share = float(here.sum() / (lengths > 0).sum())
    left = {k: _left_torn(here, torn(found.roll(-k, 0)), ends) for k in _SHIFTS if share > _SHIFTED_SHARE}
    shift = min(left, key=lambda k: left[k], default=0)
    shifted = bool(shift) and left[shift] < _LEFT_TORN
    if share > _TORN_SHARE or shifted:
        how = f", shifted by {abs(shift)}," if shifted else ""
        raise AlignmentError(
            f"{name}: found {100 * share:.1f} % of its edges more than {_TORN:g} times as long as the template's (both "
            f"in one size), as where vertices stand in another order{how} than the template's; export it with the "
            "order kept (Maya, ZBrush and Blender have a setting for it)"
        )


def _left_torn(here: Tensor, back: Tensor, ends: Tensor) -> float:
    """How many of the torn edges ``here`` (E,) a shift taken back leaves, which tears ``back``, in the part of the
    vertices' numbers where it mends edges; 1 where it mends few."""
    mended = ends[here & ~back].flatten().sort().values
    if len(mended) < 2 * _MENDED * int(here.sum()):
        return 1.0
    low, high = mended[int(_EDGE_OF_PART * len(mended))], mended[int((1 - _EDGE_OF_PART) * len(mended))]
    part = ((ends >= low) & (ends <= high)).all(1)
    return float(back[part].sum() / here[part].sum().clamp(min=1))
