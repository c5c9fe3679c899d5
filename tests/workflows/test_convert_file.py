"""Rigs and meshes from one kind of file to another."""

from collections.abc import Callable
from pathlib import Path

import torch
from rig_samples import sheet_rig

from torchface.geometry.meshes.region_maps import RegionMaps
from torchface.io import load_detail_maps, load_region_maps, load_rig, save_mesh, save_rig
from torchface.workflows.convert_file import convert_file


def test_files_are_converted_without_blender_where_it_is_not_needed(
    tmp_path: Path, messages_of: Callable[..., str]
) -> None:
    rig = sheet_rig()
    save_rig(rig, tmp_path / "rig.glb")
    assert "3 shapes, 12 vertices" in messages_of(
        "convert", tmp_path / "rig.glb", tmp_path / "folder", "--part", "lower"
    )
    assert load_rig(tmp_path / "folder").names == rig.names
    save_mesh(rig.neutral, tmp_path / "scan.obj")
    assert "0 shapes, 30 vertices" in messages_of("convert", tmp_path / "scan.obj", tmp_path / "scan.ply")
    assert "found a mesh without shapes, expected a rig" in messages_of(
        "convert", tmp_path / "scan.obj", tmp_path / "other", status=2
    )
    for words, told in (
        (["take.c3d", "take.csv"], "take.c3d: found a take, expected a rig or a mesh: `torchface solve`"),
        (["rig.glb", "pose.obj", "--at", "jawOpn=1"], "--at: found jawOpn; expected shapes of the rig: did you mean"),
        (["rig.glb", "pose.obj", "--at", "jawOpen=1e9"], "--at: found 'jawOpen=1e9', expected NAME=NUMBER"),
    ):
        (tmp_path / "take.c3d").touch()
        assert told in messages_of(
            "convert", *(word if "." not in word else str(tmp_path / word) for word in words), status=2
        )


def test_wrinkle_maps_by_region_stay_in_a_glb_and_are_named_where_there_is_no_place_for_them(tmp_path: Path) -> None:
    normals = torch.tensor([0.0, 0.6, 0.8])[:, None, None].repeat(2, 1, 8, 8)
    maps = RegionMaps(("brow", "chin"), normals, torch.rand(2, 8, 8), torch.ones(2, 4, 4), normals[0])
    save_rig(sheet_rig(), tmp_path / "rig.glb", maps)
    assert convert_file(tmp_path / "rig.glb", tmp_path / "again.glb").notes == ()
    again = load_region_maps(tmp_path / "again.glb")
    assert again.regions == maps.regions
    notes = convert_file(tmp_path / "rig.glb", tmp_path / "folder").notes
    assert notes == ("folder has no place for wrinkle maps by region, which are left out; .glb has",)
    assert load_detail_maps(tmp_path / "again.glb") is not None
