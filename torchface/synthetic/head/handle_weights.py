"""Weights by which the skin follows the lip handles and the jaw: smooth, solved once on the sculpture."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu
from torch import Tensor

from torchface.synthetic.head.identity import both_sides, ramp, sculpted_vertices
from torchface.synthetic.head.topology import MOUTH_BORDER, MOUTH_CONTACT, topology

LIP_HANDLES = 52
"""Handles round the mouth: 27 on the left from the upper midline over the corner (13) to the lower midline (26), and
25 more on the right, back up."""
_REACH = 5.0  # millimetres, of the lips


@dataclass(frozen=True, eq=False)
class HandleWeights:
    """Weights over the sculpture's vertices."""

    lips: Tensor  # how much each vertex follows each lip handle, (V,52); rows of the red of the lips sum to 1
    jaw: Tensor  # how much each vertex rotates with the jaw, (V,)
    lip_position: Tensor  # each lip vertex's handle, (V,) int64, -1 elsewhere; lip_ring its ring, -1 elsewhere
    lip_ring: Tensor


@lru_cache(maxsize=1)
def handle_weights() -> HandleWeights:
    """The weights, computed once."""
    t = topology()
    p = sculpted_vertices()
    position = torch.full((t.count,), -1)
    ring = torch.full((t.count,), -1)
    around = torch.arange(27)
    for side, handles in ((1, torch.where((around > 0) & (around < 26), 52 - around, around)), (0, around)):
        ids = both_sides(t.rings["mouth"])[side]
        position[ids] = handles.expand_as(ids)
        ring[ids] = torch.arange(len(ids))[:, None].expand_as(ids)
    return HandleWeights(_lip_weights(p, position, ring), _jaw_weights(p, position, ring), position, ring)


def _lip_weights(p: Tensor, position: Tensor, ring: Tensor) -> Tensor:
    on_lips = (ring >= MOUTH_BORDER) & (ring <= MOUTH_CONTACT + 2)
    values = torch.zeros(len(p), LIP_HANDLES, dtype=torch.float64)
    values[on_lips] = torch.nn.functional.one_hot(position[on_lips], LIP_HANDLES).double()
    fixed_skin = (p[:, 1] > -18) | (p[:, 1] < -111) | (p[:, 2] < 22) | (ring > MOUTH_CONTACT + 5) | _unmoved_parts()
    # The nose stays: only the skin beside its wings gives.
    fixed_skin |= (p[:, 1] > -44.5) & (p[:, 0].abs() < 20)
    return _interpolated(values, on_lips | fixed_skin, _REACH)


def _jaw_weights(p: Tensor, position: Tensor, ring: Tensor) -> Tensor:
    values = torch.zeros(len(p), 1, dtype=torch.float64)
    side = torch.where(position > 26, 52 - position, position).double()
    follow = ramp(side, 6.5, 20.0)
    lips = ring >= 3
    values[lips, 0] = follow[lips]
    cap = torch.zeros(len(p), dtype=torch.bool)
    bag = topology().caps["mouth"]
    depth = torch.linspace(0, 1, bag.shape[0], dtype=torch.float64)[:, None].expand(bag.shape)
    for both in both_sides(bag):
        cap[both] = True
        inner = ~(ring[both] >= 0)
        values[both[inner], 0] = ramp(depth, 0.0, 1.0)[inner]
    # The bone: below a line from under the mouth's corner to the jaw's angle; the throat follows part of the way.
    line = -82 + 0.10 * (80 - p[:, 2])
    below_chin = (p[:, 1] < -106) & (p[:, 2] < 62)
    bone = (p[:, 1] < line) & (p[:, 1] > -117) & (p[:, 2] > 40) & ~lips & ~cap & ~below_chin & (ring < 3)
    values[bone] = 1.0
    fixed_skin = (p[:, 1] > -36) | (p[:, 1] < -150) | (p[:, 2] < -26) | _unmoved_parts()
    fixed_skin |= (p[:, 1] > -50) & (p[:, 0].abs() < 22) & (p[:, 2] > 60) & (ring < 0)
    fixed_skin &= ~(lips | cap)
    return _interpolated(values, bone | lips | cap | fixed_skin)[:, 0].clamp(0, 1)


def _unmoved_parts() -> Tensor:
    """Parts that no lip moves: eyes, ears, nostrils."""
    t = topology()
    mask = torch.zeros(t.count, dtype=torch.bool)
    ids = [t.rings["eye"][1:], t.caps["eye"], t.rings["ear"], t.caps["ear"], t.rings["nostril"], t.caps["nostril"]]
    for half in (*ids, t.eyeball, t.caps["eyeball_front"], t.caps["eyeball_back"]):
        for both in both_sides(half):
            mask[both] = True
    return mask


def _interpolated(values: Tensor, fixed: Tensor, reach: float | None = None) -> Tensor:
    """Values (V,C) where fixed (V,), elsewhere interpolated as a thin plate, whose squared Laplacian is zero, under
    tension with a reach so that it swings out no farther."""
    t = topology()
    p = sculpted_vertices().numpy()
    quads = t.quads.numpy()
    pairs = np.concatenate([quads[:, [i, (i + 1) % 4]] for i in range(4)])
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    length = np.linalg.norm(p[pairs[:, 0]] - p[pairs[:, 1]], axis=1)
    weight = 1 / np.maximum(length, 0.3)
    count = len(p)
    adjacency = coo_matrix((weight, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    adjacency = (adjacency + adjacency.T).tocsr()
    degree = np.asarray(adjacency.sum(1)).ravel()
    laplacian = diags(degree) - adjacency
    area = np.bincount(pairs.ravel(), np.repeat(length**2, 2), count) / np.maximum(np.bincount(pairs.ravel()), 1)
    plate = (laplacian @ diags(1 / area) @ laplacian).tocsr()
    if reach is not None:
        plate = (plate + laplacian / reach**2).tocsr()
    known = fixed.numpy()
    free = ~known
    right = -(plate[free][:, known] @ values.numpy()[known])
    result = values.clone()
    result[torch.from_numpy(free)] = torch.from_numpy(splu(plate[free][:, free].tocsc()).solve(np.asarray(right)))
    return result
