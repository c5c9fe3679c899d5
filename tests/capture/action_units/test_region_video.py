"""Regions are read where they are; a video without them is refused."""

from dataclasses import replace

import pytest
import torch

from torchface.capture.action_units import (
    ActionUnitClassifier,
    RegionVideo,
    action_unit_curves,
    load_shape_table,
    read_regions,
)
from torchface.capture.action_units.painted_regions import region_grid, sample_regions
from torchface.capture.action_units.region_video import open_regions
from torchface.errors import AlignmentError, FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.io.video import write_video
from train.filmed_performers.camera_stage import RecordedSession


def test_a_region_of_its_own_size_is_a_cut() -> None:
    frames = torch.rand(3, 40, 50, generator=torch.Generator().manual_seed(0))
    grid = region_grid({"a": (9.5, 4.5, 25.5, 20.5)}, ["a"], 16, 50, 40)
    still = torch.eye(2, 3).expand(3, 2, 3)
    torch.testing.assert_close(sample_regions(frames, grid, still)[:, 0], frames[:, 5:21, 10:26])
    moved = still.clone()
    moved[:, :, 2] = torch.tensor([3.0, -2.0])
    torch.testing.assert_close(sample_regions(frames, grid, moved)[:, 0], frames[:, 3:19, 13:29])


def test_bad_input_is_named(session: RecordedSession, regions: RegionVideo, tmp_path) -> None:
    video, labels = session.video, session.labels
    outside = replace(labels, regions=dict(labels.regions, mouth=(60.0, 100.0, 130.0, 150.0)))
    with pytest.raises(ValueRangeError, match=r"region 'mouth' is .* inside the image of 128 x 170"):
        read_regions(video, outside, ["mouth"])
    with pytest.raises(NameMismatchError, match="found no chin"):
        read_regions(video, labels, ["chin"])
    cheek = replace(labels, regions={"cheek": (30.0, 85.0, 42.0, 97.0)})
    with pytest.raises(ValueRangeError, match=r"no painted pattern.*: 23% of region 'cheek' is brighter by 0\.05"):
        read_regions(video, cheek, ["cheek"])
    with pytest.raises(ShapeError, match=rf"found {labels.frames} frames, expected {labels.frames + 5} as its labels"):
        read_regions(video, replace(labels, frames=labels.frames + 5), ["mouth"])
    astray = replace(labels, markers=(labels.markers[0], (500.0, 3.0)), source="take.toml")
    with pytest.raises(AlignmentError, match=r"take.toml: the second of markers is at \(500.0, 3.0\)"):
        read_regions(video, astray, ["mouth"])
    path = tmp_path / "broken.avi"
    path.write_bytes(video.path.read_bytes()[:200_000])
    with pytest.raises(FileFormatError, match="could be decoded"):
        read_regions(path, labels, ["mouth"])
    black = write_video([torch.zeros(labels.frames, 170, 128, dtype=torch.uint8)], tmp_path / "black.avi", 20.0)
    with pytest.raises(ValueRangeError, match="no painted pattern"):
        read_regions(black, labels, ["mouth"])


def test_a_film_of_dark_paint_has_the_same_pattern(session: RecordedSession, regions: RegionVideo, tmp_path) -> None:
    count = 8
    frames = torch.stack([session.video.frame(t) for t in range(count)])
    video = write_video([255 - frames], tmp_path / "dark.avi", 20.0)
    labels = replace(session.labels, frames=count, neutral=0, performed=())
    with pytest.warns(UserWarning, match=r"dark\.avi: the paint is taken to be darker than the skin"):
        found = read_regions(video, labels, regions.names, size=regions.neutral.shape[-1])
    assert (found.neutral - regions.neutral).abs().mean() < 0.02


def test_a_film_is_classified_with_a_few_frames_in_memory_as_its_regions_are(
    classifier: ActionUnitClassifier, regions: RegionVideo, session: RecordedSession
) -> None:
    film = open_regions(session.video, session.labels, regions.names, size=regions.neutral.shape[-1])
    chunks = list(film.chunks())
    assert max(map(len, chunks)) <= 64 < len(regions.patterns)
    assert torch.equal(torch.cat(chunks), regions.patterns)
    assert torch.equal(film.rest, regions.patterns[session.labels.neutral])
    table, names = load_shape_table("arkit"), session.rig.names
    of_film = action_unit_curves(classifier, session.video, session.labels, table, names)
    reference = read_regions(session.video, session.labels, classifier.regions, classifier.neutral, classifier.size)
    of_regions = action_unit_curves(classifier, reference, session.labels, table, names)
    assert torch.equal(of_film.weights, of_regions.weights)
    assert torch.equal(of_film.active, of_regions.active)
