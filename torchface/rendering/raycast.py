"""Rays against a triangle mesh, by Embree."""

from dataclasses import dataclass

import numpy as np
import torch
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from torch import Tensor

from torchface.errors import ShapeError


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays hit: ``triangle`` (R,) is -1 for a miss, ``barycentric`` (R,3), ``distance`` (R,) along the ray."""

    triangle: Tensor
    barycentric: Tensor
    distance: Tensor


class RayCaster:
    """A mesh prepared for ray casting.

    Embree keeps single precision, so the mesh is moved to its own centre first.
    """

    def __init__(self, vertices: Tensor, faces: Tensor) -> None:
        self._centre = vertices.double().mean(0)
        self._scene = rtcore_scene.EmbreeScene()
        # Embree's binding takes a microsecond for each vertex, which those of other parts of a head need not cost.
        used = torch.zeros(len(vertices), dtype=torch.bool, device=faces.device)
        used[faces.flatten()] = True
        rows = (used.cumsum(0) - 1).to(torch.int32)[faces]
        centred = (vertices.double() - self._centre)[used.to(vertices.device)].float().cpu().numpy()
        TriangleMesh(self._scene, centred.astype(object), rows.cpu().numpy().astype(object))  # it reads Python's sooner

    def cast(self, origins: Tensor, directions: Tensor) -> Hits:
        """The first hit of each ray; origins and unit directions (R,3)."""
        starts, ways = self._prepare(origins, directions)
        result = self._scene.run(starts, ways, output=True)
        triangle = torch.from_numpy(result["primID"].astype(np.int64))
        u, v = torch.from_numpy(result["u"]), torch.from_numpy(result["v"])
        barycentric = torch.stack([1 - u - v, u, v], dim=-1)
        distance = torch.from_numpy(result["tfar"].astype(np.float64))
        missed = triangle < 0
        return Hits(triangle, barycentric.masked_fill(missed[:, None], 0.0), distance.masked_fill(missed, torch.inf))

    def distances(self, origins: Tensor, directions: Tensor, reach: float) -> Tensor:
        """How far each ray gets, at most ``reach``, (R,) float32; cheaper than ``cast``."""
        starts, ways = self._prepare(origins, directions)
        return torch.from_numpy(self._scene.run(starts, ways, np.float32(reach), query="DISTANCE"))

    def occluded(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Whether anything stands in a ray's way, (R,) bool."""
        starts, ways = self._prepare(origins, directions)
        return torch.from_numpy(self._scene.run(starts, ways, query="OCCLUDED").astype(np.int64)) >= 0

    def _prepare(self, origins: Tensor, directions: Tensor) -> tuple[np.ndarray, np.ndarray]:
        if origins.shape != directions.shape or origins.ndim != 2 or origins.shape[1] != 3:
            raise ShapeError(f"rays: found {tuple(origins.shape)} and {tuple(directions.shape)}, expected (R,3) twice")
        starts = (origins - self._centre).numpy().astype(np.float32, copy=False)
        return np.ascontiguousarray(starts), np.ascontiguousarray(directions.numpy().astype(np.float32, copy=False))
