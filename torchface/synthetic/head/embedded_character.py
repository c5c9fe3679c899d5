"""The performer as a character to be shown: skin maps, teeth, gums, tongue, hair, and all 52 of ARKit's shapes."""

from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.errors import TopologyError
from torchface.geometry.meshes.normal_maps import SurfaceMaps
from torchface.geometry.similarity import similarity_transform
from torchface.mesh import Annotations, Mesh
from torchface.rig import BlendshapeRig
from torchface.synthetic.head.hair import GrownPart, brow_hairs, lashes, scalp_hair
from torchface.synthetic.head.hair_locks import hair_locks
from torchface.synthetic.head.handle_weights import handle_weights
from torchface.synthetic.head.head_annotations import head_annotations
from torchface.synthetic.head.identity import sculpted_vertices
from torchface.synthetic.head.performer import performer
from torchface.synthetic.head.shirt import about_neck, shirt
from torchface.synthetic.head.skin_maps import Look, skin_maps
from torchface.synthetic.head.teeth_and_tongue import HeadPart, mouth_parts, tongue_out
from torchface.synthetic.head.topology import MOUTH_CONTACT, topology
from torchface.synthetic.head.uv_layout import unwrapping

_OPEN_FOR_TONGUE = 0.33  # of jawOpen, without which the tongue would go through the teeth
_WITH_THE_JAW = ("teeth_lower", "gums_lower", "tongue")
_STILL = 0.01  # millimetres
_FRONT, _BESIDE, _COVER = 15.0, 6, 2.5  # millimetres to a side, vertices, millimetres of flesh before gums
_CAP = {"short": 0.6, "long": 0.18, "tied": 0.2}


@dataclass(frozen=True, eq=False)
class Character:
    """A rig to be shown, and how its skin shades.

    Args:
        rig: its neutral's first vertices are the performer's; then come teeth, gums, tongue and hair.
        surface: normals and roughness, in the layout of the neutral's texture; ``save_rig`` takes them as detail.
    """

    rig: BlendshapeRig
    surface: SurfaceMaps


def character(
    rig: BlendshapeRig | None = None, look: Look | None = None, size: int = 2048, skin: Tensor | None = None
) -> Character:
    """A head of the performer's topology with all that belongs to a face.

    Args:
        rig: ``performer()`` or another rig of its topology, whose shapes stay as they are.
        look: colours; a fair man's of 30 if absent.
        size: texels of a side of the images.
        skin: see ``skin_maps``; its brows are the only ones then.

    Returns:
        The rig's shapes, in which the lower teeth go with the jaw and hair with the skin, and ``tongueOut`` where the
        rig has ``jawOpen``.

    Raises:
        TopologyError: the rig has another topology.

    Example:
        >>> from torchface.synthetic import performer
        >>> actor = performer(texture=False)
        >>> shown = character(actor, size=64).rig
        >>> shown.names == (*actor.names, "tongueOut"), sorted(shown.neutral.annotations.regions)[-3:]
        (True, ['teeth_upper', 'tongue', 'upper_lip'])
    """
    rig = performer(texture=False) if rig is None else rig
    count = topology().count
    if not is_performers(rig):
        raise TopologyError(f"character: found {rig.neutral}, expected the performer's topology of {count} vertices")
    rest, moved = rig.vertices.double(), rig.deltas.double()
    mouth = _InTheMouth(rig)
    pieces = {"skin": (rest, moved)}
    parts: dict[str, HeadPart] = {}
    for name, part in mouth_parts().items():
        parts[name] = part
        pieces[name] = mouth.placed(part.vertices, name in _WITH_THE_JAW)
    look = look or Look()
    grown = {"lash_hair": lashes()} | ({"brow_hair": brow_hairs()} if skin is None else {})
    if look.haircut is not None:
        grown = {"hair": scalp_hair(_CAP[look.haircut]), "hair_locks": hair_locks(look.haircut, look.fringe), **grown}
    for name, piece in grown.items():
        parts[name] = piece.part
        pieces[name] = _grown(piece, rest, moved)
    parts["shirt"] = shirt()
    pieces["shirt"] = about_neck(shirt().vertices, rest), torch.zeros(len(moved), len(shirt().vertices), 3).double()
    vertices = torch.cat([points for points, _ in pieces.values()])
    deltas = torch.cat([motion for _, motion in pieces.values()], 1)
    deltas[deltas.norm(dim=-1) < _STILL] = 0
    names = rig.names
    if "jawOpen" in names and "tongueOut" not in names:
        out = _OPEN_FOR_TONGUE * deltas[names.index("jawOpen")]
        start = sum(len(pieces[name][0]) for name in list(pieces)[: list(pieces).index("tongue")])
        tongue = slice(start, start + len(pieces["tongue"][0]))
        out[tongue] = mouth.place(tongue_out()) - vertices[tongue]
        deltas, names = torch.cat([deltas, out[None]]), (*names, "tongueOut")
    maps = skin_maps(look, size, skin)
    neutral = _mesh(rig.neutral, vertices, parts, maps.color)
    return Character(BlendshapeRig(neutral, deltas.float(), names), maps.surface)


def shown_rig(rig: BlendshapeRig, size: int = 1024) -> BlendshapeRig:
    """The character of a performer's rig, with the rig's shapes alone; a rig of another topology as it is."""
    return character(rig, size=size).rig.select(rig.names) if is_performers(rig) else rig


def is_performers(rig: BlendshapeRig) -> bool:
    """Whether a rig has the performer's topology, which ``character`` needs."""
    quads = rig.neutral.polygons
    return len(rig.vertices) == topology().count and quads is not None and torch.equal(quads, topology().quads)


def _mesh(skin: Mesh, vertices: Tensor, parts: dict[str, HeadPart], color: Tensor) -> Mesh:
    """The mesh of skin and parts, with annotations of both."""
    flat, notes = unwrapping(), skin.annotations or Annotations()
    quads, uvs, uv_quads = [topology().quads], [flat.uvs], [flat.quads]
    masks = {name: torch.zeros(len(vertices), dtype=torch.bool) for name in (*notes.regions, *parts)}
    for name, mask in notes.regions.items():
        masks[name][: len(mask)] = mask
    start, corner = len(skin.vertices), len(flat.uvs)
    for name, part in parts.items():
        end = start + len(part.vertices)
        masks[name][start:end] = True
        own, index = torch.unique(part.uvs.reshape(-1, 2), dim=0, return_inverse=True)
        quads.append(part.quads + start)
        uvs.append(own)
        uv_quads.append(index.view(-1, 4) + corner)
        start, corner = end, corner + len(own)
    mean = torch.cat([sculpted_vertices(), *(part.vertices for part in parts.values())])
    mirror = torch.from_numpy(cKDTree(mean.numpy()).query(mean.numpy() * [-1, 1, 1])[1]).long()
    mirror[: topology().count] = topology().mirror
    return Mesh.from_polygons(
        vertices.float(),
        torch.cat(quads),
        torch.cat(uvs).float(),
        torch.cat(uv_quads),
        annotations=Annotations(notes.landmarks, masks, mirror, notes.contacts),
        texture=color,
    )


class _InTheMouth:
    """Where parts of the sculpture's mouth lie in another head, and how its jaw moves them."""

    def __init__(self, rig: BlendshapeRig) -> None:
        line = topology().rings["mouth"][MOUTH_CONTACT]
        skin, mean = rig.vertices.double(), sculpted_vertices()
        self._from, self._to = mean[line[[0, 26]]].mean(0), skin[line[[0, 26]]].mean(0)
        wide = float(skin[line[13], 0] / mean[line[13], 0])
        self._scale = torch.tensor([wide, 1.0, 1.0], dtype=torch.float64)
        self._to = self._to - torch.tensor([0.0, 0.0, self._in_front_of(skin)], dtype=torch.float64)
        weights = handle_weights()
        bone = (weights.jaw > 0.9999) & (weights.lip_ring < 0)
        rest, count = skin[bone], len(rig.names)
        posed = rest + rig.deltas.double()[:, bone]
        posed[[not name.startswith("jaw") for name in rig.names]] = rest
        self._jaw = similarity_transform(rest.expand(count, -1, -1), posed, scale=False)

    def place(self, points: Tensor) -> Tensor:
        """Points (P,3) of the sculpture in this one."""
        return self._to + (points - self._from) * self._scale

    def _in_front_of(self, skin: Tensor) -> float:
        """Millimetres by which gums lie too far forward: they would come through lips or chin of skin (V,3)."""
        regions = head_annotations().regions
        outside = skin[torch.stack([regions[name] for name in ("chin", "upper_lip", "lower_lip")]).any(0)]
        gums = torch.cat([self.place(mouth_parts()[name].vertices) for name in ("gums_upper", "gums_lower")])
        gums = gums[gums[:, 0].abs() < _FRONT]
        beside = torch.from_numpy(cKDTree(outside[:, :2].numpy()).query(gums[:, :2].numpy(), _BESIDE)[1])
        cover = outside[beside][..., 2].amax(1) - gums[:, 2]  # of the vertices beside, inner ones lie further back
        return max(0.0, _COVER - float(cover.min()))

    def placed(self, points: Tensor, with_jaw: bool) -> tuple[Tensor, Tensor]:
        """A part (P,3) in this head and its motion in each shape, (N,P,3)."""
        here = self.place(points)
        moved = self._jaw.apply(here)
        return here, moved - here if with_jaw else torch.zeros_like(moved)


def _grown(grown: GrownPart, skin: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
    """A part that skin carries on this head, and its motion in each shape."""
    host = lambda values: (values[..., grown.hosts, :] * grown.weights[..., None]).sum(-2)  # noqa: E731
    root = host(sculpted_vertices())
    offset = grown.part.vertices - root
    here = host(skin)
    motion = host(moved)
    if not grown.turns:  # wider on a wider head
        offset = offset * ((here.amax(0) - here.amin(0)) / (root.amax(0) - root.amin(0)))
    else:
        motion = motion + _turned(here, motion, offset, skin)
    return here + offset, motion


def _turned(roots: Tensor, motion: Tensor, offset: Tensor, skin: Tensor) -> Tensor:
    """What offsets (V,3) change by where their roots (V,3) go round the nearer eye by a motion (N,V,3)."""
    centre = torch.zeros_like(roots)
    for side in (0, 1):
        ball = topology().eyeball.flatten()
        middle = skin[ball if side == 0 else topology().mirror[ball]]
        here = roots[:, 0] > 0 if side == 0 else roots[:, 0] <= 0
        centre[here] = (middle.amin(0) + middle.amax(0)) / 2
    a = torch.nn.functional.normalize(roots - centre, dim=-1).expand_as(motion)
    b = torch.nn.functional.normalize(roots + motion - centre, dim=-1)
    # The smallest rotation of a onto b, applied to the offset.
    axis = torch.linalg.cross(a, b)
    cosine = (a * b).sum(-1, keepdim=True)
    spun = torch.linalg.cross(axis, offset.expand_as(axis))
    return spun + torch.linalg.cross(axis, spun) / (1 + cosine)
