"""What every recipe has of the runner: settings files, logs, devices, runs that go on where they were killed."""

import re
import shlex
import shutil
import sys
import types
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Literal

import pytest
import torch
from torch import Tensor, nn

from torchface import TorchfaceError, zoo
from torchface.errors import FileFormatError
from torchface.files.documents import write_toml
from torchface.optim import DescentRun, DescentSettings, DescentTask, descend
from torchface.progress import Progress
from train.model_cards import command
from train.recipe_settings import ANY_DEVICE, RecipeSettings
from train.run_log import RunLog, read_log
from train.runner import Recipe, Run, recipe
from train.settings_files import read_settings, write_settings

RECIPES = (
    "action_units", "appearance", "enhancement", "expression", "eye_network", "face_boxes", "face_parts",
    "landmark_network", "landmark_trees", "marker_solver", "morphable", "priors", "uv_landmarks",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """A line is learned."""

    data: Path  # What there is no default for
    kind: Literal["one", "two"] = "one"  # One of two
    slope: float = 3.0  # Of the line
    parts: tuple[int, ...] = (1, 2)  # Several
    limit: int | None = 14  # A number, or none
    # How it descends
    network: DescentSettings = field(default_factory=lambda: DescentSettings(120, 8, 0.1, checkpoint_every=0))

    devices: ClassVar[tuple[str, ...]] = ANY_DEVICE


class Noisy(nn.Module):
    """A line whose inputs are dropped at random while it learns."""

    def __init__(self) -> None:
        super().__init__()
        self.line, self.dropped = nn.Linear(2, 1), nn.Dropout(0.2)

    def forward(self, inputs: Tensor) -> Tensor:
        return self.line(self.dropped(inputs))


@recipe
def train(settings: Settings, run: Run) -> Noisy:
    torch.manual_seed(settings.seed)
    line = Noisy()

    def draw(step: int) -> Tensor:
        return torch.randn(settings.network.batch, 2, generator=torch.Generator().manual_seed(step))

    def loss(inputs: Tensor, _: float) -> tuple[Tensor, float]:
        total = (line(inputs) - settings.slope * inputs[:, :1]).square().mean()
        return total, float(total.detach())

    how = DescentRun(run.progress, run.log, run.checkpoint, run.device)
    return descend(line, DescentTask(draw, loss), settings.network, how)


RECIPE = Recipe(Settings, train, "A line.", lambda settings, _: [f"slope {settings.slope}"])


def killed_after(step: int) -> Progress:
    def progress(_: str, done: int = 0, total: int = 0) -> None:
        if done == step:
            raise KeyboardInterrupt

    return progress


@pytest.mark.parametrize("name", RECIPES)
def test_settings_of_every_recipe_are_read_as_they_were_written(name: str, tmp_path: Path) -> None:
    kind = import_module(f"train.{name}").Settings
    assert issubclass(kind, RecipeSettings)
    needed = {"action_units": {"video": (Path("a"),), "labels": (Path("b"),)}, "appearance": {"data": Path("c")}}
    settings = kind(**needed.get(name, {}), seed=5, out=tmp_path / "model", licence="MIT", resume=False)
    write_settings(tmp_path / "settings.toml", settings)
    assert read_settings(tmp_path / "settings.toml", kind) == settings


def test_flags_go_before_the_file_and_the_file_before_defaults(tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    write_toml(file, {"slope": 5, "limit": "none", "network": {"rate": 0.5}, "data": "there", "parts": [7]})
    found = RECIPE.chosen(["--config", str(file), "--network.rate", "0.25", "--seed", "4"])
    assert (found.data, found.slope, found.parts, found.limit, found.seed) == (Path("there"), 5.0, (7,), None, 4)
    assert found.network.rate == 0.25
    again = tmp_path / "again.toml"
    write_settings(again, found)
    assert RECIPE.chosen([f"--config={again}"]) == found


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"slop": 5}, "found slop = 5, expected only out, seed, device, resume, licence, quiet, data"),
        ({"slope": "steep"}, "found slope = 'steep', expected a number"),
        ({"resume": 1}, "found resume = 1, expected true or false"),
        ({"kind": "three"}, "found kind = 'three', expected one of 'one', 'two'"),
        ({"network": {"steps": 1.5}}, "found network.steps = 1.5, expected a whole number"),
        ({"parts": [1, "two"]}, "found parts[1] = 'two', expected a whole number"),
        ({"network": 3}, "found network = 3, expected a table"),
        ({"out": "a\0b"}, r"found out = 'a\x00b', expected a path without NUL"),
    ],
)
def test_what_a_file_cannot_say_is_named(
    document: dict[str, object], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_toml(tmp_path / "odd.toml", document)
    with pytest.raises(SystemExit) as ended:
        RECIPE.main(["--config", str(tmp_path / "odd.toml")])
    assert ended.value.code == 2
    told = " ".join(capsys.readouterr().err.split())
    assert f"odd.toml: {message}" in told


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"slope": -0.5}, "slope: found -0.5, expected a finite number of at least 0"),
        ({"parts": [1, -1]}, "parts: found -1, expected a whole number from 0"),
        ({"limit": 2**62}, "limit: found 4.611686e+18, expected a whole number from 0 to 10000000"),
        ({"seed": -1}, "seed: found -1, expected a whole number from 0 to 4294967295"),
        ({"network": {"workers": -1}}, "network.workers: found -1, expected a whole number"),
    ],
)
def test_a_number_that_no_recipe_can_work_with_is_refused_before_any_work(
    document: dict[str, object], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_toml(tmp_path / "odd.toml", {"data": str(tmp_path), "out": str(tmp_path / "out"), **document})
    with pytest.raises(SystemExit) as ended:
        RECIPE.main(["--config", str(tmp_path / "odd.toml")])
    assert ended.value.code == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("given", ["my model", "prior ü", "_hidden", "a" * 65])
def test_a_folder_whose_name_no_model_can_have_is_refused_before_any_work(
    given: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    class Two(Settings):
        @property
        def folders(self) -> tuple[Path, ...]:
            return self.out.with_name(f"{self.out.name}_one"), self.out.with_name(f"{self.out.name}_two")

    def work(settings: Settings, run: Run) -> None:
        pytest.fail("the work has begun")

    for kind in (Settings, Two):
        with pytest.raises(SystemExit):
            Recipe(kind, recipe(work), None).main(["--data", "here", "--out", str(tmp_path / given)])
        message = " ".join(capsys.readouterr().err.split())
        assert f"found the name '{given}', expected letters from a to z, digits, - and _, at most 64" in message
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", RECIPES)
def test_a_message_names_the_flag_of_what_the_user_gave(name: str) -> None:
    """Settings within settings know their field alone: ``--network.rate`` is called ``rate`` there."""
    kind = import_module(f"train.{name}").RECIPE
    needed = [one for one in fields(kind.settings) if one.default is MISSING and one.default_factory is MISSING]
    words = [word for one in needed for word in (f"--{one.name.replace('_', '-')}", "missing")]
    for path, value in _numbers(kind.chosen(words)):
        flag = f"--{path.replace('_', '-')}"
        with pytest.raises((TorchfaceError, SystemExit)) as refused:
            kind.chosen([*words, flag, "nan" if isinstance(value, float) else "-1"])
        if isinstance(refused.value, TorchfaceError):  # what tyro refuses has the flag in its box
            assert flag in str(refused.value)


def test_what_the_library_calls_a_setting_is_called_by_its_flag(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, told in (("slope", "--slope"), ("network", "network"), ("heads", "heads"), ("work", "work")):

        def refuse(settings: Settings, run: Run, name: str = name) -> None:
            raise TorchfaceError(f"{name}: found 3.0, expected less")

        with pytest.raises(SystemExit):
            Recipe(Settings, recipe(refuse), None).main(["--data", "here", "--out", str(tmp_path / "out")])
        assert f"error: {told}: found 3.0, expected less" in capsys.readouterr().err


@pytest.mark.parametrize("name", RECIPES)
def test_what_a_recipe_says_of_itself_names_its_own_flags(name: str) -> None:
    module = import_module(f"train.{name}")
    own = {one.name.replace("_", "-") for one in fields(module.RECIPE.settings)}
    said = f"{module.__doc__} {module.RECIPE.settings.__doc__}"
    assert {flag.removeprefix("no-") for flag in re.findall(r"--([a-z-]+)", said)} <= own


def _numbers(settings: Any, above: str = "") -> Iterator[tuple[str, float]]:
    for one in fields(settings):
        value = getattr(settings, one.name)
        if is_dataclass(value):
            yield from _numbers(value, f"{above}{one.name}.")
        elif type(value) in (int, float):
            yield f"{above}{one.name}", value


def test_what_has_no_default_and_is_not_in_the_file_is_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_toml(tmp_path / "own.toml", {"slope": 5})
    with pytest.raises(SystemExit):
        RECIPE.main(["--config", str(tmp_path / "own.toml")])
    assert "--data" in capsys.readouterr().err


def test_a_quiet_run_shows_no_progress_and_prints_what_it_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = []
    for flags in ([], ["-q"]):
        RECIPE.main(["--data", str(tmp_path), "--out", str(tmp_path / "line"), "--network.steps", "5", *flags])
        shown.append(capsys.readouterr())
    assert shown[0].err
    assert not shown[1].err
    assert shown[0].out == shown[1].out


def test_a_killed_run_goes_on_to_the_same_model_and_log(tmp_path: Path) -> None:
    whole = train(Settings(data=tmp_path, out=tmp_path / "whole"))
    settings = Settings(data=tmp_path, out=tmp_path / "killed")
    with pytest.raises(KeyboardInterrupt):
        train(settings, killed_after(70))
    steps: list[int] = []
    again = train(settings, lambda _, done=0, total=0: steps.append(done))
    assert steps[0] == 70  # the checkpoint is of the step before
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=0, atol=0, msg=name)
    logs = [read_log(tmp_path / own / "log.csv") for own in ("whole", "killed")]
    rows = [[(row.step, row.name, row.value) for row in log] for log in logs]
    assert rows[0] == rows[1]
    assert [row[0] for row in rows[0]] == [50, 50, 100, 100, 120, 120]
    names = {path.name for path in settings.out.iterdir()} - {"tensorboard"}
    assert names == {"settings.toml", "log.csv", "curves.png"}
    assert not settings.work.exists()


def test_a_run_may_start_anew(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path, out=tmp_path / "line")
    with pytest.raises(KeyboardInterrupt):
        train(settings, killed_after(70))
    other = Settings(data=tmp_path, out=tmp_path / "line", network=DescentSettings(60, 8, 0.1))
    with pytest.raises(TorchfaceError, match="found a checkpoint of other data or settings"):
        train(other)
    assert read_settings(settings.work / "settings.toml", Settings) == settings
    steps: list[int] = []
    fresh = Settings(data=tmp_path, out=tmp_path / "line", network=other.network, resume=False)
    train(fresh, lambda _, done=0, total=0: steps.append(done))
    assert steps == list(range(1, 61))
    assert [row.step for row in read_log(tmp_path / "line" / "log.csv")] == [50, 50, 60, 60]


@pytest.mark.parametrize("kept", [True, False])
def test_a_stopped_run_says_how_to_go_on_and_leaves_nothing_else(
    kept: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(_: Settings, run: Run) -> None:
        if kept:
            run.checkpoint.write_bytes(b"what was done")
        raise KeyboardInterrupt

    with pytest.raises(SystemExit):
        Recipe(Settings, recipe(stopped), None).main(["--data", "here", "--out", str(tmp_path / "line"), "-q"])
    said = "".join(capsys.readouterr().err.split())  # a long path is cut where a line ends
    assert (".line.trainingkeepswhatwasdone:thesamecommandgoesonfromthere" in said) is kept
    assert [path.name for path in tmp_path.glob(".line.training")] == [".line.training"] * kept


def test_a_checkpoint_holds_no_pickle(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path, out=tmp_path / "line")
    with pytest.raises(KeyboardInterrupt):
        train(settings, killed_after(3))
    (found,) = settings.work.glob("*.safetensors")
    assert {path.name for path in settings.work.iterdir()} == {found.name, "settings.toml"}
    assert found.read_bytes()[8:10] == b'{"'  # safetensors: a length, then JSON


@pytest.mark.parametrize(
    ("device", "message"),
    [
        ("cuda:99", "found 'cuda:99', but PyTorch sees"),
        ("gpu", "found 'gpu', expected cpu or cuda or mps"),
        ("meta", "found 'meta', expected cpu or cuda or mps"),
    ],
)
def test_devices_that_are_not_there_are_told_before_anything_begins(device: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(TorchfaceError, match=message):
        train(Settings(data=tmp_path, out=tmp_path / "line", device=device))
    assert not list(tmp_path.iterdir())
    with pytest.raises(TorchfaceError, match="expected cpu: this recipe knows no other"):
        RecipeSettings(device="cuda").chosen_device()


def test_tensorboard_is_told_where_it_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[str, float, int]] = []

    class Writer:
        def __init__(self, folder: str, purge_step: int | None) -> None:
            told.append((Path(folder).name, 0.0, purge_step or 0))

        def add_scalar(self, name: str, value: float, step: int) -> None:
            told.append((name, value, step))

        def close(self) -> None: ...

    module = types.ModuleType("torch.utils.tensorboard")
    module.SummaryWriter = Writer
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", module)
    log = RunLog(tmp_path)
    log(50, "loss", 0.5)
    log.close()
    assert told == [("tensorboard", 0.0, 0), ("loss", 0.5, 50)]


@pytest.mark.parametrize("left", ["9.0,20", "9.0,200,loss," + 200_000 * "1", "\0\ud800"])
def test_a_log_goes_on_with_the_step_that_is_done_again(tmp_path: Path, left: str) -> None:
    log = RunLog(tmp_path)
    for step in (50, 100, 150):
        log(step, "loss, of all", 1 / step)
    with (tmp_path / "log.csv").open("ab") as file:
        file.write(left.encode("utf-8", "surrogatepass"))  # a line that a killed run or a failing disk has left
    again = RunLog(tmp_path, goes_on=True)
    again(100, "loss, of all", 0.5)
    again(150, "loss, of all", 0.25)
    again.close()
    told = [(row.step, row.name, row.value) for row in read_log(tmp_path / "log.csv")]
    assert told == [(50, "loss, of all", 0.02), (100, "loss, of all", 0.5), (150, "loss, of all", 0.25)]


def test_a_log_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "run")
    log(50, "loss", 0.5)
    shutil.rmtree(tmp_path / "run")
    with pytest.raises(FileFormatError, match=r"log\.csv: cannot be written: found no folder .*run, expected one"):
        log(100, "loss", 0.25)


def test_a_card_tells_the_command_that_makes_the_model_again() -> None:
    settings = Settings(data=Path("data/my scans"), limit=None, parts=(3, 4), out=Path("a/line"), device="cpu")
    told = command(settings)
    words = "--parts 3 4 --limit None --seed 0 --out models/line"
    assert told == f"torchface train test_runner --data '{Path('data/my scans')}' {words}"


@pytest.mark.parametrize("name", zoo.list_models())
def test_commands_of_the_shipped_models_are_still_taken(name: str) -> None:
    """``python -m train.NAME FLAGS``, as ``torchface train NAME FLAGS`` takes them."""
    words = shlex.split(zoo.describe(name).recipe)
    module = words[2].removeprefix("train.")
    assert module in RECIPES
    settings = import_module(f"train.{module}").RECIPE.chosen(words[3:])
    assert settings.out.name == name
