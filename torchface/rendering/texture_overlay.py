"""A painted texture on a recorded face in the light of the video, and a recorded face under another light."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.color_space import to_linear, to_srgb
from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.pinhole import Camera
from torchface.mesh import Mesh
from torchface.rendering.environment_light import EnvironmentLight
from torchface.rendering.gaussian_blur import gaussian_blur
from torchface.rendering.pixel_coverage import Footprint, footprint
from torchface.rendering.point_light import PointLight, lit_by

_NOT_SKIN = (
    "eyeball", "eye_socket", "eye_blend", "eye_occlusion", "eyelash", "lacrimal", "mouth_interior", "mouth_socket",
    "gums", "teeth", "tongue", "nostrils",
)  # fmt: skip
_MAX_GAIN = 10.0
_FLOOR = 1e-3  # linear; light that lenses scatter, so that black has a quotient
_BESIDE = 0.025  # of the root of the pixels that a head covers, standard deviation of a blur
_FAINT = 0.05  # of a blurred cover, where light beyond the head ends
_SOURCE = 20.0  # degrees, from the middle to the rim of a light source such as a window
_WIDTH = 0.87 * math.sin(math.radians(_SOURCE))  # of a bar of light that falls off as the disc does, half of it
_PLACES = 4  # by as many of them on the source's disc, each seen from one pixel of a square
_RIM = 0.75  # cosine between the normals of a point and of those beside it, on the rims of lids and lips
_MAX_SIDE = 8192


def skin_faces(mesh: Mesh) -> Tensor:
    """Triangles that are skin, (F,) bool: all but those that touch eyeballs, sockets, teeth or the inside of the mouth.

    By the names of the annotated regions; a mesh without is skin all over.
    """
    skin = torch.ones(len(mesh.vertices), dtype=torch.bool)
    for name, mask in mesh.regions.items():
        if name.startswith(_NOT_SKIN):
            skin &= ~mask.cpu()
    return skin[mesh.faces.cpu()].all(1)


@dataclass(frozen=True, eq=False)
class FacePaint:
    """Paint for the skin of a mesh, prepared once for many frames."""

    mesh: Mesh  # topology, texture coordinates and regions; where its vertices are does not matter
    # The paint, linear, colour times alpha and alpha, (4,h,w), each half as large as the one before.
    levels: tuple[Tensor, ...]
    skin: Tensor  # triangles that take paint, (F,)

    @staticmethod
    def of(mesh: Mesh, texture: Tensor) -> "FacePaint":
        """Paint of an image in the mesh's texture coordinates.

        Args:
            texture: red, green, blue (sRGB) and alpha, (4,h,w), uint8 or in [0,1], first row on top; alpha 0 leaves
                the video as it is.
        """
        if mesh.uvs is None or mesh.uv_faces is None:
            raise TopologyError("overlay: found a mesh without texture coordinates, expected some to paint by")
        if texture.ndim != 3 or texture.shape[0] != 4 or not 1 <= min(texture.shape) <= max(texture.shape) <= _MAX_SIDE:
            raise ShapeError(
                f"texture: found {tuple(texture.shape)}, expected (4,h,w), red, green, blue and alpha, at most "
                f"{_MAX_SIDE} a side"
            )
        values = texture.detach().cpu()
        values = values.float() / 255 if values.dtype == torch.uint8 else values.float()
        if not bool(((values >= 0) & (values <= 1)).all()):
            raise ValueRangeError("texture: found values outside of [0,1] or NaN, expected colours and alpha in [0,1]")
        levels = [torch.cat([to_linear(values[:3]) * values[3:], values[3:]])]
        while min(levels[-1].shape[1:]) > 4:
            levels.append(torch.nn.functional.avg_pool2d(levels[-1][None], 2, ceil_mode=True)[0])
        return FacePaint(mesh, tuple(levels), skin_faces(mesh))

    def at(self, covered: Footprint, coarseness: float) -> Tensor:
        """The paint at samples, (S,4), where a pixel is ``coarseness`` texels wide."""
        assert self.mesh.uvs is not None
        assert self.mesh.uv_faces is not None
        uv = covered.of_vertices(self.mesh.uvs.cpu().double(), self.mesh.uv_faces.cpu()).float()
        grid = torch.stack([uv[:, 0] * 2 - 1, 1 - uv[:, 1] * 2], dim=-1)[None, None]
        level = min(max(math.log2(max(coarseness, 1e-6)), 0.0), len(self.levels) - 1.0)
        below = min(int(level), len(self.levels) - 1)
        result = _read(self.levels[below], grid)
        if below + 1 < len(self.levels) and level > below:
            result = torch.lerp(result, _read(self.levels[below + 1], grid), level - below)
        return result


def overlay(
    frame: Tensor,
    vertices: Tensor,
    paint: FacePaint,
    light: PointLight | EnvironmentLight,
    camera: Camera,
    calibration: CameraCalibration | None = None,
    share: Tensor | None = None,
) -> Tensor:
    r"""A frame with paint on the face, lit as the face is.

    .. math:: C = (1 - \alpha)\, C_{frame} + \alpha\, g\text{-coded}\; T (I_a + I_p \max(0, N \cdot L)\, s)

    mixed in linear light. What the mesh itself hides stays unpainted, eyeballs and the inside of the mouth too; hair,
    hands and glasses in front of the face are not known and are painted over. Edges are antialiased.

    Args:
        frame: (3,H,W) sRGB, uint8 or in [0,1].
        vertices: of the face in it, (V,3), millimetres.
        paint: see :meth:`FacePaint.of`.
        light: as ``estimate_light`` finds it; its strengths belong to an albedo that the paint replaces.
        calibration: of a lens that bends the frame; paint is bent with it.
        share: how far each vertex is painted, (V,) in [0,1]; all of it if absent.

    Returns:
        A frame of the same kind; the same where the face lies outside.

    Source: thesis 4.2.11 and figure 80.
    """
    image = _checked(frame, vertices, paint.mesh, camera)
    covered = footprint(vertices, paint.mesh.faces.cpu(), paint.skin, camera, calibration)
    if len(covered.pixel) == 0:
        return frame
    colors = paint.at(covered, _coarseness(covered, paint))
    if share is not None:
        colors = colors * covered.of_vertices(share.double()[:, None], paint.mesh.faces.cpu()).float()
    painted = (colors[:, 3] > 1e-4).nonzero()[:, 0]
    if len(painted) == 0:
        return frame
    covered, colors = covered.select(painted), colors[painted]
    shade = _light_on(covered, light)
    mixed = covered.blended(to_linear(image), colors[:, :3] * shade, colors[:, 3])
    return _as(frame, image, mixed, covered.pixel)


def relight(
    frame: Tensor,
    mesh: Mesh,
    light: PointLight,
    new_light: PointLight | EnvironmentLight,
    camera: Camera,
    calibration: CameraCalibration | None = None,
    share: Tensor | None = None,
    beyond: bool = False,
) -> Tensor:
    r"""A frame with the face under another light: each pixel times the quotient of new and old light there.

    .. math:: C' = C\; \frac{I'_a + I'_p \max(0, N \cdot L')\, s'}{I_a + I_p \max(0, N \cdot L)\, s}

    in linear light, so that pores, beard and colour stay; no albedo is needed. At most ten times as bright: noise of
    black shadows is no skin. Highlights of the old source stay where they were.

    Args:
        frame: (3,H,W) sRGB, uint8 or in [0,1].
        mesh: of the face as it stands in it, millimetres.
        light: of the frame, as ``estimate_light`` finds it.
        calibration: of a lens that bends the frame.
        share: how far each vertex is relit, (V,) in [0,1]; fade it out where hair or collar begins. All of it if
            absent.
        beyond: relight what lies beside the outline too, as what is within: a filmed face never ends exactly where
            its mesh does. Mask what is no skin afterwards.

    Source: thesis 4.2.11 and figure 80.
    """
    image = _checked(frame, mesh.vertices, mesh, camera)
    if share is not None and share.shape != (len(mesh.vertices),):
        raise ShapeError(f"share: found {tuple(share.shape)}, expected ({len(mesh.vertices)},)")
    faces = mesh.faces.cpu()
    covered = footprint(mesh.vertices, faces, torch.ones(len(faces), dtype=torch.bool), camera, calibration)
    if len(covered.pixel) == 0:
        return frame
    linear, sigma = to_linear(image), _beside(covered)
    old, lit = linear.reshape(3, -1).T[covered.pixel], _soft_shadow(covered, light)
    shaded, lights = old + _FLOOR, (lit, torch.zeros_like(lit), torch.ones_like(lit))
    on_skin, most, least = (shaded / (_light_on(covered, light, seen) + _FLOOR) for seen in lights)
    # Where the old shadow ends, a pixel's lag between mesh and face would draw a line: the skin beside it goes there,
    # as far as a shadow can tell.
    seen_of = _unhidden(covered, light, lit).float()
    clear = (1 - 4 * seen_of * (1 - seen_of)).clamp(min=0) ** 2
    reflected = torch.lerp(covered.softened(on_skin, clear + 1e-3, sigma), on_skin, clear[:, None])
    new = (reflected.clamp(least, most) * (_light_on(covered, new_light) + _FLOOR) - _FLOOR).clamp(min=0)
    gain = ((new + _FLOOR) / (old + _FLOOR)).clamp(max=_MAX_GAIN)
    if share is not None:
        kept = covered.of_vertices(share.double()[:, None], faces).float()
        gain = torch.lerp(torch.ones_like(gain), gain, covered.softened(kept, sigma=sigma))
    drawn = torch.zeros(linear[0].numel(), 4)
    weight = covered.share.float()[:, None]
    drawn.index_add_(0, covered.pixel, weight * torch.cat([gain, torch.ones_like(gain[:, :1])], 1))
    reach, spread = drawn[:, 3:], torch.ones(1)
    if beyond:
        near = gaussian_blur(drawn.T.reshape(1, 4, *linear.shape[1:]), sigma)[0].flatten(1).T
        reach = (near[:, 3:] / _FAINT).clamp(max=1)
        spread = torch.lerp(torch.ones(1), near[:, :3] / near[:, 3:].clamp(min=1e-6), reach)
    result = linear.reshape(3, -1) * (drawn[:, :3] + (1 - drawn[:, 3:]) * spread).T
    return _as(frame, image, result, reach[:, 0].nonzero()[:, 0])


def _beside(covered: Footprint) -> float:
    """The standard deviation of a blur over the neighbourhood of a face's point, pixels."""
    return max(1.0, _BESIDE * math.sqrt(float(covered.share.sum())))


def _soft_shadow(covered: Footprint, light: PointLight) -> Tensor:
    """The share of the source that samples see, (S,), where the source is a disc and so has soft shadows.

    Each pixel of a square looks at another place on the disc, and a blur takes their mean. Lines of shadow, as between
    lips, are none: those of the film lie elsewhere.
    """
    count = _PLACES * _PLACES
    turn = torch.arange(count).double() * math.pi * (3 - math.sqrt(5))
    disc = (torch.arange(count) + 0.5).div(count).sqrt().double() * math.tan(math.radians(_SOURCE))
    middle = covered.points.mean(0)
    toward = light.position.double() - middle
    _, _, across = torch.linalg.svd(toward[None])  # rows: the direction, and two across it
    disc = (disc * turn.cos())[:, None] * across[1] + (disc * turn.sin())[:, None] * across[2]
    place = covered.pixel % covered.width % _PLACES + covered.pixel // covered.width % _PLACES * _PLACES
    positions = light.position.double() + toward.norm() * disc[place]
    lit = lit_by(positions, covered.caster, covered.points, covered.normals)
    wide = covered.softened(lit[:, None], sigma=max(_PLACES / 2, 0.5 * _beside(covered)))[:, 0]
    return (1.5 * wide - 0.25).clamp(0, 1)


def _light_on(covered: Footprint, light: PointLight | EnvironmentLight, lit: Tensor | None = None) -> Tensor:
    """Red, green and blue light at the samples, (S,3); ``lit`` is the share of the source that each sees, if known.

    The rims of lids and lips would shine, or be black, and never lie where the filmed ones do: they have the light of
    the skin beside them.
    """
    sigma = _beside(covered)
    if isinstance(light, EnvironmentLight):
        found = covered.softened(light.irradiance(covered.normals).float(), sigma=sigma)  # it knows no shadows
    else:
        lit = _soft_shadow(covered, light) if lit is None else lit
        falling = _falling(covered, light, lit.double())[:, None]
        found = (light.ambient.double() + light.intensity.double() * falling).float()
    mean = torch.nn.functional.normalize(covered.softened(covered.normals, sigma=sigma), dim=1)
    smooth = (((mean * covered.normals.float()).sum(1) - _RIM) / (1 - _RIM)).clamp(1e-3, 0.5) * 2
    return torch.lerp(covered.softened(found, smooth, sigma), found, smooth[:, None])


def _over_horizon(covered: Footprint, light: PointLight) -> tuple[Tensor, Tensor, Tensor]:
    """Cosines to the middle of a source that is a disc, half of its width in cosines, its share over the horizon."""
    cosine = (covered.normals * light.toward(covered.points)).sum(-1)
    half = (_WIDTH * (1 - cosine.square()).clamp(min=1e-6).sqrt()).clamp(min=1e-3)
    return cosine, half, ((cosine + half) / (2 * half)).clamp(0, 1)


def _unhidden(covered: Footprint, light: PointLight, lit: Tensor) -> Tensor:
    """The share of what is over the horizon that nothing hides, (S,), of the share ``lit`` of the whole source."""
    above = _over_horizon(covered, light)[2]
    return torch.where(above < 0.02, torch.ones_like(above), lit / above.clamp(min=0.02)).clamp(max=1)


def _falling(covered: Footprint, light: PointLight, lit: Tensor) -> Tensor:
    r"""What of a source that is a disc falls on samples, (S,), of which they see a share ``lit``.

    .. math:: \frac{1}{2w} \int_{-w}^{w} \max(0, N \cdot L + t)\, dt

    Where the middle of the disc sets, half of it still shines, unless something else hides it.
    """
    cosine, half, above = _over_horizon(covered, light)
    return torch.where(cosine < half, above.square() * half, cosine) * _unhidden(covered, light, lit)


def _coarseness(covered: Footprint, paint: FacePaint) -> float:
    """Texels that a pixel covers side by side, the median over the face; one for the whole face, so no seam shows."""
    mesh, rows = paint.mesh, covered.triangle.unique()
    assert mesh.uvs is not None
    assert mesh.uv_faces is not None
    height, width = paint.levels[0].shape[1:]
    a, b, c = (mesh.uvs.cpu().double()[mesh.uv_faces.cpu()[rows, k]] * torch.tensor([width, height]) for k in range(3))
    texels = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).abs().sum() / 2
    pixels = float(covered.share.sum())
    return math.sqrt(float(texels) / max(pixels, 1.0))


def _read(texture: Tensor, grid: Tensor) -> Tensor:
    sampled = torch.nn.functional.grid_sample(
        texture[None], grid, mode="bilinear", padding_mode="border", align_corners=False
    )
    return sampled[0, :, 0].T


def _checked(frame: Tensor, vertices: Tensor, mesh: Mesh, camera: Camera) -> Tensor:
    """The frame as floats in [0,1], on the CPU."""
    if frame.shape != (3, camera.height, camera.width):
        raise ShapeError(f"frame: found {tuple(frame.shape)}, expected the camera's (3,{camera.height},{camera.width})")
    if vertices.shape != mesh.vertices.shape:
        raise ShapeError(f"vertices: found {tuple(vertices.shape)}, expected the mesh's {tuple(mesh.vertices.shape)}")
    if not bool(torch.isfinite(vertices).all()):
        raise ValueRangeError("vertices: found NaN or infinity, expected a face")
    return frame.detach().cpu().float() / 255 if frame.dtype == torch.uint8 else frame.detach().cpu().float()


def _as(frame: Tensor, image: Tensor, linear: Tensor, pixel: Tensor) -> Tensor:
    """The image with the pixels changed that were painted, in the frame's kind; the others stay exactly."""
    touched = pixel.unique()
    result = image.reshape(3, -1).clone()
    result[:, touched] = to_srgb(linear.reshape(3, -1)[:, touched].clamp(0, 1))
    result = result.view(image.shape)
    if frame.dtype == torch.uint8:
        return (result * 255).round().to(torch.uint8)
    return result.to(frame)
