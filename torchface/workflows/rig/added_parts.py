"""The inside of a mouth and the eyes that a character's mesh lacks, taken from the template on its face."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchface.geometry.meshes.cutting import CutMesh, strip
from torchface.geometry.meshes.operators import border_edges, vertex_normals
from torchface.io.gltf.character_scene import Character
from torchface.io.gltf.part_insertion import ExtendedBlock
from torchface.modeling.rigging.other_topology import fitted_template, joined_vertices
from torchface.registration import Registration
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig
from torchface.synthetic import character as shown_character
from torchface.synthetic.head.topology import EYE_RIM, MOUTH_CONTACT, topology
from torchface.workflows.rig.character_face import CharacterFace

_TEETH = ("teeth_upper", "gums_upper", "teeth_lower", "gums_lower", "tongue")
_PAGE = 1024  # texels of a side of the parts' image
_FINE, _ROUNDS, _REACH, _DEPTH = 1.5, 6, 3.0, 14.0  # millimetres: edges at a cut, and how far round it they are so
_APART = 0.02  # millimetres between lips that were cut, so that they are two
_CREASE, _COLUMNS, _LEAN = 2.5, 61, 0.06  # millimetres round the template's line where the lips' own is looked for
_LINED, _OF_LIPS, _INSIDE = 4.0, 0.6, 30.0  # rays so far from the lips' line meet a mouth's inside behind the lips
_HOLE, _HOLE_OFF = (0.35, 2.0), 14.0  # a hole's width beside the template's opening, millimetres between both
_THICK, _OUT = 2.0, 15.0  # millimetres: of the skin before a mouth's bag, and how far it may have come through
_LOOSE = 12  # vertices of loose parts from which a mouth has teeth and an eye an eyeball


@dataclass(frozen=True, eq=False)
class AddedParts:
    """What is added to a character's file, and what is said of it.

    Args:
        blocks: of the file, with their new vertices; none where nothing was missing.
        page: image of the parts, (3,H,W) in [0,1].
        notes: for people to read.
    """

    blocks: tuple[ExtendedBlock, ...]
    page: Tensor
    notes: tuple[str, ...]


def added_parts(
    character: Character,
    face: CharacterFace,
    template: BlendshapeRig,
    registration: Registration,
    wanted: tuple[bool, bool],
) -> AddedParts:
    """The parts that a character lacks.

    Args:
        face: where it is.
        registration: of the template with ``face.skin``.
        wanted: the inside of the mouth, and eyes.
    """
    fitting = _Fitting(character, face, template, registration)
    if wanted[0]:
        fitting.add_mouth()
    if wanted[1]:
        fitting.add_eyes()
    return fitting.finished()


@dataclass(frozen=True, eq=False)
class _Loop:
    """Vertices (n,) once round an opening, from the person's left end over its upper edge, and their shares of it."""

    vertices: Tensor
    share: Tensor

    @staticmethod
    def of(vertices: Tensor, places: Tensor) -> _Loop:
        """Of vertices in order, whichever way round they run; a half of the way lies above."""
        x = places[vertices, 0]
        ordered = vertices.roll(-int(x.argmax()))
        right = int(places[ordered, 0].argmin())
        upper, lower = ordered[: right + 1], torch.cat([ordered[:1], ordered[right:].flip(0)])
        if float(places[upper, 1].mean()) < float(places[lower, 1].mean()):
            upper, lower = lower, upper
        halves = []
        for chain in (upper, lower):
            step = places[chain].diff(dim=0)[:, :2].norm(dim=-1).cumsum(0)
            halves.append(torch.cat([torch.zeros(1).double(), step / step[-1].clamp(min=1e-9)]) / 2)
        around = torch.cat([upper, lower[1:-1].flip(0)])
        return _Loop(around, torch.cat([halves[0], (1 - halves[1][1:-1]).flip(0)]))


def _ring(name: str, number: int, left: bool) -> Tensor:
    """A ring of the template round the mouth, or the left or right eye, in order."""
    t = topology()
    half = t.rings[name][number]
    if name == "mouth":  # from the upper lip's middle over the left corner to the lower lip's
        return torch.cat([half, t.mirror[half.flip(0)[1:-1]]])
    return half if left else t.mirror[half]


class _Fitting:
    """Parts added one by one; places are in the template's space, new rows are counted from -1 down until the end."""

    def __init__(
        self, character: Character, face: CharacterFace, template: BlendshapeRig, registration: Registration
    ) -> None:
        self._character, self._face, self._registration = character, face, registration
        fitted = fitted_template(template, registration)
        self._shown = shown_character(BlendshapeRig(fitted, template.deltas, template.names), size=_PAGE).rig.neutral
        self._template = self._shown.vertices.double()
        self._rest = registration.pose.inverse().apply(face.vertices)[0]
        self._cut = CutMesh.of(len(self._rest), character.faces)
        self._shifts: list[tuple[Tensor, Tensor]] = []
        self._skin = torch.zeros(len(self._rest), dtype=torch.bool)
        self._skin[face.skin_rows] = True
        skin = character.faces[self._skin[character.faces].all(1)]
        self._caster = RayCaster(self._rest, skin)
        self._joined = joined_vertices(self._rest, skin)
        nose = self._template[self._shown.landmarks[30]]
        self._host = int(face.skin_rows[(self._rest[face.skin_rows] - nose).norm(dim=-1).argmin()])
        self._count = 0
        self._new: list[tuple[Tensor, Tensor | None, Tensor]] = []  # places, coordinates, hosts
        self._strips: list[tuple[Tensor, int]] = []  # triangles, and one of the file's at their edge
        self._faces: list[Tensor] = []
        self._notes: list[str] = []

    def add_mouth(self) -> None:
        """Bag, gums, teeth and tongue where the mouth has none; lips that are one piece are cut apart."""
        edge = self._template[_ring("mouth", MOUTH_CONTACT, True)]
        hole = self._hole(edge)
        if hole is None and self._lined(edge):
            self._notes.append("the mouth has a bag: none was added")
        else:
            self._weld(self._cut_lips(edge) if hole is None else hole, "mouth", MOUTH_CONTACT + 1, True)
            self._notes.append("added: the mouth's bag" + (", behind lips that were cut apart" if hole is None else ""))
        if self._has_loose(edge.mean(0), 26.0):
            self._notes.append("teeth or a tongue are there: none were added")
        else:
            for name in _TEETH:
                self._add_region(self._regions(name))
            self._notes.append("added: teeth, gums and a tongue")

    def add_eyes(self) -> None:
        """Eyeballs where there are none; an eye in one piece with the skin is cut out along the lids."""
        for side in ("left", "right"):
            edge = self._template[_ring("eye", EYE_RIM, side == "left")]
            if self._has_loose(edge.mean(0), 12.0):
                self._notes.append(f"the {side} eye is there: none was added")
                continue
            hole = self._hole(edge)
            self._weld(self._cut_eye(edge) if hole is None else hole, "eye", EYE_RIM + 1, side == "left")
            self._add_region(self._regions(f"eyeball_{side}"))
            self._notes.append(
                f"added: the {side} eye" + ("" if hole is not None else ", where the lids were cut open")
            )

    def _places(self) -> Tensor:
        places = self._cut.at(self._rest)
        for rows, shift in self._shifts:
            places[rows] += shift
        return places

    def _regions(self, name: str) -> Tensor:
        notes = self._shown.annotations
        assert notes is not None
        return notes.regions[name]

    def _has_loose(self, middle: Tensor, reach: float) -> bool:
        """Whether vertices of other parts than the skin lie behind a place on the face."""
        loose = self._rest[self._face.rows[~self._skin[self._face.rows]]] - middle
        near = (loose[:, :2].norm(dim=-1) < reach) & (loose[:, 2] < -2.0) & (loose[:, 2] > -2 * _INSIDE)
        return int(near.sum()) >= _LOOSE

    def _hole(self, edge: Tensor) -> _Loop | None:
        """The border of the skin's hole where the template has the opening ``edge``."""
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
        return None if found is None else _Loop.of(found, self._rest)

    def _lined(self, edge: Tensor) -> bool:
        """Whether something lies behind the lips."""
        line = _halves(edge)
        at = line.at(torch.linspace(-_OF_LIPS, _OF_LIPS, 9, dtype=torch.float64))
        up = torch.tensor([0.0, _LINED, 0.0], dtype=torch.float64)
        origins = torch.cat([at + up, at - up]) + torch.tensor([0.0, 0.0, 60.0])
        ahead = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand_as(origins)
        first = self._caster.cast(origins, ahead).distance
        met = torch.isfinite(first)
        inside = origins[met] + (first[met, None] + 0.3) * ahead[met]
        behind = self._caster.cast(inside, ahead[met]).distance
        return float((behind < _INSIDE).double().mean()) > 0.5

    def _refined(self, distance: Callable[[Tensor], Tensor]) -> None:
        """Cuts long edges near where ``distance`` (W,) of places is 0."""
        for _ in range(_ROUNDS):
            places = self._places()
            far, ends = distance(places), self._cut.edges(self._of_skin())
            one, other = far[ends[:, 0]], far[ends[:, 1]]
            long = (places[ends[:, 0]] - places[ends[:, 1]]).norm(dim=-1) > _FINE
            near = (torch.minimum(one.abs(), other.abs()) < _REACH) | (one * other < 0)
            wanted = ends[long & near & torch.isfinite(one) & torch.isfinite(other)]
            if not len(wanted):
                break
            self._cut = self._cut.split(wanted, torch.full((len(wanted),), 0.5, dtype=torch.float64))

    def _of_skin(self) -> Tensor:
        """Which vertices of the cut mesh lie on the skin."""
        return torch.from_numpy(self._cut.shares @ self._skin.double().numpy()) > 0.99

    def _split(self, distance: Callable[[Tensor], Tensor], usable: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """Cuts triangles where ``distance`` is 0 and places are usable; the new rows, all distances, 0 there."""
        places = self._places()
        far = distance(places)
        far = torch.where(far.abs() < 1e-4, 1e-4, far)
        ends = self._cut.edges(self._of_skin())
        one, other = far[ends[:, 0]], far[ends[:, 1]]
        share = one / (one - other)
        point = places[ends[:, 0]] + share[:, None] * (places[ends[:, 1]] - places[ends[:, 0]])
        kept = (one * other < 0) & torch.isfinite(one + other) & usable(point)
        self._cut = self._cut.split(ends[kept], share[kept])
        new = torch.arange(len(far), len(far) + int(kept.sum()))
        return new, torch.cat([far, torch.zeros(len(new), dtype=far.dtype)])

    def _cut_lips(self, edge: Tensor) -> _Loop:
        """Cuts lips that are one piece along the line between them."""
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
        places = self._places()
        group = self._in_order(new, places[new, 0], places)
        inner = torch.cat(group[1:-1])
        count = self._cut.shares.shape[0]
        copy = torch.arange(count)
        copy[inner] = count + torch.arange(len(inner))
        sum_of = torch.where(torch.isfinite(far), far, 0.0)[self._cut.faces].sum(1)
        self._cut = self._cut.torn(inner, sum_of < 0)
        up = torch.tensor([0.0, _APART / 2, 0.0], dtype=torch.float64)
        self._shifts += [(inner, up), (copy[inner], -up)]
        chain = torch.stack([rows[0] for rows in group])
        return _Loop.of(torch.cat([chain, copy[chain[1:-1]].flip(0)]), self._places())

    def _crease(self, line: _LipLine) -> _LipLine:
        """The deepest place of the face near the template's line between the lips, in each column."""
        share = torch.linspace(-0.95, 0.95, _COLUMNS, dtype=torch.float64)
        at, off = line.at(share), torch.linspace(-_CREASE, _CREASE, 41, dtype=torch.float64)
        origins = (at[:, None] + torch.stack([0 * off, off, 60 + 0 * off], -1)).reshape(-1, 3)
        ahead = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand_as(origins)
        depth = self._caster.cast(origins, ahead).distance.reshape(len(at), -1)
        chord = depth[:, :1] + (depth[:, -1:] - depth[:, :1]) * torch.linspace(0, 1, len(off)).double()
        dip = torch.where(torch.isfinite(depth), depth - chord, 0.0) - _LEAN * off.square()
        moved = off[dip.argmax(1)] * (1 - share.abs() ** 4)
        moved = torch.nn.functional.pad(moved[None], (3, 3), mode="replicate")[0].unfold(0, 7, 1).median(-1).values
        moved = torch.nn.functional.pad(moved[None], (3, 3), mode="replicate")[0].unfold(0, 7, 1).mean(-1)
        return _LipLine(line.ends, share, at + torch.stack([0 * moved, moved, 0 * moved], -1))

    def _cut_eye(self, edge: Tensor) -> _Loop:
        """Cuts the skin out between the lids."""
        depth = edge[:, 2].mean()

        def distance(places: Tensor) -> Tensor:
            near = (places[:, 2] - depth).abs() < _DEPTH
            far = torch.full((len(places),), torch.inf, dtype=torch.float64)
            far[near] = _outside(places[near, :2], edge[:, :2])
            return far

        self._refined(distance)
        new, far = self._split(distance, lambda points: (points[:, 2] - depth).abs() < _DEPTH)
        places = self._places()
        away = places[new, :2] - edge[:, :2].mean(0)
        group = self._in_order(new, torch.atan2(away[:, 1], away[:, 0]), places)
        self._cut = self._cut.without(torch.where(torch.isfinite(far), far, 1e3)[self._cut.faces].sum(1) < 0)
        return _Loop.of(torch.stack([rows[0] for rows in group]), places)

    @staticmethod
    def _in_order(rows: Tensor, key: Tensor, places: Tensor) -> list[Tensor]:
        """Rows in the order of a key, those in one place together."""
        rows = rows[key.argsort()]
        apart = (places[rows].diff(dim=0).norm(dim=-1) > 1e-3).nonzero()[:, 0] + 1
        return list(rows.tensor_split(apart.tolist()))

    def _weld(self, loop: _Loop, name: str, number: int, left: bool) -> None:
        """Joins the template's inside, from a ring on, to an opening's edge by a strip in the skin's colours."""
        places, rings = self._places(), len(topology().rings[name]) - 1
        deep = float(places[loop.vertices, 2].mean()) - 0.5
        while number < rings and float(self._template[_ring(name, number, left), 2].mean()) > deep:
            number += 1
        inner = _Loop.of(_ring(name, number, left), self._template)
        host = torch.stack([loop.vertices[(loop.share - one).abs().argmin()] for one in inner.share])
        rows = self._append(self._template[inner.vertices], None, host)
        triangles = strip(loop.vertices, rows, loop.share, inner.share)
        following = loop.vertices.roll(-1)
        sides = torch.cat([self._cut.faces[:, [0, 1]], self._cut.faces[:, [1, 2]], self._cut.faces[:, [2, 0]]])
        key, count = sides[:, 0] * len(places) + sides[:, 1], len(places)
        along, against = (
            int(torch.isin(one, key).sum())
            for one in (loop.vertices * count + following, following * count + loop.vertices)
        )
        at = int(torch.isin(self._cut.faces, loop.vertices).sum(1).argmax())
        self._strips.append((triangles.flip(1) if along > against else triangles, int(self._cut.source[at])))
        inside = torch.zeros(len(self._template), dtype=torch.bool)
        t = topology()
        for later in range(number, rings + 1):
            inside[_ring(name, later, left)] = True
        cap = t.caps[name].flatten()
        inside[cap if left else t.mirror[cap]] = True
        inside[t.mirror[cap] if name == "mouth" else cap[:0]] = True
        self._add_region(inside, behind=name == "mouth")

    def _add_region(self, inside: Tensor, behind: bool = False) -> None:
        """Adds the triangles of the template whose vertices are all inside, with their places on the page."""
        mesh = self._shown
        assert mesh.uvs is not None
        assert mesh.uv_faces is not None
        kept = inside[mesh.faces].all(1)
        pairs = torch.stack([mesh.faces[kept], mesh.uv_faces[kept]], -1).reshape(-1, 2)
        own, of = pairs.unique(dim=0, return_inverse=True)
        places = self._template[own[:, 0]]
        rows = self._append(
            self._behind_skin(places) if behind else places,
            mesh.uvs[own[:, 1]].double(),
            torch.full((len(own),), self._host),
        )
        self._faces.append(rows[of].reshape(-1, 3))

    def _behind_skin(self, places: Tensor) -> Tensor:
        """Places (P,3), those that stand before the skin behind it: some chins are nearer to the mouth than others."""
        far = places + torch.tensor([0.0, 0.0, _INSIDE], dtype=torch.float64)
        ahead = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand_as(far)
        before = self._caster.cast(far, ahead).distance - _INSIDE  # negative where the skin stands before a place
        moved = places.clone()
        moved[:, 2] -= torch.where(before < _OUT, (before + _THICK).clamp(min=0.0), 0.0)
        return moved

    def _append(self, places: Tensor, uvs: Tensor | None, host: Tensor) -> Tensor:
        self._new.append((places, uvs, host))
        rows = -1 - torch.arange(self._count, self._count + len(places))
        self._count += len(places)
        return rows

    def finished(self) -> AddedParts:
        """All that was added, by the file's blocks: a new vertex is of the block that those around it are of."""
        page = self._shown.texture
        assert page is not None
        if not self._new:
            return AddedParts((), page, tuple(self._notes))
        shares, of = self._cut.shares, self._character.block
        whole, old = shares.shape[0], len(of)
        of = of[torch.from_numpy(shares.indices[shares.indptr[:-1]].astype(np.int64))]
        places = torch.cat([self._places(), *(one[0] for one in self._new)])
        host = torch.cat([one[2] for one in self._new])
        positive = lambda faces: torch.where(faces < 0, whole - 1 - faces, faces)  # noqa: E731
        strips, parts = [positive(one) for one, _ in self._strips], positive(torch.cat(self._faces))
        everything = torch.cat([self._cut.faces, *strips, parts])
        normals = vertex_normals(places, everything)
        out = self._face.found.pose, self._registration.pose
        scene = out[0].apply(out[1].apply(places))[0]
        turned = (normals @ out[1].rotation[0].T) @ out[0].rotation[0].T
        main = int(of[self._host])
        host[of[host] != main] = self._host
        uvs = [
            torch.full((len(one[0]), 2), torch.nan, dtype=torch.float64) if one[1] is None else one[1]
            for one in self._new
        ]
        source = torch.cat(
            [
                self._cut.source,
                *(torch.full((len(one),), at) for one, (_, at) in zip(strips, self._strips, strict=True)),
            ]
        )
        faces = torch.cat([self._cut.faces, *strips])
        blocks = []
        for number, block in enumerate(self._character.blocks):
            cut = (of[old:] == number).nonzero()[:, 0] + old
            mine = number == main
            rows = torch.cat([cut, whole + torch.arange(self._count)]) if mine else cut
            if not len(rows):
                continue
            local = torch.full((len(places),), -1)
            local[block.rows] = torch.arange(block.rows.stop - block.rows.start)
            local[rows] = block.rows.stop - block.rows.start + torch.arange(len(rows))
            by = torch.cat([cut, host]) if mine else cut
            own, start = {}, self._character.first_triangles[number]
            for primitive, count in zip(block.primitives, block.triangles, strict=True):
                own[primitive] = local[faces[(source >= start) & (source < start + count)]].numpy()
                start += count
            given = torch.cat([torch.full((len(cut), 2), torch.nan).double(), *uvs]) if mine else None
            blocks.append(
                ExtendedBlock(
                    number,
                    shares[by.numpy()][:, block.rows],
                    scene[rows].numpy(),
                    turned[rows].numpy(),
                    own,
                    (torch.full((len(rows), 2), torch.nan) if given is None else given).numpy(),
                    local[parts].numpy() if mine else None,
                )
            )
        return AddedParts(tuple(blocks), page, tuple(self._notes))


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
    loop = _Loop.of(torch.arange(len(edge)), edge)
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
