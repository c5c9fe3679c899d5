"""A real head goes through glTF and USD and stays what it was."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchface.io import load_rig, save_rig

SHAPES = ("jawOpen", "mouthSmile_R")


@pytest.mark.real
def test_a_real_head_comes_back_through_glb_and_usdc_vertex_by_vertex(ict_folder: Path, tmp_path: Path) -> None:
    rig = load_rig(ict_folder, part="face", shapes=SHAPES)
    save_rig(rig, tmp_path / "head.glb")
    save_rig(load_rig(tmp_path / "head.glb"), tmp_path / "head.usdc")
    found = load_rig(tmp_path / "head.usdc")
    assert found.names == rig.names
    assert (found.vertices - rig.vertices).abs().max() <= 1e-4
    assert (found.deltas - rig.deltas).abs().max() <= 1e-4
    assert (found.neutral.polygons == rig.neutral.polygons).all()
    corners, expected = found.neutral.uvs[found.neutral.uv_faces], rig.neutral.uvs[rig.neutral.uv_faces]
    assert (corners - expected).abs().max() <= 1e-6  # glTF counts v from the top
    assert list(found.neutral.annotations.regions) == list(rig.neutral.annotations.regions)
    assert (tmp_path / "head.usdc").stat().st_size < 1.1 * (tmp_path / "head.glb").stat().st_size
