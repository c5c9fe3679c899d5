"""``torchface retarget`` onto a rig whose mouthClose opens the jaw."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from planted.characters import Planted, write_character
from planted.glb_files import unpacked
from torchface import BlendshapeRig, Take, Track, load_take, save_rig, save_take
from torchface.cli import main
from torchface.errors import NameMismatchError
from torchface.io import load_animation, load_image
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.synthetic import performer
from torchface.workflows.convert_file import convert_file
from torchface.workflows.retarget_weights import retarget_weights
from torchface.workflows.weight_files import WeightFiles


def test_the_jaw_is_opened_once(tmp_path: Path) -> None:
    rig = performer(texture=False).select(["jawOpen", "mouthClose", "mouthPucker"])
    opens_jaw = torch.tensor([0.0, 1.0, 0.0])[:, None, None] * rig.deltas[0]
    other = BlendshapeRig(rig.neutral, rig.deltas + opens_jaw, rig.names)
    save_rig(rig, tmp_path / "arkit.glb")
    save_rig(other, tmp_path / "other.glb")
    weights = torch.tensor([[0.8, 0.5, 0.1], [0.3, 0.3, 0.9]])
    save_take(Take(60.0, weights=Track(rig.names, weights[..., None])), tmp_path / "take.csv")
    done = retarget_weights(tmp_path / "take.csv", tmp_path / "other.glb", WeightFiles(tmp_path / "out.csv"))
    torch.testing.assert_close(other(done.take.weights.values[..., 0]), rig(weights), atol=1e-3, rtol=0)
    assert any("opens the jaw itself" in warning for warning in done.warnings)
    back = retarget_weights(
        tmp_path / "out.csv", tmp_path / "arkit.glb", WeightFiles(tmp_path / "back.csv"), tmp_path / "other.glb"
    )
    torch.testing.assert_close(back.take.weights.values[..., 0], weights, atol=1e-4, rtol=0)
    table = tmp_path / "table.toml"
    table.write_text("[jawOpen]\nsum = {jawOpen = 1.0}\n")
    written = WeightFiles(tmp_path / "ruled.csv")
    ruled = retarget_weights(tmp_path / "take.csv", tmp_path / "other.glb", written, table=table)
    torch.testing.assert_close(ruled.take.weights.values[..., 0], weights, atol=1e-4, rtol=0)


def test_a_target_of_another_unit_is_said_with_its_size(tmp_path: Path) -> None:
    rig = performer(texture=False).select(["jawOpen", "mouthClose"])
    large = BlendshapeRig(rig.neutral.with_vertices(10 * rig.vertices), 10 * rig.deltas, rig.names)
    save_rig(large, tmp_path / "large.glb")
    save_take(Take(60.0, weights=Track(rig.names, torch.full((2, 2, 1), 0.5))), tmp_path / "take.csv")
    done = retarget_weights(tmp_path / "take.csv", tmp_path / "large.glb", WeightFiles(tmp_path / "out.csv"))
    size = 10 * float((rig.vertices.amax(0) - rig.vertices.amin(0)).max())
    assert done.warnings[0].startswith(f"{tmp_path / 'large.glb'}: {size:,.4g} mm, expected 80 to 700 of a head")


def test_most_shapes_without_a_name_on_the_target_are_counted(tmp_path: Path) -> None:
    rig = performer(texture=False).select(["jawOpen"])
    save_rig(rig, tmp_path / "rig.glb")
    names = ("jawOpen", "Maw", "Snout", "Horns")
    save_take(Take(60.0, weights=Track(names, torch.tensor([[0.5, 0.5, 0.5, 0.0]])[..., None])), tmp_path / "take.csv")
    done = retarget_weights(tmp_path / "take.csv", tmp_path / "rig.glb", WeightFiles(tmp_path / "out.csv"))
    said = f"only 1 of the 3 shapes that move in {tmp_path / 'take.csv'} drive a shape of {tmp_path / 'rig.glb'}: "
    assert any(warning.startswith(said) for warning in done.warnings)


def test_action_units_of_openface_move_a_rig_and_those_without_a_shape_are_named(
    tmp_path: Path, messages_of: Callable[..., str]
) -> None:
    rig = performer(texture=False).select(["jawOpen", "mouthSmileLeft", "mouthSmileRight"])
    save_rig(rig, tmp_path / "rig.glb")
    header = "frame, timestamp, confidence, success, x_0, y_0, AU12_r, AU25_r, AU26_r, AU26_c"
    (tmp_path / "film.csv").write_text(f"{header}\n1, 0, 1, 1, 10, 10, 3, 1, 5, 1\n2, 0.04, 1, 1, 10, 10, 0, 1, 0, 0\n")
    out = tmp_path / "out.csv"
    said = messages_of("retarget", tmp_path / "film.csv", "--to", tmp_path / "rig.glb", "--out", out)
    assert "3 of 3 shapes driven drives nothing: AU25_r" in said
    found = rig.weights_from(load_take(out).weights)
    torch.testing.assert_close(found, torch.tensor([[1.0, 0.6, 0.6], [0.0, 0.0, 0.0]]))


def test_a_shape_without_motion_does_not_count_as_driven(tmp_path: Path, messages_of: Callable[..., str]) -> None:
    rig = performer(texture=False).select(["jawOpen", "mouthSmileLeft", "mouthPucker"])
    deltas = rig.deltas * torch.tensor([1.0, 0.0, 1.0])[:, None, None]
    save_rig(BlendshapeRig(rig.neutral, deltas, rig.names), tmp_path / "rig.glb")
    save_take(Take(30.0, weights=Track(rig.names[:2], torch.ones(2, 2, 1))), tmp_path / "take.csv")
    words = ["retarget", tmp_path / "take.csv", "--to", tmp_path / "rig.glb", "--out", tmp_path / "out.csv"]
    said = messages_of(*words)
    assert "1 of 3 shapes driven nothing drives mouthPucker has no motion in the target: mouthSmileLeft" in said


def test_an_identity_shape_is_not_spoken_of(tmp_path: Path, messages_of: Callable[..., str]) -> None:
    rig = performer(texture=False).select(["jawOpen"])
    names, deltas = ("Basis", "jawOpen", "thin"), torch.cat([0 * rig.deltas, rig.deltas, 0 * rig.deltas])
    save_rig(BlendshapeRig(rig.neutral, deltas, names), tmp_path / "rig.glb")
    for known in (("jawOpen",), ("Basis", "jawOpen")):
        weights = torch.tensor([float(name == "jawOpen") for name in known]).expand(2, -1)
        save_take(Take(30.0, weights=Track(known, weights[..., None])), tmp_path / "take.csv")
        words = ["retarget", tmp_path / "take.csv", "--to", tmp_path / "rig.glb", "--out", tmp_path / "out.csv"]
        said = messages_of(*words)
        assert "1 of 1 shapes driven" in said
        assert "Basis" not in said
        assert "thin" not in said


def test_names_that_nothing_knows_are_refused_with_the_flags_that_map_them(tmp_path: Path) -> None:
    save_rig(performer(texture=False).select(["jawOpen"]), tmp_path / "rig.glb")
    save_take(Take(30.0, weights=Track(("にやり", "ぺろっ"), torch.ones(2, 2, 1))), tmp_path / "mmd.csv")
    with pytest.raises(NameMismatchError, match=r"mmd\.csv: .*にやり.*\(--table\) or example poses \(--poses\)"):
        retarget_weights(tmp_path / "mmd.csv", tmp_path / "rig.glb", WeightFiles(tmp_path / "out.csv"))


def test_a_map_is_learned_from_poses_kept_and_drawn(tmp_path: Path, messages_of: Callable[..., str]) -> None:
    whole = performer(texture=False)
    creature = whole.select(["jawOpen", "mouthPucker", "browInnerUp"])
    creature = BlendshapeRig(creature.neutral, creature.deltas, ("Maw", "Snout", "Horns"))
    save_rig(creature, tmp_path / "creature.glb")
    weights = torch.tensor([[0.8, 0.5], [0.2, 0.0]])
    save_take(Take(60.0, weights=Track(("jawOpen", "browInnerUp"), weights[..., None])), tmp_path / "take.csv")
    (tmp_path / "poses.toml").write_text(
        "[roar]\nfrom = {jawOpen = 1.0}\nto = {Maw = 0.9, Snout = 0.2}\n"
        "[wonder]\nfrom = {browInnerUp = 1.0}\nto = {Horns = 0.7}\n"
    )
    take, rig, out = (str(tmp_path / name) for name in ("take.csv", "creature.glb", "out.csv"))
    told = messages_of("retarget", take, "--to", rig, "--poses", tmp_path / "poses.toml", "--out", out)
    assert "3 factors for 3 shapes from 2 poses, which they give within 0.000" in told
    found = load_take(out).weights
    expected = torch.stack([0.9 * weights[:, 0], 0.2 * weights[:, 0], 0.7 * weights[:, 1]], 1)
    assert (found.values[..., 0] - expected).abs().max() < 2e-3
    main(["retarget", take, "--to", rig, "--table", str(tmp_path / "out_table.toml"), "--out", str(tmp_path / "b.csv")])
    torch.testing.assert_close(load_take(tmp_path / "b.csv").weights.values, found.values)
    picture = load_image(tmp_path / "out_poses.png")
    left, right = picture[:, :, : picture.shape[2] // 2], picture[:, :, picture.shape[2] // 2 :]
    assert picture.shape[2] > 400
    assert (left - right).abs().max() > 0.3  # two poses


def test_uneven_times_go_with_the_weights(tmp_path: Path) -> None:
    rig = performer(texture=False).select(["jawOpen", "mouthPucker"])
    save_rig(rig, tmp_path / "rig.glb")
    seconds = torch.rand(20, generator=torch.Generator().manual_seed(0), dtype=torch.float64).add(0.2).cumsum(0) / 30
    weights = torch.rand(20, 2, 1, generator=torch.Generator().manual_seed(1))
    save_take(Take(30.0, weights=Track(rig.names, weights), seconds=seconds), tmp_path / "take.csv")
    words = ["retarget", tmp_path / "take.csv", "--to", tmp_path / "rig.glb", "--out", tmp_path / "out.csv"]
    words += ["--live-link", tmp_path / "live.csv", "--animation", tmp_path / "out.glb", "--quiet"]
    main([str(word) for word in words])
    written = [load_take(tmp_path / "out.csv"), load_take(tmp_path / "live.csv"), load_animation(tmp_path / "out.glb")]
    for found in written:
        torch.testing.assert_close(found.times, seconds - seconds[0], atol=2e-5, rtol=0)


def test_the_animated_character_keeps_all_that_it_has(tmp_path: Path) -> None:
    """Nodes, skeleton, materials and its own animation; the head's bone turns as the take says."""
    person = performer(texture=False).select(["jawOpen", "mouthPucker"])
    shapes = dict(zip(person.names, person.deltas, strict=True))
    write_character(tmp_path / "hero.vrm", person.neutral, shapes, Planted(vrm="VRMC_vrm"))
    weights = torch.rand(20, 2, 1, generator=torch.Generator().manual_seed(1)).round(decimals=3)
    still = torch.zeros(20, dtype=torch.float64)
    columns = {name: torch.linspace(0, 0.4, 20).double() if name == "HeadYaw" else still for name in ROTATIONS}
    save_take(Take(30.0, weights=Track(person.names, weights), extras={"columns": columns}), tmp_path / "take.csv")
    words = ["retarget", tmp_path / "take.csv", "--to", tmp_path / "hero.vrm", "--out", tmp_path / "out.csv"]
    main([str(word) for word in (*words, "--animation", tmp_path / "out.glb", "--quiet")])
    (before, _), (after, _) = unpacked(tmp_path / "hero.vrm"), unpacked(tmp_path / "out.glb")
    for key in ("nodes", "skins", "materials", "meshes", "extensions", "scenes"):
        assert after[key] == before[key], key
    assert [one["name"] for one in after["animations"]] == ["performance", "talk"]
    turned = {channel["target"]["node"] for channel in after["animations"][0]["channels"]}
    bones = before["extensions"]["VRMC_vrm"]["humanoid"]["humanBones"]
    assert turned == {0, bones["head"]["node"], bones["neck"]["node"]}
    with pytest.warns(UserWarning, match="left out: the character's other animations: .*talk"):
        played = load_animation(tmp_path / "out.glb")
    torch.testing.assert_close(played.weights.values, weights, atol=1e-3, rtol=0)
    turns = f"{tmp_path / 'out.glb'}: the weights of its shapes are read, not how its head and eyes turn"
    with pytest.warns(UserWarning, match="left out"):
        assert turns in convert_file(tmp_path / "out.glb", tmp_path / "plain.glb").notes
    with pytest.warns(UserWarning, match="left out"):
        assert retarget_weights(tmp_path / "out.glb", tmp_path / "hero.vrm", WeightFiles(tmp_path / "b.csv")).notes == (
            turns,
        )
    assert retarget_weights(tmp_path / "plain.glb", tmp_path / "hero.vrm", WeightFiles(tmp_path / "b.csv")).notes == ()


def test_what_an_unpacked_character_loses_is_said(tmp_path: Path) -> None:
    rig = performer(texture=False).select(["jawOpen", "mouthPucker"])
    save_rig(rig, tmp_path / "hero.glb")
    root, binary = unpacked(tmp_path / "hero.glb")
    root["buffers"][0]["uri"] = "hero.bin"
    (tmp_path / "hero.bin").write_bytes(binary)
    (tmp_path / "hero.gltf").write_text(json.dumps(root))
    save_take(Take(30.0, weights=Track(rig.names, torch.rand(3, 2, 1))), tmp_path / "take.csv")
    files = WeightFiles(tmp_path / "out.csv", tmp_path / "out.glb")
    done = retarget_weights(tmp_path / "take.csv", tmp_path / "hero.gltf", files)
    assert any("gltf-transform/cli copy" in warning for warning in done.warnings)


def test_weights_called_as_a_rig_are_refused_with_the_option_that_writes_one(
    tmp_path: Path, messages_of: Callable[..., str]
) -> None:
    (tmp_path / "take.csv").touch()
    words = ["retarget", tmp_path / "take.csv", "--to", tmp_path, "--out", tmp_path / "hero_take.glb"]
    assert "the animated rig is written by --animation" in messages_of(*words, status=2)
