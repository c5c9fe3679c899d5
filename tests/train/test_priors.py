"""The recipe end to end: synthetic takes, weight takes, marker takes, another rig's names, bad input."""

import shutil
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import BlendshapeRig, Take, load_take, save_take, zoo
from torchface.capture import DynamicsPrior, DynamicsSettings, ShapePrior
from torchface.capture.priors import ReciprocalPrior
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, TorchfaceError, ValueRangeError
from torchface.shape_names import mapping
from torchface.synthetic import performer
from torchface.synthetic.stages import perform, place_markers
from torchface.take import Track
from train import prior_takes
from train.prior_takes import read_takes, renamed, split, synthetic_takes
from train.priors import Settings, train

ICT_LIKE = ("browInnerUp_L", "browInnerUp_R", "eyeBlink_L", "eyeBlink_R", "jawOpen", "cheekRaiser_L", "earWiggle_L")


def saved(folder: Path, name: str, frames: int = 160, seed: int = 0, fps: float = 60.0) -> Take:
    take = perform(frames, torch.Generator().manual_seed(seed), fps)
    save_take(take, folder / f"{name}.csv")
    return take


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("takes")
    for seed in range(4):
        saved(path, f"take_{seed}", seed=seed)
    return path


def test_both_priors_of_weight_takes(folder: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    settings = Settings(
        takes=folder,
        out=tmp_path / "own",
        held_out=1,
        window=3,
        inducing=20,
        iterations=3,
        strength=0.3,
        trial_frames=4,
    )
    measured = train(settings, lambda step, *_: lines.append(step))
    assert set(measured) == {"own_shape", "own_dynamics"} == {folder.name for folder in settings.folders}
    shape, dynamics = (zoo.get_model(tmp_path / name) for name in measured)
    assert isinstance(shape, ShapePrior)
    assert isinstance(dynamics, DynamicsPrior)
    assert shape.names == dynamics.names
    assert shape.strength == 0.3
    assert (dynamics.window, dynamics.input_noise) == (3, 0.01)
    assert dynamics.fps == pytest.approx(60.0, rel=1e-3)
    found = measured["own_dynamics"]
    assert found["held out, one-step error"] < found["held out, one-step error of extrapolation"]
    solved = measured["own_shape"]
    assert solved["held out, error of a weight"] < solved["held out, error of a weight without a prior"]
    record = zoo.describe(tmp_path / "own_dynamics")
    assert record.recipe.startswith("torchface train priors --takes")
    assert "--window 3" in record.recipe
    assert record.licence == "that of the takes"
    for picture in ("calibration", "curves"):
        assert (tmp_path / "own_dynamics" / "pictures" / f"{picture}.png").stat().st_size > 5000
    assert any("480 frames of 3 takes" in line for line in lines)


def test_the_window_is_chosen_and_the_rate_is_the_one_asked_for(folder: Path, tmp_path: Path) -> None:
    settings = Settings(takes=folder, out=tmp_path / "own", kind="dynamics", fps=30.0, inducing=10, iterations=1)
    (found,) = train(settings).values()
    prior = zoo.get_model(tmp_path / "own")
    assert prior.fps == 30.0
    assert prior.window == found["window"]
    assert (tmp_path / "own" / "pictures" / "window.png").stat().st_size > 5000


def test_the_papers_form_with_a_bandwidth(folder: Path, tmp_path: Path) -> None:
    settings = Settings(
        takes=folder, out=tmp_path / "own", kind="reciprocal", bandwidth=0.4, strength=0.1, trial_frames=2
    )
    (found,) = train(settings).values()
    prior = zoo.get_model(tmp_path / "own")
    assert isinstance(prior, ReciprocalPrior)
    assert prior.strength == 0.1
    assert found["bandwidth, lower"] == pytest.approx(0.4)


def test_names_of_another_rig(folder: Path, tmp_path: Path) -> None:
    takes, silent = renamed(read_takes(folder, tmp_path), ICT_LIKE)
    assert takes.names == ICT_LIKE
    assert silent == ("earWiggle_L",)
    own = read_takes(folder, tmp_path)
    brow = own.weights[0][:, [name.lower() for name in own.names].index("browinnerup")]
    for column in (0, 1):
        torch.testing.assert_close(takes.weights[0][:, column], brow)
    cheek = own.weights[0][:, [name.lower() for name in own.names].index("cheeksquintleft")]
    torch.testing.assert_close(takes.weights[0][:, 5], cheek)  # by its meaning
    with pytest.raises(NameMismatchError, match="none of which the takes have"):
        renamed(own, ["left", "right"])


def test_marker_takes_are_solved(tmp_path: Path) -> None:
    rig = performer(texture=False)
    attachment = place_markers(rig, 60)
    take = perform(40, torch.Generator().manual_seed(3))
    truth = shapes(take, rig)
    markers = attachment.on(rig.neutral.faces, rig(truth))
    save_take(Take(60.0, markers=Track(attachment.labels or (), markers)), tmp_path / "take.csv")
    found = read_takes(tmp_path, tmp_path / "work", rig=rig, attachment=attachment)
    assert found.solved == 1
    assert found.names == rig.names
    seen = [name for name in rig.names if not name.startswith("eyeLook")]
    rows = [rig.names.index(name) for name in seen]
    assert float((found.weights[0][:, rows] - truth[:, rows]).abs().mean()) < 0.03
    with pytest.raises(NameMismatchError, match="found markers, expected weights, or the rig"):
        read_takes(tmp_path, tmp_path / "work")


def shapes(take: Take, rig: BlendshapeRig) -> Tensor:
    return take.weights.values[..., 0] @ mapping(take.weights.names, rig.names).T


def test_takes_at_another_rate_are_brought_to_the_first(tmp_path: Path) -> None:
    saved(tmp_path, "a", 120, fps=60.0)
    saved(tmp_path, "b", 120, seed=1, fps=30.0)
    found = read_takes(tmp_path, tmp_path / "work")
    assert found.fps == pytest.approx(60.0, rel=1e-3)
    assert len(found.weights[1]) == pytest.approx(239, abs=2)


def test_a_run_that_was_killed_takes_up_the_takes_it_has_read(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_takes(folder, tmp_path)
    changed, damaged = tmp_path / "take_000001.safetensors", tmp_path / "take_000003.safetensors"
    damaged.write_bytes(damaged.read_bytes()[:-4] + b"\0\0\0\1")
    changed.unlink()
    again: list[str] = []
    monkeypatch.setattr(prior_takes, "load_take", lambda path: again.append(path.stem) or load_take(path))
    with pytest.warns(UserWarning, match="damaged checkpoint"):
        found = read_takes(folder, tmp_path)
    assert again == ["take_1", "take_3"]
    assert torch.equal(found.weights[3], read_takes(folder, tmp_path / "anew").weights[3])
    assert found.frames == (160,) * 4
    again.clear()
    saved(folder_of(folder, tmp_path / "others"), "take_2", 90, seed=8)
    assert read_takes(tmp_path / "others", tmp_path).frames == (160, 160, 90, 160)
    assert again == ["take_2"]


def folder_of(takes: Path, copy: Path) -> Path:
    return Path(shutil.copytree(takes, copy))


def test_takes_on_disk_give_the_priors_that_takes_in_memory_give(folder: Path, tmp_path: Path) -> None:
    kept = read_takes(folder, tmp_path)
    held, quick = list(kept.weights), DynamicsSettings(inducing=20, subset=200, iterations=2)
    assert not isinstance(kept.weights, list)
    for learn in (
        lambda takes: ShapePrior.fit(takes, kept.names),
        lambda takes: ReciprocalPrior.fit(takes, kept.names),
        lambda takes: DynamicsPrior.fit(takes, kept.names, 3, input_noise=0.01, settings=quick),
    ):
        found, wanted = learn(kept.weights).state_dict(), learn(held).state_dict()
        torch.testing.assert_close(found, wanted, rtol=0, atol=0)


def test_nobody_is_learned_from_and_tested_on(tmp_path: Path) -> None:
    for name in ("anna", "ben"):
        (tmp_path / "takes" / name).mkdir(parents=True)
        for take in range(2):
            saved(tmp_path / "takes" / name, f"take_{take}", 30)
    saved(tmp_path / "takes", "carl", 30)
    learn, test = split(read_takes(tmp_path / "takes", tmp_path / "work"), 2)  # the last two: ben's second, and carl
    assert (learn.people, test.labels) == (["anna", "anna"], ["take_0", "take_1", "carl"])


def test_bad_input(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueRangeError, match="a folder of takes, or a number of performances"):
        train(Settings())
    with pytest.raises(FileFormatError, match="found no such folder"):
        read_takes(tmp_path / "none", tmp_path / "work")
    with pytest.raises(FileFormatError, match="found no take"):
        read_takes(tmp_path, tmp_path / "work")
    with pytest.raises(ShapeError, match="--held-out: found 2 of 2 takes"):
        split(synthetic_takes(2, 30, 0, tmp_path / "work"), 2)
    with pytest.raises(TorchfaceError, match="for a window of 40"):
        train(Settings(performances=2, frames=30, kind="dynamics", window=40, out=tmp_path / "own"))
    take = saved(tmp_path, "a", 20)
    other = Track(("jawWide", *take.weights.names[1:]), take.weights.values)
    save_take(Take(60.0, weights=other), tmp_path / "b.csv")
    with pytest.raises(NameMismatchError, match=r"b\.csv: found other shapes than in a\.csv \(jawWide"):
        read_takes(tmp_path, tmp_path / "work")
    broken = take.weights.values.clone()
    broken[7, 3] = torch.nan
    save_take(Take(60.0, weights=Track(("x", *take.weights.names[1:]), broken)), tmp_path / "b.csv")
    with pytest.raises(ValueRangeError, match=r"b\.csv: found NaN or infinity in 1 of 20 frames \(the first is 7\)"):
        read_takes(tmp_path, tmp_path / "work")
    assert not (tmp_path / "own").exists()
