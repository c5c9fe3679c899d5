"""The triangle mesh with seams, quads and annotations that the whole toolkit works on."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.geometry.meshes.trimesh_conversion import from_trimesh, to_trimesh
from torchface.number_checks import as_real, as_tensor, checked_indices, checked_type

if TYPE_CHECKING:
    from pathlib import Path

    import trimesh

_FAN_CELLS = 2**20


@dataclass(frozen=True)
class Annotations:
    """Landmarks, regions and symmetry of a mesh's vertices; travels in glTF extras.

    Args:
        landmarks: vertex ids of the 68 iBUG landmarks (or another set), (L,) int64.
        regions: boolean vertex masks by name, each (V,).
        mirror: the vertex on the other side of the face, (V,) int64; a midline vertex names itself.
        contacts: pairs of vertex ids that touch when lids or lips close, (K,2) int64.

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> notes = neutral_head(texture=False).annotations
        >>> len(notes.landmarks), sorted(notes.regions)[:3]
        (68, ['brow_left', 'brow_right', 'cheek_left'])
        >>> bool((notes.mirror[notes.mirror] == torch.arange(len(notes.mirror))).all())
        True
    """

    landmarks: Tensor | None = None
    regions: dict[str, Tensor] = field(default_factory=dict)
    mirror: Tensor | None = None
    contacts: Tensor | None = None

    def __post_init__(self) -> None:
        for name, expected in (("landmarks", "(68,)"), ("mirror", "(V,)"), ("contacts", "(K,2)")):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, as_tensor(name, getattr(self, name), expected, torch.int64))

    def to(self, device: torch.device | str) -> Annotations:
        """The same annotations on another device."""
        return Annotations(
            None if self.landmarks is None else self.landmarks.to(device),
            {name: mask.to(device) for name, mask in self.regions.items()},
            None if self.mirror is None else self.mirror.to(device),
            None if self.contacts is None else self.contacts.to(device),
        )


_TENSORS = (
    ("vertices", "(V,3)", None),
    ("faces", "(F,3)", torch.int64),
    ("uvs", "(U,2)", None),
    ("uv_faces", "(F,3)", torch.int64),
    ("colors", "(V,3)", None),
    ("texture", "(3,H,W)", None),
    ("polygons", "(P,K)", torch.int64),
)
"""A mesh's tensors, their shapes, and the integers among them."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A mesh in millimetres, y up, z toward the viewer.

    Args:
        vertices: positions, (V,3) float, finite.
        faces: triangles, (F,3) int64. With ``polygons`` they are its fan triangulation, in order.
        uvs: texture coordinates, (U,2), origin at the lower left.
        uv_faces: the rows of ``uvs`` at each triangle's corners, (F,3) int64; a seam gives a vertex several.
        colors: vertex colours in [0,1], (V,3).
        texture: an image in [0,1], (3,H,W), first row on top.
        polygons: the faces as authored, (P,K) int64, shorter rows padded with -1.
        annotations: landmarks, regions, mirror map, contact pairs.

    Raises:
        ShapeError: a tensor has the wrong shape.
        TopologyError: there is no vertex, an index points outside, or ``faces`` is not the fan triangulation of
            ``polygons``.
        ValueRangeError: a position is NaN or infinite.

    Example:
        >>> triangle = Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))
        >>> triangle
        Mesh(3 vertices, 1 triangles)
        >>> triangle.with_vertices(2 * triangle.vertices).fingerprint() == triangle.fingerprint()
        True
    """

    vertices: Tensor
    faces: Tensor
    uvs: Tensor | None = None
    uv_faces: Tensor | None = None
    colors: Tensor | None = None
    texture: Tensor | None = None
    polygons: Tensor | None = None
    annotations: Annotations | None = None

    def __post_init__(self) -> None:
        for name, shape, dtype in _TENSORS:
            value = getattr(self, name)
            if not isinstance(value, Tensor) and (value is not None or name in ("vertices", "faces")):
                object.__setattr__(self, name, as_tensor(name, value, shape, dtype or torch.get_default_dtype()))
        object.__setattr__(self, "vertices", as_real(self.vertices))
        if self.annotations is not None:
            checked_type("annotations", self.annotations, Annotations)
        _check_shape("vertices", self.vertices, (None, 3))
        _check_shape("faces", self.faces, (None, 3))
        if len(self.vertices) == 0:
            raise TopologyError("mesh: found no vertices, expected at least one")
        if not torch.isfinite(self.vertices).all():
            bad = int((~torch.isfinite(self.vertices)).any(-1).sum())
            raise ValueRangeError(f"mesh: {bad} of {len(self.vertices)} vertices are NaN or infinite; expected none")
        checked_indices("faces", self.faces, len(self.vertices))
        if (self.uvs is None) != (self.uv_faces is None):
            raise TopologyError("mesh: uvs and uv_faces come together; found only one of them")
        if self.uvs is not None and self.uv_faces is not None:
            _check_shape("uvs", self.uvs, (None, 2))
            _check_shape("uv_faces", self.uv_faces, (len(self.faces), 3))
            checked_indices("uv_faces", self.uv_faces, len(self.uvs))
        if self.colors is not None:
            _check_shape("colors", self.colors, (len(self.vertices), 3))
        if self.texture is not None:
            _check_shape("texture", self.texture, (3, None, None))
        if self.polygons is not None and not _are_fans(self.polygons, self.faces):
            raise TopologyError("mesh: faces are not the fan triangulation of polygons")
        if self.annotations is not None:
            _check_annotations(self.annotations, len(self.vertices))

    @staticmethod
    def from_polygons(
        vertices: Tensor,
        polygons: Tensor,
        uvs: Tensor | None = None,
        uv_polygons: Tensor | None = None,
        **rest: Tensor | Annotations | None,
    ) -> Mesh:
        """A mesh of polygons (P,K), padded with -1; ``uv_polygons`` (P,K) is laid out alike.

        Example:
            >>> square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
            >>> Mesh.from_polygons(square, torch.tensor([[0, 1, 2, 3]])).faces.tolist()
            [[0, 1, 2], [0, 2, 3]]
        """
        uv_faces = None if uv_polygons is None else fan_triangulation(uv_polygons)
        return Mesh(vertices, fan_triangulation(polygons), uvs, uv_faces, polygons=polygons, **rest)  # type: ignore[arg-type]

    def to(self, device: torch.device | str) -> Mesh:
        """The same mesh on another device."""
        moved: dict[str, Any] = {
            f.name: value.to(device)
            for f in fields(self)
            if isinstance(value := getattr(self, f.name), Tensor | Annotations)
        }
        return replace(self, **moved)

    def with_vertices(self, vertices: Tensor) -> Mesh:
        """The same topology, texture, colours and annotations at other positions (V,3)."""
        vertices = as_tensor("vertices", vertices, "(V,3)")
        if vertices.shape != self.vertices.shape:
            raise ShapeError(f"vertices: found {tuple(vertices.shape)}, expected {tuple(self.vertices.shape)}")
        return replace(self, vertices=vertices)

    def to_trimesh(self) -> trimesh.Trimesh:
        """The mesh for ``trimesh``, in the same millimetres and axes, vertices unmerged and in order.

        ``trimesh`` has one texture coordinate a vertex: where texture coordinates have seams, vertices are split, and
        ``vertex_attributes["vertex_id"]`` says which vertex each was, so that :meth:`from_trimesh` joins them again.
        Lost are polygons (faces are their triangles) and annotations. Colours and texture have 8 bits a channel;
        beside texture coordinates colours are in ``vertex_attributes["color"]``, since ``trimesh`` shows one or the
        other.
        """
        return to_trimesh(self.vertices, self.faces, self.uvs, self.uv_faces, self.colors, self.texture)

    @staticmethod
    def from_trimesh(mesh: trimesh.Trimesh) -> Mesh:
        """The mesh of a ``trimesh.Trimesh`` in millimetres, y up, with its texture coordinates, image and colours.

        Vertices keep their order; those that :meth:`to_trimesh` split at seams are joined again, unless they have
        been moved apart. Colours of faces become the mean of a vertex's faces; opacity is lost.

        Raises:
            ShapeError: not a ``Trimesh``; of a ``trimesh.Scene`` take ``scene.to_geometry()``.
            ValueRangeError: a position is NaN or infinite.
        """
        return Mesh(**from_trimesh(mesh))

    @property
    def landmarks(self) -> Tensor:
        """Landmark vertex ids (L,); raises where the mesh has none."""
        if self.annotations is None or self.annotations.landmarks is None:
            raise ValueRangeError("mesh: no landmark vertices are annotated; set Annotations(landmarks=...)")
        return self.annotations.landmarks

    @property
    def regions(self) -> dict[str, Tensor]:
        """Annotated regions by name, (V,) bool each; none where the mesh has no annotations."""
        return {} if self.annotations is None else self.annotations.regions

    def require_topology(self, other: Mesh, source: str | Path, owner: str | Path, hint: str = "") -> None:
        """Raises ``TopologyError`` where this mesh, of a source, has not the vertices and triangles of another one."""
        if len(self.vertices) == len(other.vertices) and torch.equal(self.faces, other.faces.to(self.faces)):
            return
        counts = len(other.vertices), len(other.faces)
        same = "other triangles" if counts == (len(self.vertices), len(self.faces)) else f"{counts[1]} triangles"
        raise TopologyError(
            f"{source}: found {len(self.vertices)} vertices and {len(self.faces)} triangles, expected those of "
            f"{owner}, {counts[0]} vertices and {same}, in their order{hint}"
        )

    def fingerprint(self) -> str:
        """Sixteen hex digits that two meshes share when their triangles are the same."""
        digest = hashlib.sha256(self.faces.cpu().contiguous().numpy().tobytes())
        return f"{len(self.vertices)}-{digest.hexdigest()[:16]}"

    def __repr__(self) -> str:
        extra = "" if self.polygons is None else f", {len(self.polygons)} polygons"
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} triangles{extra})"


def other_topology(fingerprint: str, mesh: Mesh, owner: str | Path = "the mesh") -> str:
    """What distinguishes the mesh of a fingerprint from another one, for people to read."""
    count, vertices = fingerprint.partition("-")[0], len(mesh.vertices)
    if not count.isdecimal():
        return f"another mesh than {owner}, of {vertices} vertices"
    if int(count) != vertices:
        return f"a mesh of {int(count)} vertices, expected {owner}'s, of {vertices}"
    return f"a mesh with other triangles than {owner}, or the same in another order (both have {vertices} vertices)"


def fan_triangulation(polygons: Tensor) -> Tensor:
    """Triangles (F,3) of polygons (P,K) padded with -1: corner 0 with each following edge, polygon by polygon."""
    if polygons.ndim != 2 or polygons.shape[1] < 3:
        raise ShapeError(f"polygons: found {tuple(polygons.shape)}, expected (P,K) with K at least 3")
    blocks = list(_fans(polygons))
    return blocks[0] if len(blocks) == 1 else torch.cat(blocks)


def _fans(polygons: Tensor) -> Iterator[Tensor]:
    """The triangles of some polygons after the other: a table of all fans may be far larger than what it holds."""
    for some in polygons.split(max(1, _FAN_CELLS // polygons.shape[1])):
        apex = some[:, :1].expand(-1, some.shape[1] - 2)
        fan = torch.stack([apex, some[:, 1:-1], some[:, 2:]], dim=-1).reshape(-1, 3)
        yield fan[(fan >= 0).all(-1)].contiguous()


def _are_fans(polygons: Tensor, faces: Tensor) -> bool:
    """Whether the triangles (F,3) are those of the polygons, in their order."""
    done = 0
    for fan in _fans(polygons):
        if not torch.equal(fan, faces[done : done + len(fan)]):
            return False
        done += len(fan)
    return done == len(faces)


@dataclass(frozen=True)
class Submesh:
    """A part of a mesh: ``mesh`` with V' vertices, and where each stands in the whole, ``vertex_ids`` (V',)."""

    mesh: Mesh
    vertex_ids: Tensor


def submesh(mesh: Mesh, keep: Tensor) -> Submesh:
    """The part of a mesh whose vertices, a mask (V,) or ids (K,), are kept, in its order; a face stays when all its
    corners do."""
    count, device = len(mesh.vertices), mesh.vertices.device
    keep = as_tensor("keep", keep, "(V,) bool or (K,) int64, such as mesh.annotations.regions['face']")
    if keep.dtype == torch.bool:
        _check_shape("keep", keep, (count,))
    else:
        checked_indices("keep", keep, count)
    mask = torch.zeros(count, dtype=torch.bool, device=device)
    mask[keep] = True
    ids = mask.nonzero()[:, 0]
    if len(ids) == 0:
        raise ValueRangeError("submesh: no vertex is kept; expected at least one")
    new_id = torch.full((count + 1,), -1, dtype=torch.int64, device=device)  # the last row answers for padding
    new_id[ids] = torch.arange(len(ids), device=device)
    polygons = mesh.polygons
    if polygons is None:
        kept_faces = mask[mesh.faces].all(-1)
    else:
        kept_polygons = (mask[polygons.clamp(min=0)] | (polygons < 0)).all(-1)
        kept_faces = kept_polygons[_polygon_of_triangle(polygons)]
        polygons = new_id[polygons[kept_polygons]]
    uvs, uv_faces = None, None
    if mesh.uvs is not None and mesh.uv_faces is not None:
        used, uv_faces = mesh.uv_faces[kept_faces].unique(return_inverse=True)
        uvs = mesh.uvs[used]
    part = Mesh(
        mesh.vertices[ids],
        new_id[mesh.faces[kept_faces]],
        uvs,
        uv_faces,
        None if mesh.colors is None else mesh.colors[ids],
        mesh.texture,
        polygons,
        None if mesh.annotations is None else _part_of_annotations(mesh.annotations, ids, new_id),
    )
    return Submesh(part, ids)


def _polygon_of_triangle(polygons: Tensor) -> Tensor:
    triangles = (polygons >= 0).sum(1) - 2
    return torch.repeat_interleave(torch.arange(len(polygons), device=polygons.device), triangles)


def _part_of_annotations(whole: Annotations, ids: Tensor, new_id: Tensor) -> Annotations:
    """Landmarks survive only complete: a set with holes would change the meaning of its rows."""
    landmarks = None if whole.landmarks is None else new_id[whole.landmarks]
    mirror = None if whole.mirror is None else new_id[whole.mirror[ids]]
    contacts = None if whole.contacts is None else new_id[whole.contacts]
    return Annotations(
        landmarks if landmarks is not None and (landmarks >= 0).all() else None,
        {name: mask[ids] for name, mask in whole.regions.items()},
        mirror if mirror is not None and (mirror >= 0).all() else None,
        None if contacts is None else contacts[(contacts >= 0).all(-1)],
    )


def _check_shape(name: str, tensor: Tensor, expected: tuple[int | None, ...]) -> None:
    sizes = tuple(tensor.shape)
    if len(sizes) != len(expected) or any(e is not None and f != e for f, e in zip(sizes, expected, strict=True)):
        wanted = ",".join("*" if e is None else str(e) for e in expected)
        raise ShapeError(f"{name}: found {sizes}, expected ({wanted})")


def _check_annotations(annotations: Annotations, count: int) -> None:
    if annotations.landmarks is not None:
        _check_shape("landmarks", annotations.landmarks, (None,))
        checked_indices("landmarks", annotations.landmarks, count)
    if annotations.mirror is not None:
        _check_shape("mirror", annotations.mirror, (count,))
        checked_indices("mirror", annotations.mirror, count)
    if annotations.contacts is not None:
        _check_shape("contacts", annotations.contacts, (None, 2))
        checked_indices("contacts", annotations.contacts, count)
    for name, mask in annotations.regions.items():
        _check_shape(f"regions[{name!r}]", mask, (count,))
