"""Faults of a scan and its landmarks: repaired where that is safe, reported where it is not."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import AlignmentError, ShapeError, TopologyError, ValueRangeError
from torchface.geometry.meshes.operators import components, triangle_areas, triangle_cross
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.meshes.unit_check import check_unit, extent
from torchface.geometry.mirrored_points import check_mirrored
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.mesh import Annotations, Mesh

LEAST_TRIANGLES = 50  # of a surface that a template is registered to
_CRUMB = 0.02
_OFF_SURFACE = 15.0
_WORST_LANDMARK_FIT = 0.1
_LINE = 0.02
_UNITS = {  # by the power of ten that points are too small by
    3: "metres beside a scan in millimetres",
    2: "metres beside a scan in centimetres",
    1: "centimetres beside a scan in millimetres",
    -1: "millimetres beside a scan in centimetres",
    -3: "millimetres beside a scan in metres",
}
_PAIRED = ("brow", "lids", "cheek")
_ONE_SIDE = 0.65  # of what a scan shows of the other side
# Of the skin around a part's landmarks, or of its regions: whole scans show 0.7 and more.
_LEAST_SHOWN, _AROUND = 0.5, 8.0
_PARTS = {  # rows of iBUG's 68, for each side where there are two
    "brows": (range(17, 22), range(22, 27)),
    "eyes": (range(36, 42), range(42, 48)),
    "nose": (range(27, 36),),
    "jaw": (range(2, 6), range(11, 15)),
    "mouth": (range(48, 60),),
    "chin": (range(6, 11),),
}
_LEAST_EXTENT, _MOST_EXTENT = 0.17, 9.0  # of a template's: a scan may show less than the face or the whole person

Landmarks = tuple[Tensor, Tensor]
"""Template vertex ids (L,) int64, and where they lie on the scan, (L,3) millimetres; a NaN row is missing."""


@dataclass(frozen=True, eq=False)
class PreparedScan:
    """The surface of a scan that is registered to."""

    vertices: Tensor  # (V',3) float64, those at the same place made one
    faces: Tensor  # (F',3), without crumbs, the right side out
    face_ids: Tensor  # the scan's own row of each, (F',)
    notes: tuple[str, ...]  # what was done

    def turned(self) -> "PreparedScan":
        """The other side out."""
        note = "the scan's triangles are clockwise seen from outside (flipped normals); they were turned over"
        return PreparedScan(self.vertices, self.faces.flip(1), self.face_ids, (*self.notes, note))


def check_template(template: Mesh) -> None:
    """Raises ``TopologyError`` or ``ValueRangeError`` where nothing can be registered."""
    if len(template.faces) < LEAST_TRIANGLES:
        raise TopologyError(
            f"template: found {len(template.faces)} triangles, expected at least {LEAST_TRIANGLES}, a face's mesh"
        )
    if not float(triangle_areas(template.vertices, template.faces).sum()) > 0:
        raise ValueRangeError("template: found no triangle with any area, expected a face's mesh")


def prepare_scan(scan: Mesh, template: Mesh) -> PreparedScan:
    """Checks size and unit, joins vertices that lie at one place, drops small loose parts, turns the outside out."""
    triangles = len(scan.faces)
    if triangles < LEAST_TRIANGLES:
        raise TopologyError(
            f"scan: found {len(scan.vertices)} vertices and {triangles} triangles, expected a surface of at least "
            f"{LEAST_TRIANGLES} triangles"
        )
    vertices, place = torch.unique(scan.vertices.detach().cpu().double(), dim=0, return_inverse=True)
    faces = place[scan.faces.cpu()]
    areas = triangle_areas(vertices, faces)
    solid = areas > 0
    if int(solid.sum()) < LEAST_TRIANGLES:
        raise ValueRangeError(
            f"scan: found {int(solid.sum())} triangles with any area, expected at least {LEAST_TRIANGLES}"
        )
    points = vertices[faces[solid].flatten()]
    check_unit(
        "scan", points, extent(template.vertices[template.faces.flatten()]), "a template", _LEAST_EXTENT, _MOST_EXTENT
    )
    label = components(faces, len(vertices))[faces[:, 0]]
    area_of = torch.zeros(int(label.max()) + 1, dtype=torch.float64).index_add_(0, label, areas)
    large = area_of >= _CRUMB * area_of.max()
    keep = solid & large[label]
    notes = []
    crumbs = int((~large & (area_of > 0)).sum())
    if crumbs:
        lost = int((solid & ~large[label]).sum())
        share = float(area_of[~large].sum() / area_of.sum())
        notes.append(
            f"{crumbs} loose parts of the scan ({lost} triangles, {share:.1%} of its area) were left out: such are "
            "dust, teeth, eyes"
        )
    face_ids = keep.nonzero()[:, 0]
    used, faces = faces[face_ids].unique(return_inverse=True)
    prepared = PreparedScan(vertices[used], faces, face_ids, tuple(notes))
    return prepared.turned() if _inside_out(prepared) else prepared


def _inside_out(scan: PreparedScan) -> bool:
    """Whether the triangles look toward the middle of the bounding box, where a face's or head's do not."""
    cross = triangle_cross(scan.vertices, scan.faces)
    centres = scan.vertices[scan.faces].mean(1)
    mean = (centres * cross.norm(dim=-1, keepdim=True)).sum(0) / cross.norm(dim=-1).sum()
    # An open shell's mean lies behind it, a head's inside: on both the outside looks away from there.
    return float((cross * (centres - mean)).sum()) < 0


def check_same_hand(own: Tensor, points: Tensor, name: str = "landmarks", owner: str = "the template") -> None:
    """Raises ``AlignmentError`` where points on a scan, or its vertices, (L,3), are a mirror image of a template's."""
    mirrored = check_mirrored(own, points)
    if mirrored.mirrored:
        raise AlignmentError(
            f"{name}: found a mirror image of {owner}'s: {mirrored.figures()} are left; the scan was exported in "
            "left-handed axes (export it in right-handed ones, or negate one coordinate of its vertices and "
            "landmarks), or left and right are swapped"
        )


def check_landmarks(landmarks: Landmarks, template: Mesh, scan: SurfaceIndex) -> tuple[Landmarks, Similarity, str]:
    """The landmarks that can be used, the similarity they give, and a note of what was left out ("" if nothing)."""
    ids, points = landmarks[0].detach().cpu(), landmarks[1].detach().cpu().double()
    if ids.ndim != 1 or points.shape != (len(ids), 3) or ids.dtype != torch.int64:
        raise ShapeError(
            f"landmarks: found {ids.dtype} {tuple(ids.shape)} and {tuple(points.shape)}, "
            "expected template vertex ids (L,) int64 and scan points (L,3)"
        )
    if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) < len(template.vertices):
        raise TopologyError(
            f"landmarks: found template vertices {int(ids.min())} to {int(ids.max())}, "
            f"expected 0 to {len(template.vertices) - 1}"
        )
    own = template.vertices.detach().cpu().double()[ids]
    present = torch.isfinite(points).all(-1)
    _check_size(own[present], points[present])
    off = torch.zeros_like(present)
    off[present] = scan.nearest(points[present]).distance > _OFF_SURFACE
    keep = present & ~off
    reasons = [f"{int((~present).sum())} are NaN"] * bool((~present).any())
    reasons += [f"{int(off.sum())} lie more than {_OFF_SURFACE:g} mm off the scan's surface"] * bool(off.any())
    if int(keep.sum()) < 3:
        why = f" ({', '.join(reasons)})" if reasons else ""
        raise ShapeError(f"landmarks: found {int(keep.sum())} that can be used of {len(ids)}{why}, expected at least 3")
    ids, points, own = ids[keep], points[keep], own[keep]
    for name, cloud in (("template", own), ("scan", points)):
        singular_values = torch.linalg.svdvals(cloud - cloud.mean(0))
        if float(singular_values[1]) <= _LINE * float(singular_values[0]):
            raise ValueRangeError(f"landmarks: those on the {name} lie on a line, expected a triangle of them")
    pose = similarity_transform(own[None], points[None])
    error = float((pose.apply(own)[0] - points).square().sum(-1).mean().sqrt())
    size = float((points.amax(0) - points.amin(0)).norm())
    check_same_hand(own, points)
    if error > _WORST_LANDMARK_FIT * size:
        raise AlignmentError(
            f"landmarks: the best similarity leaves {error:.1f} mm (root mean square) between the template's and the "
            f"scan's, which are {size:.0f} mm across; expected both in the same order"
        )
    note = f"of {len(keep)} landmarks {' and '.join(reasons)}; they were left out" if reasons else ""
    return (ids, points), pose, note


def _check_size(own: Tensor, points: Tensor) -> None:
    """Refuses points on a scan (L,3) in another unit than a template's own (L,3); the farthest half may be wrong."""
    if len(points) < 3:
        return
    order = (points - points.median(0).values).norm(dim=1).argsort()[: max(3, len(points) // 2 + 1)]
    size, beside = extent(points[order]), extent(own[order])
    if not 0 < size < _LEAST_EXTENT * beside and not size > _MOST_EXTENT * beside:
        return
    power = round(math.log10(max(beside, 1e-30) / size))
    seem = f", as points in {_UNITS[power]} are" if power in _UNITS else ""
    raise ValueRangeError(
        f"landmarks: found {size:.3g} mm across, where the template's are {beside:.3g} mm across{seem}; "
        f"expected the scan's unit: multiply them by {10.0**power:g}"
    )


def one_side_notes(template: Mesh, matched: Tensor) -> list[str]:
    """A warning of parts of the face that a scan shows on one side only; matched (V,) bool is what it shows."""
    regions = template.regions
    pairs = {part: [regions.get(f"{part}_{side}") for side in ("left", "right")] for part in _PAIRED}
    if "face" in regions:
        face, across = regions["face"], template.vertices[:, 0]
        left = across > across[face].mean()
        pairs["face"] = [face & left, face & ~left]
    lost: dict[str, list[str]] = {"left": [], "right": []}
    for part, masks in pairs.items():
        shown = [float(matched[mask.cpu()].double().mean()) for mask in masks if mask is not None]
        if len(shown) == 2 and min(shown) < _ONE_SIDE * max(shown):
            side, other = ("left", "right") if shown[0] < shown[1] else ("right", "left")
            lost[side].append(f"{min(shown):.0%} of the {part} ({max(shown):.0%} at the {other})")
    said = "warning: at the person's {} the scan shows {}: the rest is a guess"
    return [said.format(side, ", ".join(parts)) for side, parts in lost.items() if parts]


def lost_part_notes(template: Mesh, outward: Tensor, shown: Tensor) -> list[str]:
    """A warning of parts of the face that a scan shows at neither side; of the template's vertices, (V,) bool,
    ``outward`` can be seen and ``shown`` are, or lie under hair."""
    notes = template.annotations or Annotations()
    cheeks = [notes.regions[name].cpu() for name in ("cheek_left", "cheek_right") if name in notes.regions]
    parts = {"cheeks": cheeks} if cheeks else {}
    if notes.landmarks is not None and len(notes.landmarks) == 68:
        points = template.vertices.detach().cpu().double()
        near = torch.cdist(points[notes.landmarks.cpu()], points) < _AROUND
        parts |= {part: [near[list(rows)].any(0) for rows in sides] for part, sides in _PARTS.items()}
    most = {name: max(float(shown[side & outward].double().mean()) for side in sides) for name, sides in parts.items()}
    lost = [f"{share:.0%} of the {name}" for name, share in most.items() if share < _LEAST_SHOWN]
    return [f"warning: the scan shows {', '.join(lost)}: the rest is a guess"] if lost else []
