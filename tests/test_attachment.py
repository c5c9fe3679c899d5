"""Attachment: linear in the vertices, tied to its topology, safe to load."""

import json
import math
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchface import Attachment, Mesh, TorchfaceError
from torchface.errors import FileFormatError, NameMismatchError, TopologyError
from torchface.synthetic import performer


def tetrahedron() -> Mesh:
    vertices = torch.tensor([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10], [5, 5, 5]])
    return Mesh(vertices, torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))


def test_markers_on_vertices_are_where_the_vertices_are() -> None:
    mesh = tetrahedron()
    attachment = Attachment.from_vertices(mesh, [3, 0, 2], ["chin", "nose", "brow"])
    torch.testing.assert_close(attachment.on(mesh.faces, mesh.vertices), mesh.vertices[[3, 0, 2]])
    moving = torch.stack([mesh.vertices, mesh.vertices * 2 + 1])
    torch.testing.assert_close(attachment.on(mesh.faces, moving), moving[:, [3, 0, 2]])
    assert attachment.select(["brow"]).on(mesh.faces, mesh.vertices).tolist() == [[0, 10, 0]]


def test_saved_and_loaded_is_the_same(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    barycentric = torch.rand(3, 3, generator=generator)
    attachment = Attachment(
        torch.tensor([2, 0, 1]), barycentric / barycentric.sum(1, keepdim=True), ("ä", "b c", "d"), torch.randn(3, 3)
    )
    attachment.save(tmp_path / "a.json")
    loaded = Attachment.load(tmp_path / "a.json")
    assert loaded.labels == attachment.labels
    assert torch.equal(loaded.triangles, attachment.triangles)
    assert torch.equal(loaded.barycentric, attachment.barycentric)
    assert torch.equal(loaded.residual, attachment.residual)
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_other_meshes_are_refused() -> None:
    mesh = tetrahedron()
    attachment = Attachment.from_vertices(mesh, [0, 1])
    with pytest.raises(
        TopologyError, match=r"other triangles than it, or the same in another order \(both have 5 vertices\).*attach"
    ):
        attachment.check(Mesh(mesh.vertices, mesh.faces.flip(0)), owner="it")
    with pytest.raises(TopologyError, match=r"made for a mesh of 5 vertices, expected r\.glb's, of 6;"):
        attachment.check(Mesh(torch.rand(6, 3), mesh.faces), owner="r.glb")
    with pytest.raises(TopologyError, match="found triangles 0 to 9, expected 0 to 3"):
        Attachment(torch.tensor([0, 9]), torch.eye(3)[:2]).check(mesh)
    with pytest.raises(TopologyError, match=r"vertices \[4\] belong to no triangle"):
        Attachment.from_vertices(mesh, [4])
    with pytest.raises(TopologyError, match="found vertex ids 0 to 7, expected 0 to 4"):
        Attachment.from_vertices(mesh, [0, 7])
    with pytest.raises(NameMismatchError, match="no marker 'x'"):
        attachment.select(["x"])


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ("", "found an empty file, expected content"),
        ("[1, 2]", 'found format None, expected "torchface.attachment/1"'),
        ('{"format": "torchface.attachment/1"}', "found triangles = None, expected a list of triangles"),
        ("[" * 100_000, "not JSON"),
    ],
)
def test_broken_files_are_named(tmp_path: Path, content: str, found: str) -> None:
    path = tmp_path / "broken.json"
    path.write_text(content)
    with pytest.raises(FileFormatError, match=found) as caught:
        Attachment.load(path)
    assert "broken.json" in str(caught.value)


@given(st.data())
def test_mutated_attachments_raise_only_our_errors(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    document = {
        "format": "torchface.attachment/1",
        "labels": ["a", "b"],
        "triangles": [0, 1],
        "barycentric": [[1.0, 0, 0], [0, 0.5, 0.5]],
    }
    field = data.draw(st.sampled_from(["labels", "triangles", "barycentric"]))
    json_value = st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(), lambda inner: st.lists(inner, max_size=4)
    )
    document[field] = data.draw(json_value)
    path = tmp_path_factory.mktemp("mutated") / "a.json"
    path.write_text(json.dumps(document))
    try:
        Attachment.load(path)
    except TorchfaceError:
        return


def test_the_head_it_was_made_for_is_recorded_and_old_files_load(tmp_path: Path) -> None:
    face = performer(texture=False).neutral
    sites = Attachment.from_vertices(face, face.landmarks)
    sites.save(tmp_path / "sites.json")
    loaded = Attachment.load(tmp_path / "sites.json")
    # A rigid motion is the same head, a smooth bend is not.
    turned = face.with_vertices(face.vertices[:, [1, 2, 0]] + torch.tensor([5.0, -900, 3]))
    assert loaded.rest_distance(turned) < 1e-3
    bent = face.vertices + 3 * torch.sin(face.vertices[:, [1, 2, 0]] / 30)
    assert loaded.rest_distance(face.with_vertices(bent)) > 0.5
    assert loaded.select((loaded.labels or ())[5:20]).rest_distance(face.with_vertices(bent)) > 0.5
    document = json.loads((tmp_path / "sites.json").read_text())
    del document["rest"]
    (tmp_path / "old.json").write_text(json.dumps(document))
    old = Attachment.load(tmp_path / "old.json")
    assert old.rest is None
    assert math.isnan(old.rest_distance(face))
