import numpy as np
import pytest

from torchface.geometry.meshes.uv_seams import merge_equal_rows, split_at_seams


@pytest.mark.parametrize("columns", [1, 3, 30])
def test_equal_rows_are_those_of_numpy_numbered_by_first_appearance(columns: int) -> None:
    generator = np.random.default_rng(columns)
    rows = generator.integers(-2, 3, (40, columns)).astype(np.float32)[generator.integers(0, 40, 500)]
    rows[::7] *= -1  # -0 beside 0
    value_of, first = merge_equal_rows(rows)
    assert len(first) == len(np.unique(rows + 0.0, axis=0))
    assert np.array_equal(rows[first[value_of]], rows)
    assert np.array_equal(np.unique(value_of, return_index=True)[1], first)
    assert (np.diff(first) > 0).all()


def test_a_split_has_one_coordinate_a_row_and_keeps_loose_vertices() -> None:
    faces, uv_faces = np.array([[0, 1, 2], [0, 2, 3]]), np.array([[0, 1, 2], [4, 2, 3]])
    split = split_at_seams(5, faces, uv_faces)
    assert np.array_equal(split.vertex_of[split.triangles], faces)
    assert np.array_equal(split.uv_of[split.triangles], uv_faces)
    assert sorted(split.vertex_of.tolist()) == [0, 0, 1, 2, 3, 4]  # vertex 0 is on the seam, 4 in no face
    sided = split_at_seams(5, faces, uv_faces, np.array([[False] * 3, [True] * 3]))
    assert sorted(sided.vertex_of.tolist()) == [0, 0, 1, 2, 2, 3, 4]
