"""What ``torchface info`` says of a take's markers: their extent in millimetres, and the file's unit."""

import shlex
from pathlib import Path

import numpy as np
import pytest
import torch

from planted.characters import Planted, write_character
from planted.glb_files import packed, unpacked
from torchface import Annotations, Attachment, BlendshapeRig, Mesh, Take, Track, save_mesh, save_rig, save_take
from torchface.errors import FileFormatError
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.io import save_calibration, save_pts
from torchface.synthetic import neutral_head, performer
from torchface.workflows.convert_file import convert_file
from torchface.workflows.describe_file import describe


def test_the_extent_of_markers_is_in_millimetres_and_knows_no_outlier(tmp_path: Path) -> None:
    corners = torch.tensor([[10.0, 5.0, 2.0], [90.0, 125.0, 32.0], [50.0, 60.0, 12.0]])
    values = corners.expand(30, 3, 3).clone()
    values[4, 1] = 5000.0
    values[7:9, 0] = torch.nan
    save_take(Take(60.0, markers=Track(("a", "b", "c"), values)), tmp_path / "take.c3d")
    rows = dict(describe(tmp_path / "take.c3d", None, None))
    assert rows["extent, mm"] == "80.0 x 120.0 x 30.0, of each marker's median place"
    assert "unit mm" in rows["kept besides"]


def test_a_head_model_of_others_says_what_it_has(tmp_path: Path) -> None:
    corners = np.random.default_rng(0).normal(size=(9, 3))
    arrays = {"v_template": corners, "shapedirs": np.zeros((9, 3, 350)), "f": np.array([[0, 1, 2], [3, 4, 5]])}
    np.savez(tmp_path / "flame.npz", **arrays)
    rows = dict(describe(tmp_path / "flame.npz"))
    assert rows["head model"].startswith("FLAME")
    assert (rows["identity parameters"], rows["expression parameters"]) == ("300", "50")
    assert (rows["joints"], rows["vertices"]) == ("none", "9")


def test_what_fit_and_arkit_write_is_known(tmp_path: Path) -> None:
    save_pts(torch.tensor([[1.0, 2.0], [11.0, 32.0]]), tmp_path / "face.pts")
    assert dict(describe(tmp_path / "face.pts"))["extent, pixels"] == "10.0 x 30.0"
    points = '{"version": 2, "labels": [], "landmarks": {"points": [[0, 0, 0], [1, 2, 3]]}}'
    (tmp_path / "scan.ljson").write_text(points)
    assert dict(describe(tmp_path / "scan.ljson"))["extent, the scan's unit"] == "1.0 x 2.0 x 3.0"
    K = torch.tensor([[900.0, 0, 319.5], [0, 900, 239.5], [0, 0, 1]], dtype=torch.float64)
    save_calibration(CameraCalibration(K, torch.zeros(5, dtype=torch.float64), 640, 480), tmp_path / "c.toml")
    assert dict(describe(tmp_path / "c.toml"))["focal length, pixels"] == "900.0, 900.0"
    (tmp_path / "w_error.csv").write_text("frame,time,error_mm,motion_mm\n0,0,1,4\n1,0.04,2,8\n")
    rows = dict(describe(tmp_path / "w_error.csv"))
    assert rows["motion_mm"] == "mean 6.000, largest 8.000"
    assert "weights" not in rows


def test_what_other_commands_read_is_described(tmp_path: Path) -> None:
    np.savez(tmp_path / "frames.npz", exp=np.zeros((7, 50)), jaw=np.zeros((7, 3)))
    assert describe(tmp_path / "frames.npz") == [("exp", "array (7,50)"), ("jaw", "array (7,3)")]
    box = "<image file='{}.jpg'><box top='1' left='2' width='3' height='4'><part name='00' x='5' y='6'/></box></image>"
    images = box.format("a") + 2 * box.format("b")
    (tmp_path / "faces.xml").write_text(f"<dataset><images>{images}</images></dataset>")
    rows = describe(tmp_path / "faces.xml")
    assert rows == [("faces", "3 in 2 photographs"), ("landmarks", "1 of a face, pixels")]
    (tmp_path / "broken.task").write_bytes(b"no zip")
    with pytest.raises(FileFormatError, match=r"broken\.task"):
        describe(tmp_path / "broken.task")


def test_folders_that_are_no_rigs_say_what_they_are(tmp_path: Path) -> None:
    for name in ("a.glb", "neutral.obj"):
        (tmp_path / name).touch()
    with pytest.raises(FileFormatError, match=r"found a folder with 1: a\.glb, expected a file, such as .*a\.glb"):
        describe(tmp_path)
    (tmp_path / "model.toml").touch()
    model = tmp_path.rename(tmp_path.with_name("my model's"))
    with pytest.raises(FileFormatError, match="found a learned model, expected a rig; ") as refused:
        describe(model)
    assert shlex.split(str(refused.value).split("`")[1]) == ["torchface", "zoo", "describe", str(model)]


def test_a_head_of_two_metres_and_a_texture_that_is_not_read_are_said(tmp_path: Path) -> None:
    head = neutral_head(texture=False)
    save_mesh(head.with_vertices(8 * head.vertices), tmp_path / "large.obj")
    ((_, said),) = [row for row in describe(tmp_path / "large.obj") if row[0] == "warning"]
    assert "mm, expected 80 to 700 of a head" in said
    whole = tmp_path / "whole.glb"
    write_character(whole, head, how=Planted())  # a head with a body
    assert not [row for row in describe(whole) if row[0] == "warning"]
    root, binary = unpacked(whole)
    root["textures"][0] = {"extensions": {"MSFT_texture_dds": {"source": root["textures"][0]["source"]}}}
    whole.write_bytes(packed(root, binary))
    ((_, said),) = [row for row in describe(whole) if row[0] == "warning"]
    assert "1 of its textures cannot be read: found none of a kind that is known" in said
    assert "texture none" not in said


def test_what_is_not_there_is_told_before_its_ending(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="found no such file"):
        describe(tmp_path / "nothing")


@pytest.mark.parametrize("typed", ["'{}'", '"{}"', "{escaped}", "file:{}", " {} "])
def test_a_path_as_a_shell_would_have_read_it_is_suggested(tmp_path: Path, typed: str) -> None:
    there = tmp_path / "my takes (2)" / "a b.c3d"
    there.parent.mkdir()
    there.touch()
    escaped = str(there).replace(" ", r"\ ").replace("(", r"\(").replace(")", r"\)")
    with pytest.raises(FileFormatError, match="found no such file") as refused:
        describe(Path(typed.format(there, escaped=escaped)))
    assert str(refused.value).endswith(f"; did you mean {shlex.quote(str(there))}?")
    with pytest.raises(FileFormatError, match=r"expected an existing one$"):
        describe(Path(f"'{there}x'"))


def test_triangles_without_area_are_counted_where_a_rig_is_described(tmp_path: Path) -> None:
    vertices = torch.tensor([[0.0, 0, 0], [100, 0, 0], [0, 100, 0], [100, 100, 0], [50, 100, 0]])
    faces = torch.tensor([[0, 1, 2], [1, 3, 2], [2, 3, 4]])
    folded = torch.zeros(5, 3)
    folded[0] = torch.tensor([50.0, 50.0, 0.0])
    rig = BlendshapeRig(Mesh(vertices, faces), torch.stack([folded, 0.5 * folded]), ["folded", "half"])
    save_rig(rig, tmp_path / "rig.glb")
    assert dict(describe(tmp_path / "rig.glb"))["triangles without area"] == "1 at rest, 1 in folded"
    save_rig(BlendshapeRig(Mesh(vertices[:4], faces[:2]), rig.deltas[1:, :4], ["half"]), tmp_path / "whole.glb")
    assert "triangles without area" not in dict(describe(tmp_path / "whole.glb"))


def test_shapes_that_move_the_whole_mesh_are_said(tmp_path: Path) -> None:
    rig = performer(texture=False).select(["jawOpen", "jawLeft"])
    save_rig(BlendshapeRig(rig.neutral, rig.deltas + torch.tensor([0.0, 9.0, 0.0]), rig.names), tmp_path / "rig.glb")
    assert "warning" not in dict(describe(tmp_path / "rig.glb"))  # an expression besides
    deltas = torch.stack([rig.deltas[0], torch.tensor([3.0, 0.0, 4.0]).expand_as(rig.vertices)])
    save_rig(BlendshapeRig(rig.neutral, deltas, rig.names), tmp_path / "rig.glb")
    assert "all vertices alike in jawLeft (5.0 mm)" in dict(describe(tmp_path / "rig.glb"))["warning"]
    nothing = BlendshapeRig(rig.neutral, deltas * torch.tensor([1.0, 2e-4])[:, None, None], rig.names)
    save_rig(nothing, tmp_path / "rig.glb")
    rows = dict(describe(tmp_path / "rig.glb"))
    assert "warning" not in rows
    assert "(its jawLeft moves nothing)" in rows["ARKit's shapes"]


def test_heads_beside_each_other_are_listed_and_one_head_is_not(tmp_path: Path) -> None:
    rig = performer(texture=False)
    count, apart = len(rig.vertices), torch.tensor([400.0, 0.0, 0.0])
    faces = torch.cat([rig.neutral.faces, rig.neutral.faces + count])
    both = {"Anna": torch.arange(2 * count) < count, "Bert": torch.arange(2 * count) >= count}
    mesh = Mesh(torch.cat([rig.vertices, rig.vertices + apart]), faces, annotations=Annotations(regions=both))
    deltas = torch.cat([rig.deltas, rig.deltas], 1)
    deltas[20:, count:] = 0
    save_rig(BlendshapeRig(mesh, deltas, rig.names), tmp_path / "two.glb")
    said = dict(describe(tmp_path / "two.glb"))["heads"]
    assert said.startswith(f"2: Anna ({len(rig.names)} shapes), Bert (20 shapes); they are one rig here")
    assert any(said in note for note in convert_file(tmp_path / "two.glb", tmp_path / "both.glb").notes)
    assert not convert_file(tmp_path / "two.glb", tmp_path / "anna.glb", part="Anna").notes
    assert "heads" not in dict(describe(tmp_path / "two.glb", part="Bert"))
    save_rig(rig, tmp_path / "one.glb")
    assert "heads" not in dict(describe(tmp_path / "one.glb"))


def test_markers_see_no_shape_without_motion_and_it_is_not_spoken_of(tmp_path: Path) -> None:
    rig = performer(texture=False).select(["jawOpen"])
    rig = BlendshapeRig(rig.neutral, torch.cat([0 * rig.deltas, rig.deltas]), ("Basis", "jawOpen"))
    save_rig(rig, tmp_path / "rig.glb")
    Attachment.from_vertices(rig.neutral, rig.neutral.landmarks).save(tmp_path / "sites.json")
    said = dict(describe(tmp_path / "rig.glb", tmp_path / "sites.json"))["what the markers see"]
    assert "1 of the 1 shapes clearly" in said
    assert "Basis" not in said


def test_a_home_of_nobody_is_no_file() -> None:
    with pytest.raises(FileFormatError, match=r"^~nobody-of-this-name/x\.glb: found no such file.*existing one$"):
        describe(Path("~nobody-of-this-name/x.glb"))
