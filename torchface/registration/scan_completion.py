"""Completion of a scan by the template: shape and colours that pass over into those of the scan."""

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import edges, triangle_areas
from torchface.geometry.similarity import similarity_transform
from torchface.optim.sparse import SparseCholesky

_LINK = 0.577  # cotangent of 60°: the weight of an edge between equilateral triangles
_FORM_FADES, _COLORS_FADE = 80.0, 40.0
# Beside what is unseen lie vertices that hair or a scan's border moved: of those so near, millimetres, the form goes on
# from what a plate of this reach makes of those less than about so far off it. Beside hair those further off are no
# skin; what the rest is off goes on as a plate of its own, that fades within 20 mm, so that no edge shows.
_BESIDE, _ALIKE, _NO_SKIN, _EDGE_FADES = 20.0, 0.5, 3.0, 20.0
_FIRST_REACH, _REACH, _ROUNDS = 20.0, 5.0, 6
_LEAST_AREA = 1e-3
_MIN_COUNT = 4


def completed_form(
    rest: Tensor, current: Tensor, faces: Tensor, unseen: Tensor, shown: Tensor, doubtful: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Vertices (V,3), the unseen ones where the template has them, bent to go on smoothly from those around.

    A similarity aligns the template with what the scan shows. The offset y from there to the registered vertices
    goes on over the unseen ones as a thin plate does, and fades with the distance, :math:`\ell` = 80 mm:

    .. math:: \min_y \int \lVert \Delta y \rVert^2 + \ell^{-4} \lVert y \rVert^2
        + s^{-4} w \lVert y - d \rVert^2

    Shown vertices within 20 mm of unseen ones pull the plate to their offset d by a robust weight w (Cauchy's squared,
    0.5 mm; s = 5 mm), as hair moves some of them; those further away hold it. Of those within 20 mm doubtful ones
    that lie more than 3 mm off the plate are unseen too. What the others are off goes on over the unseen ones as
    a plate of its own, which fades within 20 mm, so that no edge shows.

    Args:
        unseen: whose positions the scan does not show, (V,) bool; the rest of the mesh stays.
        shown: whose positions it shows, (V,) bool: they align the template.
        doubtful: which may be hair or cloth, (V,) bool: where a scan ends, all that it shows is the person's.

    Returns:
        The vertices, and which were unseen, (V,) bool.

    Source: Botsch and Sorkine 2008 (thin plates over a mesh).
    """
    if not unseen.any() or int(shown.sum()) < _MIN_COUNT:
        return current, unseen
    aligned = similarity_transform(rest[shown][None], current[shown][None]).apply(rest)[0]
    stiffness, area = _membrane(aligned, faces)
    bending = stiffness @ sparse.diags_array(1 / area) @ stiffness
    plate = bending + sparse.diags_array(area / _FORM_FADES**4)
    offset = current - aligned
    gap, _ = cKDTree(aligned[unseen].numpy()).query(aligned.numpy())
    beside = shown & (torch.from_numpy(gap) < _BESIDE)
    weights, reach = beside.double(), _FIRST_REACH
    for _ in range(_ROUNDS):
        pull = weights.numpy() * area / reach**4
        form = _spread(plate, offset, unseen | beside, pull)
        off = (offset - form).norm(dim=1)
        weights, reach = beside / (1 + (off / _ALIKE).square()).square(), _REACH
    unseen = unseen | (beside & doubtful & (off > _NO_SKIN))
    edge = _spread(bending + sparse.diags_array(area / _EDGE_FADES**4), offset - form, unseen)
    return torch.where(unseen[:, None], aligned + form + edge, current), unseen


def completed_colors(colors: Tensor, base: Tensor, vertices: Tensor, faces: Tensor, unseen: Tensor) -> Tensor:
    """Colours (V,3), the unseen ones going over from those around to ``base`` (V,3) within some 40 mm, as a membrane
    does."""
    if not unseen.any():
        return colors
    stiffness, area = _membrane(vertices, faces)
    system = stiffness + sparse.diags_array(area / _COLORS_FADE**2)
    return (base + _spread(system, (colors - base).double(), unseen).to(colors)).clamp(0, 1)


def _membrane(vertices: Tensor, faces: Tensor) -> tuple[sparse.csr_array, np.ndarray]:
    """The stiffness (V,V) of a membrane with equal weights on all edges, and each vertex's area (V,)."""
    count = len(vertices)
    first, second = edges(faces).numpy().T
    half = sparse.coo_array((np.full(len(first), _LINK), (first, second)), shape=(count, count)).tocsr()
    links = half + half.T
    third = triangle_areas(vertices, faces).double() / 3
    area = torch.zeros(count, dtype=torch.float64)
    for corner in range(3):
        area.index_add_(0, faces[:, corner], third)
    return (sparse.diags_array(links.sum(1)) - links).tocsr(), area.clamp(min=_LEAST_AREA).numpy()


def _spread(system: sparse.csr_array, values: Tensor, unknown: Tensor, pull: np.ndarray | None = None) -> Tensor:
    """Values (V,K) with the unknown rows, or those pulled (V,), at the least of the quadratic form, the others held."""
    held = values.masked_fill(unknown[:, None], 0.0).numpy()
    rows = unknown.nonzero()[:, 0].numpy()
    right = -(system[rows] @ held)
    if pull is not None:
        system = (system + sparse.diags_array(pull)).tocsr()
        right += (pull[:, None] * values.numpy())[rows]
    filled = values.clone()
    filled[unknown] = torch.from_numpy(SparseCholesky(system[rows][:, rows]).solve(right))
    return filled
