"""Blinks of a head of any topology that shut its own eyes: the edges of its lids meet, before what lies in the eye."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy import sparse
from torch import Tensor

from torchface.geometry.meshes.operators import vertex_areas
from torchface.geometry.meshes.shell_energies import bending_energy, stretching_energy
from torchface.geometry.meshes.surface_index import SurfaceIndex, SurfacePoints
from torchface.landmarks.surfaces.eye_openings import Opening, eye_opening
from torchface.optim.sparse import SparseCholesky
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping

BLINKS = ("eyeBlinkRight", "eyeBlinkLeft")
"""In the order of iBUG's eyes."""
_OTHER_LIDS = tuple(
    tuple(f"eye{way}{side}" for way in ("LookUp", "LookDown", "Wide", "Squint")) for side in ("Right", "Left")
)
_DOWN = ("eyeLookDownRight", "eyeLookDownLeft")
_MOST_GROWN = 2.0  # times
EYES = (slice(36, 42), slice(42, 48))
"""Of iBUG's 68."""

_SHARES = torch.linspace(0.0, 1.0, 41, dtype=torch.float64)
_UPPER = 0.9  # of what is left of the opening: what the upper lid closes
_REACH, _LEAST_REACH = 0.5, 3.0  # of the opening's height, millimetres: how far the lids around go along
_FIRM, _TOUCH, _OVERLAP = 100.0, 0.3, 0.5
_SPAN, _ASIDE = 76.0, 1.6
_AROUND = 1.5  # of the opening's half width, round its middle: the lids
_BEHIND, _BEFORE, _LIFT, _MOST, _HIDDEN = 1.5, 0.5, 0.25, 12.0, 0.2
_PLACES = (
    torch.tensor(
        [[a, b, 4 - a - b] for a in range(5) for b in range(5 - a) if 4 not in (a, b, 4 - a - b)], dtype=torch.float64
    )
    / 4
)  # of a triangle beside its corners: one of a coarse head stands through a round eye
# Of its edge's way: how high an upper lid goes half as far. Millimetres: below and behind the edge, and of lag.
_GOES_ALONG, _BESIDE, _LAG = 0.42, 1.5, 0.5
_LID = 0.8  # of the opening's height, from the upper lid's edge up: what unfolds
_OTHER = 0.4, 0.6  # millimetres of a lid from the template's, mean: where it begins to unfold, and does wholly
_FINEST, _HELD = 1.3, 0.005  # millimetres: narrower folds go; how much each place of the lid keeps to where it is


@dataclass(frozen=True, eq=False)
class SkinOfHead:
    """A head's skin apart from its other parts, upright, millimetres."""

    vertices: Tensor  # of the head, (J,3) float64
    faces: Tensor
    loose: Tensor  # vertices that are no skin, (J,) bool
    part: Tensor  # connected part of each vertex, (J,)

    @property
    def skin(self) -> Tensor:
        """Its triangles of skin, (S,3)."""
        return self.faces[~self.loose[self.faces].any(1)]


def eyes_seen(head: SkinOfHead, marks: Tensor) -> list[Opening | None]:
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
    openings: Sequence[Opening | None],
    apart: Tensor | None = None,
    looking_down: Sequence[float | None] = (None, None),
) -> tuple[Tensor, tuple[float | None, ...]]:
    r"""Deltas (N,J,3) in which each blink shuts its eye, and what it leaves open, as a share of the opening.

    Where a blink leaves points p of the upper and q of the lower edge apart, the change c closes the gap,

    .. math:: \min_c \sum_k \lVert c(p_k) - c(q_k) + g_k \rVert^2 + \lambda \int \lVert c \rVert^2 / \ell^2 + \lVert
        \nabla c \rVert^2,

    nine tenths of it by the upper lid. An upper lid that is not of the form from which the blink came unfolds: narrow
    folds that it keeps from rest are smoothed by least bending. Then the lids go before what lies in the eye, be it a
    ball or a plate. Of an upper lid that is thicker or higher than the template's more goes along than its edge.

    Blinks are fitted to openings, an eye's other shapes are not: where lids that look down go a smaller share of a
    blink's way than the template's, lids of all these shapes move as many times as far as that takes.

    Args:
        head: at rest.
        deltas: (N,J,3) float64.
        names: of the shapes; those that mean ARKit's shapes of the eyes are changed.
        openings: of the right and left eye; of one that is not seen the blink stays, and what it leaves is None; where
            no shape means its blink, 0.
        apart: how far each vertex lies from the surface from which the blinks came, (J,) millimetres; 0 if absent.
        looking_down: the template's shares, see ``lids_looking_down``; what is None or absent changes nothing.
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
        upper = [lids.upper_lid(one) for one in (_shape(deltas, names, _DOWN[row]), deltas[own[0]]) if one is not None]
        share, wanted = _share(*upper) if len(upper) == 2 else None, looking_down[row]
        if share is not None and wanted is not None and wanted > share:
            times = min(wanted / share, _MOST_GROWN)
            for shape in (mapping(names, _OTHER_LIDS[row]) > 0.5).any(0).nonzero()[:, 0].tolist():
                deltas[shape] = lids.moved_by(times, deltas[shape])
        left.append(lids.left(deltas[own[0]]))
    return deltas, tuple(left)


def lids_looking_down(rig: BlendshapeRig) -> tuple[float | None, float | None]:
    """How far the right and left upper lid go where the eye looks down, as a share of a blink; None if unknown."""
    marks = None if rig.neutral.annotations is None else rig.neutral.annotations.landmarks
    if marks is None or len(marks) != 68:
        return None, None
    deltas = rig.deltas.detach().cpu().double()
    shares = []
    for row, eye in enumerate(EYES):
        both = [_shape(deltas, rig.names, name) for name in (_DOWN[row], BLINKS[row])]
        middle = marks[eye][1:3].cpu()
        upper = [one[middle] for one in both if one is not None]
        shares.append(_share(*upper) if len(upper) == 2 else None)
    return shares[0], shares[1]


def _shape(deltas: Tensor, names: Sequence[str], name: str) -> Tensor | None:
    meant = (mapping(names, [name])[0] > 0.5).nonzero()[:, 0]
    return deltas[int(meant[0])] if len(meant) else None


def _share(down: Tensor, blink: Tensor) -> float | None:
    """Of points' mean ways (k,3), vertical."""
    way, whole = float(down[:, 1].mean()), float(blink[:, 1].mean())
    return way / whole if way < 0 and whole < 0 else None


@dataclass(frozen=True, eq=False)
class _Lids:
    """The lids of one eye."""

    head: SkinOfHead
    skin: Tensor  # triangles (S,3)
    edges: tuple[SurfacePoints, SurfacePoints]  # places of the upper and of the lower edge on the skin
    height: float  # of the opening, millimetres
    rows: Tensor  # vertices of the skin around, (n,)
    faces: Tensor  # triangles among them, (m,3) of 0 to n-1
    # (k,n) each, points of the upper and of the lower edge from the vertices
    matrices: tuple[sparse.csr_array, sparse.csr_array]
    system: SparseCholesky  # of the change of the vertices that moves the edges
    eye: Tensor  # the triangles of what lies in it

    @staticmethod
    def of(head: SkinOfHead, opening: Opening, index: SurfaceIndex) -> "_Lids":
        above, below = opening.at(_SHARES)
        edge, skin = torch.cat([above, below]), head.skin
        middle, height = edge.mean(0), float((above - below)[:, 1].max())
        half = float(edge[:, 0].max() - edge[:, 0].min()) / 2
        near = (head.vertices - middle).norm(dim=-1) < _AROUND * half + height
        rows = skin[near[skin].any(1)].unique()
        place = torch.full((len(head.vertices),), -1)
        place[rows] = torch.arange(len(rows))
        faces = place[skin]
        faces = faces[(faces >= 0).all(1)]
        rest, edges = head.vertices[rows], (index.nearest(above), index.nearest(below))
        upper, lower = (_matrix(points, place[skin[points.triangle]], len(rows)) for points in edges)
        mass = vertex_areas(rest, faces) / max(_REACH * height, _LEAST_REACH) ** 2
        held = _FIRM * (upper.T @ upper) + _FIRM * (lower.T @ lower)
        system = SparseCholesky(stretching_energy(rest, faces) + sparse.diags_array(mass.numpy()) + held)
        return _Lids(head, skin, edges, height, rows, faces, (upper, lower), system, _eye(head, near, edge))

    def gap(self, delta: Tensor) -> Tensor:
        """From the upper to the lower edge in a pose, (k,3)."""
        upper, lower = (self._at(self.head.vertices + delta, points) for points in self.edges)
        return lower - upper

    def left(self, delta: Tensor) -> float:
        """The widest gap that a blink leaves, as a share of the opening's height."""
        return float(-self.gap(delta)[1:-1, 1].clamp(max=0).min() / self.height)

    def upper_lid(self, delta: Tensor) -> Tensor:
        """The ways of the middle of the upper lid's edge, (k,3)."""
        return self._at(delta, self.edges[0])[len(_SHARES) // 3 : -(len(_SHARES) // 3)]

    def moved_by(self, times: float, delta: Tensor) -> Tensor:
        """A pose (J,3) whose lids move so many times as far."""
        change = self._change([(times - 1) * self._at(delta, points) for points in self.edges])
        return delta.index_add(0, self.rows, change)

    def shut(self, delta: Tensor, apart: Tensor | None) -> Tensor:
        """The blink (J,3), shut and unfolded."""
        gap = self.gap(delta)
        # Lids that overlap a little have shut; they may slide.
        wrong = torch.where(gap[:, 1:2] < _TOUCH, 1.0, 1 - _OVERLAP / gap[:, 1:2].clamp(min=_OVERLAP))
        gap = gap * wrong * torch.tensor([0.0, 1.0, 1.0])
        moved = delta.index_add(0, self.rows, self._change([_UPPER * gap, (_UPPER - 1) * gap]))
        moved[self.rows] = self._with_its_edge(moved)
        if apart is not None:
            moved[self.rows] += self._unfolding(moved[self.rows], apart[self.rows])
        return _before_the_eye(self.head, self.eye, moved, self.rows)

    def _with_its_edge(self, delta: Tensor) -> Tensor:
        """A pose of the vertices around, (n,3), in which the upper lid goes down with its edge, the less the higher."""
        rest, edge = self.head.vertices[self.rows], self._at(self.head.vertices, self.edges[0])
        distance, nearest = torch.cdist(rest, edge).min(1)
        way, own = self._at(delta, self.edges[0])[nearest], delta[self.rows]
        far = distance / (_GOES_ALONG * way.norm(dim=-1).clamp(min=1e-6))
        least = way / (1 + far**5)[:, None]
        lags = (own[:, 1] - least[:, 1]).clamp(min=0)
        front = ((rest - edge[nearest])[:, 1:] / _BESIDE + 1).clamp(0, 1).prod(1)
        return own + (front * lags / (lags + _LAG))[:, None] * (least - own)

    def _change(self, edges: Sequence[Tensor]) -> Tensor:
        """The change (n,3) of the vertices around that moves the edges' points, (k,3) each."""
        right = sum(_FIRM * (matrix.T @ way.numpy()) for matrix, way in zip(self.matrices, edges, strict=True))
        return self.system.solve(torch.from_numpy(right))

    def _unfolding(self, delta: Tensor, apart: Tensor) -> Tensor:
        """The change (n,3) of a pose that bends an upper lid of another form least; its edge stays."""
        rest = self.head.vertices[self.rows]
        posed = rest + delta
        bending, mass = bending_energy(posed, self.faces), vertex_areas(posed, self.faces).clamp(min=1e-6) / _FINEST**4
        above, below = (self._at(self.head.vertices, points) for points in self.edges)
        distance, nearest = torch.cdist(rest, above).min(1)
        lid = torch.exp(-((distance / (_LID * self.height)) ** 4)) * (rest[:, 1] > below[nearest, 1])
        other = (lid * apart).sum() / lid.sum().clamp(min=1e-9)
        share = ((other - _OTHER[0]) / (_OTHER[1] - _OTHER[0])).clamp(0, 1)
        lid = lid * (delta.norm(dim=-1) / delta.norm(dim=-1).max().clamp(min=1e-9)).sqrt()
        held = (1 / lid.clamp(min=1e-3) - 1 + _HELD) * mass
        edges = sum(matrix.T @ matrix for matrix in self.matrices)
        system = bending + sparse.diags_array(held.numpy()) + _FIRM * edges
        return share * SparseCholesky(system).solve(-torch.from_numpy(bending @ posed.numpy()))

    def _at(self, vertices: Tensor, points: SurfacePoints) -> Tensor:
        return (vertices[self.skin[points.triangle]] * points.barycentric[..., None]).sum(1)


def _before_the_eye(head: SkinOfHead, eye: Tensor, delta: Tensor, rows: Tensor) -> Tensor:
    """Lifts what of the skin's rows (n,) was before the eye or beside it at rest before it in the pose."""
    if not len(eye):
        return delta
    caster = RayCaster(head.vertices, eye)
    skin, free = head.skin, torch.zeros(len(delta), dtype=torch.bool)
    free[rows] = stands_before(caster, head.vertices[rows]) < _BEFORE
    faces = skin[free[skin].all(1)]
    posed = head.vertices + delta
    shell = RayCaster(posed, skin[torch.isin(skin, rows).any(1)])
    lift = torch.zeros(len(delta), dtype=torch.float64)
    lift[free] = (_shown(caster, shell, posed[free]) + _LIFT).clamp(0, _MOST)
    places = torch.einsum("pk,fkc->fpc", _PLACES, posed[faces]).flatten(0, 1)
    lacking = _shown(caster, shell, places).view(len(faces), -1) - lift[faces] @ _PLACES.T
    lift.scatter_reduce_(0, faces.flatten(), (lift[faces] + lacking.amax(1).clamp(0, _MOST)[:, None]).flatten(), "amax")
    posed[:, 2] += lift
    return posed - head.vertices


def _matrix(points: SurfacePoints, columns: Tensor, count: int) -> sparse.csr_array:
    """Points (k,n) from vertices, of which those of each point's triangle are ``columns`` (k,3)."""
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


def _shown(caster: RayCaster, skin: RayCaster, points: Tensor) -> Tensor:
    """How far the eye stands before points (n,3), minus infinity behind other skin, as a lid's lining is and a fold."""
    return torch.where(stands_before(skin, points) > _HIDDEN, -torch.inf, stands_before(caster, points))


def stands_before(caster: RayCaster, points: Tensor) -> Tensor:
    """How far an eye, or other skin, stands before points (n,3), seen from the front; minus infinity beside it."""
    far = points + torch.tensor([0.0, 0.0, 200.0], dtype=torch.float64)
    hits = caster.cast(far, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand_as(far))
    return torch.where(hits.triangle >= 0, 200.0 - hits.distance, -torch.inf)
