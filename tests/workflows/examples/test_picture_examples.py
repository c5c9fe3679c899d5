"""``torchface examples``: from pictures in order or by name, from a video in place of a camera, from a rig."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface.capture.anybody import ExampleShapes, paper_examples, paper_expressions
from torchface.cli import main
from torchface.errors import NameMismatchError
from torchface.io import save_image, save_rig
from torchface.io.video import write_video
from torchface.landmarks import FaceReading, NoFaceError
from torchface.synthetic import performer
from torchface.workflows.examples import guided_session, picture_examples
from torchface.workflows.examples.guided_session import calmest, guided_examples

NAMES = [one.name for one in paper_expressions()]
STEP = 8  # grey levels between the pictures of two expressions: what stands for a face here


@pytest.fixture(scope="module")
def shapes() -> Tensor:
    """Landmarks of the 16, (16,68,2); nose and corners of the eyes still, as heads are brought together by them."""
    made = paper_examples(performer(texture=False))
    still = [*range(27, 36), 36, 39, 42, 45]
    stacked = torch.cat([made.neutral[None], made.landmarks])
    stacked[1:12, still] = stacked[0, still]
    return stacked


@pytest.fixture(autouse=True)
def finder(monkeypatch: pytest.MonkeyPatch, shapes: Tensor) -> None:
    """A finder that sees in a picture's level of grey which expression it is; half a level off the face jitters."""

    def seen(image: Tensor) -> FaceReading:
        level = float(image.float().mean()) / STEP - 1
        if round(level) < 0:
            return FaceReading.lost()
        number = min(round(level), 15)
        shake = 4 * abs(level - number) * torch.tensor([1.0, -1.0])[int(image.float().mean()) % 2]
        landmarks = shapes[number] + shake
        return FaceReading(landmarks, torch.zeros(68), torch.ones(68), torch.ones(()))

    class Tracker:
        def __init__(self, finder: object) -> None:
            pass

        def step(self, frame: Tensor) -> FaceReading:
            return seen(frame)

    def found(image: Tensor, finder: object) -> FaceReading:
        face = seen(image)
        if not face.found:
            raise NoFaceError("image: found nothing, expected a face")
        return face

    class Named:
        finder = None

    for module in (guided_session, picture_examples):
        monkeypatch.setattr(module, "load_finder", lambda *names, **more: Named())
    monkeypatch.setattr(guided_session, "LandmarkTracker", Tracker)
    monkeypatch.setattr(picture_examples, "find_landmarks", found)


def grey(number: float) -> Tensor:
    return torch.full((3, 8, 8), STEP * (number + 1) / 255)


def check(path: Path, shapes: Tensor) -> None:
    found = ExampleShapes.load(path).select(NAMES[1:])
    apart = found.landmarks - shapes[1:]
    assert apart[:11].abs().max() < 1e-2
    assert (apart[11:] - apart[11:].mean(1, keepdim=True)).abs().max() < 1e-2


def test_pictures_in_order_or_by_name(tmp_path: Path, shapes: Tensor) -> None:
    (tmp_path / "numbered").mkdir()
    (tmp_path / "named").mkdir()
    for number, name in enumerate(NAMES):
        save_image(grey(number), tmp_path / "numbered" / f"picture {number}.png")  # 10 after 9
        save_image(grey(number), tmp_path / "named" / f"{90 - number} {name.replace('_', '-').title()}.png")
    for folder in ("numbered", "named"):
        main(["examples", str(tmp_path / folder), "--out", str(tmp_path / f"{folder}.json"), "--quiet"])
        check(tmp_path / f"{folder}.json", shapes)
    files = sorted((tmp_path / "numbered").iterdir())
    with pytest.raises(NameMismatchError, match=r"found 15 pictures whose names say nothing .* expected 16 in this"):
        picture_examples.picture_examples(files[:15])
    named = sorted((tmp_path / "named").iterdir())
    with pytest.raises(NameMismatchError, match=r"found picture 0\.png among files named by what they show"):
        picture_examples.picture_examples([*named[:3], files[0]])
    with pytest.raises(NameMismatchError, match="several pictures of tilt_right"):
        picture_examples.picture_examples([*named, named[0]])
    with pytest.raises(NameMismatchError, match="expected neutral and at least one other"):
        picture_examples.picture_examples(named[:3])
    save_image(torch.zeros(3, 8, 8), named[0])
    with pytest.raises(NoFaceError, match="it should show tilt_right"):
        picture_examples.picture_examples(named)


def session(fps: int, seconds: float) -> Iterator[Tensor]:
    """Each expression trembles at first, and is still in the last fifth of its time."""
    count = round(fps * seconds)
    for number in range(16):
        for frame in range(count):
            late = frame >= 0.8 * count
            off = 0.0 if late else (0.25 if frame % 2 else 0.375)
            yield (255 * grey(number + off)).round().to(torch.uint8)[None]


def test_a_video_stands_in_for_the_camera(tmp_path: Path, shapes: Tensor, capsys: pytest.CaptureFixture[str]) -> None:
    write_video(session(20, 1.0), tmp_path / "session.avi", 20)
    out = tmp_path / "session.json"
    main(["examples", "--camera", str(tmp_path / "session.avi"), "--seconds", "1", "--out", str(out)])
    check(out, shapes)
    said = capsys.readouterr().err
    assert [said.index(f"{number + 1} of 16, {name}:") for number, name in enumerate(NAMES)] == sorted(
        said.index(f"{number + 1} of 16, {name}:") for number, name in enumerate(NAMES)
    )
    assert "hold" in said
    with pytest.raises(NoFaceError, match="while tilt_right was asked for; the frames ended"):
        guided_examples(str(tmp_path / "session.avi"), lambda words: None, seconds=1.05)


def test_the_calmest_frame_is_taken() -> None:
    landmarks = torch.rand(20, 68, 2, generator=torch.Generator().manual_seed(0))
    landmarks[11:14] = landmarks[12]
    assert torch.equal(calmest(landmarks), landmarks[12])


def test_a_rig_in_place_of_a_person(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = performer(texture=False).select(["jawOpen", "mouthSmileLeft", "browInnerUp"])
    save_rig(rig, tmp_path / "rig.glb")
    main(["examples", "--rig", str(tmp_path / "rig.glb"), "--out", str(tmp_path / "rig.json")])
    found = ExampleShapes.load(tmp_path / "rig.json")
    assert found.names == (*rig.names, "rotate_left", "rotate_right", "tilt_left", "tilt_right")
    assert "68 landmarks see" in capsys.readouterr().err
    main(["info", str(tmp_path / "rig.json")])
    assert "jawOpen" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["examples", "--rig", str(tmp_path / "rig.glb"), "--camera", "0", "--out", "x.json"])
    assert "found --camera and --rig, expected PICTURES, --camera or --rig" in " ".join(capsys.readouterr().err.split())
