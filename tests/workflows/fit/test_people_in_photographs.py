"""Two people, another photograph's landmarks, a dark or a grey picture: none passes without a word."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from torchface import Mesh, load_rig, zoo
from torchface.errors import AlignmentError
from torchface.geometry.cameras.pinhole import look_at
from torchface.io import load_identity_modes, load_image, save_image
from torchface.io.video import open_video, write_video
from torchface.modeling import FitSettings, HeadModel, ImageFit, MorphableModel, fit_images
from torchface.progress import silent
from torchface.rig import BlendshapeRig
from torchface.synthetic import draw_identities, performer
from torchface.workflows.fit import fit_checks, photograph_rig
from torchface.workflows.fit.fit_checks import ALONE, one_person_lines
from torchface.workflows.fit.fit_landmarks import landmarks_of
from torchface.workflows.fit.photograph_rig import PhotographSettings, fit_photographs
from torchface.workflows.fit.picture_checks import picture_lines
from torchface.workflows.fit.video_pictures import video_pictures
from torchface.workflows.named_heads import load_head_model, matching

HEAD = FitSettings(texture_size=0, transfers=0, match_skin=False)
"""Of a head alone, of which remarks and verdicts speak."""

PEOPLE = ("einstein.jpg", "lfpw_1.png", "lfpw_2.png", "takeo.ppm")
"""The second and third are one woman."""


@dataclass(frozen=True, eq=False)
class People:
    """A model of people, and photographs with their landmarks."""

    model: Path
    photographs: list[Path]
    heads: HeadModel
    rig: BlendshapeRig

    def remarks(self, *which: int, insist: bool = False) -> list[str]:
        photographs = [self.photographs[i] for i in which]
        marks = torch.stack(landmarks_of(photographs, [path.with_suffix(".pts") for path in photographs]))
        sizes = [load_image(path).shape[:0:-1] for path in photographs]

        def bare(points: Tensor, rows: list[int]) -> ImageFit:
            return fit_images(self.heads, self.rig, points, [sizes[row] for row in rows], settings=ALONE)

        alone = [bare(marks[i : i + 1], [i]) for i in range(len(marks))]
        return one_person_lines(photographs, marks, alone, bare, insist)


@pytest.fixture(scope="module")
def people(data: Path, ict_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> People:
    modes, rig = load_identity_modes(ict_folder, part="face"), load_rig(ict_folder, part="face")
    sizes = modes.deltas.flatten(1).norm(dim=1)
    heads = HeadModel.on(rig.neutral, MorphableModel(rig.vertices, modes.deltas / sizes[:, None, None], sizes), rig=rig)
    model = tmp_path_factory.mktemp("models") / "people"
    zoo.save_model(heads, model, zoo.ModelCard("MIT", "ICT", {}, "none"))
    return People(model, [data / "images" / "people" / name for name in PEOPLE], heads, rig)


@pytest.fixture(scope="module", autouse=True)
def template_shapes() -> Iterator[None]:
    """No test here looks at the shapes or the rig's file, which take half the time: the template's are not moved."""

    def unmoved(rig: BlendshapeRig, mesh: Mesh, **_: object) -> SimpleNamespace:
        report = SimpleNamespace(summary=lambda: "")
        return SimpleNamespace(rig=BlendshapeRig(mesh, rig.deltas, rig.names), report=report)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(photograph_rig, "transfer_with_report", unmoved)
        patch.setattr(photograph_rig, "save_rig", lambda *_: None)
        yield


@pytest.mark.bench
@pytest.mark.real
def test_two_people_do_not_merge_without_a_word(people: People, tmp_path: Path) -> None:
    photographs, out = [people.photographs[0], people.photographs[3]], tmp_path / "rig.glb"
    marks = [path.with_suffix(".pts") for path in photographs]
    with pytest.raises(AlignmentError, match=r"shows another person than the rest.*einstein\.jpg [012]%, .*--insist"):
        fit_photographs(photographs, marks, people.model, out)
    assert not out.exists()
    assert any("may show different people" in line for line in people.remarks(0, 3, insist=True))
    for stranger in (0, 3):
        for known in (1, 2):
            assert any("may show different people" in line for line in people.remarks(stranger, known, insist=True))
    assert people.remarks(1, 2) == []
    with pytest.raises(AlignmentError, match=r"einstein\.jpg: shows another person"):
        people.remarks(0, 1, 2)


@pytest.mark.bench
@pytest.mark.real
def test_given_landmarks_that_do_not_fit_are_said(people: People, tmp_path: Path) -> None:
    photograph = people.photographs[3]
    files = [photograph.with_suffix(".pts")]
    made = fit_photographs(
        [photograph], files, people.model, tmp_path / "rig.glb", PhotographSettings(fit=FitSettings(texture_size=0))
    )
    assert len(made.remarks) == 2
    assert "takeo.ppm: no colours" in made.remarks[0]
    assert "takeo.ppm: the given landmarks do not fit well" in made.remarks[1]
    assert "those that landmark_network finds have" in made.remarks[1]
    assert made.remarks[1] in made.lines()
    fits = replace(made, fit=replace(made.fit, residuals=torch.zeros_like(made.fit.residuals)), remarks=())
    assert fits.verdict().startswith("result: good, eyes, nose and mouth lie 0.0%")
    eyes = replace(made, fit=replace(made.fit, iris=torch.full((3,), 0.25)))
    assert "irises: #404040, their brightness in the photographs, which show no colours" in eyes.lines()
    assert "irises: #404040, their colour in the photographs" in replace(eyes, grey=False).lines()
    warned = replace(fits, remarks=("WARNING: takeo.ppm: the mouth hidden", "note: dark"))
    assert warned.verdict().startswith("result: partly usable")
    assert "; 1 warning below; " in warned.verdict()
    assert replace(fits, dark=True).verdict().startswith("result: poor, too dark to show the skin's colour")
    named = replace(fits, remarks=("WARNING: too dark room.jpg: the mouth hidden",))
    assert named.verdict().startswith("result: partly usable")


@pytest.mark.real
def test_a_dark_photograph_makes_a_poor_result(data: Path, tmp_path: Path) -> None:
    folder, settings = data / "images" / "people", PhotographSettings(fit=HEAD, focal=700.0)
    save_image(0.2 * load_image(folder / "lfpw_2.png"), tmp_path / "a.png")
    made = fit_photographs([tmp_path / "a.png"], [folder / "lfpw_2.pts"], None, tmp_path / "rig.glb", settings)
    assert made.verdict().startswith("result: poor, too dark to show"), made.verdict()


@pytest.mark.real
def test_a_grey_photograph_is_warned_of_and_is_not_dark_though_its_name_says_so(data: Path, tmp_path: Path) -> None:
    folder, settings = data / "images" / "people", PhotographSettings(fit=HEAD, focal=700.0)
    photograph, marks = load_image(folder / "lfpw_2.png"), [folder / "lfpw_2.pts"]
    path = tmp_path / "too dark room.png"
    save_image(photograph.mean(0).expand(3, -1, -1).contiguous(), path)
    made = fit_photographs([path], marks, None, tmp_path / "rig.glb", settings)
    assert not made.verdict().startswith("result: poor, too dark to show"), made.verdict()
    assert any("no colours: the skin is grey" in line for line in made.remarks), made.remarks
    assert not any(line.startswith("focal length: a guess") for line in made.lines())


@pytest.mark.real
def test_landmarks_of_another_photograph_make_a_poor_result(data: Path, tmp_path: Path) -> None:
    folder, settings = data / "images" / "people", PhotographSettings(fit=HEAD)
    made = fit_photographs([folder / "lfpw_1.png"], [folder / "lfpw_2.pts"], None, tmp_path / "rig.glb", settings)
    assert made.verdict().startswith("result: poor, the given landmarks are not on a face"), made.verdict()
    (line,) = made.remarks
    assert line.startswith("WARNING: lfpw_1.png: the given landmarks do not fit well")
    assert "expected less than 4.5%; landmark_network finds no face where the given landmarks lie" in line
    made = fit_photographs([folder / "lfpw_2.png"], [folder / "lfpw_1.pts"], None, tmp_path / "rig.glb", settings)
    assert made.verdict().startswith("result: poor, the given landmarks are not on a face")
    assert "no face where the given landmarks lie, but 1 elsewhere" in " ".join(made.remarks)


@pytest.mark.bench
@pytest.mark.real
def test_a_smile_does_not_make_another_person(data: Path, tmp_path: Path) -> None:
    """A man at rest and smiling in one film had probabilities of 7 % by form, and 42 % with colours."""
    frames = dict(enumerate(open_video(data / "video" / "single_face.mp4").color_frames()))
    photographs = [tmp_path / "rest.png", tmp_path / "smile.png"]
    for path, number in zip(photographs, (4, 54), strict=True):
        save_image(frames[number] / 255, path)
    settings = PhotographSettings(fit=HEAD)
    made = fit_photographs(photographs, [], "head", tmp_path / "rig.glb", settings)
    assert not any("different people" in line for line in made.remarks), made.remarks
    assert any(line.startswith("focal length: a guess") for line in made.lines())


@pytest.mark.real
def test_a_film_with_a_cut_to_another_person_is_warned_of(data: Path, tmp_path: Path) -> None:
    man, other = (
        list(islice(open_video(data / "video" / name).color_frames(), count))
        for name, count in (("single_face.mp4", 6), ("webcam/head_pose_male.gif", 2))  # the sharper half is fitted
    )
    height, width = other[0].shape[1:]
    small = torch.nn.functional.interpolate(torch.stack(man).float() / 255, (height, width), mode="area")
    film = write_video([small, torch.stack(other).float() / 255], tmp_path / "cut.mkv", 12.0)
    settings = PhotographSettings(fit=HEAD)
    made = fit_photographs([Path(film.path)], [], "head", tmp_path / "rig.glb", settings)
    assert any("may show different people" in line for line in made.remarks), made.remarks
    assert any(line.startswith("focal length: a guess") for line in made.lines())


@pytest.mark.real
def test_a_film_of_two_people_names_the_other(data: Path) -> None:
    _, rig = matching(load_head_model("head"))
    film, rest = data / "video" / "webcam" / "head_pose_two.gif", rig.vertices[rig.neutral.landmarks]
    pictures = video_pictures(film, rest, silent).found
    (line,) = (line for one in pictures for line in picture_lines(one) if "faces" in line)
    assert "the largest of 2 faces is taken, 1 more nearly as large (--face 1)" in line


def test_exact_landmarks_of_one_head_are_of_one_person() -> None:
    """As of a rendered head: what is left over is the model's form of it, and says nothing of another person."""
    heads, rig = matching(load_head_model("head"))
    person = performer(draw_identities(1, torch.Generator().manual_seed(3))[0], texture=False)
    smile = torch.zeros(1, len(person.names))
    smile[:, person.index(["mouthSmileLeft", "mouthSmileRight"])] = 0.7
    points = person(smile)[0][person.neutral.landmarks]
    cameras = [look_at(points.mean(0), yaw, span=300.0, width=464, height=580) for yaw in (-35.0, 0.0, 35.0)]
    marks = torch.stack([camera.project(points.double()) for camera in cameras])

    def bare(some: Tensor, rows: list[int]) -> ImageFit:
        return fit_images(heads, rig, some, [(464, 580)] * len(rows), settings=ALONE)

    alone = [bare(marks[i : i + 1], [i]) for i in range(3)]
    assert one_person_lines([Path(f"{i}.png") for i in range(3)], marks, alone, bare) == []


def test_like_heads_with_other_hair_and_lips_are_warned_of_and_not_refused() -> None:
    eye, one = torch.eye(3), torch.tensor([0.5, -1.0, 1.5])
    fit = SimpleNamespace(coefficients=one, covariance=0.02 * eye, errors=torch.ones(1), landmarks=torch.rand(1, 68, 2))
    names, marks = [Path("a.png"), Path("b.png")], torch.rand(2, 68, 2)
    like = torch.tensor([[-2.0, -1.5, 0.3, -0.1]]).double().expand(2, 4)
    other = torch.stack([like[0], torch.tensor([-0.3, -0.4, 0.0, 0.3]).double()])

    def lines(colors: Tensor | None) -> list[str]:
        return one_person_lines(names, marks, [fit, fit], lambda *_: fit, colors=colors)

    assert lines(None) == lines(like) == []
    (line,) = lines(other)
    assert "may show different people" in line
    assert "with the colours of hair, brows and lips a.png" in line


def test_many_pictures_with_the_errors_of_one_are_hardly_surer_of_the_head_than_it() -> None:
    """Independent errors would make them as sure as 40 are, alike ones at most as the inverse of their share."""
    eye, off = torch.eye(3), torch.tensor([0.6, -0.6, 0.6])
    one, odd = (SimpleNamespace(coefficients=at, covariance=0.1 * eye) for at in (0 * off, off))
    pair, crowd = fit_checks.same_person([odd, one]), fit_checks.same_person([odd, *[one] * 40])
    surer = SimpleNamespace(coefficients=0 * off, covariance=eye / (1 + 9 / 0.3))  # 9 is what 0.1 says beyond the prior
    assert fit_checks.same_person([odd, surer])[0] < crowd[0] < pair[0]


def test_a_line_that_only_frames_and_figures_tell_apart_is_said_once_with_their_count() -> None:
    of = "WARNING: {}: dark glasses hide {}% of the face"
    lines = [of.format("f_000001", 14), "note: f_000001: blurred", of.format("f_000009", 9), of.format("a.png", 13)]
    assert fit_checks.counted(lines, {"f_000001", "f_000009", "f_000011"}) == [
        "WARNING: 2 of 3 frames, such as f_000001: dark glasses hide 14% of the face", lines[1], lines[3]
    ]  # fmt: skip
    assert fit_checks.counted(["WARNING: only profiles"], {"f_000001"}) == ["WARNING: only profiles"]


def test_a_photograph_that_form_and_colours_call_another_persons_is_refused_beside_a_less_likely_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The form of the first speaks for it, so that its colours, which are the least likely, do not refuse it.
    form, colors = torch.tensor([0.5, -0.5, 3.0]).double(), torch.tensor([-6.0, -4.0, 0.0]).double()
    monkeypatch.setattr(fit_checks, "same_person", lambda fits: form[[one.row for one in fits]])
    monkeypatch.setattr(fit_checks, "color_evidence", lambda rows: colors[rows[:, 0].long()])
    fits = [SimpleNamespace(errors=torch.ones(1), landmarks=torch.rand(1, 68, 2), row=row) for row in range(3)]
    names, marks, shown = [Path(f"{i}.png") for i in range(3)], torch.rand(3, 68, 2), torch.arange(3.0)[:, None]

    def lines(insist: bool) -> list[str]:
        return one_person_lines(names, marks, fits, lambda *_: fits[0], insist, colors=shown)

    found = r"^1\.png: shows another person .*; the others, 0\.png, 2\.png, may show different people, too \("
    with pytest.raises(AlignmentError, match=found):
        lines(False)
    (line,) = lines(True)
    assert "may show different people" in line


def test_all_photographs_that_show_others_are_named() -> None:
    """Two of one person, and two other people: each is looked for beside what is left."""
    eye, ways = torch.eye(4, dtype=torch.float64), torch.tensor([[0, 0], [0, 0.1], [3, -3], [-4, 4]]).double()
    fits = [
        SimpleNamespace(
            coefficients=torch.cat([way, 1 - way]), covariance=0.02 * eye, errors=torch.ones(1),
            landmarks=torch.rand(1, 68, 2),
        )
        for way in ways
    ]  # fmt: skip
    names, marks = [Path(f"{i}.png") for i in range(4)], torch.rand(4, 68, 2)
    with pytest.raises(AlignmentError, match=r"^2\.png, 3\.png: show other people than the rest, .*; leave them out"):
        one_person_lines(names, marks, fits, lambda *_: fits[0])
    assert one_person_lines(names[:2], marks[:2], fits[:2], lambda *_: fits[0]) == []
