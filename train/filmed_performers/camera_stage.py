"""A camera stage: a performer with painted strokes and reflective markers, recorded by a camera on a helmet.

A real video file, the markers as C3D beside it, a description of what was performed, and the truth.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import vertex_normals
from torchface.io.action_labels import ActionLabels, Box
from torchface.io.take_files import save_take
from torchface.io.video import VideoFile, write_video
from torchface.progress import Progress, silent
from torchface.rendering.gaussian_blur import gaussian_blur
from torchface.rig import BlendshapeRig
from torchface.synthetic.head.identity import both_sides, sculpted_vertices
from torchface.synthetic.head.performer import performer
from torchface.synthetic.head.topology import EYE_RIM, topology
from torchface.synthetic.stages.marker_stage import Recording, StageFlaws, place_markers, record

from .action_performance import ActionPerformance, PerformanceSettings, perform_action_units
from .head_camera_images import MARKER_RADIUS, HeadCameraRenderer
from .helmet_camera import HELMET_POINT, CameraFlaws, helmet_camera, shaken_cameras
from .label_files import save_action_labels
from .reflective_paint import reflective_paint

SIDE_MARKERS = ("SIDE_L", "SIDE_R")
"""Labels of the two markers by which images are stabilised."""


@dataclass(frozen=True)
class StageSettings:
    """How a session is recorded."""

    width: int = 192  # of the video, pixels
    height: int = 256  # of the video, pixels
    markers: int = 40  # on the face, besides the two on its sides
    flaws: CameraFlaws = field(default_factory=CameraFlaws)
    marker_flaws: StageFlaws = field(default_factory=lambda: StageFlaws(noise=0.1, standoff=MARKER_RADIUS))
    unsteadiness: float = 0.5  # of the painter's hand, millimetres
    performance: PerformanceSettings = field(default_factory=PerformanceSettings)  # what is performed how often


@dataclass(frozen=True, eq=False)
class RecordedSession:
    """The files of a session, and the truth behind them."""

    video: VideoFile
    take_path: Path  # the C3D with the markers, as many frames as the video
    labels_path: Path  # what `torchface.io.action_labels.load_action_labels` reads
    labels: ActionLabels
    rig: BlendshapeRig
    attachment: Attachment  # where the markers sit
    performance: ActionPerformance
    recording: Recording  # the markers, and what their system did to them
    rotation: Tensor  # of the camera, world to camera, (T,3,3)
    translation: Tensor  # the same, (T,3)


def record_session(
    folder: str | Path,
    name: str,
    identity: Tensor | None,
    generator: torch.Generator,
    settings: StageSettings = StageSettings(),
    progress: Progress | None = None,
    attachment: Attachment | None = None,
) -> RecordedSession:
    """Paints a performer, sets markers, records a session: ``name.avi``, ``name.c3d`` and ``name.toml``."""
    folder = Path(folder)
    rig = performer(identity, texture=True)
    performance = perform_action_units(rig.names, generator, settings.performance)
    attachment = stage_markers(rig, settings.markers) if attachment is None else attachment
    attachment.select(SIDE_MARKERS)  # without them there is no way to hold images still; said before hours of filming
    recording = record(rig, attachment, performance.weights, generator, settings.marker_flaws, settings.performance.fps)
    paint = reflective_paint(rig.neutral.texture.shape[-1], generator, settings.unsteadiness)  # type: ignore[union-attr]
    camera = helmet_camera(settings.width, settings.height)
    rotation, translation = shaken_cameras(camera, len(performance.weights), performance.fps, settings.flaws, generator)
    labels = replace(
        describe(rig, attachment, replace(camera, rotation=rotation[0], translation=translation[0])),
        frames=len(performance.weights),
        performed=performance.performed,
    )
    scene = HeadCameraRenderer(rig, paint, attachment)
    frames = render_video(scene, performance.weights, camera, rotation, translation, settings.flaws, generator)
    frames = _counted(frames, len(performance.weights), progress or silent)
    video = write_video(frames, folder / f"{name}.avi", performance.fps)
    take_path, labels_path = folder / f"{name}.c3d", folder / f"{name}.toml"
    save_take(recording.take, take_path)
    save_action_labels(labels, labels_path)
    return RecordedSession(
        video, take_path, labels_path, labels, rig, attachment, performance, recording, rotation, translation
    )


def _counted(frames: Iterator[Tensor], total: int, progress: Progress) -> Iterator[Tensor]:
    for done, frame in enumerate(frames):
        yield frame
        progress("rendering the video", done + 1, total)


def stage_markers(rig: BlendshapeRig, count: int = 40) -> Attachment:
    """So many markers spread over the performer's skin, and one on each side of the face where it moves least."""
    spots = place_markers(rig, count)
    p = sculpted_vertices()
    aside = torch.tensor([60.0, -4.0, 44.0], dtype=p.dtype)
    left = int((p - aside).norm(dim=1).argmin())
    right = int(topology().mirror[left])
    sides = Attachment.from_vertices(rig.neutral, [left, right], SIDE_MARKERS)
    points, side_points = spots.on(rig.neutral.faces, rig.vertices), sides.on(rig.neutral.faces, rig.vertices)
    apart = torch.cdist(points, side_points).amin(1) > 6.0  # two markers side by side would be one blob
    spots = spots.select([label for label, free in zip(spots.labels or (), apart.tolist(), strict=True) if free])
    return Attachment(
        torch.cat([spots.triangles, sides.triangles]),
        torch.cat([spots.barycentric, sides.barycentric]),
        (*(spots.labels or ()), *SIDE_MARKERS),
        fingerprint=rig.neutral.fingerprint(),
    )


def describe(rig: BlendshapeRig, attachment: Attachment, camera: Camera) -> ActionLabels:
    """Where in a neutral image the helmet's point, the side markers and the regions are; one frame, no actions."""
    points = attachment.select(SIDE_MARKERS).on(rig.neutral.faces, rig.vertices).double()
    normals = vertex_normals(rig.vertices.double(), rig.neutral.faces)
    normals = attachment.select(SIDE_MARKERS).on(rig.neutral.faces, normals)
    sides = camera.project(points + MARKER_RADIUS * torch.nn.functional.normalize(normals, dim=-1)).tolist()
    helmet = camera.project(torch.tensor([HELMET_POINT], dtype=torch.float64))[0].tolist()
    pixels = camera.project(rig.vertices.double())
    regions = {name: _box(pixels[mask]) for name, mask in _region_vertices().items()}
    return ActionLabels(1, 0, (helmet[0], helmet[1]), (tuple(sides[0]), tuple(sides[1])), regions)


def _box(pixels: Tensor, margin: float = 0.08) -> Box:
    low, high = pixels.amin(0), pixels.amax(0)
    low, high = low - margin * (high - low), high + margin * (high - low)
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def _region_vertices() -> dict[str, Tensor]:
    """Vertices (V,) whose extent is a region: over the brows, between them, round the eyes, round the mouth."""
    t, p = topology(), sculpted_vertices()
    x, y, front = p[:, 0], p[:, 1], p[:, 2] > 40
    skin = torch.zeros(t.count, dtype=torch.bool)
    skin[t.grid[t.grid >= 0]] = True
    skin |= skin[t.mirror]
    regions = {}
    for side, name in ((1.0, "left"), (-1.0, "right")):
        regions[f"brow_{name}"] = skin & front & (side * x > 3) & (side * x < 52) & (y > 17) & (y < 57)
    regions["between_brows"] = skin & front & (x.abs() < 16) & (y > -24) & (y < 26)
    for side, name in enumerate(("left", "right")):
        eye = torch.zeros(t.count, dtype=torch.bool)
        eye[both_sides(t.rings["eye"])[side][1 : EYE_RIM + 1]] = True
        regions[f"eye_{name}"] = eye
    mouth = torch.zeros(t.count, dtype=torch.bool)
    for ring in both_sides(t.rings["mouth"][:6]):
        mouth[ring] = True
    regions["mouth"] = mouth
    return regions


def render_video(
    scene: HeadCameraRenderer,
    weights: Tensor,
    camera: Camera,
    rotation: Tensor,
    translation: Tensor,
    flaws: CameraFlaws,
    generator: torch.Generator,
) -> Iterator[Tensor]:
    """Grey images (H,W) in [0,1] of a painted performer, one a frame.

    The light sits round the lens: skin scatters it, paint throws much of it back, markers all of it.
    """
    _, ways = replace(camera, rotation=torch.eye(3), translation=torch.zeros(3)).rays()
    shape = ways.shape[:2]
    shade = _vignette(shape, flaws.vignette)
    for t in range(len(weights)):  # an image at a time: each has a surface of its own
        centre = -rotation[t].T @ translation[t]
        light = scene.render(weights[t], centre, ways.reshape(-1, 3) @ rotation[t]).view(shape)
        light = flaws.exposure * shade * gaussian_blur(light[None, None], flaws.blur)[0, 0]
        noise = flaws.noise * torch.randn(shape, generator=generator)
        yield (light + noise * (light.clamp(min=0).sqrt() + 1 / 3)).clamp(0, 1)


def _vignette(shape: torch.Size, amount: float) -> Tensor:
    y, x = torch.meshgrid(torch.linspace(-1, 1, shape[0]), torch.linspace(-1, 1, shape[1]), indexing="ij")
    return 1 - amount * (x**2 + y**2) / 2
