"""The wheel that a user installs: it holds the command, the type marker, the zoo and its recipes, and no tests."""

import json
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
pytestmark = [pytest.mark.wheel, pytest.mark.slow]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    built = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, REPOSITORY],
        capture_output=True,
        text=True,
        check=False,
    )
    if built.returncode != 0 and "No matching distribution" in built.stderr:
        pytest.skip("the build backend cannot be installed here")
    assert built.returncode == 0, built.stderr
    (built_wheel,) = folder.glob("torchface-*.whl")
    return built_wheel


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an empty environment with the wheel in it; what torchface depends on is borrowed from here.

    Beside the package lies what careless packages leave there: a project file, and a folder of models of their own.
    """
    folder = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    python = folder / ("Scripts" if sys.platform == "win32" else "bin") / "python"
    subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "--python",
            python,
            "install",
            "--quiet",
            "--no-deps",
            "--no-index",
            "--no-compile",
            wheel,
        ],
        check=True,
    )
    asked = [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    packages = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    # A path in a .pth file is looked through after the environment's own, and its .pth files (an editable install's
    # among them) are not read.
    Path(packages, "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    Path(packages, "pyproject.toml").write_bytes((REPOSITORY / "pyproject.toml").read_bytes())
    shutil.copytree(REPOSITORY / "models" / "head", Path(packages, "models", "strangers_head"))
    return python


def run(python: Path, code: str, folder: Path) -> str:
    done = subprocess.run(
        [python, "-I", "-c", code], capture_output=True, text=True, check=False, cwd=folder, env={"PATH": ""}
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_holds_the_package_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"torchface"}
    assert "torchface/py.typed" in names
    assert any(name.startswith("torchface/_models/") for name in names)
    assert "torchface/_train/morphable.py" in names
    assert not any(name.endswith(".pyc") for name in names)


@pytest.mark.bench  # the wheel holds the recipe, as the first test says
def test_a_recipe_of_the_wheel_learns(python: Path, tmp_path: Path) -> None:
    words = ["train", "marker_solver", "--markers", "20", "--frames", "30", "--out", "models/own"]
    code = f"import sys, torchface.cli; torchface.cli.main({words}); print('train' in sys.modules)"
    code += "\nimport torchface._train.landmark_network  # with the people that it learns from"
    printed = run(python, code, tmp_path)
    assert "mean error of a weight" in printed
    assert printed.endswith("False\n")
    assert (tmp_path / "models" / "own" / "model.toml").is_file()


def test_every_model_of_the_zoo_loads_and_the_command_runs(wheel: Path, python: Path, tmp_path: Path) -> None:
    code = """
import json, sys, torchface
from torchface import zoo
names = zoo.list_models()
kinds = {name: type(zoo.get_model(name)).__name__ for name in names}
import torchface.cli
assert "av" not in sys.modules, "what PyAV's wheel brings is loaded with a video alone"
print(json.dumps([torchface.__file__, kinds, [str(zoo.find(name)) for name in names]]))
torchface.cli.main(["--help"])
"""
    told, shown = run(python, code, tmp_path).split("\n", 1)
    assert "transfer" in shown
    file, kinds, folders = json.loads(told)
    assert str(python.parent.parent) in file
    with zipfile.ZipFile(wheel) as archive:
        packed = {Path(name).parent.name for name in archive.namelist() if name.endswith("/model.toml")}
    assert set(kinds) == packed
    assert kinds["marker_solver"] == "MarkerSolver"
    assert all("_models" in folder for folder in folders)
