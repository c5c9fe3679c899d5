"""Raw scans of a synthetic head, as a hand-held scanner makes them: another topology, noise, holes, hair, collar."""

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ValueRangeError
from torchface.geometry.cameras.pinhole import Camera, look_at
from torchface.geometry.meshes.operators import components, corners, triangle_normals, vertex_normals
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.rotations import quaternion_matrix
from torchface.landmarks.scans.contours import evenly_spaced
from torchface.landmarks.scans.landmark_pairs import template_features
from torchface.landmarks.scans.scan_annotations import ScanAnnotation
from torchface.landmarks.scans.uv_landmark_names import LINES, UV_LANDMARK_NAMES, uv_landmarks_from_ibug
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import Lighting, render
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig
from torchface.synthetic.stages.depth_fusion import DepthNoise, fuse
from torchface.synthetic.stages.subdivision import finely_coloured

_WAVES = 14
_HAIRLINE = 62.0  # millimetres above the eyes, on the forehead
_HAIR_COLOR, _COLLAR_COLOR = (0.12, 0.09, 0.07), (0.75, 0.78, 0.80)


@dataclass(frozen=True)
class Dress:
    """How much hair and collar there is."""

    hair: float = 9.0  # thickness of the lumps, millimetres; 0 is a shaved head
    collar: float = 10.0  # thickness of the collar's lumps, millimetres; 0 is none


_DISTANCE = 520.0
_VIEWS = tuple((yaw, pitch) for pitch in (-14.0, 22.0) for yaw in (-100.0, -65.0, -32.0, 0.0, 32.0, 65.0, 100.0))
_LINE_POINTS = 60
_HOLES, _HOLE_RADIUS = 5, 5.0  # how many are torn, and their radii at most, millimetres
_CRUMBS = 4  # loose bits floating about
_BELOW_CHIN, _BEHIND_EARS = 75.0, 60.0  # millimetres: where the scan is cut off, roughly; the cut is ragged
_TONE = 1.15  # by which factor one standard deviation brightens the skin from scan to scan
_YAWS = (0.0, -55.0, 55.0)
_FLASH = Lighting(lights=(((0.3, 0.3, 0.9), 0.35), ((-0.4, 0.1, 0.8), 0.2)), ambient=0.5, occlusion_rays=0, gloss=0.03)


@dataclass(frozen=True)
class Photography:
    """How images are taken: ``height`` pixels that cover ``span`` millimetres."""

    height: int = 900
    span: float = 330.0


@dataclass(frozen=True)
class ScannerSettings:
    """What the scanner does to a head; lengths in millimetres.

    Args:
        voxel: resolution of the fused surface; a scan has about 120,000 / voxel² vertices.
        detail: the head is subdivided until its edges are about this long.
        noise: of depth.
        dress: hair and collar.
        photography: of the texture; None makes a scan without one.

    Example:
        >>> ScannerSettings(voxel=3.0, photography=None).detail
        1.2
    """

    voxel: float = 1.4
    detail: float = 1.2
    noise: DepthNoise = field(default_factory=DepthNoise)
    dress: Dress = field(default_factory=Dress)
    photography: Photography | None = field(default_factory=Photography)


@dataclass(frozen=True, eq=False)
class RawScan:
    """A scan and the truth about it, all in the scan's space.

    Args:
        mesh: in millimetres, with a texture if one was taken.
        ibug: the 68 landmarks, (68,3).
        annotation: the twelve landmarks and the lip and lid lines.
        rotation, translation: from the head's space to the scan's, (3,3) and (3,).
    """

    mesh: Mesh
    ibug: Tensor
    annotation: ScanAnnotation
    rotation: Tensor
    translation: Tensor


def eyes_closed(rig: BlendshapeRig) -> Mesh:
    """A performer as it sits before the scanner: neutral, both eyes shut.

    Raises:
        NameMismatchError: the rig has no ``eyeBlinkLeft`` or ``eyeBlinkRight``.

    Example:
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> lowered = (rig.vertices - eyes_closed(rig).vertices)[:, 1]
        >>> lowered.max().item() > 5  # millimetres that an upper lid falls
        True
    """
    blinks = ("eyeBlinkLeft", "eyeBlinkRight")
    missing = [name for name in blinks if name not in rig.names]
    if missing:
        raise NameMismatchError(f"rig: found no shape {missing[0]!r}, expected ARKit's names")
    weights = rig.vertices.new_zeros(1, len(rig.names))
    weights[0, [rig.names.index(name) for name in blinks]] = 1.0
    return rig.neutral.with_vertices(rig(weights)[0])


def scan_head(head: Mesh, seed: int, settings: ScannerSettings | None = None) -> RawScan:
    """Scans a head.

    Args:
        head: in the head's space (y up, z forward, millimetres), eyes closed, mouth shut, with 68 annotated landmarks
            and contact pairs; with colours or a texture if the scan shall have one.
        seed: of everything random.
        settings: what the scanner does.

    Raises:
        ValueRangeError: the head lacks landmarks or contacts.
    """
    settings = settings or ScannerSettings()
    generator = torch.Generator().manual_seed(seed)
    smooth = finely_coloured(head, settings.detail)
    head = head.with_vertices(smooth.vertices[: len(head.vertices)])
    landmarks = head.vertices[head.landmarks].double()
    annotation = _truth(head, landmarks)
    tone = _TONE ** float(torch.randn(1, generator=generator))
    smooth = replace(smooth, colors=None if smooth.colors is None else (smooth.colors * tone).clamp(0, 1))
    subject = dressed(smooth, landmarks, settings.dress, generator)
    centre = landmarks[[36, 45, 48, 54]].mean(0)
    fused = Mesh(*fuse(subject, _eyes(centre), settings.voxel, settings.noise, generator))
    fused = _torn(fused, landmarks, generator)
    if settings.photography is not None:
        fused = _photographed(fused, subject, centre, settings.photography)
    rotation, translation = _pose(generator)

    def moved(points: Tensor) -> Tensor:
        return (points.double() - centre) @ rotation.T + translation

    mesh = Mesh(moved(fused.vertices).float(), fused.faces, fused.uvs, fused.uv_faces, texture=fused.texture)
    truth = ScanAnnotation(
        {name: moved(point) for name, point in annotation.points.items()},
        {name: moved(line) for name, line in annotation.lines.items()},
    )
    return RawScan(mesh, moved(landmarks), truth, rotation, translation - rotation @ centre)


def _photographed(scan: Mesh, subject: Mesh, centre: Tensor, photography: Photography) -> Mesh:
    """A fused scan with a texture and texture coordinates, of what stood before the cameras."""
    width = round(photography.height * 0.8)
    cameras = [look_at(centre, yaw, 0.0, photography.span, width, photography.height) for yaw in _YAWS]
    texture = torch.cat([render(subject, camera, lighting=_FLASH, samples=1) for camera in cameras], dim=2)
    best = _best_view(scan, cameras)
    pixels = torch.stack([camera.project(scan.vertices.double()) for camera in cameras])
    wide = texture.shape[2]
    u = (pixels[..., 0].clamp(0, width - 1) + 0.5 + width * torch.arange(len(cameras))[:, None]) / wide
    v = 1 - (pixels[..., 1].clamp(0, photography.height - 1) + 0.5) / photography.height
    uvs = torch.stack([u, v], dim=-1).float()
    rows = scan.faces + best[:, None] * len(scan.vertices)
    used, uv_faces = rows.unique(return_inverse=True)
    return replace(scan, texture=texture, uvs=uvs.view(-1, 2)[used], uv_faces=uv_faces)


def _best_view(scan: Mesh, cameras: list[Camera]) -> Tensor:
    """The camera (F,) that sees a triangle most frontally, one whose view is free before one whose view is not."""
    middle = torch.stack(corners(scan.vertices.double(), scan.faces)).mean(0)
    normals = triangle_normals(scan.vertices.double(), scan.faces)
    caster = RayCaster(scan.vertices, scan.faces)
    scores = []
    for camera in cameras:
        toward = torch.nn.functional.normalize(camera.centre.double() - middle, dim=-1)
        hidden = caster.occluded(middle + 0.5 * normals + 0.5 * toward, toward)
        scores.append((normals * toward).sum(-1) - 2.0 * hidden)
    return torch.stack(scores).argmax(0)


def _truth(head: Mesh, landmarks: Tensor) -> ScanAnnotation:
    """Twelve landmarks, cheeks moved onto the surface, and the lines where lids and lips meet."""
    twelve = uv_landmarks_from_ibug(landmarks)
    on_surface = SurfaceIndex(head.vertices, head.faces).nearest(twelve).points
    points = dict(zip(UV_LANDMARK_NAMES, on_surface, strict=True))
    features = template_features(head)
    lines = {}
    for name, (left, right) in LINES.items():
        if name not in features.lines:
            raise ValueRangeError(f"head: found no contact pairs along the {name}, expected lids and lips that touch")
        pairs = features.lines[name][0].view(-1, 2)
        middle = head.vertices[pairs].double().mean(1)
        path = torch.cat([points[left][None], middle, points[right][None]])
        lines[name] = evenly_spaced(path, _LINE_POINTS)
    return ScanAnnotation(points, lines)


def _eyes(centre: Tensor) -> Tensor:
    """Where the scanner stops on its way round the head, (E,3)."""
    yaw, pitch = torch.deg2rad(torch.tensor(_VIEWS, dtype=torch.float64)).unbind(1)
    way = torch.stack([yaw.sin() * pitch.cos(), pitch.sin(), yaw.cos() * pitch.cos()], dim=-1)
    return centre + torch.tensor([0.0, 0.0, -70.0], dtype=torch.float64) + _DISTANCE * way


def _torn(mesh: Mesh, landmarks: Tensor, generator: torch.Generator) -> Mesh:
    """Cut off raggedly at the neck and behind the ears, with holes, without most crumbs."""
    middle = torch.stack(corners(mesh.vertices, mesh.faces)).mean(0)
    ragged = _ragged(middle, generator)
    keep = middle[:, 1] > landmarks[8, 1] - _BELOW_CHIN + ragged
    keep &= middle[:, 2] > landmarks[[0, 16], 2].mean() - _BEHIND_EARS + ragged
    inside = middle[keep]
    for _ in range(_HOLES):
        at = inside[int(torch.randint(len(inside), (1,), generator=generator))]
        radius = _HOLE_RADIUS * float(torch.rand(1, generator=generator)) ** 0.5
        keep &= (middle - at).norm(dim=-1) > radius * (1 + 0.3 * ragged / 6.0)
    faces = mesh.faces[keep]
    part = components(faces, len(mesh.vertices))[faces[:, 0]]
    order = part.bincount().argsort(descending=True)[: 1 + _CRUMBS]
    faces = faces[torch.isin(part, order)]
    used, faces = faces.unique(return_inverse=True)
    return Mesh(mesh.vertices[used], faces)


def _ragged(points: Tensor, generator: torch.Generator) -> Tensor:
    """Some millimetres more or less from place to place, (N,)."""
    heading = torch.randn(6, 3, generator=generator, dtype=torch.float64) * 0.25
    phase = torch.rand(6, generator=generator, dtype=torch.float64) * 2 * math.pi
    return 2.0 * (points @ heading.T + phase).sin().sum(1)


def _pose(generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A random rotation (3,3) and translation (3,)."""
    w, *rest = torch.nn.functional.normalize(torch.randn(4, generator=generator, dtype=torch.float64), dim=0)
    rotation = quaternion_matrix(torch.stack([*rest, w]))
    return rotation, 60.0 * torch.randn(3, generator=generator, dtype=torch.float64)


def dressed(head: Mesh, landmarks: Tensor, dress: Dress, generator: torch.Generator) -> Mesh:
    """A head with colours, fine enough to carry lumps, in its own space (y up, z forward), with hair and collar."""
    vertices = head.vertices.double()
    colors = torch.full_like(vertices, 0.7) if head.colors is None else head.colors.double()
    eyes, chin, ears = landmarks[36:48].mean(0), landmarks[8], landmarks[[0, 16]].mean(0)
    share = _hair_share(vertices, eyes, ears)
    lumps = _lumps(vertices, generator, 22.0, 70.0)
    thickness = dress.hair * share * (1.0 + 0.45 * lumps)
    vertices = vertices + thickness[:, None] * vertex_normals(vertices, head.faces)
    colors = torch.lerp(colors, torch.tensor(_HAIR_COLOR, dtype=torch.float64), share[:, None] ** 0.5)
    faces = head.faces
    if dress.collar > 0:
        ring, ring_faces = _collar(vertices, ears, chin, dress.collar, generator)
        faces = torch.cat([faces, ring_faces + len(vertices)])
        vertices = torch.cat([vertices, ring])
        colors = torch.cat([colors, torch.tensor(_COLLAR_COLOR, dtype=torch.float64).expand(len(ring), 3)])
    return Mesh(vertices.float(), faces, colors=colors.clamp(0, 1).float())


def _hair_share(vertices: Tensor, eyes: Tensor, ears: Tensor) -> Tensor:
    """0 on the face, 1 on the scalp, (V,); the line falls from forehead to behind the ears."""
    depth = ((eyes[2] - vertices[:, 2]) / (eyes[2] - ears[2]).clamp(min=20)).clamp(-1, 2)
    # On the forehead the line lies far above the eyes, at the ears a little above them, behind them far below.
    line = eyes[1] + _HAIRLINE - 45.0 * depth.clamp(min=0) - 75.0 * (depth - 1.15).clamp(min=0) / 0.5
    return ((vertices[:, 1] - line) / 9.0).clamp(0, 1) * (vertices[:, 1] > ears[1] - 90)


def _lumps(points: Tensor, generator: torch.Generator, shortest: float, longest: float) -> Tensor:
    """A smooth random field of about unit size, (N,)."""
    heading = torch.nn.functional.normalize(torch.randn(_WAVES, 3, generator=generator, dtype=torch.float64), dim=-1)
    draw = torch.rand(_WAVES, 2, generator=generator, dtype=torch.float64)
    length = shortest * (longest / shortest) ** draw[:, 0]
    phase = points @ (heading * (2 * math.pi / length)[:, None]).T + 2 * math.pi * draw[:, 1]
    return phase.sin().sum(1) * math.sqrt(2 / _WAVES)


def _collar(
    vertices: Tensor, ears: Tensor, chin: Tensor, thickness: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """A crumpled band round the neck, open in front, (N,3) and its faces."""
    top = chin[1] - 48.0
    neck = vertices[(vertices[:, 1] - top).abs() < 12]
    centre = neck[:, [0, 2]].mean(0) if len(neck) else torch.stack([ears[0], ears[2]])
    reach = (neck[:, [0, 2]] - centre).norm(dim=1).quantile(0.9) if len(neck) else torch.tensor(60.0)
    rows, columns = 12, 120
    angle = torch.linspace(0.35, 2 * math.pi - 0.35, columns, dtype=torch.float64)  # 0 is in front
    down = torch.linspace(0, 1, rows, dtype=torch.float64)
    radius = reach + 6.0 + 22.0 * down[:, None] ** 1.5
    x, z = centre[0] + radius * angle.sin(), centre[1] + radius * angle.cos()
    y = top - 30.0 * down[:, None] + 14.0 * (1 - angle.cos()) / 2
    ring = torch.stack([x, y.expand(rows, columns), z], dim=-1).view(-1, 3)
    ring = ring + (0.3 * thickness * _lumps(ring, generator, 12.0, 50.0))[:, None] * torch.nn.functional.normalize(
        ring - torch.stack([centre[0], top, centre[1]]), dim=-1
    )
    grid = torch.arange(rows * columns).view(rows, columns)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    faces = torch.cat([torch.stack([a, b, c], -1).view(-1, 3), torch.stack([a, c, d], -1).view(-1, 3)])
    return ring, faces
