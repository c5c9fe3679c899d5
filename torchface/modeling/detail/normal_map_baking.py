"""Baking of normal maps: detail that a high-resolution scan shows and a face mesh is too coarse to hold."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.geometry.meshes.normal_maps import DetailMaps, encode_normals
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.rasterization import TexelMap, interpolate, rasterise_uvs
from torchface.geometry.meshes.tangent_space import TangentSpace, tangent_space, to_tangent_space
from torchface.geometry.similarity import Similarity
from torchface.mesh import Mesh
from torchface.modeling.detail.scan_alignment import Correspondences, ScanAlignment, align_scan
from torchface.number_checks import checked_count, checked_number, checked_type
from torchface.rendering.raycast import RayCaster

MAX_SIDE = 8192
_BATCH = 2**19
_STAND_OFF = 1e-3  # millimetres; rays start this far behind the surface, so that a scan that touches it is hit


@dataclass(frozen=True)
class BakeSettings:
    """How far a bake's rays go, and which hits count.

    Args:
        maximum_distance: along the normal, millimetres.
        maximum_angle: between the normals of mesh and scan, degrees, 90 at most.
        padding: texels by which charts are dilated, so that seams do not show when the map is filtered.

    Raises:
        ValueRangeError: a limit that makes no sense.

    Example:
        >>> BakeSettings(maximum_distance=2.0).maximum_angle
        80.0
    """

    maximum_distance: float = 5.0
    maximum_angle: float = 80.0
    padding: int = 16

    def __post_init__(self) -> None:
        checked_number("maximum_distance", self.maximum_distance, above=True, most=1e6)
        checked_number("maximum_angle", self.maximum_angle, 0.0, 90.0, above=True)
        checked_count("padding", self.padding, 0, MAX_SIDE)


@dataclass(frozen=True)
class BakeStatistics:
    """What the rays of a bake found.

    Args:
        texels: inside the mesh's charts.
        hit_share: of them, those whose ray hit the scan within the maximum distance from its outer side.
        median_distance, far_distance: from mesh to scan along the normal, the median and the 95th percentile over
            the texels hit, millimetres; NaN where none was.
        median_offset: the same with a sign, positive where the scan lies outside the mesh.

    Example:
        >>> found = BakeStatistics(1000, hit_share=0.9, median_distance=0.1, far_distance=0.4, median_offset=0.0)
        >>> round(found.texels * found.hit_share)  # texels that the scan covers
        900
    """

    texels: int
    hit_share: float
    median_distance: float
    far_distance: float
    median_offset: float


@dataclass(frozen=True, eq=False)
class NormalMap:
    """A baked map.

    Args:
        normals: unit vectors in tangent space (see ``torchface.geometry.meshes.tangent_space``), (3,H,W).
        hit: the texels that the scan covers, (H,W) bool; the others are flat.
        heights: by which the scan stands out of the mesh along the normal, millimetres, (H,W); 0 where not hit.
        alignment: how the scan was aligned with the mesh; none where it was given.
        statistics: what the rays found.
    """

    normals: Tensor
    hit: Tensor
    heights: Tensor
    alignment: ScanAlignment | None
    statistics: BakeStatistics

    @property
    def image(self) -> Tensor:
        """The image as files hold it, (3,H,W) in [0,1]."""
        return encode_normals(self.normals)


def bake_normal_map(
    mesh: Mesh,
    high_resolution_scan: Mesh,
    size: int | tuple[int, int] = 2048,
    correspondences: Correspondences | None = None,
    alignment: Similarity | None = None,
    scale: bool = False,
    settings: BakeSettings = BakeSettings(),
) -> NormalMap:
    """Writes the normals of a high-resolution scan into a map for a mesh of the same face and expression.

    The scan is aligned with the mesh. From each texel's point two rays go along the interpolated normal, outward and
    inward; the nearer hit whose smooth normal deviates by no more than ``maximum_angle`` counts, and that normal is
    written in the mesh's tangent space. Texels without such a hit stay flat, (0, 0, 1).

    Args:
        mesh: the face, a shape of the rig at weight 1, with texture coordinates.
        high_resolution_scan: millimetres; any topology, and any pose.
        size: of the map, texels a side, or height and width.
        correspondences: vertex ids (L,) or points (L,3) of the mesh, and points (L,3) of the scan, at least three;
            the scan finds its place by itself if they are absent, see ``align_scan``.
        alignment: scan space to mesh space, if given; then nothing is estimated.
        scale: estimate the scan's scale too.
        settings: how far rays go, and what counts as a hit.

    Returns:
        ``NormalMap(normals (3,H,W), hit (H,W), heights (H,W), alignment, statistics)``.

    Raises:
        ShapeError: fewer than three correspondences.
        TopologyError: the mesh has no texture coordinates, or mesh or scan have no triangles.
        ValueRangeError: a size or limit that makes no sense, NaN, a scan in another unit or with its normals inside.
        AlignmentError: the scan does not find its place by itself.

    Source: thesis 3.3.2.

    Example:
        >>> from torchface.geometry.similarity import Similarity
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> still = Similarity(torch.ones(1), torch.eye(3)[None], torch.zeros(1, 3))
        >>> baked = bake_normal_map(head, head, size=32, alignment=still)  # a head on itself: no detail
        >>> bool(baked.statistics.far_distance < 0.01), bool(baked.normals[2].median() > 0.99)
        (True, True)
    """
    checked_type("settings", settings, BakeSettings)
    if alignment is not None:
        checked_type("alignment", alignment, Similarity)
    height, width = _checked_size(size)
    uvs, uv_faces = _checked_meshes(mesh, high_resolution_scan)
    found = None
    if alignment is None:
        found = align_scan(mesh, high_resolution_scan, correspondences, scale)
        alignment = found.similarity
    elif correspondences is not None:
        raise ValueRangeError("bake_normal_map: found both correspondences and an alignment, expected one of them")
    texels = rasterise_uvs(uvs, uv_faces, height, width)
    if len(texels.texels) == 0:
        raise ValueRangeError(
            f"mesh: no texel's centre of {height} x {width} lies in a triangle; expected uvs within the unit square "
            "and a larger size"
        )
    vertices = mesh.vertices.detach().double()
    space = tangent_space(vertices, mesh.faces, uvs.double(), uv_faces, vertex_normals(vertices, mesh.faces))
    scan = _Surface.of(high_resolution_scan.vertices.detach().double(), high_resolution_scan.faces, alignment)
    cosine = float(torch.tensor(settings.maximum_angle).deg2rad().cos())
    normals, offset, opposed = _cast_all(vertices, space, texels, scan, settings.maximum_distance, cosine)
    seen = torch.isfinite(offset)
    if float(opposed) > 0.5 and float(seen.double().mean()) < 0.05:
        raise ValueRangeError(
            f"scan: {float(opposed):.0%} of the rays meet it from inside; expected triangles that run "
            "counter-clockwise seen from outside"
        )
    hit = torch.zeros(height * width, dtype=torch.bool)
    hit[texels.texels] = seen
    return NormalMap(
        texels.image(normals, settings.padding, torch.tensor([0.0, 0.0, 1.0])),
        hit.view(height, width),
        texels.image(torch.where(seen, offset, 0.0)[:, None], settings.padding, torch.zeros(1))[0],
        found,
        _statistics(offset[seen], len(offset)),
    )


def detail_maps(names: Sequence[str], baked: Sequence[NormalMap], neutral: NormalMap | None = None) -> DetailMaps:
    """Maps baked from scans of expressions, one a shape, ready to be mixed by weight.

    Where a scan covers nothing, its shape keeps the neutral's map.

    Args:
        names: the shapes.
        baked: one each, all of one size.
        neutral: the map of the face at rest.

    Raises:
        ShapeError: the sizes differ, or there is no map.
        NameMismatchError: not one name a map, or a name twice.

    Example:
        >>> from torchface.modeling import bake_normal_map
        >>> from torchface.geometry.similarity import Similarity
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> still = Similarity(torch.ones(1), torch.eye(3)[None], torch.zeros(1, 3))
        >>> maps = detail_maps(["jawOpen"], [bake_normal_map(head, head, size=16, alignment=still)])
        >>> maps.names, maps.maps.shape == (1, 3, 16, 16)
        (('jawOpen',), True)
    """
    for one in (*baked, *([neutral] if neutral else [])):
        checked_type("a map", one, NormalMap)
    sizes = {tuple(one.normals.shape) for one in (*baked, *([neutral] if neutral else []))}
    if len(baked) == 0 or len(sizes) != 1:
        raise ShapeError(f"detail_maps: found {len(baked)} maps of sizes {sorted(sizes)}, expected some of one size")
    if neutral is None:
        return DetailMaps(tuple(names), torch.stack([one.normals for one in baked]))
    filled = [torch.where(one.hit, one.normals, neutral.normals) for one in baked]
    return DetailMaps(tuple(names), torch.stack(filled), neutral.normals)


@dataclass(frozen=True, eq=False)
class _Surface:
    """A scan in mesh space, ready for rays."""

    caster: RayCaster
    faces: Tensor
    normals: Tensor
    low: Tensor
    high: Tensor

    @staticmethod
    def of(vertices: Tensor, faces: Tensor, alignment: Similarity) -> "_Surface":
        moved = alignment.apply(vertices[None])[0]
        used = moved[faces.flatten().unique()]
        normals = vertex_normals(moved, faces).float()
        return _Surface(RayCaster(moved, faces), faces, normals, used.amin(0), used.amax(0))

    def may_reach(self, points: Tensor, distance: float) -> Tensor:
        """Whether points (R,3) are so near to the surface's bounding box that a ray of a length could hit, (R,)."""
        return ((points >= self.low - distance) & (points <= self.high + distance)).all(-1)

    def hits(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (R,) and smooth unit normal (R,3), zero for a miss."""
        cast = self.caster.cast(origins, directions)
        corners = self.faces[cast.triangle.clamp(min=0)]
        normals = interpolate(self.normals, corners, cast.barycentric.float())
        return cast.distance, torch.nn.functional.normalize(normals, dim=-1)


def _cast_all(
    vertices: Tensor, space: TangentSpace, texels: TexelMap, scan: _Surface, reach: float, cosine: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Tangent-space normals (M,3), offsets (M,), infinite where nothing counted, and the share that met back sides."""
    count = len(texels.texels)
    normals = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float32).repeat(count, 1)
    offsets = torch.full((count,), torch.inf, dtype=torch.float32)
    opposed = torch.zeros(())
    for start in range(0, count, _BATCH):  # batches bound the memory
        piece = torch.arange(start, min(start + _BATCH, count))
        points = interpolate(vertices, space.faces[texels.triangles[piece]], texels.barycentric[piece])
        near = scan.may_reach(points, reach)
        piece, points = piece[near], points[near]
        frames = space.frames(texels.triangles[piece], texels.barycentric[piece])
        ways = torch.nn.functional.normalize(frames[..., 2], dim=-1)
        offset, hit_normals, back = _nearest_hits(points, ways, scan, reach, cosine)
        local = to_tangent_space(frames, hit_normals.double())
        good = torch.isfinite(offset) & (local[:, 2] > 0)
        normals[piece[good]] = local[good].float()
        offsets[piece[good]] = offset[good].float()
        opposed += back.sum()
    return normals, offsets, opposed / count


def _nearest_hits(
    points: Tensor, ways: Tensor, scan: _Surface, reach: float, cosine: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Signed distance along the normal, infinite without a hit that counts; its normal; whether a back side is near."""
    best = torch.full((len(points),), torch.inf, dtype=torch.float64)
    normals = torch.zeros(len(points), 3, dtype=torch.float32)
    back = torch.zeros(len(points), dtype=torch.bool)
    for side in (1.0, -1.0):
        distance, found = scan.hits(points - side * _STAND_OFF * ways, side * ways)
        offset = side * (distance - _STAND_OFF)
        agreement = (found * ways).sum(-1)
        near = (distance - _STAND_OFF).abs() <= reach
        back |= near & (agreement < -cosine)
        counts = near & (agreement >= cosine) & (offset.abs() < best.abs())
        best = torch.where(counts, offset, best)
        normals = torch.where(counts[:, None], found, normals)
    return best, normals, back


def _statistics(offsets: Tensor, texels: int) -> BakeStatistics:
    if len(offsets) == 0:
        return BakeStatistics(texels, 0.0, float("nan"), float("nan"), float("nan"))
    ordered = offsets.abs().sort().values
    return BakeStatistics(
        texels,
        len(offsets) / texels,
        float(ordered[len(ordered) // 2]),
        float(ordered[int(0.95 * (len(ordered) - 1))]),
        float(offsets.median()),
    )


def _checked_size(size: int | tuple[int, int]) -> tuple[int, int]:
    sides = size if isinstance(size, tuple) else (size, size)
    whole = len(sides) == 2 and all(isinstance(side, int) and not isinstance(side, bool) for side in sides)
    if not whole or not all(1 <= side <= MAX_SIDE for side in sides):
        raise ValueRangeError(f"size: found {size!r}, expected one or two whole numbers from 1 to {MAX_SIDE}")
    return sides[0], sides[1]


def _checked_meshes(mesh: Mesh, scan: Mesh) -> tuple[Tensor, Tensor]:
    checked_type("mesh", mesh, Mesh)
    checked_type("scan", scan, Mesh)
    if mesh.uvs is None or mesh.uv_faces is None:
        raise TopologyError("mesh: found no texture coordinates, expected uvs and uv_faces to bake into")
    for name, one in (("mesh", mesh), ("scan", scan)):
        if len(one.faces) == 0:
            raise TopologyError(f"{name}: found {len(one.vertices)} vertices and no triangle, expected a surface")
        cross = vertex_normals(one.vertices.double(), one.faces)
        if not (cross.norm(dim=1) > 0.5).any():
            raise TopologyError(f"{name}: found only triangles without area, expected a surface")
    return mesh.uvs, mesh.uv_faces
