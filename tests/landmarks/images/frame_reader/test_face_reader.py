"""One face in a camera's pictures: it is kept, lost and found; its eyes are read as the library reads them."""

from collections.abc import Callable
from copy import copy
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from planted.crossing_people import crossing_film
from torchface import zoo
from torchface.geometry.cameras.pinhole import look_at
from torchface.landmarks import FaceReading, LandmarkTracker
from torchface.landmarks.images.checked_detector import shipped_detector
from torchface.landmarks.images.frame_reader.face_reader import (
    STATE,
    FaceReader,
    WebcamNetworks,
    people_beside,
    read_eyes,
)
from torchface.landmarks.images.frame_reader.face_search import FOUND
from torchface.landmarks.images.ibug_68 import relative_errors
from torchface.landmarks.images.networks.crop_finder import CropFinder
from torchface.landmarks.images.networks.eye_finder import EyeFinder
from torchface.landmarks.images.person_identity import (
    IDENTITY,
    LOOK_SIZE,
    after_boxes,
    after_face,
    counted_beside,
    face_look,
)
from torchface.rendering.clay_shading import Lighting, render
from torchface.synthetic import performer
from torchface.workflows.named_finders import graph_detector


@pytest.fixture(scope="module")
def portrait() -> tuple[Tensor, Tensor]:
    """A performer's head on grey, (3,150,150), and its landmarks (68,2)."""
    rig = performer()
    marks = rig.neutral.landmarks
    camera = look_at(rig.vertices[marks].double().mean(0), 0.0, 0.0, 330.0, 150, 150)
    picture = render(rig.neutral, camera, background=(0.3, 0.35, 0.4), lighting=Lighting(occlusion_rays=0), samples=1)
    return (picture.clamp(0, 1) * 255).byte(), camera.project(rig.vertices[marks].double()).float()


@pytest.fixture(scope="module")
def reader() -> FaceReader:
    """With the zoo's networks."""
    networks = WebcamNetworks(*(zoo.get_model(name) for name in ("face_boxes", "landmark_network", "eye_network")))
    return FaceReader(networks).eval()


class Run(nn.Module):
    """A network's graph as a module of crops."""

    def __init__(self, run: Callable[[Tensor], Any], size: int = 0, margin: float = 0.0) -> None:
        super().__init__()
        self.run, self.size, self.margin = run, size, margin

    def forward(self, images: Tensor) -> Any:
        return self.run(images)


@pytest.fixture(scope="module")
def quick(reader: FaceReader) -> FaceReader:
    """Its networks run in ONNX Runtime, as those of programs do; PyTorch takes far longer."""
    found, detector = copy(reader), graph_detector()
    found._modules = {**reader._modules}
    found.boxes = Run(detector.detector.network)
    found.landmarks = Run(detector.network, detector.size, detector.margin)
    return found


def quick_tracker(fps: float = 30.0) -> LandmarkTracker:
    """See ``quick``."""
    detector = graph_detector()
    return LandmarkTracker(CropFinder(detector.network, detector.size, detector.margin), detector=detector, fps=fps)


class Webcam:
    """A reader with the state that it hands on."""

    def __init__(self, reader: FaceReader) -> None:
        self.reader, self.state = reader, torch.zeros(STATE)

    @torch.inference_mode()
    def step(self, frame: Tensor, interval: float = 1 / 30) -> FaceReading:
        found, self.state = self.reader(frame.permute(1, 2, 0), torch.tensor(interval), self.state)
        return found


@pytest.fixture
def webcam(quick: FaceReader) -> Webcam:
    return Webcam(quick)


def test_eyes_are_read_as_the_library_reads_them(portrait: tuple[Tensor, Tensor], reader: FaceReader) -> None:
    """Lids, irises, and what is told of each eye; of eyes too small to be seen nothing."""
    picture, marks = portrait
    sure, names = torch.ones(68), ("landmarks", "deviation", "iris", "openness", "closed", "eye_visibility")
    finder = EyeFinder(reader.eyes, reader.eyes.width, reader.eyes.height)
    for size in (1.0, 0.05):
        face = FaceReading(size * marks, torch.linspace(0.5, 2.0, 68), sure, sure[0])
        with torch.inference_mode():
            expected, found = finder(picture, face), read_eyes(picture.permute(1, 2, 0), face, reader.eyes)
        for name in names:
            torch.testing.assert_close(
                getattr(found, name), getattr(expected, name), atol=0.05, rtol=0, equal_nan=True, msg=name
            )
    assert found.iris.isnan().all()
    assert (found.eye_visibility == 0).all()


def scene(portrait: Tensor, *corners: tuple[int, int], size: tuple[int, int] = (240, 400)) -> Tensor:
    """Portraits at corners (column, row) on an empty wall."""
    frame = torch.tensor([76, 89, 102], dtype=torch.uint8)[:, None, None].expand(3, *size).clone()
    for left, top in corners:
        frame[:, top : top + portrait.shape[1], left : left + portrait.shape[2]] = portrait
    return frame


def column(face: FaceReading) -> float:
    return float(face.landmarks[:, 0].mean())


def test_a_face_is_followed_as_the_library_follows_it(reader: FaceReader, portrait: tuple[Tensor, Tensor]) -> None:
    webcam, network = Webcam(reader), zoo.get_model("landmark_network")
    tracker = LandmarkTracker(CropFinder(network, network.size, network.margin), detector=shipped_detector())
    head, truth = portrait
    for left in (60, 66, 72, 95, 95):
        frame = scene(head, (left, 50))
        found, tracked = webcam.step(frame), tracker.step(frame)
        theirs = tracked.landmarks
        assert found.presence > 0.9
        assert relative_errors(found.landmarks[None], theirs[None]) < 0.01
        assert relative_errors(found.landmarks[None], truth[None] + torch.tensor([left, 50.0])) < 0.06
        assert float((found.expression - tracked.expression).abs().median()) < 0.05
        assert (found.iris - found.landmarks[torch.tensor([[36, 39], [42, 45]])].mean(1)).abs().max() < 5
    clear = torch.cat([frame, torch.zeros(1, *frame.shape[1:], dtype=torch.uint8)])
    before = webcam.state
    once = webcam.step(frame).landmarks
    webcam.state = before
    assert torch.equal(webcam.step(clear).landmarks, once)


def test_it_stays_with_the_largest_and_finds_it_again(webcam: Webcam, portrait: tuple[Tensor, Tensor]) -> None:
    head, _ = portrait
    small = torch.nn.functional.interpolate(head[None].float(), (110, 110), mode="area")[0].byte()

    def both(large: Tensor, other: Tensor) -> Tensor:
        frame = scene(large, (20, 40))
        frame[:, 60 : 60 + other.shape[1], 220 : 220 + other.shape[2]] = other
        return frame

    assert column(webcam.step(both(head, small))) < 190
    assert column(webcam.step(both(head, small))) < 190
    assert column(webcam.step(both(small, head))) < 190  # now the other is larger, and not it
    for _ in range(4):
        gone = webcam.step(scene(head))
        assert gone.presence == 0
        assert gone.landmarks.isnan().all()
        assert gone.iris.isnan().all()
        assert gone.expression.isnan().all()
        assert gone.expression_deviation.isinf().all()
        assert webcam.state.isfinite().all()
    assert column(webcam.step(both(small, head))) < 190  # the one that is where it was, though another is larger
    webcam.state = torch.zeros(STATE)
    assert column(webcam.step(both(small, head))) > 190  # forgotten: the largest


def patterns(count: int) -> Tensor:
    """Coarse coloured patterns, uint8 (count,3,300,400)."""
    colors = 255 * torch.rand(count, 3, 6, 8, generator=torch.Generator().manual_seed(0))
    return interpolate(colors, size=(300, 400), mode="bicubic").clamp(0, 255).byte()


def test_after_a_cut_the_face_is_found_at_once_elsewhere(webcam: Webcam, portrait: tuple[Tensor, Tensor]) -> None:
    walls = patterns(2)

    def shown(wall: int, left: int) -> Tensor:
        frame = walls[wall].clone()
        frame[:, 75:225, left : left + 150] = portrait[0]
        return frame

    first, *_ = [webcam.step(shown(0, 10)) for _ in range(4)][::-1]
    after = webcam.step(shown(1, 240))
    assert column(after) == pytest.approx(column(first) + 230, abs=2)
    assert column(webcam.step(shown(1, 240))) == pytest.approx(column(after), abs=1)


@pytest.mark.parametrize(
    ("color", "frames"),
    [((255, 255, 255), 1), ((0, 0, 0), 3), ((0, 0, 0), 15), ((190, 120, 100), 10), ((0, 200, 0), 1)],
    ids=["flash", "black", "black for half a second", "hand", "glitch"],
)
def test_frames_without_a_picture_do_not_lead_to_a_larger_face(
    webcam: Webcam, portrait: tuple[Tensor, Tensor], color: tuple[int, int, int], frames: int
) -> None:
    """A cut to a picture without a face, and back to the one before it."""
    head = portrait[0]
    small = interpolate(head[None].float(), (110, 110), mode="area")[0].byte()
    film = []
    for own, other in ((head, small), (small, head)):
        frame = patterns(1)[0].clone()
        frame[:, 80 : 80 + own.shape[1], 20 : 20 + own.shape[2]] = own
        frame[:, 70 : 70 + other.shape[1], 230 : 230 + other.shape[2]] = other
        film += [frame] * 4
    assert all(column(webcam.step(frame)) < 190 for frame in film)
    shade = torch.linspace(0.7, 1.0, 400)
    odd = (torch.tensor(color)[:, None, None] * shade).byte().expand(3, 300, 400)
    assert [float(webcam.step(odd).presence) for _ in range(frames)][-1] == 0
    after = [column(webcam.step(film[-1])) for _ in range(15)]
    assert max(after) < 190


def test_a_face_with_too_few_visible_landmarks_to_be_solved_is_none(
    webcam: Webcam, portrait: tuple[Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """However sure the network is that it is there: an application would move a head that nobody solved."""
    look = webcam.reader.look

    def blind(image: Tensor, place: Tensor) -> Tensor:
        seen = look(image, place).clone()
        seen[3 * 68 : 4 * 68] = 0.2
        return seen

    assert webcam.step(scene(portrait[0], (60, 50))).presence > 0.9
    webcam.state = torch.zeros(STATE)
    monkeypatch.setattr(webcam.reader, "look", blind)
    assert webcam.step(scene(portrait[0], (60, 50))).presence == 0


@pytest.mark.parametrize(("grey", "frames"), [(60, 3), (110, 3), (0, 12)])
def test_a_plain_wall_is_no_face_for_long(
    webcam: Webcam, portrait: tuple[Tensor, Tensor], grey: int, frames: int
) -> None:
    """The network does not say surely that a plain wall is no face; it is least sure before a covered lens."""
    for _ in range(8):
        assert webcam.step(scene(portrait[0], (60, 50))).presence > 0.9
    wall = torch.full((3, 240, 400), grey, dtype=torch.uint8)
    kept = [float(webcam.step(wall).presence) for _ in range(frames)]
    assert kept[-1] == 0


@pytest.mark.parametrize(
    "film",
    [
        pytest.param({"start": 400.0, "end": -160.0}, id="passing"),
        pytest.param({"tint": (1.0, 1.0, 1.0)}, id="alike"),
        pytest.param({}, id="beside", marks=pytest.mark.bench),
        pytest.param({"hidden": 0.8}, id="slow", marks=pytest.mark.bench),
        pytest.param({"larger": 1.4}, id="near", marks=pytest.mark.bench),
        pytest.param({"stays": 5.0, "fps": 15}, id="before", marks=pytest.mark.bench),
        pytest.param({"stays": 2.0, "tint": (1.0, 1.0, 1.0)}, id="alike before", marks=pytest.mark.bench),
    ],
)
def test_it_stays_with_a_person_before_whom_another_passes(webcam: Webcam, film: dict[str, Any]) -> None:
    """Reader and tracker alike: never for two frames with the other, soon with the first again; others are counted."""
    crossing, fps = crossing_film(**film), film.get("fps", 30)
    tracker, away = quick_tracker(fps), torch.zeros(2, len(crossing.frames))
    for i, frame in enumerate(crossing.frames):
        for row, found in enumerate((webcam.step(frame, 1 / fps), tracker.step(frame))):
            away[row, i] = abs(float(found.landmarks[:, 0].mean()) - float(crossing.columns[i]))
    assert (away[:, :15] < 2).all()
    assert (away[:, -20:] < 2).all()
    assert (away.nan_to_num(0.0) < 16).all()  # pixels, of a face of 75
    assert ((away > 3).sum(1) <= 2).all()
    others = [round(one) for one in people_beside(webcam.state).tolist()]
    assert others == [round(one) for one in tracker.beside.tolist()] == [int(film.get("end") is None), 0]


def test_one_of_two_boxes_that_overlap_is_not_mistaken_for_good() -> None:
    """Who comes out from behind another little by little is followed again."""
    crossing, tracker = crossing_film(hidden=3.0), quick_tracker()
    away = torch.tensor([column(tracker.step(frame)) for frame in crossing.frames]) - crossing.columns
    assert away[60:80].isnan().all()
    assert (away.abs().nan_to_num(0.0) < 16).all()
    assert (away[-20:].abs() < 2).all()


def test_who_goes_aside_while_another_passes_is_found_there(webcam: Webcam) -> None:
    """The other stops where the first one was: that place was watched for seconds."""
    crossing, tracker = crossing_film(after=25), quick_tracker()
    aside = (torch.arange(len(crossing.frames)) - 24).clamp(0, 11) * 10
    away = torch.zeros(2, len(aside))
    for i, (frame, moved) in enumerate(zip(crossing.frames, aside.tolist(), strict=True)):
        for row, reader in enumerate((webcam, tracker)):
            away[row, i] = column(reader.step(frame.roll(moved, 2))) - float(crossing.columns[i]) - moved
    assert (away[:, :15].abs() < 2).all()
    assert (away.abs().nan_to_num(0.0) < 16).all()
    assert (away[:, -10:].abs() < 2).all()


def test_who_stays_before_another_is_followed_in_the_end(webcam: Webcam) -> None:
    frames = crossing_film(stays=10.0, after=0, fps=10).frames
    seen = [column(webcam.step(frame, 0.1)) for frame in frames]
    assert all(one != one for one in seen[27:74])  # for five seconds
    assert seen[-7] == seen[-7]


def test_a_person_who_passes_before_another_is_kept(webcam: Webcam) -> None:
    frames = crossing_film(larger=1.3).frames[5:]  # the nearer is the larger, and so the one that is followed
    columns = [column(webcam.step(frame)) for frame in frames]
    assert min(columns) == pytest.approx(columns[-1], abs=2)
    assert columns[0] - columns[-1] > 200
    assert all(one == one for one in columns)


@pytest.mark.parametrize(("score", "others"), [(0.45, 0), (0.55, 1)], ids=["a skull on a shirt", "a person"])
def test_who_is_counted(score: float, others: int) -> None:
    """By scores of the box network in films; a face on a shirt moves with the person, so that motion tells nothing."""
    interval, look = torch.tensor(1 / 30), face_look(torch.rand(3, LOOK_SIZE, LOOK_SIZE))
    people, whose = torch.zeros(IDENTITY), (torch.tensor(True), torch.tensor(False))
    faces = torch.tensor([[200.0, 100, 80, 0.6], [210, 260, 70, score], [0, 0, 0, 0], [0, 0, 0, 0]])
    for _ in range(30):
        people = after_boxes(people, faces, torch.tensor(True), interval)
        people = after_face(people, torch.tensor([200.0, 100, 80, 1, 0]), look, whose, interval)
    assert counted_beside(people).sum().round() == others


def test_what_was_refused_is_not_tried_again_and_again(
    webcam: Webcam, portrait: tuple[Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Long after a face was lost it is searched for now and then, and another candidate comes each time."""
    frame, place, wall = scene(portrait[0], (60, 50)), torch.tensor([135.0, 120, 90]), torch.tensor([320.0, 60, 90])

    def search(image: Tensor, last: Tensor, waiting: Tensor, attempt: Tensor, longest: Tensor) -> Tensor:
        return torch.cat([place if attempt == 2 else wall, torch.tensor([1.0, 0, 1, 0]), torch.zeros(FOUND - 7)])

    monkeypatch.setattr(webcam.reader, "search", search)
    webcam.state[9] = 1.0  # seconds without a face
    assert any(webcam.step(frame).presence > 0.9 for _ in range(15))


def test_a_face_is_kept_between_pictures_that_are_seconds_apart(
    webcam: Webcam, portrait: tuple[Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the box network does not see it, as with two frames a second it did not; lost where it is gone."""
    assert column(webcam.step(scene(portrait[0], (60, 50)), 2.0)) < 190
    assert column(webcam.step(scene(portrait[0], (230, 50)), 2.0)) > 190  # the box network finds it elsewhere
    monkeypatch.setattr(webcam.reader, "search", lambda *given: torch.zeros(FOUND))
    for left in (220, 230):
        assert webcam.step(scene(portrait[0], (left, 50)), 2.0).presence > 0.9
    assert webcam.step(scene(portrait[0], (20, 50)), 2.0).presence == 0


def test_whatever_is_shown_is_read_safely(webcam: Webcam, portrait: tuple[Tensor, Tensor]) -> None:
    frame = scene(portrait[0], (60, 50))
    expected = webcam.step(frame).landmarks
    other_camera = webcam.step(frame[:, 30:, 40:260]).landmarks
    assert relative_errors(other_camera[None], expected[None] - torch.tensor([40.0, 30.0])) < 0.02
    for size in ((64, 64), (1, 1), (2000, 40)):
        assert webcam.step(torch.zeros(3, *size, dtype=torch.uint8)).presence == 0
        assert webcam.state.isfinite().all()
