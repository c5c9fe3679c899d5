"""A performer is photographed, and the command makes a rig of the pictures that looks as the performer does."""

from pathlib import Path

import pytest
import torch
from PIL import Image

from planted.photographed_heads import aligned_error
from torchface import load_rig, save_rig, zoo
from torchface.cli import main
from torchface.color_space import to_linear
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, TopologyError, ValueRangeError
from torchface.geometry.cameras.pinhole import look_at
from torchface.io import load_calibration, load_image, load_landmark_points, save_image
from torchface.io.video import write_video
from torchface.landmarks import FaceReading, NoFaceError, find_faces
from torchface.modeling import FitSettings, HeadModel, MorphableModel, fit_images
from torchface.rendering.clay_shading import render
from torchface.rendering.gaussian_blur import gaussian_blur
from torchface.rig import BlendshapeRig
from torchface.synthetic import draw_identities, performer
from torchface.synthetic.head.identity import anatomy
from torchface.workflows.fit.fit_checks import ALONE, width_lines
from torchface.workflows.fit.fit_landmarks import PhotographLandmarks, check_inside, landmarks_of, warn_if_stored_turned
from torchface.workflows.fit.photograph_rig import PhotographSettings, fit_photographs
from torchface.workflows.named_heads import load_head_model, matching
from train.rendered_people.complexion import complexion_colors, draw_complexions

YAWS = (-35.0, 0.0, 35.0)
SHAPES = ["jawOpen", "mouthSmileLeft", "mouthSmileRight", "browInnerUp"]


@pytest.fixture(scope="module")
def actor() -> BlendshapeRig:
    return performer(draw_identities(1, torch.Generator().manual_seed(9))[0])


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory, actor: BlendshapeRig) -> Path:
    """A folder with a head model, three photographs of a smile and their landmarks."""
    folder = tmp_path_factory.mktemp("studio")
    generator = torch.Generator().manual_seed(0)
    heads = torch.stack([anatomy(who).vertices for who in draw_identities(60, generator)]).float()
    colors = complexion_colors(draw_complexions(30, generator))
    model = HeadModel.on(actor.neutral, MorphableModel.fit(heads, 15), MorphableModel.fit(colors, 4))
    template = performer().select(SHAPES)
    carrying = HeadModel.on(actor.neutral, model.shape, model.color, template)
    for name, saved in (("heads", model), ("heads_with_rig", carrying)):
        zoo.save_model(saved, folder / name, zoo.ModelCard("MIT", "performers", {}, "none"))
    save_rig(template, folder / "template.glb")
    weights = torch.zeros(1, len(actor.names))
    weights[0, actor.index(["mouthSmileLeft", "mouthSmileRight"])] = 0.7
    smiling = actor.neutral.with_vertices(actor(weights)[0])
    for i, yaw in enumerate(YAWS):
        camera = look_at(smiling.vertices[smiling.landmarks].mean(0), yaw, span=320.0, width=240, height=300)
        save_image(render(smiling, camera, background=(0.2, 0.3, 0.6), samples=1), folder / f"p{i}.png")
        marks = camera.project(smiling.vertices[smiling.landmarks].double()) + 1
        rows = "\n".join(f"{x:.3f} {y:.3f}" for x, y in marks.tolist())
        (folder / f"p{i}.pts").write_text(f"version: 1\nn_points: 68\n{{\n{rows}\n}}\n")
    return folder


def test_the_command_makes_the_actors_rig(
    studio: Path, actor: BlendshapeRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "rig.glb"
    photographs = [str(studio / f"p{i}.png") for i in range(3)]
    marks = [str(studio / f"p{i}.pts") for i in range(3)]
    rest = ["--model", str(studio / "heads"), "--template", str(studio / "template.glb"), "--out", str(out)]
    main(["fit", *photographs, "--landmarks", *marks, *rest, "--texture-size", "256", "--quiet"])
    printed = capsys.readouterr()
    assert str(out) in printed.out
    assert "mouthSmile" in printed.err
    for remark in ("different people", "another person", "do not fit well"):
        assert remark not in printed.err
    made = load_rig(out)
    assert list(made.names) == SHAPES
    assert made.neutral.annotations is not None
    skin = actor.neutral.annotations.regions["face"]
    mean = performer(texture=False)
    assert aligned_error(made.vertices[skin], actor.vertices[skin]) < 0.6 * aligned_error(
        mean.vertices[skin], actor.vertices[skin]
    )
    assert made.neutral.texture.shape == (3, 256, 256)
    blue = made.neutral.texture[2] > made.neutral.texture[0] + 0.15
    assert float(blue.float().mean()) < 0.01  # none of the background
    for i in range(3):
        sheet = load_image(tmp_path / f"rig_{i + 1}_p{i}.png")
        assert sheet.shape == (3, 480, 1440)
        seen, drawn = (to_linear(one)[:, 200:280, 200:280].mean(0).median() for one in (sheet, sheet[..., 480:960]))
        assert float(drawn / seen) == pytest.approx(1, abs=0.15)
        camera = load_calibration(tmp_path / f"rig_{i + 1}_p{i}.toml")
        assert (camera.width, camera.height) == load_image(studio / f"p{i}.png").shape[:0:-1]
        assert (camera.assumed, camera.guessed) == (False, True)


def test_landmarks_that_no_file_gives_are_found(
    studio: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "rig.glb"
    rest = ["--model", str(studio / "heads"), "--template", str(studio / "template.glb"), "--texture-size", "0"]
    main(["fit", str(studio / "p1.png"), *rest, "--out", str(out), "--quiet"])
    printed = capsys.readouterr()
    assert "p1.png: landmarks found by landmark_network in the face at" in printed.err
    assert "confidence 0." in printed.err
    written = tmp_path / "rig_1_p1.pts"
    assert str(written) in printed.out
    found, true = load_landmark_points(written).ibug(), load_landmark_points(studio / "p1.pts").ibug()
    assert (found - true).norm(dim=1).mean() < 0.05 * (true[36] - true[45]).norm()
    assert list(load_rig(out).names) == SHAPES


def test_photographs_without_a_face_are_said(studio: Path, tmp_path: Path) -> None:
    save_image(torch.full((3, 120, 160), 0.4), tmp_path / "wall.png")
    template, out = studio / "template.glb", tmp_path / "rig.glb"
    with pytest.raises(NoFaceError, match=r"wall\.png: found no face, expected one at least; .* with --landmarks"):
        fit_photographs([tmp_path / "wall.png"], [], studio / "heads", out, PhotographSettings(template=template))
    with pytest.raises(NoFaceError, match=r"p1\.png: found 1 face, expected more than 1"):
        fit_photographs([studio / "p1.png"], [], studio / "heads", out, PhotographSettings(template=template, face=1))
    with pytest.raises(NameMismatchError, match="a HeadModel, expected a LandmarkTrees"):
        fit_photographs(
            [studio / "p1.png"],
            [],
            studio / "heads",
            out,
            PhotographSettings(template=template, landmark_model=studio / "heads"),
        )
    with pytest.raises(FileFormatError, match=r"head\.glb: found a mesh, expected photographs; torchface rig"):
        fit_photographs([tmp_path / "head.glb"], [], studio / "heads", out)
    with pytest.raises(FileFormatError, match="found a folder, expected photographs, by name"):
        fit_photographs([tmp_path], [], studio / "heads", out)
    assert not out.exists()


def test_unsure_landmarks_are_left_out(studio: Path) -> None:
    points = torch.linspace(10, 60, 68)[:, None].expand(-1, 2).clone()
    points[3] = torch.tensor([-4.0, 20.0])
    confidence = torch.full((68,), 0.8)
    confidence[60:] = 0.05
    box, sure = torch.tensor([10.0, 10, 60, 60]), torch.ones(68)
    face = FaceReading.of_confidence(points, confidence, sure, sure[0], box)
    boxes = torch.tensor([[200.0, 5, 80, 80], [10, 10, 60, 60]])
    found = PhotographLandmarks(Path("a.png"), "face_landmarks", face, 1, boxes, (300, 100))
    assert found.confident.isnan().any(1).nonzero()[:, 0].tolist() == [3, *range(60, 68)]
    assert "lowest at the mouth with 0.50; 9 left out" in found.lines()[0]
    assert found.lines()[1] == "  number 1 of 2 faces; others with --face 0: at (200, 5)"
    unsure = FaceReading.of_confidence(points, torch.full((68,), 0.1), sure, sure[0], box)
    kept = PhotographLandmarks(Path("a.png"), "face_landmarks", unsure, 0, boxes[:1], (300, 100)).confident
    assert kept.isnan().any(1).nonzero()[:, 0].tolist() == [3]


def test_a_rig_that_travels_with_the_model_needs_no_template(studio: Path) -> None:
    """The fit gets the same rig: a video is fitted so below."""
    _, plain = matching(load_head_model(studio / "heads"), studio / "template.glb")
    _, own = matching(load_head_model(studio / "heads_with_rig"))
    assert own.names == tuple(SHAPES)
    torch.testing.assert_close(own.deltas, plain.deltas, rtol=0, atol=0.01)


@pytest.mark.bench
def test_a_face_alone_is_fitted_as_the_head_is(studio: Path, tmp_path: Path) -> None:
    skin = performer(texture=False).neutral.annotations
    whole, face = (
        fit_photographs(
            [studio / "p1.png"],
            [studio / "p1.pts"],
            studio / "heads_with_rig",
            tmp_path / f"{part}.glb",
            PhotographSettings(fit=FitSettings(texture_size=0), part=part),
        ).rig
        for part in (None, "face")
    )
    assert len(face.vertices) == int(skin.regions["face"].sum())
    assert aligned_error(face.vertices, whole.vertices[skin.regions["face"]]) < 0.5


def test_a_model_of_a_part_says_which_part_of_the_template_it_meets(studio: Path) -> None:
    template = performer(texture=False)
    heads = load_head_model(studio / "heads").part(template.neutral.annotations.regions["face"])
    with pytest.raises(TopologyError, match=r"found 6419 vertices .*; try --part face"):
        matching(heads, studio / "template.glb")
    model, rig = matching(heads, studio / "template.glb", "face")
    assert model is heads
    assert len(rig.vertices) == len(heads.shape.mean)


def dlib_xml(path: Path, faces: list[tuple[str, int]]) -> Path:
    boxes = "".join(
        f"<image file='{name}'><box top='1' left='{k}' width='9' height='9'>"
        + "".join(f"<part name='{n:02d}' x='{n + k}' y='{2 * n}'/>" for n in range(count))
        + "</box></image>"
        for k, (name, count) in enumerate(faces)
    )
    path.write_text(f"<dataset><images>{boxes}</images></dataset>")
    return path


def test_an_xml_tells_whose_face_is_meant(tmp_path: Path) -> None:
    photographs = [tmp_path / name for name in ("a.png", "b.png")]
    for path in photographs:
        save_image(torch.full((3, 60, 80), 0.5), path)
    file = dlib_xml(tmp_path / "faces.xml", [("x/a.png", 68), ("b.png", 68), ("b.png", 68), ("c.png", 5)])
    with pytest.raises(NameMismatchError, match=r"found 2 faces in b\.png, choose one of --face 0: at \(1, 1\), 1: at"):
        landmarks_of(photographs, [file])
    with pytest.raises(NameMismatchError, match=r"found 1 faces in a\.png, expected more than 1"):
        landmarks_of(photographs, [file], face=1)
    first, second = landmarks_of(photographs, [file], face=0)
    assert (float(first[0, 0]), float(second[0, 0])) == (0.0, 1.0)
    with pytest.raises(NameMismatchError, match=r"found no face in d\.png"):
        landmarks_of([Path("d.png")], [file])
    with pytest.raises(ShapeError, match=r"found 5 landmarks in c\.png, expected 68"):
        landmarks_of([Path("c.png")], [file])


def test_files_that_do_not_belong_together_are_named(studio: Path, tmp_path: Path, dome_rig: BlendshapeRig) -> None:
    photographs = [studio / f"p{i}.png" for i in range(3)]
    with pytest.raises(NameMismatchError, match="found 1 files for 3 photographs"):
        landmarks_of(photographs, [studio / "p0.pts"])
    (tmp_path / "space.pts").write_text("version: 1\nn_points: 68\n{\n" + "1 2 3\n" * 68 + "}\n")
    with pytest.raises(FileFormatError, match="three numbers each"):
        landmarks_of(photographs[:1], [tmp_path / "space.pts"])
    with pytest.raises(FileFormatError, match=r"expected \.glb"):
        fit_photographs(photographs, [], studio / "heads", tmp_path / "rig.obj")
    dome = HeadModel.on(dome_rig.neutral, MorphableModel(dome_rig.vertices, dome_rig.deltas[:1], torch.ones(1)))
    with pytest.raises(TopologyError, match="name a rig with --template"):
        matching(dome)


@pytest.mark.bench
@pytest.mark.real
def test_a_face_has_one_number_with_and_without_a_file(data: Path) -> None:
    folder = data / "images" / "dlib_faces"
    file, compared = folder / "training_with_face_landmarks.xml", 0
    for photograph in sorted(folder.glob("*.jpg"))[::3]:
        image = load_image(photograph)
        detected = find_faces((image * 255).to(torch.uint8))
        for number, box in enumerate(detected.boxes):
            points = landmarks_of([photograph], [file], number)[0]
            inside = ((points >= box[:2] - 0.3 * box[2:]) & (points <= box[:2] + 1.3 * box[2:])).all(1)
            if not bool(((points.mean(0) >= box[:2]) & (points.mean(0) <= box[:2] + box[2:])).all()):
                continue  # a face that the file does not label
            assert float(inside.double().mean()) > 0.9
            compared += 1
    assert compared >= 6


@pytest.mark.parametrize(("factor", "said"), [(1.0, ""), (0.75, "narrower"), (1.33, "wider")])
def test_a_squeezed_or_stretched_photograph_is_remarked_on(factor: float, said: str) -> None:
    heads, rig = matching(load_head_model("head"))
    points = rig.vertices[rig.neutral.landmarks].double()
    marks = look_at(points.mean(0), 5.0, span=300.0, width=464, height=580).project(points)[None]
    marks[..., 0] *= factor
    fit = fit_images(heads, rig, marks, (round(factor * 464), 580), settings=ALONE)
    lines = width_lines([Path("a.png")], [fit], heads, rig.neutral.landmarks)
    assert (len(lines), said in "".join(lines)) == (int(factor != 1), True)


def test_frames_of_a_video_are_fitted(studio: Path, tmp_path: Path) -> None:
    frames = [(load_image(studio / f"p{i}.png") * 255).round().to(torch.uint8) for i in (0, 0, 1, 1, 2, 2)]
    frames[1] = (255 * gaussian_blur(frames[0].float()[None] / 255, 3.0)[0]).to(torch.uint8)
    write_video(iter(frame[None] for frame in frames), tmp_path / "film.avi", 25.0)
    settings = PhotographSettings(fit=FitSettings(texture_size=0, transfers=0, match_skin=False))
    made = fit_photographs([tmp_path / "film.avi"], [], studio / "heads_with_rig", tmp_path / "rig.glb", settings)
    numbers = [int(path.name.removeprefix("film_")) for path in made.shown]
    assert len(numbers) >= 2
    assert 1 not in numbers  # it is blurred
    assert all(f"film_{number:06d}: expression" in " ".join(made.lines()) for number in numbers)
    assert load_rig(tmp_path / "rig.glb").names == tuple(SHAPES)


def test_landmarks_counted_before_the_photograph_was_turned_are_refused() -> None:
    """A phone stores 4032 x 3024 pixels of a portrait that is 3024 x 4032."""
    columns, rows = torch.meshgrid(torch.linspace(1200, 1800, 17), torch.linspace(3100, 3900, 4), indexing="ij")
    upright = torch.stack([columns, rows], dim=-1).reshape(1, 68, 2)
    check_inside([Path("phone.jpg")], upright, [(3024, 4032)])
    stored = torch.stack([upright[..., 1], 3023 - upright[..., 0]], dim=-1)
    with pytest.raises(ValueRangeError, match=r"phone.jpg: found 68 of 68 landmarks outside its 3024 x 4032 pixels"):
        check_inside([Path("phone.jpg")], stored, [(3024, 4032)])


def test_a_photograph_that_was_stored_turned_is_warned_of(tmp_path: Path) -> None:
    orientation = Image.Exif()
    orientation[0x0112] = 6
    Image.new("RGB", (8, 6)).save(tmp_path / "phone.jpg", exif=orientation)
    with pytest.warns(UserWarning, match=r"phone\.jpg.*EXIF orientation 6"):
        warn_if_stored_turned(tmp_path / "phone.jpg")
