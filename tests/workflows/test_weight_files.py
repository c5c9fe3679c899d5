"""Weights on disk: any rig's names, Live Link Face where they allow, and what a take holds beside them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from torchface import BlendshapeRig, Take, Track, load_take, save_rig, save_take
from torchface.capture import MarkerSolver
from torchface.cli import main
from torchface.io import load_animation
from torchface.io.weights.live_link_csv import not_in_live_link
from torchface.io.weights.weight_csv import ROTATIONS, load_weights_csv, save_weights_csv
from torchface.shape_names import ARKIT, spelled_as
from torchface.synthetic.stages import StageFlaws, place_markers, record
from torchface.workflows.weight_files import WeightFiles, reduced_take, weight_faults, write_weights

Said = Callable[..., str]
DOME = ("jawOpen", "browInnerUp", "mouthSmileLeft", "mouthSmileRight")
OWN = ("ctrl_a", "ctrl_b", "ctrl_c", "ctrl_d")
HALVES = ("jawOpen", "browInnerUp_L", "mouthSmile_L", "mouthSmile_R")
TIMECODE = tuple(f"10:00:00:{frame:02d}.000" for frame in range(30))


@pytest.fixture(scope="module")
def stage(dome_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one rig by three sets of names, an attachment and a marker take."""
    folder = tmp_path_factory.mktemp("stage")
    sites = place_markers(dome_rig, 30)
    weights = 0.5 + 0.5 * torch.sin(torch.arange(30)[:, None] * torch.tensor([0.05, 0.11, 0.17, 0.23]))
    take = record(dome_rig, sites, weights, torch.Generator().manual_seed(0), StageFlaws(noise=0.05)).take
    for name, names in (("arkit", dome_rig.names), ("own", OWN), ("halves", HALVES)):
        save_rig(BlendshapeRig(dome_rig.neutral, dome_rig.deltas, names), folder / f"{name}.glb")
    sites.save(folder / "attachment.json")
    save_take(take, folder / "take.c3d")
    return folder


@pytest.fixture
def solve(stage: Path, messages_of: Said) -> Said:
    """Solves the take on a rig into its own file, and gives what is said."""

    def solved(rig: str, *more: str | Path, status: int = 0) -> str:
        words = ("solve", stage / f"{rig}.glb", stage / "take.c3d", "--attachment", stage / "attachment.json")
        return messages_of(*words, "--quiet", "--out", stage / f"{rig}.csv", *more, status=status)

    return solved


def values(path: Path) -> torch.Tensor:
    track = load_take(path).weights
    return track.values


def phone_take() -> Take:
    generator = torch.Generator().manual_seed(0)
    columns = {name: torch.randn(30, generator=generator, dtype=torch.float64) for name in ROTATIONS}
    track = Track(ARKIT, torch.rand(30, 52, 1, generator=generator))
    return Take(60.0, weights=track, timecode=TIMECODE, extras={"columns": columns})


def test_a_rig_with_names_of_its_own_is_solved_into_a_plain_table(stage: Path, solve: Said) -> None:
    solve("own")
    assert (stage / "own.csv").read_text().startswith("frame,time,ctrl_a,ctrl_b,ctrl_c,ctrl_d\n")
    solve("arkit")
    same = load_take(stage / "arkit.csv").weights.select([name[0].upper() + name[1:] for name in DOME])
    torch.testing.assert_close(values(stage / "own.csv"), same.values)


def test_names_decide_the_format_and_both_may_be_asked_for(stage: Path, solve: Said) -> None:
    solve("arkit")
    assert (stage / "arkit.csv").read_text().startswith("Timecode,BlendshapeCount,")
    live, plain = stage / "live.csv", stage / "halves.csv"
    told = solve("halves", "--live-link", live)
    assert plain.read_text().startswith("frame,time,jawOpen,browInnerUp_L,")
    assert live.read_text().startswith("Timecode,BlendshapeCount,")
    assert "does not give back" in told
    assert "browInnerUp_L" in told
    torch.testing.assert_close(values(plain)[:, 0], values(live)[:, [n.lower() for n in ARKIT].index("jawopen")])


def test_live_link_without_a_single_name_is_refused_before_the_solve(stage: Path, solve: Said) -> None:
    (stage / "own.csv").unlink(missing_ok=True)
    for more in (("--live-link", stage / "live.csv"), ("--stream", "udp://127.0.0.1:11111")):
        assert "expected at least one of ARKit's shapes" in solve("own", *more, status=2)
        assert not (stage / "own.csv").exists()


@pytest.mark.parametrize(
    ("names", "lost"),
    [
        (ARKIT, ()),
        (("eyeBlink_L", "JawOpen"), ()),
        (("browInnerUp_L", "browInnerUp_R", "jawOpen"), ("browInnerUp_L", "browInnerUp_R")),
        (OWN, OWN),
    ],
)
def test_what_live_link_would_not_give_back(names: tuple[str, ...], lost: tuple[str, ...]) -> None:
    assert not_in_live_link(names) == lost


def test_a_plain_table_keeps_timecode_and_rotations_to_the_bit(tmp_path: Path) -> None:
    take = replace(phone_take(), weights=Track(OWN, torch.rand(30, 4, 1)))
    save_weights_csv(take, tmp_path / "take.csv")
    back = load_take(tmp_path / "take.csv")
    assert back.weights.names == OWN
    assert torch.equal(back.weights.values, take.weights.values)
    assert back.timecode == TIMECODE
    assert back.extras["columns"].keys() == set(ROTATIONS)
    for name, column in take.extras["columns"].items():
        assert torch.equal(back.extras["columns"][name], column)
    bare = load_weights_csv(tmp_path / "take.csv")
    save_weights_csv(replace(bare, timecode=None, extras={}), tmp_path / "bare.csv")
    assert (tmp_path / "bare.csv").read_text().startswith("frame,time,ctrl_a,ctrl_b,ctrl_c,ctrl_d\n")


@pytest.mark.parametrize("target", ["arkit", "halves"])
def test_retarget_keeps_timecode_and_rotations(stage: Path, target: str) -> None:
    take = phone_take()
    save_take(take, stage / "phone.csv")
    out, live = stage / "moved.csv", stage / "moved_live.csv"
    words = ["retarget", stage / "phone.csv", "--to", stage / f"{target}.glb", "--out", out, "--live-link", live]
    main([str(word) for word in (*words, "--quiet")])
    for path in (out, live):
        moved = load_take(path)
        assert moved.timecode == TIMECODE
        for name, column in take.extras["columns"].items():
            torch.testing.assert_close(moved.extras["columns"][name], column, atol=1e-9, rtol=0)


def test_a_solved_take_is_saved_as_its_weights(stage: Path, dome_rig: BlendshapeRig) -> None:
    rig = BlendshapeRig(dome_rig.neutral, dome_rig.deltas, OWN)
    solved = MarkerSolver(rig, place_markers(dome_rig, 30)).solve_take(load_take(stage / "take.c3d"))
    save_take(solved, stage / "solved.csv")
    assert torch.equal(values(stage / "solved.csv"), solved.weights.values)


def test_what_is_wrong_with_weights_is_told_by_shape_and_frame() -> None:
    values = torch.full((6, 3, 1), 0.5)
    track = Track(("jawOpen", "mouthPucker", "eyeBlinkLeft"), values)
    assert weight_faults(track) == []
    values[4, 1], values[5, 2], values[2, 0] = torch.nan, torch.nan, 7.5
    assert weight_faults(track) == [
        "2 weights are missing, of mouthPucker, eyeBlinkLeft; the first is mouthPucker in frame 4",
        "1 weights are below 0 or above 1 (7.5 to 7.5), of jawOpen; the first is jawOpen in frame 2, 7.5",
    ]


def test_missing_weights_are_told_by_every_command(
    stage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def said() -> str:
        found = capsys.readouterr()
        return " ".join((found.out + found.err).replace("│", "").split())

    values = torch.zeros(5, 2, 1)
    values[3, 1], values[1, 0] = torch.nan, 1.5
    file = tmp_path / "gaps.csv"
    save_weights_csv(Take(30.0, weights=Track(("jawOpen", "tongueOut"), values)), file)
    assert main(["info", str(file)]) in (0, None)
    told = "1 weights are missing, of tongueOut; the first is tongueOut in frame 3"
    assert told in said()
    rig = str(stage / "arkit.glb")
    for command in (
        ["retarget", str(file), "--to", rig, "--out", str(tmp_path / "out.csv")],
        ["evaluate", str(file), str(file), "--rig", rig, "--out", str(tmp_path / "out")],
        ["render", rig, "--take", str(file), "--out", str(tmp_path / "out.png")],
        ["demo", "--take", str(file), "--out", str(tmp_path / "out")],
    ):
        with pytest.raises(SystemExit):
            main([*command, "-q"])
        assert told in said()
        assert {path.name for path in tmp_path.iterdir()} == {"gaps.csv"}
    values[0] = torch.nan  # no face, which is no fault
    save_weights_csv(Take(30.0, weights=Track(("jawOpen", "tongueOut"), values)), file)
    with pytest.raises(SystemExit):
        main(["retarget", str(file), "--to", rig, "--out", str(tmp_path / "out.csv"), "-q"])
    assert told in said()


def test_a_frame_without_a_face_stays_one(stage: Path, tmp_path: Path, messages_of: Said) -> None:
    values = torch.zeros(5, 2, 1)
    values[3], values[1, 0], values[4, 0] = torch.nan, 1.5, 0.5
    save_weights_csv(Take(30.0, weights=Track(("jawOpen", "browInnerUp"), values)), tmp_path / "gaps.csv")
    (tmp_path / "table.toml").write_text("[ctrl_a]\nsum = { jawOpen = 1.0 }\n")
    words = ("retarget", tmp_path / "gaps.csv", "--to", stage / "own.glb", "--out", tmp_path / "out.csv")
    words = (*words, "--table", tmp_path / "table.toml", "-q")
    shown = messages_of(*words)
    assert "2 weights are missing, of jawOpen, browInnerUp" in shown
    assert "1 weights are below 0 or above 1 (1.5 to 1.5), of jawOpen" in shown
    moved = load_take(tmp_path / "out.csv").weights
    assert moved.values.isnan().all(1)[:, 0].tolist() == [False, False, False, True, False]
    assert torch.isfinite(moved.values[[0, 1, 2, 4]]).all()
    words = (*words, "--animation", tmp_path / "a.glb")
    assert "1 frames without a face take what lies between" in messages_of(*words)
    played = load_animation(tmp_path / "a.glb").weights
    assert played.select(["ctrl_a"]).values.flatten().tolist() == pytest.approx([0, 1, 0, 0.25, 0.5])
    save_weights_csv(Take(30.0, weights=Track(("jawOpen", "browInnerUp"), values * torch.nan)), tmp_path / "gaps.csv")
    assert "expected a frame with a face for an animation" in messages_of(*words, status=2)


def test_weights_go_to_a_csv_only(stage: Path, tmp_path: Path, messages_of: Said) -> None:
    words = ("solve", stage / "arkit.glb", stage / "take.c3d", "--attachment", stage / "attachment.json", "--out")
    said = messages_of(*words, tmp_path / "weights.xlsx", status=2)
    assert "weights.xlsx: found the ending '.xlsx', expected .csv" in said
    assert not list(tmp_path.iterdir())


def lines_at(keys: Take, times: torch.Tensor) -> np.ndarray:
    """What straight lines between a take's keys are at some times, (T,N)."""
    rows = keys.weights.values[..., 0].double().T.numpy()
    return np.stack([np.interp(times.numpy(), keys.times.numpy(), row) for row in rows], 1)


@pytest.mark.parametrize(("rig", "ending"), [("own", ".glb"), ("arkit", ".ma"), ("arkit", ".usdc")])
def test_few_keys_are_written_within_a_bound_of_every_frame(rig: str, ending: str, stage: Path, solve: Said) -> None:
    solve(rig)
    whole, moved = load_take(stage / f"{rig}.csv"), stage / f"moved{ending}"
    told = solve(rig, "--reduce", "0.05", "--animation", moved)
    few = load_take(stage / f"{rig}.csv")
    assert told.count(" keys, largest error 0.0") == 2
    assert f"{len(few)} of 30 keys" in told
    assert f"warning: {stage / rig}" not in told
    assert len(few) < 20
    names = few.weights.names
    assert np.abs(lines_at(few, whole.times) - whole.weights.select(names).values[..., 0].numpy()).max() <= 0.05 + 1e-6
    assert float(few.times[-1]) == pytest.approx(float(whole.times[-1]), abs=1e-4)
    if ending != ".ma":
        main(["convert", str(moved), str(stage / "again.glb"), "--reduce", "0.1", "--quiet"])
        again = load_animation(stage / "again.glb")
        assert len(again) < len(few)
        own = whole.weights.select([spelled_as(name, whole.weights.names) for name in again.weights.names])
        assert np.abs(lines_at(again, whole.times) - own.values[..., 0].numpy()).max() <= 0.15 + 1e-6


def test_reduced_takes_keep_rotations_timecodes_and_frame_numbers(tmp_path: Path) -> None:
    take = phone_take()
    smooth = torch.linspace(0, 1, 30)
    columns = {name: 0.3 * smooth.double().square() for name in ROTATIONS}
    track = Track(OWN, (smooth[:, None] * torch.tensor([0.2, 0.4, 0.0, 1.0]))[..., None])
    few, reduction = reduced_take(replace(take, weights=track, extras={"columns": columns}), 2e-3)
    assert (reduction.before, reduction.after) == (30, len(few))
    assert 2 < len(few) < 12  # the rotations bend
    rows = few.extras["frame_numbers"]
    assert few.timecode == tuple(TIMECODE[row] for row in rows.tolist())
    between = np.interp(np.arange(30), rows.numpy(), few.extras["columns"]["HeadYaw"].numpy())
    assert np.abs(between - columns["HeadYaw"].numpy()).max() <= 2e-3
    save_take(few, tmp_path / "few.csv")
    back = load_take(tmp_path / "few.csv")
    assert back.fps == 60.0
    assert torch.equal(back.extras["frame_numbers"], rows)
    torch.testing.assert_close(back.times, rows.double() / 60)


@pytest.mark.parametrize("bound", ["0", "-1", "nan", "2"])
def test_other_bounds_are_refused(bound: str, stage: Path, solve: Said, messages_of: Said) -> None:
    assert "--reduce: found" in solve("own", "--reduce", bound, status=2)
    messages_of("convert", stage / "own.glb", stage / "b.glb", "--reduce", bound, status=2)


def test_eyes_turn_in_live_link_as_the_weights_say(tmp_path: Path, dome_rig: BlendshapeRig) -> None:
    """By the usual 30 degrees at weight 1, where no eyeball shows another; a take's own columns stay as they are."""
    values = torch.zeros(2, len(ARKIT), 1)
    values[1, ARKIT.index("eyeLookInLeft")] = 0.5
    take = Take(30.0, weights=Track(ARKIT, values))
    write_weights(take, WeightFiles(tmp_path / "w.csv"), dome_rig)
    columns = load_take(tmp_path / "w.csv").extras["columns"]
    assert float(columns["LeftEyeYaw"][1]) == pytest.approx(0.5 * 0.52, abs=1e-4)
    assert not any(bool(columns[name].any()) for name in ROTATIONS if name != "LeftEyeYaw")
    own = {name: torch.full((2,), 0.1).double() for name in ROTATIONS}
    write_weights(replace(take, extras={"columns": own}), WeightFiles(tmp_path / "own.csv"), dome_rig)
    assert torch.allclose(load_take(tmp_path / "own.csv").extras["columns"]["LeftEyeYaw"], own["LeftEyeYaw"])


def test_a_whole_shape_comes_back_from_live_links_two_halves(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    names = ("mouthSmile", "browInnerUp_L", "browInnerUp_R", "ctrl")
    rig = BlendshapeRig(dome_rig.neutral, dome_rig.deltas, names)
    take = Take(60.0, weights=Track(names, torch.rand(30, 4, 1)))
    (warning,), _ = write_weights(take, WeightFiles(tmp_path / "out.csv", live_link=tmp_path / "live.csv"), rig)
    assert warning.endswith(": browInnerUp_L, browInnerUp_R, ctrl")
    back = rig.weights_from(load_take(tmp_path / "live.csv").weights)
    torch.testing.assert_close(back[:, 0], take.weights.values[:, 0, 0])


def test_markers_that_no_frame_shows_are_named(stage: Path, solve: Said, messages_of: Said, tmp_path: Path) -> None:
    assert "no frame shows" not in solve("own")
    take = load_take(stage / "take.c3d").markers
    hidden, absent = take.names[3], take.names[8]
    take.values[:, 3] = torch.nan
    save_take(Take(60.0, markers=take.select([name for name in take.names if name != absent])), tmp_path / "take.c3d")
    files = (stage / "own.glb", tmp_path / "take.c3d", "--attachment", stage / "attachment.json")
    warned = messages_of("solve", *files, "--quiet", "--out", tmp_path / "out.csv")
    assert f"no frame shows {hidden}, {absent}, of the attachment's" in warned
