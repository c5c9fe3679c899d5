"""Paint sits where the skin is, in the light of the film; a relit face looks as if filmed under the other source."""

import math
from dataclasses import replace

import pytest
import torch
import trimesh
from torch import Tensor

from planted.light_stage import LightStageSettings, lit_image, turning_cameras
from torchface import BlendshapeRig, Mesh
from torchface.color_space import to_linear, to_srgb
from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.distortion import distort
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import triangle_normals
from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.rendering.pixel_coverage import footprint
from torchface.rendering.point_light import PointLight
from torchface.rendering.raycast import RayCaster
from torchface.rendering.texture_overlay import FacePaint, _light_on, _soft_shadow, overlay, relight, skin_faces
from torchface.synthetic import performer

STAGE = LightStageSettings(width=240, height=240, samples=2, gloss=0.0, noise=0.0)
LIGHT = PointLight(torch.tensor([0.3, 0.32, 0.35]), torch.tensor([0.65, 0.6, 0.55]), torch.tensor([-500.0, -250, 100]))
EVEN = PointLight(torch.ones(3), torch.zeros(3), torch.zeros(3))


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(texture=True)


@pytest.fixture(scope="module")
def cameras(rig: BlendshapeRig) -> tuple[Camera, ...]:
    return turning_cameras(rig, 60, 20.0, torch.Generator().manual_seed(1), STAGE)[::15]


def film(mesh: Mesh, camera: Camera, light: PointLight) -> Tensor:
    return to_srgb(lit_image(mesh, camera, light, STAGE).clamp(0, 1))


def plain(color: tuple[float, float, float], alpha: Tensor) -> Tensor:
    """A texture (4,h,w) of one colour."""
    return torch.cat([torch.tensor(color)[:, None, None].expand(3, *alpha.shape), alpha[None]])


def over_vertices(mesh: Mesh, values: Tensor, size: int = 512) -> Tensor:
    """Values (V,) of vertices as a map (size,size) in texture coordinates."""
    texels = rasterise_uvs(mesh.uvs, mesh.uv_faces, size, size)
    page = torch.zeros(size * size, dtype=torch.float64)
    page[texels.texels] = texels.interpolate(values[:, None].double(), mesh.faces)[:, 0]
    return page.view(size, size).float()


def region(mesh: Mesh, name: str) -> Tensor:
    return mesh.annotations.regions[name]


def first_hits(mesh: Mesh, camera: Camera) -> Tensor:
    """The triangle under each pixel's centre, (H,W); -1 for none, and for the inside of the neck."""
    origins, ways = camera.rays()
    hits = RayCaster(mesh.vertices, mesh.faces).cast(origins.reshape(-1, 3), ways.reshape(-1, 3))
    outward = triangle_normals(mesh.vertices.double(), mesh.faces)[hits.triangle.clamp(min=0)]
    facing = (outward * ways.reshape(-1, 3)).sum(1) < 0
    return hits.triangle.masked_fill(~facing, -1).view(camera.height, camera.width)


def eroded(mask: Tensor) -> Tensor:
    """A mask (H,W) without its outermost pixels: those at an edge are painted by the share that is skin."""
    return -torch.nn.functional.max_pool2d(-mask.float()[None, None], 3, 1, 1)[0, 0] > 0


def grown(mask: Tensor) -> Tensor:
    return torch.nn.functional.max_pool2d(mask.float()[None, None], 5, 1, 2)[0, 0] > 0


def test_paint_of_the_skins_own_colours_is_not_seen(rig: BlendshapeRig, cameras: tuple[Camera, ...]) -> None:
    """The skin's texture as paint, in the film's light, gives the film again: shading, shadows and place are right."""
    mesh = rig.neutral
    paint = FacePaint.of(mesh, torch.cat([mesh.texture, torch.ones(1, *mesh.texture.shape[1:])]))
    for camera in cameras[:2]:
        frame = film(mesh, camera, LIGHT)
        blank = torch.full_like(frame, 0.5)
        painted = overlay(blank, mesh.vertices, paint, LIGHT, camera)
        here = skin_faces(mesh)[first_hits(mesh, camera).clamp(min=0)] & (first_hits(mesh, camera) >= 0)
        off = (painted - frame).abs().amax(0)[here]
        assert float(off.median()) < 0.004
        assert float(off.quantile(0.95)) < 0.05
        assert float((blank - frame).abs().amax(0)[here].median()) > 0.1


def test_where_there_is_no_paint_the_frame_stays_to_the_bit(rig: BlendshapeRig, cameras: tuple[Camera, ...]) -> None:
    mesh, camera = rig.neutral, cameras[0]
    frame = torch.randint(0, 256, (3, 240, 240), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    nothing = FacePaint.of(mesh, plain((1, 0, 0), torch.zeros(64, 64)))
    assert torch.equal(overlay(frame, mesh.vertices, nothing, LIGHT, camera), frame)
    lips = over_vertices(mesh, (region(mesh, "upper_lip") | region(mesh, "lower_lip")).float())
    painted = overlay(frame, mesh.vertices, FacePaint.of(mesh, plain((0.8, 0, 0.1), lips)), LIGHT, camera)
    assert painted.dtype == torch.uint8
    changed = (painted != frame).any(0).nonzero()[:, [1, 0]].double()
    mouth = camera.project(mesh.vertices.double())[mesh.landmarks[48:68]]
    assert len(changed) > 100
    assert bool((changed >= mouth.amin(0) - 6).all())
    assert bool((changed <= mouth.amax(0) + 6).all())
    aside = mesh.vertices + torch.tensor([3000.0, 0, 0])
    assert overlay(frame, aside, nothing, LIGHT, camera) is frame


def test_eyes_and_the_inside_of_the_mouth_take_no_paint(rig: BlendshapeRig, cameras: tuple[Camera, ...]) -> None:
    weights = torch.zeros(1, len(rig.names))
    weights[0, rig.names.index("jawOpen")] = 0.9
    mesh, camera = rig.neutral.with_vertices(rig(weights)[0]), cameras[0]
    hits = first_hits(mesh, camera)
    frame = torch.zeros(3, 240, 240)
    painted = overlay(frame, mesh.vertices, FacePaint.of(mesh, plain((1, 1, 1), torch.ones(64, 64))), EVEN, camera)
    inside = torch.zeros(len(mesh.vertices), dtype=torch.bool)
    for name in ("eyeball_left", "eyeball_right", "mouth_interior"):
        inside |= region(mesh, name)
    deep = eroded((hits >= 0) & inside[mesh.faces[hits.clamp(min=0)]].all(-1))
    assert int(deep.sum()) > 150
    assert float(painted[:, deep].max()) == 0
    cheek = eroded((hits >= 0) & region(mesh, "cheek_left")[mesh.faces[hits.clamp(min=0)]].all(-1))
    torch.testing.assert_close(painted[:, cheek], torch.ones(3, int(cheek.sum())), atol=0.01, rtol=0)


def test_a_dot_sits_on_its_landmark_while_the_head_turns(rig: BlendshapeRig, cameras: tuple[Camera, ...]) -> None:
    """Also through a lens that bends the picture."""
    mesh = rig.neutral
    vertex = int((mesh.vertices - torch.tensor([12.0, 50.0, 90.0])).norm(dim=1).argmin())  # on the flat of the forehead
    near = torch.exp(-((mesh.vertices - mesh.vertices[vertex]).norm(dim=1) ** 2) / (2 * 4.0**2))
    paint = FacePaint.of(mesh, plain((1, 1, 1), over_vertices(mesh, near)))
    for camera in cameras:
        lens = CameraCalibration(
            camera.intrinsics, torch.tensor([-0.4, 0.1, 0.01, -0.01, 0.0]).double(), camera.width, camera.height
        )
        for calibration in (None, lens):
            painted = overlay(torch.zeros(3, 240, 240), mesh.vertices, paint, EVEN, camera, calibration)
            amount = to_linear(painted)[0].double()
            y, x = torch.meshgrid(torch.arange(240.0).double(), torch.arange(240.0).double(), indexing="ij")
            found = torch.stack([(amount * x).sum(), (amount * y).sum()]) / amount.sum()
            place = camera.project(mesh.vertices.double())[vertex]
            place = place if calibration is None else distort(place, calibration)
            assert float((found - place).norm()) < 0.4


def test_what_the_head_hides_is_not_painted(rig: BlendshapeRig, cameras: tuple[Camera, ...]) -> None:
    mesh = rig.neutral
    turned = cameras[0].rotation.double()
    a = math.radians(60)
    yaw = torch.tensor([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]]).double()
    camera = replace(cameras[0], rotation=turned @ yaw)
    frame = torch.zeros(3, 240, 240)
    seen = {}
    for name in ("ear_left", "ear_right"):
        paint = FacePaint.of(mesh, plain((1, 1, 1), over_vertices(mesh, region(mesh, name).float())))
        seen[name] = int((overlay(frame, mesh.vertices, paint, EVEN, camera) > 0.5).any(0).sum())
    assert min(seen.values()) == 0
    assert max(seen.values()) > 100


def test_edges_are_covered_by_their_share(rig: BlendshapeRig, cameras: tuple[Camera, ...]) -> None:
    """The painted area is that of a picture with eight times the pixels a side."""
    mesh, camera = rig.neutral, cameras[0]
    fine_K = camera.intrinsics.double().clone()
    fine_K[:2] *= 8
    fine_K[:2, 2] += 3.5
    fine = first_hits(mesh, replace(camera, intrinsics=fine_K, width=240 * 8, height=240 * 8)) >= 0
    share = torch.nn.functional.avg_pool2d(fine[None, None].float(), 8)[0, 0]
    covered = footprint(mesh.vertices, mesh.faces, torch.ones(len(mesh.faces), dtype=torch.bool), camera)
    found = torch.zeros(240 * 240, dtype=torch.float64).index_add_(0, covered.pixel, covered.share).view(240, 240)
    edge = (found > 0) & (found < 1)
    assert float((found - share).abs().max()) <= 0.25  # one of four columns of samples
    assert float((found - share)[edge].square().mean().sqrt()) < 0.08
    assert abs(float(found.sum() / share.sum()) - 1) < 0.001
    assert int(((found > 0.1) & (found < 0.9)).sum()) > 200


def test_a_relit_face_looks_as_under_the_other_source(rig: BlendshapeRig, cameras: tuple[Camera, ...]) -> None:
    other = PointLight(torch.tensor([0.3, 0.3, 0.3]), torch.tensor([0.5, 0.6, 0.7]), torch.tensor([500.0, -200, 200]))
    mesh = rig.neutral
    for camera in cameras[::2]:
        old, wanted = film(mesh, camera, LIGHT), film(mesh, camera, other)
        found = relight(old, mesh, LIGHT, other, camera)
        on_face = first_hits(mesh, camera) >= 0
        before, after = ((x - wanted).abs().amax(0)[on_face] for x in (old, found))
        assert float(after.mean()) < 0.15 * float(before.mean())
        assert float(after.median()) < 0.01
        assert torch.equal(found[:, ~grown(on_face)], old[:, ~grown(on_face)])


def test_the_same_light_changes_nothing_but_old_shadows_edges(rig: BlendshapeRig, cameras: tuple[Camera, ...]) -> None:
    mesh, camera = rig.neutral, cameras[0]
    frame = film(mesh, camera, LIGHT)
    same = relight(frame, mesh, LIGHT, LIGHT, camera)
    assert float((same - frame).abs().amax(0).quantile(0.9)) < 2e-3
    share = torch.zeros(len(mesh.vertices))
    kept = relight(frame, mesh, LIGHT, EVEN, camera, share=share)
    torch.testing.assert_close(kept, frame, atol=1e-4, rtol=0)


def test_a_shadow_ends_softly() -> None:
    """A wall of 40 mm on a plane, light at 45 degrees: the shadow fades over the penumbra of a source of 20 degrees.

    Seen from a point at distance x behind the wall, its edge is at the angle atan(40 / x); the source is hidden where
    that is above 65 degrees and whole where it is below 25.
    """
    wide, high = 400.0, 40.0
    plane = torch.tensor([[-wide, -wide, 0], [wide, -wide, 0], [wide, wide, 0], [-wide, wide, 0]])
    wall = torch.tensor([[0, -wide, 0], [0, wide, 0], [0, wide, high], [0, -wide, high]])
    mesh = Mesh(torch.cat([plane, wall]), torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]))
    K = torch.tensor([[500.0, 0, 99.5], [0, 500.0, 99.5], [0, 0, 1]])
    camera = Camera(K, torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.0, 0, 500]), 200, 200)
    light = PointLight.directional(torch.zeros(3), torch.ones(3), torch.tensor([-1.0, 0.0, -1.0]))
    covered = footprint(mesh.vertices, mesh.faces, torch.ones(4, dtype=torch.bool), camera)
    seen, x = _soft_shadow(covered, light), covered.points[:, 0]
    flat = (covered.normals[:, 2] < -0.9) & (covered.share == 1)
    assert float(seen[flat & (x > 4) & (x < 12)].max()) < 0.05
    assert float(seen[flat & (x > 95)].min()) > 0.95
    fading = x[flat & (seen > 0.1) & (seen < 0.9)]
    assert 25 < float(fading.max() - fading.min()) < 75


def test_light_ends_on_a_ball_as_that_of_a_disc() -> None:
    """The mean of many sources on the disc, and no darker edge where its middle sets."""
    ball = trimesh.creation.icosphere(5, 80.0)
    mesh = Mesh(torch.from_numpy(ball.vertices).float(), torch.from_numpy(ball.faces))
    K = torch.tensor([[500.0, 0, 99.5], [0, 500.0, 99.5], [0, 0, 1]])
    camera = Camera(K, torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.0, 0, 500]), 200, 200)
    way = torch.tensor([1.0, 0.0, -0.3])
    light = PointLight.directional(torch.zeros(3), torch.ones(3), way)
    covered = footprint(mesh.vertices, mesh.faces, torch.ones(len(mesh.faces), dtype=torch.bool), camera)
    found = _light_on(covered, light)[:, 0]
    middle = torch.nn.functional.normalize(way.double(), dim=0)
    first = torch.linalg.cross(middle, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    across = torch.stack([first / first.norm(), torch.linalg.cross(middle, first / first.norm())])
    count = 400
    turn, radius = torch.arange(count) * math.pi * (3 - math.sqrt(5)), (torch.arange(count) + 0.5).div(count).sqrt()
    disc = math.tan(math.radians(20)) * torch.stack([radius * turn.cos(), radius * turn.sin()], dim=1).double()
    sources = torch.nn.functional.normalize(middle + disc @ across, dim=1)
    true = (covered.normals.double() @ sources.T).clamp(min=0).mean(1)
    inner = covered.normals[:, 2] < -0.4  # the outline is softened
    assert float((found - true).abs()[inner].max()) < 0.04
    dusk = inner & ((covered.normals.double() @ middle).abs() < 0.2)
    assert float((found - true).abs()[dusk].mean()) < 0.01


def test_light_reaches_beyond_the_mesh_where_asked(rig: BlendshapeRig, cameras: tuple[Camera, ...]) -> None:
    """A grey picture in half the light is half as bright on both sides of the outline, and as before far off."""
    mesh, camera, grey = rig.neutral, cameras[0], torch.full((3, 240, 240), 0.5)
    half = PointLight(EVEN.ambient / 2, EVEN.intensity, EVEN.position)
    found = relight(grey, mesh, EVEN, half, camera, beyond=True)
    on_face = first_hits(mesh, camera) >= 0
    dark = to_srgb(to_linear(grey) / 2)
    assert float((found - dark).abs().amax(0)[grown(on_face)].max()) < 0.01
    assert torch.equal(found[:, :3, :3], grey[:, :3, :3])


def test_what_is_no_paint_or_no_face_is_refused(rig: BlendshapeRig, cameras: tuple[Camera, ...]) -> None:
    mesh, camera, frame = rig.neutral, cameras[0], torch.zeros(3, 240, 240)
    with pytest.raises(ShapeError, match="alpha"):
        FacePaint.of(mesh, torch.ones(3, 64, 64))
    with pytest.raises(ShapeError, match="at most"):
        FacePaint.of(mesh, torch.ones(4, 1, 1).expand(4, 9000, 1))
    with pytest.raises(ValueRangeError, match="texture"):
        FacePaint.of(mesh, torch.full((4, 8, 8), 2.0))
    with pytest.raises(TopologyError, match="texture coordinates"):
        FacePaint.of(Mesh(mesh.vertices, mesh.faces), torch.ones(4, 8, 8))
    paint = FacePaint.of(mesh, torch.ones(4, 8, 8))
    with pytest.raises(ShapeError, match="frame"):
        overlay(frame[:, 1:], mesh.vertices, paint, LIGHT, camera)
    with pytest.raises(ShapeError, match="vertices"):
        overlay(frame, mesh.vertices[1:], paint, LIGHT, camera)
    broken = mesh.vertices.clone()
    broken[0, 0] = math.nan
    with pytest.raises(ValueRangeError, match="NaN"):
        overlay(frame, broken, paint, LIGHT, camera)
    with pytest.raises(ShapeError, match="share"):
        relight(frame, mesh, LIGHT, EVEN, camera, share=torch.ones(3))


def test_no_region_no_hole(rig: BlendshapeRig) -> None:
    mesh = rig.neutral
    bare = Mesh(mesh.vertices, mesh.faces, mesh.uvs, mesh.uv_faces)
    assert bool(skin_faces(bare).all())
    assert 0.5 < float(skin_faces(mesh).float().mean()) < 0.95
