"""``torchface train`` finds recipes by name or as a file; what it cannot find it says in words."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from torchface import save_take
from torchface.cli import main
from torchface.synthetic.stages import perform
from train import marker_solver

OWN = '''"""``torchface train own``: nothing."""
from .recipe_settings import RecipeSettings
from .runner import Recipe

class Settings(RecipeSettings):
    pass

RECIPE = Recipe(Settings, lambda settings, _: settings.out.name, __doc__, lambda _, made: [f"{made} done"])
'''


def test_every_recipe_is_listed_with_what_it_makes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    with pytest.raises(SystemExit) as ended:
        main(["train", "--help"])
    assert ended.value.code == 0
    rows = {line.split()[0]: line.split(None, 1)[1] for line in capsys.readouterr().out.splitlines() if line[:1] == " "}
    files = Path(marker_solver.__file__).parent.glob("*.py")
    assert {path.stem for path in files if "RECIPE = " in path.read_text()} <= set(rows)
    assert rows["marker_solver"].startswith("the solve of one rig")


def test_a_recipe_takes_its_flags(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["train", "marker-solver", "--help"])  # as commands are spelled, too
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert "--sparsity" in printed
    assert "`torchface train marker_solver" in printed
    assert "``" not in printed
    assert "None" not in printed  # Python's word, not the user's


def test_a_file_is_a_recipe_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = tmp_path / "own_recipe.py"
    own.write_text(OWN)
    main(["train", str(own), "--out", str(tmp_path / "model")])
    assert capsys.readouterr().out == f"model done\nwritten to {tmp_path / 'model'}\n"


def test_the_recipe_of_the_documentation_learns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = (Path(marker_solver.__file__).parents[1] / "docs" / "how_to" / "models.md").read_text()
    own = tmp_path / "steady.py"
    own.write_text(page.partition("## Your own recipe")[2].partition("```python\n")[2].partition("```")[0])
    for seed in range(2):
        save_take(perform(60, torch.Generator().manual_seed(seed), 60.0), tmp_path / f"{seed}.csv")
    words = ["--network.steps", "60", "--network.rate", "0.02", "--out", str(tmp_path / "steady")]
    main(["train", str(own), "--takes", str(tmp_path), *words])
    *printed, written = capsys.readouterr().out.splitlines()
    assert set(dict(line.split() for line in printed)) == {"noisy", "filtered"}
    assert written == f"written to {tmp_path / 'steady'}"
    assert {"steady.safetensors", "settings.toml", "log.csv"} <= {path.name for path in (tmp_path / "steady").iterdir()}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("morphables", "found the recipe 'morphables', expected one of action_units"),
        ("none.py", "none.py: found no such file"),
    ],
)
def test_what_is_no_recipe_is_named(name: str, message: str, messages_of: Callable[..., str]) -> None:
    assert message in messages_of("train", name, status=2)
