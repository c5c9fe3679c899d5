"""Hair that hangs beside the neck is found in what photographs show, and what stands behind the head is none."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import look_at
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.landmarks.images.networks.part_network import PARTS
from torchface.modeling import ImageFit
from torchface.modeling.photographs.hair_cap import hangs_down
from torchface.synthetic import neutral_head, performer
from torchface.synthetic.head.signed_distance import EYE_CENTRE
from torchface.synthetic.head.skin_texture import eye_color
from torchface.workflows.fit.fitted_character import dressed_rig, iris_size

SIZE, HAIR, SKIN = 128, PARTS.index("hair"), PARTS.index("skin")


def _shown(yaw: float) -> tuple[Tensor, Tensor, Tensor]:
    """Landmarks (68,2), and the columns and rows of a crop, (S,S) each, in widths between the outer corners of the eyes
    about the mouth."""
    head = neutral_head(texture=False)
    camera = look_at(head.vertices[head.landmarks].mean(0), yaw, span=330.0, width=SIZE, height=SIZE)
    marks = camera.project(head.vertices[head.landmarks].double())
    mouth, unit = marks[48:].mean(0), (marks[45] - marks[36]).norm()
    y, x = torch.meshgrid(*(torch.arange(SIZE, dtype=torch.float64),) * 2, indexing="ij")
    return marks, (x - mouth[0]) / unit, (y - mouth[1]) / unit


def _parts(hair: Tensor) -> FaceParts:
    number = torch.where(hair, HAIR, SKIN)
    shares = torch.nn.functional.one_hot(number, len(PARTS)).permute(2, 0, 1).float()
    return FaceParts(shares, torch.eye(2, 3, dtype=torch.float64))


def test_long_hair_hangs_and_short_hair_does_not() -> None:
    marks, x, y = _shown(0.0)
    cap = (y < -1.6) & (x.abs() < 1.2)
    long = cap | ((x.abs() > 0.5) & (x.abs() < 1.2) & (y < 1.0))
    assert hangs_down([_parts(long)], marks[None])
    assert not hangs_down([_parts(cap)], marks[None])


def test_what_is_not_one_with_the_hair_on_the_head_is_none() -> None:
    marks, x, y = _shown(0.0)
    cap = (y < -1.6) & (x.abs() < 1.2)
    beside = (x > 0.5) & (x < 1.2) & (y > -0.8)  # someone's dark coat
    assert not hangs_down([_parts(cap | beside)], marks[None])
    curtain = (x > 0.7) & (x < 1.4)  # as high as the picture
    assert not hangs_down([_parts((cap & (x < 0.6)) | curtain)], marks[None])


@pytest.mark.parametrize("yaw", [-50.0, 50.0])
def test_of_a_turned_face_the_near_side_counts(yaw: float) -> None:
    marks, x, y = _shown(yaw)
    near = float(torch.sign((marks[30] - marks[[0, 16]].mean(0))[0])) * -1
    cap = y < -1.4
    wall, hair = cap | (x * near < -0.4), cap | (x * near > 0.4)
    assert not hangs_down([_parts(wall)], marks[None])
    assert hangs_down([_parts(hair)], marks[None])
    unseen = marks.clone()
    unseen[slice(0, 4) if near > 0 else slice(13, 17)] = torch.nan
    assert not hangs_down([_parts(wall)], unseen[None])


@pytest.mark.parametrize("colors", [True, False])
def test_teeth_are_as_bright_as_photographed_and_grey_in_black_and_white(
    colors: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchface.workflows.fit.fitted_character._SIZE", 256)  # painting a skin takes seconds
    actor = performer(texture=False).select(["jawOpen"])
    number = torch.full((SIZE, SIZE), SKIN)
    number[90:100, 50:80] = PARTS.index("teeth")
    shares = torch.nn.functional.one_hot(number, len(PARTS)).permute(2, 0, 1).float()
    image = torch.tensor([0.8, 0.6, 0.5] if colors else [0.6, 0.6, 0.6])[:, None, None].repeat(1, SIZE, SIZE)
    image[:, number == PARTS.index("teeth")] = 0.5
    image[:, :8] = 1.0  # well exposed
    photographed = ImageFit(
        actor.neutral, (), *torch.zeros(2, 1, 0), (), *torch.zeros(2, 1, 68, 2), 0.0, torch.zeros(0, 0)
    )
    parts = [FaceParts(shares, torch.eye(2, 3, dtype=torch.float64))]
    made = dressed_rig(actor, actor, photographed, [image], parts, torch.zeros(1, 68, 2), True).rig.neutral
    in_front = made.annotations.regions["teeth_upper"] & (made.vertices[:, 0].abs() < 8)  # cheeks shade the others
    teeth = in_front[made.faces].all(1)
    at = made.uvs[made.uv_faces[teeth]].mean(1)
    size = made.texture.shape[-1]
    shown = made.texture[:, ((1 - at[:, 1]) * size).long(), (at[:, 0] * size).long()]
    assert abs(float(shown.mean()) - 0.5) < 0.06
    assert bool((made.texture == made.texture[:1]).all()) != colors
    assert "hair" not in made.regions
    covered = dressed_rig(actor, actor, photographed, [image], parts, torch.zeros(1, 68, 2), True, True).rig.neutral
    assert "hair" in covered.regions


def test_a_head_with_a_rig_of_its_own_is_grey_in_black_and_white_also_in_the_mouth() -> None:
    actor = performer().select(["jawOpen"])
    parts = [FaceParts(torch.zeros(len(PARTS), SIZE, SIZE), torch.eye(2, 3, dtype=torch.float64))]
    head = replace(actor.neutral, colors=torch.tensor([0.7, 0.4, 0.4]).repeat(len(actor.neutral.vertices), 1))
    photographed = ImageFit(head, (), *torch.zeros(2, 1, 0), (), *torch.zeros(2, 1, 68, 2), 0.0, torch.zeros(0, 0))
    for tint, grey in ((0.6, True), (0.4, False)):
        image = torch.tensor([0.6, 0.6, tint])[:, None, None].repeat(1, SIZE, SIZE)
        made = dressed_rig(actor, actor, photographed, [image], parts, torch.zeros(1, 68, 2), False).rig.neutral
        assert bool((made.texture == made.texture[:1]).all()) == grey
        assert bool((made.colors == made.colors[:, :1]).all()) == grey


@pytest.mark.parametrize("scale", [0.85, 1.0])
def test_irises_are_as_wide_as_peoples_on_eyeballs_of_any_size(scale: float) -> None:
    head = neutral_head()
    smaller = head.with_vertices(scale * head.vertices)
    ball = smaller.vertices[head.annotations.regions["eyeball_left"]]
    radius = 0.5 * float(ball[:, 0].max() - ball[:, 0].min())
    polar = torch.linspace(0, 0.8, 800)
    across = torch.stack([polar.sin(), torch.zeros(800), polar.cos()], dim=1)
    colors = eye_color(torch.tensor(EYE_CENTRE) + radius * across, iris_size=iris_size(smaller))
    edge = float(polar[(colors.mean(1) < 0.5).nonzero().amax()])
    assert 2 * radius * math.sin(edge) == pytest.approx(11.7, abs=0.4)
