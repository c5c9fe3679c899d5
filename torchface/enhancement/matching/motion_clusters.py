"""Clusters of a face's patches that move together: connected, and mirrored where face and motion are."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from torchface.enhancement.matching.patches import Ids, grow_groups, grow_labels, neighbour_table
from torchface.errors import ValueRangeError

Numbers = NDArray[np.float64]

_MOST = 800  # patches that are clustered as they are; more are joined to about so many groups first
_STILL = 0.05  # of the motion of what moves most: what moves less takes part in no cluster
_CONTRAST = 0.25  # of correlation: patches that correlate by so much less are e times less alike
_REACH = 0.2  # of the face's size: patches so far apart along the surface are e^(1/2) times less alike
_ALIKE = 0.6  # correlation of left and right above which a cluster on the midline is one rather than two halves
_SYMMETRIC = 0.6  # of the distance of neighbours: how far a mirrored patch may lie from the next one, in the median
_HALVES = 3  # marked patches that keep a cluster on the midline from being joined


def motion_clusters(
    motion: Numbers, centres: Numbers, pairs: Ids, count: int, midline: float, apart: Ids, seed: int = 0
) -> Ids:
    """The cluster of each patch by correlated motion, (P,), from 0 to ``count`` - 1.

    Spectral clustering: patches are alike as their motion correlates and as they are near along the surface; the
    graph's eigenvectors are joined to clusters by Ward's rule along the patches' adjacency, which keeps every cluster
    connected. A face whose motion is symmetric is clustered as one half; clusters on the midline become one or two, as
    their halves move alike or not.

    Args:
        motion: how far each patch is from its mean place or shape in every frame, (K,P,C).
        midline: the plane of symmetry is x = ``midline``.
        apart: patches, such as those of the mouth, whose clusters stay two halves.

    Source: Tena, De la Torre, Matthews 2011, Interactive region-based linear 3D face models, section 3.
    """
    pairs = _joined(pairs, centres)
    groups = np.arange(len(centres))
    if len(centres) > _MOST:
        groups = grow_groups(pairs, len(centres), len(centres) / _MOST, seed)
    graph = _grouped(motion, centres, pairs, groups)
    moving = _moving(graph.motion)
    if moving.sum() < count:
        raise ValueRangeError(
            f"regions: found {int(moving.sum())} of {len(graph.centres)} patches that move, expected at least "
            f"{count}, one for each region; ask for fewer regions or smaller patches, or give frames with more motion"
        )
    part = graph.only(moving)
    alike, correlation = _likeness(part, np.ptp(graph.centres, axis=0).max())
    labels = _mirrored_clusters(part, alike, correlation, count, midline, np.isin(moving.nonzero()[0], groups[apart]))
    if labels is None:
        labels = _ward(_embedding(alike, count, seed), part.pairs, count)
    grown = grow_labels(moving.nonzero()[0], labels, neighbour_table(graph.pairs, len(graph.centres)))
    return grown[groups]


@dataclass(frozen=True, eq=False)
class _Graph:
    """Groups of patches: motion (K,G,C), centres (G,3) and neighbours (E,2)."""

    motion: Numbers
    centres: Numbers
    pairs: Ids

    def only(self, keep: NDArray[np.bool_]) -> "_Graph":
        """The groups that are kept, renumbered, in one piece."""
        number = np.full(len(keep), -1)
        number[keep] = np.arange(keep.sum())
        inside = number[self.pairs]
        centres = self.centres[keep]
        return _Graph(self.motion[:, keep], centres, _joined(inside[(inside >= 0).all(1)], centres))


def _grouped(motion: Numbers, centres: Numbers, pairs: Ids, groups: Ids) -> _Graph:
    count = groups.max() + 1
    means = csr_array((np.ones(len(groups)), (groups, np.arange(len(groups)))), shape=(count, len(groups)))
    means = csr_array(means / np.bincount(groups)[:, None])
    across = np.unique(np.sort(groups[pairs], axis=1), axis=0)
    together = np.stack([means @ frame for frame in motion])  # frame by frame: all at once would copy the database
    return _Graph(together, means @ centres, across[across[:, 0] != across[:, 1]])


def _moving(motion: Numbers) -> NDArray[np.bool_]:
    extent = np.sqrt(np.square(motion - motion.mean(0)).sum((0, 2)))
    most = np.quantile(extent, 0.95)
    return (extent > _STILL * most) & (extent > 0)


def _likeness(graph: _Graph, size: float) -> tuple[Numbers, Numbers]:
    """How alike each two groups are, in [0,1], and how their motion correlates, in [-1,1], both (G,G)."""
    centred = graph.motion - graph.motion.mean(0)
    rows = centred.transpose(1, 0, 2).reshape(len(graph.centres), -1)
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    correlation = rows @ rows.T
    lengths = np.linalg.norm(graph.centres[graph.pairs[:, 0]] - graph.centres[graph.pairs[:, 1]], axis=1) + 1e-9
    ways = coo_array((lengths, graph.pairs.T), shape=correlation.shape)
    distance = dijkstra(ways.tocsr(), directed=False) / (_REACH * size)
    return np.exp(-(1 - correlation) / _CONTRAST - 0.5 * np.square(distance)), correlation


def _mirrored_clusters(
    graph: _Graph, alike: Numbers, correlation: Numbers, count: int, midline: float, apart: NDArray[np.bool_]
) -> Ids | None:
    """Clusters of one half of the face and their mirror images; None where face or motion is not symmetric."""
    over = graph.centres * [-1, 1, 1] + [2 * midline, 0, 0]
    distance, mirror = KDTree(graph.centres).query(over)
    spacing = np.median(np.linalg.norm(graph.centres[graph.pairs[:, 0]] - graph.centres[graph.pairs[:, 1]], axis=1))
    same_motion = np.corrcoef(correlation.ravel(), correlation[np.ix_(mirror, mirror)].ravel())[0, 1]
    half = (graph.centres[:, 0] <= midline).nonzero()[0]
    if np.median(distance) > _SYMMETRIC * spacing or same_motion < _ALIKE or not count <= len(half) < len(mirror):
        return None
    both = 0.5 * (alike + alike[np.ix_(mirror, mirror)])[np.ix_(half, half)]
    left = graph.only(np.isin(np.arange(len(mirror)), half))
    embedding = _embedding(0.5 * (both + both.T), (count + 1) // 2, 0)
    number = np.full(len(mirror), -1)
    number[half] = np.arange(len(half))
    # The half that a group on the other side is the image of.
    image = np.where(number >= 0, number, number[half[KDTree(graph.centres[half]).query(over)[1]]])
    other = number < 0
    best, chosen = np.inf, None
    for halves in range((count + 1) // 2, count + 1):  # few; each a cut of the same tree
        labels = _ward(embedding, left.pairs, halves)[image]
        joined = 2 * halves - count
        touching = labels[graph.pairs[:, 0]] == labels[graph.pairs[:, 1]]
        touching &= other[graph.pairs[:, 0]] != other[graph.pairs[:, 1]]
        middle = np.unique(labels[graph.pairs[touching, 0]])
        together = np.array([correlation[np.ix_((labels == k) & ~other, (labels == k) & other)].mean() for k in middle])
        together -= 2.0 * np.array([np.sum(apart & (labels == k)) >= _HALVES for k in middle])
        order = np.argsort(-together, kind="stable")
        if joined > len(middle):
            continue
        cost = (_ALIKE - together[order[:joined]]).clip(min=0).sum()
        cost += (together[order[joined:]] - _ALIKE).clip(min=0).sum()
        if cost < best:
            single = np.isin(labels, middle[order[:joined]])
            best, chosen = cost, np.unique(np.where(other & ~single, halves + labels, labels), return_inverse=True)[1]
    return chosen


def _embedding(alike: Numbers, count: int, seed: int) -> Numbers:
    """Each group's place among the eigenvectors of its likeness to all others, (G,N)."""
    from sklearn.manifold import spectral_embedding  # takes a second, and only training needs it

    return spectral_embedding(alike, n_components=min(count, len(alike) - 1), eigen_solver="arpack", random_state=seed)


def _ward(embedding: Numbers, pairs: Ids, count: int) -> Ids:
    from sklearn.cluster import AgglomerativeClustering

    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(embedding),) * 2).tocsr()
    links = links + links.T
    return AgglomerativeClustering(n_clusters=count, connectivity=links).fit_predict(embedding)


def _joined(pairs: Ids, centres: Numbers) -> Ids:
    """The same edges and one more for each part but the largest, to what is nearest of the rest."""
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(centres),) * 2)
    parts, labels = connected_components(links, directed=False)
    if parts == 1:
        return pairs
    largest = np.bincount(labels).argmax()
    more = []
    done = labels == largest
    for part in np.argsort(-np.bincount(labels), kind="stable")[1:]:  # few: loose parts of a mesh
        own = (labels == part).nonzero()[0]
        distance, nearest = KDTree(centres[done]).query(centres[own])
        best = distance.argmin()
        more.append((own[best], done.nonzero()[0][nearest[best]]))
        done |= labels == part
    return np.concatenate([pairs, np.array(more)])
