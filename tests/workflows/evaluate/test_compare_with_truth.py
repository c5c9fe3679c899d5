"""A result's files against the truth's: whatever form they have, the figures are those of what was planted."""

import csv
import json
import re
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest
import torch

from torchface import BlendshapeRig, Mesh, Take, Track, load_rig, save_animation, save_mesh, save_rig
from torchface.cli import main
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, TopologyError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix
from torchface.io.meshes.mesh_sequence import MeshSequenceWriter
from torchface.io.weights.weight_csv import save_weights_csv
from torchface.mesh import Annotations
from torchface.workflows.evaluate.compare_with_truth import ALL, EvaluationSettings, evaluate

FRAMES = 6
NAMES = ("jawOpen", "browInnerUp", "mouthSmileLeft", "mouthSmileRight")


@pytest.fixture
def rig(dome_rig: BlendshapeRig) -> BlendshapeRig:
    """The dome, with a region and many landmarks."""
    upper = dome_rig.vertices[:, 1] > -20
    marks = torch.arange(70, 625, 17)
    notes = Annotations(landmarks=marks, regions={"upper": upper})
    return BlendshapeRig(replace(dome_rig.neutral, annotations=notes), dome_rig.deltas, dome_rig.names)


@pytest.fixture
def weights() -> torch.Tensor:
    return torch.rand(FRAMES, 4, generator=torch.Generator().manual_seed(0))


@pytest.fixture
def folder(rig: BlendshapeRig, weights: torch.Tensor, tmp_path: Path) -> Path:
    """The truth in every form that a file may have."""
    take = Take(30.0, weights=Track(NAMES, weights[..., None]))
    save_rig(rig, tmp_path / "rig.glb")
    save_weights_csv(take, tmp_path / "true.csv")
    save_animation(rig, take, tmp_path / "true.glb")
    write_sequence(tmp_path / "true.safetensors", rig(weights), rig.neutral.faces)
    (tmp_path / "meshes").mkdir()
    for frame, vertices in enumerate(rig(weights)):
        save_mesh(rig.neutral.with_vertices(vertices), tmp_path / "meshes" / f"f{frame}.ply")
    return tmp_path


def write_sequence(path: Path, vertices: torch.Tensor, faces: torch.Tensor) -> None:
    with MeshSequenceWriter(path, len(vertices), vertices.shape[1], faces) as writer:
        writer.append(vertices)


@pytest.mark.parametrize("truth", ["true.csv", "true.glb", "true.safetensors", "meshes"])
def test_a_planted_displacement_is_found_against_every_form_of_the_truth(
    truth: str, folder: Path, rig: BlendshapeRig, weights: torch.Tensor
) -> None:
    vertices = rig(weights)
    vertices[:, :300, 2] += 1.5  # no two vertices are moved alike, but for these
    vertices[2] = torch.nan
    write_sequence(folder / "found.safetensors", vertices, rig.neutral.faces)
    settings = EvaluationSettings(rig=folder / "rig.glb")
    found = evaluate(folder / "found.safetensors", folder / truth, folder / "out", settings)
    assert found.regions[ALL].mean == pytest.approx(1.5 * 300 / 625, rel=1e-4)
    assert found.regions[ALL].largest == pytest.approx(1.5, rel=1e-4)
    assert found.regions[ALL].total == pytest.approx(450, rel=1e-4)
    upper = rig.neutral.annotations.regions["upper"]
    assert found.regions["upper"].mean == pytest.approx(1.5 * float((upper.nonzero() < 300).float().mean()), rel=1e-3)
    assert torch.isnan(found.frame_mean[2])
    assert "1 of 6 frames are NaN" in " ".join(found.lines())
    rows = list(csv.DictReader((folder / "out" / "frames.csv").open()))
    assert [row["mean_mm"] == "" for row in rows] == [False, False, True, False, False, False]
    assert float(rows[0]["total_mm"]) == pytest.approx(450, rel=1e-4)
    told = json.loads((folder / "out" / "summary.json").read_text())
    assert told["regions"][ALL]["mean"] == found.regions[ALL].mean
    assert told["alignment"] == "none"


def test_weights_are_compared_by_shape_and_the_report_shows_it_all(
    folder: Path, weights: torch.Tensor, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(import_module("torchface.cli.evaluate"), "_SHOWN", 0)
    wrong = (weights * torch.tensor([1.0, 0.5, 1, 1])).clamp(0, 1)
    save_weights_csv(Take(30.0, weights=Track(NAMES, wrong[..., None])), folder / "found.csv")
    words = (
        "evaluate",
        folder / "found.csv",
        folder / "true.glb",
        "--rig",
        folder / "rig.glb",
        "--out",
        folder / "out",
    )
    main([*map(str, words), "--quiet", "--height", "40"])
    told = capsys.readouterr()
    assert told.out.strip() == str(folder / "out" / "index.html")
    assert "over 4 shapes" in told.err
    assert not re.search(r"\de[+-]\d", told.err)
    assert "regions.csv has all" in " ".join(told.err.split())
    assert "upper" not in told.err.partition("frames compared")[0]
    rows = {row["shape"]: row for row in csv.DictReader((folder / "out" / "shapes.csv").open())}
    assert float(rows["browInnerUp"]["mean"]) == pytest.approx(float(weights[:, 1].mean() / 2), rel=1e-4)
    assert float(rows["jawOpen"]["mean"]) == pytest.approx(0, abs=1e-6)
    page = (folder / "out" / "index.html").read_text()
    assert "RdYlGn_r" in page
    for picture in ("heat_mean.png", "frames.png", "shapes.png"):
        assert picture in page
        assert (folder / "out" / picture).is_file()
    assert not list((folder / "out").glob(".*part*"))


def test_files_of_one_name_are_named_with_their_folders(folder: Path, weights: torch.Tensor) -> None:
    places = folder / "a" / "weights.csv", folder / "b" / "weights.csv"
    for place in places:
        place.parent.mkdir()
        save_weights_csv(Take(30.0, weights=Track(NAMES, weights[..., None])), place)
    main(["evaluate", *map(str, places), "--rig", str(folder / "rig.glb"), "--out", str(folder / "out"), "--quiet"])
    page = (folder / "out" / "index.html").read_text()
    assert f"{places[0]} against {places[1]}" in page


def test_shapes_that_the_result_does_not_have_are_named(folder: Path, weights: torch.Tensor) -> None:
    """A program that gives no brows has them at rest, which is no finding."""
    settings = EvaluationSettings(rig=folder / "rig.glb")
    for kept, named in (((0, 2), "browInnerUp, mouthSmileRight"), ((0, 1, 2, 3), None)):
        track = Track([NAMES[i] for i in kept], weights[:, list(kept), None])
        save_weights_csv(Take(30.0, weights=track), folder / "part.csv")
        lines = evaluate(folder / "part.csv", folder / "true.csv", folder / "out", settings).lines()
        assert [line for line in lines if "part.csv has no" in line] == (
            [] if named is None else [f"part.csv has no {named}, which true.csv moves: taken for 0"]
        )


def test_alignment_is_done_where_it_is_asked_for(folder: Path, rig: BlendshapeRig, weights: torch.Tensor) -> None:
    turn = rotation_matrix(torch.tensor([0.0, 0.2, 0.0]))
    moved = rig(weights) @ turn.T + torch.tensor([10.0, 0.0, 0.0])
    write_sequence(folder / "found.safetensors", moved, rig.neutral.faces)
    paths = folder / "found.safetensors", folder / "true.glb", folder / "out"
    assert evaluate(*paths).regions[ALL].mean > 5
    laid = evaluate(*paths, EvaluationSettings(align=True))
    assert laid.regions[ALL].mean < 1e-3
    torch.testing.assert_close(
        laid.rotation, torch.full((FRAMES,), float(torch.rad2deg(torch.tensor(0.2)))), rtol=1e-3, atol=0
    )


def test_frames_may_be_picked(folder: Path, rig: BlendshapeRig, weights: torch.Tensor) -> None:
    save_weights_csv(Take(30.0, weights=Track(NAMES, weights[[4, 1]][..., None])), folder / "some.csv")
    settings = EvaluationSettings(rig=folder / "rig.glb", frames=(4, 1))
    found = evaluate(folder / "true.csv", folder / "some.csv", folder / "out", settings)
    assert found.regions[ALL].largest < 1e-4
    assert found.frames.tolist() == [4, 1]
    with pytest.raises(ShapeError, match=r"found 6 frames, expected the 2 .*--frames"):
        evaluate(folder / "true.csv", folder / "some.csv", folder / "out", EvaluationSettings(folder / "rig.glb"))
    for wrong, message in (((4, 6), "found frame 6"), ((1,), "found 1 frames")):
        with pytest.raises(ShapeError, match=message):
            evaluate(folder / "true.csv", folder / "some.csv", folder / "out", replace(settings, frames=wrong))


def test_meshes_that_lack_frames_are_said_to_be_compared_by_their_place(folder: Path) -> None:
    (folder / "meshes" / "f5.ply").rename(folder / "meshes" / "f7.ply")
    settings = EvaluationSettings(rig=folder / "rig.glb")
    for one, other in (("meshes", "true.safetensors"), ("true.safetensors", "meshes")):
        (note,) = evaluate(folder / one, folder / other, folder / "out", settings).notes
        lost = "meshes: 2 of 8 frames are missing, first from f4.ply to f7.ply"
        assert note == f"warning: {lost}; the first frame was compared with the first, and so on"
    assert evaluate(folder / "meshes", folder / "meshes", folder / "out", settings).notes == ()


def test_what_does_not_fit_is_told(folder: Path, rig: BlendshapeRig, weights: torch.Tensor) -> None:
    true, out = folder / "true.glb", folder / "out"
    with pytest.raises(NameMismatchError, match="weights without a rig"):
        evaluate(folder / "true.csv", true, out)
    sheet = Mesh(torch.rand(4, 3), torch.tensor([[0, 1, 2], [1, 2, 3]]))
    save_mesh(sheet, folder / "sheet.ply")
    with pytest.raises(TopologyError, match=r"found 4 vertices and 2 triangles.*torchface register first"):
        evaluate(true, folder / "sheet.ply", out)
    write_sequence(folder / "nan.safetensors", torch.full((FRAMES, 625, 3), torch.nan), rig.neutral.faces)
    with pytest.raises(ValueRangeError, match="NaN in every frame"):
        evaluate(folder / "nan.safetensors", true, out)
    (folder / "a.doc").write_bytes(b"words")
    with pytest.raises(FileFormatError, match=r"ending '\.doc'"):
        evaluate(folder / "a.doc", true, out)
    with pytest.raises(ValueRangeError, match="scale"):
        evaluate(true, true, out, EvaluationSettings(maximum=0.0))
    (folder / "empty").mkdir()
    with pytest.raises(FileFormatError, match="no mesh"):
        evaluate(true, folder / "empty", out)
    assert not (out / "summary.json").exists()


def test_frames_are_compared_with_those_of_their_times(folder: Path, weights: torch.Tensor) -> None:
    many = torch.rand(180, 4, generator=torch.Generator().manual_seed(1))
    whole = Take(60.0, weights=Track(NAMES, many[..., None]))
    save_weights_csv(whole, folder / "whole.csv")
    save_weights_csv(whole.frames(slice(0, 40)), folder / "first.csv")
    save_weights_csv(whole.frames(slice(100, 140)), folder / "later.csv")
    settings = EvaluationSettings(rig=folder / "rig.glb")
    with pytest.raises(
        ValueRangeError, match=r"found 40 frames from 0.000 to 0.650 s, .* 1.667 to 2.317 s: 0 have one"
    ):
        evaluate(folder / "first.csv", folder / "later.csv", folder / "out", settings)
    by_number = evaluate(folder / "first.csv", folder / "later.csv", folder / "out", replace(settings, by_number=True))
    assert by_number.frames.tolist() == list(range(40))
    assert by_number.regions[ALL].largest > 1
    found = evaluate(folder / "later.csv", folder / "whole.csv", folder / "out", settings)
    assert found.regions[ALL].largest < 1e-4
    assert any(
        "40 frames at the same times were compared, 0 to 39 of the result with 100 to 139" in n for n in found.notes
    )


def test_frames_of_a_variable_rate_are_compared_at_their_times(folder: Path) -> None:
    many = torch.rand(40, 4, generator=torch.Generator().manual_seed(1))
    seconds = (
        torch.rand(40, generator=torch.Generator().manual_seed(2), dtype=torch.float64).mul(0.05).add(0.01).cumsum(0)
    )
    take = Take(30.0, weights=Track(NAMES, many[..., None]), seconds=seconds)
    save_weights_csv(take, folder / "uneven.csv")
    save_animation(load_rig(folder / "rig.glb"), take, folder / "uneven.glb")
    settings = EvaluationSettings(rig=folder / "rig.glb")
    assert evaluate(folder / "uneven.csv", folder / "uneven.glb", folder / "out", settings).regions[ALL].largest < 1e-4


def test_uneven_and_even_takes_of_one_length_are_compared_at_the_times_of_the_result(folder: Path) -> None:
    slopes = torch.tensor([0.3, 0.2, 0.1, 0.25])
    even = torch.arange(40, dtype=torch.float64) / 30
    uneven = (even / even[-1]) ** 1.3 * even[-1]  # by number frames lie up to 0.1 s apart
    for name, times, seconds in (("even", even, None), ("uneven", uneven, uneven)):
        weights = Track(NAMES, (times[:, None] * slopes).float()[..., None])
        save_weights_csv(Take(30.0, weights=weights, seconds=seconds), folder / f"{name}.csv")
    save_weights_csv(
        Take(30.0, weights=Track(NAMES, torch.zeros(40, 4, 1)), seconds=uneven + 9.0), folder / "after.csv"
    )
    settings = EvaluationSettings(rig=folder / "rig.glb")
    for result, truth in (("even", "uneven"), ("uneven", "even")):
        found = evaluate(folder / f"{result}.csv", folder / f"{truth}.csv", folder / "out", settings)
        assert found.regions[ALL].largest < 1e-3
        assert found.frames.tolist() == list(range(40))
        assert any(
            "40 of the result's 40 frames were compared, each with the truth at its time" in n for n in found.notes
        )
        numbered = replace(settings, by_number=True)
        by_number = evaluate(folder / f"{result}.csv", folder / f"{truth}.csv", folder / "out", numbered)
        assert by_number.regions[ALL].largest > 0.1
    with pytest.raises(ValueRangeError, match=r"s from the nearest; .*--by-number"):
        evaluate(folder / "even.csv", folder / "after.csv", folder / "out", settings)


def test_takes_of_other_rates_are_compared_at_the_times_of_the_result(folder: Path, rig: BlendshapeRig) -> None:
    slopes = torch.tensor([0.3, 0.2, 0.1, 0.25])
    slow, fast = (torch.arange(count)[:, None] / rate * slopes for count, rate in ((24, 24.0), (60, 60.0)))  # a second
    for name, values, rate in (("slow", slow, 24.0), ("fast", fast, 60.0)):
        save_weights_csv(Take(rate, weights=Track(NAMES, values[..., None])), folder / f"{name}.csv")
    every_second = Take(60.0, weights=Track(NAMES, fast[..., None])).rows(torch.arange(0, 60, 2))
    save_weights_csv(every_second, folder / "half.csv")
    with MeshSequenceWriter(folder / "slow.safetensors", 24, 625, rig.neutral.faces, fps=24.0) as writer:
        writer.append(rig(slow))
    settings = EvaluationSettings(rig=folder / "rig.glb")

    def compared(result: str, truth: str) -> tuple[list[int], str]:
        found = evaluate(folder / result, folder / truth, folder / "out", settings)
        assert found.regions[ALL].largest < 1e-3
        assert found.shapes is None or float(found.shapes.error.largest.max()) < 1e-5
        return found.frames.tolist(), " ".join(found.notes)

    frames, note = compared("half.csv", "fast.csv")
    assert frames == list(range(30))
    assert "30 frames at the same times" in note
    assert compared("fast.csv", "half.csv")[0] == list(range(0, 60, 2))
    for slower in ("slow.csv", "slow.safetensors"):
        frames, note = compared(slower, "fast.csv")
        assert frames == list(range(24))
        assert "24 of the result's 24 frames were compared, each with the truth at its time" in note
    frames, note = compared("fast.csv", "slow.csv")
    assert len(frames) == 23  # the frame nearest to the last lies behind it
    assert all(abs(frame / 60 - row / 24) < 1 / 100 for row, frame in enumerate(frames))
    assert "23 of the result's 60 frames" in note


def test_takes_of_other_rates_at_other_times_are_refused(folder: Path) -> None:
    settings = EvaluationSettings(rig=folder / "rig.glb")
    many = Take(60.0, weights=Track(NAMES, torch.rand(180, 4, 1)))
    save_weights_csv(many.frames(slice(0, 40)), folder / "first.csv")
    save_weights_csv(many.rows(torch.arange(100, 180, 2)[:30]), folder / "later.csv")
    with pytest.raises(ValueRangeError, match=r"found 40 frames from 0.000 to 0.650 s, .* 1.667 to .* 0 have one"):
        evaluate(folder / "first.csv", folder / "later.csv", folder / "out", settings)
