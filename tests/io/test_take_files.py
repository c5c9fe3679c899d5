"""load_take and save_take: which format by suffix, header, and what the take holds; the units of weights and angles."""

import math
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from mutation import check_reader

from torchface import Take, Track, load_take, save_take
from torchface.errors import FileFormatError, ValueRangeError
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT


def _markers() -> Track:
    return Track(("nose", "chin"), torch.randn(4, 2, 3, generator=torch.Generator().manual_seed(0)))


@pytest.mark.parametrize("suffix", [".c3d", ".C3D", ".trc", ".csv"])
def test_markers_go_to_the_format_of_the_suffix(suffix: str, tmp_path: Path) -> None:
    take = Take(100.0, markers=_markers())
    save_take(take, tmp_path / f"take{suffix}")
    back = load_take(tmp_path / f"take{suffix}")
    assert torch.equal(back.markers.values, take.markers.values)
    in_metres = load_take(tmp_path / f"take{suffix}", unit="m")
    torch.testing.assert_close(in_metres.markers.values, 1000 * take.markers.values)


@pytest.mark.parametrize(
    ("names", "first"), [(ARKIT, "Timecode,BlendshapeCount,EyeBlinkLeft"), (ARKIT[:-1], "frame,time,eyeBlinkLeft")]
)
def test_only_arkits_whole_set_becomes_a_live_link_file(names: tuple[str, ...], first: str, tmp_path: Path) -> None:
    take = Take(60.0, weights=Track(names, torch.rand(3, len(names), 1, generator=torch.Generator().manual_seed(0))))
    save_take(take, tmp_path / "take.csv")
    assert (tmp_path / "take.csv").read_text().startswith(first)
    back = load_take(tmp_path / "take.csv").weights
    assert [name.lower() for name in back.names] == [name.lower() for name in names]
    assert torch.equal(back.values, take.weights.values)


def test_a_csv_holds_the_weights_or_the_one_track_there_is(tmp_path: Path) -> None:
    take = Take(60.0, markers=_markers(), weights=Track(("smile",), torch.full((4, 1, 1), 0.5)))
    save_take(take, tmp_path / "take.csv")
    back = load_take(tmp_path / "take.csv")
    assert back.markers is None
    assert back.weights.names == ("smile",)
    landmarks = Track(("nose", "chin"), torch.zeros(4, 2, 2))
    with pytest.raises(ValueRangeError, match=r"take\.csv: found a take of markers and landmarks, expected one"):
        save_take(Take(60.0, markers=_markers(), landmarks=landmarks), tmp_path / "take.csv")
    with pytest.raises(ValueRangeError, match=r"take\.csv: found a take of no track"):
        save_take(Take(60.0), tmp_path / "take.csv")
    save_take(take, tmp_path / "take.c3d")
    assert load_take(tmp_path / "take.c3d").weights is None


def test_what_no_reader_knows_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"take\.fbx: found the ending '\.fbx', expected \.c3d, \.trc, \.csv"):
        load_take(tmp_path / "take.fbx")
    with pytest.raises(FileFormatError, match=r"take\.glb: found .*torchface\.io\.load_animation reads \.glb"):
        load_take(tmp_path / "take.glb")
    with pytest.raises(FileFormatError, match=r"take\.fbx: found the ending"):
        save_take(Take(60.0, markers=_markers()), tmp_path / "take.fbx")
    with pytest.raises(FileFormatError, match=r"take\.c3d: found no such file"):
        load_take(tmp_path / "take.c3d")
    (tmp_path / "take.csv").write_text("a,b\n1,2\n")
    with pytest.raises(FileFormatError, match=r"take\.csv: found the columns 'a', 'b'; expected Timecode"):
        load_take(tmp_path / "take.csv")


def test_a_mutated_csv_of_any_kind_is_read_or_refused(tmp_path: Path) -> None:
    values = torch.rand(3, 2, 2, generator=torch.Generator().manual_seed(0))
    takes = {
        "markers": Take(60.0, markers=_markers()),
        "landmarks": Take(60.0, landmarks=Track(("0", "1"), values)),
        "weights": Take(60.0, weights=Track(("jawOpen", "smile"), values[..., :1])),
        "live_link": Take(60.0, weights=Track(ARKIT, torch.zeros(3, 52, 1))),
    }
    for name, take in takes.items():
        save_take(take, tmp_path / f"{name}.csv")
    check_reader(load_take, [tmp_path / f"{name}.csv" for name in takes], ".csv")


def planted(names: tuple[str, ...]) -> Take:
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(100, len(names), 1, generator=generator)
    angles = 0.6 * torch.randn(100, len(ROTATIONS), dtype=torch.float64, generator=generator).clamp(-1.5, 1.5)
    columns = {name: angles[:, i] for i, name in enumerate(ROTATIONS)}
    return Take(60.0, weights=Track(names, weights), extras={"columns": columns})


@pytest.mark.parametrize("names", [ARKIT, ("one", "two")], ids=["Live Link", "plain"])
def test_percent_and_degrees_are_converted_and_said(names: tuple[str, ...], tmp_path: Path) -> None:
    take = planted(names)
    columns = {name: column * 180 / math.pi for name, column in take.extras["columns"].items()}
    percent = Track(names, 100 * take.weights.values)
    save_take(replace(take, weights=percent, extras={"columns": columns}), tmp_path / "take.csv")
    with pytest.warns(UserWarning, match="taken for") as said:
        found = load_take(tmp_path / "take.csv")
    texts = [str(one.message) for one in said]
    assert any("found weights up to 9" in text and "taken for percent" in text for text in texts)
    assert any("rotations up to 51.57, expected radians; they are taken for degrees" in text for text in texts)
    torch.testing.assert_close(found.weights.values, take.weights.values)
    for name in ROTATIONS:
        torch.testing.assert_close(found.extras["columns"][name], take.extras["columns"][name])


def test_usual_units_and_single_wild_frames_stay(tmp_path: Path) -> None:
    take = planted(("one", "two"))
    values = take.weights.values.clone().repeat(3, 1, 1)
    values[7] = 80.0
    columns = {name: column.repeat(3) for name, column in take.extras["columns"].items()}
    columns["HeadYaw"][3] = 50.0
    save_take(Take(60.0, weights=Track(("one", "two"), values), extras={"columns": columns}), tmp_path / "take.csv")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = load_take(tmp_path / "take.csv")
    assert found.weights.values.equal(values)
    assert found.extras["columns"]["HeadYaw"].equal(columns["HeadYaw"])


@pytest.mark.real
def test_real_takes_are_in_usual_units(performances: list[Path]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for path in performances:
            load_take(path)
