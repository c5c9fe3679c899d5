"""Vertices from deformation gradients: pins hold exactly, soft constraints as well as their weights demand."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.meshes.deformation import gradient_operator
from torchface.optim.sparse import SparseCholesky


@dataclass(frozen=True, eq=False)
class SoftConstraints:
    r"""Linear soft constraints :math:`\omega_k \lVert \sum_v C_{kv} \tilde x_v - y_k \rVert^2`."""

    matrix: sparse.csr_array  # C, (K,V) sparse
    values: Tensor  # y, (..., K,3), millimetres; leading dimensions as the gradients that are solved for
    # Omega, (K,), non-negative, in units of the squared gradient error of one triangle a square millimetre.
    weights: Tensor


def offset_constraints(pairs: Tensor, offsets: Tensor, weights: Tensor, vertex_count: int) -> SoftConstraints:
    """Constraints: vertex ``pairs[k,0]`` lies at the offset ``offsets[k]`` (..., K,3) from vertex ``pairs[k,1]``."""
    count = len(pairs)
    rows = np.arange(count)
    ends = pairs.cpu().numpy()
    matrix = sparse.coo_array(
        (
            np.concatenate([np.ones(count), -np.ones(count)]),
            (np.concatenate([rows, rows]), np.concatenate([ends[:, 0], ends[:, 1]])),
        ),
        shape=(count, vertex_count),
    )
    return SoftConstraints(matrix.tocsr(), offsets, weights)


class GradientReconstruction:
    r"""Finds the vertices whose triangles have given deformation gradients.

    .. math:: \min_{\tilde x} \; \sum_t a_t \lVert (Q_t - T_t(\tilde x)) P_t \rVert_F^2
        + \sum_k \omega_k \lVert (C \tilde x)_k - y_k \rVert^2 + \epsilon \lVert \tilde x - \bar x \rVert^2

    :math:`T_t` is the gradient of triangle t from rest to :math:`\tilde x`, :math:`P_t` the projection onto its plane.
    The last term is so small that it only places what nothing else does: a loose part, a vertex without a triangle.

    Args:
        triangle_weights: :math:`a_t`, (F,); 1 if absent, as in equation 23.

    Source: thesis 3.3.1, equations 23 to 25, solved in float64 on the CPU.
    """

    def __init__(self, rest: Tensor, faces: Tensor, triangle_weights: Tensor | None = None) -> None:
        self.vertex_count, self.triangle_count = len(rest), len(faces)
        operator = gradient_operator(rest, faces)
        if triangle_weights is None:
            weighted = operator
        else:
            weighted = sparse.diags_array(np.repeat(triangle_weights.double().cpu().numpy(), 3)) @ operator
        self._transposed = weighted.T.tocsr()
        self.stiffness = sparse.csr_array(self._transposed @ operator)
        diagonal = self.stiffness.diagonal()
        self._anchor = 1e-8 * float(diagonal[diagonal > 0].mean()) if (diagonal > 0).any() else 1.0

    def solve(
        self, gradients: Tensor, positions: Tensor, pinned: Tensor, constraints: Sequence[SoftConstraints] = ()
    ) -> Tensor:
        """Vertices (N,V,3), float64, of N gradients that share pins and constraint matrices: one factorisation for all.

        Args:
            positions: where pinned vertices are held, and :math:`\\bar x` for the others, (N,V,3), millimetres.
        """
        self._check(gradients, positions, pinned)
        prepared = self.prepare(pinned, constraints)
        return prepared.solve(gradients, positions, [constraint.values for constraint in constraints])

    def prepare(self, pinned: Tensor, constraints: Sequence[SoftConstraints] = ()) -> "PreparedReconstruction":
        """Factors the system once, for many solves with the same pins (V,) and the same matrices of constraints."""
        free = (~pinned).nonzero()[:, 0].cpu().numpy()
        matrix = self.stiffness[free]
        system = matrix[:, free] + self._anchor * sparse.eye_array(len(free), format="csr")
        pulls = []
        for constraint in constraints:
            rows = constraint.matrix[:, free]
            pulls.append(rows.T @ sparse.diags_array(constraint.weights.double().cpu().numpy()))
            system = system + pulls[-1] @ rows
        return PreparedReconstruction(
            free, matrix, self._transposed[free], [held.matrix for held in constraints], pulls, SparseCholesky(system)
        )

    def _check(self, gradients: Tensor, positions: Tensor, pinned: Tensor) -> None:
        count = len(positions)
        wanted = {
            "gradients": (gradients, (count, self.triangle_count, 3, 3)),
            "positions": (positions, (count, self.vertex_count, 3)),
            "pinned": (pinned, (self.vertex_count,)),
        }
        for name, (tensor, expected) in wanted.items():
            if tuple(tensor.shape) != expected:
                raise ShapeError(f"{name}: found {tuple(tensor.shape)}, expected {expected}")
        for name in ("gradients", "positions"):
            if not torch.isfinite(wanted[name][0].sum()):
                raise ValueRangeError(f"{name}: found NaN or infinite values; expected none")


class PreparedReconstruction:
    """A factored reconstruction: gradients and the constraints' values in, vertices out."""

    def __init__(
        self,
        free: np.ndarray,
        stiffness: sparse.csr_array,
        transposed: sparse.csr_array,
        matrices: Sequence[sparse.csr_array],
        pulls: Sequence[sparse.csr_array],
        factor: SparseCholesky,
    ) -> None:
        self._free, self._stiffness, self._transposed = free, stiffness, transposed
        self._matrices, self._pulls, self._factor = matrices, pulls, factor
        self.vertex_count = stiffness.shape[1]

    def solve(self, gradients: Tensor, positions: Tensor, values: Sequence[Tensor]) -> Tensor:
        """Vertices (N,V,3), float64, for N sets of gradients, constraints' values (N,K,3) or (K,3), and where pinned
        vertices are held and the others drawn by next to nothing."""
        result = positions.detach().double().cpu().numpy().copy()
        if len(self._free) == 0:
            return torch.from_numpy(result)
        count = len(result)
        # Unknown is the step from ``positions``: pins are then zeros, and what already fits is left as it is.
        anchored = result.transpose(1, 0, 2).reshape(self.vertex_count, -1)
        asked = gradients.detach().double().cpu().permute(1, 3, 0, 2).reshape(self._transposed.shape[1], -1).numpy()
        rhs = self._transposed @ asked - self._stiffness @ anchored
        for matrix, pull, given in zip(self._matrices, self._pulls, values, strict=True):
            wanted = torch.as_tensor(given).double().cpu().expand(count, -1, 3)
            rhs = rhs + pull @ (wanted.permute(1, 0, 2).flatten(1).numpy() - matrix @ anchored)
        step = self._factor.solve(rhs)
        result[:, self._free] += step.reshape(len(self._free), count, 3).transpose(1, 0, 2)
        return torch.from_numpy(result)
