"""What makes a photograph unfit for a likeness is said with its figure; what is hardly a face is refused."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw, ImageFilter, ImageOps
from torch import Tensor

from torchface.color_space import to_linear, to_srgb
from torchface.geometry.cameras.pinhole import look_at
from torchface.landmarks import FaceReading, NoFaceError
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.landmarks.images.networks.part_network import PARTS
from torchface.modeling import ImageFit
from torchface.synthetic import neutral_head
from torchface.workflows.fit.fit_checks import strange_lines
from torchface.workflows.fit.fit_landmarks import PhotographLandmarks, find_in_photographs
from torchface.workflows.fit.picture_checks import (
    angle_lines,
    color_lines,
    cover_lines,
    edge_lines,
    forehead_lines,
    hat_lines,
    light_lines,
    picture_lines,
    without_hat,
)
from torchface.workflows.named_finders import part_finder


def skin() -> Tensor:
    """A picture of skin with grain, in brightness and in hue, 200 x 200."""
    grain = torch.randn(4, 200, 200, generator=torch.Generator().manual_seed(0))
    grain = 0.03 * grain[:1] + 0.015 * grain[1:]
    return (torch.tensor([0.78, 0.58, 0.48])[:, None, None] + grain).clamp(0, 1)


def painted(image: Tensor) -> Tensor:
    """Brushstrokes of one colour each, ten pixels wide."""
    return image[:, ::10, ::10].repeat_interleave(10, 1).repeat_interleave(10, 2)


def reading(eyes: float = 90.0) -> FaceReading:
    """A face in its middle, so many pixels between the outer corners of its eyes."""
    points = torch.full((68, 2), 100.0)
    points[[0, 16, 8, 24]] = 100 + eyes * torch.tensor([[-0.8, 0.0], [0.8, 0.0], [0.0, 1.0], [0.0, -0.6]])
    points[[36, 45]] = 100 + eyes * torch.tensor([[-0.5, 0.0], [0.5, 0.0]])
    sure, both = torch.ones(68), torch.ones(2)
    return FaceReading(points, sure, sure, sure[0], points[[36, 45]], 0.3 * both, 0 * both, both)


def found(face: FaceReading) -> PhotographLandmarks:
    return PhotographLandmarks(Path("a.png"), "network", face, 0, face.box[None], (200, 200))


def bare() -> FaceParts:
    """Skin all over."""
    shares = torch.zeros(len(PARTS), 200, 200)
    shares[PARTS.index("skin")] = 1.0
    return FaceParts(shares, torch.eye(2, 3, dtype=torch.float64))


def colored(image: Tensor) -> list[str]:
    return color_lines(Path("a.png"), image, bare(), reading().landmarks)


def test_a_face_that_is_shown_well_is_not_remarked_on() -> None:
    assert picture_lines(found(reading())) == colored(skin()) == []


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda image: image.mean(0).expand(3, -1, -1), "no colours"),
        (lambda image: (image * 4).round() / 4, "even patches with edges between them"),
        (lambda image: painted(image), "even patches with edges between them"),
        (lambda image: image.flip(0), "colours that skin has not in white light (red 0.83"),
        (lambda image: image * torch.tensor([0.82, 1.0, 1.2])[:, None, None], "blue 0.99 of green): a filter"),
        (lambda image: torch.full_like(image, 0.7), "a drawing, a statue"),
        (lambda image: image[:1] * torch.tensor([1.0, 0.8, 0.7])[:, None, None], "skin of one hue (it varies by 0.2%"),
        (lambda image: image.mean(0) + 0.3 * (image - image.mean(0)), "skin of one hue (it varies by 0.8%"),
    ],
)
def test_pictures_that_are_not_plain_photographs(change: Callable[[Tensor], Tensor], line: str) -> None:
    lines = colored(change(skin()))
    assert any(line in one and one.startswith("WARNING: a.png: ") for one in lines), lines


@pytest.mark.parametrize(
    ("eyes", "hair", "line"),
    [
        ((0.8, 0.72, 0.7), (0.15, 0.13, 0.1), None),
        ((0.8, 0.72, 0.78), (0.15, 0.13, 0.1), "whites of eyes that are violet or blue (blue 1.08 of green)"),
        ((0.8, 0.72, 0.7), (0.15, 0.18, 0.18), "dark hair that is greenish (red 0.84 of green)"),
    ],
)
def test_whites_of_eyes_and_hair_say_what_skin_does_not(
    eyes: tuple[float, ...], hair: tuple[float, ...], line: str | None
) -> None:
    image, parts = skin(), bare()
    for rows, name, color in ((slice(90, 96), "eyes", eyes), (slice(0, 20), "hair", hair)):
        image[:, rows] = torch.tensor(color)[:, None, None]
        parts.shares[:, rows] = 0
        parts.shares[PARTS.index(name), rows] = 1
    lines = color_lines(Path("a.png"), image, parts, reading().landmarks)
    assert len(lines) == (line is not None)
    assert line is None or line in lines[0]


def test_hidden_and_small_faces() -> None:
    face = reading()
    behind = replace(face, eye_visibility=torch.tensor([0.1, 0.05]))
    assert "the eyes hidden (visible to 8%" in picture_lines(found(behind))[0]
    masked = replace(face, visibility=torch.where(torch.arange(68) < 48, 1.0, 0.02))
    assert "the mouth hidden (visible to 2%" in picture_lines(found(masked))[0]
    both = replace(behind, visibility=masked.visibility)
    with pytest.raises(NoFaceError, match=r"a\.png: found eyes and mouth hidden .* --insist"):
        picture_lines(found(both))
    assert "eyes and mouth hidden" in picture_lines(found(both), insist=True)[0]
    assert "20 pixels between the eyes' outer corners" in picture_lines(found(reading(20.0)))[0]
    with pytest.raises(NoFaceError, match="found 8 pixels between the outer corners of the eyes, expected at least 10"):
        picture_lines(found(reading(8.0)))
    turned = replace(face, landmarks=200 - face.landmarks, deviation=torch.full((68,), 90.0))
    turned.landmarks[36:42] += torch.tensor([20.0, 0.0])
    with pytest.raises(NoFaceError, match=r"a face upside down \(roll angle 180°\).*expected an upright face \(0°\)"):
        picture_lines(found(turned))
    assert picture_lines(found(replace(turned, deviation=face.deviation))) == []
    with pytest.raises(NoFaceError, match=r"hardly a face \(likelihood 0\.20\)"):
        picture_lines(found(replace(face, presence=torch.tensor(0.2))))


def test_two_faces_of_one_size() -> None:
    face = reading()
    pair = replace(found(face), boxes=torch.stack([face.box, face.box]))
    assert "the largest of 2 faces is taken, 1 more nearly as large (--face 1)" in picture_lines(pair)[0]
    assert picture_lines(replace(pair, asked=True)) == []
    few = found(reading(25.0))
    crowd = replace(few, boxes=few.boxes.expand(7, 4))
    with pytest.raises(
        NoFaceError, match=r"found 7 faces, 7 of them of similar size, the largest 33 pixels .* --face .*6 at \("
    ):
        picture_lines(crowd)
    assert "25 pixels between" in picture_lines(replace(crowd, asked=True))[0]


@pytest.mark.parametrize(
    ("part", "least"), [("glasses", "dark glasses hide"), ("hand", "a hand hides"), ("cloth", "cloth (a mask?) hides")]
)
def test_what_stands_before_a_face_is_said_with_its_share(part: str, least: str) -> None:
    """A band of a square face: of a fifth of it there is a warning, of a fortieth there is none."""
    square = torch.tensor([[40.0, 40], [140, 40], [140, 140], [40, 140]]).repeat(17, 1).double()

    def lines(rows: int) -> list[str]:
        shares = torch.zeros(len(PARTS), 180, 180)
        shares[PARTS.index("skin")] = 1.0
        shares[PARTS.index("skin"), 60 : 60 + rows], shares[PARTS.index(part), 60 : 60 + rows] = 0.0, 1.0
        return cover_lines(Path("a.png"), FaceParts(shares, torch.eye(2, 3, dtype=torch.float64)), square)

    assert lines(0) == lines(2) == []
    assert lines(20) == [f"WARNING: a.png: {least} 20% of the face; its skin there is completed"]


def test_a_face_that_the_pictures_edge_cuts_is_no_face_behind_a_hand() -> None:
    marks = torch.full((68, 2), 50.0)
    assert edge_lines(Path("a.png"), (100, 100), marks) == []
    marks[:5, 0] = torch.tensor([-3.0, -0.4, 99.4, 99.6, torch.nan])
    (line,) = edge_lines(Path("a.png"), (100, 100), marks)
    assert "edge cuts off the face (2 of 68 landmarks" in line
    shares = torch.zeros(len(PARTS), 100, 100)
    shares[PARTS.index("hand")] = 1.0
    parts = FaceParts(shares, torch.eye(2, 3, dtype=torch.float64))
    square = torch.tensor([[20.0, 20.0], [20.0, 80.0], [80.0, 80.0], [80.0, 20.0]])
    assert cover_lines(Path("a.png"), parts, square)
    assert cover_lines(Path("a.png"), parts, square, cut=True) == []


def test_a_forehead_that_the_pictures_edge_cuts_is_remarked_on_whatever_the_tilt() -> None:
    marks = torch.full((68, 2), 60.0)
    marks[[8, 27, 36, 45]] = torch.tensor([[50.0, 95.0], [50.0, 40.0], [35.0, 42.0], [65.0, 42.0]])
    assert forehead_lines(Path("a.png"), (100, 100), marks) == []
    cut = marks - torch.tensor([0.0, 20.0])  # 20 pixels above the eyes
    for points in (cut, cut.flip(1), 99 - cut):
        (line,) = forehead_lines(Path("a.png"), (100, 100), points)
        assert "a.png: the picture's edge cuts off the forehead" in line


@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_a_hat_is_remarked_on_and_is_no_hair_whatever_the_tilt_and_a_fringe_is_hair(turn: float) -> None:
    """Over eyes 40 pixels apart: a hat's edge, locks that end 4 pixels apart, and hair 20 pixels over the brows."""
    y, x = torch.meshgrid(*(torch.arange(160, dtype=torch.float64) - 80,) * 2, indexing="ij")
    around = torch.tensor([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]]).double()
    marks = torch.zeros(68, 2).double()
    marks[17:27, 1] = -12.0
    marks[[36, 45], 0] = torch.tensor([-20.0, 20.0]).double()

    def parts(name: str, ends: Tensor) -> FaceParts:
        number = torch.where(y < ends, PARTS.index(name), PARTS.index("skin"))
        shares = torch.nn.functional.one_hot(number, len(PARTS)).permute(2, 0, 1).float()
        return FaceParts(shares, torch.cat([around.T, torch.full((2, 1), 80.0).double()], 1))

    def lines(name: str, ends: Tensor) -> list[str]:
        return hat_lines(Path("a.png"), parts(name, ends), marks @ around.T)

    straight, locks = torch.full_like(x, -16.0), -16 + 4 * (x % 8 < 4)
    (cloth,), (dark,) = lines("cloth", straight - 3), lines("hair", straight)
    assert "a.png: a hat or a hand hides the forehead (cloth or hand" in cloth
    assert "straight edge over the brows: a hat" in dark
    assert lines("hair", locks) == lines("hair", straight - 16) == []
    bare = without_hat(parts("hair", straight), marks @ around.T)
    assert float(bare.of("hair").sum()) == 0
    assert torch.equal(bare.of("skin"), parts("hair", straight).of("skin"))
    unknown = marks.clone()
    unknown[17:27] = torch.nan
    assert hat_lines(Path("a.png"), parts("hair", straight), unknown) == []


def test_landmarks_that_no_head_has_are_remarked_on() -> None:
    marks = reading().landmarks.expand(2, -1, -1).double()
    off = torch.tensor([2.0, 6.0])[:, None, None] * torch.tensor([1.0, 0.0]).expand(2, 68, 2)
    empty, camera = torch.zeros(0), look_at(torch.zeros(3), 0.0, width=200, height=200)
    fit = ImageFit(neutral_head(texture=False), (), empty, empty, (camera,) * 2, off, marks, 1.0, empty)
    lines = strange_lines([Path("man.png"), Path("cat.png")], fit)
    assert len(lines) == 1
    assert "cat.png: found landmarks lie 6.7% of the eyes' distance" in lines[0]


def remarks_on_angles(*yaws: float, pitch: float = 0.0) -> list[str]:
    """Of a head that is seen at these yaw angles, the last time from a pitch angle, degrees."""
    empty, marks = torch.zeros(0), torch.zeros(len(yaws), 68, 2)
    pitches = [0.0] * (len(yaws) - 1) + [pitch]
    cameras = tuple(
        look_at(torch.zeros(3), *angles, width=200, height=200) for angles in zip(yaws, pitches, strict=True)
    )
    return angle_lines(ImageFit(neutral_head(texture=False), (), empty, empty, cameras, marks, marks, 1.0, empty))


def test_profiles_alone_are_remarked_on() -> None:
    """A head seen from 70° to either side, beside a view from the front, and from 30°."""
    assert remarks_on_angles(30.0) == remarks_on_angles(70.0, 0.0) == []
    (line,) = remarks_on_angles(70.0, -70.0)
    assert "only profiles" in line
    assert "70°" in line
    assert "-70°" in line


@pytest.mark.parametrize(
    ("yaws", "words"),
    [
        ((-4.0, 0.0, 8.0), ("all 3 pictures", "-4° to 8°, 12° apart", "45° to either side")),
        ((30.0, 40.0), ("all 2 pictures", "30° to 40°, 10° apart", "45° to the other side")),
        ((-10.0, 12.0), ()),
        ((3.0,), ()),
    ],
)
def test_several_pictures_from_one_angle_are_remarked_on_once(yaws: tuple[float, ...], words: tuple[str, ...]) -> None:
    lines = remarks_on_angles(*yaws)
    assert len(lines) == bool(words)
    assert all(word in line for line in lines for word in words)


def test_a_view_from_below_shows_depth_too() -> None:
    assert remarks_on_angles(0.0, 0.0, pitch=-25.0) == []


def test_hidden_landmarks_do_not_count() -> None:
    face = reading()
    behind = replace(face, eye_visibility=torch.tensor([0.1, 0.05]))
    assert found(behind).confident.isnan().any(1).nonzero()[:, 0].tolist() == list(range(36, 48))
    masked = replace(face, visibility=torch.where(torch.arange(68) < 48, 1.0, 0.02))
    assert found(masked).confident.isnan().any(1).nonzero()[:, 0].tolist() == list(range(48, 68))


@pytest.mark.real
def test_a_photograph_that_is_spoilt(data: Path) -> None:
    """By code: glasses, a mask, no colours, few colours, few pixels."""
    plain = Image.open(data / "images" / "people" / "lfpw_1.png").convert("RGB")

    def seen(image: Image.Image) -> tuple[PhotographLandmarks, list[str]]:
        pixels = torch.from_numpy(np.asarray(image.convert("RGB")).copy()).permute(2, 0, 1).float() / 255
        one = find_in_photographs([Path("a.png")], [pixels])[0]
        parts = part_finder()((255 * pixels).byte(), one.confident)
        return one, picture_lines(one) + color_lines(Path("a.png"), pixels, parts, one.confident)

    whole, lines = seen(plain)
    assert lines == []
    marks = whole.face.landmarks
    eyes = float((marks[36] - marks[45]).norm())
    dark, masked = plain.copy(), plain.copy()
    for first in (36, 42):
        x, y = marks[first : first + 6].mean(0).tolist()
        box = (x - 0.3 * eyes, y - 0.22 * eyes, x + 0.3 * eyes, y + 0.25 * eyes)
        ImageDraw.Draw(dark).ellipse(box, fill=(15, 15, 18))
    cloth = [tuple(point) for point in [*marks[2:15].tolist(), marks[28].tolist()]]
    ImageDraw.Draw(masked).polygon(cloth, fill=(150, 190, 210))
    scale = 40 / float(whole.face.box[2])
    small = plain.resize((int(plain.width * scale), int(plain.height * scale)), Image.Resampling.LANCZOS)
    stone = ImageOps.autocontrast(plain.convert("L").filter(ImageFilter.GaussianBlur(eyes / 40)))
    for image, line in (
        (dark, "the eyes hidden"),
        (masked, "the mouth hidden"),
        (ImageOps.grayscale(plain), "no colours"),
        (Image.eval(stone, lambda value: int(90 + 0.45 * value)), "a statue"),
        (ImageOps.posterize(plain, 2), "a strong filter"),
        (small, "pixels between the eyes' outer corners"),
    ):
        assert any(line in one for one in seen(image)[1]), line


@pytest.mark.parametrize(
    ("right", "words"),
    [
        ((1.0, 1.0, 1.0), None),
        ((0.7, 0.7, 0.7), None),
        ((0.3, 0.3, 0.3), "a factor of 3.3 in brightness, 1.0 in blue over red"),
        ((0.9, 0.7, 0.45), "1.5 in brightness, 2.0 in blue over red"),
    ],
)
def test_light_from_one_side_is_remarked_on(right: tuple[float, ...], words: str | None) -> None:
    picture = to_linear(skin())
    picture[:, :, 100:] *= torch.tensor(right)[:, None, None]
    points = reading().landmarks
    points[36:42], points[42:48] = torch.tensor([70.0, 80.0]), torch.tensor([130.0, 80.0])
    points[36], points[45] = torch.tensor([55.0, 80.0]), torch.tensor([145.0, 80.0])
    points[48], points[54] = torch.tensor([75.0, 130.0]), torch.tensor([125.0, 130.0])
    shares = torch.zeros(len(PARTS), 100, 100)
    shares[PARTS.index("skin")] = 1.0
    parts = FaceParts(shares, torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.5, 0.0]], dtype=torch.float64))
    picture[:, :10] = 0.9  # something white
    lines, too_dark = light_lines(Path("too dark.png"), to_srgb(picture), parts, points)
    assert not too_dark
    assert [words in line for line in lines] == [True] if words else lines == []
    dim, too_dark = light_lines(Path("a.png"), to_srgb(0.3 * picture), parts, points)
    assert next(line for line in dim if "under-exposed" in line).startswith("note: a.png")
    assert not too_dark
    dark, too_dark = light_lines(Path("a.png"), to_srgb(0.05 * picture), parts, points)
    assert too_dark
    assert re.match(r"WARNING: a\.png: too dark: it shows 1/\d+ of the light .* expected at least 1/5; ", dark[0]), dark
    assert not any("too fair" in line for line in dark)
