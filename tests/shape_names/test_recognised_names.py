"""Names of other programs are ARKit's shapes, and no others are."""

import pytest
import torch

from torchface.capture.priors.shape_prior import face_halves
from torchface.shape_names import (
    ARKIT,
    METAHUMAN,
    UNIFIED,
    VISEMES,
    VRM0,
    VRM1,
    antagonists,
    arkit_name,
    mapping,
    recognised_mapping,
    recognised_shapes,
)
from torchface.shape_names.recognised_names import arkit_count

CC4 = [
    "A01_Brow_Inner_Up",
    "A02_Brow_Down_Left",
    "A03_Brow_Down_Right",
    "A04_Brow_Outer_Up_Left",
    "A05_Brow_Outer_Up_Right",
    "A06_Eye_Look_Up_Left",
    "A07_Eye_Look_Up_Right",
    "A08_Eye_Look_Down_Left",
    "A09_Eye_Look_Down_Right",
    "A10_Eye_Look_Out_Left",
    "A11_Eye_Look_In_Left",
    "A12_Eye_Look_In_Right",
    "A13_Eye_Look_Out_Right",
    "A14_Eye_Blink_Left",
    "A15_Eye_Blink_Right",
    "A16_Eye_Squint_Left",
    "A17_Eye_Squint_Right",
    "A18_Eye_Wide_Left",
    "A19_Eye_Wide_Right",
    "A20_Cheek_Puff",
    "A21_Cheek_Squint_Left",
    "A22_Cheek_Squint_Right",
    "A23_Nose_Sneer_Left",
    "A24_Nose_Sneer_Right",
    "A25_Jaw_Open",
    "A26_Jaw_Forward",
    "A27_Jaw_Left",
    "A28_Jaw_Right",
    "A29_Mouth_Funnel",
    "A30_Mouth_Pucker",
    "A31_Mouth_Left",
    "A32_Mouth_Right",
    "A33_Mouth_Roll_Upper",
    "A34_Mouth_Roll_Lower",
    "A35_Mouth_Shrug_Upper",
    "A36_Mouth_Shrug_Lower",
    "A37_Mouth_Close",
    "A38_Mouth_Smile_Left",
    "A39_Mouth_Smile_Right",
    "A40_Mouth_Frown_Left",
    "A41_Mouth_Frown_Right",
    "A42_Mouth_Dimple_Left",
    "A43_Mouth_Dimple_Right",
    "A44_Mouth_Upper_Up_Left",
    "A45_Mouth_Upper_Up_Right",
    "A46_Mouth_Lower_Down_Left",
    "A47_Mouth_Lower_Down_Right",
    "A48_Mouth_Press_Left",
    "A49_Mouth_Press_Right",
    "A50_Mouth_Stretch_Left",
    "A51_Mouth_Stretch_Right",
    "T01_Tongue_Out",
]


@pytest.mark.parametrize(
    ("dialect", "spelled"),
    [
        ("ARKit", list(ARKIT)),
        ("Live Link, Perfect Sync", [name[0].upper() + name[1:] for name in ARKIT]),
        ("Faceit", [name.replace("Left", "_L").replace("Right", "_R") for name in ARKIT]),
        ("Audio2Face, Maya", [f"blendShape1.{name}" for name in ARKIT]),
        ("Daz", [f"Genesis9__facs_bs_{name[0].upper()}{name[1:]}_div2" for name in ARKIT]),
        ("lower case", [name.lower() for name in ARKIT]),
        ("MetaHuman", list(METAHUMAN.names)),
        ("CC4 Extended Plus", CC4),
    ],
)
def test_a_dialect_has_all_52(dialect: str, spelled: list[str]) -> None:
    assert tuple(recognised_shapes(spelled)) == ARKIT, dialect


def test_every_cc4_name_is_the_one_it_says() -> None:
    assert sorted(map(str, map(arkit_name, CC4))) == sorted(ARKIT)
    assert arkit_name("A10_Eye_Look_Out_Left") == "eyeLookOutLeft"


@pytest.mark.parametrize(
    ("name", "arkit"),
    [
        ("Fcl_EYE_Close_L", "eyeBlinkLeft"),
        ("Face.M_F00_000_00_Fcl_EYE_Close_R", "eyeBlinkRight"),
        ("blinkLeft", "eyeBlinkLeft"),
        ("Blink_R", "eyeBlinkRight"),
        ("Eye_L_Look_L", "eyeLookOutLeft"),  # CC4: the left eye looks to the left
        ("Eye_R_Look_L", "eyeLookInRight"),
        ("Mouth_Down_Lower_R", "mouthLowerDownRight"),
        ("Jaw_L", "jawLeft"),
        ("Brow_Drop_L", "browDownLeft"),
        ("eye-blink.L", "eyeBlinkLeft"),
        ("facs_jnt_JawOpen", "jawOpen"),
        ("lf_mouth_smile", "mouthSmileLeft"),
        ("AU12_lipCornerPuller_R", "mouthSmileRight"),
        ("AU26_jawDrop", "jawOpen"),
        ("mouthSmile_L.001", "mouthSmileLeft"),
    ],
)
def test_names_of_other_programs(name: str, arkit: str) -> None:
    assert arkit_name(name) == arkit


def test_poses_of_several_shapes_and_both_sides_at_once_are_none_of_them() -> None:
    none = [
        "aa",
        "happy",
        "Fcl_MTH_A",
        "Fcl_ALL_Joy",
        "viseme_aa",
        "blink",
        "mouthOpen",
        "mouthSmile",
        "eyesClosed",
        "",
    ]
    none += [name for name in (*VRM0.names, *VRM1.names, *VISEMES.names) if "link" not in name]
    assert {name: arkit_name(name) for name in none} == dict.fromkeys(none)


def test_halves_are_one_shape_and_one_half_is_none() -> None:
    found = recognised_shapes(["jawOpen", "Brow_Raise_Inner_L", "Brow_Raise_Inner_R", "cheekPuff_L"])
    assert found["browInnerUp"].rows == (1, 2)
    assert set(found) == {"jawOpen", "browInnerUp"}
    assert (found["jawOpen"].as_arkit, found["browInnerUp"].as_arkit) == (True, False)


def test_arkits_own_spelling_counts_before_another() -> None:
    assert recognised_shapes(["Jaw_Open", "jawOpen"])["jawOpen"].rows == (1,)


def test_unified_expressions_that_mean_the_same_are_read_the_same() -> None:
    for arkit, twins in UNIFIED.twins.items():
        for twin in twins:
            found = arkit_name(twin)
            assert found is None or found.startswith(arkit), (twin, found, arkit)


@pytest.mark.parametrize("form", ["Head_blendShape1.{}", "bs_{}_Mesh", "Char_{}_shape", "{}"])
def test_rigs_that_add_to_all_names_are_driven_by_arkit(form: str) -> None:
    plain = [*ARKIT, "pupilDilate"]
    matrix = recognised_mapping(plain, [form.format(name) for name in plain])
    assert torch.equal(matrix, torch.eye(len(plain)))
    assert torch.equal(recognised_mapping([form.format(name) for name in plain], plain), matrix)


@pytest.mark.parametrize("form", ["hero_{}", "Char_{}_shape", "{}_Mesh"])
def test_what_all_names_share_hides_no_meaning(form: str) -> None:
    shared = [form.format(name) for name in ARKIT]
    assert torch.equal(mapping(ARKIT, shared), torch.eye(len(ARKIT)))
    assert torch.equal(antagonists(shared), antagonists(ARKIT))
    assert face_halves(shared) == face_halves(ARKIT)
    assert [shape.names for shape in recognised_shapes(shared).values()] == [(name,) for name in shared]


def test_sides_in_front_and_shared_by_all_stay() -> None:
    assert recognised_mapping(["browDownLeft", "browDownRight"], ["l_browDown"]).tolist() == [[1, 0]]
    left = ["eyeBlink_L", "browDown_L"]
    assert recognised_mapping(["eyeBlinkRight", "browDownRight"], left).tolist() == [[0, 0], [0, 0]]
    assert recognised_mapping(left, ["l_eyeBlink", "l_browDown"]).tolist() == [[1, 0], [0, 1]]


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (["eye_up", "eye_down"], ["brow_up", "brow_down"]),
        (["eyes_left", "eyes_right"], ["head_left", "head_right"]),
        (["upper_lip_suck", "upper_lip_tight"], ["lower_lip_suck", "lower_lip_tight"]),
        (["blow_cheek", "suck_cheek"], ["blow_nose", "suck_nose"]),
        (["eye_blink_left", "eye_wide_left", "eye_up"], ["brow_down_left", "brow_up"]),
        (["Mouth_Smile_L", "Mouth_Chew"], ["Jaw_Open", "Jaw_Fwd", "Jaw_Chew"]),
    ],
)
def test_a_beginning_or_ending_that_is_a_meaning_stays(ours: list[str], theirs: list[str]) -> None:
    assert not bool(recognised_mapping(ours, theirs).any())
    assert not bool(recognised_mapping(theirs, ours).any())


def test_shapes_of_two_vroid_characters_are_the_same_whatever_their_meshes_are_called() -> None:
    plain = ["Fcl_ALL_Joy", "Fcl_EYE_Close_L", "Fcl_EYE_Close_R", "Fcl_MTH_A", "Fcl_HA_Fung1"]
    ours, theirs = ([f"Face.M_F00_00{number}_00_{name}" for name in plain] for number in (0, 1))
    assert torch.equal(recognised_mapping(ours, theirs), torch.eye(5))
    assert torch.equal(recognised_mapping(ours, plain), torch.eye(5))


def test_metahumans_curves_are_driven_by_its_table_and_drive() -> None:
    assert torch.equal(recognised_mapping(ARKIT, METAHUMAN.names), METAHUMAN.from_arkit(torch.eye(len(ARKIT))).T)
    assert torch.equal(
        recognised_mapping(METAHUMAN.names, ARKIT), METAHUMAN.to_arkit(torch.eye(len(METAHUMAN.names))).T
    )


def test_of_two_shapes_for_one_motion_one_is_driven() -> None:
    assert recognised_mapping(["jawOpen"], ["Jaw_Open", "jawOpen"]).tolist() == [[0], [1]]
    assert recognised_mapping(["jawOpen"], ["Jaw_Open", "A25_Jaw_Open"]).tolist() == [[1], [0]]


def test_shapes_that_move_nothing_are_said_in_the_plural() -> None:
    assert arkit_count(["jawOpen"], ["tongueOut"]) == "1 of ARKit's 52 (its tongueOut moves nothing)"
    assert arkit_count([], ["jawOpen", "tongueOut"]) == "0 of ARKit's 52 (its jawOpen, tongueOut move nothing)"
