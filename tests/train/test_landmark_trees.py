"""The recipe end to end: iBUG folders, dlib's XML, rendered performers, a killed run, bad input."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import zoo
from torchface.errors import FileFormatError, TorchfaceError
from torchface.landmarks import LandmarkTrees, TreeSettings
from torchface.landmarks.images.ibug_68 import box_around
from torchface.rendering.compositing import save_rendered_image
from train import landmark_trees as recipe
from train.annotated_faces import Faces, load_faces, rendered_faces
from train.landmark_trees import Settings, evaluate, train
from train.people_split import held_out_people
from train.rendered_people.portraits import FaceImage, FaceImageSettings, face_images

FEW = TreeSettings(cascades=3, trees=15, depth=3, features=80, test_splits=10, oversampling=6, components=10)


@pytest.fixture(scope="module")
def pictures() -> list[FaceImage]:
    return list(face_images(9, 5, FaceImageSettings(yaw=8, each=9, smallest=100, largest=120)))


@pytest.fixture(scope="module")
def folder(pictures: list[FaceImage], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pictures as iBUG keeps them, one in a folder below, and as dlib does."""
    path = tmp_path_factory.mktemp("faces")
    (path / "more").mkdir()
    entries = []
    for number, picture in enumerate(pictures):
        name = f"{'more/' if number == 8 else ''}face{number}"
        save_rendered_image(picture.image.float().expand(3, -1, -1) / 255, path / f"{name}.png")
        rows = "\n".join(f"{x + 1} {y + 1}" for x, y in picture.landmarks.tolist())
        (path / f"{name}.pts").write_text(f"version: 1\nn_points: 68\n{{\n{rows}\n}}\n")
        parts = "".join(
            f'<part name="{i:02d}" x="{round(x)}" y="{round(y)}"/>'
            for i, (x, y) in enumerate(picture.landmarks.tolist())
        )
        entries.append(f'<image file="{name}.png"><box left="9" top="9" width="50" height="50">{parts}</box></image>')
    (path / "faces.xml").write_text(f"<dataset><images>{''.join(entries)}</images></dataset>")
    return path


def placed_alike(faces: Faces, pictures: list[FaceImage]) -> Tensor:
    """How far landmarks lie from the pictures' own once the crop is undone, in grey and in place."""
    away = []
    for image, box, points, picture in zip(faces.images, faces.boxes, faces.landmarks, pictures, strict=True):
        shift = (points - picture.landmarks).mean(0).round()
        high, wide = image.shape
        x, y = (-shift).long().tolist()
        assert (image.int() - picture.image[y : y + high, x : x + wide].int()).abs().max() <= 1
        torch.testing.assert_close(box, box_around(points))
        away.append((points - picture.landmarks - shift).abs().max())
    return torch.stack(away)


def test_folders_and_dlib_files_give_the_same_faces(folder: Path, pictures: list[FaceImage]) -> None:
    assert placed_alike(load_faces(folder), pictures).max() < 1e-3
    assert placed_alike(load_faces(folder / "faces.xml"), pictures).max() < 1.0  # whole pixels


def test_large_pictures_are_made_smaller_with_their_landmarks(folder: Path, tmp_path: Path) -> None:
    image = torch.zeros(3, 1500, 1500)
    points = torch.stack([200 + 15.0 * (torch.arange(68) % 9), 300 + 120.0 * (torch.arange(68) // 9)], dim=1)
    image[:, points[40, 1].long(), points[40, 0].long()] = 1.0  # one white pixel
    save_rendered_image(image, tmp_path / "large.png")
    rows = "\n".join(f"{x + 1} {y + 1}" for x, y in points.tolist())
    (tmp_path / "large.pts").write_text(f"version: 1\nn_points: 68\n{{\n{rows}\n}}\n")
    (tmp_path / "._hidden.pts").write_bytes(b"\0\5\x16\7Mac OS X")
    faces = load_faces(tmp_path)
    assert 239 < float(faces.boxes[0, 2]) < 241
    white = faces.images[0].flatten().argmax()
    found = torch.tensor([white % faces.images[0].shape[1], white // faces.images[0].shape[1]])
    assert (found - faces.landmarks[0, 40]).abs().max() <= 1.0


def test_the_recipe_learns_from_a_folder_and_goes_on_where_it_was_killed(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = Settings(data=(folder, folder / "faces.xml"), out=tmp_path / "faces", held_out=4, trees=FEW)
    lines: list[str] = []
    model, errors = train(settings, lambda step, *_: lines.append(step))
    assert len(errors) == 8  # the last four pictures, from both
    mean = LandmarkTrees(cascades=1, trees=1, depth=1, features=2, components=1)
    mean.mean.copy_(model.mean)
    learned = (load_faces(folder) + load_faces(folder / "faces.xml")).some([*range(5), *range(9, 14)])
    assert evaluate(model, learned).mean() < 0.8 * evaluate(mean, learned).mean()
    record = zoo.describe(tmp_path / "faces")
    assert record.metrics["median error, %"] == pytest.approx(100 * float(errors.median()))
    assert "--trees.cascades 3" in record.recipe
    assert "performer" not in record.data
    assert record.licence == "that of the data"  # other people's photographs are not ours to license
    assert "10 faces to learn from, 8 to test on" in lines
    assert not settings.work.exists()

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    other = replace(settings, out=tmp_path / "again")
    monkeypatch.setattr(recipe, "_save", killed)
    with pytest.raises(KeyboardInterrupt):
        train(other)
    assert (other.work / "checkpoint.safetensors").exists()
    monkeypatch.undo()
    lines.clear()
    again, _ = train(other, lambda step, *_: lines.append(step))
    assert not [line for line in lines if "trees" in line]  # all of them came from the checkpoint
    for name, value in model.state_dict().items():
        assert torch.equal(value, again.state_dict()[name])


def test_performers_are_learned_from(tmp_path: Path) -> None:
    small = FaceImageSettings(smallest=90, largest=100)
    settings = Settings(performers=4, out=tmp_path / "made_up", held_out=2, trees=FEW, images=small)
    _, errors = train(settings)
    assert len(errors) == 2
    record = zoo.describe(tmp_path / "made_up")
    assert record.data == "4 rendered images of the embedded performer; no person's face."
    assert record.licence == "MIT"
    assert "--images.smallest 90" not in record.recipe  # the default
    assert "--images.largest 100" in record.recipe
    once = rendered_faces(3, 8, small)
    twice = list(face_images(1, 8, small)) + list(face_images(1, 8, small, first=1))
    assert all(torch.equal(a, b) for a, b in zip(once.images, [picture.image for picture in twice], strict=False))
    assert torch.equal(once.landmarks[:2], torch.stack([picture.landmarks for picture in twice]))


def test_bad_input_is_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(TorchfaceError, match="neither data nor performers"):
        train(Settings())
    with pytest.raises(TorchfaceError, match="9 faces, expected more than the 9 held out"):
        train(Settings(data=(folder,), held_out=9, out=tmp_path / "x"))
    with pytest.raises(FileFormatError, match=r"no folder and no \.xml"):
        load_faces(tmp_path / "nothing")
    with pytest.raises(FileFormatError, match="no face with 68 landmarks"):
        load_faces(tmp_path)
    (tmp_path / "alone.pts").write_text((folder / "face0.pts").read_text())
    with pytest.raises(FileFormatError, match=r"alone\.pts: found no image"):
        load_faces(tmp_path)
    text = (folder / "faces.xml").read_text().replace("face0.png", "../face0.png")
    (tmp_path / "outside.xml").write_text(text)
    with pytest.raises(FileFormatError, match="in the same folder"):
        load_faces(tmp_path / "outside.xml")


def test_landmarks_lie_in_box_and_picture(pictures: list[FaceImage]) -> None:
    """Brows, nose, eyes and mouth lie in the box, and the jaw in the picture."""
    for picture in face_images(4, 31, FaceImageSettings(yaw=5, pitch=3, smallest=200, largest=220)):
        grey, points = picture.image.float(), picture.landmarks
        assert picture.image.dtype == torch.uint8
        x, y = points[[31, 35, 3, 13]].round().long().unbind(1)
        assert bool((x >= 0).all() and (y >= 0).all() and (x < grey.shape[1]).all() and (y < grey.shape[0]).all())
        inner = points[17:]
        box = picture.box
        assert bool((inner >= box[:2]).all() and (inner <= box[:2] + box[2:]).all())
    assert {picture.person for picture in pictures} == {0}


def test_pictures_of_a_person_are_not_divided(folder: Path) -> None:
    """As folders of people have them, and with mirrored copies, which show the same person."""
    assert held_out_people(["anna", "ben", "ben", "anna", "carl"], 1) == ([0, 1, 2, 3], [4])
    assert held_out_people(["anna", "ben", "ben", "carl", "anna"], 1) == ([1, 2, 3], [0, 4])
    assert held_out_people(["anna", "ben"], 0) == ([0, 1], [])
    assert held_out_people(["anna", "ben"], 9) == ([], [0, 1])
    assert len(set(load_faces(folder).people)) == len(load_faces(folder))
    assert len(set(load_faces(folder, folders_are_people=True).people)) == 2
