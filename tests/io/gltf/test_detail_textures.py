"""Wrinkle maps on disk: 16-bit pictures and ``.glb``, there and back."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mutation import check_reader
from PIL import Image
from rig_samples import sheet_rig
from torch import Tensor

import torchface.io.gltf.detail_textures
from planted.glb_files import rewrite
from torchface import BlendshapeRig, Mesh, load_rig, save_rig
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, TopologyError
from torchface.geometry.meshes.normal_maps import DetailMaps, decode_normals
from torchface.io import load_detail_maps, load_image, save_image16, save_normal_map


def some_normals(*shape: int, seed: int = 0) -> Tensor:
    vectors = 0.4 * torch.randn(*shape, generator=torch.Generator().manual_seed(seed))
    vectors.select(-3, 2).abs_().add_(0.5)
    return torch.nn.functional.normalize(vectors, dim=-3)


def detail() -> DetailMaps:
    names = sheet_rig().names[:2]
    return DetailMaps(names, some_normals(2, 3, 16, 24), some_normals(3, 16, 24, seed=1))


@given(height=st.integers(1, 9), width=st.integers(1, 9), seed=st.integers(0, 99))
def test_a_picture_of_sixteen_bits_comes_back_to_half_a_step(
    height: int, width: int, seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "sixteen.png"
    image = torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed))
    save_image16(image, path)
    assert (load_image(path) - image).abs().max() <= 0.5 / 65535 + 1e-7


def test_pillow_sees_the_same_picture_with_eight_bits(tmp_path: Path) -> None:
    image = torch.rand(3, 33, 57, generator=torch.Generator().manual_seed(0))
    save_image16(image, tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as opened:
        opened.verify()  # every checksum
    with Image.open(tmp_path / "a.png") as opened:
        seen = np.asarray(opened.convert("RGB"))
    steps = (image.permute(1, 2, 0).double() * 65535).round().numpy().astype(np.uint16)
    assert np.array_equal(seen, steps >> 8)


def test_normals_come_back_within_a_thousandth_of_a_degree_a_step(tmp_path: Path) -> None:
    normals = some_normals(3, 20, 30)
    save_normal_map(normals, tmp_path / "n.png")
    assert (decode_normals(load_image(tmp_path / "n.png")) - normals).norm(dim=0).max() < 1e-4
    with pytest.raises(ShapeError, match=r"\(1, 8, 8\)"):
        save_normal_map(torch.zeros(1, 8, 8), tmp_path / "one.png")


def test_maps_come_back_from_a_glb_with_their_shapes_and_the_rig_is_the_same(tmp_path: Path) -> None:
    rig, maps = sheet_rig(), detail()
    save_rig(rig, tmp_path / "rig.glb", maps)
    found = load_detail_maps(tmp_path / "rig.glb")
    assert found.neutral is not None
    assert found.names == maps.names
    for got, wanted in ((found.maps, maps.maps), (found.neutral, maps.neutral)):
        assert torch.linalg.vector_norm(got - wanted, dim=-3).max() < 0.008  # 8 bits: half a degree at worst
    again = load_rig(tmp_path / "rig.glb")
    assert again.names == rig.names
    torch.testing.assert_close(again.deltas, rig.deltas, atol=1e-4, rtol=0)
    torch.testing.assert_close(again.neutral.texture, rig.neutral.texture, atol=0.003, rtol=0)


def test_without_a_neutral_map_the_material_has_none_and_without_maps_there_is_nothing(tmp_path: Path) -> None:
    rig, maps = sheet_rig(), detail()
    save_rig(rig, tmp_path / "some.glb", DetailMaps(maps.names, maps.maps))
    found = load_detail_maps(tmp_path / "some.glb")
    assert found.neutral is None
    save_rig(rig, tmp_path / "none.glb")
    assert load_detail_maps(tmp_path / "none.glb") is None


def test_maps_that_do_not_fit_the_rig_are_refused_and_nothing_is_written(tmp_path: Path) -> None:
    rig, maps = sheet_rig(), detail()
    with pytest.raises(NameMismatchError, match="noSuchShape"):
        save_rig(rig, tmp_path / "a.glb", DetailMaps(("noSuchShape",), maps.maps[:1]))
    bare = BlendshapeRig(Mesh(rig.neutral.vertices, rig.neutral.faces), rig.deltas, rig.names)
    with pytest.raises(TopologyError, match="texture coordinates"):
        save_rig(bare, tmp_path / "a.glb", maps)
    assert not (tmp_path / "a.glb").exists()


def test_broken_lists_are_refused(tmp_path: Path) -> None:
    def listed(root: dict) -> list:
        return root["meshes"][0]["extras"]["torchface"]["wrinkleMaps"]

    for number, (change, message) in enumerate(
        (
            (lambda root: listed(root)[0].update(texture=99), "an index into"),
            (lambda root: listed(root)[0].update(texture="a"), "an index into"),
            (lambda root: listed(root)[0].pop("shape"), "name of a shape"),
            (lambda root: listed(root)[1].update(shape=listed(root)[0]["shape"]), "each shape once"),
            (lambda root: listed(root).__setitem__(0, 3), "an object"),
            (lambda root: root["meshes"][0]["extras"]["torchface"].update(wrinkleMaps={"a": 1}), "an array"),
            (lambda root: listed(root)[0].update(texture=0), "one size"),  # the skin's picture
        )
    ):
        path = tmp_path / f"{number}.glb"
        save_rig(sheet_rig(), path, detail())
        rewrite(path, change)
        with pytest.raises(FileFormatError, match=message):
            load_detail_maps(path)


def test_a_list_that_unpacks_to_more_than_the_file_can_hold_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torchface.io.gltf.detail_textures, "_UNPACKED_ALWAYS", 2**20)
    rig = sheet_rig()
    flat = torch.zeros(1, 3, 256, 256)
    flat[:, 2] = 1
    path = tmp_path / "bomb.glb"
    save_rig(rig, path, DetailMaps(rig.names[:1], flat))

    def many(root: dict) -> None:
        ours = root["meshes"][0]["extras"]["torchface"]
        ours["wrinkleMaps"] = [{"shape": f"s{i}", "texture": ours["wrinkleMaps"][0]["texture"]} for i in range(200)]

    rewrite(path, many)
    with pytest.raises(FileFormatError, match="unpack to"):
        load_detail_maps(path)


def test_a_mutated_file_is_read_or_refused(tmp_path: Path) -> None:
    save_rig(sheet_rig(), tmp_path / "good.glb", detail())
    report = check_reader(load_detail_maps, [tmp_path / "good.glb"], ".glb")
    assert report.read > 0
    assert report.refused > 0
    save_image16(torch.rand(3, 12, 16, generator=torch.Generator().manual_seed(0)), tmp_path / "good.png")
    report = check_reader(load_image, [tmp_path / "good.png"], ".png")
    assert report.refused > 0


def test_a_mirrored_texture_splits_the_vertices_between_its_halves_and_they_come_back_as_one(tmp_path: Path) -> None:
    rig = sheet_rig()
    mesh = rig.neutral
    across = (mesh.vertices[:, 0].abs() / 60, mesh.vertices[:, 1] / 100 + 0.5)  # both halves show the same picture
    folded = replace(mesh, uvs=torch.stack(across, dim=1), uv_faces=mesh.faces)
    save_rig(BlendshapeRig(folded, rig.deltas, rig.names), tmp_path / "a.glb", detail())
    again = load_rig(tmp_path / "a.glb").neutral
    assert torch.equal(again.faces, mesh.faces)
    torch.testing.assert_close(again.vertices, mesh.vertices, atol=1e-4, rtol=0)
    torch.testing.assert_close(again.uvs[again.uv_faces], folded.uvs[folded.uv_faces])
