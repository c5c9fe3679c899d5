"""A planted skin comes back from pictures of it, whatever the light; photographs on a head look as the head did."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.planted.planted_parts import planted_parts
from torchface.errors import AlignmentError, ShapeError, TopologyError
from torchface.geometry.cameras.pinhole import Camera, look_at
from torchface.geometry.meshes.vertex_graph import VertexGraph
from torchface.mesh import Mesh
from torchface.modeling import MorphableModel, PhotoTexture, fit_colors, photo_texture
from torchface.modeling.photographs.skin_mask import FacePlaces, ShownParts
from torchface.rendering.clay_shading import Lighting, render
from torchface.synthetic import neutral_head
from train.rendered_people.complexion import complexion_colors, draw_complexions

EVEN = Lighting(lights=(), ambient=1.0, occlusion_rays=0, gloss=0.0)
LAMP = Lighting(lights=(((0.5, 0.3, 0.8), 0.95),), ambient=0.22, occlusion_rays=0, gloss=0.0)
CASTS = (torch.tensor([1.1, 1.0, 0.85]), torch.ones(3), torch.tensor([0.85, 0.95, 1.1]))
GREEN = (0.2, 0.6, 0.2)


@pytest.fixture(scope="module")
def skins() -> Tensor:
    learned = complexion_colors(draw_complexions(40, torch.Generator().manual_seed(0)))
    return torch.cat([learned, complexion_colors(draw_complexions(1, torch.Generator().manual_seed(52)))])


@pytest.fixture(scope="module")
def model(skins: Tensor) -> MorphableModel:
    return MorphableModel.fit(skins[:40], 6)


@pytest.fixture(scope="module")
def subject(skins: Tensor) -> Mesh:
    """A head that wears the skin that the model has not seen, as colours of its vertices."""
    return replace(neutral_head(texture=False), colors=skins[40])


@pytest.fixture(scope="module")
def cameras(subject: Mesh) -> list[Camera]:
    centre = subject.vertices[subject.landmarks].mean(0)
    return [look_at(centre, yaw, span=300.0, width=320, height=400) for yaw in (-45.0, 0.0, 45.0)]


@pytest.fixture(scope="module")
def lit(subject: Mesh, cameras: list[Camera]) -> list[Tensor]:
    """Pictures under a lamp that moves with the camera, each of another white balance."""
    pictures = [render(subject, camera, lighting=LAMP, background=GREEN, samples=1) for camera in cameras]
    return [(picture * cast[:, None, None]).clamp(0, 1) for picture, cast in zip(pictures, CASTS, strict=True)]


def difference(found: Tensor, true: Tensor, mesh: Mesh) -> float:
    return float((found - true)[mesh.annotations.regions["face"]].norm(dim=-1).mean())


def test_a_skin_is_found_under_even_light(
    skins: Tensor, model: MorphableModel, subject: Mesh, cameras: list[Camera]
) -> None:
    pictures = [render(subject, camera, lighting=EVEN, background=GREEN, samples=1) for camera in cameras]
    found = fit_colors(model, subject, pictures, cameras, lighting=False)
    nearest = model(model.project(skins[40:]))[0]
    assert difference(found.colors, skins[40], subject) < difference(nearest, skins[40], subject) + 0.003
    assert float(found.coefficients.abs().max()) <= 3.0
    assert float(found.error.max()) < 0.03
    torch.testing.assert_close(found.light[..., 0], torch.ones(3, 3))


def test_light_and_white_balance_do_not_count_as_skin(
    skins: Tensor, model: MorphableModel, subject: Mesh, cameras: list[Camera], lit: list[Tensor]
) -> None:
    found = fit_colors(model, subject, lit, cameras)
    evenly = fit_colors(model, subject, lit, cameras, lighting=False)
    assert difference(found.colors, skins[40], subject) < difference(model.mean, skins[40], subject)
    assert difference(found.colors, skins[40], subject) < 0.7 * difference(evenly.colors, skins[40], subject)
    # Of the first picture red is the strongest channel, of the last blue.
    assert found.light[0, :, 0].argmax() == 0
    assert found.light[2, :, 0].argmax() == 2


def test_a_black_hat_counts_no_more_than_other_errors(
    model: MorphableModel, subject: Mesh, cameras: list[Camera], lit: list[Tensor]
) -> None:
    """A little light more in black is much in sRGB, and only a little of what a hat differs from skin by."""
    high = subject.vertices[:, 1] > subject.vertices[subject.landmarks[17:27], 1].max() + 25.0
    hat = replace(subject, colors=torch.where(high[:, None], 0.03, subject.colors))
    found = fit_colors(model, hat, [render(hat, cameras[1], lighting=LAMP, background=GREEN, samples=1)], cameras[1:2])
    bare = fit_colors(model, subject, lit[1:2], cameras[1:2])
    assert difference(found.colors, bare.colors, subject) < 0.03
    assert (found.light - bare.light).norm() < 0.1 * bare.light.norm()


def test_bounds_hold(model: MorphableModel, subject: Mesh, cameras: list[Camera], lit: list[Tensor]) -> None:
    found = fit_colors(model, subject, lit, cameras, lighting=False, bound=0.5)
    assert float(found.coefficients.abs().max()) == 0.5


@pytest.fixture(scope="module")
def texture(subject: Mesh, cameras: list[Camera]) -> PhotoTexture:
    """Of pictures under even light, each of another white balance."""
    pictures = [render(subject, camera, lighting=EVEN, background=GREEN, samples=1) for camera in cameras]
    cast = [picture * gain[:, None, None] for picture, gain in zip(pictures, CASTS, strict=True)]
    return photo_texture(subject, cast, cameras, 512)


def test_photographs_look_as_the_head_did(subject: Mesh, texture: PhotoTexture, cameras: list[Camera]) -> None:
    for camera in cameras:
        worn = render(replace(subject, colors=None, texture=texture.image), camera, lighting=EVEN, samples=1)
        bare = render(subject, camera, lighting=EVEN, samples=1)
        skin = (bare < 0.999).any(0)
        a, b = worn[:, skin], bare[:, skin]
        # One factor a channel: the mean white balance is no property of the skin.
        apart = (a * (b.mean(1) / a.mean(1))[:, None] - b).norm(dim=0)
        assert float(apart.median()) < 0.02
        assert float(apart.mean()) < 0.04


def test_no_seam_shows_where_photographs_meet(subject: Mesh, skins: Tensor, texture: PhotoTexture) -> None:
    inside = subject.annotations.regions["face"][subject.faces].all(1)
    pairs = subject.faces[inside][:, :2]
    jump = (texture.colors[pairs[:, 0]] - texture.colors[pairs[:, 1]]).norm(dim=-1)
    painted = (skins[40][pairs[:, 0]] - skins[40][pairs[:, 1]]).norm(dim=-1)
    # The pictures' white balances are 0.2 apart.
    assert float((jump - painted).quantile(0.99)) < 0.05
    assert float((jump - painted).mean()) < 0.005


def test_the_hidden_side_mirrors_the_seen_one(subject: Mesh, cameras: list[Camera], lit: list[Tensor]) -> None:
    found = photo_texture(subject, lit[:1], cameras[:1], 256)
    mirror, face = subject.annotations.mirror, subject.annotations.regions["face"]
    hidden = face & (found.seen == 0) & (found.seen[mirror] == 1)
    assert int(hidden.sum()) > 100
    assert float((found.colors - found.colors[mirror])[hidden].norm(dim=-1).mean()) < 0.15
    background = torch.tensor(GREEN) * CASTS[0]
    assert float((found.colors[face] - background).norm(dim=-1).min()) > 0.2


def test_what_no_photograph_shows_is_the_base(subject: Mesh, skins: Tensor, cameras: list[Camera]) -> None:
    picture = render(subject, cameras[1], lighting=EVEN, background=GREEN, samples=1)
    found = photo_texture(subject, [picture], cameras[1:2], 256, base=skins[40])
    away = found.seen == 0
    assert int(away.sum()) > 1000
    assert float((found.colors - skins[40])[away].norm(dim=-1).mean()) < 0.05


def test_bad_input_is_named(
    model: MorphableModel, subject: Mesh, cameras: list[Camera], lit: list[Tensor], dome_rig: torch.nn.Module
) -> None:
    with pytest.raises(ShapeError, match="3 images and 2 cameras"):
        fit_colors(model, subject, lit, cameras[:2])
    with pytest.raises(ShapeError, match=r"found \(3, 400, 319\), expected \(3,400,320\)"):
        fit_colors(model, subject, [lit[0][..., 1:]], cameras[:1])
    with pytest.raises(TopologyError, match="for a mesh of 625 vertices"):
        fit_colors(model, dome_rig.neutral, lit, cameras)
    away = look_at(subject.vertices.mean(0) + 5000, 0.0, span=300.0, width=320, height=400)
    with pytest.raises(AlignmentError, match="found 0 of 6419 vertices in view 0"):
        fit_colors(model, subject, lit[:1], [away])
    with pytest.raises(AlignmentError, match="no vertex of the head"):
        photo_texture(subject, lit[:1], [away])
    with pytest.raises(TopologyError, match="without texture coordinates"):
        photo_texture(Mesh(subject.vertices, subject.faces), lit, cameras)


def test_hair_and_cloth_are_not_painted_on(subject: Mesh, skins: Tensor, cameras: list[Camera]) -> None:
    """Dressed in a blue collar and black hair, the head wears skin there; its face stays as it was photographed."""
    regions = subject.annotations.regions
    hair, collar, cheeks = regions["cranium"], regions["neck"] & ~regions["face"], regions["cheek_left"]
    blue, black = torch.tensor([0.1, 0.2, 0.7]), torch.tensor([0.08, 0.06, 0.05])
    dressed = skins[40].clone()
    dressed[hair], dressed[collar] = black, blue
    pictures = [
        render(replace(subject, colors=dressed), c, lighting=EVEN, background=GREEN, samples=1) for c in cameras
    ]
    painted = photo_texture(subject, pictures, cameras, 256)
    places, graph = FacePlaces.of(subject), VertexGraph(subject.faces, len(subject.vertices))
    shares = torch.stack([
        ShownParts.of(planted_parts(picture, {"hair": black, "cloth": blue, "background": GREEN}),
                      camera.project(subject.vertices.double()), places, graph).own
        for picture, camera in zip(pictures, cameras, strict=True)
    ])  # fmt: skip
    masked = photo_texture(subject, pictures, cameras, 256, confidence=shares)
    skin = skins[40][regions["face"]].median(0).values
    for cloth, color in ((hair, black), (collar, blue)):
        assert float(((painted.colors[cloth] - color).norm(dim=-1) < 0.2).float().mean()) > 0.3
        assert float(((masked.colors[cloth] - color).norm(dim=-1) < 0.2).float().mean()) < 0.02
        assert float((masked.colors[cloth] - skin).norm(dim=-1).mean()) < 0.15
    assert float((masked.colors - painted.colors)[cheeks].norm(dim=-1).quantile(0.95)) < 0.05
    pairs = subject.faces[:, :2]  # nor is there a seam where the photographs end
    outside = (hair | collar)[pairs].any(1)
    jump = (masked.colors[pairs[:, 0]] - masked.colors[pairs[:, 1]]).norm(dim=-1)[outside]
    assert float(jump.quantile(0.99)) < 0.06


def test_skin_that_no_photograph_shows_has_the_hue_of_what_one_shows(subject: Mesh, cameras: list[Camera]) -> None:
    own, other = torch.tensor([0.62, 0.48, 0.36]), torch.tensor([0.32, 0.27, 0.33])
    shown = replace(subject, colors=own.expand_as(subject.vertices))
    picture = render(shown, cameras[1], lighting=EVEN, background=GREEN, samples=1)
    colors = photo_texture(shown, [picture], cameras[1:2], 256, base=other.expand_as(subject.vertices)).colors
    assert float((colors[subject.vertices[:, 2].argmin()] - own).abs().max()) < 0.02  # the back of the head
