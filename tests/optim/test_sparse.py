"""Sparse Cholesky against scipy, and the matrices it has to refuse."""

import numpy as np
import pytest
import torch
from scipy import sparse
from scipy.sparse.linalg import spsolve

from torchface.errors import ShapeError, ValueRangeError
from torchface.optim.sparse import SparseCholesky


def definite(size: int, seed: int = 0) -> sparse.csr_array:
    factor = sparse.random_array((size, size), density=0.05, rng=np.random.default_rng(seed))
    return sparse.csr_array(factor @ factor.T + sparse.eye_array(size))


def test_many_right_hand_sides_agree_with_scipy() -> None:
    matrix = definite(80)
    rhs = np.random.default_rng(1).standard_normal((80, 7))
    expected = np.stack([spsolve(matrix.tocsc(), column) for column in rhs.T], axis=1)
    np.testing.assert_allclose(SparseCholesky(matrix).solve(rhs), expected, atol=1e-11)


def test_a_vector_comes_back_as_a_vector_and_a_tensor_as_a_tensor_of_its_dtype() -> None:
    matrix = definite(30)
    rhs = torch.arange(30.0)
    solution = SparseCholesky(matrix).solve(rhs)
    assert solution.shape == (30,)
    assert solution.dtype == torch.float32
    np.testing.assert_allclose(matrix @ solution.numpy(), rhs.numpy(), atol=1e-4)


def test_only_the_lower_triangle_is_read() -> None:
    matrix = definite(30)
    rhs = np.ones(30)
    np.testing.assert_array_equal(
        SparseCholesky(sparse.tril(matrix)).solve(rhs), SparseCholesky(matrix.tocoo()).solve(rhs)
    )


def test_an_empty_system_has_an_empty_solution() -> None:
    assert SparseCholesky(sparse.csr_array((0, 0))).solve(np.zeros((0, 3))).shape == (0, 3)


@pytest.mark.parametrize(
    "matrix", [np.array([[1.0, 2.0], [2.0, 1.0]]), np.diag([1.0, 0.0]), np.diag([1.0, np.nan]), -np.eye(3)]
)
def test_a_matrix_that_is_not_definite_is_refused(matrix: np.ndarray) -> None:
    with pytest.raises(ValueRangeError, match="SparseCholesky"):
        SparseCholesky(sparse.csr_array(matrix))


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ShapeError, match=r"\(2, 3\)"):
        SparseCholesky(sparse.csr_array((2, 3)))
    with pytest.raises(ShapeError, match=r"expected \(5,\*\)"):
        SparseCholesky(definite(5)).solve(np.zeros(4))
