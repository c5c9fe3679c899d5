"""The inside of a mouth and the eyes that a character's mesh lacks, taken from the template on its face."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchface.geometry.meshes.cutting import strip
from torchface.geometry.meshes.operators import vertex_normals
from torchface.io.gltf.character_scene import Character
from torchface.io.gltf.part_insertion import ExtendedBlock
from torchface.modeling.rigging.other_topology import TemplatePlaces, fitted_template
from torchface.registration import Registration
from torchface.rig import BlendshapeRig
from torchface.synthetic import character as shown_character
from torchface.synthetic.head.topology import EYE_RIM, MOUTH_CONTACT, topology
from torchface.workflows.rig.character_face import CharacterFace
from torchface.workflows.rig.face_openings import INSIDE, Loop, OpenedFace

_TEETH = ("teeth_upper", "gums_upper", "teeth_lower", "gums_lower", "tongue")
_PAGE = 1024  # texels of a side of the parts' image
_THICK, _OUT = 2.0, 15.0  # millimetres: of the skin before a mouth's bag, and how far it may have come through
_LOOSE = 12  # vertices of loose parts from which a mouth has teeth and an eye an eyeball


@dataclass(frozen=True, eq=False)
class AddedParts:
    """What is added to a character's file, and what is said of it."""

    blocks: tuple[ExtendedBlock, ...]  # of the file, with their new vertices; none where nothing was missing
    page: Tensor  # image of the parts, (3,H,W) in [0,1]
    notes: tuple[str, ...]  # for people to read
    lips_cut: bool  # lips that were one piece are two
    # which places of the template the vertices of the mouth's edge and bag follow, by the file's blocks: its number,
    # and their rows there
    followed: tuple[tuple[int, TemplatePlaces], ...] = ()

    def followed_on(self, character: Character, face: CharacterFace) -> TemplatePlaces:
        """The same by vertices of the head, once the parts are in the file."""
        place = torch.full((len(character.vertices),), -1)
        place[face.rows] = torch.arange(len(face.rows))
        rows = torch.cat([place[character.blocks[block].rows][one.rows] for block, one in self.followed])
        known = rows >= 0
        corner, share = (torch.cat([getattr(one, key) for _, one in self.followed]) for key in ("corner", "share"))
        return TemplatePlaces(rows[known], corner[known], share[known])


def added_parts(
    character: Character,
    face: CharacterFace,
    template: BlendshapeRig,
    registration: Registration,
    wanted: tuple[bool, bool],
) -> AddedParts:
    """The ``wanted`` parts, the inside of the mouth and eyes, that a character lacks, by the template registered to
    its skin."""
    fitting = _Fitting(character, face, template, registration)
    if wanted[0]:
        fitting.add_mouth()
    if wanted[1]:
        fitting.add_eyes()
    return fitting.finished()


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
        self._skin = torch.zeros(len(self._rest), dtype=torch.bool)
        self._skin[face.skin_rows] = True
        self._opened = OpenedFace(self._rest, character.faces, self._skin)
        nose = self._template[self._shown.landmarks[30]]
        self._host = int(face.skin_rows[(self._rest[face.skin_rows] - nose).norm(dim=-1).argmin()])
        self._count = 0
        self._new: list[tuple[Tensor, Tensor | None, Tensor]] = []  # places, coordinates, hosts
        self._strips: list[tuple[Tensor, int]] = []  # triangles, and one of the file's at their edge
        self._faces: list[Tensor] = []
        self._notes: list[str] = []
        self._lips_cut = False
        self._followed: list[TemplatePlaces] = []  # rows as in the faces

    def add_mouth(self) -> None:
        """Bag, gums, teeth and tongue where the mouth has none; lips that are one piece are cut apart."""
        edge = self._template[_ring("mouth", MOUTH_CONTACT, True)]
        hole = self._opened.hole(edge)
        if hole is None and self._opened.lined(edge):
            self._notes.append("the mouth has a bag: none was added")
        else:
            self._lips_cut = hole is None
            loop = self._opened.cut_lips(edge) if hole is None else hole
            self._weld(loop, "mouth", MOUTH_CONTACT + 1, True)
            ring = self._loop("mouth", MOUTH_CONTACT, True)
            self._followed.append(TemplatePlaces(loop.vertices, *ring.between(loop.share)))
            self._notes.append("added: the mouth's bag" + ", behind lips that were cut apart" * self._lips_cut)
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
            hole = self._opened.hole(edge)
            self._weld(self._opened.cut_eye(edge) if hole is None else hole, "eye", EYE_RIM + 1, side == "left")
            self._add_region(self._regions(f"eyeball_{side}"))
            self._notes.append(
                f"added: the {side} eye" + ("" if hole is not None else ", where the lids were cut open")
            )

    def _regions(self, name: str) -> Tensor:
        notes = self._shown.annotations
        assert notes is not None
        return notes.regions[name]

    def _has_loose(self, middle: Tensor, reach: float) -> bool:
        """Whether vertices of other parts than the skin lie behind a place on the face."""
        loose = self._rest[self._face.rows[~self._skin[self._face.rows]]] - middle
        near = (loose[:, :2].norm(dim=-1) < reach) & (loose[:, 2] < -2.0) & (loose[:, 2] > -2 * INSIDE)
        return int(near.sum()) >= _LOOSE

    def _loop(self, name: str, number: int, left: bool) -> Loop:
        """A ring of the template as it lies on the face, where the edges of touching lips may have crossed."""
        ring = _ring(name, number, left)
        return Loop.of(ring, self._template, int(ring[0]) if name == "mouth" else None)

    def _weld(self, loop: Loop, name: str, number: int, left: bool) -> None:
        """Joins the template's inside, from a ring on, to an opening's edge by a strip in the skin's colours."""
        places, rings = self._opened.places(), len(topology().rings[name]) - 1
        deep = float(places[loop.vertices, 2].mean()) - 0.5
        while number < rings and float(self._template[_ring(name, number, left), 2].mean()) > deep:
            number += 1
        inner = self._loop(name, number, left)
        host = torch.stack([loop.vertices[(loop.share - one).abs().argmin()] for one in inner.share])
        rows = self._append(self._template[inner.vertices], None, host)
        if name == "mouth":
            self._followed.append(TemplatePlaces.at(rows, inner.vertices))
        triangles = strip(loop.vertices, rows, loop.share, inner.share)
        following = loop.vertices.roll(-1)
        faces = self._opened.cut.faces
        sides = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        key, count = sides[:, 0] * len(places) + sides[:, 1], len(places)
        along, against = (
            int(torch.isin(one, key).sum())
            for one in (loop.vertices * count + following, following * count + loop.vertices)
        )
        at = int(torch.isin(self._opened.cut.faces, loop.vertices).sum(1).argmax())
        self._strips.append((triangles.flip(1) if along > against else triangles, int(self._opened.cut.source[at])))
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
        if behind:
            self._followed.append(TemplatePlaces.at(rows, own[:, 0]))
        self._faces.append(rows[of].reshape(-1, 3))

    def _behind_skin(self, places: Tensor) -> Tensor:
        """Places (P,3), those that stand before the skin behind it: some chins are nearer to the mouth than others."""
        far = places + torch.tensor([0.0, 0.0, INSIDE], dtype=torch.float64)
        ahead = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand_as(far)
        before = self._opened.caster.cast(far, ahead).distance - INSIDE  # negative where the skin stands before a place
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
            return AddedParts((), page, tuple(self._notes), False)
        shares, of = self._opened.cut.shares, self._character.block
        whole, old = shares.shape[0], len(of)
        of = of[torch.from_numpy(shares.indices[shares.indptr[:-1]].astype(np.int64))]
        places = torch.cat([self._opened.places(), *(one[0] for one in self._new)])
        host = torch.cat([one[2] for one in self._new])
        positive = lambda faces: torch.where(faces < 0, whole - 1 - faces, faces)  # noqa: E731
        strips, parts = [positive(one) for one, _ in self._strips], positive(torch.cat(self._faces))
        everything = torch.cat([self._opened.cut.faces, *strips, parts])
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
                self._opened.cut.source,
                *(torch.full((len(one),), at) for one, (_, at) in zip(strips, self._strips, strict=True)),
            ]
        )
        faces = torch.cat([self._opened.cut.faces, *strips])
        blocks, followed = [], []
        known = [replace(one, rows=positive(one.rows)) for one in self._followed]
        for number, block in enumerate(self._character.blocks):
            cut = (of[old:] == number).nonzero()[:, 0] + old
            mine = number == main
            rows = torch.cat([cut, whole + torch.arange(self._count)]) if mine else cut
            if not len(rows):
                continue
            local = torch.full((len(places),), -1)
            local[block.rows] = torch.arange(block.rows.stop - block.rows.start)
            local[rows] = block.rows.stop - block.rows.start + torch.arange(len(rows))
            for one in known:
                here = local[one.rows] >= 0
                followed.append((number, TemplatePlaces(local[one.rows][here], one.corner[here], one.share[here])))
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
        return AddedParts(tuple(blocks), page, tuple(self._notes), self._lips_cut, tuple(followed))
