"""A run that was killed goes on, what is up to date is kept, and damaged files are made anew."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from forked_runs import killed
from safetensors.torch import load_file

from tests.workflows.track.conftest import FRAMES, PIECE, Done, Filmed
from torchface.capture.own_rig.another_face import FilmLooks
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.video import open_video
from torchface.io.video.video_file import VideoFile
from torchface.landmarks import FaceReading, LandmarkTracker
from torchface.workflows.named_finders import graph_detector, load_finder
from torchface.workflows.track import frame_readings
from torchface.workflows.track.track_inputs import TrackSettings
from torchface.workflows.track.track_state import FOLDER, TrackState
from torchface.workflows.track.track_video import track_video


def test_a_killed_run_goes_on_where_it_was_and_gives_the_same(done: Done, filmed: Filmed) -> None:
    assert done.left == (FOLDER,)
    assert done.steps == FRAMES - 2 * PIECE
    assert done.tracked.reused == 2 * PIECE
    tracker = LandmarkTracker(load_finder(shown="film").finder, detector=graph_detector())
    whole: list[torch.Tensor] = []
    whole.extend(tracker.step(frame).landmarks for frame in open_video(filmed.video).color_frames())
    assert torch.equal(done.tracked.reading.landmarks, torch.stack(whole))


def test_what_is_up_to_date_is_kept(
    done: Done, filmed: Filmed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, decoded, color_frames = tmp_path / "out", [], VideoFile.color_frames
    shutil.copytree(done.out, out)

    def counted(clip: VideoFile) -> Iterator[torch.Tensor]:
        for frame in color_frames(clip):
            decoded.append(frame)
            yield frame

    monkeypatch.setattr(VideoFile, "color_frames", counted)
    made = {path: path.stat().st_mtime_ns for path in (out / "overlay.mp4", out / FOLDER / "solution.safetensors")}
    again = track_video(filmed.video, filmed.rig, out, TrackSettings(camera=filmed.camera))
    assert {path: path.stat().st_mtime_ns for path in made} == made
    assert set(again.seconds) == {"smoothing"}
    assert len(decoded) == 1  # the first frame says how many faces there are
    torch.testing.assert_close(again.solution.weights, done.tracked.solution.weights)
    smooth = track_video(
        filmed.video, filmed.rig, out, TrackSettings(camera=filmed.camera, overlay="none", whole_take=True)
    )
    assert set(smooth.seconds) == {"smoothing", "weights", "skin's motion"}  # landmarks stay
    assert not torch.equal(smooth.solution.weights, again.solution.weights)


def assert_same_file(path: Path, other: Path) -> None:
    """Bit for bit, but that numbers of tables may differ by rounding: products of matrices depend on where they lie."""
    if path.read_bytes() == other.read_bytes():
        return
    if path.suffix == ".glb":
        played, wanted_take = read_gltf_weights(path), read_gltf_weights(other)
        torch.testing.assert_close(played.weights.values, wanted_take.weights.values, atol=1e-5, rtol=0)
        return
    assert path.suffix == ".csv", path
    ours, theirs = (table.read_text().splitlines() for table in (path, other))
    assert len(ours) == len(theirs)
    for row, wanted in zip(ours, theirs, strict=True):
        for one, two in zip(row.split(","), wanted.split(","), strict=True):
            assert one == two or float(one) == pytest.approx(float(two), abs=1e-5), (path.name, row[:20])


def test_damaged_files_are_told_and_made_anew(
    done: Done, filmed: Filmed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frame_readings, "PIECE", PIECE)
    out = tmp_path / "out"
    shutil.copytree(done.out, out)
    names = {path.relative_to(done.out) for path in done.out.rglob("*") if path.is_file()}
    pieces = sorted((out / FOLDER).glob("landmarks_*"))
    pieces[1].write_bytes(b"")
    (out / "overlay.mp4").write_bytes((out / "overlay.mp4").read_bytes()[:1000])
    for name in ("weights.csv", "animation.glb", "summary.json"):
        (out / name).write_bytes(b"")
    settings = TrackSettings(camera=filmed.camera)
    killed(
        lambda told: track_video(filmed.video, filmed.rig, out, settings, told),
        "drawing the overlay (--overlay none skips it)",
        5,
    )
    left = out / FOLDER / f".{pieces[1].name}.999999.part"
    left.write_bytes(b"of a run that was killed")
    with pytest.warns(UserWarning, match="overlay.mp4: found other content than was written"):
        again = track_video(filmed.video, filmed.rig, out, settings)
    assert again.reused == FRAMES
    assert set(again.seconds) == {"smoothing", "overlay"}
    assert {path.relative_to(out) for path in out.rglob("*") if path.is_file()} == names
    for name in names - {Path("summary.json"), Path(FOLDER) / "track.json"}:  # these hold times and hashes of files
        if name.suffix == ".safetensors":  # whose header names things in any order
            ours, theirs = load_file(out / name), load_file(done.out / name)
            torch.testing.assert_close(ours, theirs, rtol=0, atol=0, equal_nan=True)
        else:
            assert_same_file(out / name, done.out / name)


def test_pieces_of_other_runs_and_damaged_ones_are_thrown_away(tmp_path: Path) -> None:
    piece = FaceReading(torch.rand(4, 68, 2), torch.rand(4, 68), torch.ones(4, 68), torch.ones(4))
    state = TrackState(tmp_path, "a")
    for _ in range(3):
        state.append(piece, FilmLooks(torch.rand(4, 1200), torch.rand(4)), torch.zeros(3))
    assert TrackState(tmp_path, "a").done == 12
    files = sorted((tmp_path / FOLDER).glob("*.safetensors"))
    files[1].write_bytes(files[1].read_bytes()[:-1000] + bytes(1000))
    with pytest.warns(UserWarning, match=r"landmarks_000001\.safetensors: found a damaged checkpoint"):
        assert TrackState(tmp_path, "a").done == 4
    assert [path.exists() for path in files] == [True, False, False]
    assert TrackState(tmp_path, "b").done == 0
    product = tmp_path / "x.csv"
    product.write_text("x")
    state.made(product, "k")
    assert state.is_current(product, "k")
    assert not state.is_current(product, "l")
    product.write_text("y")
    with pytest.warns(UserWarning, match=r"x\.csv: found other content than was written"):
        assert not state.is_current(product, "k")
    product.write_text("x")
    (tmp_path / FOLDER / "track.json").write_text("[[[")
    assert not state.is_current(product, "k")
