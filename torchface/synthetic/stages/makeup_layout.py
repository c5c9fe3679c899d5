"""Layout of markers as a make-up artist sets them: by muscles and action units, symmetric, each with its name.

A site is a weighted sum of the 68 landmarks, projected onto the skin. The tables hold the subject's right side and the
midline; the left side is the mirror image.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.errors import ValueRangeError
from torchface.geometry.meshes.operators import components, corners
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.similarity import similarity_transform
from torchface.landmarks.images.ibug_68 import COUNT, MIRROR_68
from torchface.mesh import Mesh
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, mapping
from torchface.synthetic.head.performer import performer

_Site = dict[int, float]
_SIDE: dict[str, dict[str, _Site]] = {
    "forehead": {
        "foreheadInner": {21: 1.7, 39: -0.7},
        "foreheadMid": {19: 1.1, 20: 0.55, 37: -0.4, 38: -0.25},
        "foreheadOuter": {17: 0.95, 18: 0.75, 36: -0.7},
        "foreheadHigh": {18: 1.2, 20: 1.4, 37: -0.8, 38: -0.8},
        "temple": {0: 0.4, 17: 0.75, 36: -0.15},
    },
    "brow": {
        "browTail": {17: 1.0},
        "browOuter": {18: 0.75, 19: 0.25},
        "browMid": {19: 0.4, 20: 0.6},
        "browInner": {21: 1.0},
    },
    "lids": {
        "lidUpperOuter": {36: 0.2, 37: 0.65, 18: 0.15},
        "lidUpperMid": {37: 0.43, 38: 0.43, 19: 0.14},
        "lidUpperInner": {39: 0.15, 38: 0.7, 20: 0.15},
        "lidLowerOuter": {36: 0.25, 41: 1.05, 37: -0.3},
        "lidLowerMid": {40: 0.65, 41: 0.65, 37: -0.15, 38: -0.15},
        "lidLowerInner": {39: 0.25, 40: 1.05, 38: -0.3},
        "canthusOuter": {36: 1.35, 39: -0.35},
    },
    "infraorbital": {
        "infraorbitalOuter": {36: 0.75, 3: 0.25},
        "infraorbitalMid": {41: 0.55, 40: 0.2, 48: 0.25},
        "infraorbitalInner": {40: 0.45, 39: 0.25, 31: 0.3},
    },
    "cheek": {
        "cheekZygoma": {36: 0.5, 2: 0.5},
        "cheekApple": {41: 0.4, 48: 0.4, 3: 0.2},
        "cheekMid": {36: 0.15, 48: 0.45, 3: 0.4},
        "cheekOuter": {36: 0.25, 48: 0.15, 2: 0.4, 3: 0.2},
        "cheekLower": {48: 0.6, 4: 0.4},
    },
    "nasolabial fold": {
        "nasolabialUpper": {31: 1.2, 33: -0.4, 41: 0.2},
        "nasolabialMid": {31: 0.55, 48: 0.6, 51: -0.15},
        "nasolabialLower": {48: 1.3, 51: -0.4, 31: 0.1},
    },
    "nose": {
        "noseSideUpper": {28: 0.6, 39: 0.4},
        "noseSideLower": {29: 0.3, 31: 0.4, 39: 0.3},
        "noseAla": {31: 1.0, 33: -0.15, 29: 0.15},
    },
    "upper lip": {
        "philtrumSide": {50: 0.5, 32: 0.5},
        "upperLipSide": {49: 0.55, 31: 0.45},
        "lipUpperInner": {50: 0.88, 32: 0.12},
        "lipUpperOuter": {49: 0.88, 31: 0.12},
        "lipCorner": {48: 1.07, 54: -0.07},
    },
    "lower lip": {"lipLowerInner": {58: 0.9, 7: 0.1}, "lipLowerOuter": {59: 0.9, 6: 0.1}},
    "chin": {
        "mentolabialSide": {58: 0.65, 7: 0.35},
        "marionette": {48: 0.6, 59: 0.1, 6: 0.3},
        "chinSide": {58: 0.3, 7: 0.7},
    },
    "jaw": {
        "jawFront": {48: 0.1, 6: 0.6, 7: 0.3},
        "jawMid": {48: 0.1, 5: 0.75, 6: 0.15},
        "jawBack": {48: 0.1, 3: 0.4, 4: 0.5},
    },
}
_MIDLINE: dict[str, dict[str, _Site]] = {
    "forehead": {
        "foreheadLow": {21: 0.95, 22: 0.95, 27: -0.9},
        "foreheadCentre": {20: 1.2, 23: 1.2, 38: -0.7, 43: -0.7},
    },
    "brow": {"glabella": {21: 0.42, 22: 0.42, 27: 0.16}},
    "nose": {"noseRoot": {27: 1.0}, "noseBridge": {28: 0.5, 29: 0.5}, "noseTip": {30: 1.0}},
    "upper lip": {"philtrum": {33: 0.5, 51: 0.5}, "lipUpper": {51: 0.88, 33: 0.12}},
    "lower lip": {"lipLower": {57: 0.9, 8: 0.1}},
    "chin": {"mentolabial": {57: 0.6, 8: 0.4}, "chin": {57: 0.25, 8: 0.75}},
}
# Directions from which a marker has to be seen by one camera at least, degrees of yaw.
_VIEWS = (0.0, -55.0, 55.0)
_FORWARD, _TOWARD = -0.2, 0.1
_MIN_SHAPES = 12
# Eyes and tongue are parts of their own on many rigs; jaws carry beards and necks along on some.
_NOT_OF_THE_SKIN = ("eyeLook", "tongue", "jaw")


@dataclass(frozen=True, eq=False)
class MakeupLayout:
    """Markers on a face.

    Args:
        attachment: where they sit; labels name muscles or creases, ``L`` and ``R`` are the subject's sides.
        regions: of each marker, in the attachment's order.
        mirror: the row of each marker's mirror image, (M,); a marker on the midline names itself.
    """

    attachment: Attachment
    regions: tuple[str, ...]
    mirror: Tensor

    def counts(self) -> dict[str, int]:
        """How many markers each region has."""
        return {region: self.regions.count(region) for region in dict.fromkeys(self.regions)}


def makeup_layout(rig: BlendshapeRig) -> MakeupLayout:
    """Markers as a make-up artist sets them for the facial action coding system, on any head.

    Brows and the frontalis above them (action units 1, 2, 4), lids (5, 7, 45), the orbicularis beside and below the eye
    (6), nose (9), nasolabial fold (10, 11, 12), the contour of both lips (15 to 28), chin (17), jaw line (26, 27, 29,
    30), and few on forehead, temples and nasal root that hardly move, which show the head's motion.

    Args:
        rig: with 68 iBUG landmarks in its annotations; without, they are found from shapes with ARKit's names.

    Raises:
        ValueRangeError: the rig has neither landmarks nor enough of ARKit's shapes.

    Source: Ekman, Friesen 1978 for the action units; thesis 4.1.1.

    Example:
        >>> from torchface.synthetic import performer
        >>> layout = makeup_layout(performer(texture=False))
        >>> sum(layout.counts().values()) == len(layout.attachment.labels)
        True
    """
    points = _landmarks(rig)
    names, regions, sites, partner = [], [], [], []
    for region in _SIDE:
        for name, weights in _MIDLINE.get(region, {}).items():
            names.append(name)
            partner.append(name)
            regions.append(region)
            sites.append(_row(weights))
        for name, weights in _SIDE[region].items():
            names += [f"{name}R", f"{name}L"]
            partner += [f"{name}L", f"{name}R"]
            regions += [region, region]
            sites += [_row(weights), _row({MIRROR_68[index]: weight for index, weight in weights.items()})]
    attachment = _on_skin(rig.neutral, torch.stack(sites) @ points, names)
    return MakeupLayout(attachment, tuple(regions), torch.tensor([names.index(name) for name in partner]))


def _landmarks(rig: BlendshapeRig) -> Tensor:
    annotations = rig.neutral.annotations
    if annotations is not None and annotations.landmarks is not None and len(annotations.landmarks) == COUNT:
        return rig.vertices.detach().cpu().double()[annotations.landmarks.cpu()]
    return landmarks_by_shape(rig)


def landmarks_by_shape(rig: BlendshapeRig) -> Tensor:
    """Landmarks (68,3), millimetres, float64: the embedded performer's, moved by a similarity.

    It takes the place at which each of ARKit's shapes moves the performer to that at which it moves the rig. Within
    2 mm on other performers; on another family of heads within 6 mm inside the face, more along the jaw.
    """
    known = performer(texture=False)
    ours, here = _centres(known), _centres(rig)
    both = [name for name in ours if name in here]
    if len(both) < _MIN_SHAPES:
        raise ValueRangeError(
            f"rig: found no 68 landmarks and {len(both)} shapes with ARKit's names, expected landmarks or at least "
            f"{_MIN_SHAPES} such shapes; landmarks are set with: torchface pick RIG"
        )
    source = torch.stack([ours[name] for name in both])
    target = torch.stack([here[name] for name in both])
    points = known.vertices.double()[known.neutral.landmarks]
    return similarity_transform(source[None], target[None]).apply(points[None])[0]


def _centres(rig: BlendshapeRig) -> dict[str, Tensor]:
    """Where each of ARKit's shapes moves the rig: the mean place, weighted by the squared motion."""
    table = mapping(ARKIT, rig.names).T.double()
    vertices, deltas = rig.vertices.detach().cpu().double(), rig.deltas.detach().cpu()
    centres = {}
    for name, row in zip(ARKIT, table, strict=True):
        if name.startswith(_NOT_OF_THE_SKIN) or not bool(row.any()):
            continue
        motion = torch.einsum("n,nvc->vc", row.to(deltas), deltas).double().square().sum(-1)
        if float(motion.sum()) > 0:
            centres[name] = (motion[:, None] * vertices).sum(0) / motion.sum()
    return centres


def _row(weights: _Site) -> Tensor:
    row = torch.zeros(COUNT, dtype=torch.float64)
    row[list(weights)] = torch.tensor(list(weights.values()), dtype=torch.float64)
    if abs(float(row.sum()) - 1) > 1e-9:
        raise ValueRangeError(f"layout: found weights {weights} of sum {float(row.sum()):g}, expected 1")
    return row


def _on_skin(mesh: Mesh, points: Tensor, names: list[str]) -> Attachment:
    """The nearest points of the skin that some camera sees."""
    vertices, faces = mesh.vertices.detach().cpu().double(), mesh.faces.cpu()
    rows = _outer_skin(mesh)
    nearest = SurfaceIndex(vertices, faces[rows]).nearest(points)
    triangles, corner = rows[nearest.triangle], nearest.barycentric.float()
    return Attachment(triangles, corner, tuple(names), fingerprint=mesh.fingerprint())


def _outer_skin(mesh: Mesh) -> Tensor:
    """Triangles of the largest connected part that face a camera which nothing hides; lid rims and lips' inside not."""
    vertices, faces = mesh.vertices.detach().cpu().double(), mesh.faces.cpu()
    part = components(faces, len(vertices))
    skin = (part == part[faces.flatten()].mode().values)[faces[:, 0]]
    if mesh.annotations is not None and mesh.annotations.contacts is not None:
        touching = torch.zeros(len(vertices), dtype=torch.bool)
        touching[mesh.annotations.contacts.flatten().cpu()] = True
        skin &= ~touching[faces].any(1)
    a, b, c = corners(vertices, faces)
    middle = (a + b + c) / 3
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    skin &= normals[:, 2] > _FORWARD  # the inside of a lid looks back
    caster = RayCaster(vertices, faces[part[faces[:, 0]] == part[faces.flatten()].mode().values])
    seen = torch.zeros(len(faces), dtype=torch.bool)
    for yaw in torch.deg2rad(torch.tensor(_VIEWS, dtype=torch.float64)):
        toward = torch.stack([yaw.sin(), torch.zeros_like(yaw), yaw.cos()])
        free = ~caster.occluded(middle + 0.1 * normals, toward.expand_as(middle))
        seen |= free & (normals @ toward > _TOWARD)
    return (skin & seen).nonzero()[:, 0]
