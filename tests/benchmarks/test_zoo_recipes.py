"""Every model of the zoo is made again by the one command in its card, to the same metrics."""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from torchface import zoo

REPOSITORY = Path(__file__).resolve().parents[2]
LARGEST = 2_000_000
HOURS = {
    "eye_network": "it learns for an hour, from ICT-FaceKit's heads",
    "face_boxes": "it learns from ICT-FaceKit's heads, in two parts of which the command makes one",
    "face_parts": "it learns for an hour, from ICT-FaceKit's heads",
    "landmark_network": "it learns for hours, from ICT-FaceKit's heads, and its pictures changed while it did",
}


@pytest.mark.parametrize("name", sorted(path.parent.name for path in (REPOSITORY / "models").glob("*/model.toml")))
def test_the_recipe_makes_the_model_again(name: str, tmp_path: Path) -> None:
    if name in HOURS:
        pytest.skip(f"{name} is not made again: {HOURS[name]}")
    shipped = zoo.describe(name)
    command = shlex.split(shipped.recipe)
    if command[:2] == ["torchface", "train"]:
        command = ["python", "-m", f"train.{command[2]}", *command[3:]]
    assert command[:2] == ["python", "-m"]
    assert command[-2:] == ["--out", f"models/{name}"]
    environment = {**os.environ, "TORCHFACE_HOME": str(tmp_path)}
    subprocess.run(
        [sys.executable, *command[1:-1], str(tmp_path / name)],
        cwd=REPOSITORY,
        env=environment,
        check=True,
        stdout=subprocess.DEVNULL,
    )
    made = zoo.describe(tmp_path / name)
    print(f"\n{name}: {shipped.size} bytes")
    for key, value in shipped.metrics.items():
        print(f"  {key:70} {value:12.5g} {made.metrics[key]:12.5g}")
    assert shipped.size < LARGEST
    assert made.config == shipped.config
    assert made.metrics == pytest.approx(shipped.metrics, rel=1e-2)
