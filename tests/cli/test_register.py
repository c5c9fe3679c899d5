"""``torchface register`` on files as a user brings them."""

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from torchface import BlendshapeRig, Mesh, load_mesh, save_mesh, save_rig, zoo
from torchface.cli import main
from torchface.io import Correspondences, save_correspondences
from torchface.modeling import MorphableModel

pytestmark = pytest.mark.usefixtures("coarse_figures")

PICKS = torch.arange(26, 600, 41)


@pytest.fixture
def brought(dome_rig: BlendshapeRig, tmp_path: Path) -> Path:
    """A template rig, two scans with correspondences, and one that is none."""
    save_rig(dome_rig, tmp_path / "template.glb")
    (tmp_path / "scans").mkdir()
    for i, name in enumerate(("anna", "ben")):
        moved = dome_rig.vertices * torch.tensor([1.02, 0.98, 1 + 0.05 * i]) + 30.0 * i
        scan = Mesh(moved.flip(0), len(moved) - 1 - dome_rig.neutral.faces)  # other triangles than the template's
        save_mesh(scan, tmp_path / "scans" / f"{name}.obj")
        labels = tuple(map(str, PICKS.tolist()))
        pairs = Correspondences(PICKS, moved[PICKS], labels, dome_rig.neutral.fingerprint())
        save_correspondences(pairs, tmp_path / "scans" / f"{name}.json")
    (tmp_path / "scans" / "crate.stl").write_bytes(b"solid")
    return tmp_path


def status_of(words: list[str]) -> int | str | None:
    """The exit status of a command that leaves something out."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    return ended.value.code


def test_results_table_and_contact_sheet_are_written(
    brought: Path, dome_rig: BlendshapeRig, capsys: pytest.CaptureFixture[str]
) -> None:
    scans, out = brought / "scans", brought / "new" / "out"
    words = ["register", str(brought / "template.glb"), str(scans), "--out", str(out), "--landmarks", str(scans)]
    assert status_of(words) == 1
    told = capsys.readouterr()
    assert "2 of 3 scans registered" in told.err
    assert "skipped crate.stl" in told.err
    assert told.out.split() == [str(out / "summary.csv"), str(out / "contact_sheet.png")]
    found = load_mesh(out / "ben.glb")
    true = load_mesh(scans / "ben.obj")
    assert torch.equal(found.faces, dome_rig.neutral.faces)
    assert float((found.vertices - true.vertices.flip(0)).norm(dim=-1).median()) < 0.3
    with (out / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    told_of = rows
    assert [(row["name"], row["status"], row["landmarks"]) for row in rows] == [
        ("anna", "done", "14"),
        ("ben", "done", "14"),
        ("crate", "skipped", ""),
    ]
    sheet = np.asarray(Image.open(out / "contact_sheet.png").convert("L")).astype(int)
    third = sheet.shape[1] // 3
    # The face of a registered scan has light and shade, the cell of a skipped one is grey and says in letters why.
    spread = [np.ptp(sheet[8:170, third * i + 8 : third * i + 120]) for i in range(3)]
    assert min(spread[:2]) > 60
    skipped = sheet[8:170, 2 * third + 8 : 2 * third + 120]
    assert 0.02 < float((skipped != np.median(skipped)).mean()) < 0.3
    # Below the face its lines, darker than it, and its distances, in colour.
    colors = np.asarray(Image.open(out / "contact_sheet.png").convert("RGB")).astype(int)
    tall = (colors.shape[0] - 40) // 3  # the names stand below
    pictures = [colors[tall * k : tall * (k + 1), 8 : third - 8] for k in range(3)]
    assert pictures[1].mean() < pictures[0].mean()
    blue = [float((row[..., 2] > row[..., 0] + 5).mean()) for row in pictures]
    assert max(blue[:2]) < 0.01
    assert blue[2] > 0.2
    assert float(told_of[0]["shown"]) > 0.8
    before = (out / "ben.glb").stat().st_mtime_ns
    assert status_of(words) == 1
    assert "3 known from an earlier run" in capsys.readouterr().err.replace("\n", " ")
    assert (out / "ben.glb").stat().st_mtime_ns == before


def test_mistakes_end_with_a_message_and_status_2(brought: Path, capsys: pytest.CaptureFixture[str]) -> None:
    template, scans, out = str(brought / "template.glb"), str(brought / "scans"), str(brought / "out")
    (brought / "empty").mkdir()
    points = Mesh(torch.rand(5, 3), torch.zeros(0, 3, dtype=torch.int64))
    save_mesh(points, brought / "points.ply")
    cases = [
        ([template, str(brought / "empty"), "--out", out], "found no scan in the folder"),
        ([template, str(brought / "scans" / "crate.stl"), "--out", out], "none of 1 scans could be registered"),
        ([str(brought / "points.ply"), scans, "--out", out], "no face, expected at least one"),
        ([str(brought / "none.obj"), scans, "--out", out], "none.obj"),
        ([template, scans, "--out", template], "which is the input"),
        ([template, scans, "--out", scans], "expected another folder"),
        ([template, scans, "--out", out, "--unit", "yards"], "yards"),
    ]
    for words, message in cases:
        with pytest.raises(SystemExit) as ended:
            main(["register", *words, "--quiet"])
        assert ended.value.code == 2
        told = capsys.readouterr().err.replace("\n", " ")
        assert message in told, (words, told)


def test_a_model_by_folder_holds_the_registration(
    brought: Path, dome_rig: BlendshapeRig, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    heads = dome_rig.vertices * torch.tensor([[1, 1, 1], [1.05, 1, 1], [1, 0.95, 1.1], [1, 1, 1.1]])[:, None]
    model = MorphableModel.fit(heads)
    zoo.save_model(model, brought / "domes", zoo.ModelCard("MIT", "domes", {}, "this test"))
    scans, template = str(brought / "scans"), str(brought / "template.glb")
    words = ["register", template, scans, "--out", str(brought / "out"), "--landmarks", scans, "--model"]
    assert status_of([*words, str(brought / "domes")]) == 1
    assert "the model comes to" in " ".join(capsys.readouterr().err.split())
    monkeypatch.chdir(brought)
    assert status_of([*words, "domes"]) == 1  # the folder beside the user, by its bare name
    told = " ".join(capsys.readouterr().err.split())
    assert "3 known from an earlier run" in told
    assert told.count("neither a texture with coordinates nor vertex colours") == 1
    true = load_mesh(brought / "scans" / "ben.obj")
    assert float((load_mesh(brought / "out" / "ben.glb").vertices - true.vertices.flip(0)).norm(dim=-1).median()) < 0.3
    with pytest.raises(SystemExit):
        main([*words, "dunes"])
    assert "found no 'dunes'" in capsys.readouterr().err
    small = MorphableModel.fit(heads[:, :50])
    zoo.save_model(small, brought / "half", zoo.ModelCard("MIT", "domes", {}, "this test"))
    with pytest.raises(SystemExit):
        main([*words, str(brought / "half")])
    assert "found a model of (50, 3), expected the template's topology" in " ".join(capsys.readouterr().err.split())
