import json

import pytest
import torch
from mutation import check_reader

from torchface.errors import FileFormatError, NameMismatchError, ShapeError, TopologyError
from torchface.io.landmarks.picks import (
    Correspondences,
    LandmarkVertices,
    load_correspondences,
    load_landmarks,
    save_correspondences,
    save_landmarks,
)
from torchface.mesh import Mesh


def triangle() -> Mesh:
    return Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))


def test_landmarks_and_pairs_come_back_exactly(tmp_path) -> None:
    mesh = triangle()
    landmarks = LandmarkVertices(torch.tensor([2, 0]), ("nose", "chin"), mesh.fingerprint())
    save_landmarks(landmarks, tmp_path / "l.json")
    found = load_landmarks(tmp_path / "l.json")
    assert (found.vertices.tolist(), found.labels, found.fingerprint) == ([2, 0], ("nose", "chin"), mesh.fingerprint())
    points = torch.randn(2, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    save_correspondences(Correspondences(torch.tensor([1, 2]), points, ("a", "b")), tmp_path / "c.json")
    pairs = load_correspondences(tmp_path / "c.json")
    assert torch.equal(pairs.points, points)
    assert pairs.vertices.tolist() == [1, 2]


def test_picks_of_another_mesh_are_refused() -> None:
    other = Mesh(torch.eye(3), torch.tensor([[0, 2, 1]]))
    with pytest.raises(TopologyError, match="made for a mesh with other triangles"):
        LandmarkVertices(torch.tensor([0]), ("nose",), triangle().fingerprint()).check(other)
    with pytest.raises(TopologyError, match="expected 0 to 2"):
        Correspondences(torch.tensor([3]), torch.zeros(1, 3), ("nose",)).check(triangle())


def test_parts_must_fit() -> None:
    with pytest.raises(NameMismatchError, match="1 distinct"):
        LandmarkVertices(torch.tensor([0, 1]), ("nose", "nose"))
    with pytest.raises(ShapeError, match=r"expected \(2,3\)"):
        Correspondences(torch.tensor([0, 1]), torch.zeros(3, 3), ("a", "b"))


GOOD = {
    "format": "torchface.correspondences/1",
    "fingerprint": None,
    "labels": ["a"],
    "vertices": [1],
    "points": [[1.0, 2, 3.5]],
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "torchface.landmarks/1"}, "correspondences/1"),
        ({"vertices": [-1]}, "vertex ids"),
        ({"vertices": [True]}, "vertex ids"),
        ({"vertices": [2**40]}, "vertex ids"),
        ({"vertices": "1"}, "vertex ids"),
        ({"labels": [3]}, "texts"),
        ({"labels": ["a", "b"]}, "distinct labels"),
        ({"points": [[1, 2]]}, "three numbers"),
        ({"points": [[1, 2, 1e300]]}, "three numbers"),
        ({"points": [[1, 2, None]]}, "three numbers"),
        ({"points": []}, "three numbers"),
        ({"fingerprint": 7}, "fingerprint"),
    ],
)
def test_a_broken_field_is_named(change: dict, message: str, tmp_path) -> None:
    path = tmp_path / "c.json"
    path.write_text(json.dumps(GOOD))
    assert load_correspondences(path).labels == ("a",)
    path.write_text(json.dumps(GOOD | change))
    with pytest.raises(FileFormatError, match=message) as caught:
        load_correspondences(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"[", b"[" * 100_000, b"\xff\xfe", b"[]", b'{"format": NaN}'])
def test_what_is_no_picks_file_is_refused(content: bytes, tmp_path) -> None:
    path = tmp_path / "l.json"
    path.write_bytes(content)
    with pytest.raises(FileFormatError):
        load_landmarks(path)


def test_mutated_landmarks_are_read_or_refused(tmp_path) -> None:
    save_landmarks(LandmarkVertices(torch.tensor([2, 0]), ("nose", "chin"), "3-abc"), tmp_path / "l.json")
    check_reader(load_landmarks, [tmp_path / "l.json"], ".json")


def test_mutated_correspondences_are_read_or_refused(tmp_path) -> None:
    save_correspondences(Correspondences(torch.tensor([1, 2]), torch.eye(3)[:2], ("a", "b")), tmp_path / "c.json")
    check_reader(load_correspondences, [tmp_path / "c.json"], ".json")
