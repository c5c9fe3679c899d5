"""An actor's wrinkles for an engine: maps, graphs of their weights, a ``.glb``."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from tests.workflows.enhance.conftest import FRAMES, Actor
from torchface.cli.export import export_enhancement
from torchface.errors import FileFormatError, TopologyError, ValueRangeError
from torchface.geometry.meshes.normal_maps import normal_slopes
from torchface.io import load_region_maps, load_rig, save_rig
from torchface.onnx import ExportReport
from torchface.rig import BlendshapeRig
from torchface.workflows.enhance import wrinkle_export
from torchface.workflows.enhance.wrinkle_export import ExportedWrinkles, WrinkleSettings, export_wrinkles


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("wrinkles")


GRAPHS: dict[str, nn.Module] = {}


def written(module: nn.Module, poses: Tensor, path: Path, facts: object) -> ExportReport:
    """In place of the export, which takes ten seconds and which ``tests/onnx/test_enhancement_graph.py`` tries."""
    GRAPHS[path.stem] = module
    path.write_bytes(b"a graph")
    return ExportReport(path, 7, {"map_weights": 0.0}, {"map_weights": "of the range"})


@pytest.fixture(scope="module")
def exported(actor: Actor, out: Path) -> ExportedWrinkles:
    settings = WrinkleSettings(4, 128, 80, animation=actor.folder / "weights.csv")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wrinkle_export, "export_wrinkle_weights", written)
        return export_wrinkles(actor.model, actor.folder / "rig.glb", out, settings)


def test_maps_and_found_weights_show_most_of_the_detail(exported: ExportedWrinkles, out: Path) -> None:
    assert exported.missed_by_maps < 0.35
    assert exported.missed_by_maps <= exported.missed < 0.55
    told = json.loads((out / "summary.json").read_bytes())
    assert told["missed_share_with_found_weights"] == pytest.approx(exported.missed)
    assert sorted(path.name for path in out.iterdir()) == [
        "map_weights.csv", "map_weights.onnx", "map_weights_of_vertices.onnx", "maps", "state", "summary.json",
        "wrinkles.glb",
    ]  # fmt: skip


def test_the_graphs_give_the_weights_of_the_animation(actor: Actor, exported: ExportedWrinkles, out: Path) -> None:
    rows = list(csv.reader((out / "map_weights.csv").open()))
    assert len(rows) == FRAMES + 1
    values = torch.tensor([[float(cell) for cell in row[1:]] for row in rows[1:]])
    regions = len(exported.maps.regions)
    for name, inputs in (("map_weights", actor.weights), ("map_weights_of_vertices", actor.frames)):
        with torch.no_grad():
            found = GRAPHS[name](inputs)
        assert found.shape == (FRAMES, regions, 4)
        torch.testing.assert_close(found.flatten(1), values, atol=1e-3, rtol=0)
    assert float(values[0].abs().max()) < 1e-4
    assert float(values[-1].max()) > 0.2


def test_the_glb_brings_rig_and_maps_back_and_the_maps_show_the_folds(
    actor: Actor, exported: ExportedWrinkles, out: Path
) -> None:
    assert load_rig(out / "wrinkles.glb").names == actor.rig.names
    found = load_region_maps(out / "wrinkles.glb")
    assert found.regions == exported.maps.regions
    torch.testing.assert_close(found.heights, exported.maps.heights, atol=0.02, rtol=0)
    total = found.masks.sum(0)
    torch.testing.assert_close(total, torch.ones_like(total), atol=0.03, rtol=0)
    last = exported.wrinkles(actor.frames[-1:])[0]
    normals, heights = found.blend(last)
    assert float(heights.abs().max()) > 0.05
    assert float((normal_slopes(normals) - normal_slopes(found.neutral)).abs().max()) > 0.05
    flat, none = found.blend(torch.zeros_like(last))
    torch.testing.assert_close(flat, found.neutral, atol=1e-5, rtol=0)
    assert not none.any()


def test_what_does_not_fit_is_refused(actor: Actor, tmp_path: Path) -> None:
    mesh = replace(actor.rig.neutral, uvs=None, uv_faces=None)
    save_rig(BlendshapeRig(mesh, actor.rig.deltas, actor.rig.names), tmp_path / "bare.glb")
    with pytest.raises(TopologyError, match=r"bare\.glb: found a rig without texture coordinates"):
        export_enhancement(model=actor.model, rig=tmp_path / "bare.glb", out=tmp_path / "a", quiet=True)
    rig = actor.folder / "rig.glb"
    with pytest.raises(ValueRangeError, match="--maps"):
        export_enhancement(model=actor.model, rig=rig, out=tmp_path / "a", maps=0, quiet=True)
    with pytest.raises(ValueRangeError, match="--size"):
        export_enhancement(model=actor.model, rig=rig, out=tmp_path / "a", size=20_000, quiet=True)
    other = actor.folder / "attachment.json"
    with pytest.raises(FileFormatError, match=r"attachment\.json"):
        export_enhancement(model=actor.model, rig=rig, out=tmp_path / "a", animation=other, quiet=True)
    assert not (tmp_path / "a" / "summary.json").exists()
