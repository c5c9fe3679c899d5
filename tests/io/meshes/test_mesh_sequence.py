"""Mesh sequences: what is written is read, a killed writer continues, damaged files are named."""

import os
from pathlib import Path

import pytest
import torch
from mutation import check_reader
from safetensors.torch import load_file, save_file

from torchface.errors import FileFormatError, ShapeError, TopologyError, ValueRangeError
from torchface.io.meshes.mesh_sequence import MeshSequence, MeshSequenceWriter

FACES = torch.tensor([[0, 1, 2], [2, 3, 0]])
MESHES = torch.randn(7, 4, 3, generator=torch.Generator().manual_seed(0))


def written(path: Path) -> Path:
    with MeshSequenceWriter(path, 7, 4, FACES) as writer:
        writer.append(MESHES[0])
        writer.append(MESHES[1:])
    return path


def open_all(path: Path) -> None:
    sequence = MeshSequence(path)
    sequence.read(0, len(sequence))


def test_what_is_written_is_read_a_few_at_a_time(tmp_path: Path) -> None:
    sequence = MeshSequence(written(tmp_path / "heads.safetensors"))
    assert sequence.shape == (7, 4, 3)
    assert torch.equal(sequence.faces, FACES)
    assert torch.equal(sequence.read(2, 5), MESHES[2:5])
    assert torch.equal(load_file(sequence.path)["vertices"], MESHES)
    assert [p.name for p in tmp_path.iterdir()] == ["heads.safetensors"]


def test_a_killed_writer_continues_where_it_was(tmp_path: Path) -> None:
    path = tmp_path / "heads.safetensors"
    first = MeshSequenceWriter(path, 7, 4, FACES, key="a")
    first.append(MESHES[:3])
    assert not path.exists()
    with (tmp_path / "heads.safetensors.part").open("ab") as part:
        part.write(b"half a mesh")
    with MeshSequenceWriter(path, 7, 4, FACES, key="a") as second:
        assert second.done == 3
        second.append(MESHES[3:])
    assert MeshSequence(path).key == "a"
    assert torch.equal(MeshSequence(path).read(0, 7), MESHES)
    MeshSequenceWriter(path, 7, 4, FACES, key="a").append(MESHES[:3])
    assert MeshSequenceWriter(path, 7, 4, FACES, key="b").done == 0  # made of something else


def test_meshes_that_are_not_as_they_were_written_are_told(tmp_path: Path) -> None:
    path = tmp_path / "heads.safetensors"
    part = tmp_path / "heads.safetensors.part"
    MeshSequenceWriter(path, 7, 4, FACES, key="a").append(MESHES[:3])
    data = part.read_bytes()
    part.write_bytes(data[:-16] + bytes(16))
    with pytest.warns(UserWarning, match=r"heads\.safetensors\.part: found other meshes"):
        MeshSequenceWriter(path, 7, 4, FACES, key="a")
    assert MeshSequence(written(path)).is_whole()
    path.write_bytes(path.read_bytes()[:-16] + bytes(16))
    assert not MeshSequence(path).is_whole()
    save_file({"vertices": MESHES, "faces": FACES}, path)
    assert MeshSequence(path).is_whole()  # another program's


def test_what_only_lacks_its_name_is_not_written_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, rename = tmp_path / "heads.safetensors", os.replace

    def killed(source: Path, target: Path) -> None:
        if target == path:
            raise KeyboardInterrupt
        rename(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            written(path)
    with MeshSequenceWriter(path, 7, 4, FACES) as writer:
        assert writer.done == 7
    assert MeshSequence(path).is_whole()
    assert torch.equal(MeshSequence(path).read(0, 7), MESHES)


def test_no_more_is_noted_than_is_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, calls = tmp_path / "heads.safetensors", list[str]()

    def sync(handle: int) -> None:
        name = Path(os.readlink(f"/proc/self/fd/{handle}")).name
        calls.append("meshes" if name == "heads.safetensors.part" else "note" if ".part.json." in name else "")

    monkeypatch.setattr(os, "fsync", sync)
    with MeshSequenceWriter(path, 7, 4, FACES) as writer:
        for mesh in MESHES:
            writer.append(mesh)
        # A disk is waited for once a second, not after each mesh.
        assert [call for call in calls if call] == ["meshes", "note"]
    assert [call for call in calls if call] == [*["meshes", "note"] * 2, "meshes"]  # the last: the hash of all


def test_what_a_planted_link_names_is_not_written_to(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("kept")
    (tmp_path / "heads.safetensors.part").symlink_to(precious)
    assert len(MeshSequence(written(tmp_path / "heads.safetensors"))) == 7
    assert precious.read_text() == "kept"


def test_other_meshes_are_refused(tmp_path: Path) -> None:
    with MeshSequenceWriter(tmp_path / "heads.safetensors", 2, 4, FACES) as writer:
        with pytest.raises(TopologyError, match=r"found \(5, 3\), expected \(4, 3\)"):
            writer.append(torch.zeros(5, 3))
        with pytest.raises(ShapeError, match="more than the 2"):
            writer.append(MESHES)


@pytest.mark.parametrize("fps", [float("nan"), 0.0, -3.0])
def test_what_is_no_rate_is_refused_before_anything_is_written(fps: float, tmp_path: Path) -> None:
    with pytest.raises(ValueRangeError, match=r"mesh sequence: found .* frames a second"):
        MeshSequenceWriter(tmp_path / "heads.safetensors", 2, 4, FACES, fps=fps)
    assert not list(tmp_path.iterdir())


def test_other_files_are_named(tmp_path: Path) -> None:
    path = written(tmp_path / "heads.safetensors")
    whole = path.read_bytes()
    path.write_bytes(whole[:-4])
    with pytest.raises(FileFormatError, match=r"heads\.safetensors"):
        MeshSequence(path)
    path.write_bytes(whole)
    sequence = MeshSequence(path)
    path.write_bytes(whole[:-4])
    with pytest.raises(FileFormatError, match=r"heads\.safetensors"):
        sequence.read(0, 1)
    save_file({"vertices": MESHES, "faces": FACES + 3}, path)
    with pytest.raises(FileFormatError, match="beyond the 4"):
        MeshSequence(path)
    save_file({"vertices": MESHES.double(), "faces": FACES}, path)
    with pytest.raises(FileFormatError, match="F64"):
        MeshSequence(path)
    with pytest.raises(FileFormatError, match="no such file"):
        MeshSequence(tmp_path / "none")


def test_a_mutated_sequence_is_read_or_refused(tmp_path: Path) -> None:
    check_reader(open_all, [written(tmp_path / "heads.safetensors")], ".safetensors")
