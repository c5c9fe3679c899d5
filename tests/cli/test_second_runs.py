"""A second run into a place that another run writes into is refused before it reads or writes anything."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from torchface.cli import main
from torchface.files.job_lock import file_lock, job_lock
from train.recipe_settings import RecipeSettings
from train.runner import Recipe

Lock = Callable[[Path], AbstractContextManager[Path]]


@pytest.mark.parametrize(
    ("lock", "words"),
    [
        (job_lock, "track video.mp4 --rig rig.glb"),
        (job_lock, "demo"),
        (job_lock, "evaluate a.csv b.csv"),
        (job_lock, "register template.glb scans"),
        (job_lock, "annotate video.mp4 --no-browser"),
        (file_lock, "rig scan.ply --template template.glb"),
        (file_lock, "fit photo.jpg --model head"),
        (file_lock, "solve rig.glb take.c3d --attachment attachment.json --out out.csv"),
        (file_lock, "attach rig.glb take.c3d --out out.json"),
        (file_lock, "export webcam --out out.onnx"),
        (file_lock, "calibrate board.png --out out.toml"),
        (file_lock, "retarget take.csv --to rig.glb --out out.csv"),
    ],
)
def test_a_second_run_of_a_command_is_refused(
    lock: Lock, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given, _, name = words.partition(" --out ")
    out = tmp_path / (name or "out")
    monkeypatch.chdir(tmp_path)
    for word in given.split():
        if "." in word or word == "scans":
            Path(word).touch()
    with lock(out):
        there = sorted(tmp_path.rglob("*"))
        with pytest.raises(SystemExit) as ended:
            main([*given.split(), "--out", str(out), "--quiet"])
        assert sorted(tmp_path.rglob("*")) == there
    assert ended.value.code == 2
    assert f"found another run writing into {out} (process" in " ".join(capsys.readouterr().err.split())


def test_a_second_run_of_a_recipe_is_refused_and_the_lock_goes_with_the_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "model"
    words = ["--out", str(out)]
    calls: list[str] = []

    def first(settings: RecipeSettings, _: object = None) -> str:
        calls.append("first")
        (settings.out / "model.toml").write_text("first")
        with pytest.raises(SystemExit):
            Recipe(RecipeSettings, second, None, lambda *_: []).main(words)
        assert f"another run writing into {out} (process" in " ".join(capsys.readouterr().err.split())
        return "trained"

    def second(settings: RecipeSettings, _: object = None) -> str:
        calls.append("second")
        (settings.out / "model.toml").write_text("second")
        return "trained"

    Recipe(RecipeSettings, first, None, lambda *_: []).main(words)
    assert (calls, (out / "model.toml").read_text()) == (["first"], "first")
    Recipe(RecipeSettings, second, None, lambda *_: []).main(words)
    assert [path.name for path in out.iterdir()] == ["model.toml"]
