"""A posed rig is the rig at those weights, from whatever file it lies in."""

import json
import math
import re
from functools import partial
from pathlib import Path

import pytest
import torch
from rig_samples import corrective_sheet

from planted.glb_files import rewrite
from torchface import BlendshapeRig, Take, Track, save_animation, save_mesh, save_rig, save_take
from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.workflows.convert_file import convert_file
from torchface.workflows.describe_file import describe
from torchface.workflows.posed_mesh import load_posed, pose_weights


def test_pose_by_words_and_by_take_is_the_rig_at_those_weights(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    save_rig(dome_rig, tmp_path / "rig.glb")
    by_words = load_posed(tmp_path / "rig.glb", pose_weights(["jawOpen=0.5", "MouthSmileLeft=1"]))
    expected = dome_rig(torch.tensor([[0.5, 0, 1, 0]]))[0]
    torch.testing.assert_close(by_words.mesh.vertices, expected, atol=1e-3, rtol=0)
    torch.testing.assert_close(by_words.neutral.vertices, dome_rig.vertices, atol=1e-3, rtol=0)
    weights = torch.rand(5, 4, 1, generator=torch.Generator().manual_seed(0))
    save_take(Take(60.0, weights=Track(dome_rig.names, weights)), tmp_path / "take.csv")
    save_animation(dome_rig, Take(60.0, weights=Track(dome_rig.names, weights)), tmp_path / "take.glb")
    for take in ("take.csv", "take.glb"):
        by_take = load_posed(tmp_path / "rig.glb", {}, tmp_path / take, 3)
        torch.testing.assert_close(by_take.mesh.vertices, dome_rig(weights[3:4, :, 0])[0], atol=1e-3, rtol=0)
        assert not by_take.faults
    save_rig(dome_rig.select(["jawOpen"]), tmp_path / "jaw.glb")
    fewer = load_posed(tmp_path / "jaw.glb", {}, tmp_path / "take.csv", 3)
    lost = ", ".join(name for name in dome_rig.names if name != "jawOpen")
    assert fewer.faults == (
        f"warning: {tmp_path / 'jaw.glb'} has no shape for {lost}, which move in {tmp_path / 'take.csv'}",
    )
    with pytest.raises(ValueRangeError, match="found no weights, expected a weight take"):
        load_posed(tmp_path / "rig.glb", {}, tmp_path / "rig.glb", 0)


def test_what_cannot_be_posed_is_said(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    save_rig(dome_rig, tmp_path / "rig.glb")
    save_mesh(dome_rig.neutral, tmp_path / "mesh.obj")
    with pytest.raises(NameMismatchError, match=r"mesh.obj: found a mesh without shapes"):
        load_posed(tmp_path / "mesh.obj", {"jawOpen": 1.0})
    with pytest.raises(NameMismatchError, match="found tongueOut; expected shapes of the rig: jawOpen"):
        load_posed(tmp_path / "rig.glb", {"tongueOut": 1.0})
    with pytest.raises(NameMismatchError, match=r"found jawOpn; expected shapes of the rig: did you mean jawOpen\?"):
        load_posed(tmp_path / "rig.glb", {"jawOpn": 1.0})
    save_mesh(dome_rig.neutral, tmp_path / "plain.glb")
    at_rest = load_posed(tmp_path / "plain.glb", {}).mesh.vertices
    torch.testing.assert_close(at_rest, dome_rig.vertices, atol=1e-3, rtol=0)
    for word in ("jawOpen", "=1", "jawOpen=wide", "jawOpen=nan", "jawOpen=1e9"):
        with pytest.raises(ValueRangeError, match="expected NAME=NUMBER"):
            pose_weights([word])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"drivers": ["jawOpen", "jaw_smile"]}, "a cycle, jaw_smile"),
        ({"drivers": ["jawOpen"], "peak": math.nan}, "'jaw_smile': peak: found nan"),
        ({"drivers": ["jawOpen", "gone"]}, "'jaw_smile' and no morph target 'gone'"),
        ({"drivers": [f"shape{i}" for i in range(5000)]}, "'jaw_smile': found a product of 5000"),
    ],
    ids=["cycle", "NaN peak", "missing target", "5,000 drivers"],
)
@pytest.mark.parametrize("ending", [".glb", ".usda"])
def test_a_broken_corrective_is_an_error_and_no_rig_without_shapes(
    ending: str, change: dict[str, object], message: str, tmp_path: Path
) -> None:
    path = tmp_path / f"rig{ending}"
    save_rig(corrective_sheet(), path)
    if ending == ".glb":
        rewrite(path, lambda root: root["meshes"][0]["extras"]["torchface"]["correctives"][0].update(change))
    else:
        data = path.read_bytes()
        notes = re.search(r"string torchface = '(.*correctives.*)'$", data.decode(), re.MULTILINE)
        record = json.loads(notes[1])
        record["correctives"][0].update(change)
        path.write_text(data.decode().replace(notes[1], json.dumps(record)))
    convert = partial(convert_file, path, tmp_path / "out.obj")
    for read in (convert,) if ending == ".usda" else (convert, partial(describe, path), partial(load_posed, path, {})):
        with pytest.raises(FileFormatError, match=message):
            read()
    assert not (tmp_path / "out.obj").exists()


def test_a_pose_may_be_one_text_and_names_may_have_blanks() -> None:
    assert pose_weights(["Kiefer auf=1 b=.5", "目 を=-2"]) == {"Kiefer auf": 1, "b": 0.5, "目 を": -2}
    for word in ("", "a=1 b", "a = 1"):
        with pytest.raises(ValueRangeError, match="expected NAME=NUMBER"):
            pose_weights([word])
