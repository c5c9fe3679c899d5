"""Irises planted on a head come back from its picture, and a written eyeball wears them."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest
import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import look_at
from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.io.gltf.part_textures.iris_texture import painted_eye
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.landmarks.images.networks.part_network import PARTS
from torchface.mesh import Mesh
from torchface.modeling.photographs.eye_color import iris_color, white_brightness, with_iris
from torchface.modeling.photographs.fit_settings import FitSettings
from torchface.modeling.photographs.image_texture import (
    _spectacles,
    _View,
    _with_parts,
    part_vertices,
    photographed_skin,
    with_part_colors,
)
from torchface.modeling.photographs.skin_light import like_skin_around
from torchface.modeling.photographs.skin_mask import FacePlaces
from torchface.modeling.photographs.texture_projection import PhotoTexture
from torchface.registration.scan_colors import own_colors
from torchface.rendering.clay_shading import Lighting, render
from torchface.synthetic import neutral_head, performer

EVEN = Lighting(lights=(), ambient=1.0, occlusion_rays=0, gloss=0.0)
BLUE, BROWN = torch.tensor([0.25, 0.40, 0.60]), torch.tensor([0.30, 0.19, 0.10])


@pytest.fixture(scope="module")
def bare() -> Mesh:
    mesh = neutral_head(texture=False)
    return replace(mesh, colors=torch.tensor([0.8, 0.62, 0.55]).repeat(len(mesh.vertices), 1))


@pytest.mark.parametrize("planted", [BLUE, BROWN], ids=["blue", "brown"])
def test_irises_come_back_from_a_picture(bare: Mesh, planted: Tensor) -> None:
    worn = with_part_colors(bare, planted)
    skin = ~part_vertices(bare)
    assert torch.equal(worn.colors[skin], bare.colors[skin])
    eyes = bare.vertices[bare.landmarks[36:48]].mean(0)
    camera = look_at(eyes, 10.0, span=160.0, width=640, height=400)
    fronts, wide = [], bare.colors.clone()  # irises of people's size; those of the coarse ball fade from their middle
    for side in ("right", "left"):
        ball = bare.annotations.regions[f"eyeball_{side}"].nonzero()[:, 0]
        out = bare.vertices[ball] - bare.vertices[ball].mean(0)
        fronts.append(bare.vertices[ball[out[:, 2].argmax()]].double())
        wide[ball] = torch.where((out[:, 2] > 0.8 * out[:, 2].max())[:, None], planted, torch.tensor(1.0))
    picture = render(replace(bare, colors=wide), camera, lighting=EVEN, samples=1)
    ringed = iris_color(bare, [picture], [camera], camera.project(torch.stack(fronts))[None])
    assert float((ringed - planted).norm()) < 0.05
    rig, aside = performer(texture=False), ("eyeLookOutLeft", "eyeLookInRight")
    weights = torch.tensor([[float(name in aside) for name in rig.names]])
    for posed in (bare, bare.with_vertices(rig(weights)[0].detach())):  # whose irises' places are not known
        seen = render(replace(posed, colors=wide), camera, lighting=EVEN, samples=1)
        assert float((iris_color(posed, [seen], [camera]) - planted).norm()) < 0.05
    centres = camera.project(torch.stack(fronts)).expand(3, 2, 2)
    sepia = (picture.mean(0) * torch.tensor([1.0, 0.75, 0.4])[:, None, None]).clamp(max=1)
    three = iris_color([bare] * 3, [picture, sepia, picture], [camera] * 3, centres)
    assert torch.equal(three, ringed)  # one in sepia does not decide
    violet = torch.tensor([1.0, 0.5, 1.5])[:, None, None] * picture
    dark, bright = (iris_color(bare, [share * violet], [camera], centres[:1]) for share in (0.35, 1.5))
    assert bright is None  # as a flashed pupil
    assert bool((dark[:-1] > dark[1:]).all())  # brown
    assert abs(float(dark.mean() - (0.35 * planted * torch.tensor([1.0, 0.5, 1.5])).mean())) < 0.02
    whites = torch.stack([torch.tensor(white_brightness(bare, [share * picture], [camera], centres[:1]))
                          for share in (0.5, 0.6, 0.8, 1.0)])  # fmt: skip
    torch.testing.assert_close(whites, torch.tensor([0.6, 0.66, 0.88, 1.0]), atol=0.03, rtol=0)
    far = look_at(eyes, 10.0, span=2000.0, width=320, height=200)
    assert white_brightness(bare, [0.5 * picture], [far], centres[:1]) == 1  # as the material has them
    assert iris_color(bare, [render(worn, far, lighting=EVEN, samples=1)], [far]) is None


def test_a_written_eyeball_wears_the_iris(bare: Mesh) -> None:
    ball = bare.annotations.regions["eyeball_left"]
    triangles = ball[bare.faces].all(1).nonzero()[:, 0]

    def bluest(mesh: Mesh) -> float:
        paints = [paint for _, _, paint in painted_eye(mesh, triangles) if paint is not None]
        values = [paint.image.flatten(1).T if paint.image is not None else paint.colors for paint in paints]
        colors = torch.cat([value[:, :3] for value in values if value is not None])
        return float((colors[:, 2] - colors[:, 0]).max())

    assert bluest(with_part_colors(bare, BLUE)) > 0.2
    assert bluest(with_part_colors(bare, BROWN)) < 0.05
    assert bluest(bare) < 0.05  # colours that are skin's all over are no painted eye


def test_painted_irises_take_a_colour_and_nothing_else_does() -> None:
    head = performer().neutral
    blue = torch.tensor([0.40, 0.50, 0.60])
    texture, mesh = head.texture, with_iris(head, blue)
    changed = (mesh.texture - texture).abs().amax(0) > 1e-6
    assert 0 < float(changed.float().mean()) < 0.02
    colors = mesh.texture[:, changed]
    assert float((colors.median(1).values / colors.median(1).values.norm() - blue / blue.norm()).abs().max()) < 0.03
    assert float(texture[:, changed].mean(0).max()) < 0.72  # the whites stay


def test_the_edge_of_a_painted_pupil_is_soft(bare: Mesh) -> None:
    texels = rasterise_uvs(bare.uvs, bare.uv_faces, 1024, 1024)
    blank = PhotoTexture(torch.ones(3, 1024, 1024), bare.colors, torch.ones(len(bare.vertices)), texels)
    drawn = _with_parts(blank, bare.colors, bare, part_vertices(bare), torch.ones(2, 3)).image.mean(0)
    assert int((drawn < 0.05).sum()) > 20
    assert int(((drawn > 0.06) & (drawn < 0.2)).sum()) > 10  # none where black ends at the next texel


@pytest.mark.parametrize("part", ["teeth_upper", "gums_and_tongue", "mouth_socket"])
def test_what_lies_in_the_mouth_is_darker_the_further_back_it_lies(part: str) -> None:
    head = performer(texture=False).neutral
    teeth = torch.arange(len(head.vertices)) % 3 == 0
    head = replace(head, annotations=replace(head.annotations, regions={part: teeth}))
    colored = with_part_colors(replace(head, colors=torch.ones(len(head.vertices), 3)), None)
    depth, light = head.vertices[teeth, 2], colored.colors[teeth].mean(1)
    order = depth.argsort(descending=True)
    assert bool((light[order].diff() < 1e-6).all())
    assert float(light[order[-1]]) < 0.5 * float(light[order[0]]) < 0.45


def test_frames_count_where_a_photograph_shows_enough_of_glasses() -> None:
    places = FacePlaces.of(neutral_head())
    view = cast(_View, SimpleNamespace(places=places, shown=SimpleNamespace(cosine=torch.ones(len(places.frames)))))
    between = (places.place[:, 0].abs() < 0.03) & (places.frames > 0.5)
    assert bool(between.any())  # the bridge
    shown = (torch.arange(len(places.frames)) % 20 == 0).double()
    assert torch.equal(_spectacles([view], [shown]), places.frames)
    assert not _spectacles([view], [shown * 0.09]).any()
    assert not _spectacles([view], [shown * (torch.arange(len(shown)) % 60 == 0)]).any()
    bridge = (places.place[:, :2].abs() < 0.05).all(1).double()
    assert torch.equal(_spectacles([view], [0.25 * bridge]), places.frames)  # thin frames of a small face
    assert not _spectacles([view], [0.09 * bridge]).any()
    assert not _spectacles([view] * 3, [shown, 0 * shown, 0 * shown]).any()  # a blurred socket in one picture


def test_brows_that_the_network_takes_for_skin_stay_also_behind_glasses() -> None:
    head = neutral_head()
    camera = look_at(head.vertices[head.landmarks[27:48]].mean(0), 0.0, span=260.0, width=400, height=400)
    picture = render(head, camera, lighting=EVEN, samples=1)
    shares = torch.zeros(len(PARTS), 100, 100)
    shares[PARTS.index("skin")] = 1.0
    shares[PARTS.index("glasses")] = 0.3 + 0.02
    parts = FaceParts(shares, torch.tensor([[0.25, 0.0, 0.0], [0.0, 0.25, 0.0]]).double())
    settings = FitSettings(parts=[parts], texture_size=512, paint_hair=False)
    found = photographed_skin([head], None, [picture], [camera], settings).colors
    brow = FacePlaces.of(head).brow
    drawn = own_colors(head)[brow].mean(1)
    dark = drawn < drawn.median() - 0.15
    assert int(dark.sum()) >= 10
    assert float((found[brow].mean(1) - drawn)[dark].mean()) < 0.01


def test_strands_and_red_folds_are_nearer_to_the_skin_around_and_moles_stay() -> None:
    tone = torch.tensor([[0.78, 0.58, 0.48]]).double()
    strand, fold = torch.tensor([[0.12, 0.09, 0.07]]).double(), torch.tensor([[0.6, 0.15, 0.12]]).double()
    mole = tone * 0.8
    left = [(like_skin_around(one, tone, 0.8, 0.12) / tone).log()[0] for one in (strand, fold, mole)]
    assert float(left[0].mean()) > -0.8
    assert float(left[1].max() - left[1].min()) < 0.25
    assert float(left[2].mean()) == pytest.approx(math.log(0.8), abs=0.02)
