"""Characters of other names are driven; those that cannot move are refused."""

from pathlib import Path

import pytest
import torch
from planted_faces import JAW, SMILE

from planted.glb_files import rewrite
from torchface import BlendshapeRig, save_rig
from torchface.errors import FileFormatError
from torchface.shape_names import ARKIT
from torchface.workflows.browser_app import character as characters
from torchface.workflows.browser_app.character import load_character


def test_a_mapping_drives_a_character_of_other_names(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    names = ["Mund_auf", "Brauen", "Laecheln_L", "Laecheln_R"]
    save_rig(BlendshapeRig(dome_rig.neutral, dome_rig.deltas, names), tmp_path / "strange.glb")
    with pytest.raises(Exception, match=r"found the shapes 'Mund_auf'.*--mapping FILE.*\n\[\"Mund_auf\"\]") as told:
        load_character(tmp_path / "strange.glb")
    assert type(told.value).__name__ == "NameMismatchError"
    table = tmp_path / "mapping.toml"
    table.write_text(str(told.value).split("such as\n")[1] + "\ngain = 0.5\n")  # what the message shows is a table
    moved = load_character(tmp_path / "strange.glb", table)
    weights = torch.zeros(5000, 52)
    weights[:, JAW] = torch.linspace(0, 1, 5000)
    assert torch.equal(moved.weights(weights)[:, 0], weights[:, JAW] * 0.5)
    assert "1 of its 4 shapes move" in moved.notes()[0]
    table.write_text("[Nase]\nsum = {jawOpen = 1.0}\n")
    with pytest.raises(Exception, match=r"mapping.toml: retarget: found rules for Nase, expected shapes"):
        load_character(tmp_path / "strange.glb", table)
    table.write_text("[Mund_auf]\nsum = {jawOpne = 1.0}\n")
    with pytest.raises(Exception, match=r"mapping.toml: .*names jawOpne, expected shapes of the source"):
        load_character(tmp_path / "strange.glb", table)


def test_shapes_by_other_programs_names_move(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    names = ["A25_Jaw_Open", "Fcl_EYE_Close_L", "mouthSmile_L", "Nase"]
    save_rig(BlendshapeRig(dome_rig.neutral, dome_rig.deltas, names), tmp_path / "other.glb")
    moved = load_character(tmp_path / "other.glb")
    weights = torch.rand(3, 52)
    expected = weights[:, [JAW, ARKIT.index("eyeBlinkLeft"), SMILE]]
    torch.testing.assert_close(moved.weights(weights), torch.cat([expected, torch.zeros(3, 1)], 1))


@pytest.mark.parametrize("version", ["VRMC_vrm", "VRM"])
def test_a_vrm_moves_by_what_its_expressions_say(dome_rig: BlendshapeRig, tmp_path: Path, version: str) -> None:
    """Where targets' names say nothing; a name that is known counts before an expression, and vowels do not double."""
    names = ["m_0", "m_1", "mouthSmile_L", "Fcl_MTH_A"]
    path = tmp_path / "avatar.vrm"
    save_rig(BlendshapeRig(dome_rig.neutral, dome_rig.deltas, names), tmp_path / "dome.glb")
    bound = {"JawOpen": (0, 0.8), "blinkLeft": (1, 1.0), "mouthSmileLeft": (0, 1.0)}
    one = {
        name: {"morphTargetBinds": [{"node": 0, "index": row, "weight": weight}]}
        for name, (row, weight) in bound.items()
    }
    zero = [
        {"name": name, "presetName": "unknown", "binds": [{"mesh": 0, "index": row, "weight": 100 * weight}]}
        for name, (row, weight) in bound.items()
    ]
    said = {"VRMC_vrm": {"expressions": {"custom": one}}, "VRM": {"blendShapeMaster": {"blendShapeGroups": zero}}}
    rewrite(tmp_path / "dome.glb", lambda root: root.update(extensions={version: said[version]}), path)
    weights = torch.rand(3, 52)
    expected = weights[:, [JAW, ARKIT.index("eyeBlinkLeft"), SMILE, JAW]] * torch.tensor([0.8, 1.0, 1.0, 0.0])
    torch.testing.assert_close(load_character(path).weights(weights), expected)


def test_broken_expressions_stop_no_vrm_whose_targets_have_names(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    broken = {"VRMC_vrm": {"expressions": {"preset": {"happy": {"morphTargetBinds": [{"node": 99, "index": 0}]}}}}}
    for names in (["jawOpen", "m_1", "m_2", "m_3"], ["m_0", "m_1", "m_2", "m_3"]):
        save_rig(BlendshapeRig(dome_rig.neutral, dome_rig.deltas, names), tmp_path / "dome.glb")
        path = tmp_path / "avatar.vrm"
        rewrite(tmp_path / "dome.glb", lambda root: root.update(extensions=broken), path)
        if names[0] == "jawOpen":
            assert load_character(path).weights(torch.ones(1, 52)).tolist() == [[1, 0, 0, 0]]
        else:
            with pytest.raises(FileFormatError, match="happy"):
                load_character(path)


def test_characters_that_cannot_move(dome_rig: BlendshapeRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from torchface import save_mesh

    save_mesh(dome_rig.neutral, tmp_path / "statue.glb")
    with pytest.raises(FileFormatError, match=r"statue.glb: found no morph target.*torchface rig .*arkit"):
        load_character(tmp_path / "statue.glb")
    save_rig(dome_rig, tmp_path / "dome.glb")
    whole = (tmp_path / "dome.glb").read_bytes()
    (tmp_path / "broken.glb").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileFormatError, match=r"broken.glb"):
        load_character(tmp_path / "broken.glb")
    monkeypatch.setattr(characters, "LARGEST_CHARACTER", 1000)
    with pytest.raises(FileFormatError, match=r"dome.glb: found 0 MB, expected at most 0 MB for a character"):
        load_character(tmp_path / "dome.glb")


def test_a_mouth_of_vowels_alone_is_driven_by_them(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    """As VRoid's are. A character that has ARKit's jawOpen beside them opens its mouth once."""
    names = ["Fcl_MTH_A", "Fcl_MTH_U", "Fcl_MTH_O", "Fcl_EYE_Close_L"]
    save_rig(BlendshapeRig(dome_rig.neutral, dome_rig.deltas, names), tmp_path / "vroid.glb")
    row = ARKIT.index
    faces = torch.zeros(3, len(ARKIT))
    faces[0, JAW] = 0.7
    faces[1, [row("mouthPucker"), JAW]] = torch.tensor([0.9, 0.1])
    faces[2, [row("mouthFunnel"), JAW, row("eyeBlinkLeft")]] = torch.tensor([0.7, 0.35, 1.0])
    found = load_character(tmp_path / "vroid.glb").weights(faces)
    expected = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1]])
    torch.testing.assert_close(found, expected, atol=1e-3, rtol=0)
    names[1] = "jawOpen"
    save_rig(BlendshapeRig(dome_rig.neutral, dome_rig.deltas, names), tmp_path / "both.glb")
    torch.testing.assert_close(load_character(tmp_path / "both.glb").weights(faces[:1]), torch.tensor([[0, 0.7, 0, 0]]))
