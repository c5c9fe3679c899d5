"""Planted lights come back from pictures with gloss, shadows and noise."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from planted.light_stage import LightStageSettings, lit_image, render_lit_video, turning_cameras
from torchface import BlendshapeRig, Mesh, load_rig
from torchface.capture.own_rig.lighting import LightFit, estimate_light
from torchface.color_space import to_linear, to_srgb
from torchface.errors import AlignmentError, ShapeError, ValueRangeError
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.distortion import undistort
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import vertex_normals
from torchface.io.video import open_video
from torchface.modeling import photo_texture
from torchface.rendering.camera_visibility import shown_in
from torchface.rendering.point_light import PointLight, in_camera_frame, irradiance, lit_by, vertex_albedo
from torchface.rendering.raycast import RayCaster
from torchface.shape_names import mapping
from torchface.synthetic import draw_identities, performer
from torchface.synthetic.stages import perform

STAGE = LightStageSettings(width=200, height=200, samples=1)


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(draw_identities(1, torch.Generator().manual_seed(2))[0], texture=True)


def performed(rig: BlendshapeRig, frames: int, generator: torch.Generator) -> Tensor:
    take = perform(frames, generator, fps=20.0)
    return take.weights.values[..., 0] @ mapping(take.weights.names, rig.names).T


def planted(centre: Tensor, generator: torch.Generator) -> PointLight:
    """A source somewhere before the face, 0.3 to 3 m away, neither too weak nor too coloured."""
    heading = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
    heading[2] = -heading[2].abs() - 0.25
    amount = torch.rand(8, generator=generator)
    distance = 300 * 10 ** float(amount[0])
    tint = 0.8 + 0.4 * amount[1:4]
    return PointLight(
        0.1 + 0.3 * amount[4:7],
        (0.3 + 0.6 * amount[7]) * tint,
        centre + distance * torch.nn.functional.normalize(heading, dim=0),
    )


def photograph(mesh: Mesh, camera: Camera, light: PointLight, seed: int) -> Tensor:
    """What a camera writes, uint8 (3,H,W)."""
    linear = lit_image(mesh, camera, light, STAGE)
    noise = torch.randn(linear.shape, generator=torch.Generator().manual_seed(seed))
    return (to_srgb((linear + STAGE.noise * linear.sqrt() * noise).clamp(0, 1)) * 255).round().to(torch.uint8)


def middle(mesh: Mesh, camera: Camera) -> Tensor:
    return in_camera_frame(camera, mesh.vertices)[mesh.landmarks].mean(0).float()


def angle(fit: LightFit, light: PointLight, centre: Tensor) -> float:
    """Between where the found and the planted source are seen from the face, degrees."""
    return math.degrees(math.acos(min(1.0, float(fit.light.toward(centre) @ light.toward(centre)))))


def apart(found: Tensor, truth: Tensor) -> float:
    return float((found - truth).norm() / truth.norm())


def check(fit: LightFit, light: PointLight, centre: Tensor) -> None:
    assert angle(fit, light, centre) < 2.0
    assert apart(fit.light.intensity, light.intensity) < 0.05
    assert apart(fit.light.ambient, light.ambient) < 0.05


@pytest.mark.bench  # a light from afar is found, and one of a file
def test_planted_lights_come_back(rig: BlendshapeRig) -> None:
    generator = torch.Generator().manual_seed(0)
    cameras, weights = turning_cameras(rig, 400, 20.0, generator, STAGE), performed(rig, 400, generator)
    t = int(torch.randint(400, (1,), generator=generator))
    mesh = rig.neutral.with_vertices(rig(weights[t : t + 1])[0])
    centre = middle(mesh, cameras[t])
    light = planted(centre, generator)
    frame = photograph(mesh, cameras[t], light, t)
    fit = estimate_light(frame, mesh.vertices, mesh.faces, vertex_albedo(mesh), cameras[t])
    check(fit, light, centre)
    assert fit.error < 4 / 255
    assert fit.deviation < 1.0


@pytest.mark.bench
@pytest.mark.real
def test_planted_lights_come_back_on_a_scanned_head(ict_folder: Path) -> None:
    rig = load_rig(ict_folder, part="face")
    generator = torch.Generator().manual_seed(1)
    blotches = torch.rand(1, 3, 24, 24, generator=generator)
    texture = torch.nn.functional.interpolate(0.35 + 0.5 * blotches, (256, 256), mode="bicubic")[0].clamp(0, 1)
    cameras = turning_cameras(rig, 100, 20.0, generator, STAGE)
    weights = 0.4 * torch.rand(1, len(rig.names), generator=generator)
    mesh, camera = replace(rig.neutral, vertices=rig(weights)[0], texture=texture), cameras[60]
    centre = middle(mesh, camera)
    light = planted(centre, generator)
    frame = photograph(mesh, camera, light, 60)
    check(estimate_light(frame, mesh.vertices, mesh.faces, vertex_albedo(mesh), camera), light, centre)


@pytest.fixture(scope="module")
def lit(rig: BlendshapeRig) -> tuple[Mesh, Camera, PointLight, Tensor]:
    """A mesh, its camera, the light from one side, and the picture."""
    camera = turning_cameras(rig, 1, 20.0, torch.Generator().manual_seed(4), STAGE)[0]
    ambient, intensity = torch.tensor([0.2, 0.22, 0.25]), torch.tensor([0.7, 0.65, 0.6])
    light = PointLight.directional(ambient, intensity, torch.tensor([-0.7, -0.3, -0.6]))
    return rig.neutral, camera, light, photograph(rig.neutral, camera, light, 0)


@pytest.fixture(scope="module")
def found(lit: tuple[Mesh, Camera, PointLight, Tensor]) -> LightFit:
    mesh, camera, _, frame = lit
    return estimate_light(frame, mesh.vertices, mesh.faces, vertex_albedo(mesh), camera)


def test_light_from_far_away_is_found_far_away(lit: tuple[Mesh, Camera, PointLight, Tensor], found: LightFit) -> None:
    (mesh, camera, light, _), fit = lit, found
    check(fit, light, middle(mesh, camera))
    assert fit.distance > 2500
    assert fit.lit.sum() < 0.9 * fit.visible.sum()  # the far side of the nose lies in shadow


def test_shadow_of_the_nose_is_modelled_not_explained_away(
    lit: tuple[Mesh, Camera, PointLight, Tensor], found: LightFit
) -> None:
    """Vertices turned to the source that the head itself shades are dark and still inliers."""
    (mesh, camera, light, _), fit = lit, found
    points = in_camera_frame(camera, mesh.vertices)
    facing = (vertex_normals(points, mesh.faces) * light.toward(points)).sum(1) > 0.3
    shaded = fit.visible[0] & facing & ~fit.lit[0]
    assert int(shaded.sum()) > 20
    assert float(fit.inliers[0, shaded].float().mean()) > 0.4


def test_paint_and_foreign_shadow_are_outliers(lit: tuple[Mesh, Camera, PointLight, Tensor]) -> None:
    mesh, camera, light, frame = lit
    spoiled = frame.clone()
    spoiled[:, :70] //= 5  # the brim of a hat
    spoiled[:, 120:132, 80:120] = 255  # a sticker
    fit = estimate_light(spoiled, mesh.vertices, mesh.faces, vertex_albedo(mesh), camera)
    check(fit, light, middle(mesh, camera))
    rows = camera.project(mesh.vertices.double())[:, 1]
    assert float(fit.inliers[0, fit.visible[0] & (rows < 66)].float().mean()) < 0.05


@pytest.mark.bench
def test_only_products_of_light_and_reflectance_are_told(
    lit: tuple[Mesh, Camera, PointLight, Tensor], found: LightFit
) -> None:
    """Skin half as bright under a light twice as strong makes the same picture."""
    mesh, camera, _, frame = lit
    one, darker = found, to_srgb(0.5 * to_linear(vertex_albedo(mesh)))
    two = estimate_light(frame, mesh.vertices, mesh.faces, darker, camera)
    torch.testing.assert_close(two.light.intensity, 2 * one.light.intensity, rtol=0.01, atol=0.0)
    torch.testing.assert_close(two.light.ambient, 2 * one.light.ambient, rtol=0.01, atol=0.0)
    assert float(one.direction @ two.direction) > math.cos(math.radians(0.3))


@pytest.mark.bench
def test_a_bent_lens_is_heeded(lit: tuple[Mesh, Camera, PointLight, Tensor]) -> None:
    """The same vertices are read where the lens shows them: a film squeezed to a third, and a lens that squeezes."""
    mesh, camera, light, frame = lit
    lens = CameraCalibration(
        camera.intrinsics, torch.tensor([0.6, 0.0, 0.0, 0.0, 0.0]).double(), camera.width, camera.height
    )
    y, x = torch.meshgrid(torch.arange(200.0).double(), torch.arange(200.0).double(), indexing="ij")
    straight = undistort(torch.stack([x, y], dim=-1), lens)
    grid = (2 * straight + 1) / 200 - 1
    bent = torch.nn.functional.grid_sample(frame[None].float() / 255, grid[None].float(), align_corners=False)[0]
    fit = estimate_light(bent.clamp(0, 1), mesh.vertices, mesh.faces, vertex_albedo(mesh), camera, calibration=lens)
    check(fit, light, middle(mesh, camera))


@pytest.mark.bench
def test_several_frames_narrow_the_light_down(rig: BlendshapeRig) -> None:
    generator = torch.Generator().manual_seed(5)
    cameras = turning_cameras(rig, 60, 20.0, generator, STAGE)[::20]
    light = PointLight(torch.full((3,), 0.2), torch.full((3,), 0.6), torch.tensor([-500.0, -200, 100]))
    frames = torch.stack([photograph(rig.neutral, camera, light, k) for k, camera in enumerate(cameras)])
    meshes = rig.vertices.expand(3, -1, -1)
    albedo = vertex_albedo(rig.neutral)
    one = estimate_light(frames[0], rig.vertices, rig.neutral.faces, albedo, cameras[0])
    all_of_them = estimate_light(frames, meshes, rig.neutral.faces, albedo, cameras)
    check(all_of_them, light, middle(rig.neutral, cameras[0]))
    assert all_of_them.deviation < 0.8 * one.deviation
    assert all_of_them.visible.shape == (3, len(rig.vertices))


def test_from_a_file_to_its_light(tmp_path: Path, rig: BlendshapeRig) -> None:
    """The first frame of a film gives the light of the others, while the head turns and speaks."""
    generator = torch.Generator().manual_seed(6)
    light = PointLight(torch.tensor([0.2, 0.2, 0.25]), torch.tensor([0.7, 0.6, 0.5]), torch.tensor([450.0, -350, 150]))
    film = render_lit_video(
        tmp_path / "lit.avi", rig, performed(rig, 60, generator)[::20], light, 1.0, generator, STAGE
    )
    video = open_video(film.video.path)
    frames = torch.cat(list(video.color_chunks(2)))
    assert frames.shape == (3, 3, STAGE.height, STAGE.width)
    albedo, meshes = vertex_albedo(rig.neutral), film.vertices
    fit = estimate_light(frames[0], meshes[0], rig.neutral.faces, albedo, film.cameras[0])
    check(fit, light, middle(rig.neutral, film.cameras[0]))
    # Shaded by that light, the others look as they were filmed.
    points = in_camera_frame(film.cameras[2], meshes[2])
    normals = vertex_normals(points, rig.neutral.faces)
    caster = RayCaster(points, rig.neutral.faces)
    shade = irradiance(points, normals, fit.light, lit_by(fit.light.position, caster, points, normals))
    unmoved = replace(film.cameras[2], rotation=torch.eye(3).double(), translation=torch.zeros(3).double())
    shown = shown_in(frames[2].float() / 255, unmoved, caster, points, normals)
    off = (to_srgb(to_linear(albedo) * shade.float()) - shown.colors).abs().amax(-1)[shown.cosine > 0.4]
    assert float(off.median()) < 5 / 255


def test_what_cannot_be_estimated_is_said(lit: tuple[Mesh, Camera, PointLight, Tensor]) -> None:
    mesh, camera, _, frame = lit
    vertices, faces, albedo = mesh.vertices, mesh.faces, vertex_albedo(mesh)
    broken = vertices.clone()
    broken[5] = math.nan
    with pytest.raises(ValueRangeError, match="vertices"):
        estimate_light(frame, broken, faces, albedo, camera)
    with pytest.raises(AlignmentError, match="is the face in the frame"):
        estimate_light(frame, vertices + torch.tensor([5000.0, 0, 0]), faces, albedo, camera)
    with pytest.raises(ValueRangeError, match="black"):
        estimate_light(torch.zeros_like(frame), vertices, faces, albedo, camera)
    with pytest.raises(AlignmentError, match="not blown out"):
        estimate_light(torch.full_like(frame, 255), vertices, faces, albedo, camera)
    with pytest.raises(ShapeError, match="albedo"):
        estimate_light(frame, vertices, faces, albedo[:-1], camera)
    with pytest.raises(ShapeError, match="pixels"):
        estimate_light(frame[:, :-1], vertices, faces, albedo, camera)
    with pytest.raises(ShapeError, match="frames"):
        estimate_light(frame[:1], vertices, faces, albedo, camera)
    with pytest.raises(ShapeError, match="cameras"):
        estimate_light(frame, vertices, faces, albedo, [camera, camera])
    with pytest.raises(ValueRangeError, match="albedo"):
        estimate_light(frame, vertices, faces, 255 * albedo, camera)
    with pytest.raises(ValueRangeError, match="frame"):
        estimate_light(frame.float(), vertices, faces, albedo, camera)
    with pytest.raises(ValueRangeError, match="weights"):
        estimate_light(frame, vertices, faces, albedo, camera, weights=-torch.ones(len(vertices)))


def test_an_albedo_taken_from_the_frame_is_refused(lit: tuple[Mesh, Camera, PointLight, Tensor]) -> None:
    """It would be explained by even light, whatever light there was."""
    mesh, camera, _, frame = lit
    taken = photo_texture(mesh, [frame.float() / 255], [camera], size=64).colors
    with pytest.raises(ValueRangeError, match="the frame's own colours"):
        estimate_light(frame, mesh.vertices, mesh.faces, taken.float().clamp(0, 1), camera)
