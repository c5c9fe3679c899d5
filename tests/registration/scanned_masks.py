"""A face-like surface by formula, and what a scanner makes of it."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from torchface.mesh import Annotations, Mesh


def _form(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Depth of a mask 160 wide and 220 high: a round shell with nose, chin, brow and two eye hollows."""

    def bump(cx: float, cy: float, sx: float, sy: float) -> torch.Tensor:
        return torch.exp(-(((x - cx) / sx) ** 2) - ((y - cy) / sy) ** 2)

    shell = 90 * (1 - (x / 110) ** 2 - (y / 160) ** 2)
    return shell + 22 * bump(0, -5, 12, 22) + 8 * bump(0, -80, 22, 14) + 5 * bump(0, 45, 45, 10) - (
        9 * bump(-33, 25, 16, 10) + 9 * bump(33, 25, 16, 10) + 4 * bump(0, -45, 25, 5)
    )  # fmt: skip


def _grid(columns: int, rows: int) -> Mesh:
    u, v = torch.meshgrid(torch.linspace(0, 1, columns), torch.linspace(0, 1, rows), indexing="ij")
    x, y = (160 * u - 80).double(), (220 * v - 110).double()
    vertices = torch.stack([x, y, _form(x, y)], dim=-1).reshape(-1, 3)
    ids = torch.arange(columns * rows).reshape(columns, rows)
    a, b, c, d = ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]
    faces = torch.cat([torch.stack([a, b, c], -1).reshape(-1, 3), torch.stack([a, c, d], -1).reshape(-1, 3)])
    picked = [(0.5, 0.48), (0.3, 0.61), (0.7, 0.61), (0.5, 0.3), (0.35, 0.3), (0.65, 0.3), (0.5, 0.14), (0.5, 0.75)]
    landmarks = torch.tensor([int(ids[round(p * (columns - 1)), round(q * (rows - 1))]) for p, q in picked])
    uvs = torch.stack([u, v], dim=-1).reshape(-1, 2)
    return Mesh(vertices, faces, uvs, faces, annotations=Annotations(landmarks=landmarks))


def _warp(points: torch.Tensor) -> torch.Tensor:
    """Another person: wider, a longer nose, a shifted chin; smooth and up to some 12 mm."""
    x, y, z = points.unbind(-1)
    x_new = x * 1.06 + 3 * torch.sin(y / 60)
    y_new = y * 0.96 + 3 * torch.cos(x / 45)
    z_new = z + 5 * torch.sin(x / 50) * torch.cos(y / 70) + 6 * torch.exp(-((x / 14) ** 2) - ((y + 10) / 20) ** 2)
    return torch.stack([x_new, y_new, z_new], dim=-1)


def _moved(points: torch.Tensor, seed: int = 1, scale: float = 1.0) -> torch.Tensor:
    rotation = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    return scale * points @ torch.from_numpy(rotation).T + torch.tensor([40.0, -70.0, 120.0], dtype=torch.float64)


def _rescanned(mesh: Mesh, seed: int = 0, noise: float = 0.05) -> Mesh:
    """Another topology of the same surface: subdivided, every vertex slid into a triangle beside it, with noise."""
    generator = np.random.default_rng(seed)
    vertices, faces = trimesh.remesh.subdivide(mesh.vertices.double().numpy(), mesh.faces.numpy())
    corner = np.full(len(vertices), -1)
    order = generator.permutation(faces.size)
    corner[faces.ravel()[order]] = order
    weights = generator.uniform(0, 0.3, (len(vertices), 3))
    weights[np.arange(len(vertices)), corner % 3] = 1
    slid = (vertices[faces[corner // 3]] * (weights / weights.sum(1, keepdims=True))[..., None]).sum(1)
    rim = np.zeros(len(vertices), dtype=bool)
    rim[np.unique(trimesh.Trimesh(vertices, faces, process=False).outline().vertex_nodes)] = True
    slid[rim] = vertices[rim]
    slid += generator.normal(0, noise, slid.shape)
    return Mesh(torch.from_numpy(slid), torch.from_numpy(faces.astype(np.int64)))


@pytest.fixture(scope="session")
def mask() -> Mesh:
    """The template: 33 x 45 vertices with texture coordinates and eight landmarks, float64."""
    return _grid(33, 45)


@pytest.fixture(scope="session")
def make_mask() -> Callable[[int, int], Mesh]:
    """The same at another resolution."""
    return _grid


@pytest.fixture(scope="session")
def warp() -> Callable[[torch.Tensor], torch.Tensor]:
    """The planted deformation."""
    return _warp


@pytest.fixture(scope="session")
def moved() -> Callable[..., torch.Tensor]:
    """A similarity, by seed and scale."""
    return _moved


@pytest.fixture(scope="session")
def rescanned() -> Callable[..., Mesh]:
    """A scan of a mesh in another topology."""
    return _rescanned
