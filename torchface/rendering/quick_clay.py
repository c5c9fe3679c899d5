"""A rig with its skin, or as clay with coloured eyes and mouth, drawn fast enough to play."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import components, vertex_normals
from torchface.geometry.meshes.rasterization import DrawnPixels, rasterise
from torchface.mesh import Mesh
from torchface.part_materials import EYEBALL, IRIS
from torchface.rendering.clay_shading import vertex_openness
from torchface.rendering.part_colors import CLAY, clear_triangles, triangle_colors

BACKGROUND = (38, 40, 44)
_TINT, _TINT_SHARE = (236, 92, 40), 0.75
_LIPS = (0.77, 0.52, 0.47)
_LEVELS, _TINT_LEVELS = 256, 4
_AMBIENT, _HIGHLIGHT = 0.16, 0.08
# Right, up, toward the viewer; strength. Light from steeply above blackens the lids of eyes that lie deep.
_LIGHTS = (((-0.45, 0.40, 0.80), 0.78), ((0.70, 0.05, 0.60), 0.18))
_IN_CREASES = 0.6  # of the lights' strength, where nothing of the sky is seen
_LEAST_OPEN = 0.6
_IN_MOUTH = ("mouth_interior", "teeth", "gums", "tongue")
_IBUG, _INNER_LIPS = 68, [62, 66]
# Of teeth behind shut lips, which would flicker in the gap, and millimetres between lips that let all light in.
_BEHIND_LIPS, _LIPS_APART = 0.1, 4.0
_EXPOSURE = 1.05  # of skin in these lights
_GAMMA = 2.2  # sRGB, nearly
_DARKER = 0.85  # irises beside the whites of eyes
_SMALLEST = 1.0  # millimetres before the lens
_JUMP = 0.012  # of the nearness; neighbours that differ by more are an edge
_APART = 10.0  # times the nearness, by which parts and tints lie apart where edges are sought


@dataclass(frozen=True, eq=False)
class QuickClay:
    """What of a mesh stays while it moves."""

    faces: Tensor  # triangles that are drawn, (F,3)
    part: Tensor  # which colour each has, (F,)
    openness: Tensor  # how much light creases let in, (V,)
    colors: np.ndarray  # of each part, tint and light, (parts * tints * levels,): four bytes, the last unused, as one
    # The mesh's texture, (H,W,3) in [0,255], and where the triangles' corners lie in it, (F,3,2) pixels, for all but
    # the parts; clay if absent.
    paint: tuple[Tensor, Tensor] | None = None
    # Which vertices lie in the mouth, (V,) bool, and the landmarks in the middle of the lips' inner edges, (2,)
    mouth: tuple[Tensor, Tensor] | None = None

    @staticmethod
    def of(mesh: Mesh, skin: bool = False) -> "QuickClay":
        """A mesh at rest, prepared, its eyes along z; with its texture in place of clay if asked for."""
        faces, drawn = mesh.faces.cpu(), ~clear_triangles(mesh)
        colors, paint = triangle_colors(mesh), _paint(mesh, drawn) if skin else None
        painted = paint is not None
        if paint is not None:
            colors[drawn] = _with_iris(colors[drawn], *paint)
        for name, mask in mesh.regions.items():
            if name in {"upper_lip", "lower_lip"} and not painted:  # a texture shows them
                colors[mask.cpu()[faces].all(1)] = torch.tensor(_LIPS)
        clay = torch.tensor([CLAY])
        part = (colors != clay).any(1).long()
        others, row = colors[part > 0].unique(dim=0, return_inverse=True)
        part[part > 0] += row
        palette = 255 * torch.cat([clay, others]).double().numpy()
        openness = vertex_openness(Mesh(mesh.vertices, mesh.faces[drawn.to(mesh.faces.device)]))
        # A closed mouth at rest would leave its teeth dark when it opens; some are parts without a name.
        loose = components(faces, len(mesh.vertices))
        inside = (part > 0) | (loose != loose[faces.flatten()].mode().values)[faces[:, 0]]
        lit = faces[drawn & inside].unique()
        openness[lit] = openness[lit].clamp(min=_LEAST_OPEN)
        return QuickClay(faces[drawn], part[drawn], openness, _lit_colors(palette), paint, _mouth(mesh))

    def draw(self, vertices: Tensor, camera: Camera, tint: Tensor | None = None) -> np.ndarray:
        """The mesh before a dark ground, (H,W,3) uint8, its vertices marked by a tint (V,) in [0,1]."""
        image = np.full(camera.height * camera.width, _words(np.array(BACKGROUND, np.uint8)))
        size = (camera.height, camera.width, 4)
        points = vertices.double() @ camera.rotation.double().T + camera.translation.double()
        if bool((points[:, 2] < _SMALLEST).any()):
            return _three(image.view(np.uint8).reshape(size))  # before or behind the lens there is no picture of a face
        nearness = 1 / points[:, 2]
        pixels = (points @ camera.intrinsics.double().T)[:, :2] * nearness[:, None]
        drawn = rasterise(pixels, nearness, self.faces, camera.height, camera.width)
        lit = self._light(points.float())
        if self.mouth is not None:
            inside, lips = self.mouth
            apart = float((points[lips[0]] - points[lips[1]]).norm())
            lit[inside] *= min(_BEHIND_LIPS + apart / _LIPS_APART, 1.0)
        light = drawn.interpolated(lit.take(self.faces))
        row = self.part * _TINT_LEVELS
        if tint is not None:
            row = row + (tint[self.faces].mean(1) * (_TINT_LEVELS - 1)).round().clamp(0, _TINT_LEVELS - 1).long()
        row = row.index_select(0, drawn.triangle)
        index = row * _LEVELS + (light * (_LEVELS - 1)).clamp(0, _LEVELS - 1).long()
        colors = self.colors.take(index.numpy())
        if self.paint is not None:
            self._paint_skin(colors, drawn, light, row)
        image[drawn.pixel.numpy()] = colors
        return _smooth_edges(_three(image.view(np.uint8).reshape(size)), drawn, row)

    def _paint_skin(self, colors: np.ndarray, drawn: DrawnPixels, light: Tensor, kind: Tensor) -> None:
        """Overwrites colours (S,) of what is no part with the texture's, with its tint, in the light (S,)."""
        assert self.paint is not None
        texture, corners = self.paint
        mine = kind < _TINT_LEVELS
        column, row = (drawn.interpolated(corners[..., axis])[mine].round().long() for axis in (0, 1))
        height, width = texture.shape[:2]
        texels = texture[row.clamp(0, height - 1), column.clamp(0, width - 1)]
        if bool(kind[mine].any()):
            texels = texels.lerp(texels.new_tensor(_TINT), _TINT_SHARE * kind[mine, None] / (_TINT_LEVELS - 1))
        colors[mine.numpy()] = _words((_EXPOSURE * light[mine, None] * texels).clamp(0, 255).byte().numpy())

    def _light(self, points: Tensor) -> Tensor:
        """What the light on vertices (V,3) in the camera's frame multiplies sRGB colours by, (V,)."""
        normals = vertex_normals(points, self.faces)
        light, reached = _AMBIENT * self.openness, _IN_CREASES + (1 - _IN_CREASES) * self.openness
        for (x, y, z), strength in _LIGHTS:
            toward = torch.nn.functional.normalize(points.new_tensor([x, -y, -z]), dim=0)
            facing = normals @ toward
            light = light + strength * ((facing + 0.15) / 1.15).clamp(min=0) * reached
            half = torch.nn.functional.normalize(toward + points.new_tensor([0.0, 0.0, -1.0]), dim=0)
            light = light + _HIGHLIGHT * strength * (normals @ half).clamp(min=0) ** 24
        return light ** (1 / _GAMMA)


def _mouth(mesh: Mesh) -> tuple[Tensor, Tensor] | None:
    """What lies in a mesh's mouth, and the lips' landmarks before it; see ``QuickClay``."""
    notes = mesh.annotations
    if notes is None or notes.landmarks is None or len(notes.landmarks) != _IBUG:
        return None
    inside = [mask.cpu() for name, mask in notes.regions.items() if name.startswith(_IN_MOUTH)]
    return (torch.stack(inside).any(0), notes.landmarks.cpu()[_INNER_LIPS]) if inside else None


def _paint(mesh: Mesh, drawn: Tensor) -> tuple[Tensor, Tensor] | None:
    """A mesh's texture and where the corners of triangles that are drawn (F,) lie in it; see ``QuickClay``."""
    if mesh.texture is None or mesh.uvs is None or mesh.uv_faces is None:
        return None
    texture = 255 * mesh.texture[:3].permute(1, 2, 0).float().cpu()
    size = torch.tensor([texture.shape[1], texture.shape[0]])
    uvs = mesh.uvs.cpu().float()
    places = torch.stack([uvs[:, 0], 1 - uvs[:, 1]], 1) * size - 0.5
    return texture, places[mesh.uv_faces.cpu()[drawn]]


def _with_iris(colors: Tensor, texture: Tensor, places: Tensor) -> Tensor:
    """Colours (F,3) of triangles with irises as the texture has them, where it has some, at places (F,3,2)."""
    size = torch.tensor([texture.shape[1], texture.shape[0]])
    column, row = places.mean(1).round().long().clamp(torch.zeros_like(size), size - 1).unbind(1)
    own = texture[row, column] / 255
    iris, white = ((colors == torch.tensor(part.color)).all(1) for part in (IRIS, EYEBALL))
    if bool(iris.any() and white.any()) and own[iris].mean() < _DARKER * own[white].mean():
        colors = torch.where(iris[:, None], own[iris].median(0).values, colors)
    return colors


def _lit_colors(palette: np.ndarray) -> np.ndarray:
    """Colours (P,3) under every tint and light, one after the other, uint8."""
    tint = np.linspace(0, _TINT_SHARE, _TINT_LEVELS)[:, None]
    tinted = palette[:, None] * (1 - tint) + np.array(_TINT) * tint
    light = np.linspace(0, 1, _LEVELS)[:, None]
    return _words((tinted[:, :, None] * light).clip(0, 255).round().astype(np.uint8).reshape(-1, 3))


def _words(colors: np.ndarray) -> np.ndarray:
    """Colours (...,3) uint8 as one number each, (...) uint32, that are gathered in a third of the time."""
    padded = np.concatenate([colors, np.zeros_like(colors[..., :1])], -1)
    return padded.view(np.uint32)[..., 0]


def _three(image: np.ndarray) -> np.ndarray:
    """(H,W,4) without the fourth, (H,W,3)."""
    return cv2.cvtColor(image, cv2.COLOR_RGBA2RGB)


def _smooth_edges(image: np.ndarray, drawn: DrawnPixels, kind: Tensor) -> np.ndarray:
    """The image with its outlines, and those of parts and tints, ``kind`` (S,), blurred by a pixel, so that they do not
    crawl."""
    near = np.zeros(image.shape[:2], np.float32)
    most = float(drawn.nearness.amax()) if len(kind) else 0.0
    # As if each kind lay far before the one below.
    near.reshape(-1)[drawn.pixel.numpy()] = (drawn.nearness + _APART * most * kind).numpy()
    edge = cv2.morphologyEx(near, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > _JUMP * most
    return cv2.copyTo(cv2.GaussianBlur(image, (3, 3), 0), edge.view(np.uint8), image)
