"""Mask of a photographed head's skin: neither hair nor clothes, nor what stands behind a misplaced ear."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from torchface.geometry.meshes.vertex_graph import VertexGraph
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.mesh import Mesh
from torchface.modeling.photographs.landmark_view import JAW, LANDMARKS

_FEATURES = ("brows", "eyes", "lips", "teeth")
_NOSE = -0.45
_NEAR_FEATURES, _SURELY_SKIN = 0.12, 0.75
_NECK, _BEHIND = (0.05, 0.35), (0.05, 0.30)
_FOREHEAD = 0.15
_BROW, _FRINGE = 0.13, (0.16, 0.30)
"""In distances between the eyes' outer corners, but for the second row: shares of the way to the face's outline."""

_HANGS = 0.1, 0.5  # shares of hair over the brows, and about the mouth, between which a fringe and a beard begin
_STRAND, _HANGING, _SHADED = 0.2, 40, 6  # share of hair; edges that it hangs down, that it shades
_CHIN, _FULLEST = 0.2, 0.95  # of the same distances, beside the middle and behind the chin; quantile

_FRAMES = (0.05, 0.08, 0.36, 0.44)  # from the eyes' landmarks
_LID, _LID_BROW, _RIM = (0.01, 0.03, 0.10, 0.15), (0.06, 0.10), (0.02, 0.05)
"""In the same distances: from the upper lid's edge, from a brow, and from what is no skin beside it."""
_SHADOW, _DOUBT = 5, 11  # pixels of the network's crop: across which hair covers skin, and may darken it


@dataclass(frozen=True, eq=False)
class FacePlaces:
    """Where vertices lie beside a face's landmarks; lengths in distances between the outer corners of the eyes."""

    # the way from the face's middle to its outline (jaw, and over the brows), seen from the front, (V,); 1 is on it
    out: Tensor
    beyond: Tensor  # length beyond that outline, (V,); negative inside
    place: Tensor  # right, up and forward of the point between the eyes, (V,3)
    features: Tensor  # near eyes, brows, nostrils or mouth, which are no skin and yet the person's, (V,) bool
    behind: Tensor  # length behind the ears' landmarks, (V,)
    chin: Tensor  # the chin's place, (3,)
    brow: Tensor  # near a brow's landmarks, (V,) bool
    lids: Tensor  # how much each is of an upper lid, which open eyes fold away, (V,) in [0,1]
    frames: Tensor  # how much each lies where spectacles have frames, and not on eyes or brows, (V,) in [0,1]
    rim: Tensor  # how far each is off eyes, nostrils and lips, (V,) in [0,1]
    brows: float  # how high the brows are
    ears: float  # how far forward the ears' landmarks lie

    @property
    def cheeks(self) -> Tensor:
        """Vertices that are surely skin, unless something hides them: no feature, and below the brows, (V,) bool."""
        return (self.out < _SURELY_SKIN) & ~self.features & (self.place[:, 1] < self.brows)

    @staticmethod
    def of(mesh: Mesh) -> "FacePlaces":
        """Those of a mesh with the 68 landmarks."""
        vertices = mesh.vertices.detach().cpu().double()
        marks = vertices[mesh.landmarks.cpu()]
        unit = (marks[45] - marks[36]).norm()
        across = (marks[45] - marks[36]) / unit
        up = marks[27] - marks[8]
        up = torch.nn.functional.normalize(up - (up @ across) * across, dim=0)
        frame = torch.stack([across, up, torch.linalg.cross(across, up)]) / unit
        place, at = (vertices - marks[[36, 45]].mean(0)) @ frame.T, (marks - marks[[36, 45]].mean(0)) @ frame.T
        brow = at[17:27].flip(0).clone()
        brow[:, 1] += _FOREHEAD
        outline = torch.cat([at[:JAW], brow])[:, :2]
        middle = at[[27, 33, 36, 45, 48, 54], :2].mean(0)
        offsets = place[:, :2] - middle
        reach = _radius(outline - middle, torch.atan2(offsets[:, 1], offsets[:, 0]))
        length = offsets.norm(dim=1)
        features = torch.cdist(place, torch.cat([at[JAW:27], at[31:LANDMARKS]])).amin(1) < _NEAR_FEATURES
        from_brow = torch.cdist(place, at[JAW:27]).amin(1)
        ears, brows = float(at[[0, 16], 2].mean()), float(at[17:27, 1].mean())
        from_eyes = torch.cdist(place, at[36:48]).amin(1)
        frames = ramp(from_eyes, *_FRAMES[:2]) * (1 - ramp(from_eyes, *_FRAMES[2:])) * ramp(from_brow, *_LID_BROW)
        beside = torch.cdist(place, at[[31, 32, 33, 34, 35, *range(36, LANDMARKS)]]).amin(1)
        return FacePlaces(
            length / reach, length - reach, place, features, ears - place[:, 2], at[8], from_brow < _BROW,
            _upper_lids(place, at) * ramp(from_brow, *_LID_BROW), frames, ramp(beside, *_RIM), brows, ears,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class ShownParts:
    """What a photograph shows at each vertex, (V,) in [0,1] each; of hidden vertices it says nothing."""

    own: Tensor  # the person's skin, brows, eyes, lips, teeth, beard: all that is painted on the head
    bare: Tensor  # skin alone
    hair: Tensor  # hair, the beard not
    doubt: Tensor  # how much skin there may lie in the shadow of hair

    @staticmethod
    def of(parts: FaceParts | None, pixels: Tensor, places: FacePlaces, graph: VertexGraph) -> "ShownParts":
        """At the places of the vertices in the photograph, (V,2) pixels.

        Without parts all inside the face's outline is the person's. Far below the chin and behind the ears nothing is.
        """
        below = places.beyond * (places.place[:, 1] < 0.5 * places.chin[1])
        falloff = (1 - ramp(below, *_NECK)) * (1 - ramp(places.behind, *_BEHIND))
        if parts is None:
            inside = (places.out < 1).double() * falloff
            return ShownParts(inside, inside, torch.zeros_like(inside), torch.zeros_like(inside))
        bare, features, hair = (
            parts.at(pixels, *names).double().nan_to_num(0.0) for names in (("skin",), _FEATURES, ("hair",))
        )
        # Thick brows and beards look like hair; where hair hangs over the brows too there is a fringe.
        above = places.place[:, 1] - places.brows
        fringe = ramp(
            hair[(above > _FRINGE[0]) & (above < _FRINGE[1]) & (places.out < 1)].mean().nan_to_num(1.0), *_HANGS
        )
        # A beard grows on the chin or over the lip too: hair that hangs beside a bare mouth comes from the head.
        # It lies before neck and gums too, where a turned head hides them.
        right, up, front = places.place.T
        mouth = hair[(right.abs() < _CHIN) & (up < _NOSE) & (places.out < 1) & (front > places.chin[2] - _CHIN)]
        beard = ramp(mouth.quantile(_FULLEST), *_HANGS)
        grown = hair * ramp(_NOSE - up, 0.0, 0.1) * (places.out < 1) * beard
        grown = torch.maximum(grown, hair * places.brow * (1 - fringe))
        # What looks like hair below the brows and does not hang from the head is a fold, stubble, a moustache.
        low = (up < places.brows) & (places.out < 1)
        strand = hair > _STRAND
        hangs = graph.reached(strand & ~low, strand, _HANGING)
        grown = torch.maximum(grown, hair * (low & ~hangs))
        # What lies beside hair is in its shadow, and between strands of a fringe is no skin to be painted.
        over = torch.where(up > _NOSE, 1.0, 1 - beard)
        over = over * (~low | graph.reached(hangs, low, _SHADED))
        strands = parts.of("hair")[None]
        wide = replace(parts, shares=max_pool2d(strands, _SHADOW, 1, _SHADOW // 2).expand_as(parts.shares))
        shaded = wide.at(pixels, "hair").double().nan_to_num(0.0) * over * (1 - (1 - fringe) * places.brow)
        wider = avg_pool2d(max_pool2d(strands, _DOUBT, 1, _DOUBT // 2), _DOUBT, 1, _DOUBT // 2)
        doubt = replace(parts, shares=wider.expand_as(parts.shares)).at(pixels, "hair").double().nan_to_num(0.0) * over
        seen = (bare * (1 - shaded) + features * (1 - shaded * (1 - features)) + grown) * falloff
        own = graph.smoothed(seen[:, None], torch.ones_like(bare), 2)[:, 0]
        return ShownParts(own, bare * falloff, hair - grown, doubt)


def _upper_lids(place: Tensor, at: Tensor) -> Tensor:
    """How much places (V,3) lie over the upper lids' edges, which landmarks (68,3) give, and not on them, (V,)."""
    share = torch.linspace(0, 1, 9, dtype=torch.float64)[:, None]
    edges = [at[k] + share * (at[k + 1] - at[k]) for k in (36, 37, 38, 42, 43, 44)]
    edge = torch.cat(edges)
    distance, nearest = torch.cdist(place, edge).min(1)
    over = distance * (place[:, 1] > edge[nearest, 1])
    return ramp(over, *_LID[:2]) * (1 - ramp(over, *_LID[2:]))


def _radius(outline: Tensor, angle: Tensor) -> Tensor:
    """How far a star-shaped outline (P,2) about the origin reaches in directions (V,)."""
    angles = torch.atan2(outline[:, 1], outline[:, 0])
    order = angles.argsort()
    angles, reach = angles[order], outline.norm(dim=1)[order]
    angles = torch.cat([angles[-1:] - 2 * torch.pi, angles, angles[:1] + 2 * torch.pi])
    reach = torch.cat([reach[-1:], reach, reach[:1]])
    after = torch.searchsorted(angles, angle).clamp(1, len(angles) - 1)
    share = (angle - angles[after - 1]) / (angles[after] - angles[after - 1]).clamp(min=1e-9)
    return torch.lerp(reach[after - 1], reach[after], share.clamp(0, 1)).clamp(min=1e-6)


def ramp(value: Tensor, low: float, high: float) -> Tensor:
    """0 below ``low``, 1 above ``high``, smooth between."""
    share = ((value - low) / (high - low)).clamp(0, 1)
    return share * share * (3 - 2 * share)
