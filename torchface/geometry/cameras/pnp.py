"""Pose of a camera from points that it sees: the perspective-n-point problem."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import AlignmentError, ShapeError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix

_MIN_POINTS = 4
_MIN_DEPTH = 1e-3  # of the points' own size; what is nearer to the camera than this counts as behind it
_FLAT = 1e-2  # relative; points that extend less in their third direction count as flat at first
_ORTHOGRAPHIC_ITERATIONS, _MAX_ITERATIONS, _DONE = 5, 60, 1e-10


@dataclass(frozen=True, eq=False)
class Pose:
    """World to camera for a batch."""

    rotation: Tensor  # (B,3,3)
    translation: Tensor  # (B,3), millimetres
    errors: Tensor  # reprojection, weighted root mean square, (B,), pixels


def solve_pnp(
    points: Tensor, pixels: Tensor, intrinsics: Tensor, weights: Tensor | None = None, initial: Pose | None = None
) -> Pose:
    r"""The poses in which a camera sees points where they are seen, with least squared error; float64.

    .. math:: \min_{R,t} \sum_i w_i \lVert \pi(K (R x_i + t)) - q_i \rVert^2, \quad R \in SO(3)

    Initialised by iterated scaled orthography (POSIT; for flat points from both of its mirrored answers), refined by
    Levenberg's method in float64.

    Args:
        points: :math:`x`, (B,N,3) or (N,3) for all, millimetres.
        pixels: :math:`q`, (B,N,2); a NaN row counts as not seen.
        intrinsics: K, (B,3,3) or (3,3).
        weights: non-negative, (B,N) or (N,); equal if absent.
        initial: poses to refine; found from nothing if absent.

    Source: thesis 3.2.5, equation 12; DeMenthon and Davis 1995.
    """
    x, q, K, w = _checked(points, pixels, intrinsics, weights)
    inverse = torch.linalg.inv(K)
    rays = torch.nn.functional.pad(q, (0, 1), value=1.0) @ inverse.transpose(-1, -2)
    if initial is not None:
        best = refined_poses(x, q, K, w, initial.rotation.double(), initial.translation.double())
    else:
        rotation, translation, normal, flat = _orthographic_pose(x, rays[..., :2] / rays[..., 2:], w)
        best = refined_poses(x, q, K, w, rotation, translation)
        if flat.any():
            best = _better(best, refined_poses(x, q, K, w, *_mirrored(x, w, best, normal)))
    if not torch.isfinite(best.errors).all():
        bad = (~torch.isfinite(best.errors)).nonzero()[:, 0].tolist()
        raise AlignmentError(f"solve_pnp: found no pose with all points in front of the camera in views {bad[:5]}")
    return best


def pixel_jacobian(seen: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (B,N,2) of points (B,N,3) in the camera's frame, and their derivatives: (B,N,2,3)."""
    image = seen @ intrinsics.transpose(-1, -2)
    depth = image[..., 2:]
    pixels = image[..., :2] / depth
    rows = intrinsics[..., None, :2, :] - pixels[..., None] * intrinsics[..., None, 2:, :]
    return pixels, rows / depth[..., None]


def _checked(
    points: Tensor, pixels: Tensor, intrinsics: Tensor, weights: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    count = pixels.shape[1] if pixels.ndim == 3 else -1
    fits = pixels.ndim == 3 and pixels.shape[2] == 2 and points.shape[-2:] == (count, 3)
    if not fits or points.ndim not in (2, 3) or (points.ndim == 3 and len(points) != len(pixels)):
        raise ShapeError(
            f"solve_pnp: found points {tuple(points.shape)} and pixels {tuple(pixels.shape)}, expected (B,N,3) or "
            "(N,3), and (B,N,2)"
        )
    if intrinsics.shape[-2:] != (3, 3) or intrinsics.ndim > 3 or intrinsics.shape[:-2] not in ((), (len(pixels),)):
        raise ShapeError(f"intrinsics: found {tuple(intrinsics.shape)}, expected (3,3) or ({len(pixels)},3,3)")
    q = pixels.detach().double()
    seen = torch.isfinite(q).all(-1)
    w = torch.ones_like(seen, dtype=torch.float64) if weights is None else weights.detach().double().expand(seen.shape)
    if not torch.isfinite(w).all() or (w < 0).any():
        raise ValueRangeError("solve_pnp: found a negative or infinite weight, expected finite ones of at least 0")
    w = w * seen
    counts = (w > 0).sum(1)
    if bool((counts < _MIN_POINTS).any()):
        raise ValueRangeError(
            f"solve_pnp: found {int(counts.min())} points seen in view {int(counts.argmin())}, "
            f"expected at least {_MIN_POINTS}"
        )
    x = points.detach().double().expand(len(q), -1, -1)
    if not torch.isfinite(x[w > 0]).all():
        raise ValueRangeError("solve_pnp: found NaN or infinite points, expected finite millimetres")
    x = torch.where((w > 0)[..., None], x, 0.0)
    return x, torch.where(seen[..., None], q, 0.0), intrinsics.detach().double().expand(len(q), 3, 3), w


def _orthographic_pose(x: Tensor, rays: Tensor, w: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rotation, translation, the direction (B,3) in which points extend least, and whether they are flat, (B,).

    ``rays`` (B,N,2) are pixels of a camera with K = I.
    """
    weight = (w / w.sum(1, keepdim=True))[..., None]
    centre = (weight * x).sum(1, keepdim=True)
    u, singular, vh = torch.linalg.svd((x - centre) * weight.sqrt(), full_matrices=False)
    if (singular[:, 1] <= 1e-6 * singular[:, 0]).any():
        raise AlignmentError("solve_pnp: found points that lie on a line, expected some beside it")
    flat = singular[:, 2] < _FLAT * singular[:, 0]
    kept = torch.where(flat[:, None] & (torch.arange(3, device=x.device) == 2), torch.inf, singular)
    inverse = vh.transpose(-1, -2) @ (u / kept[:, None, :]).transpose(-1, -2)
    normal = vh[:, 2]
    deeper = torch.zeros_like(x[..., 0])
    for _ in range(_ORTHOGRAPHIC_ITERATIONS):  # each corrects for perspective with the depths of the one before
        goal = rays * (1 + deeper)[..., None]
        middle = (weight * goal).sum(1, keepdim=True)
        ij = (inverse @ ((goal - middle) * weight.sqrt())).transpose(-1, -2)
        i, j = (ij + torch.where(flat[:, None, None], _out_of_plane(ij, normal), 0.0)).unbind(1)
        scale = (i.norm(dim=-1) * j.norm(dim=-1)).sqrt().clamp(min=1e-12)
        rows = torch.stack([i, j, torch.linalg.cross(i, j) / scale[:, None]], dim=1) / scale[:, None, None]
        a, _, b = torch.linalg.svd(rows)
        rotation = a @ b
        deeper = ((x - centre) @ rotation[:, 2, :, None])[..., 0] * scale[:, None]
        deeper = deeper.clamp(-0.5, 0.5)
    depth = 1 / scale[:, None]
    translation = torch.cat([middle[:, 0] * depth, depth], dim=1) - (rotation @ centre.transpose(-1, -2))[..., 0]
    # In front of the camera, whatever the first guess was.
    lack = _MIN_DEPTH * singular[:, 0] - ((x @ rotation.transpose(-1, -2))[..., 2] + translation[:, 2:]).amin(1)
    translation[:, 2] += 2 * lack.clamp(min=0)
    return rotation, translation, normal, flat


def _out_of_plane(ij: Tensor, normal: Tensor) -> Tensor:
    """What flat points leave open of the two rows (B,2,3): (λ, μ) times the normal, so that they are orthonormal."""
    i, j = ij.unbind(1)
    product, difference = -(i * j).sum(-1), j.square().sum(-1) - i.square().sum(-1)
    first = (0.5 * (difference + (difference.square() + 4 * product.square()).sqrt())).clamp(min=0).sqrt()
    second = torch.where(first > 1e-12, product / first.clamp(min=1e-12), (-difference).clamp(min=0).sqrt())
    return torch.stack([first, second], dim=1)[..., None] * normal[:, None]


def _mirrored(x: Tensor, w: Tensor, pose: Pose, normal: Tensor) -> tuple[Tensor, Tensor]:
    """The pose in which flat points look nearly the same: tilted the other way about the line of sight."""
    centre = (w[..., None] * x).sum(1) / w.sum(1, keepdim=True)
    middle = (pose.rotation @ centre[..., None])[..., 0] + pose.translation
    sight = torch.nn.functional.normalize(middle, dim=-1)
    identity = torch.eye(3, dtype=x.dtype, device=x.device)
    through, across = (identity - 2 * v[:, :, None] * v[:, None, :] for v in (sight, normal))
    rotation = through @ pose.rotation @ across
    return rotation, middle - (rotation @ centre[..., None])[..., 0]


def _better(one: Pose, other: Pose) -> Pose:
    better = other.errors < one.errors
    return Pose(
        torch.where(better[:, None, None], other.rotation, one.rotation),
        torch.where(better[:, None], other.translation, one.translation),
        torch.where(better, other.errors, one.errors),
    )


def refined_poses(x: Tensor, q: Tensor, K: Tensor, w: Tensor, rotation: Tensor, translation: Tensor) -> Pose:
    """Poses after Levenberg's method from initial ones, of points (B,N,3) and pixels (B,N,2), checked, float64;
    errors are infinite where points stay behind the camera."""
    min_depth = _MIN_DEPTH * (x - x.mean(1, keepdim=True)).norm(dim=-1).amax(1)
    damping = torch.full_like(translation[:, 0], 1e-4)
    error = _error(x, q, K, w, rotation, translation, min_depth)
    total, going = w.sum(1), torch.arange(len(x), device=x.device)
    settled_poses = Pose(rotation.clone(), translation.clone(), error.clone())
    for _ in range(_MAX_ITERATIONS):
        pixels, jacobian = _jacobian(x @ rotation.transpose(-1, -2), translation, K)
        weighted = (jacobian * w.repeat_interleave(2, dim=1)[..., None]).transpose(-1, -2)
        H = weighted @ jacobian
        g = weighted @ (pixels - q).flatten(1)[..., None]
        H = H + torch.diag_embed(damping[:, None] * H.diagonal(dim1=1, dim2=2) + 1e-12)
        step = -torch.linalg.solve(H, g)[..., 0]
        next_rotation, next_translation = rotation_matrix(step[:, :3]) @ rotation, translation + step[:, 3:]
        reached = _error(x, q, K, w, next_rotation, next_translation, min_depth)
        better = reached < error
        rotation = torch.where(better[:, None, None], next_rotation, rotation)
        translation = torch.where(better[:, None], next_translation, translation)
        settled = (better & (error - reached < _DONE * error)) | (~better & (damping > 1e6)) | (error < 1e-20)
        error = torch.where(better, reached, error)
        damping = torch.where(better, damping * 0.1, damping * 10).clamp(min=1e-12)
        if bool(settled.any()):  # views that are done wait for no other
            settled_poses.rotation[going], settled_poses.translation[going], settled_poses.errors[going] = (
                rotation,
                translation,
                error,
            )
            left = (~settled).nonzero()[:, 0]
            going, x, q, K, w = going[left], x[left], q[left], K[left], w[left]
            rotation, translation, error, damping = rotation[left], translation[left], error[left], damping[left]
            min_depth = min_depth[left]
            if not len(left):
                break
    settled_poses.rotation[going], settled_poses.translation[going], settled_poses.errors[going] = (
        rotation,
        translation,
        error,
    )
    return Pose(settled_poses.rotation, settled_poses.translation, (settled_poses.errors / total).sqrt())


def _jacobian(rotated: Tensor, translation: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (B,N,2) of points rotated into the camera's frame (B,N,3), and their derivatives: (B,2N,6)."""
    pixels, by_translation = pixel_jacobian(rotated + translation[:, None], K)
    # A rotation by r moves the point s by r x s, so the pixel by (s x a) r where a translation by m moves it by a m.
    by_rotation = torch.linalg.cross(rotated[:, :, None].expand_as(by_translation), by_translation)
    return pixels, torch.cat([by_rotation, by_translation], dim=-1).flatten(1, 2)


def _error(
    x: Tensor, q: Tensor, K: Tensor, w: Tensor, rotation: Tensor, translation: Tensor, min_depth: Tensor
) -> Tensor:
    """Weighted squared error (B,); infinite where a point lies behind the camera."""
    seen = x @ rotation.transpose(-1, -2) + translation[:, None]
    image = seen @ K.transpose(-1, -2)
    squared = (image[..., :2] / image[..., 2:] - q).square().sum(-1) * w
    behind = ((seen[..., 2] < min_depth[:, None]) & (w > 0)).any(1)
    return torch.where(w > 0, squared, 0.0).sum(1).masked_fill(behind, torch.inf)
