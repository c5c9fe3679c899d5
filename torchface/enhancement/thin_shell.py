"""From a few moving points to every vertex of a dense head: a linear thin shell with the points as constraints."""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.attachment import Attachment
from torchface.enhancement.coarse_level import coarse_level
from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.geometry.meshes.operators import components
from torchface.geometry.meshes.shell_energies import bending_energy, stretching_energy
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.optim.sparse import SparseCholesky

LEAST_POINTS = 12
_OPERATOR_POINTS = 400
_LEAST_LEVEL = 30_000
_VERTICES_A_POINT = 12
_PULL, _PULL_ON_A_LEVEL = 1e5, 30.0
_RIGID_MM = 3.0
_RIGID_ITERATIONS = 8
_LEAST_ON_A_PART = 3


class ThinShell:
    r"""The smoothest displacements of a dense head that move some points of it where they were seen.

    .. math:: (-k_s \Delta + k_b \Delta^2)\, u = 0 \quad\text{with}\quad C u = c,

    the minimum of :math:`k_s \int |\nabla u|^2 + k_b \int (\Delta u)^2` over the displacements :math:`u` whose values
    :math:`C u` at the points are the seen ones. It is linear in :math:`c` and factored once. Up to 400 points become a
    dense operator, more are solved for in every frame. Meshes of more than ``level`` vertices are thinned out to that
    many, on which the shell is solved, and carried back linearly.

    Parts of the mesh with fewer than three points, such as eyes and teeth, move along with what they lie nearest to;
    points on such parts are left out.

    Args:
        neutral: the dense head at rest, (V,3), millimetres.
        points: where they sit on it: an attachment, or vertex ids (M,).
        stretching: :math:`k_s`; against ``bending`` it says over what length :math:`\sqrt{k_b / k_s}`, millimetres,
            motion fades into its surroundings' mean where no point holds it. Without any, motion goes on linearly.
        bending: :math:`k_b`, square millimetres.
        level: vertices at most on which the shell is solved; 30,000, or twelve a point, if absent.

    Source: facial_performance_enhancement 5.1; Bickel, Lang, Botsch, Otaduy, Gross 2008, section 3.
    """

    def __init__(
        self,
        neutral: Tensor,
        faces: Tensor,
        points: Attachment | Tensor,
        stretching: float = 1.0,
        bending: float = 100.0,
        level: int | None = None,
    ) -> None:
        if stretching < 0 or bending < 0 or stretching + bending <= 0:
            raise ValueRangeError(
                f"thin shell: found stretching {stretching} and bending {bending}, expected none below 0 and one above"
            )
        self.neutral = neutral.detach().cpu().float()
        self._faces = faces.detach().cpu()
        self._constraints = _constraints(self._faces, len(neutral), points)
        self.count = int(self._constraints.shape[0])
        if self.count < LEAST_POINTS:
            raise ShapeError(f"thin shell: found {self.count} points, expected at least {LEAST_POINTS}")
        dense = self.neutral.double().numpy()
        self.rest = torch.from_numpy(self._constraints @ dense).float()
        """Where the points are at rest, (M,3), millimetres."""
        coarse = coarse_level(
            self.neutral, self._faces, max(_LEAST_LEVEL, _VERTICES_A_POINT * self.count) if level is None else level
        )
        self._carried = sparse.csr_array(self._constraints @ coarse.prolongation)
        part = components(coarse.faces, len(coarse.vertex_ids)).numpy()
        held, self.used = _held(part, self._carried)
        if int(self.used.sum()) < LEAST_POINTS:
            raise ShapeError(
                f"thin shell: found {int(self.used.sum())} points on parts with three or more, expected at least "
                f"{LEAST_POINTS}"
            )
        self._ids = np.flatnonzero(held)
        level_points = self.neutral[coarse.vertex_ids]
        energy = stretching * stretching_energy(level_points, coarse.faces)
        energy = sparse.csr_array(energy + bending * bending_energy(level_points, coarse.faces))
        self._energy = sparse.csr_array(energy[self._ids][:, self._ids])
        self._carried = sparse.csr_array(self._carried[:, self._ids])
        # Points on the two lips may share a triangle of a coarse level: to meet both exactly would tear at its corners.
        meets_all = self.count <= _OPERATOR_POINTS or len(coarse.vertex_ids) == len(self.neutral)
        pull = _PULL if meets_all else _PULL_ON_A_LEVEL
        self._pull = pull * float(np.median(self._energy.diagonal()))
        to_dense = coarse.prolongation @ _followed(level_points.double().numpy(), part, held)
        self._to_dense = sparse.csr_array(to_dense, dtype=np.float32)
        self._operator: NDArray[np.float32] | None = None
        self._reduced: NDArray[np.float64] | None = None
        self._factored: tuple[bytes, SparseCholesky] | None = None
        if self.count <= _OPERATOR_POINTS:
            self._operator, self._reduced = self._dense_operator()
        else:
            self._factor(self.used)

    def spread(self, displacements: Tensor) -> Tensor:
        """Displacements (T,V,3) of every vertex from those of the points, (T,M,3), whose rigid motion is taken out, see
        :meth:`follow`.

        A NaN row was not seen; frames with fewer than 12 points are NaN.
        """
        seen = torch.isfinite(displacements).all(-1)
        self._check(displacements, seen)
        deformed = torch.full((len(displacements), *self.neutral.shape), torch.nan)
        given = torch.where(seen[..., None], displacements, 0.0).double().cpu().numpy()
        mask = (seen.cpu() & self.used).numpy()
        patterns, of_frame = np.unique(mask, axis=0, return_inverse=True)
        for number, pattern in enumerate(patterns):  # frames in which the same points were seen, at once
            if pattern.sum() < LEAST_POINTS:
                continue
            rows = np.flatnonzero(of_frame.reshape(-1) == number)
            columns = given[rows].transpose(1, 0, 2).reshape(self.count, -1)
            level = self._on_level(columns, pattern)
            dense = torch.from_numpy(self._to_dense @ level)
            deformed[torch.from_numpy(rows)] = dense.reshape(len(self.neutral), len(rows), 3).transpose(0, 1)
        return deformed.to(displacements.device)

    def follow(self, points: Tensor, rest: Tensor | None = None) -> Tensor:
        """Every vertex where the points take it, the head's rigid motion included.

        Each frame's motion is that of the points that move together: those that a face moves by itself count the less
        the farther they get, so that an open jaw does not turn the head.

        Args:
            points: seen places, (T,M,3), millimetres; NaN rows were not seen.
            rest: where they are seen with the head at rest in the neutral's place, (M,3); on its surface if absent.

        Returns:
            (T,V,3), millimetres; NaN in frames where fewer than 12 points were seen.
        """
        seen = torch.isfinite(points).all(-1).cpu()
        self._check(points, seen)
        still = (self.rest if rest is None else rest.cpu()).double()
        enough = (seen & self.used).sum(-1) >= LEAST_POINTS
        deformed = torch.full((len(points), *self.neutral.shape), torch.nan)
        if enough.any():
            shown = points.detach().cpu().double()[enough]
            pose = rigid_motion(still, shown)
            moved = self.spread((pose.inverse().apply(shown) - still).float()).double()
            deformed[enough] = pose.apply(moved + self.neutral.double()).float()
        return deformed.to(points.device)

    def _check(self, points: Tensor, seen: Tensor) -> None:
        if points.ndim != 3 or points.shape[1:] != (self.count, 3):
            raise ShapeError(f"thin shell: found points {tuple(points.shape)}, expected (T,{self.count},3)")
        if torch.isinf(points).any():
            raise ValueRangeError("thin shell: found infinite points, expected numbers, or NaN where one was not seen")

    def _on_level(self, columns: NDArray[np.float64], pattern: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Displacements of the coarse vertices that are held, (C,K), from those of the points (M,K)."""
        if self._operator is not None and self._reduced is not None:
            used = self.used.numpy()
            inner = columns[used]
            missing = ~pattern[used]
            if missing.any():  # the places at which the shell pulls at them no more
                block = self._reduced[missing]
                inner[missing] = -np.linalg.lstsq(block[:, missing], block[:, ~missing] @ inner[~missing], rcond=None)[
                    0
                ]
            return self._operator @ inner.astype(np.float32)
        factor = self._factor(torch.from_numpy(pattern))
        carried = self._carried[pattern]
        wanted = columns[pattern]
        return factor.solve(self._pull * (carried.T @ wanted)).astype(np.float32)

    def _factor(self, used: Tensor) -> SparseCholesky:
        """The shell pulled at these points; the last is kept, for points are lost for many frames, or for none."""
        key = used.numpy().tobytes()
        if self._factored is None or self._factored[0] != key:
            carried = self._carried[used.numpy()]
            try:
                self._factored = key, SparseCholesky(self._energy + self._pull * (carried.T @ carried))
            except ValueRangeError as error:
                raise ValueRangeError(
                    "thin shell: the points do not hold it (they lie on a line, or stretching is 0 on a loose part); "
                    "expected points spread over the face"
                ) from error
        return self._factored[1]

    def _dense_operator(self) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        r"""The coarse displacements for each point's own, (C,M), and the energy of the points' displacements, (M,M).

        With :math:`A = K + p\,C^\top C` and :math:`S = C A^{-1} C^\top` the field is :math:`A^{-1} C^\top S^{-1} c` for
        any :math:`p`, its energy :math:`c^\top (S^{-1} - p) c`.
        """
        carried = self._carried[self.used.numpy()]
        response = self._factor(self.used).solve(carried.T.toarray())
        inner = carried @ response
        inverse = np.linalg.pinv((inner + inner.T) / 2, rcond=1e-9, hermitian=True)
        operator = (response @ inverse).astype(np.float32)
        self._factored = None
        return operator, inverse - self._pull * np.eye(len(inverse))


def rigid_motion(rest: Tensor, points: Tensor) -> Similarity:
    """How a head moved, from points (T,M,3) on its face that also move by themselves; NaN rows were not seen.

    Returns:
        The motion of every frame from rest, scale 1: least squares in which a point that is :math:`r` from where the
        motion has it counts as :math:`1 / (1 + (r / 3)^2)`.
    """
    every = rest.expand_as(points)
    pose = similarity_transform(every, points, scale=False)
    for _ in range(_RIGID_ITERATIONS):
        left = (pose.apply(every) - points).nan_to_num(0.0).square().sum(-1)
        pose = similarity_transform(every, points, 1 / (1 + left / _RIGID_MM**2), scale=False)
    return pose


def _constraints(faces: Tensor, count: int, points: Attachment | Tensor) -> sparse.csr_array:
    """The matrix (M,V) that reads the points from the vertices."""
    if isinstance(points, Attachment):
        if len(points.triangles) and not 0 <= int(points.triangles.min()) <= int(points.triangles.max()) < len(faces):
            raise TopologyError(
                f"thin shell: found points on triangles {int(points.triangles.min())} to "
                f"{int(points.triangles.max())}, expected 0 to {len(faces) - 1}"
            )
        columns, weights = faces[points.triangles.cpu()], points.barycentric.double().cpu()
    else:
        ids = points.detach().cpu()
        if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) < count:
            raise TopologyError(
                f"thin shell: found vertex ids {int(ids.min())} to {int(ids.max())}, expected 0 to {count - 1}"
            )
        columns, weights = ids[:, None], torch.ones(len(ids), 1, dtype=torch.float64)
    rows = np.arange(len(columns)).repeat(columns.shape[1])
    entries = (weights.flatten().numpy(), (rows, columns.flatten().numpy()))
    return sparse.csr_array(entries, shape=(len(columns), count))


def _held(part: NDArray[np.int64], carried: sparse.csr_array) -> tuple[NDArray[np.bool_], Tensor]:
    """Which coarse vertices lie on a part with three points or more, (C,), and which points do, (M,)."""
    part_of_point = part[np.asarray(abs(carried).argmax(axis=1)).reshape(-1)]
    enough = np.bincount(part_of_point, minlength=part.max() + 1) >= _LEAST_ON_A_PART
    return enough[part], torch.from_numpy(enough[part_of_point])


def _followed(points: NDArray[np.float64], part: NDArray[np.int64], held: NDArray[np.bool_]) -> sparse.csr_array:
    """The matrix (C,H) that has the loose parts move as one, by the mean of what their vertices lie nearest to."""
    loose, ids = np.flatnonzero(~held), np.flatnonzero(held)
    column = np.cumsum(held) - 1
    nearest = column[ids[cKDTree(points[ids]).query(points[loose])[1]]]
    share = 1 / np.bincount(part[loose], minlength=part.max() + 1).clip(min=1)
    parts = part.max() + 1
    means = sparse.csr_array((share[part[loose]], (part[loose], nearest)), shape=(parts, len(ids)))
    own = sparse.csr_array((np.ones(len(ids)), (ids, column[ids])), shape=(len(points), len(ids)))
    member = sparse.csr_array((np.ones(len(loose)), (loose, part[loose])), shape=(len(points), parts))
    return sparse.csr_array(own + member @ means)
