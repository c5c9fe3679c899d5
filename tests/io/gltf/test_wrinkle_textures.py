"""Wrinkle maps by region: mixed, in a ``.glb`` and back."""

from pathlib import Path

import pytest
import torch
from mutation import check_reader
from rig_samples import sheet_rig
from test_gltf_viewers import assert_three_moves_it_alike, assert_valid, node  # noqa: F401  (its packages)
from torch import Tensor

from planted.glb_files import rewrite
from torchface import BlendshapeRig, Mesh, load_rig, save_rig
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, TopologyError, ValueRangeError
from torchface.geometry.meshes.normal_maps import normal_slopes
from torchface.geometry.meshes.region_maps import RegionMaps
from torchface.io import load_detail_maps, load_region_maps

REGIONS = ("brow", "mouth", "nose", "chin")


def some_normals(*shape: int, seed: int = 0) -> Tensor:
    vectors = 0.4 * torch.randn(*shape, generator=torch.Generator().manual_seed(seed))
    vectors.select(-3, 2).abs_().add_(0.6)
    return torch.nn.functional.normalize(vectors, dim=-3)


def maps() -> RegionMaps:
    generator = torch.Generator().manual_seed(1)
    return RegionMaps(
        REGIONS,
        some_normals(2, 3, 12, 20),
        torch.randn(2, 12, 20, generator=generator),
        torch.rand(4, 6, 10, generator=generator),
        some_normals(3, 12, 20, seed=2),
    )


def test_regions_mix_their_own_maps() -> None:
    made = maps()
    masks = torch.zeros(2, 12, 20)
    masks[0, :, :10], masks[1, :, 10:] = 1, 1
    halves = RegionMaps(REGIONS[:2], made.normals, made.heights, masks, made.neutral)
    normals, heights = halves.blend(torch.tensor([[1.0, 0.0], [0.0, 0.5]]))
    torch.testing.assert_close(normals[:, :, :10], made.normals[0][:, :, :10], atol=1e-6, rtol=0)
    torch.testing.assert_close(heights[:, :10], made.heights[0][:, :10])
    torch.testing.assert_close(heights[:, 10:], 0.5 * made.heights[1][:, 10:])
    half = 0.5 * (normal_slopes(made.neutral) + normal_slopes(made.normals[1]))
    torch.testing.assert_close(normal_slopes(normals)[:, :, 10:], half[:, :, 10:])
    normals, heights = halves.blend(torch.zeros(2, 2))
    torch.testing.assert_close(normals, made.neutral, atol=1e-6, rtol=0)
    assert not heights.any()


def test_maps_come_back_from_a_glb_beside_the_rig(tmp_path: Path) -> None:
    rig, made = sheet_rig(), maps()
    save_rig(rig, tmp_path / "rig.glb", made)
    found = load_region_maps(tmp_path / "rig.glb")
    assert found.regions == REGIONS
    for name in ("normals", "neutral"):
        apart = getattr(found, name) - getattr(made, name)
        assert torch.linalg.vector_norm(apart, dim=-3).max() < 0.008  # 8 bits: half a degree at worst
    step = float(made.heights.max() - made.heights.min()) / 255
    torch.testing.assert_close(found.heights, made.heights, atol=0.51 * step, rtol=0)
    torch.testing.assert_close(found.masks, made.masks, atol=0.51 / 255, rtol=0)
    again = load_rig(tmp_path / "rig.glb")
    assert again.names == rig.names
    torch.testing.assert_close(again.deltas, rig.deltas, atol=1e-4, rtol=0)
    shown = load_detail_maps(tmp_path / "rig.glb")
    assert shown.names == ()
    save_rig(rig, tmp_path / "none.glb")
    assert load_region_maps(tmp_path / "none.glb") is None


def test_maps_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    rig, made = sheet_rig(), maps()
    bare = BlendshapeRig(Mesh(rig.neutral.vertices, rig.neutral.faces), rig.deltas, rig.names)
    with pytest.raises(TopologyError, match="texture coordinates"):
        save_rig(bare, tmp_path / "a.glb", made)
    with pytest.raises(FileFormatError, match=r"expected \.glb"):
        save_rig(rig, tmp_path / "folder", made)
    assert not list(tmp_path.iterdir())
    with pytest.raises(ShapeError, match="region maps"):
        RegionMaps(REGIONS, made.normals, made.heights[:1], made.masks, made.neutral)
    with pytest.raises(NameMismatchError, match="a region each"):
        RegionMaps(REGIONS[:2], made.normals, made.heights, made.masks, made.neutral)
    with pytest.raises(ValueRangeError, match="mask"):
        RegionMaps(REGIONS, made.normals, made.heights, 2 * made.masks, made.neutral)
    with pytest.raises(ValueRangeError, match="NaN"):
        RegionMaps(REGIONS, made.normals, made.heights * torch.nan, made.masks, made.neutral)
    with pytest.raises(ShapeError, match="map weights"):
        made.blend(torch.zeros(2, 4))


def test_broken_lists_are_refused(tmp_path: Path) -> None:
    for number, (change, message) in enumerate(
        (
            (lambda listed, _: listed["normals"].append(99), "an index into"),
            (lambda listed, _: listed.pop("normals"), "one or more"),
            (lambda listed, _: listed["heights"].append(0), "1, three channels each"),
            (lambda listed, _: listed["masks"].pop(), "2, three channels each"),
            (lambda listed, _: listed["regions"].append("brow"), "each once"),
            (lambda listed, _: listed.update(heightRange=[1, 1]), "the lower first"),
            (lambda listed, _: listed.update(heightRange=[1, "a"]), "numbers"),
            (lambda listed, _: listed.update(heights=[listed["masks"][0]]), "one size"),
            (lambda _, root: root["materials"][0].pop("normalTexture"), "normals of the face at rest"),
        )
    ):
        path = tmp_path / f"{number}.glb"
        save_rig(sheet_rig(), path, maps())
        rewrite(path, lambda root: change(root["meshes"][0]["extras"]["torchface"]["wrinkleRegions"], root))  # noqa: B023
        with pytest.raises(FileFormatError, match=message):
            load_region_maps(path)


def test_a_mutated_file_is_read_or_refused(tmp_path: Path) -> None:
    made = maps()
    few = RegionMaps(REGIONS[:1], made.normals[:1], made.heights[:1], made.masks[:1], made.neutral)
    save_rig(sheet_rig(), tmp_path / "good.glb", few)
    report = check_reader(load_region_maps, [tmp_path / "good.glb"], ".glb")
    assert report.read > 0
    assert report.refused > 0


def test_the_file_is_valid_and_three_shows_it(node: str, tmp_path: Path) -> None:  # noqa: F811
    rig = sheet_rig()
    save_rig(rig, tmp_path / "rig.glb", maps())
    assert_valid(node, tmp_path / "rig.glb")
    assert_three_moves_it_alike(node, tmp_path / "rig.glb", rig, torch.tensor([0.5, 0.25, 1.0]))
