"""A model of faces fitted to a scan: where the template's vertices lie before they bend freely."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from torchface.errors import ShapeError, TopologyError
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.rotations import cross_matrix
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.mesh import Mesh
from torchface.registration.nonrigid.correspondence import correspondences, evenly_spread

_SAMPLES = 3000
_REACHES = (30.0, 25.0, 20.0, 16.0, 13.0, 10.0, 8.0, 7.0, 6.0, 5.0, 5.0, 5.0, 5.0, 5.0)
_CORRELATED = 20.0
_OUTLYING, _LEAST_OUTLYING = 3.0, 0.5
_LEAST_NOISE, _MAX_NOISE = 0.1, 5.0
_LEAST_LANDMARK_NOISE = 1.5
_MAX_COEFFICIENT = 4.0
_RIDGE = 1e-6


@runtime_checkable
class ShapeModel(Protocol):
    """A mean (V,3) and what one standard deviation of each mode adds to it, (K,V,3), in millimetres."""

    @property
    def mean(self) -> Tensor: ...

    @property
    def modes(self) -> Tensor: ...


@dataclass(frozen=True, eq=False)
class LinearShape:
    """A mean (V,3) and modes (K,V,3) of a model, without the model: what other processes are sent."""

    mean: Tensor
    modes: Tensor

    @staticmethod
    def of(model: ShapeModel) -> "LinearShape":
        """On the CPU, float32."""
        return LinearShape(model.mean.detach().cpu().float(), model.modes.detach().cpu().float())


class HasShape(Protocol):
    """What pairs a model of shape with other things, such as colours."""

    @property
    def shape(self) -> ShapeModel: ...


@dataclass(frozen=True, eq=False)
class ModelFit:
    """A model aligned with a scan."""

    vertices: Tensor  # (V,3) float64, in the scan's space
    coefficients: Tensor  # (K,), standard deviations
    pose: Similarity  # from the model's space to the scan's, a batch of one
    noise: float  # what the model leaves of the distance to the scan, millimetres, a robust standard deviation


def shape_model(model: object, template: Mesh) -> ShapeModel:
    """The model of shape in what was given: itself, or that of a head model."""
    shape = getattr(model, "shape", model)
    if not isinstance(shape, ShapeModel):
        raise ShapeError(f"model: found {type(model).__name__}, expected a model with mean (V,3) and modes (K,V,3)")
    faces = getattr(model, "faces", None)
    if shape.mean.shape != template.vertices.shape or (
        isinstance(faces, Tensor) and not torch.equal(faces.cpu(), template.faces.cpu())
    ):
        raise TopologyError(
            f"model: found a model of {tuple(shape.mean.shape)}, expected the template's topology, "
            f"{len(template.vertices)} vertices and {len(template.faces)} triangles"
        )
    return shape


def fit_to_scan(
    model: ShapeModel,
    faces: Tensor,
    start: Tensor,
    exposed: Tensor,
    scan: SurfaceIndex,
    landmarks: tuple[Tensor, Tensor],
    largest_angle: float,
) -> ModelFit:
    r"""The similarity and coefficients that explain a scan best, by iterated closest points across the surface.

    .. math:: \min_{s,R,t,a} \; \frac{A}{\ell^2 n} \sum_i \frac{w_i}{\nu^2} \big(n_i \cdot (x_i - u_i)\big)^2
        + \sum_l \frac{\lVert x_l - u_l \rVert^2}{\nu_l^2} + \lVert a \rVert^2, \qquad
        x = s R (\bar x + M a) + t

    The noise :math:`\nu` is what the last step has left (1.48 times the median), so that the coefficients come to
    life as the surfaces meet; what lies off by several times as much, such as hair, counts little. What a model cannot
    explain it misses by patches, not by vertices: however many there are, a square of :math:`\ell` = 20 mm counts once.

    Source: Amberg, Knothe, Vetter 2008 (a statistical model in non-rigid ICP); thesis 3.2.3 and 3.2.4.
    """
    mean, modes = model.mean.detach().cpu().double(), model.modes.detach().cpu().double()
    ids, points = landmarks
    chosen = evenly_spread(start, exposed, _SAMPLES)
    corners = start[faces]
    area = float(torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1).sum()) / 2
    area *= len(exposed) / len(start)
    pose = similarity_transform(mean[None], start[None])
    coefficients = torch.zeros(len(modes), dtype=torch.float64)
    noise = _MAX_NOISE
    for reach in _REACHES:
        local = mean + torch.tensordot(coefficients, modes, 1)
        current = pose.apply(local)[0]
        pairs = correspondences(current, faces, chosen, scan, reach, largest_angle)
        left = ((pairs.points - current[chosen]) * pairs.normals).sum(-1)
        used = pairs.weights > 0
        if bool(used.any()):
            noise = min(max(1.4826 * float(left[used].abs().median()), _LEAST_NOISE), _MAX_NOISE)
        # Hair and collars stand off the head: what misses by more than the rest counts little.
        weights = pairs.weights * (1 + (left / max(_OUTLYING * noise, _LEAST_OUTLYING)).square()).pow(-2)
        share = area / _CORRELATED**2 / len(chosen) / noise**2
        centre = current.mean(0)
        rows = _jacobian(modes, current, chosen, pose, centre)  # (n,3,7+K)
        across = (pairs.normals[:, :, None] * rows).sum(1)
        weighted = across * (share * weights)[:, None]
        matrix, downhill = weighted.T @ across, weighted.T @ left
        if len(ids):
            pull = _jacobian(modes, current, ids, pose, centre).flatten(0, 1)
            weight = 1 / max(noise, _LEAST_LANDMARK_NOISE) ** 2
            matrix += weight * pull.T @ pull
            downhill += weight * pull.T @ (points - current[ids]).flatten()
        prior = torch.ones(len(matrix), dtype=torch.float64)
        prior[:7] = _RIDGE * matrix.diagonal()[:7] + 1e-12
        downhill[7:] -= coefficients
        step = torch.linalg.solve(matrix + torch.diag(prior), downhill)
        coefficients = (coefficients + step[7:]).clamp(-_MAX_COEFFICIENT, _MAX_COEFFICIENT)
        growth = step[6:7].clamp(-0.1, 0.1).exp()
        pose = pose.moved(step[None, :3], growth, step[None, 3:6], centre[None])
    return ModelFit(pose.apply(mean + torch.tensordot(coefficients, modes, 1))[0], coefficients, pose, noise)


def _jacobian(modes: Tensor, current: Tensor, ids: Tensor, pose: Similarity, centre: Tensor) -> Tensor:
    """How vertices ``ids`` move with a turn and a growth about the centre, a shift, and the modes, (n,3,7+K)."""
    arm = current[ids] - centre
    shift = torch.eye(3, dtype=torch.float64).expand(len(ids), 3, 3)
    moved = pose.apply_vectors(modes[:, ids].reshape(1, -1, 3))[0].reshape(len(modes), len(ids), 3)
    return torch.cat([-cross_matrix(arm), shift, arm[:, :, None], moved.permute(1, 2, 0)], dim=2)
