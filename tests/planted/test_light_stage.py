"""The film under a light shows what its settings say."""

from dataclasses import replace
from pathlib import Path

import torch

from planted.face_paint import face_paint
from planted.light_stage import LightStageSettings, lit_image, render_lit_video, turning_cameras
from torchface.color_space import to_linear
from torchface.geometry.cameras.pinhole import look_at
from torchface.geometry.meshes.operators import vertex_normals
from torchface.io.video import open_video
from torchface.mesh import Mesh
from torchface.rendering.point_light import PointLight, in_camera_frame
from torchface.synthetic import neutral_head, performer

PLAIN = LightStageSettings(width=120, height=120, samples=1, gloss=0.0, noise=0.0)
AMBIENT, INTENSITY = torch.tensor([0.2, 0.3, 0.4]), torch.tensor([0.5, 0.6, 0.7])


def ball() -> Mesh:
    """A sphere of 80 mm in one colour."""
    line = torch.linspace(0, torch.pi, 61), torch.linspace(0, 2 * torch.pi, 121)
    down, turn = torch.meshgrid(*line, indexing="ij")
    points = torch.stack([down.sin() * turn.sin(), down.cos(), down.sin() * turn.cos()], dim=-1).view(-1, 3)
    ids = torch.arange(len(points)).view(61, 121)
    quads = torch.stack([ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]], dim=-1).view(-1, 4)
    uvs = torch.full((len(points), 2), 0.5)
    return Mesh.from_polygons(80 * points, quads, uvs, quads, texture=torch.full((3, 4, 4), 0.6))


def test_a_ball_is_shaded_by_the_cosine() -> None:
    mesh, light = ball(), PointLight(AMBIENT, INTENSITY, torch.tensor([400.0, -300, -200]))
    camera = look_at(torch.zeros(3), 15.0, 10.0, 200.0, 120, 120)
    picture = lit_image(mesh, camera, light, PLAIN)
    origins, ways = (x.reshape(-1, 3) for x in camera.rays())
    middle = (origins * ways).sum(1)
    root = middle.square() - (origins.square().sum(1) - 80.0**2)
    on_ball = root > 400  # away from the rim, where a mesh is no ball
    point = (origins + (-middle - root.clamp(min=0).sqrt())[:, None] * ways)[on_ball]
    normal = point / 80
    lamp = camera.rotation.T @ (light.position.double() - camera.translation)
    cosine = (normal * torch.nn.functional.normalize(lamp - point, dim=1)).sum(1).clamp(min=0)
    expected = to_linear(torch.tensor(0.6)) * (AMBIENT + INTENSITY * cosine[:, None])
    torch.testing.assert_close(picture.view(3, -1).T[on_ball].double(), expected, atol=4e-3, rtol=0)
    glossy = lit_image(mesh, camera, light, replace(PLAIN, gloss=0.2))
    assert 0.15 * 0.7 < float((glossy - picture).max()) <= 0.2 * 0.7 + 1e-6


def test_the_camera_stands_still_and_the_head_turns() -> None:
    rig = performer(texture=True)
    cameras = turning_cameras(rig, 200, 20.0, torch.Generator().manual_seed(0), PLAIN)
    places = torch.stack([in_camera_frame(camera, rig.vertices) for camera in cameras[::10]])
    nose = places[:, rig.neutral.landmarks[30]]
    assert bool((nose - places[:, rig.neutral.landmarks].mean(1)).std(0)[0] > 3)
    normals = torch.stack([vertex_normals(p, rig.neutral.faces)[rig.neutral.landmarks[27]] for p in places])
    turned = torch.rad2deg(torch.atan2(normals[:, 0], -normals[:, 2]))
    assert 20 < float(turned.max() - turned.min()) < 60
    pixels = torch.stack([camera.project(rig.vertices.double()) for camera in cameras[::10]])
    assert bool(((pixels > 0) & (pixels < 120)).all())


def test_a_film_is_a_file_with_its_truth(tmp_path: Path) -> None:
    rig = performer(texture=True)
    light, told = PointLight(AMBIENT, INTENSITY, torch.tensor([-400.0, -200, 0])), []
    settings = replace(PLAIN, noise=0.01, width=64, height=48)
    film = render_lit_video(
        tmp_path / "film.avi", rig, torch.zeros(3, len(rig.names)), light, 10.0, torch.Generator().manual_seed(0),
        settings, progress=lambda _, done=None, of=None: told.append((done, of)),
    )  # fmt: skip
    video = open_video(film.video.path)
    assert (video.width, video.height, video.fps, video.count) == (64, 48, 10.0, 3)
    assert told == [(1, 3), (2, 3), (3, 3)]
    frames = torch.cat(list(video.color_chunks(2))).float() / 255
    truth = lit_image(rig.neutral, film.cameras[1], light, settings)
    assert float((to_linear(frames[1]) - truth).abs().mean()) < 0.01
    assert film.vertices.shape == (3, len(rig.vertices), 3)


def test_face_paint_lies_round_the_eyes_and_on_the_lips() -> None:
    paint, mesh = face_paint(256), neutral_head(texture=False)
    assert paint.shape == (4, 256, 256)
    assert float(paint.min()) >= 0
    assert float(paint.max()) <= 1
    assert mesh.uvs is not None
    assert mesh.uv_faces is not None
    row = torch.zeros(len(mesh.vertices), dtype=torch.int64)
    row[mesh.faces.flatten()] = mesh.uv_faces.flatten()
    column, line = (mesh.uvs[row] * 256).long().clamp(max=255).unbind(1)
    at = paint[:, 255 - line, column]
    assert mesh.annotations is not None
    regions = mesh.annotations.regions
    assert float(at[3, regions["lids_left"] | regions["lids_right"]].median()) > 0.85
    lips = at[:, mesh.landmarks[[51, 57]]]
    assert bool((lips[3] > 0.5).all())
    assert bool((lips[0] > 3 * lips[1]).all())
    assert float(at[3, regions["cranium"] | regions["neck"] | regions["ear_left"]].max()) == 0
