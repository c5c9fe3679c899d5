"""Keys differ wherever anything that a result is made of does, and nowhere else."""

import os
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

import pytest
import torch
from torch import nn

from torchface.files import content_keys
from torchface.files.content_keys import content_key, file_digest
from torchface.mesh import Annotations, Mesh


class Kind(Enum):
    ONE = 1
    TWO = 2


@dataclass(frozen=True)
class Settings:
    kind: Kind = Kind.ONE
    weight: float = 1.0
    name: str | None = None


def test_whatever_differs_makes_another_key() -> None:
    ramp = torch.arange(6.0)
    different = [
        None, 1, 1.0, True, "1", "", [], {}, ["a", "b"], ["ab"], [["a"], "b"], ["b", "a"], {"a": "b"},
        Kind.ONE, Kind.TWO, Settings(), Settings(Kind.TWO), Settings(weight=1 + 1e-15), Settings(name="None"),
        ramp, ramp.flip(0), ramp.view(2, 3), ramp.view(3, 2), ramp.double(), ramp.int(), ramp[:0], ramp > 2,
        nn.Linear(1, 1), nn.ReLU(),
    ]  # fmt: skip
    keys = [content_key("test/1", value=value) for value in different]
    assert len(set(keys)) == len(keys)
    assert content_key("test/1", value=ramp.view(2, 3).T.contiguous()) == content_key("test/1", value=ramp.view(2, 3).T)
    assert content_key("test/1", a=1) not in {content_key("test/2", a=1), content_key("test/1", b=1)}
    with pytest.raises(TypeError, match="found a set"):
        content_key("test/1", value={1})


def test_another_version_makes_another_key(monkeypatch: pytest.MonkeyPatch) -> None:
    before = content_key("test/1", a=1)
    monkeypatch.setattr(content_keys, "__version__", "0.0.0")
    assert content_key("test/1", a=1) != before


def test_every_part_of_a_template_counts() -> None:
    grid = torch.arange(12.0).view(4, 3)
    notes = Annotations(landmarks=torch.tensor([0, 1]), regions={"lips": torch.tensor([True, False, False, True])})
    mesh = Mesh(grid, torch.tensor([[0, 1, 2], [0, 2, 3]]), annotations=notes)
    meshes = [
        mesh,
        mesh.with_vertices(grid + 1e-6),
        replace(mesh, faces=mesh.faces.flip(0)),
        replace(mesh, colors=torch.zeros(4, 3)),
        replace(mesh, annotations=replace(notes, landmarks=torch.tensor([1, 0]))),
        replace(mesh, annotations=replace(notes, contacts=torch.tensor([[0, 3]]))),
        replace(mesh, annotations=replace(notes, mirror=torch.tensor([1, 0, 3, 2]))),
        replace(mesh, annotations=replace(notes, regions={"lids": notes.regions["lips"]})),
        replace(mesh, annotations=replace(notes, regions={"lips": ~notes.regions["lips"]})),
    ]
    keys = {content_key("test/1", template=mesh) for mesh in meshes}
    assert len(keys) == len(meshes)


def test_a_path_stands_for_its_content(tmp_path: Path) -> None:
    folder, path = tmp_path / "model", tmp_path / "model" / "state"

    def key(place: Path) -> str:
        return content_key("test/1", place=place)

    nothing = key(path)
    folder.mkdir()
    path.write_bytes(b"abc")
    inside, whole = key(path), key(folder)
    os.utime(path, (1, 1))
    (folder / ".lock").touch()
    assert (key(path), key(folder)) == (inside, whole)
    state = path.stat()
    path.write_bytes(b"abd")
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))  # neither size nor date tell
    assert len({nothing, inside, whole, key(path), key(folder)}) == 5
    path.write_bytes(b"abc")
    path.rename(folder / "other")
    assert key(folder) != whole
    assert file_digest(folder / "other") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
