"""Images of a mesh by ray casting, lit so that form shows: key, fill and rim light, soft shadow in creases."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.color_space import to_linear, to_srgb
from torchface.errors import ShapeError, TopologyError
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.tangent_space import from_tangent_space, tangent_space
from torchface.mesh import Mesh
from torchface.rendering.part_colors import CLAY, without_clear_shells
from torchface.rendering.raycast import RayCaster

__all__ = ["Lighting", "render"]

_OCCLUSION_REACH = 60.0  # millimetres beyond which a surface no longer dims


@dataclass(frozen=True)
class Lighting:
    """Lights that move with the camera, so that a profile is lit as well as a front view.

    Args:
        lights: direction toward the light in the camera's frame (right, up, toward the viewer) and its strength.
        ambient: light from everywhere, dimmed where other parts of the mesh stand close.
        occlusion_rays: rays a pixel that measure how close; 0 leaves the dimming out.
        gloss: strength of the highlight.

    Example:
        >>> even = Lighting(lights=(), ambient=1.0, occlusion_rays=0, gloss=0.0)  # shows colours as they are
        >>> even.ambient
        1.0
    """

    lights: tuple[tuple[tuple[float, float, float], float], ...] = (
        ((-0.55, 0.60, 0.60), 0.85),
        ((0.80, 0.10, 0.50), 0.12),
        ((0.30, 0.60, -0.75), 0.20),
    )
    ambient: float = 0.18
    occlusion_rays: int = 8
    gloss: float = 0.05


DEFAULT_LIGHTING = Lighting()


def render(
    mesh: Mesh,
    camera: Camera,
    colors: Tensor | None = None,
    lighting: Lighting = DEFAULT_LIGHTING,
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    samples: int = 2,
    normal_map: Tensor | None = None,
) -> Tensor:
    """An image of a mesh.

    Args:
        mesh: its texture is used where it has one, else its vertex colours, else clay; clear shells over eyes are left
            out.
        camera: see ``torchface.geometry.cameras.pinhole.look_at``.
        colors: vertex colours (V,3) in [0,1] to use instead, for example a heat map.
        lighting: which lights.
        background: colour where no ray hits.
        samples: rays a pixel side.
        normal_map: unit vectors in the mesh's tangent space, (3,h,w); see ``blend_normal_maps`` for several.

    Returns:
        An image (3,H,W) in [0,1], float32.

    Raises:
        ShapeError: the normal map is not (3,h,w).
        TopologyError: a normal map is given and the mesh has no texture coordinates.

    Example:
        >>> from torchface.geometry.cameras.pinhole import look_at
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> camera = look_at(head.vertices[head.landmarks].mean(0), 0.0, width=32, height=40)
        >>> image = render(head, camera, samples=1)
        >>> image.shape == (3, 40, 32), bool(image[:, 20, 16].mean() < 1)  # a face before white
        (True, True)
    """
    origins, directions = camera.rays(samples)
    height, width = directions.shape[:2]
    origins, directions = origins.reshape(-1, 3), directions.reshape(-1, 3)
    mesh = without_clear_shells(mesh)
    caster = RayCaster(mesh.vertices, mesh.faces)
    hits = caster.cast(origins, directions)
    seen = hits.triangle >= 0
    image = torch.tensor(background, dtype=torch.float32).expand(len(directions), 3).clone()
    if seen.any():
        triangle, barycentric = hits.triangle[seen], hits.barycentric[seen]
        points = origins[seen] + hits.distance[seen, None] * directions[seen]
        smooth = vertex_normals(mesh.vertices.double(), mesh.faces)
        normals = (smooth[mesh.faces[triangle]] * barycentric[..., None]).sum(1)
        normals = torch.nn.functional.normalize(normals, dim=-1)
        detailed = normals
        if normal_map is not None:
            detailed = _mapped_normals(mesh, smooth, normal_map, triangle, barycentric)
        # A surface seen from behind (inside of the mouth, a cut border) is lit as if it faced the viewer.
        behind = (normals * directions[seen]).sum(-1, keepdim=True) > 0
        normals, detailed = torch.where(behind, -normals, normals), torch.where(behind, -detailed, detailed)
        albedo = _albedo(mesh, colors, triangle, barycentric)
        image[seen] = _shade(caster, camera, lighting, points, normals, detailed, directions[seen], albedo)
    image = image.reshape(height // samples, samples, width // samples, samples, 3).mean((1, 3))
    return image.permute(2, 0, 1).clamp(0, 1).contiguous()


def _albedo(mesh: Mesh, colors: Tensor | None, triangle: Tensor, barycentric: Tensor) -> Tensor:
    if colors is None and mesh.texture is not None and mesh.uvs is not None and mesh.uv_faces is not None:
        uv = (mesh.uvs[mesh.uv_faces[triangle]].float() * barycentric[..., None]).sum(1)
        sampled = sample_texture(mesh.texture, uv)
        if mesh.colors is None:
            return sampled
        # Charts of further tiles (UDIM) have no place in the one image that a mesh has.
        beyond = ((uv < 0) | (uv > 1)).any(-1, keepdim=True)
        own = (mesh.colors[mesh.faces[triangle]].float() * barycentric[..., None]).sum(1)
        return torch.where(beyond, own.to(sampled), sampled)
    colors = mesh.colors if colors is None else colors
    if colors is None:
        return torch.tensor(CLAY).expand(len(triangle), 3)
    return (colors[mesh.faces[triangle]].float() * barycentric[..., None]).sum(1)


def _mapped_normals(mesh: Mesh, smooth: Tensor, normal_map: Tensor, triangle: Tensor, barycentric: Tensor) -> Tensor:
    if mesh.uvs is None or mesh.uv_faces is None:
        raise TopologyError("render: found a normal map for a mesh without texture coordinates, expected uvs")
    if normal_map.ndim != 3 or normal_map.shape[0] != 3:
        raise ShapeError(f"normal_map: found {tuple(normal_map.shape)}, expected (3,h,w)")
    space = tangent_space(mesh.vertices.double(), mesh.faces, mesh.uvs.double(), mesh.uv_faces, smooth)
    uv = (mesh.uvs[mesh.uv_faces[triangle]].float() * barycentric[..., None]).sum(1)
    return from_tangent_space(space.frames(triangle, barycentric), sample_texture(normal_map, uv).double())


def sample_texture(texture: Tensor, uv: Tensor) -> Tensor:
    """Colours (R,3) of an image (3,H,W) at texture coordinates (R,2), bilinear, clamped at the border."""
    grid = torch.stack([uv[:, 0] * 2 - 1, 1 - uv[:, 1] * 2], dim=-1).float()
    sampled = torch.nn.functional.grid_sample(
        texture[None].float(), grid[None, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return sampled[0, :, 0].T


def _shade(
    caster: RayCaster,
    camera: Camera,
    lighting: Lighting,
    points: Tensor,
    smooth: Tensor,
    normals: Tensor,
    ways: Tensor,
    albedo: Tensor,
) -> Tensor:
    right, down, forward = camera.rotation.double()
    light = torch.full((len(points),), lighting.ambient, dtype=torch.float64)
    if lighting.occlusion_rays:
        # About the smooth normal: half the rays about one that a map has tilted would start into the skin.
        light = light * _openness(caster, points, smooth, lighting)
    highlight = torch.zeros_like(light)
    for (x, y, z), strength in lighting.lights:
        toward = torch.nn.functional.normalize(x * right - y * down - z * forward, dim=0)
        cosine = normals @ toward
        # Wrapped a little past the terminator, as light that scatters under skin is.
        light = light + strength * ((cosine + 0.15) / 1.15).clamp(min=0)
        half = torch.nn.functional.normalize(toward - ways, dim=-1)
        highlight = highlight + strength * (normals * half).sum(-1).clamp(min=0) ** 30
    lit = to_linear(albedo).double() * light[:, None] + lighting.gloss * highlight[:, None]
    return to_srgb(lit.clamp(0, 1)).float()


def vertex_openness(mesh: Mesh) -> Tensor:
    """The share of the hemisphere over each vertex that is free within the default lighting's reach, (V,) in [0,1]."""
    normals = vertex_normals(mesh.vertices.double(), mesh.faces)
    points = mesh.vertices.double() + 0.05 * normals
    return _openness(RayCaster(mesh.vertices, mesh.faces), points, normals, DEFAULT_LIGHTING).float().clamp(0, 1)


def _openness(caster: RayCaster, points: Tensor, normals: Tensor, lighting: Lighting) -> Tensor:
    """The share of the hemisphere over each point (R,) that is free within reach."""
    count = lighting.occlusion_rays
    generator = torch.Generator().manual_seed(0)
    turn = torch.rand(len(points), 1, generator=generator) * 2 * math.pi
    starts, normals = points + 0.05 * normals, normals.float()
    helper = torch.where(normals[:, :1].abs() > 0.9, torch.tensor([[0.0, 1, 0]]), torch.tensor([[1.0, 0, 0]]))
    side = torch.nn.functional.normalize(torch.linalg.cross(normals, helper), dim=-1)
    other = torch.linalg.cross(normals, side)
    free = torch.zeros(len(points))
    for i in range(count):  # a loop over rays, each a batch over pixels: all at once would take gigabytes
        height = math.sqrt((i + 0.5) / count)
        angle = turn + i * 2.399963
        way = height * normals + math.sqrt(1 - height**2) * (angle.cos() * side + angle.sin() * other)
        free += caster.distances(starts, way, _OCCLUSION_REACH)
    return free.double() / (count * _OCCLUSION_REACH)
