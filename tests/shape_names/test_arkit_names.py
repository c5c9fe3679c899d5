"""Weights keep their meaning from one naming to the other."""

import json
import re
from pathlib import Path

import pytest
import torch

from torchface.shape_names import ARKIT, antagonists, arkit_sources, mapping, mirror


def test_arkit_has_52_names_and_its_mirror_is_an_involution() -> None:
    assert len(set(ARKIT)) == 52
    twin = mirror(ARKIT)
    assert torch.equal(twin[twin], torch.arange(52))
    for i, name in enumerate(ARKIT):
        expected = name.replace("Left", "#").replace("Right", "Left").replace("#", "Right")
        assert ARKIT[int(twin[i])] == expected


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("L_smile", "R_smile"),
        ("lf_eye_blink", "rt_eye_blink"),
        ("hero:bs.L_mouthSmile", "hero:bs.R_mouthSmile"),
        ("SMILELEFT", "SMILERIGHT"),
        ("smile.L", "smile.R"),
        ("LeftEyeClosed", "RightEyeClosed"),
        ("AU12L_inner", "AU12R_inner"),
        ("Eye_L_Look_L", "Eye_R_Look_R"),
        ("A14_Eye_Blink_Left", "A15_Eye_Blink_Right"),
        ("facs_bs_MouthSmileLeft_div2", "facs_bs_MouthSmileRight_div2"),
    ],
)
def test_sides_stand_anywhere_in_a_name(left: str, right: str) -> None:
    assert mirror(["jaw", right, left, "∧", "AU12_r", "AU12_c", "roll"]).tolist() == [0, 2, 1, 3, 4, 5, 6]


def test_other_programs_names_mean_arkits_where_no_other_name_is_spelled_so() -> None:
    maya = ["hero_bs." + re.sub("(.*)(L|R)(eft|ight)$", r"\2_\1", name) for name in ARKIT]
    for matrix in (mapping(ARKIT, maya), mapping(maya, ARKIT)):
        assert torch.equal(matrix, torch.eye(52))
    assert len(antagonists(maya)) == len(antagonists(ARKIT)) > 0
    assert mapping(["jawOpen"], ["A25_Jaw_Open", "jawOpen"]).tolist() == [[0], [1]]  # one shape for one motion
    assert mapping(["browInnerUp"], ["Brow_Raise_Inner_L", "browInnerUp"]).tolist() == [[0], [1]]


def test_live_link_spelling_is_a_permutation() -> None:
    shuffled = [name[0].upper() + name[1:] for name in reversed(ARKIT)]
    matrix = mapping(shuffled, ARKIT)
    assert torch.equal(matrix, torch.eye(52).flip(1))


@pytest.mark.real
def test_ict_and_back_keeps_every_weight_that_ict_has(ict_folder: Path) -> None:
    ict = json.loads((ict_folder / "vertex_indices.json").read_text())["expressions"]
    there, back = mapping(ARKIT, ict), mapping(ict, ARKIT)
    weights = torch.rand(52, generator=torch.Generator().manual_seed(0))
    expected = weights.clone()
    expected[ARKIT.index("tongueOut")] = 0
    torch.testing.assert_close(back @ there @ weights, expected)
    assert (there.sum(1) == 1).all()


def test_arkit_names_take_every_shape_once_and_mean_what_mapping_means() -> None:
    names = ["PupilDilate_L", "cheekPuff_R", "EyeBlinkLeft", "cheekPuff_L", "browInnerUp_L", "jawOpen", "JawOpen"]
    sources = arkit_sources(names)
    assert sources == {
        "eyeBlinkLeft": (2,),
        "jawOpen": (5,),
        "cheekPuff": (3, 1),
        "PupilDilate_L": (0,),
        "browInnerUp_L": (4,),  # without its other half it is not ARKit's shape
        "JawOpen": (6,),
    }
    # ARKit's weights move the renamed rig as they move the old one by mapping.
    matrix = mapping(ARKIT, names)
    for column, name in enumerate(ARKIT):
        if name in sources:
            assert set(matrix[:, column].nonzero()[:, 0].tolist()) >= set(sources[name])


@pytest.mark.real
def test_ict_has_51_of_arkits_names(ict_folder: Path) -> None:
    ict = json.loads((ict_folder / "vertex_indices.json").read_text())["expressions"]
    sources = arkit_sources(ict)
    assert [name for name in ARKIT if name not in sources] == ["tongueOut"]
    assert sorted(row for rows in sources.values() for row in rows) == list(range(len(ict)))
    assert {name: [ict[row] for row in rows] for name, rows in sources.items() if len(rows) > 1} == {
        "browInnerUp": ["browInnerUp_L", "browInnerUp_R"],
        "cheekPuff": ["cheekPuff_L", "cheekPuff_R"],
    }
