"""Light planted on a head's skin is found in its picture and divided out of its colours."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.planted.planted_parts import planted_parts
from torchface.color_space import to_linear, to_srgb
from torchface.geometry.cameras.pinhole import Camera, look_at
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.vertex_graph import VertexGraph
from torchface.mesh import Mesh
from torchface.modeling.photographs.fit_settings import FitSettings
from torchface.modeling.photographs.image_texture import part_vertices, photographed_skin
from torchface.modeling.photographs.skin_light import (
    exposed,
    exposure_gain,
    light_hue,
    like_skin_around,
    patch_offset,
    skin_light,
    unlit,
    unveiled,
)
from torchface.modeling.photographs.skin_mask import FacePlaces, ShownParts
from torchface.rendering.camera_visibility import PosedSurface
from torchface.rendering.clay_shading import Lighting, render
from torchface.synthetic import neutral_head

SIDE = Lighting(lights=(((0.8, 0.2, 0.5), 0.8),), ambient=0.35, occlusion_rays=0, gloss=0.0)
EVEN = Lighting(lights=(), ambient=1.0, occlusion_rays=0, gloss=0.0)
SKIN, HAIR = torch.tensor([0.72, 0.52, 0.44]), torch.tensor([0.12, 0.08, 0.06])


@pytest.fixture(scope="module")
def head() -> Mesh:
    mesh = neutral_head(texture=False)
    return replace(mesh, colors=SKIN.repeat(len(mesh.vertices), 1))


@pytest.fixture(scope="module")
def camera(head: Mesh) -> Camera:
    return look_at(head.vertices[head.landmarks].mean(0), 5.0, span=300.0, width=300, height=360)


def test_light_from_the_side_is_divided_out(head: Mesh, camera: Camera) -> None:
    picture = render(head, camera, lighting=SIDE, samples=1)
    shown = PosedSurface.each(head, 1)[0].shown_in(picture, camera)
    normals = vertex_normals(head.vertices.double(), head.faces)
    cheeks = FacePlaces.of(head).cheeks
    light = skin_light(shown, normals, camera, cheeks)
    seen = cheeks & (shown.cosine > 0.4)
    even = unlit(shown.colors, normals, camera, light)

    def spread(colors: Tensor) -> float:
        return float(colors[seen].log().std(0).mean())

    assert spread(even) < 0.45 * spread(shown.colors)
    brighter = light.irradiance(torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]]).double()).mean(1)
    assert brighter[0] > brighter[1] + 0.3  # the light stands at the viewer's right
    assert skin_light(shown, normals, camera, cheeks & (shown.cosine > 2)) is None


def test_hair_is_a_cap_of_its_colour_and_a_bald_head_stays_bald(head: Mesh, camera: Camera) -> None:
    places = FacePlaces.of(head)
    high = places.place[:, 1] > 0.55
    haired = replace(head, colors=torch.where(high[:, None], HAIR, head.colors))
    found = {}
    for name, mesh in (("bald", head), ("hair", haired)):
        picture = render(mesh, camera, lighting=EVEN, samples=1)
        parts = planted_parts(picture, {"hair": HAIR, "background": torch.zeros(3)}, 0.05)
        found[name] = photographed_skin([head], None, [picture], [camera], FitSettings(texture_size=128, parts=[parts]))
    assert found["bald"].hair is None
    color, cap = found["hair"].hair, found["hair"].colors
    assert float((color - HAIR).norm()) < 0.06
    behind = (places.behind > 0.8) & (places.place[:, 1] > 0.2)
    assert float((cap[behind] - HAIR).norm(dim=1).median()) < 0.1  # no picture shows it
    forehead = places.cheeks & (places.place[:, 1] < 0.3) & ~part_vertices(head)
    assert float((cap[forehead] - SKIN).norm(dim=1).median()) < 0.1


def test_highlights_are_not_the_hairs_colour(head: Mesh, camera: Camera) -> None:
    haired = replace(head, colors=torch.where((FacePlaces.of(head).place[:, 1] > 0.55)[:, None], HAIR, head.colors))
    picture = render(haired, camera, lighting=EVEN, samples=1)
    parts = planted_parts(picture, {"hair": HAIR, "background": torch.zeros(3)}, 0.05)
    shines = (parts.of("hair")[: picture.shape[1], : picture.shape[2]] > 0.5) & (torch.arange(300) % 8 == 0)
    streaks = torch.where(torch.arange(300) % 2 == 0, 0.2, 1.8).expand_as(shines)
    streaked = torch.where(parts.of("hair")[: picture.shape[1], : picture.shape[2]] > 0.5, streaks * picture, picture)
    found = [
        photographed_skin([head], None, [shown], [camera], FitSettings(texture_size=128, parts=[parts])).hair
        for shown in (torch.where(shines, 0.6, picture), picture, streaked)
    ]
    assert float((found[0] - HAIR).norm()) < 0.06  # their mean is 0.1 off
    assert float(found[2].mean() / found[1].mean()) == pytest.approx(1.0, abs=0.08)  # nor is the shade beside them


def test_shadow_beside_hair_is_not_painted_and_a_mole_is(head: Mesh, camera: Camera) -> None:
    places = FacePlaces.of(head)
    border = (places.out > 0.8) & (places.out < 1.0) & (places.place[:, 1] < 0) & (places.place[:, 0] > 0)
    mole = places.cheeks & ((places.place - places.place.new_tensor([-0.4, -0.5, 0.0]))[:, :2].norm(dim=1) < 0.08)
    dark = SKIN * 0.5
    picture = render(
        replace(head, colors=torch.where((border | mole)[:, None], dark, head.colors)), camera, lighting=EVEN, samples=1
    )
    parts = planted_parts(picture, {"background": torch.zeros(3)}, 0.05)
    found = photographed_skin([head], None, [picture], [camera], FitSettings(texture_size=128, parts=[parts])).colors
    seen = PosedSurface.each(head, 1)[0].shown_in(picture, camera).cosine > 0.3
    assert float((found[border & seen] - SKIN).norm(dim=1).median()) < 0.1
    assert float((found[mole] - dark).norm(dim=1).min()) < 0.1


def test_long_hair_beside_the_jaw_is_no_beard_and_a_beard_stays(head: Mesh, camera: Camera) -> None:
    places = FacePlaces.of(head)
    low = (places.place[:, 1] < -0.5) & (places.out < 1.3)
    strand, beard = low & (places.out > 0.6) & (places.place[:, 0] > 0.25), low & (places.out > 0.6)
    skin = low & (places.out < 1) & ~places.features & ~part_vertices(head) & (places.place[:, 0].abs() > 0.3)
    moustache = (places.place[:, :2] - places.place[head.landmarks[[33, 51]], :2].mean(0)).norm(dim=1) < 0.1
    moustache &= places.out < 1
    graph, all_shown = VertexGraph(head.faces, len(head.vertices)), []
    for hair in (strand, beard, moustache):
        shown = replace(head, colors=torch.where(hair[:, None], HAIR, head.colors))
        picture = render(shown, camera, lighting=EVEN, samples=1)
        parts = planted_parts(picture, {"hair": HAIR, "background": torch.zeros(3)}, 0.05)
        all_shown.append(ShownParts.of(parts, camera.project(head.vertices.double()), places, graph))
        if hair is strand:
            settings = FitSettings(texture_size=128, parts=[parts], paint_hair=False)
            found = photographed_skin([head], None, [picture], [camera], settings).colors
            assert float((found[skin] - SKIN).norm(dim=1).max()) < 0.1  # nor is it mirrored
    inner = strand & (places.out < 0.9) & ~places.features & ~part_vertices(head)
    assert float(all_shown[0].own[inner].median()) < 0.1 < 0.9 < float(all_shown[1].own[inner].median())
    assert float(all_shown[0].doubt[inner].median()) > 0.9 > 0.1 > float(all_shown[1].doubt[inner].median())
    grown = moustache & (places.place[:, 2] > places.chin[2]) & (places.place[:, 1] < -0.55)
    assert float(all_shown[2].own[grown].median()) > 0.9


def test_folds_that_look_like_hair_are_skin(head: Mesh, camera: Camera) -> None:
    """Deep folds beside the nose are dark, and the network takes some of them for hair."""
    places = FacePlaces.of(head)
    at = places.place[:, :2] * places.place.new_tensor([1.0, 0.5])
    fold = ((at - at.new_tensor([0.3, -0.3])).norm(dim=1) < 0.1) & places.cheeks & ~part_vertices(head)
    picture = render(
        replace(head, colors=torch.where(fold[:, None], HAIR, head.colors)), camera, lighting=EVEN, samples=1
    )
    parts = planted_parts(picture, {"hair": HAIR, "background": torch.zeros(3)}, 0.05)
    graph = VertexGraph(head.faces, len(head.vertices), head.vertices)
    seen = ShownParts.of(parts, camera.project(head.vertices.double()), places, graph)
    inner = fold & (graph.least((fold | ~places.cheeks).double()) > 0)
    assert float(seen.own[inner].min()) > 0.9
    assert float(seen.doubt[inner].max()) < 0.1
    found = photographed_skin([head], None, [picture], [camera], FitSettings(texture_size=128, parts=[parts])).colors
    assert float((found[inner] - HAIR).norm(dim=1).median()) < 0.25


@pytest.mark.parametrize("yaw", [30.0, 60.0])
def test_long_hair_before_what_a_turned_head_hides_of_mouth_and_neck_is_no_beard(head: Mesh, yaw: float) -> None:
    places = FacePlaces.of(head)
    strand = (places.place[:, 1] < -0.5) & (places.out > 0.6) & (places.out < 1.3) & (places.place[:, 0] > 0.25)
    shown = replace(head, colors=torch.where(strand[:, None], HAIR, head.colors))
    camera = look_at(head.vertices[head.landmarks].mean(0), yaw, span=300.0, width=300, height=360)
    picture = render(shown, camera, lighting=EVEN, samples=1)
    parts = planted_parts(picture, {"hair": HAIR, "background": torch.zeros(3)}, 0.05)
    graph = VertexGraph(head.faces, len(head.vertices))
    own = ShownParts.of(parts, camera.project(head.vertices.double()), places, graph).own
    inner = strand & (places.out < 0.9) & ~places.features & ~part_vertices(head)
    assert float(own[inner].median()) < 0.1


def test_rims_that_touching_lips_hide_have_the_lips_colour(head: Mesh, camera: Camera) -> None:
    red = torch.tensor([0.62, 0.24, 0.26])
    lips = head.regions["upper_lip"] | head.regions["lower_lip"]
    shown = replace(head, colors=torch.where(lips[:, None], red, head.colors))
    picture = render(shown, camera, lighting=EVEN, samples=1)
    parts = planted_parts(picture, {"lips": red, "background": torch.zeros(3)}, 0.05)
    template, settings = replace(head, colors=None), FitSettings(texture_size=128, parts=[parts], paint_hair=False)
    found = photographed_skin([template], None, [picture], [camera], settings).colors
    at = head.vertices[head.landmarks[61:64]].double()
    near = torch.cdist(head.vertices.double(), at).amin(1) < 4
    hidden = near & lips & (PosedSurface.each(head, 1)[0].shown_in(picture, camera).cosine <= 0)
    assert int(hidden.sum()) > 5
    assert float((found[hidden] - red).norm(dim=1).median()) < 0.5 * float((SKIN - red).norm())


def test_a_photographs_brows_are_the_only_ones(head: Mesh, camera: Camera) -> None:
    places = FacePlaces.of(head)
    fringe = places.place[:, 1] > places.brows + 0.12
    template = replace(head, colors=torch.where(places.brow[:, None], HAIR, head.colors))
    shown = replace(head, colors=torch.where(fringe[:, None], HAIR, head.colors))  # the person's brows are fair
    picture = render(shown, camera, lighting=EVEN, samples=1)
    parts = planted_parts(picture, {"hair": HAIR, "background": torch.zeros(3)}, 0.05)
    settings = FitSettings(texture_size=128, parts=[parts], paint_hair=False)
    found = photographed_skin([template], None, [picture], [camera], settings).colors
    assert float((found[places.brow & ~fringe] - SKIN).norm(dim=1).mean()) < 0.1


def test_skin_under_hair_is_skin_in_spite_of_its_shadow_and_of_a_templates_hair(head: Mesh, camera: Camera) -> None:
    places = FacePlaces.of(head)
    assert head.colors is not None
    up = places.place[:, 1]
    fringe, band = up > 0.45, (up > places.brows + 0.12) & (up < 0.45) & (places.place[:, 0].abs() < 0.4)
    template = replace(head, colors=torch.where((up > 0.6)[:, None], HAIR, head.colors))
    shaded = torch.where(band[:, None], 0.6 * SKIN, head.colors)
    picture = render(replace(head, colors=torch.where(fringe[:, None], HAIR, shaded)), camera, lighting=EVEN, samples=1)
    parts = planted_parts(picture, {"hair": HAIR, "background": torch.zeros(3)}, 0.05)
    settings = FitSettings(texture_size=128, parts=[parts], paint_hair=False)
    found = photographed_skin([template], None, [picture], [camera], settings).colors
    assert found is not None
    for where in (band, fringe & (places.behind < 0.3)):
        assert float((found[where] - SKIN).norm(dim=1).quantile(0.95)) < 0.06


def test_of_three_photographs_one_with_a_filter_counts_where_no_other_shows_the_head(
    head: Mesh, camera: Camera
) -> None:
    picture = render(head, camera, lighting=EVEN, samples=1)
    sepia = (picture * torch.tensor([1.1, 0.9, 0.3])[:, None, None]).clamp(max=1)
    parts = [planted_parts(one, {"background": torch.zeros(3)}, 0.05) for one in (picture, picture, sepia)]
    settings = FitSettings(texture_size=128, parts=parts)
    plain = photographed_skin([head] * 2, None, [picture] * 2, [camera] * 2, replace(settings, parts=parts[:2]))
    found = photographed_skin([head] * 3, None, [picture, picture, sepia], [camera] * 3, settings)
    cheeks = FacePlaces.of(head).cheeks
    assert float((found.colors - plain.colors)[cheeks].norm(dim=1).mean()) < 0.01


def test_a_hard_shadow_on_the_face_is_taken_away_and_a_mole_is_not(head: Mesh, camera: Camera) -> None:
    places = FacePlaces.of(head)
    shade = torch.where(places.place[:, :1] > 0.1, torch.tensor([0.75, 0.6, 0.4]), torch.tensor([1.0, 1.0, 1.0]))
    plain = render(head, camera, lighting=EVEN, samples=1)
    cheeks = places.cheeks & (PosedSurface.each(head, 1)[0].shown_in(plain, camera).cosine > 0.5)
    aside = (places.place - places.place.new_tensor([-0.35, -0.45, 0.0]))[:, :2].norm(dim=1)
    mole = int(torch.where(cheeks, aside, torch.inf).argmin())
    spots = head.colors.clone()
    spots[mole] *= 0.5
    shown = replace(head, colors=spots * shade)
    picture = render(shown, camera, lighting=EVEN, samples=1)
    parts = planted_parts(picture, {"background": torch.zeros(3)}, 0.05)
    found = photographed_skin([head], None, [picture], [camera], FitSettings(texture_size=128, parts=[parts])).colors
    spread = (found[cheeks].log().std(0) / (spots * shade)[cheeks].log().std(0)).max()
    assert float(spread) < 0.5
    assert float(found[mole].mean() / found[cheeks].median(0).values.mean()) < 0.85


def test_even_skin_stays_as_it_is(head: Mesh) -> None:
    graph = VertexGraph(head.faces, len(head.vertices))
    cheeks = FacePlaces.of(head).cheeks.double()
    blush = head.colors * (1 + 0.04 * torch.sin(head.vertices[:, :1] / 20))
    assert float(patch_offset(blush, cheeks, None, graph)[cheeks > 0].abs().max()) < 0.03
    darker = 0.3 * head.colors  # one complexion may be darker than another all over
    assert float(patch_offset(darker, cheeks, head.colors, graph)[cheeks > 0].abs().max()) < 1e-3


def test_a_coloured_light_is_taken_off_where_there_is_no_colour_model_and_grey_stays_grey(
    head: Mesh, camera: Camera
) -> None:
    plain, places = replace(head, colors=None), FacePlaces.of(head)
    picture = render(head, camera, lighting=EVEN, samples=1)
    tinted = {
        "orange": picture * torch.tensor([1.0, 0.8, 0.5])[:, None, None],
        "grey": picture.mean(0).expand(3, -1, -1),
    }
    hues = {}
    for name, image in tinted.items():
        parts = planted_parts(image, {"background": torch.zeros(3)}, 0.05)
        skin = photographed_skin([plain], None, [image], [camera], FitSettings(texture_size=64, parts=[parts]))
        color = skin.colors[places.cheeks & ~part_vertices(head)].median(0).values
        hues[name] = float((color[0] / color[2]).log())
    own = float((SKIN[0] / SKIN[2]).log())
    assert own < hues["orange"] < own + 0.6 * math.log(2)  # people's skins differ in hue by the rest
    assert abs(hues["grey"]) < 0.01


def test_hue_of_a_coloured_light_beyond_peoples_skins_is_found(head: Mesh) -> None:
    cheeks = FacePlaces.of(head).cheeks.double()
    white = torch.ones(3, dtype=torch.float64)
    assert torch.equal(light_hue(head.colors * torch.tensor([1.05, 1.0, 0.95]), cheeks, head.colors), white)
    assert torch.equal(light_hue(head.colors * 0.4, cheeks, head.colors), white)
    hue = light_hue(head.colors * torch.tensor([1.2, 1.0, 0.5]), cheeks, head.colors)
    assert hue[0] > 1
    assert hue[2] < 0.75


@pytest.mark.parametrize("exposure", [0.45, 0.6, 1.0])
def test_an_under_exposed_photograph_is_developed(head: Mesh, camera: Camera, exposure: float) -> None:
    picture = render(head, camera, lighting=EVEN, samples=1).clamp(max=0.96)
    dark = to_srgb(exposure * to_linear(picture))
    parts = planted_parts(dark, {"background": dark[:, 0, 0]}, 0.02)
    bright = exposed(dark, parts)
    error = (to_linear(bright) / to_linear(picture).clamp(min=1e-3)).flatten().median()
    assert float(error) == pytest.approx(1.0, abs=0.05)


def test_a_dark_complexion_stays_dark_before_a_dark_wall() -> None:
    def gain(skin: float, white: float) -> float:
        picture = torch.full((3, 100, 100), 0.2)
        picture[:, 20:80, 20:80] = skin
        picture[:, 40:44, 30:40] = picture[:, 40:44, 60:70] = white
        colors = {"background": [0.2] * 3, "eyes": [white] * 3}
        return exposure_gain(picture, planted_parts(picture, colors, 0.02))

    assert gain(0.25, 0.6) == pytest.approx(1.0, abs=0.05)  # its eyes are as bright as in good light
    assert gain(0.35, 0.35) > 2.0  # fair in a dim picture: its eyes are dim too
    assert gain(0.25, 0.85) > 1.1  # brighter than any white beside that skin: light in glasses


def test_a_veil_over_a_picture_is_taken_away() -> None:
    skin, hair = torch.tensor([0.74, 0.56, 0.51]), torch.tensor([0.14, 0.11, 0.1])
    picture = skin[:, None, None].expand(3, 60, 60).clone()
    picture[:, :20], picture[:, 30:34, 10:18] = hair[:, None, None], 0.04  # hair, and a nostril

    def cleared(veil: float, shown: Tensor = picture, tone: Tensor = hair) -> Tensor:
        veiled = veil + (1 - veil) * shown
        return unveiled(veiled, planted_parts(veiled, {"hair": veil + (1 - veil) * tone}, 0.02))

    torch.testing.assert_close(cleared(0.0), picture, rtol=0, atol=0.005)  # redder than blue by 1.45
    shares = [float(cleared(veil)[:, 5, 5].mean() / cleared(veil)[:, 50, 50].mean()) for veil in (0.0, 0.1, 0.25)]
    assert shares[1:] == pytest.approx([shares[0]] * 2, abs=0.02)  # a quarter's veil alone makes it 0.41 of the skin
    torch.testing.assert_close(cleared(0.25)[:, 50, 50].mean(), 0.25 + 0.75 * skin.mean(), rtol=0, atol=2e-3)
    grey, blue, black = picture.mean(0).expand(3, -1, -1), picture.flip(0), torch.where(picture < 0.2, 0.0, picture)
    for kept in (grey, blue, black):
        parts = planted_parts(kept, {"hair": kept[:, 5, 5]}, 0.02)
        torch.testing.assert_close(unveiled(kept, parts), kept, rtol=0, atol=2e-3)


def test_blush_on_both_cheeks_stays_and_light_on_one_goes(head: Mesh) -> None:
    graph, places = VertexGraph(head.faces, len(head.vertices)), FacePlaces.of(head)
    skin, mirror = places.cheeks.double(), head.annotations.mirror
    left = (places.place - places.place.new_tensor([0.5, -0.5, 0.0]))[:, :2].norm(dim=1) < 0.25
    red = torch.tensor([1.12, 1.0, 0.9])

    def change(where: Tensor) -> float:
        colors = torch.where(where[:, None], head.colors * red, head.colors)
        return float(patch_offset(colors, skin, head.colors, graph, mirror)[where & places.cheeks].abs().mean())

    assert change(left | left[mirror]) < 0.001
    assert change(left) > 0.002


def test_an_upper_lid_that_paint_darkens_in_spots_is_skin_when_it_shuts(head: Mesh, camera: Camera) -> None:
    places = FacePlaces.of(head)
    lid = places.lids > 0.5
    spots = lid & (torch.arange(len(lid)) % 2 == 0)
    picture = render(replace(head, colors=torch.where(spots[:, None], 0.2 * SKIN, head.colors)), camera, lighting=EVEN)
    parts = planted_parts(picture, {"background": torch.zeros(3)}, 0.05)
    found = photographed_skin([head], None, [picture], [camera], FitSettings(texture_size=128, parts=[parts])).colors
    assert int(spots.sum()) > 5
    assert float(found[spots].mean() / SKIN.mean()) > 0.75


def test_a_place_of_skin_keeps_its_pores_and_loses_what_is_of_another_hue() -> None:
    tone = torch.tensor([[0.7, 0.5, 0.4]], dtype=torch.float64)
    pore, edge = 0.93 * tone, tone * torch.tensor([0.9, 0.6, 0.1])
    assert torch.allclose(like_skin_around(pore, tone, 0.2, 0.06), pore, rtol=0.01)
    left = (like_skin_around(edge, tone, 0.2, 0.06) / tone).log()
    assert float(left.mean()) > -0.21
    assert float(left.amax() - left.amin()) < 0.125  # 2.2 at the edge
