"""Curves of a video, brought to the frames of a take."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchface import Take, Track, zoo
from torchface.capture.action_units import ActionUnitClassifier, ActionUnitCurves, load_shape_table
from torchface.errors import FileFormatError, NameMismatchError
from torchface.io.action_labels import load_action_labels
from torchface.workflows.batch.batch_items import BatchItem
from torchface.workflows.solve.head_camera import (
    HeadCamera,
    _fitting_table,
    predicted_curves,
    resampled_curves,
    video_warnings,
)
from torchface.workflows.solve.solution import SolveSettings
from torchface.workflows.solve.take_job import TakeJob


def curves(frames: int, fps: float) -> ActionUnitCurves:
    """A brow that goes up between 0.5 and 1 s, and a jaw that no unit moves."""
    time = torch.arange(frames) / fps
    up = ((time > 0.5) & (time < 1.0)).float()
    weights = torch.stack([up * (2 * torch.pi * (time - 0.5)).sin(), torch.zeros(frames)], 1)
    active = torch.stack([up > 0, torch.zeros(frames, dtype=torch.bool)], 1)
    levels, seen = up[:, None], torch.ones(frames, 1, dtype=torch.bool)
    return ActionUnitCurves(("browInnerUp", "jawOpen"), weights, active, ("1+2",), levels, levels, fps, seen)


def take(frames: int, fps: float) -> Take:
    return Take(fps, markers=Track(("m",), torch.zeros(frames, 1, 3)))


def test_the_same_rate_leaves_the_curves_as_they_are() -> None:
    found = resampled_curves(curves(90, 60), take(90, 60))
    assert found.weights.names == found.gamma.names == ("browInnerUp",)
    assert torch.equal(found.weights.values[:, 0, 0], curves(90, 60).weights[:, 0])
    assert found.notes == ("take and video are taken to begin together",)
    assert float(found.gamma.values[45, 0, 0]) == 4.0
    assert not found.gamma.values[:15].any()


@pytest.mark.parametrize("fps", [30.0, 50.0, 120.0])
def test_another_rate_is_brought_to_the_takes(fps: float) -> None:
    found = resampled_curves(curves(int(1.5 * fps), fps), take(85, 60))
    true = curves(85, 60).weights[:, 0]
    inside = (torch.arange(85) > 33) & (torch.arange(85) < 57)
    assert float((found.weights.values[:, 0, 0] - true)[inside].abs().max()) < 0.05
    assert "brought to the take's 60" in found.notes[0]


def test_where_the_video_ends_the_markers_are_alone() -> None:
    found = resampled_curves(curves(50, 60), take(90, 60))
    assert "ends 40 frames before the take" in found.notes[0]
    assert not found.gamma.values[60:].any()
    longer = resampled_curves(curves(90, 60), take(50, 60))
    assert "40 frames after the take" in longer.notes[0]
    assert len(longer.weights) == 50


def test_a_video_that_began_later_is_moved_by_its_offset() -> None:
    found = resampled_curves(curves(90, 60), take(90, 60), offset=0.25)
    torch.testing.assert_close(found.weights.values[15:, 0, 0], curves(90, 60).weights[:75, 0])
    assert "begins 15 frames after the take" in found.notes[0]
    assert not found.gamma.values[:30].any()
    assert float(found.gamma.values[60, 0, 0]) == 4.0


def test_a_video_that_does_not_go_with_the_markers_is_said_with_its_offset() -> None:
    """Weights of the markers alone show the brow that the video shows, 0.2 s later."""
    predicted = resampled_curves(curves(90, 60), take(90, 60))
    together = Take(60, weights=Track(("browInnerUp",), curves(90, 60).weights[:, :1, None] * 0.8))
    later = Take(60, weights=Track(("browInnerUp",), together.weights.values.roll(12, 0)))
    still = Take(60, weights=Track(("browInnerUp",), 0.01 * together.weights.values.roll(40, 0)))
    assert video_warnings(together, predicted) == video_warnings(still, predicted) == []
    (warning,) = video_warnings(later, predicted)
    assert "(by 0.95 with `offset` in its labels +0.20 s from now)" in warning
    moved = resampled_curves(curves(90, 60), take(90, 60), offset=0.2)
    assert video_warnings(later, moved) == []


def test_a_film_of_a_part_of_a_take_is_compared_with_that_part() -> None:
    """A brow that moves all the time, of whose first quarter there is a film; and a take of one frame."""
    up = (0.2 * torch.arange(400)).sin().clamp(min=0)[:, None]
    alone = Take(60, weights=Track(("browInnerUp",), up[..., None]))
    short = replace(curves(100, 60), names=("browInnerUp",), weights=up[:100], active=torch.ones(100, 1).bool())
    assert video_warnings(alone, resampled_curves(short, take(400, 60))) == []
    assert video_warnings(alone.frames(slice(1)), resampled_curves(short, take(1, 60))) == []
    other = replace(short, weights=up[:100].roll(15, 0))
    assert len(video_warnings(alone, resampled_curves(other, take(400, 60)))) == 1


def test_gamma_is_the_largest_weight_of_a_prediction() -> None:
    usual, weak = resampled_curves(curves(90, 60), take(90, 60)), resampled_curves(curves(90, 60), take(90, 60), 1.0)
    torch.testing.assert_close(weak.gamma.values, usual.gamma.values / 4)
    assert float(usual.gamma.values.max()) > 3


def test_a_video_without_labels_says_what_they_are() -> None:
    with pytest.raises(FileFormatError, match=r"take\.toml: found no such file, .* in take\.mp4; --video-labels"):
        predicted_curves(HeadCamera(Path("take.mp4"), "action_units"), take(2, 60.0), ("jawOpen",))


def test_units_that_a_classifier_does_not_know_are_named_by_the_flag() -> None:
    camera = HeadCamera(Path("take.mp4"), "action_units", units=("9", "17"))
    with pytest.raises(NameMismatchError, match=r"--units: found 17, expected some of .*18R"):
        predicted_curves(camera, take(2, 60.0), ("jawOpen",))


def test_regions_that_the_labels_lack_are_named_with_their_file(tmp_path: Path) -> None:
    """By the how-to's own labels, without two of their regions."""
    page = (Path(__file__).parents[3] / "docs/how_to/head_camera.md").read_text()
    labels = page.split("```toml\n")[1].split("```")[0]
    whole = tmp_path / "whole.toml"
    whole.write_text(labels)
    assert set(load_action_labels(whole).regions) == set(zoo.get_model("action_units", ActionUnitClassifier).regions)
    less = tmp_path / "less.toml"
    less.write_text("\n".join(line for line in labels.splitlines() if not line.startswith("eye_")))
    camera = HeadCamera(Path("take.mp4"), "action_units", less)
    with pytest.raises(NameMismatchError, match=r"less\.toml: regions: found no eye_left, eye_right, expected .*mouth"):
        predicted_curves(camera, take(2, 60.0), ("jawOpen",))


def test_units_of_ones_own_need_a_table_of_their_own() -> None:
    names = load_shape_table("arkit").units["4"]
    assert _fitting_table(("4", "mine"), tuple(names)) == "arkit"
    with pytest.raises(NameMismatchError, match=r"for the units mine, yours of a rig with browDownLeft.*--table FILE"):
        _fitting_table(("mine", "yours"), tuple(names))


def test_a_batch_solves_a_take_again_where_labels_or_classifier_have_changed(tmp_path: Path) -> None:
    """Neither is named by a path of its own: labels lie beside the video, the classifier is a folder or a name."""
    item = BatchItem("take", tmp_path / "take.c3d")
    job = TakeJob(tmp_path / "rig.glb", tmp_path / "sites.json", SolveSettings())
    job = replace(job, camera=HeadCamera(tmp_path / "{name}.mp4", str(tmp_path / "units")))
    keys = [job.key(item)]
    assert job.key(item) == keys[0]
    for changed in ("take.toml", "units/model.toml"):
        (tmp_path / changed).parent.mkdir(exist_ok=True)
        (tmp_path / changed).write_text("changed")
        keys.append(job.key(item))
    assert len(set(keys)) == 3
