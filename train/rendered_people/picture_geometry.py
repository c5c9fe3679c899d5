"""One picture's surface: a posed head with hair, teeth, shoulders; and where an annotator would put the landmarks."""

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from torchface.geometry.meshes.operators import vertex_normals
from torchface.landmarks.images.ibug_68 import as_annotated

from .head_kind import GUMS, SOCKET, TEETH, DrawnHead, HeadKind
from .looks import Looks
from .portrait_geometry import contour_lines, curtain, hair_share_at, lumps, shoulders, teeth, with_visible_jaw
from .skin_paint import brow_edge_height

CURTAIN, CLOTHES = 10, 11
"""Materials beside those of the head."""
_SHUT = 1.0  # millimetres between lips
_BROW_X = (10.5, 21.0, 32.5, 43.0, 51.5)  # of a brow's five landmarks on the mean head, from its inner end


@dataclass(frozen=True, eq=False)
class Surface:
    """All that a camera can see, as one mesh; the head's vertices and faces come first."""

    vertices: Tensor  # (V,3), millimetres
    faces: Tensor  # (F,3)
    material: Tensor  # of each face, (F,)
    hair: Tensor  # share of hair at the head's vertices, (V',)


def surface(kind: HeadKind, head: DrawnHead, posed: Tensor, looks: Looks, generator: torch.Generator) -> Surface:
    """Puts hair, teeth where the head has none, and shoulders on a posed head (V,3)."""
    rest, posed = head.rest.double(), posed.double()
    hair = hair_share_at(kind.canonical, kind.marks[:, 7] > 0.5, looks.hairdo.hairline) * kind.outer
    lift = looks.hairdo.thickness * hair * (1.0 + 0.4 * lumps(kind.canonical, generator)).clamp(min=0.1)
    lifted = posed + lift[:, None] * vertex_normals(posed, kind.faces)
    marks = posed[kind.landmarks]
    shows = torch.ones(len(kind.faces), dtype=torch.bool)
    if float((marks[61:64] - marks[[67, 66, 65]]).norm(dim=1).max()) < _SHUT:  # what lies behind shut lips costs time
        shows = (kind.material != TEETH) & (kind.material != GUMS) & (kind.material != SOCKET)
    pieces = [(lifted, kind.faces[shows], kind.material[shows])]
    if looks.hairdo.curtain > 0:
        pieces.append(_piece(*curtain(rest, looks.hairdo, generator), CURTAIN))
    if not bool((kind.material == TEETH).any()):
        pieces += [_piece(*row, TEETH) for row in teeth(rest, posed, kind.faces)]
    pieces.append(_piece(*shoulders(rest, kind.landmarks), CLOTHES))
    sizes = [len(vertices) for vertices, _, _ in pieces]
    first = [sum(sizes[:i]) for i in range(len(sizes))]
    return Surface(
        torch.cat([vertices for vertices, _, _ in pieces]),
        torch.cat([faces + start for (_, faces, _), start in zip(pieces, first, strict=True)]),
        torch.cat([material for _, _, material in pieces]),
        (hair * (looks.hairdo.thickness > 0)).float(),
    )


def _piece(vertices: Tensor, faces: Tensor, material: int) -> tuple[Tensor, Tensor, Tensor]:
    return vertices, faces, torch.full((len(faces),), material)


def annotated(kind: HeadKind, pixels: Tensor, looks: Looks) -> Tensor:
    """The 68 landmarks (68,2) as an annotator sees them: brows, lower or higher as looks say, along their upper
    edge, the jaw where the face ends; of pixels (V,2)."""
    seen = as_annotated(pixels[kind.landmarks])
    rows, weights = _brow_spots(kind, looks)
    seen[17:27] = (pixels[rows] * weights[..., None].to(pixels)).sum(1)
    return with_visible_jaw(seen, pixels, _contours(id(kind), kind))


@lru_cache(maxsize=4)
def _contours(_: int, kind: HeadKind) -> tuple[Tensor, ...]:
    return contour_lines(kind.canonical, kind.landmarks, kind.outer)


def _brow_spots(kind: HeadKind, looks: Looks) -> tuple[Tensor, Tensor]:
    """Vertices (10,3) and weights (10,3) that give the brows' upper edges, in the order of landmarks 17 to 26."""
    x = torch.tensor(_BROW_X)
    left = torch.stack([x, brow_edge_height(x, looks, kind.brow_lift)], dim=1)
    spots = torch.cat([left.flip(0) * torch.tensor([-1.0, 1.0]), left]).double()
    front = (kind.outer & (kind.canonical[:, 2] > 40)).nonzero()[:, 0]
    distance, rows = torch.cdist(spots, kind.canonical[front, :2]).topk(3, dim=1, largest=False)
    weights = 1 / distance.clamp(min=0.1)
    return front[rows], weights / weights.sum(1, keepdim=True)
