"""Correctives in files: definitions in the extras, deltas as targets, weights in animations."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from rig_samples import corrective_sheet, sheet_rig

from planted.glb_files import packed, unpacked
from torchface import BlendshapeRig, Corrective, Correctives, Take, Track, load_rig, save_animation, save_rig
from torchface.errors import FileFormatError
from torchface.io.gltf.animation_reading import read_gltf_weights


@pytest.mark.parametrize("name", ["rig.glb", "folder"])
def test_a_rig_with_correctives_comes_back(name: str, tmp_path: Path) -> None:
    rig = corrective_sheet()
    save_rig(rig, tmp_path / name)
    found = load_rig(tmp_path / name)
    assert found.names == rig.names
    assert found.correctives.definitions == rig.correctives.definitions
    weights = torch.rand(5, 3, generator=torch.Generator().manual_seed(4))
    assert (found(weights) - rig(weights)).abs().max() < 1e-2
    save_rig(found, tmp_path / f"again_{name}")
    again = load_rig(tmp_path / f"again_{name}").correctives
    assert (again.deltas - found.correctives.deltas).abs().max() < 1e-4


@pytest.mark.parametrize("name", ["rig.glb", "rig.usdc", "folder"])
@pytest.mark.parametrize("drivers", [4, 8])
def test_products_of_up_to_eight_shapes_come_back(drivers: int, name: str, tmp_path: Path) -> None:
    sheet, names = sheet_rig(), tuple("abcdefgh")
    deltas = torch.randn(9, len(sheet.vertices), 3, generator=torch.Generator().manual_seed(6))
    product = Correctives(deltas[8:], (Corrective("product", names[8 - drivers :]),))
    rig = BlendshapeRig(sheet.neutral, deltas[:8], names, product)
    weights = 0.5 + 0.5 * torch.rand(4, 8, generator=torch.Generator().manual_seed(7))
    linear = rig.without_correctives()(weights)
    expected = linear + weights[:, 8 - drivers :].prod(1)[:, None, None] * deltas[8]
    torch.testing.assert_close(rig(weights), expected)
    save_rig(rig, tmp_path / name)
    found = load_rig(tmp_path / name)
    assert found.correctives.definitions == product.definitions
    assert (found(weights) - expected).abs().max() < 1e-2


def test_an_animation_drives_the_correctives_and_reads_back_without_them(tmp_path: Path) -> None:
    rig = corrective_sheet()
    values = torch.rand(6, 3, 1, generator=torch.Generator().manual_seed(5))
    take = Take(60.0, weights=Track(rig.names, values))
    match = save_animation(rig, take, tmp_path / "take.glb")
    assert match.driven == rig.names
    root, binary = unpacked(tmp_path / "take.glb")
    names = root["meshes"][0]["extras"]["targetNames"]
    accessor = root["accessors"][root["animations"][0]["samplers"][0]["output"]]
    start = root["bufferViews"][accessor["bufferView"]]["byteOffset"]
    keys = torch.frombuffer(bytearray(binary[start : start + 4 * accessor["count"]]), dtype=torch.float32)
    keys = keys.view(6, len(names))
    a, b, c = values[..., 0].T
    torch.testing.assert_close(keys[:, names.index("all")], a * b * c)
    torch.testing.assert_close(keys[:, names.index("jaw_third")], torch.minimum(3 * a, 1.5 * (1 - a)))
    read = read_gltf_weights(tmp_path / "take.glb")
    found = read.weights
    assert found.names == rig.names
    torch.testing.assert_close(found.values, values)


def test_a_rig_without_correctives_says_nothing_of_them(tmp_path: Path) -> None:
    save_rig(sheet_rig(), tmp_path / "rig.glb")
    root, _ = unpacked(tmp_path / "rig.glb")
    assert "correctives" not in root["meshes"][0]["extras"]["torchface"]
    assert load_rig(tmp_path / "rig.glb").correctives is None


def _row(**changes: Any) -> Callable[[list[Any]], None]:
    return lambda rows: rows[0].update(changes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_row(name="gone"), "'gone' and no morph target 'gone'"),
        (_row(drivers=["jawOpen", "gone"]), "'jaw_smile' and no morph target 'gone'"),
        (_row(drivers=["jawOpen", "all"]), "driven by the corrective 'all'"),
        (_row(drivers=["jawOpen", "jaw_smile"]), "a cycle, jaw_smile -> jaw_smile"),
        (_row(drivers=["jawOpen"]), "peak: found None"),
        (_row(drivers=["jawOpen"], peak=2), "peak: found 2"),
        (_row(drivers=["jawOpen"], peak=[0.5]), "of an in-between a peak"),
        (_row(drivers=["jawOpen"] * 9), "a product of 9 shapes"),
        (_row(drivers="jawOpen"), "a list of drivers' names"),
        (_row(drivers=[1, 2]), "a list of drivers' names"),
        (_row(name=None), "a list of drivers' names"),
        (lambda rows: rows.append(dict(rows[0])), "more than once: jaw_smile"),
        (lambda rows: rows.append(7), "expected a name, a list of drivers"),
    ],
)
def test_broken_definitions_are_named(change: Callable[[list[Any]], None], message: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.glb"
    save_rig(corrective_sheet(), path)
    root, binary = unpacked(path)
    change(root["meshes"][0]["extras"]["torchface"]["correctives"])
    path.write_bytes(packed(root, binary))
    with pytest.raises(FileFormatError, match=message):
        load_rig(path)


def test_a_long_chain_of_correctives_is_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "rig.glb"
    save_rig(corrective_sheet(), path)
    root, binary = unpacked(path)
    rows = [{"name": f"n{i}", "drivers": [f"n{i + 1}", "jawOpen"]} for i in range(20_000)]
    root["meshes"][0]["extras"]["torchface"]["correctives"] = rows
    path.write_bytes(packed(root, binary))
    with pytest.raises(FileFormatError, match="'n0' is driven by the corrective 'n1'"):
        load_rig(path)
