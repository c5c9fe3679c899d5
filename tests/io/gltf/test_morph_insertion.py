"""New morph targets are there, and all else of a file is as it was: its bytes, numbers and order."""

from pathlib import Path

import numpy as np
import pytest
import torch

from planted.characters import Planted, write_character
from planted.glb_files import packed, unpacked
from torchface.errors import FileFormatError
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.gltf.character_scene import read_character
from torchface.io.gltf.gltf_document import read_document
from torchface.io.gltf.morph_insertion import AddedTargets, document_with_targets, rename_targets, write_edited
from torchface.mesh import Mesh

HEAD = Mesh(torch.tensor([[0.0, 0, 0], [50, 0, 0], [0, 50, 0], [0, 0, 50]]), torch.tensor([[0, 1, 2], [0, 3, 1]]))


def edited(tmp_path: Path, shapes: dict[str, torch.Tensor]) -> tuple[Path, Path, np.ndarray]:
    whole, out = tmp_path / "in.glb", tmp_path / "out.glb"
    count = write_character(whole, HEAD, shapes, Planted(vrm="VRMC_vrm"))
    root, binary = unpacked(whole)
    whole.write_bytes(packed(root, binary, extra=b"another chunk..."))
    document = read_document(whole)
    moved = np.zeros((2, count, 3), np.float32)
    moved[0, 2], moved[1, :4] = (0.0, 0.01, 0.0), 0.02
    root, data = document_with_targets(document, [AddedTargets(0, (0,), moved)], ["jawOpen", "tongueOut"])
    write_edited(document, root, data, out)
    return whole, out, moved


def test_the_old_bytes_and_all_old_fields_come_back(tmp_path: Path) -> None:
    whole, out, _ = edited(tmp_path, {"smile": torch.ones(4, 3)})
    (before, old), (after, new) = unpacked(whole), unpacked(out)
    assert new[: len(old)] == old
    assert after["accessors"][: len(before["accessors"])] == before["accessors"]
    assert after["bufferViews"][: len(before["bufferViews"])] == before["bufferViews"]
    target = after["meshes"][0]["primitives"][0]["targets"]
    assert target[:1] == before["meshes"][0]["primitives"][0]["targets"]
    assert len(target) == 3
    assert after["meshes"][0]["extras"] == {"author": "nobody", "targetNames": ["smile", "jawOpen", "tongueOut"]}
    assert after["meshes"][1] == before["meshes"][1]  # hair
    untouched = ("nodes", "skins", "materials", "textures", "images", "samplers", "scenes", "extensions", "asset")
    assert {key: after[key] for key in untouched} == {key: before[key] for key in untouched}
    assert out.read_bytes().endswith(b"another chunk...")


def test_new_targets_are_read_and_an_animation_of_weights_still_fits(tmp_path: Path) -> None:
    _, out, moved = edited(tmp_path, {"smile": torch.ones(4, 3)})
    character = read_character(read_document(out))
    assert character.blocks[0].names == ("smile", "jawOpen", "tongueOut")
    torch.testing.assert_close(character.targets(character.blocks[0])[1:], torch.from_numpy(moved))
    assert character.targets(character.blocks[0]) is character.targets(character.blocks[0])  # the budget counts once
    take = read_gltf_weights(out)
    assert take.weights.names == ("smile", "jawOpen", "tongueOut")


def test_a_mesh_without_targets_gets_weights_and_names(tmp_path: Path) -> None:
    _, out, _ = edited(tmp_path, {})
    mesh = unpacked(out)[0]["meshes"][0]
    assert mesh["weights"] == [0.0, 0.0]
    assert mesh["extras"]["targetNames"] == ["jawOpen", "tongueOut"]


def test_a_name_that_is_there_already_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "in.glb"
    count = write_character(path, HEAD, {"jawOpen": torch.ones(4, 3)})
    added = AddedTargets(0, (0,), np.zeros((1, count, 3), np.float32))
    with pytest.raises(FileFormatError, match="'jawOpen' already"):
        document_with_targets(read_document(path), [added], ["jawOpen"])


def test_a_skinned_character_stands_where_its_skeleton_puts_it(tmp_path: Path) -> None:
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    path = tmp_path / "in.glb"
    write_character(path, HEAD, how=Planted(turn=turn, units=100.0))
    character = read_character(read_document(path))
    expected = HEAD.vertices.double() / 1000 @ turn.T * 100
    torch.testing.assert_close(character.vertices[:4], expected, atol=1e-5, rtol=0)
    assert character.head_bone == "mixamorig:Head"
    hair = next(block for block in character.blocks if block.name.startswith("Hair"))
    assert bool((character.head[:4] == 1).all() and (character.head[hair.rows] == 1).all())
    assert float(character.head.mean()) < 1  # the body is not the head


def test_an_empty_target_is_filled_in_its_place(tmp_path: Path) -> None:
    whole, out = tmp_path / "in.glb", tmp_path / "out.glb"
    count = write_character(whole, HEAD, {"tongueOut": torch.zeros(4, 3), "smile": torch.ones(4, 3)})
    document = read_document(whole)
    moved = np.full((2, count, 3), 0.01, np.float32)
    added = AddedTargets(0, (0,), moved)
    root, data = document_with_targets(document, [added], ["jawOpen", "tongueOut"], ["tongueOut"])
    write_edited(document, root, data, out)
    character = read_character(read_document(out))
    (block, *_) = character.blocks
    assert block.names == ("tongueOut", "smile", "jawOpen")
    assert bool((character.targets(block)[[0, 2]] == 0.01).all())
    take = read_gltf_weights(out)
    assert take.weights.names == block.names


def test_targets_get_other_names_where_those_are_free(tmp_path: Path) -> None:
    path = tmp_path / "in.glb"
    shapes = dict.fromkeys(("browDown_L", "jawOpen", "jaw_open", "fat"), torch.ones(4, 3))
    write_character(path, HEAD, shapes)
    root = unpacked(path)[0]
    rename_targets(root, {"browDown_L": "browDownLeft", "jaw_open": "jawOpen"})
    assert root["meshes"][0]["extras"]["targetNames"] == ["browDownLeft", "jawOpen", "jaw_open", "fat"]
