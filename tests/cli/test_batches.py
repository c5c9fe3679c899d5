"""What works on one take works on a folder of them by the same words."""

import csv
import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from torchface import Attachment, BlendshapeRig, Take, Track, save_rig, save_take
from torchface.cli import main
from torchface.synthetic.stages import StageFlaws, place_markers, record
from torchface.workflows.evaluate.evaluation_record import Evaluation

pytestmark = pytest.mark.usefixtures("coarse_figures")
NAMES = ("calm", "loud")


@pytest.fixture(scope="module")
def stage(dome_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig, two takes with an attachment each, one that shows nothing, and files of other kinds beside them."""
    folder = tmp_path_factory.mktemp("stage")
    (folder / "takes").mkdir()
    save_rig(dome_rig, folder / "rig.glb")
    sites = place_markers(dome_rig, 30)
    for number, name in enumerate(NAMES):
        weights = 0.5 + 0.5 * torch.sin(torch.arange(60)[:, None] * torch.tensor([0.08, 0.17, 0.25, 0.35]) + number)
        shown = record(dome_rig, sites, weights, torch.Generator().manual_seed(number), StageFlaws(noise=0.05))
        save_take(shown.take, folder / "takes" / f"{name}.c3d")
        sites.save(folder / f"sites_{name}.json")
    sites.save(folder / "sites_blind.json")
    blind = Take(60, Track(sites.labels or (), torch.full((20, 30, 3), torch.nan)))
    save_take(blind, folder / "takes" / "blind.c3d")
    (folder / "takes" / "film.mp4").write_text("x")
    (folder / "takes" / "weights.csv").write_text("frame,time,jawOpen\n0,0,0\n")
    return folder


def run(*words: str | Path, status: int) -> None:
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    assert ended.value.code == status


def rows(out: Path) -> dict[str, dict[str, str]]:
    with (out / "summary.csv").open() as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def test_a_folder_of_takes_is_solved_as_each_alone(
    stage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "solved"
    words = ("solve", stage / "rig.glb", stage / "takes", "--attachment", stage / "sites_{name}.json", "--out", out)
    run(*words, status=1)
    told = " ".join(capsys.readouterr().err.split())
    assert "2 of 3 takes solved" in told
    assert "result: 2 good" in told
    assert "left out 1 video and 1 file that holds no take (film.mp4, weights.csv), expected takes" in told
    found = rows(out)
    assert {name: row["status"] for name, row in found.items()} == {"blind": "skipped", "calm": "done", "loud": "done"}
    assert float(found["calm"]["rmse_mm"]) < 0.1
    assert "none of them seen in any of 20 frames" in found["blind"]["remarks"]
    assert json.loads((out / "records" / "blind.json").read_text())["status"] == "skipped"
    for name in NAMES:
        alone = tmp_path / f"{name}.csv"
        take = stage / "takes" / f"{name}.c3d"
        main(["solve", str(stage / "rig.glb"), str(take), "--attachment", str(stage / f"sites_{name}.json"), "--out",
              str(alone), "--quiet"])  # fmt: skip
        assert alone.read_bytes() == (out / f"{name}.csv").read_bytes()
    run(*words, status=1)
    assert "3 known from an earlier run" in " ".join(capsys.readouterr().err.split())


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are Unicode elsewhere")
def test_a_name_that_is_no_unicode_ends_no_batch(stage: Path, tmp_path: Path) -> None:
    takes = tmp_path / "takes"
    takes.mkdir()
    odd = os.fsdecode(b"c\xffd")
    for name in ("calm", odd):
        shutil.copy(stage / "takes" / "calm.c3d", takes / f"{name}.c3d")
    out = tmp_path / "out"
    words = ("solve", stage / "rig.glb", takes, "--attachment", stage / "sites_calm.json", "--out", out, "--quiet")
    for _ in range(2):  # and the second time from the record
        main([str(word) for word in words])
        found = rows(out)
        assert {row["status"] for row in found.values()} == {"done"}
        assert set(found) == {"calm", "c\\udcffd"}
    assert (out / f"{odd}.csv").read_bytes() == (out / "calm.csv").read_bytes()


def test_what_many_would_write_over_one_another_is_refused(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("solve", stage / "rig.glb", stage / "takes", "--attachment", stage / "sites_calm.json", "--quiet")
    for more, message in (
        (("--out", stage / "weights.csv"), "found {0}/weights.csv, a file, for the results of a folder"),
        (("--out", stage / "out", "--animation", stage / "a.glb"), "one place for the results of many"),
        (("--out", stage / "out", "--stream", "udp://127.0.0.1:9"), "found many takes"),
        (("--out", stage / "takes"), "{0}/takes, which is the input"),
    ):
        run(*words, *more, status=2)
        assert message.format(stage) in capsys.readouterr().err.replace("\n", " ")


def test_a_folder_of_results_is_compared_with_the_truths_of_their_names(
    stage: Path,
    dome_rig: BlendshapeRig,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def page(evaluation: Evaluation, out: Path, height: int) -> Path:  # drawing has tests of its own
        return out / "regions.csv"

    monkeypatch.setattr("torchface.workflows.evaluate.result_job.write_evaluation_page", page)
    for folder in ("found", "true"):
        (tmp_path / folder).mkdir()
        for number, name in enumerate(NAMES):
            weights = torch.full((5, 4, 1), 0.3 + 0.1 * number * (folder == "found"))
            save_take(Take(30, weights=Track(dome_rig.names, weights)), tmp_path / folder / f"{name}.csv")
    (tmp_path / "found" / "lost.csv").write_bytes((tmp_path / "found" / "calm.csv").read_bytes())
    words = ("evaluate", tmp_path / "found", tmp_path / "true", "--rig", stage / "rig.glb", "--height", "60")
    run(*words, "--out", tmp_path / "out", status=1)
    assert "2 of 3 results compared" in " ".join(capsys.readouterr().err.split())
    found = rows(tmp_path / "out")
    assert float(found["calm"]["largest_mm"]) == 0
    moved = dome_rig(torch.full((1, 4), 0.1))[0] - dome_rig.vertices
    assert float(found["loud"]["mean_mm"]) == pytest.approx(float(moved.norm(dim=1).mean()), abs=1e-3)
    assert "found none for lost.csv" in found["lost"]["remarks"]
    assert found["loud"]["results"] == "loud/summary.json; loud/regions.csv"


@pytest.mark.bench  # each takes ten seconds
def test_ranges_of_motion_give_an_attachment_each(stage: Path, tmp_path: Path, messages_of: Callable[..., str]) -> None:
    takes = [stage / "takes" / f"{name}.c3d" for name in NAMES]
    words = ("attach", stage / "rig.glb", *takes, "--initial", stage / "sites_{name}.json")
    assert "2 of 2 takes attached" in messages_of(*words, "--out", tmp_path / "sites", "--insist")
    assert all(float(row["error_mm"]) < 0.2 for row in rows(tmp_path / "sites").values())
    assert Attachment.load(tmp_path / "sites" / "loud.json").labels
