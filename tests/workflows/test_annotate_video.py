"""From a film to annotated frames: proposals, resuming, files, and the model learned from them."""

import json
from pathlib import Path

import pytest
import torch
from torch import Tensor

from planted.portrait_video import EXPRESSIONS, PortraitVideo, expression_weights, render_portrait_video
from torchface import zoo
from torchface.cli import main
from torchface.errors import FileFormatError, ShapeError, TorchfaceError, ValueRangeError
from torchface.io.landmarks.landmark_points import load_landmark_points
from torchface.io.video import VideoFile, write_video
from torchface.landmarks import AppearanceModel
from torchface.landmarks.images.appearance.annotated_frames import choose_frames, load_annotated_frames
from torchface.synthetic import performer
from torchface.viz.browser.annotation_session import AnnotationSession
from torchface.workflows import annotate_video
from torchface.workflows.annotate_video import PROPOSALS, prepare_annotation, write_proposals
from train.appearance import Settings, train


@pytest.fixture(scope="module")
def film() -> PortraitVideo:
    rig = performer()
    weights = expression_weights(rig.names, list(EXPRESSIONS.values())[:7])
    return render_portrait_video(rig, torch.cat([weights, 0.5 * weights]), torch.Generator().manual_seed(1))


@pytest.fixture(scope="module")
def video(film: PortraitVideo, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(film.frames, tmp_path_factory.mktemp("film") / "actor.avi", 30.0).path


class Tracker:
    """Landmarks that are a little off, and how often they were asked for."""

    def __init__(self, film: PortraitVideo) -> None:
        self.landmarks, self.asked = film.landmarks + 1.5, 0

    def __call__(self, video: VideoFile) -> tuple[Tensor, Tensor | None]:
        self.asked += 1
        return self.landmarks, None


@pytest.fixture
def tracker(film: PortraitVideo) -> Tracker:
    return Tracker(film)


def test_proposals_are_the_frames_that_differ_and_wait_for_the_next_run(
    film: PortraitVideo, video: Path, tracker: Tracker, tmp_path: Path
) -> None:
    found = prepare_annotation(video, tmp_path, tracker, 5)
    chosen = choose_frames(tracker.landmarks, 5).tolist()
    assert [frame.name for frame in found.frames] == [f"actor_{number:06d}" for number in chosen]
    for number, frame in zip(chosen, found.frames, strict=True):
        assert frame.image.dtype == torch.uint8  # as floats fifteen frames in 4K take 1.5 GB
        shown = film.frames[number].float().expand(3, -1, -1) / 255
        torch.testing.assert_close(frame.image.float() / 255, shown, atol=2e-2, rtol=0)
        torch.testing.assert_close(frame.landmarks.float(), tracker.landmarks[number])
    assert not found.saved
    again = prepare_annotation(video, tmp_path, tracker, 5)
    assert tracker.asked == 1
    assert [frame.name for frame in again.frames] == [frame.name for frame in found.frames]
    torch.testing.assert_close(again.frames[2].landmarks, found.frames[2].landmarks, atol=1e-3, rtol=0)
    more = prepare_annotation(video, tmp_path, tracker, 7)
    assert tracker.asked == 2
    assert [frame.name for frame in more.frames][:5] == [frame.name for frame in found.frames]


def test_fewer_frames_than_asked_for_are_said(video: Path, tracker: Tracker, tmp_path: Path) -> None:
    for _ in range(2):  # the second reads what the first has kept
        with pytest.warns(UserWarning, match=r"actor\.avi: found 14 of 14 frames, 20 were asked for"):
            assert len(prepare_annotation(video, tmp_path, tracker, 20).frames) == 14
    assert tracker.asked == 1


def test_what_was_saved_comes_back_and_is_kept(video: Path, tracker: Tracker, tmp_path: Path) -> None:
    found = prepare_annotation(video, tmp_path, tracker, 4)
    session = AnnotationSession(found.frames, tmp_path, found.saved)
    session.advance()
    name = session.frame.name
    session.grab(30)
    session.drag(torch.tensor([100.0, 120.0]))
    session.let_go()
    session.save()
    again = prepare_annotation(video, tmp_path, tracker, 4)
    assert again.saved == [name]
    kept = next(frame for frame in again.frames if frame.name == name)
    torch.testing.assert_close(kept.landmarks[30], torch.tensor([100.0, 120.0]).double(), atol=1e-3, rtol=0)
    resumed = AnnotationSession(again.frames, tmp_path, again.saved)
    assert resumed.frame.name != name  # what is left comes first
    written = write_proposals(again)  # the rest, to be edited elsewhere
    assert sorted(path.name for path in written) == sorted(f"{frame.name}.pts" for frame in found.frames)
    torch.testing.assert_close(
        load_landmark_points(tmp_path / f"{name}.pts").points[30], torch.tensor([100.0, 120.0]).double()
    )
    assert len(load_annotated_frames(tmp_path)) == 4


def test_what_was_saved_stays_where_another_tracker_chooses(video: Path, tracker: Tracker, tmp_path: Path) -> None:
    found = prepare_annotation(video, tmp_path, tracker, 4)
    AnnotationSession(found.frames, tmp_path, found.saved).save()
    name = found.frames[0].name
    tracker.landmarks = tracker.landmarks.roll(1, 0)
    anew = prepare_annotation(video, tmp_path, tracker, 1, key="another tracker")
    assert tracker.asked == 2
    assert name not in [frame.name for frame in anew.frames[:1]]
    assert anew.saved == [name]


def test_folders_and_counts_that_do_not_fit_are_refused(
    film: PortraitVideo, video: Path, tracker: Tracker, tmp_path: Path
) -> None:
    prepare_annotation(video, tmp_path, tracker, 3)
    other = write_video(film.frames[:5], tmp_path / "other.avi", 30.0).path
    with pytest.raises(FileFormatError, match=r"proposals for 'actor\.avi'"):
        prepare_annotation(other, tmp_path, tracker, 3)
    (tmp_path / "alike").mkdir()
    alike = write_video(film.frames.flip(0), tmp_path / "alike" / "actor.avi", 30.0).path
    with pytest.raises(FileFormatError, match=r"frames of \d+ x \d+ of other content\)"):
        prepare_annotation(alike, tmp_path, tracker, 3)
    assert tracker.asked == 1
    prepare_annotation(video, tmp_path, tracker, 3, key="another model")
    assert tracker.asked == 2
    with pytest.raises(ValueRangeError, match="count: found 0"):
        prepare_annotation(video, tmp_path / "new", tracker, 0)
    with pytest.raises(ValueRangeError, match="a face in none"):
        prepare_annotation(video, tmp_path / "new", lambda film: (torch.full((14, 68, 2), torch.nan), None), 3)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("format", "another"),
        ("asked", "three"),
        ("proposals", []),
        ("proposals", [{"frame": 99, "landmarks": [[0, 0]] * 68}]),
        ("proposals", [{"frame": 1, "landmarks": [[0, 0]] * 67}]),
        ("proposals", [{"frame": 1, "landmarks": [[0, 1e999]] * 68}]),
        ("proposals", [{"frame": 1, "landmarks": "many"}]),
    ],
)
def test_damaged_proposals_are_refused(video: Path, tracker: Tracker, tmp_path: Path, key: str, value: object) -> None:
    prepare_annotation(video, tmp_path, tracker, 3)
    document = json.loads((tmp_path / PROPOSALS).read_text())
    document[key] = value
    (tmp_path / PROPOSALS).write_text(json.dumps(document))
    with pytest.raises(FileFormatError, match=PROPOSALS):
        prepare_annotation(video, tmp_path, tracker, 3)
    (tmp_path / PROPOSALS).write_text("{")
    with pytest.raises(FileFormatError, match="not JSON"):
        prepare_annotation(video, tmp_path, tracker, 3)


def test_a_drag_takes_neighbours_along_and_is_one_step(video: Path, tracker: Tracker, tmp_path: Path) -> None:
    session = AnnotationSession(prepare_annotation(video, tmp_path, tracker, 2).frames, tmp_path)
    before = session.landmarks.clone()
    session.grab(57)
    for step in (3.0, 6.0):  # the pointer moves on: what counts is where it is in the end
        session.drag(before[57] + torch.tensor([0.0, step]), reach=10.0)
    session.let_go()
    moved = (session.landmarks - before)[:, 1]
    share = torch.exp(-(before - before[57]).square().sum(1) / 200)
    torch.testing.assert_close(moved, 6.0 * share)
    assert [session.undo(), session.undo()] == [True, False]
    assert torch.equal(session.landmarks, before)
    session.grab(3)
    session.drag(torch.tensor([-50.0, 1e6]))  # the picture's border holds it
    assert session.landmarks[3].tolist() == [0.0, 299.0]
    session.let_go()
    session.reset()
    assert torch.equal(session.landmarks, before)
    states = [session.state]
    session.save()
    states.append(session.state)
    session.undo()  # what was saved is no longer what is shown
    assert [*states, session.state] == ["not saved", "saved", "changed since"]
    with pytest.raises(ValueRangeError, match="no landmark grabbed"):
        session.drag(before[0])
    with pytest.raises(ValueRangeError, match="landmark: found 68"):
        session.grab(68)
    with pytest.raises(ValueRangeError, match="frame: found 2"):
        session.show(2)
    with pytest.raises(ShapeError, match="found no frame"):
        AnnotationSession([], tmp_path)


@pytest.mark.bench
def test_the_recipe_learns_from_the_folder_and_tells_left_out_errors(
    film: PortraitVideo, video: Path, tmp_path: Path
) -> None:
    exact = Tracker(film)
    exact.landmarks = film.landmarks
    write_proposals(prepare_annotation(video, tmp_path / "frames", exact, 10))
    trained = train(Settings(data=tmp_path / "frames", out=tmp_path / "actor", folds=3))
    assert trained.errors.shape == (10,)
    assert trained.errors.mean() < 0.5 * trained.start_errors.mean()
    described = zoo.describe(tmp_path / "actor")
    assert described.kind == "appearance"
    assert described.metrics["left_out_error"] == pytest.approx(float(trained.errors.mean()), rel=1e-4)
    assert (tmp_path / "actor" / "held_out.png").is_file()
    model = zoo.get_model(tmp_path / "actor")
    assert isinstance(model, AppearanceModel)
    rows = slice(0, 3)
    found = model(film.frames[rows, None].float() / 255, film.landmarks[rows] + 2.0)
    assert (found - film.landmarks[rows]).norm(dim=2).mean() < 1.0
    with pytest.raises(TorchfaceError, match="folds: found 1"):
        train(Settings(data=tmp_path / "frames", out=tmp_path / "actor", folds=1))


def test_the_command_writes_proposals_of_the_zoos_tracker(
    film: PortraitVideo, video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "frames"
    main(["annotate", str(video), "--out", str(out), "--count", "3", "--no-browser", "--quiet"])
    paths = [Path(line) for line in capsys.readouterr().out.split()]
    assert sorted(paths) == sorted(out.glob("*.pts"))
    assert len(paths) == 3
    for frame in load_annotated_frames(out):
        truth = film.landmarks[int(frame.name[-6:])]
        apart = (frame.landmarks - truth).norm(dim=1).mean()
        assert apart < 0.15 * (truth[36] - truth[45]).norm()
    with pytest.raises(SystemExit) as ended:
        main(["annotate", str(video), "--out", str(tmp_path / "new"), "--landmarks", "head", "--no-browser", "--quiet"])
    assert ended.value.code == 2
    assert not (tmp_path / "new").exists()


def test_frames_that_do_not_fit_into_memory_are_refused(
    video: Path, tracker: Tracker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(annotate_video, "_MAX_PIXEL_BYTES", 10**6)
    with pytest.raises(ValueRangeError, match=r"count: found \d+ frames of \d+ x \d+ pixels, expected at most \d"):
        prepare_annotation(video, tmp_path, tracker, 15)
