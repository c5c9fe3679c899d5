"""What a folder of the app says of a character's shapes, and the tables that it takes."""

import json
from pathlib import Path

import pytest
import torch
from planted_graph import write_planted_graph
from rig_samples import named_sheet

from torchface import BlendshapeRig, save_rig
from torchface.errors import NameMismatchError
from torchface.shape_names import ARKIT
from torchface.workflows.browser_app import app_folder
from torchface.workflows.browser_app.character import load_character


def test_shapes_that_move_nothing_are_named(tmp_path: Path) -> None:
    rig = named_sheet(("jawOpen", "mouthPucker", "tongueOut"))
    save_rig(rig, tmp_path / "all.glb")
    assert load_character(tmp_path / "all.glb").still == ()
    deltas = rig.deltas * torch.tensor([1.0, 1.0, 0.0])[:, None, None]
    save_rig(BlendshapeRig(rig.neutral, deltas, rig.names), tmp_path / "two.glb")
    assert load_character(tmp_path / "two.glb").still == ("tongueOut",)


def test_the_app_takes_a_mapping_and_does_not_count_the_tongue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "page" / "assets").mkdir(parents=True)
    for name in ("index.html", "assets/page.js"):
        (tmp_path / "page" / name).write_text("page")
    monkeypatch.setattr(app_folder, "built_page", lambda progress: tmp_path / "page")
    write_planted_graph(tmp_path / "planted.onnx")
    path, own = tmp_path / "sheet.glb", tmp_path / "own.glb"
    save_rig(named_sheet(("jawOpen", "Tongue_Out", "antenna", "jawOpen_tongueOut")), path)
    report = app_folder.export_app(tmp_path / "app", path, tmp_path / "planted.onnx")
    assert (report.driven, report.still) == (("jawOpen",), ("Tongue_Out", "antenna", "jawOpen_tongueOut"))
    assert ("shapes that a face moves", "1 of 4") in report.rows()
    (tmp_path / "names.toml").write_text("[Maw]\nsum = {jawOpen = 0.5}\n[Tip]\nsum = {tongueOut = 1}\n")
    save_rig(named_sheet(("Maw", "Tip")), own)
    with pytest.raises(NameMismatchError, match="or --mapping FILE"):
        app_folder.export_app(tmp_path / "app", own, tmp_path / "planted.onnx")
    planted, names = tmp_path / "planted.onnx", tmp_path / "names.toml"
    assert app_folder.export_app(tmp_path / "app", own, planted, mapping=names).driven == ("Maw",)
    rows = json.loads((tmp_path / "app" / "character.json").read_text())["sources"]
    assert rows["Maw"] == [[ARKIT.index("jawOpen"), 0.5]]
