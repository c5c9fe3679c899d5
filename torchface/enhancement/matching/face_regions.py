"""Regions of a face with soft borders, found by what moves together and named by where they lie."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree
from torch import Tensor

from torchface.enhancement.matching.motion_clusters import motion_clusters
from torchface.enhancement.matching.patches import grow_labels, neighbour_table, neighbouring_triangles, patch_means
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.meshes.operators import components, corners, edges, triangle_areas
from torchface.number_checks import checked_count

SIGMA = 10.0  # standard deviation of the regions' borders, millimetres

_LIMIT = 4.0  # standard deviations, where 0.0003 of the weight is left: half precision holds it
_LANDMARKS = 68
_MIDDLE = (8, 27, 28, 29, 30, 33, 51, 57, 62, 66)
_EYES = {"eye_right": range(36, 42), "eye_left": range(42, 48)}
_LID_REACH = 0.25  # of the eye's width: how far an eye's region goes beyond the lids' edges


@dataclass(frozen=True, eq=False)
class Regions:
    """Where each region of a face counts, and how much."""

    # Of the regions, such as mouth_left, or region_03 where no landmarks show the place. Left is the actor's left.
    names: tuple[str, ...]
    weights: Tensor  # of each region at each triangle, (R,F), in [0,1]: 1 inside, less outside
    # (R,) bool, whether the actor moves the region at will: mouth and brows. False for all where no landmarks are
    # given.
    voluntary: Tensor

    def __post_init__(self) -> None:
        if self.weights.ndim != 2 or len(self.weights) != len(self.names) or len(self.voluntary) != len(self.names):
            raise ShapeError(
                f"Regions: found {len(self.names)} names, weights {tuple(self.weights.shape)} and voluntary "
                f"{tuple(self.voluntary.shape)}, expected (R,), (R,F) and (R,)"
            )

    def patch_weights(self, patches: Tensor, areas: Tensor) -> Tensor:
        """How much each patch counts in each region, (R,P), of sum 1: by the area and the weight of its triangles."""
        shared = self.weights.float() * areas.float()
        total = shared.new_zeros(len(shared), int(patches.max()) + 1).index_add(1, patches, shared)
        return total / total.sum(1, keepdim=True)

    def vertex_weights(self, faces: Tensor, vertex_count: int) -> Tensor:
        """The share of each region in each vertex, (R,V), of sum 1 in every vertex: the mean of the triangles around.

        A vertex of no triangle belongs to all regions alike.
        """
        ids = faces.flatten()
        each = self.weights.float().repeat_interleave(3, dim=1)
        total = each.new_zeros(len(each), vertex_count).index_add(1, ids, each)
        loose = total.sum(0) == 0
        total[:, loose] = 1.0
        return total / total.sum(0)


def regions_of_motion(
    motion: Tensor,
    patches: Tensor,
    neutral: Tensor,
    faces: Tensor,
    count: int = 13,
    landmarks: Tensor | None = None,
    seed: int = 0,
) -> Regions:
    """Regions of correlated motion, from the motion of patches.

    With landmarks the lids of each eye are regions of their own, the mouth's and the brows' are halves, all are named
    by their place, and mouth and brows are marked as voluntary. What hardly moves goes to the region next to it.

    Args:
        motion: displacements (or shape features) of the patches in each frame, (K,P,C).
        patches: the patch of each triangle, (F,) int64.
        neutral: (V,3), millimetres, upright, looking along z.
        landmarks: vertex ids of the 68 iBUG landmarks.

    Returns:
        The regions, ``count`` at most; each is connected but for parts of the mesh that hang on nothing.

    Source: Tena, De la Torre, Matthews 2011; Facial Performance Enhancement Using Dynamic Shape Space Analysis,
    section 4.3.
    """
    checked_count("count", count, 3 if landmarks is not None else 1)
    if landmarks is not None and len(landmarks) != _LANDMARKS:
        raise ValueRangeError(f"landmarks: found {len(landmarks)} vertices, expected the 68 iBUG landmarks")
    if not bool(torch.isfinite(motion).all()):
        raise ValueRangeError("regions: motion holds NaN or infinite entries, expected finite ones")
    links = neighbouring_triangles(faces)
    across = patches[links].sort(1).values
    across = across[across[:, 0] != across[:, 1]].unique(dim=0)
    middles = torch.stack(corners(neutral, faces)).mean(0)
    centres = patch_means(middles[None], patches, triangle_areas(neutral, faces))[0]
    eyes = (
        {} if landmarks is None else {name: _eye(neutral, faces, landmarks[list(ids)]) for name, ids in _EYES.items()}
    )
    eyes = {name: mask for name, mask in eyes.items() if bool(mask.any())}
    clusters = motion_clusters(
        motion.double().numpy(),
        centres.double().numpy(),
        across.numpy(),
        count - len(eyes),
        _midline(neutral, landmarks),
        _expressive_patches(landmarks, faces, patches),
        seed,
    )
    labels = torch.from_numpy(clusters)[patches]
    for number, mask in enumerate(eyes.values(), start=count - len(eyes)):
        labels[mask] = number
    # A few short motions have fewer clusters than are asked for.
    present, labels = _connected(labels, links, middles).unique(return_inverse=True)
    eyes_present = [name for number, name in enumerate(eyes, start=count - len(eyes)) if number in present]
    count = len(present)
    names, voluntary = named_regions(labels, count, neutral, faces, landmarks, tuple(eyes_present))
    return Regions(names, soft_weights(labels, count, neutral, faces, SIGMA), voluntary)


def _midline(neutral: Tensor, landmarks: Tensor | None) -> float:
    if landmarks is None:
        return float(0.5 * (neutral[:, 0].amin() + neutral[:, 0].amax()))
    return float(neutral[landmarks[list(_MIDDLE)], 0].mean())


def _expressive_patches(landmarks: Tensor | None, faces: Tensor, patches: Tensor) -> np.ndarray:
    """The patches of mouth and brows."""
    if landmarks is None:
        return np.zeros(0, dtype=np.int64)
    shown = torch.isin(faces, landmarks[[*range(17, 27), *range(48, 68)]]).any(1)
    return patches[shown].unique().numpy()


def _eye(neutral: Tensor, faces: Tensor, lids: Tensor) -> Tensor:
    """The triangles (F,) around the edges of one eye's lids."""
    width = float(torch.cdist(neutral[lids], neutral[lids]).max())
    # Landmarks are a few vertices of the lids' edges: what lies between them, too.
    distance = surface_distances(neutral, faces, lids, (0.3 + _LID_REACH) * width)
    return distance[faces].amax(1) <= (0.2 + _LID_REACH) * width


def _connected(labels: Tensor, links: Tensor, middles: Tensor) -> Tensor:
    """The same labels of triangles, with what hangs apart from the largest piece of its region given to a neighbour."""
    own = links[labels[links[:, 0]] == labels[links[:, 1]]]
    piece = _pieces(own, len(labels))
    sizes = piece.bincount()
    largest = torch.zeros(int(labels.max()) + 1, dtype=torch.int64).scatter_reduce(0, labels, sizes[piece], "amax")
    keep = sizes[piece] == largest[labels]
    seeds = keep.nonzero()[:, 0].numpy()
    grown = grow_labels(seeds, labels[keep].numpy(), neighbour_table(links.numpy(), len(labels)))
    lost = torch.from_numpy(grown < 0)
    result = torch.from_numpy(grown)
    if bool(lost.any()):  # parts of the mesh that no edge joins to any region
        nearest = KDTree(middles[~lost].numpy()).query(middles[lost].numpy())[1]
        result[lost] = result[~lost][torch.from_numpy(nearest)]
    return result


def _pieces(links: Tensor, count: int) -> Tensor:
    """The connected piece of each triangle, (F,), by links (E,2)."""
    # A triangle of a pair twice: the same search as over a mesh's vertices.
    return components(torch.cat([links, links[:, 1:]], dim=1), count)


def surface_distances(vertices: Tensor, faces: Tensor, sources: Tensor, limit: float = float("inf")) -> Tensor:
    """The shortest way along edges from the nearest source (S,) to each vertex, (V,), mm; infinite beyond ``limit``."""
    pairs = edges(faces)
    lengths = (vertices[pairs[:, 0]] - vertices[pairs[:, 1]]).norm(dim=1).double().clamp(min=1e-9)
    ways = coo_array((lengths.cpu().numpy(), pairs.T.cpu().numpy()), shape=(len(vertices),) * 2).tocsr()
    distance = dijkstra(ways, directed=False, indices=sources.cpu().numpy(), min_only=True, limit=limit)
    return torch.from_numpy(distance).to(vertices)


def soft_weights(labels: Tensor, count: int, vertices: Tensor, faces: Tensor, sigma: float) -> Tensor:
    r"""The weight of each region at each triangle (F,), (R,F) half: 1 inside, outside a Gaussian of the distance.

    .. math:: \omega_{r,t} = \exp(-d_{r,t}^2 / 2\sigma^2)

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, section 5.3.
    """
    weights = torch.zeros(count, len(faces), dtype=torch.float16)
    corner_label = labels[:, None].expand(-1, 3)
    low = torch.full((len(vertices),), count).scatter_reduce(0, faces.flatten(), corner_label.flatten(), "amin")
    high = torch.full((len(vertices),), -1).scatter_reduce(0, faces.flatten(), corner_label.flatten(), "amax")
    on_border = low != high
    for region in range(count):  # one after the other: the distances of all would be large
        inside = labels == region
        corners = faces[inside].unique()
        sources = corners[on_border[corners]]
        if len(sources):
            distance = surface_distances(vertices, faces, sources, _LIMIT * sigma)
            distance[corners] = 0.0
            distance = distance[faces].mean(1)
            weights[region] = torch.exp(-0.5 * (distance / sigma).square()).half()
        weights[region, inside] = 1.0
    return weights


_PLACES = {
    "mouth": ((48, 49, 50, 58, 59, 60, 61, 67), (54, 53, 52, 56, 55, 64, 63, 65)),
    "brow": ((17, 18, 19, 20, 21), (26, 25, 24, 23, 22)),
    "nose": ((29, 30, 31, 32), (29, 30, 35, 34)),
    "chin": ((6, 7, 8), (10, 9, 8)),
    "jaw": ((2, 3, 4, 5), (14, 13, 12, 11)),
}
"""Landmarks of each place: of the actor's right side, of the left."""
_BETWEEN = {"cheek": ((36, 48, 2, 31), (45, 54, 14, 35)), "temple": ((36, 36, 17, 0), (45, 45, 26, 16))}
"""Places that no landmark marks, by the mean of some around."""
_VOLUNTARY = ("mouth", "brow")


def named_regions(
    labels: Tensor, count: int, neutral: Tensor, faces: Tensor, landmarks: Tensor | None, eyes: tuple[str, ...]
) -> tuple[tuple[str, ...], Tensor]:
    """The name of each region, and whether an actor moves it at will, (R,) bool.

    A place goes to the region that holds most of its landmarks; a region that holds those of both sides has a name
    without a side. What is left is called by its height: forehead above the brows, else by its number.

    Args:
        labels: the region of each triangle, (F,) int64.
        landmarks: vertex ids of the 68 iBUG landmarks; without them all are numbered, and none is voluntary.
    """
    numbered = [f"region_{number:02d}" for number in range(count - len(eyes))]
    names = [*numbered, *eyes]
    voluntary = torch.zeros(count, dtype=torch.bool)
    if landmarks is None:
        return tuple(names), voluntary
    at_vertex = torch.full((len(neutral),), -1).scatter(0, faces.flatten(), labels.repeat_interleave(3))
    free = set(range(len(numbered)))
    for place, sides in (_PLACES | _BETWEEN).items():
        held = [_holder(at_vertex, neutral, landmarks, ids, place in _BETWEEN, free) for ids in sides]
        if held[0] is not None and held[0] == held[1]:
            named = {place: held[0]}
        else:
            named = {f"{place}_{side}": r for side, r in zip(("right", "left"), held, strict=True) if r is not None}
        for name, region in named.items():
            names[region] = name
            voluntary[region] = place in _VOLUNTARY
            free.discard(region)
    _name_foreheads(names, free, labels, neutral, faces, landmarks)
    return tuple(names), voluntary


def _holder(
    at_vertex: Tensor, neutral: Tensor, landmarks: Tensor, ids: tuple[int, ...], between: bool, free: set[int]
) -> int | None:
    """The nameless region that holds most of some landmarks, or the point between them; None where there is none."""
    vertices = landmarks[list(ids)]
    if between:
        known = (at_vertex >= 0).nonzero()[:, 0]
        middle = neutral[vertices].mean(0)
        vertices = known[(neutral[known] - middle).norm(dim=1).argmin()][None]
    held = [region for region in at_vertex[vertices].tolist() if region in free]
    return max(set(held), key=lambda region: (held.count(region), -region)) if held else None


def _name_foreheads(
    names: list[str], free: set[int], labels: Tensor, neutral: Tensor, faces: Tensor, landmarks: Tensor
) -> None:
    above = float(neutral[landmarks[17:27], 1].mean())
    middles = neutral[faces].mean(1)
    inside = {region: middles[labels == region].mean(0) for region in free}
    high = sorted((region for region, middle in inside.items() if middle[1] > above), key=lambda r: float(inside[r][0]))
    many = len(high) > 1
    for number, region in enumerate(high, start=1):
        names[region] = f"forehead_{number}" if many else "forehead"
