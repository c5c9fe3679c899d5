"""Blinks of a head of any topology that shut its own eyes: the edges of its lids meet, before what lies in the eye."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy import sparse
from torch import Tensor

from torchface.geometry.meshes.operators import vertex_areas
from torchface.geometry.meshes.shell_energies import bending_energy, stretching_energy
from torchface.geometry.meshes.surface_index import SurfaceIndex, SurfacePoints
from torchface.landmarks.surfaces.eye_openings import EyeOpening, eye_opening
from torchface.optim.sparse import SparseCholesky
from torchface.rendering.raycast import RayCaster
from torchface.shape_names import mapping

BLINKS = ("eyeBlinkRight", "eyeBlinkLeft")
"""In the order of iBUG's eyes."""
EYES = (slice(36, 42), slice(42, 48))
"""Of iBUG's 68."""

_SHARES = torch.linspace(0.0, 1.0, 41, dtype=torch.float64)
_UPPER = 0.9  # of what is left of the opening: what the upper lid closes
_REACH, _LEAST_REACH = 0.5, 3.0  # of the opening's height, millimetres: how far the lids around go along
_FIRM, _TOUCH = 100.0, 0.3
_SPAN, _ASIDE = 76.0, 1.6
_AROUND = 1.5  # of the opening's half width, round its middle: the lids
_BEHIND, _BEFORE, _LIFT, _MOST = 1.5, 0.5, 0.25, 12.0
_PLACES = (
    torch.tensor(
        [[a, b, 4 - a - b] for a in range(5) for b in range(5 - a) if 4 not in (a, b, 4 - a - b)], dtype=torch.float64
    )
    / 4
)  # of a triangle beside its corners: one of a coarse head stands through a round eye
_LID = 0.8  # of the opening's height, from the upper lid's edge up: what unfolds
_OTHER = 0.4, 0.6  # millimetres of a lid from the template's, mean: where it begins to unfold, and does wholly
_FINEST, _HELD = 1.3, 0.005  # millimetres: narrower folds go; how much each place of the lid keeps to where it is


@dataclass(frozen=True, eq=False)
class SkinOfHead:
    """A head's skin apart from its other parts, upright, millimetres.

    Args:
        vertices: of the head, (J,3) float64.
        loose: vertices that are no skin, (J,) bool.
        part: connected part of each vertex, (J,).
    """

    vertices: Tensor
    faces: Tensor
    loose: Tensor
    part: Tensor

    @property
    def skin(self) -> Tensor:
        """Its triangles of skin, (S,3)."""
        return self.faces[~self.loose[self.faces].any(1)]


def eyes_seen(head: SkinOfHead, marks: Tensor) -> list[EyeOpening | None]:
    """The openings of the right and left eye, by iBUG's 68 marks (68,3) of the head; NaN where one is not known."""
    found = []
    for eye in EYES:
        own = marks[eye][torch.isfinite(marks[eye]).all(-1)]
        spans = (_SPAN, _ASIDE * _SPAN) if len(own) else ()
        tried = (eye_opening(head.vertices, head.skin, own.mean(0), span) for span in spans)
        found.append(next((one for one in tried if one is not None), None))
    return found


def shut_blinks(
    head: SkinOfHead,
    deltas: Tensor,
    names: Sequence[str],
    openings: Sequence[EyeOpening | None],
    apart: Tensor | None = None,
) -> tuple[Tensor, tuple[float | None, ...]]:
    r"""Deltas (N,J,3) in which each blink shuts its eye, and what it leaves open, as a share of the opening.

    Where a blink leaves points p of the upper and q of the lower edge apart, the change c closes the gap,

    .. math:: \min_c \sum_k \lVert c(p_k) - c(q_k) + g_k \rVert^2 + \lambda \int \lVert c \rVert^2 / \ell^2 + \lVert
        \nabla c \rVert^2,

    nine tenths of it by the upper lid. An upper lid that is not of the form from which the blink came unfolds: narrow
    folds that it keeps from rest are smoothed by least bending. Then the lids go before what lies in the eye, be it a
    ball or a plate.

    Args:
        head: at rest.
        deltas: (N,J,3) float64.
        names: of the shapes; those that mean ARKit's blinks are changed.
        openings: of the right and left eye; of one that is not seen the blink stays, and what it leaves is None; where
            no shape means its blink, 0.
        apart: how far each vertex lies from the surface from which the blinks came, (J,) millimetres; 0 if absent.
    """
    shapes, left = mapping(names, BLINKS) > 0.5, []
    if any(one is not None for one in openings):
        index, deltas = SurfaceIndex(head.vertices, head.skin), deltas.clone()
    for row, opening in enumerate(openings):
        own = shapes[row].nonzero()[:, 0].tolist()
        if opening is None or not own:
            left.append(None if own else 0.0)
            continue
        lids = _Lids.of(head, opening, index)
        for shape in own:
            deltas[shape] = lids.shut(deltas[shape], apart)
        left.append(lids.left(deltas[own[0]]))
    return deltas, tuple(left)


@dataclass(frozen=True, eq=False)
class _Lids:
    """The lids of one eye: places of the upper and lower edge on the skin, skin around (n,), the eye's triangles."""

    head: SkinOfHead
    skin: Tensor
    upper: SurfacePoints
    lower: SurfacePoints
    height: float
    near: Tensor
    eye: Tensor

    @staticmethod
    def of(head: SkinOfHead, opening: EyeOpening, index: SurfaceIndex) -> _Lids:
        above, below = opening.at(_SHARES)
        edge = torch.cat([above, below])
        middle, height = edge.mean(0), float((above - below)[:, 1].max())
        half = float(edge[:, 0].max() - edge[:, 0].min()) / 2
        near = (head.vertices - middle).norm(dim=-1) < _AROUND * half + height
        eye = _eye(head, near, edge)
        return _Lids(head, head.skin, index.nearest(above), index.nearest(below), height, near, eye)

    def gap(self, delta: Tensor) -> Tensor:
        """From the upper to the lower edge in a pose, (k,3)."""
        posed = self.head.vertices + delta
        return self._at(posed, self.lower) - self._at(posed, self.upper)

    def left(self, delta: Tensor) -> float:
        """The widest gap that a blink leaves, as a share of the opening's height."""
        return float(-self.gap(delta)[1:-1, 1].clamp(max=0).min() / self.height)

    def shut(self, delta: Tensor, apart: Tensor | None) -> Tensor:
        """The blink (J,3), shut and unfolded."""
        moving = torch.zeros(len(delta), dtype=torch.bool)
        moving[self.skin[self.near[self.skin].any(1)].flatten()] = True
        rows = moving.nonzero()[:, 0]
        place = torch.full((len(delta),), -1)
        place[rows] = torch.arange(len(rows))
        faces = place[self.skin[moving[self.skin].all(1)]]
        reach = max(_REACH * self.height, _LEAST_REACH)
        rest = self.head.vertices[rows]
        stiff = stretching_energy(rest, faces)
        mass = vertex_areas(rest, faces) / reach**2
        gap = self.gap(delta)
        gap = (
            gap * (gap[:, 1:2] < _TOUCH) * torch.tensor([0.0, 1.0, 1.0])
        )  # lids that overlap have shut; they may slide
        matrices = [self._matrix(points, place, len(rows)) for points in (self.upper, self.lower)]
        wanted = [_UPPER * gap, (_UPPER - 1) * gap]
        system = stiff + sparse.diags_array(mass.numpy())
        right = torch.zeros(len(rows), 3, dtype=torch.float64)
        for matrix, values in zip(matrices, wanted, strict=True):
            system = system + _FIRM * (matrix.T @ matrix)
            right += _FIRM * torch.from_numpy(matrix.T @ values.numpy())
        moved = delta.clone()
        moved[rows] += SparseCholesky(system).solve(right)
        if apart is not None:
            moved[rows] += self._unfolding(moved[rows], rest, faces, apart[rows], sum(one.T @ one for one in matrices))
        return self._before_the_eye(moved, rows)

    def _unfolding(self, delta: Tensor, rest: Tensor, faces: Tensor, apart: Tensor, edges: sparse.csr_array) -> Tensor:
        """The change (n,3) of a pose that bends an upper lid of another form least; its edge stays."""
        posed = rest + delta
        bending, mass = bending_energy(posed, faces), vertex_areas(posed, faces).clamp(min=1e-6) / _FINEST**4
        above, below = self._at(self.head.vertices, self.upper), self._at(self.head.vertices, self.lower)
        distance, nearest = torch.cdist(rest, above).min(1)
        lid = torch.exp(-((distance / (_LID * self.height)) ** 4)) * (rest[:, 1] > below[nearest, 1])
        other = (lid * apart).sum() / lid.sum().clamp(min=1e-9)
        share = ((other - _OTHER[0]) / (_OTHER[1] - _OTHER[0])).clamp(0, 1)
        lid = lid * (delta.norm(dim=-1) / delta.norm(dim=-1).max().clamp(min=1e-9)).sqrt()
        held = (1 / lid.clamp(min=1e-3) - 1 + _HELD) * mass
        system = bending + sparse.diags_array(held.numpy()) + _FIRM * edges
        return share * SparseCholesky(system).solve(-torch.from_numpy(bending @ posed.numpy()))

    def _before_the_eye(self, delta: Tensor, rows: Tensor) -> Tensor:
        """Lifts what was before the eye at rest, or beside it, before it in the pose, triangles as a whole."""
        if not len(self.eye):
            return delta
        caster = RayCaster(self.head.vertices, self.eye)
        free = torch.zeros(len(delta), dtype=torch.bool)
        free[rows] = _over(caster, self.head.vertices[rows]) < _BEFORE
        faces = self.skin[free[self.skin].all(1)]
        posed = self.head.vertices + delta
        lift = torch.zeros(len(delta), dtype=torch.float64)
        lift[free] = (_over(caster, posed[free]) + _LIFT).clamp(0, _MOST)
        places = torch.einsum("pk,fkc->fpc", _PLACES, posed[faces])
        lacking = _over(caster, places.flatten(0, 1)).view(len(faces), -1) - lift[faces] @ _PLACES.T
        lift.scatter_reduce_(
            0, faces.flatten(), (lift[faces] + lacking.amax(1).clamp(0, _MOST)[:, None]).flatten(), "amax"
        )
        posed[:, 2] += lift
        return posed - self.head.vertices

    def _at(self, vertices: Tensor, points: SurfacePoints) -> Tensor:
        return (vertices[self.skin[points.triangle]] * points.barycentric[..., None]).sum(1)

    def _matrix(self, points: SurfacePoints, place: Tensor, count: int) -> sparse.csr_array:
        columns = place[self.skin[points.triangle]]
        row = torch.arange(len(columns)).repeat_interleave(3)
        data = (points.barycentric.flatten().numpy(), (row.numpy(), columns.flatten().numpy()))
        return sparse.csr_array(data, shape=(len(columns), count))


def _eye(head: SkinOfHead, near: Tensor, edge: Tensor) -> Tensor:
    """Triangles (n,3) of the parts behind the edges (k,3) of the lids; lashes stand before them."""
    ids = (head.loose & near).nonzero()[:, 0]
    nearest = torch.cdist(head.vertices[ids, :2], edge[:, :2]).argmin(1)
    before = head.vertices[ids, 2] - edge[nearest, 2]
    parts, of = head.part[ids].unique(return_inverse=True)
    mean = torch.zeros(len(parts), dtype=torch.float64).index_add_(0, of, before) / of.bincount(minlength=len(parts))
    inside = torch.zeros_like(near)
    inside[ids] = mean[of] < -_BEHIND
    return head.faces[inside[head.faces].all(1)]


def _over(caster: RayCaster, points: Tensor) -> Tensor:
    """How far the eye stands before points (n,3), seen from the front; minus infinity beside it."""
    far = points + torch.tensor([0.0, 0.0, 200.0], dtype=torch.float64)
    hits = caster.cast(far, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand_as(far))
    return torch.where(hits.triangle >= 0, 200.0 - hits.distance, -torch.inf)
