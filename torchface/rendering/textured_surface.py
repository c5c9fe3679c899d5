"""Surface of many materials, drawn as a viewer of characters would: textures, cut-outs, a light at the camera."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import triangle_normals, vertex_normals
from torchface.geometry.similarity import Similarity
from torchface.rendering.raycast import Hits, RayCaster

_LAYERS = 4  # of cut-out surfaces (lashes, brows) that a ray passes
_OPAQUE = 0.5
_STEP = 1e-5  # of the surface's size, behind a surface that a ray passes
_BACKGROUND = 0.62
_AMBIENT, _FALL = 0.45, 0.55


@dataclass(frozen=True, eq=False)
class Material:
    """What covers some triangles."""

    color: Tensor  # red, green, blue and opacity, (4,), encoded as images are
    texture: Tensor | None = None  # (4,H,W) in [0,1], first row on top; none for the plain colour


@dataclass(frozen=True, eq=False)
class TexturedSurface:
    """Triangles of several materials."""

    vertices: Tensor  # (V,3), any unit
    faces: Tensor
    uvs: Tensor  # (V,2), origin at the lower left
    material: Tensor  # which of the materials each triangle has, (F,) int64
    materials: tuple[Material, ...]
    _made: dict[str, object] = field(default_factory=dict, init=False, repr=False)

    def draw(self, camera: Camera, plain: bool = False, side: float = -1.0) -> "DrawnSurface":
        """A picture of the surface, a ray a pixel, in clay if ``plain``; the light stands above the camera, at its
        left for -1, its right for 1."""
        origins, directions = (rays.reshape(-1, 3) for rays in camera.rays())
        hits, color = self.first_opaque(origins, directions, plain)
        seen = hits.triangle >= 0
        picture = torch.full((len(origins), 3), _BACKGROUND)
        corners = self.faces[hits.triangle[seen]]
        normals = (self._normals[corners] * hits.barycentric[seen, :, None].double()).sum(1)
        normals = torch.nn.functional.normalize(normals, dim=-1)
        normals = torch.where((normals * directions[seen]).sum(-1, keepdim=True) > 0, -normals, normals)
        facing = (normals @ self._light(camera, side)).clamp(min=0)
        picture[seen] = color[seen] * (_AMBIENT + _FALL * facing.float())[:, None]
        shape = (camera.height, camera.width)
        return DrawnSurface(picture.T.reshape(3, *shape).clamp(0, 1).contiguous(), seen.reshape(shape))

    @staticmethod
    def _light(camera: Camera, side: float) -> Tensor:
        """The way to a light above the camera and to its left (-1) or right (1)."""
        way = torch.tensor([0.45 * side, -0.55, -0.7], dtype=torch.float64)
        return torch.nn.functional.normalize(way, dim=0) @ camera.rotation

    def moved(self, pose: Similarity) -> "TexturedSurface":
        """The surface moved by a similarity, a batch of one."""
        return TexturedSurface(
            pose.apply(self.vertices.double())[0], self.faces, self.uvs, self.material, self.materials
        )

    def facing(self, hits: Hits, directions: Tensor) -> Tensor:
        """The cosine (R,) between each ray and the surface that it hits, whichever side; 0 for a miss."""
        seen = hits.triangle >= 0
        cosine = torch.zeros(len(directions), dtype=torch.float64)
        normals = triangle_normals(self.vertices.double(), self.faces[hits.triangle[seen]])
        cosine[seen] = (normals * directions[seen]).sum(-1).abs()
        return cosine

    def first_opaque(self, origins: Tensor, directions: Tensor, plain: bool = False) -> tuple[Hits, Tensor]:
        """Where each ray (R,3) first meets what is not cut out, and the colour there, (R,3)."""
        caster = self._caster
        hits = caster.cast(origins, directions)
        color = self._colors(hits, plain)
        passed = _STEP * self._size
        for _ in range(_LAYERS):
            clear = ((hits.triangle >= 0) & (color[:, 3] < _OPAQUE)).nonzero()[:, 0]
            if not len(clear):
                break
            start = hits.distance[clear] + passed
            behind = caster.cast(origins[clear] + start[:, None] * directions[clear], directions[clear])
            hits.triangle[clear], hits.barycentric[clear] = behind.triangle, behind.barycentric
            hits.distance[clear] = start + behind.distance
            color[clear] = self._colors(behind, plain)
        return hits, color[:, :3]

    def _colors(self, hits: Hits, plain: bool) -> Tensor:
        """Red, green, blue and opacity (R,4) where rays hit."""
        color = torch.ones(len(hits.triangle), 4)
        seen = (hits.triangle >= 0).nonzero()[:, 0]
        which = self.material[hits.triangle[seen]]
        for number in which.unique().tolist():
            own, material = seen[which == number], self.materials[number]
            color[own] = material.color
            if material.texture is not None:
                corners = self.faces[hits.triangle[own]]
                uv = (self.uvs[corners] * hits.barycentric[own, :, None]).sum(1)
                color[own] = color[own] * _texels(material.texture, uv)
            if plain:
                color[own, :3] = torch.tensor([0.80, 0.66, 0.58])
        return color

    @property
    def _caster(self) -> RayCaster:
        if "caster" not in self._made:
            self._made["caster"] = RayCaster(self.vertices, self.faces)
        return self._made["caster"]  # type: ignore[return-value]

    @property
    def _normals(self) -> Tensor:
        if "normals" not in self._made:
            self._made["normals"] = vertex_normals(self.vertices.double(), self.faces)
        return self._made["normals"]  # type: ignore[return-value]

    @property
    def _size(self) -> float:
        return float((self.vertices.amax(0) - self.vertices.amin(0)).norm())


@dataclass(frozen=True, eq=False)
class DrawnSurface:
    """A picture (3,H,W) in [0,1], and where it shows the surface, (H,W) bool."""

    picture: Tensor
    seen: Tensor


def _texels(texture: Tensor, uv: Tensor) -> Tensor:
    """The texels (R,4) next to coordinates (R,2), repeated beyond the border."""
    height, width = texture.shape[1:]
    column = ((uv[:, 0] % 1) * width).long().clamp(0, width - 1)
    row = (((1 - uv[:, 1]) % 1) * height).long().clamp(0, height - 1)
    return texture[:, row, column].T
