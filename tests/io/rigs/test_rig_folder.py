import errno
import os
import re
import shutil
from pathlib import Path

import pytest
import torch
from mutation import check_reader
from rig_samples import quad_sheet, sheet_rig

from torchface import BlendshapeRig, Mesh, load_rig, save_mesh, save_rig
from torchface.errors import AlignmentError, FileFormatError, NameMismatchError, TopologyError, ValueRangeError
from torchface.geometry.meshes.normal_maps import DetailMaps, decode_normals
from torchface.io import load_image
from torchface.synthetic import performer


def save_folder(rig: BlendshapeRig, folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    save_mesh(rig.neutral, folder / "Face_Neutral.obj")
    for name, delta in zip(rig.names, rig.deltas, strict=True):
        save_mesh(rig.neutral.with_vertices(rig.neutral.vertices + delta), folder / f"{name}.obj")


def test_a_folder_of_obj_files_is_a_rig(tmp_path: Path) -> None:
    rig = sheet_rig()
    save_folder(rig, tmp_path / "rig")
    for hidden in ("._Face_Neutral.obj", "._jawOpen.obj"):  # as macOS leaves them beside files on foreign disks
        (tmp_path / "rig" / hidden).write_bytes(b"\0\5\x16\7Mac OS X")
    found = load_rig(tmp_path / "rig")
    assert found.names == tuple(sorted(rig.names))
    assert (found.deltas - rig.select(found.names).deltas).abs().max() < 1e-4
    assert torch.equal(found.neutral.polygons, rig.neutral.polygons)
    assert torch.equal(found.neutral.uv_faces, rig.neutral.uv_faces)
    assert found.neutral.texture is not None
    assert load_rig(tmp_path / "rig", shapes=["jawOpen"]).names == ("jawOpen",)
    assert load_rig(tmp_path / "rig", unit="cm").deltas[1].allclose(found.deltas[1] * 10, atol=1e-3)


def test_the_neutral_is_the_one_that_is_named(tmp_path: Path) -> None:
    rig = sheet_rig()
    save_folder(rig, tmp_path / "rig")
    other = load_rig(tmp_path / "rig", neutral="jawOpen")
    assert other.names == ("Face_Neutral", "eyeBlinkRight", "mouthSmileLeft")
    assert (other.deltas[0] + rig.deltas[0]).abs().max() < 1e-4
    with pytest.raises(FileFormatError, match=r"4 OBJ files, of them neutral: rest; expected one neutral"):
        load_rig(tmp_path / "rig", neutral="rest")
    shutil.copy(tmp_path / "rig" / "jawOpen.obj", tmp_path / "rig" / "neutral_2.obj")
    with pytest.raises(FileFormatError, match=r"of them neutral: Face_Neutral, neutral_2; expected one neutral"):
        load_rig(tmp_path / "rig")
    with pytest.raises(NameMismatchError, match="no shape 'smile'"):
        load_rig(tmp_path / "rig", neutral="Face_Neutral", shapes=["smile"])


def test_shapes_that_do_not_fit_the_neutral_are_named(tmp_path: Path) -> None:
    rig, mesh = sheet_rig(), quad_sheet()
    save_folder(rig, tmp_path / "rig")
    path = tmp_path / "rig" / "jawOpen.obj"
    save_mesh(Mesh(torch.cat([mesh.vertices, mesh.vertices[:1]]), mesh.faces), path)
    with pytest.raises(TopologyError, match=r"jawOpen.obj: found 31 vertices, expected the 30 of the neutral mesh"):
        load_rig(tmp_path / "rig")
    save_mesh(Mesh(mesh.vertices, mesh.faces.flip(0)), path)
    with pytest.raises(TopologyError, match=r"jawOpen.obj: found other faces than in the neutral mesh"):
        load_rig(tmp_path / "rig")
    # The same triangles written without texture coordinates are the same topology.
    save_mesh(Mesh(mesh.vertices + 1, mesh.faces), path)
    assert torch.allclose(load_rig(tmp_path / "rig").deltas[1], torch.ones(30, 3), atol=1e-4)
    path.write_text(re.sub(r"^v \S+", "v nan", path.read_text(), count=1, flags=re.MULTILINE))
    with pytest.raises(FileFormatError, match=r"jawOpen.obj: found NaN or infinity in 1 of 30 vertices, first at 0"):
        load_rig(tmp_path / "rig")


@pytest.mark.parametrize(
    ("fault", "error", "said"),
    [
        ("unit", ValueRangeError, r"jawOpen\.obj: found an extent of .* beside the neutral of .* in centimetres"),
        ("aside", AlignmentError, r"jawOpen\.obj: found that \d+% of its vertices lie \(0, 250, 0\) mm beside"),
        ("order", AlignmentError, r"jawOpen\.obj: found vertices in another order .* a shift of 1 taken back"),
    ],
)
def test_a_shape_that_is_no_shape_of_the_neutral_is_refused(
    tmp_path: Path, fault: str, error: type[Exception], said: str
) -> None:
    actor = performer(texture=False).select(["jawOpen", "mouthSmileLeft"])
    save_folder(actor, tmp_path)
    assert load_rig(tmp_path).names == actor.names
    shape = actor.vertices + actor.deltas[0]
    spoilt = {
        "unit": 0.1 * shape,
        "aside": shape + torch.tensor([0.0, 250.0, 0.0]),
        "order": torch.cat([shape[:3000], shape[3000:4500].roll(1, 0), shape[4500:]]),
    }[fault]
    save_mesh(actor.neutral.with_vertices(spoilt), tmp_path / "jawOpen.obj")
    with pytest.raises(error, match=said):
        load_rig(tmp_path)


def test_an_empty_folder_and_a_lone_neutral_are_no_rig(tmp_path: Path) -> None:
    (tmp_path / "rig").mkdir()
    with pytest.raises(FileFormatError, match=r"rig: found 0 OBJ files, of them neutral: none; expected one neutral"):
        load_rig(tmp_path / "rig")
    save_mesh(quad_sheet(), tmp_path / "rig" / "neutral.obj")
    with pytest.raises(FileFormatError, match=r"rig: found only the neutral neutral.obj, expected a file for each"):
        load_rig(tmp_path / "rig")


def load_with_this_shape(path: Path) -> BlendshapeRig:
    """A folder of a good neutral and, as its only shape, the file at ``path``."""
    folder = path.parent / "rig"
    if not folder.exists():
        folder.mkdir()
        save_mesh(quad_sheet(), folder / "neutral.obj")
    shutil.copy(path, folder / "shape.obj")
    return load_rig(folder)


def test_a_mutated_shape_is_read_or_refused(tmp_path: Path) -> None:
    save_mesh(quad_sheet(), tmp_path / "good.obj")
    report = check_reader(load_with_this_shape, [tmp_path / "good.obj"], ".obj")
    assert report.read > 0
    assert report.refused > report.cases / 4


def test_a_written_folder_is_the_same_rig(tmp_path: Path) -> None:
    rig = sheet_rig()
    save_rig(rig, tmp_path / "actor")
    found = load_rig(tmp_path / "actor")
    assert found.names == rig.names  # which are not sorted
    assert (found.deltas - rig.deltas).abs().max() < 1e-5
    assert torch.equal(found.neutral.vertices, rig.neutral.vertices)
    assert torch.equal(found.neutral.polygons, rig.neutral.polygons)
    assert torch.equal(found.neutral.uvs[found.neutral.uv_faces], rig.neutral.uvs[rig.neutral.uv_faces])
    assert torch.equal(found.neutral.landmarks, rig.neutral.landmarks)
    regions = rig.neutral.annotations.regions
    assert all(torch.equal(found.neutral.annotations.regions[name], mask) for name, mask in regions.items())
    assert torch.equal(found.neutral.annotations.mirror, rig.neutral.annotations.mirror)
    assert (found.neutral.texture - rig.neutral.texture).abs().max() <= 0.5 / 255 + 1e-6
    assert [path.name for path in tmp_path.iterdir()] == ["actor"]


def test_a_rig_is_written_into_the_folder_one_is_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    save_rig(sheet_rig(), ".")
    assert load_rig(".").names == sheet_rig().names


def test_wrinkle_maps_lie_beside_their_shapes(tmp_path: Path) -> None:
    rig = sheet_rig()
    maps = torch.nn.functional.normalize(torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(0)), dim=1)
    save_rig(rig, tmp_path / "actor", DetailMaps(("jawOpen",), maps[:1], maps[1]))
    for name, normals in (("jawOpen", maps[0]), ("neutral", maps[1])):
        assert (decode_normals(load_image(tmp_path / "actor" / f"{name}_normals.png")) - normals).abs().max() < 1e-3
    with pytest.raises(NameMismatchError, match="no shape 'frown'"):
        save_rig(rig, tmp_path / "other", DetailMaps(("frown",), maps[:1]))
    assert not (tmp_path / "other").exists()


def test_shapes_that_a_rigger_adds_or_takes_away_are_heeded(tmp_path: Path) -> None:
    rig = sheet_rig()
    save_rig(rig, tmp_path / "actor")
    (tmp_path / "actor" / "mouthSmileLeft.obj").unlink()
    shutil.copy(tmp_path / "actor" / "jawOpen.obj", tmp_path / "actor" / "aNewOne.obj")
    found = load_rig(tmp_path / "actor")
    assert found.names == ("jawOpen", "eyeBlinkRight", "aNewOne")
    save_rig(found, tmp_path / "actor")
    with pytest.raises(
        FileFormatError, match=r"actor: found OBJ files of another rig \(aNewOne.obj\), expected an empty"
    ):
        save_rig(rig, tmp_path / "actor")


def test_names_that_make_no_files_and_other_endings_are_refused(tmp_path: Path) -> None:
    rig = sheet_rig()
    for name in ("../jawOpen", "a/b", ".hidden", "Neutral", "", "nul\0"):
        with pytest.raises(NameMismatchError, match="expected file names; write a"):
            save_rig(BlendshapeRig(rig.neutral, rig.deltas[:1], (name,)), tmp_path / "actor")
    with pytest.raises(
        FileFormatError, match=r"actor.fbx: found the ending '.fbx', expected .glb, .usd, .* or none for a folder"
    ):
        save_rig(rig, tmp_path / "actor.fbx")
    (tmp_path / "file").write_text("x")
    with pytest.raises(FileFormatError, match="cannot be written"):
        save_rig(rig, tmp_path / "file" / "actor")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_full_disk_leaves_the_rig_that_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = sheet_rig()
    save_rig(rig, tmp_path / "actor")
    before = {path.name: path.read_bytes() for path in (tmp_path / "actor").iterdir()}
    other = BlendshapeRig(rig.neutral.with_vertices(2 * rig.neutral.vertices), rig.deltas, rig.names)
    whole, written = os.write, 0

    def full(handle: int, data: bytes) -> int:
        nonlocal written
        written += len(data)
        if written > 3000:
            raise OSError(errno.ENOSPC, "No space left on device")
        return whole(handle, data)

    for target in ("actor", "new/actor"):
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", full)
            with pytest.raises(FileFormatError, match="cannot be written: the disk is full"):
                save_rig(other, tmp_path / target)
    assert {path.name: path.read_bytes() for path in (tmp_path / "actor").iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["actor"]
    save_rig(other, tmp_path / "actor")
    assert load_rig(tmp_path / "actor").vertices.allclose(other.vertices, atol=1e-3)


def test_broken_notes_are_named(tmp_path: Path) -> None:
    save_rig(sheet_rig(), tmp_path / "actor")
    for text, told in (
        ("{", "not JSON"),
        ("[]", "expected a rig's notes"),
        ('{"shapes": 3}', "shapes: found 3, expected an array"),
        ('{"mesh": {"version": 1, "vertices": 30, "landmarks": [30]}}', "vertices 30 to 30, expected 0 to 29"),
    ):
        (tmp_path / "actor" / "rig.json").write_text(text)
        with pytest.raises(FileFormatError, match=f"rig.json.*{told}"):
            load_rig(tmp_path / "actor")


@pytest.mark.real
def test_a_real_rig_keeps_its_vertices_and_quads_in_a_folder(ict_folder: Path, tmp_path: Path) -> None:
    rig = load_rig(ict_folder, shapes=["jawOpen", "eyeBlink_L"])
    save_rig(rig, tmp_path / "ict")
    found = load_rig(tmp_path / "ict")
    assert found.names == rig.names
    assert torch.equal(found.neutral.polygons, rig.neutral.polygons)
    assert torch.equal(found.neutral.landmarks, rig.neutral.landmarks)
    assert (found.deltas - rig.deltas).abs().max() < 1e-4
