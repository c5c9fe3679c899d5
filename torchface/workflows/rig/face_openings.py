"""The openings of a face, found on its mesh or cut into it: between the lips, and between the lids of an eye."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchface.geometry.meshes.cutting import CutMesh
from torchface.geometry.meshes.operators import border_edges, triangle_cross
from torchface.modeling.rigging.joined_vertices import joined_vertices
from torchface.rendering.raycast import RayCaster

_FINE, _ROUNDS, _REACH, _DEPTH = 1.5, 6, 3.0, 14.0  # millimetres: edges at a cut, and how far round it they are so
_APART = 0.02  # millimetres between lips that were cut, so that they are two
_CREASE, _COLUMNS, _LEAN = 2.5, 61, 0.06  # millimetres round the template's line where the lips' own is looked for
_LINED, _OF_LIPS = 4.0, 0.6  # rays so far from the lips' line meet a mouth's inside behind the lips
_HOLE, _HOLE_OFF = (0.35, 2.0), 14.0  # a hole's width beside the template's opening, millimetres between both

INSIDE = 30.0
"""Millimetres behind the lips in which a mouth's inside lies."""


@dataclass(frozen=True, eq=False)
class Loop:
    """Vertices (n,) once round an opening, from the person's left end over its upper edge, and their shares of it."""

    vertices: Tensor
    share: Tensor

    @staticmethod
    def of(vertices: Tensor, places: Tensor, top: int | None = None) -> "Loop":
        """Of vertices in order, either way round; a half of the way lies above: that with the vertex ``top``, else
        the higher."""
        x = places[vertices, 0]
        ordered = vertices.roll(-int(x.argmax()))
        right = int(places[ordered, 0].argmin())
        upper, lower = ordered[: right + 1], torch.cat([ordered[:1], ordered[right:].flip(0)])
        higher = float(places[upper, 1].mean()) >= float(places[lower, 1].mean())
        if not (higher if top is None else bool((upper == top).any())):
            upper, lower = lower, upper
        halves = []
        for chain in (upper, lower):
            step = places[chain].diff(dim=0)[:, :2].norm(dim=-1).cumsum(0)
            halves.append(torch.cat([torch.zeros(1).double(), step / step[-1].clamp(min=1e-9)]) / 2)
        around = torch.cat([upper, lower[1:-1].flip(0)])
        return Loop(around, torch.cat([halves[0], (1 - halves[1][1:-1]).flip(0)]))

    def between(self, share: Tensor) -> tuple[Tensor, Tensor]:
        """The two vertices between which each share (n,) of the way lies, (n,2), and how much it is of each, (n,2)."""
        ends = torch.cat([self.share, torch.ones(1).double()])
        before = (torch.searchsorted(ends, share.clamp(0, 1 - 1e-9), right=True) - 1).clamp(0, len(self.share) - 1)
        far = ((share - ends[before]) / (ends[before + 1] - ends[before]).clamp(min=1e-9)).clamp(0, 1)
        pair = torch.stack([before, (before + 1) % len(self.vertices)], 1)
        return self.vertices[pair], torch.stack([1 - far, far], 1)


class OpenedFace:
    """A face's mesh, its vertices (V,3) float64, opened where that is asked for; places are in the template's space."""

    def __init__(self, rest: Tensor, faces: Tensor, skin: Tensor) -> None:
        self._rest, self._skin = rest, skin
        self.cut = CutMesh.of(len(rest), faces)
        self._shifts: list[tuple[Tensor, Tensor]] = []
        of_skin = faces[skin[faces].all(1)]
        self.caster = RayCaster(rest, of_skin)
        self._joined = joined_vertices(rest, of_skin)

    def places(self) -> Tensor:
        """Of all vertices now, (W,3)."""
        places = self.cut.at(self._rest)
        for rows, shift in self._shifts:
            places[rows] += shift
        return places

    def hole(self, edge: Tensor) -> Loop | None:
        """The border of the skin's hole where the template has the opening ``edge`` (n,3)."""
        faces = self._joined.faces
        row, corner = border_edges(faces).nonzero().T
        after = dict(zip(faces[row, corner - 2].tolist(), faces[row, corner - 1].tolist(), strict=True))
        of, middle, width = self._joined.of, edge.mean(0), float(edge[:, 0].max() - edge[:, 0].min())
        file_row = torch.zeros(len(self._joined.vertices), dtype=torch.int64)
        file_row[of.flip(0)] = torch.arange(len(of)).flip(0)
        best, found = _HOLE[0] * width, None
        while after:
            loop = [next(iter(after))]
            while (following := after.pop(loop[-1], loop[0])) != loop[0]:
                loop.append(following)
            places = self._joined.vertices[loop]
            wide = float(places[:, 0].max() - places[:, 0].min())
            near = float((places.mean(0) - middle)[:2].norm()) < _HOLE_OFF and len(loop) > 5
            if near and best < wide < _HOLE[1] * width:
                best, found = wide, file_row[torch.tensor(loop)]
        if found is None:
            return None
        # Seen from outside skin lies to the left of its border: from the right end on that is the upper edge, also of
        # lips that cross at rest. A file's triangles may face inward.
        at = self._joined.vertices
        around = (at[faces].mean(1) - middle).norm(dim=-1) < width
        outward = float(triangle_cross(at, faces)[around, 2].sum()) > 0
        found = found.roll(-int(self._rest[found, 0].argmax()))
        right = int(self._rest[found, 0].argmin())
        return Loop.of(found, self._rest, int(found[(right + len(found)) // 2 if outward else right // 2]))

    def lined(self, edge: Tensor) -> bool:
        """Whether something lies behind the lips, whose edge on the template is (n,3)."""
        line = _halves(edge)
        at = line.at(torch.linspace(-_OF_LIPS, _OF_LIPS, 9, dtype=torch.float64))
        up = torch.tensor([0.0, _LINED, 0.0], dtype=torch.float64)
        origins = torch.cat([at + up, at - up]) + torch.tensor([0.0, 0.0, 60.0])
        ahead = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand_as(origins)
        first = self.caster.cast(origins, ahead).distance
        met = torch.isfinite(first)
        inside = origins[met] + (first[met, None] + 0.3) * ahead[met]
        behind = self.caster.cast(inside, ahead[met]).distance
        return float((behind < INSIDE).double().mean()) > 0.5

    def _refined(self, distance: Callable[[Tensor], Tensor]) -> None:
        """Cuts long edges near where ``distance`` (W,) of places is 0."""
        for _ in range(_ROUNDS):
            places = self.places()
            far, ends = distance(places), self.cut.edges(self._of_skin())
            one, other = far[ends[:, 0]], far[ends[:, 1]]
            long = (places[ends[:, 0]] - places[ends[:, 1]]).norm(dim=-1) > _FINE
            near = (torch.minimum(one.abs(), other.abs()) < _REACH) | (one * other < 0)
            wanted = ends[long & near & torch.isfinite(one) & torch.isfinite(other)]
            if not len(wanted):
                break
            self.cut = self.cut.split(wanted, torch.full((len(wanted),), 0.5, dtype=torch.float64))

    def _of_skin(self) -> Tensor:
        """Which vertices of the cut mesh lie on the skin."""
        return torch.from_numpy(self.cut.shares @ self._skin.double().numpy()) > 0.99

    def _split(self, distance: Callable[[Tensor], Tensor], usable: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """Cuts triangles where ``distance`` is 0 and places are usable; the new rows, all distances, 0 there."""
        places = self.places()
        far = distance(places)
        far = torch.where(far.abs() < 1e-4, 1e-4, far)
        ends = self.cut.edges(self._of_skin())
        one, other = far[ends[:, 0]], far[ends[:, 1]]
        share = one / (one - other)
        point = places[ends[:, 0]] + share[:, None] * (places[ends[:, 1]] - places[ends[:, 0]])
        kept = (one * other < 0) & torch.isfinite(one + other) & usable(point)
        self.cut = self.cut.split(ends[kept], share[kept])
        new = torch.arange(len(far), len(far) + int(kept.sum()))
        return new, torch.cat([far, torch.zeros(len(new), dtype=far.dtype)])

    def cut_lips(self, edge: Tensor) -> Loop:
        """Cuts lips that are one piece along the line between them, which is near the template's edge (n,3)."""
        line = self._crease(_halves(edge))

        def distance(places: Tensor) -> Tensor:
            x, far = line.on(places)
            near = (x.abs() < 1.1) & ((places[:, 2] - far[:, 2]).abs() < _DEPTH)
            return torch.where(near, places[:, 1] - far[:, 1], torch.inf)

        def usable(points: Tensor) -> Tensor:
            x, far = line.on(points)
            return (x.abs() < 0.985) & ((points[:, 2] - far[:, 2]).abs() < _DEPTH)

        self._refined(distance)
        new, far = self._split(distance, usable)
        places = self.places()
        group = self._in_order(new, places[new, 0], places)
        inner = torch.cat(group[1:-1])
        count = self.cut.shares.shape[0]
        copy = torch.arange(count)
        copy[inner] = count + torch.arange(len(inner))
        sum_of = torch.where(torch.isfinite(far), far, 0.0)[self.cut.faces].sum(1)
        self.cut = self.cut.torn(inner, sum_of < 0)
        up = torch.tensor([0.0, _APART / 2, 0.0], dtype=torch.float64)
        self._shifts += [(inner, up), (copy[inner], -up)]
        chain = torch.stack([rows[0] for rows in group])
        return Loop.of(torch.cat([chain, copy[chain[1:-1]].flip(0)]), self.places())

    def _crease(self, line: "_LipLine") -> "_LipLine":
        """The deepest place of the face near the template's line between the lips, in each column."""
        share = torch.linspace(-0.95, 0.95, _COLUMNS, dtype=torch.float64)
        at, off = line.at(share), torch.linspace(-_CREASE, _CREASE, 41, dtype=torch.float64)
        origins = (at[:, None] + torch.stack([0 * off, off, 60 + 0 * off], -1)).reshape(-1, 3)
        ahead = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand_as(origins)
        depth = self.caster.cast(origins, ahead).distance.reshape(len(at), -1)
        chord = depth[:, :1] + (depth[:, -1:] - depth[:, :1]) * torch.linspace(0, 1, len(off)).double()
        dip = torch.where(torch.isfinite(depth), depth - chord, 0.0) - _LEAN * off.square()
        moved = off[dip.argmax(1)] * (1 - share.abs() ** 4)
        moved = torch.nn.functional.pad(moved[None], (3, 3), mode="replicate")[0].unfold(0, 7, 1).median(-1).values
        moved = torch.nn.functional.pad(moved[None], (3, 3), mode="replicate")[0].unfold(0, 7, 1).mean(-1)
        return _LipLine(line.ends, share, at + torch.stack([0 * moved, moved, 0 * moved], -1))

    def cut_eye(self, edge: Tensor) -> Loop:
        """Cuts the skin out between the lids, whose edge on the template is (n,3)."""
        depth = edge[:, 2].mean()

        def distance(places: Tensor) -> Tensor:
            near = (places[:, 2] - depth).abs() < _DEPTH
            far = torch.full((len(places),), torch.inf, dtype=torch.float64)
            far[near] = _outside(places[near, :2], edge[:, :2])
            return far

        self._refined(distance)
        new, far = self._split(distance, lambda points: (points[:, 2] - depth).abs() < _DEPTH)
        places = self.places()
        away = places[new, :2] - edge[:, :2].mean(0)
        group = self._in_order(new, torch.atan2(away[:, 1], away[:, 0]), places)
        self.cut = self.cut.without(torch.where(torch.isfinite(far), far, 1e3)[self.cut.faces].sum(1) < 0)
        return Loop.of(torch.stack([rows[0] for rows in group]), places)

    @staticmethod
    def _in_order(rows: Tensor, key: Tensor, places: Tensor) -> list[Tensor]:
        """Rows in the order of a key, those in one place together."""
        rows = rows[key.argsort()]
        apart = (places[rows].diff(dim=0).norm(dim=-1) > 1e-3).nonzero()[:, 0] + 1
        return list(rows.tensor_split(apart.tolist()))


@dataclass(frozen=True, eq=False)
class _LipLine:
    """The line between lips: places (n,3) at shares (n,) from -1 at its right end to 1 at its left one."""

    ends: tuple[float, float]
    share: Tensor
    places: Tensor

    def at(self, share: Tensor) -> Tensor:
        """Places (k,3) at shares (k,)."""
        own = (np.interp(share.numpy(), self.share.numpy(), column.numpy()) for column in self.places.T)
        return torch.from_numpy(np.stack(list(own), 1))

    def on(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The shares (P,) of points (P,3) and the line's places (P,3) above or below them."""
        share = (points[:, 0] - self.ends[0]) / (self.ends[1] - self.ends[0]) * 2 - 1
        return share, self.at(share)


def _halves(edge: Tensor) -> _LipLine:
    """The line between the upper and the lower edge (n,3) of lips that touch."""
    loop = Loop.of(torch.arange(len(edge)), edge)
    order = loop.share.argsort()
    closed = np.append(loop.share[order].numpy(), 1.0)
    ways = np.linspace(0, 0.5, 41)
    around = edge[loop.vertices[torch.cat([order, order[:1]])]].numpy()
    at = lambda share: np.stack([np.interp(share, closed, column) for column in around.T], 1)  # noqa: E731
    middle = torch.from_numpy((at(ways) + at(1 - ways)) / 2).flip(0)
    ends = float(middle[0, 0]), float(middle[-1, 0])
    return _LipLine(ends, (middle[:, 0] - ends[0]) / (ends[1] - ends[0]) * 2 - 1, middle)


def _outside(points: Tensor, polygon: Tensor) -> Tensor:
    """The distance of points (P,2) to a polygon (n,2), negative inside."""
    a, b = polygon, polygon.roll(-1, 0)
    way, from_a = b - a, points[:, None] - a
    share = ((from_a * way).sum(-1) / way.square().sum(-1).clamp(min=1e-12)).clamp(0, 1)
    distance = (from_a - share[..., None] * way).norm(dim=-1).amin(1)
    above = (a[:, 1] > points[:, 1:]) != (b[:, 1] > points[:, 1:])
    at = a[:, 0] + (points[:, 1:] - a[:, 1]) / torch.where(way[:, 1] == 0, 1e-12, way[:, 1]) * way[:, 0]
    inside = ((above & (points[:, :1] < at)).sum(1) % 2).bool()
    return torch.where(inside, -distance, distance)
