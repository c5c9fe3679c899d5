"""Polygons between the two ways of writing them: counts with a flat list of corners, and rows padded with -1."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.mesh import Mesh

MESHING = (
    "MeshLab makes a mesh of points: Compute normals for point sets, then Surface Reconstruction: Screened Poisson"
)
"""What to do with a file of points without faces."""

_MAX_TABLE = 20_000_000


def pad_polygons(source: str, sizes: NDArray[np.int64], corners: NDArray[np.int64]) -> Tensor:
    """Rows (P,K) padded with -1 from corner counts (P,) and all corners in a line (C,)."""
    widest, largest = int(sizes.max()), max(_MAX_TABLE, 3 * len(corners) // 2)
    if len(sizes) * widest > largest:
        raise FileFormatError(
            f"{source}: found a polygon of {widest} corners among {len(sizes)} faces, "
            f"expected at most {largest // len(sizes)} corners; triangulate it"
        )
    if len(sizes) * widest == len(corners):
        return torch.from_numpy(corners.reshape(-1, widest))
    padded = np.full((len(sizes), widest), -1, dtype=np.int64)
    padded[np.arange(widest) < sizes[:, None]] = corners
    return torch.from_numpy(padded)


def corners_of_polygons(mesh: Mesh) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """A mesh's faces as authored: corner counts (P,), vertex ids (C,), rows of ``mesh.uvs`` (C,) or (0,) without."""
    if mesh.polygons is None:
        sizes = np.full(len(mesh.faces), 3, dtype=np.int64)
    else:
        sizes = (mesh.polygons >= 0).sum(1).cpu().numpy()
    corners = corners_of_fans(sizes, mesh.faces.cpu().numpy())
    uv_corners = np.zeros(0, np.int64) if mesh.uv_faces is None else corners_of_fans(sizes, mesh.uv_faces.cpu().numpy())
    return sizes, corners, uv_corners


def corners_of_fans(sizes: NDArray[np.int64], faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """The corners (C,) of polygons with ``sizes`` (P,) corners, whose fan triangulation is ``faces`` (F,3)."""
    first = np.cumsum(sizes - 2) - (sizes - 2)  # each polygon's first triangle
    start = np.cumsum(sizes) - sizes
    corners = np.empty(int(sizes.sum()), dtype=np.int64)
    # A fan's corners are the first two of its first triangle, then the third of each.
    corners[start], corners[start + 1] = faces[first, 0], faces[first, 1]
    third = np.ones(len(corners), dtype=bool)
    third[start] = third[start + 1] = False
    corners[third] = faces[:, 2]
    return corners
