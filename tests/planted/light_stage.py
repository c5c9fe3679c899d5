"""A performer recorded in colour under a light of known place: gloss, cast shadows, noise, and the truth beside it."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface import BlendshapeRig, Mesh
from torchface.color_space import to_linear, to_srgb
from torchface.geometry.cameras.pinhole import Camera, look_at
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.rotations import rotation_matrix
from torchface.io.video import VideoFile, write_video
from torchface.progress import Progress, silent
from torchface.rendering.clay_shading import sample_texture
from torchface.rendering.point_light import PointLight
from torchface.rendering.raycast import RayCaster

_OFF_THE_SKIN = 0.3
_WALL = (0.16, 0.18, 0.20)  # linear


@dataclass(frozen=True)
class LightStageSettings:
    """How the performer is recorded."""

    # width, height: pixels
    width: int = 320
    height: int = 240
    field_of_view: float = 24.0  # vertical, degrees
    span: float = 330.0  # millimetres that the image's height covers at the face
    turn: float = 22.0  # how far the head turns to each side, degrees; half as far up and down
    gloss: float = 0.15  # strength of highlights beside the light's; skin has about 0.15
    shininess: float = 24.0  # exponent of the highlights
    samples: int = 2  # rays a pixel side
    noise: float = 0.01  # of the camera, standard deviation at full white, linear; shot noise, less where it is dark


@dataclass(frozen=True, eq=False)
class LitVideo:
    """A colour video of a performer, and the truth behind it."""

    video: VideoFile  # the file
    rig: BlendshapeRig  # the performer, with skin
    weights: Tensor  # (T,N)
    # world to camera, one a frame: the camera stands still, so the head's motion is in here
    cameras: tuple[Camera, ...]
    light: PointLight  # in the camera's frame

    @property
    def vertices(self) -> Tensor:
        """The mesh of every frame, (T,V,3)."""
        return self.rig(self.weights)


def render_lit_video(
    path: str | Path,
    rig: BlendshapeRig,
    weights: Tensor,
    light: PointLight,
    fps: float,
    generator: torch.Generator,
    settings: LightStageSettings = LightStageSettings(),
    progress: Progress | None = None,
) -> LitVideo:
    """Records a performance in colour; the head turns slowly from side to side.

    Args:
        path: of the video; ``.avi`` and ``.mkv`` are lossless.
        rig: a performer with skin.
        weights: (T,N).
        light: the point light and the ambient light, in the camera's frame.
        fps: frames a second.
        generator: of motion and noise.
        settings: how.
        progress: called with each step and how far it is.
    """
    progress = progress or silent
    cameras = turning_cameras(rig, len(weights), fps, generator, settings)

    def images() -> Iterator[Tensor]:
        for t, camera in enumerate(cameras):  # an image at a time: each has a surface of its own
            mesh = rig.neutral.with_vertices(rig(weights[t : t + 1])[0])
            linear = lit_image(mesh, camera, light, settings)
            noise = settings.noise * linear.sqrt() * torch.randn(linear.shape, generator=generator)
            yield (to_srgb((linear + noise).clamp(0, 1)) * 255).round().to(torch.uint8)[None]
            progress("rendering the video", t + 1, len(cameras))

    return LitVideo(write_video(images(), path, fps), rig, weights, cameras, light)


def turning_cameras(
    rig: BlendshapeRig, frames: int, fps: float, generator: torch.Generator, settings: LightStageSettings
) -> tuple[Camera, ...]:
    """Cameras before a head that turns and nods: one that stands still, told in the head's own frame."""
    middle = rig.vertices[rig.neutral.landmarks].double().mean(0)
    still = look_at(middle, 0.0, 0.0, settings.span, settings.width, settings.height, settings.field_of_view)
    seconds = torch.arange(frames, dtype=torch.float64) / fps
    phase = 2 * math.pi * torch.rand(4, generator=generator, dtype=torch.float64)
    rates = torch.tensor([0.31, 0.23, 0.17, 0.13], dtype=torch.float64)
    wave = torch.sin(2 * math.pi * rates * seconds[:, None] + phase)
    reach = math.radians(settings.turn) * torch.tensor([0.5, 1.0, 0.25], dtype=torch.float64)
    pivot = middle + torch.tensor([0.0, -50.0, -90.0], dtype=torch.float64)
    cameras = []
    for t in range(frames):  # each frame its own camera
        turned = rotation_matrix(wave[t, :3] * reach)
        shift = torch.stack([12 * wave[t, 3], 6 * wave[t, 1], 20 * wave[t, 2]])
        rotation = still.rotation @ turned
        cameras.append(
            replace(
                still,
                rotation=rotation,
                translation=still.translation + still.rotation @ (pivot + shift - turned @ pivot),
            )
        )
    return tuple(cameras)


def lit_image(mesh: Mesh, camera: Camera, light: PointLight, settings: LightStageSettings) -> Tensor:
    """What the camera sees of a mesh with skin, linear light, (3,H,W): Lambert, Blinn's gloss, cast shadows."""
    assert mesh.texture is not None
    assert mesh.uvs is not None
    assert mesh.uv_faces is not None
    vertices = mesh.vertices.double()
    caster = RayCaster(vertices, mesh.faces)
    origins, ways = camera.rays(settings.samples)
    shape = ways.shape[:2]
    origins, ways = origins.reshape(-1, 3), ways.reshape(-1, 3)
    hits = caster.cast(origins, ways)
    seen = hits.triangle >= 0
    triangle, barycentric = hits.triangle[seen], hits.barycentric[seen].double()
    point = origins[seen] + hits.distance[seen, None] * ways[seen]
    corner_normals = vertex_normals(vertices, mesh.faces)[mesh.faces[triangle]]
    normal = torch.nn.functional.normalize((corner_normals * barycentric[..., None]).sum(1), dim=-1)
    uv = (mesh.uvs[mesh.uv_faces[triangle]] * barycentric[..., None].float()).sum(1)
    albedo = to_linear(sample_texture(mesh.texture, uv)).double()
    lamp = camera.rotation.double().T @ (light.position.double() - camera.translation.double())  # in the world
    toward = torch.nn.functional.normalize(lamp - point, dim=-1)
    cosine = (normal * toward).sum(-1)
    shadow = caster.occluded(point + _OFF_THE_SKIN * (normal + toward), toward)
    falling = cosine.clamp(min=0) * ~shadow
    half = torch.nn.functional.normalize(toward - ways[seen], dim=-1)
    gloss = settings.gloss * (normal * half).sum(-1).clamp(min=0) ** settings.shininess * (falling > 0)
    ambient, intensity = light.ambient.double(), light.intensity.double()
    image = torch.tensor(_WALL, dtype=torch.float64).expand(len(ways), 3).clone()
    image[seen] = albedo * (ambient + intensity * falling[:, None]) + intensity * gloss[:, None]
    rows = image.view(shape[0] // settings.samples, settings.samples, -1, settings.samples, 3)
    return rows.mean((1, 3)).permute(2, 0, 1).float()
