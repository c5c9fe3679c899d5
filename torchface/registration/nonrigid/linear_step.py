"""The quadratic at the heart of non-rigid ICP: the best affine maps for given correspondences."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from torchface.optim.sparse import SparseCholesky
from torchface.registration.nonrigid.subspace import Subspace

Array = NDArray[np.float64]

_RIDGE = 1e-11
_TOLERANCE = 1e-2
_MAX_ITERATIONS = 200


@dataclass(frozen=True, eq=False)
class Data:
    """What pulls the vertices."""

    targets: Array  # u, (n,3)
    normals: Array  # unit, of the scan at u, (n,3)
    weights: Array  # w, (n,)
    landmarks: Array  # U_L, (L,3)


@dataclass(frozen=True, eq=False)
class Contacts:
    """Vertices that keep their place beside each other."""

    pairs: NDArray[np.int64]  # (K,2) int64
    offsets: Array  # o, from the first to the second, (K,3)
    weights: Array  # c, (K,)


class LinearStep:
    r"""Minimises cost function 7 over the affine maps of a subspace.

    .. math:: E(X) = \lVert \alpha (M \otimes G) X \rVert^2 + \lVert W (D X - U) \rVert^2
        + \sum_l \beta^2 b_l \lVert (D_L X - U_L)_l \rVert^2 + \sum_{(i,j)} c_{ij} \lVert p_j - p_i - o_{ij} \rVert^2

    The last sum, over vertices in contact, and the landmarks' own weights b are not in the paper; p are the
    positions ``D X``.

    A vertex's block of :math:`W` is :math:`\sqrt w\,(n n^\top + \sqrt\rho\,(I - n n^\top))`: across the surface a
    correspondence counts in full, along it, where the nearest point says nothing, only a share :math:`\rho`. With
    :math:`\rho = 1` it is the paper's. The blocks couple the three coordinates, so the system is solved by conjugate
    gradients, preconditioned with one factorisation of the uncoupled system of mean weights, which is kept.

    Args:
        vertices: template vertices that have correspondences, (n,).
        landmarks: template vertices that have landmarks, (L,).
        stiffness: :math:`\alpha`.
        landmark_weight: :math:`\beta`.
        sliding: :math:`\rho`.
        contacts: what is to keep together; nothing if absent.
        landmark_weights: :math:`b`, (L,); 1 if absent.

    Source: Amberg, Romdhani, Vetter 2007, equation 12; thesis 3.2.3, equation 7.
    """

    def __init__(
        self,
        subspace: Subspace,
        vertices: NDArray[np.int64],
        landmarks: NDArray[np.int64],
        stiffness: float,
        landmark_weight: float,
        sliding: float,
        contacts: Contacts | None = None,
        landmark_weights: Array | None = None,
    ) -> None:
        self._space, self._vertices, self._landmarks = subspace, vertices, landmarks
        self._alpha2, self._rho = stiffness**2, sliding
        own = np.ones(len(landmarks)) if landmark_weights is None else landmark_weights
        self._beta2 = (landmark_weight**2 * own)[:, None]
        self._rows = subspace.positions[vertices]
        self._rows_t = self._rows.T.tocsr()
        self._landmark_rows_t = subspace.positions[landmarks].T.tocsr()
        pull = self._landmark_rows_t @ sparse.diags_array(self._beta2[:, 0]) @ self._landmark_rows_t.T
        fixed = self._alpha2 * subspace.stiffness_matrix + pull
        self._contacts = contacts
        if contacts is not None:
            apart = subspace.positions[contacts.pairs[:, 1]] - subspace.positions[contacts.pairs[:, 0]]
            self._contact_rows_t = (apart.T @ sparse.diags_array(contacts.weights)).tocsr()
            fixed = fixed + self._contact_rows_t @ apart
        # Nothing holds the whole where every correspondence is refused; the ridge holds it where it is.
        ridge = _RIDGE * fixed.diagonal().mean() + 1e-12
        self._fixed = (fixed + ridge * sparse.eye_array(fixed.shape[0])).tocsr()
        self._solver: SparseCholesky | None = None

    def energy(self, maps: Array, data: Data) -> float:
        """E at the maps X (4V,3)."""
        place = maps[3::4]
        left = place[self._vertices] - data.targets
        across = (left * data.normals).sum(1)
        pull = (1 - self._rho) * across**2 + self._rho * (left**2).sum(1)
        landmarks = place[self._landmarks] - data.landmarks
        stiff = self._space.stiffness @ maps
        energy = self._alpha2 * (stiff**2).sum() + (data.weights * pull).sum() + (self._beta2 * landmarks**2).sum()
        if self._contacts is not None:
            energy += (self._contacts.weights * (self._parted(self._contacts, place) ** 2).sum(1)).sum()
        return float(energy)

    @staticmethod
    def _parted(contacts: Contacts, place: Array) -> Array:
        return place[contacts.pairs[:, 1]] - place[contacts.pairs[:, 0]] - contacts.offsets

    def minimise(self, maps: Array, data: Data, tolerance: float = _TOLERANCE) -> Array:
        """The best maps (4V,3) among those that differ from ``maps`` by what the subspace spans."""
        weights, normals = data.weights[:, None], data.normals
        if self._solver is None:
            mean = sparse.diags_array((1 + 2 * self._rho) / 3 * data.weights)
            self._solver = SparseCholesky(self._fixed + self._rows_t @ (mean @ self._rows))

        def blocks(moves: Array) -> Array:
            across = (moves * normals).sum(1, keepdims=True) * normals
            return weights * ((1 - self._rho) * across + self._rho * moves)

        def apply(y: Array) -> Array:
            return self._fixed @ y + self._rows_t @ blocks(self._rows @ y)

        place = maps[3::4]
        downhill = self._rows_t @ blocks(data.targets - place[self._vertices])
        downhill += self._landmark_rows_t @ (self._beta2 * (data.landmarks - place[self._landmarks]))
        if self._contacts is not None:
            downhill -= self._contact_rows_t @ self._parted(self._contacts, place)
        downhill -= self._alpha2 * self._space.stiffness_gradient(maps)
        return maps + self._space.basis @ conjugate_gradients(apply, self._solver.solve, downhill, tolerance)


def conjugate_gradients(
    apply: Callable[[Array], Array], precondition: Callable[[Array], Array], target: Array, tolerance: float
) -> Array:
    """The solution of a symmetric positive definite system, preconditioned, from zero.

    Ends when the residual, in the preconditioner's norm, is ``tolerance`` of the target's.
    """
    solution = np.zeros_like(target)
    residual = target
    better = precondition(residual)
    direction = better
    size = first = float((residual * better).sum())
    for _ in range(_MAX_ITERATIONS):
        if size <= tolerance**2 * first or size <= 0:
            break
        image = apply(direction)
        step = size / float((direction * image).sum())
        solution = solution + step * direction
        residual = residual - step * image
        better = precondition(residual)
        previous, size = size, float((residual * better).sum())
        direction = better + (size / previous) * direction
    return solution
