"""Expressions of VRM 1.0 and 0.x are read, and new ones come behind those that are there."""

import copy
from pathlib import Path

import pytest
import torch

from planted.characters import Planted, write_character
from torchface import Mesh, load_mesh, load_rig
from torchface.io.gltf.gltf_document import read_document
from torchface.io.vrm.vrm_expressions import MorphBind, add_expressions, vrm_expressions, vrm_version

HEAD = Mesh(torch.tensor([[0.0, 0, 0], [50, 0, 0], [0, 50, 0]]), torch.tensor([[0, 1, 2]]))
SHAPES = {"Fcl_EYE_Close_L": torch.ones(3, 3), "grin": torch.ones(3, 3)}


@pytest.mark.parametrize(("version", "name"), [("VRMC_vrm", "blinkLeft"), ("VRM", "blink_l")])
def test_expressions_are_read_and_added(tmp_path: Path, version: str, name: str) -> None:
    path = tmp_path / "avatar.vrm"
    write_character(path, HEAD, SHAPES, Planted(vrm=version, expressions={name: "Fcl_EYE_Close_L"}))
    document = read_document(path)
    assert vrm_version(document) == version
    assert vrm_expressions(document) == {name: (MorphBind(0, 0, 0),)}
    root = copy.deepcopy(document.root)
    added = {"jawOpen": [MorphBind(0, 0, 2)], name.upper(): [MorphBind(0, 0, 1)], "tongueOut": []}
    assert add_expressions(document, root, added) == ("jawOpen",)
    before, after = document.root["extensions"][version], root["extensions"][version]
    assert {key: after[key] for key in after if "xpress" not in key and "blend" not in key} == {
        key: before[key] for key in before if "xpress" not in key and "blend" not in key
    }
    document.root = root
    assert vrm_expressions(document) == {name: (MorphBind(0, 0, 0),), "jawOpen": (MorphBind(0, 0, 2),)}


def test_a_file_that_is_no_vrm_has_none(tmp_path: Path) -> None:
    path = tmp_path / "plain.glb"
    write_character(path, HEAD)
    document = read_document(path)
    assert vrm_version(document) is None
    assert vrm_expressions(document) == {}
    assert add_expressions(document, copy.deepcopy(document.root), {"jawOpen": [MorphBind(0, 0, 0)]}) == ()


def test_an_avatar_is_read_as_a_rig(tmp_path: Path) -> None:
    path = tmp_path / "avatar.vrm"
    write_character(path, HEAD, SHAPES, Planted(vrm="VRMC_vrm"))
    assert load_rig(path).names == tuple(SHAPES)
    assert len(load_mesh(path).faces) > len(HEAD.faces)
