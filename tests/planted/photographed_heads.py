"""Planted heads, and the landmarks that cameras see of them."""

from dataclasses import dataclass

import torch
import trimesh
from torch import Tensor

from torchface import Mesh
from torchface.geometry.cameras.pinhole import Camera, look_at
from torchface.geometry.similarity import similarity_transform
from torchface.modeling.morphable.head_model import HeadModel
from torchface.rig import BlendshapeRig

SIZE = (1280, 1024)


EXPRESSION = {"jawOpen": 0.3, "mouthSmileLeft": 0.7, "mouthSmileRight": 0.6, "browInnerUp": 0.5}


@dataclass(frozen=True, eq=False)
class Person:
    """A planted head and what cameras see of it."""

    coefficients: Tensor
    weights: Tensor
    rest: Tensor
    face: Tensor
    cameras: list[Camera]
    landmarks: Tensor

    @property
    def focal(self) -> float:
        return float(self.cameras[0].intrinsics[0, 0])


def portraits(face: Tensor, rig: BlendshapeRig) -> list[Camera]:
    centre = face[rig.neutral.landmarks].mean(0)
    return [look_at(centre, yaw, 3.0, span=300.0, width=SIZE[0], height=SIZE[1]) for yaw in (-40.0, 0.0, 40.0)]


def person(
    rig: BlendshapeRig, model: HeadModel, seed: int, noise: float = 0.5, weights: Tensor | None = None
) -> Person:
    """Three portraits of a head of the model, as landmarks."""
    generator = torch.Generator().manual_seed(seed)
    coefficients = torch.randn(model.shape.count, generator=generator)
    if weights is None:
        weights = torch.zeros(len(rig.names))
        weights[rig.index(list(EXPRESSION))] = torch.tensor(list(EXPRESSION.values()))
    rest = model.shape(coefficients[None])[0]
    face = rest + rig(weights[None])[0] - rig.vertices
    cameras = portraits(face, rig)
    seen = torch.stack([camera.project(face[rig.neutral.landmarks].double()) for camera in cameras])
    seen = seen + noise * torch.randn(seen.shape, generator=generator).double()
    return Person(coefficients, weights, rest, face, cameras, seen)


def aligned_error(found: Tensor, true: Tensor) -> float:
    moved = similarity_transform(found[None].double(), true[None].double()).apply(found[None].double())[0]
    return float((moved - true.double()).norm(dim=-1).mean())


def bent(head: Mesh) -> Tensor:
    """Smooth displacements (V,3) of a head: nose, chin, brow and cheeks of another form, 6 mm out and in."""
    at = head.vertices[head.landmarks[[30, 8, 27]]].double()
    cheeks = head.vertices[head.landmarks[[41, 46]]].double() + torch.tensor([0.0, -25.0, 0.0])
    near = torch.exp(-torch.cdist(head.vertices.double(), torch.cat([at, cheeks])).square() / (2 * 15.0**2))
    ways = torch.tensor([-6.0, 6.0, 6.0, 6.0, -6.0], dtype=torch.float64)
    return (near @ ways)[:, None] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def to_surface(points: Tensor, mesh: Mesh) -> float:
    """The mean distance of points (P,3) to a mesh after the best similarity, millimetres."""
    true = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
    for _ in range(8):
        near, _, _ = trimesh.proximity.closest_point(true, points.numpy())
        points = similarity_transform(points[None], torch.from_numpy(near)[None]).apply(points[None])[0]
    return float(trimesh.proximity.closest_point(true, points.numpy())[1].mean())
