"""Landmarks where no face has them: outliers of a robust fit of the rig's landmarks to each frame."""

import torch
from torch import Tensor

from torchface.capture.own_rig.face_points import EYE_CORNERS, JAW, LANDMARKS
from torchface.errors import ShapeError
from torchface.rig import BlendshapeRig

# Of the distance of the eyes' outer corners. What rig and person differ by, perspective and noise; landmarks of the
# contour slide toward the nose as a face turns.
_MARGIN, _CONTOUR_MARGIN = 0.35, 0.9
_COMBINED = 1.5  # shapes together move a landmark this much further than the one that moves it most
_LONE, _LONE_MOTION = 0.2, 6.0  # a landmark away for a frame or two; the second a second, for frames further apart
_WINDOW = 5
_MIN_LANDMARKS = 8
_STEPS, _LEAST, _SMALL = 12, 1e-3, 0.2


def landmark_reach(rig: BlendshapeRig) -> tuple[Tensor, Tensor]:
    """A rig's 68 landmarks at rest, (68,3) float64 millimetres, and how far one shape moves each at most, (68,)."""
    marks = rig.neutral.landmarks
    moved = rig.deltas[:, marks].detach().double().norm(dim=2)
    return rig.vertices[marks].detach().double(), moved.amax(0) if len(moved) else moved.new_zeros(LANDMARKS)


def outlier_landmarks(
    rest: Tensor, reach: Tensor, landmarks: Tensor, trust: Tensor, fps: float | None = None
) -> Tensor:
    r"""Which landmarks lie where no pose and no expression of the rig puts them.

    .. math:: \min_{A_t, b_t} \sum_l c_{tl} \lVert A_t x_l + b_t - q_{tl} \rVert

    in each frame: an affine camera under a robust loss. A landmark is an outlier where its residual is larger than the
    rig's expressions and 0.35 of the eyes' distance (contour: 0.9) allow, or differs by 0.2 of that distance from its
    own median over five frames: faces move, they do not jump for a frame.

    Args:
        rest: x, the rig's landmarks, (68,3), millimetres.
        reach: how far one shape moves each at most, (68,), millimetres.
        landmarks: q, (T,68,2) pixels; NaN for not seen.
        trust: c, (T,68); those of 0 neither count nor are judged.
        fps: frames a second; frames are judged apart from each other if absent.

    Returns:
        (T,68) bool; false in frames with fewer than eight trusted landmarks.

    Example:
        >>> from torchface.synthetic import performer
        >>> rest, reach = landmark_reach(performer(texture=False))
        >>> pixels = (rest[:, :2] * torch.tensor([2.0, -2.0]) + 300).expand(20, 68, 2).clone()
        >>> pixels[7, 33] = 20_000
        >>> outlier_landmarks(rest, reach, pixels, torch.ones(20, 68), 30.0).nonzero().tolist()
        [[7, 33]]
    """
    if landmarks.shape[1:] != (LANDMARKS, 2) or trust.shape != landmarks.shape[:2] or rest.shape != (LANDMARKS, 3):
        raise ShapeError(
            f"outlier landmarks: found rest {tuple(rest.shape)}, landmarks {tuple(landmarks.shape)} and trust "
            f"{tuple(trust.shape)}, expected ({LANDMARKS},3), (T,{LANDMARKS},2) and (T,{LANDMARKS})"
        )
    with torch.no_grad():
        residual = landmark_residuals(rest, landmarks, trust)
        judged = torch.isfinite(residual).all(-1)
        allowed = torch.full_like(reach.to(residual), _MARGIN)
        allowed[:JAW] = _CONTOUR_MARGIN
        eyes = (rest[EYE_CORNERS[0]] - rest[EYE_CORNERS[1]]).norm().to(residual)
        outliers = judged & ~(residual.norm(dim=-1) <= allowed + _COMBINED * reach.to(residual) / eyes)
        if fps is not None:
            usual = _running_median(torch.where((judged & ~outliers)[..., None], residual, torch.nan))
            outliers |= judged & ((residual - usual).norm(dim=-1) > max(_LONE, _LONE_MOTION / fps))
    return outliers


def landmark_residuals(rest: Tensor, landmarks: Tensor, trust: Tensor) -> Tensor:
    """Where landmarks (T,68,2) lie beside the robust fit of a rig's (68,3) to each frame, in distances of the eyes.

    (T,68,2) float64; NaN for those that are not trusted (T,68), and in frames with fewer than eight that are.
    """
    q = landmarks.detach().double()
    seen = torch.isfinite(q).all(-1) & (trust > 0)
    weight = torch.where(seen, trust.double().clamp(max=1.0), 0.0)
    weight[seen.sum(1) < _MIN_LANDMARKS] = 0.0
    residual = _residuals(rest.to(q), torch.where(seen[..., None], q, 0.0), weight)
    return torch.where((weight > 0)[..., None], residual, torch.nan)


def _residuals(rest: Tensor, q: Tensor, weight: Tensor) -> Tensor:
    """Of landmarks beside the robust fit of each frame, (T,68,2), in distances of the eyes' outer corners."""
    x = torch.nn.functional.pad((rest - rest.mean(0)) / (rest - rest.mean(0)).norm(dim=1).mean(), (0, 1), value=1.0)
    eyes = (x[EYE_CORNERS[0]] - x[EYE_CORNERS[1]]).norm()
    relative, factor = q, weight
    for _ in range(_STEPS):  # each step's weights are by the residuals of the one before
        by_weight = factor[..., None] * x
        normal = x.T @ by_weight + 1e-9 * torch.eye(4, dtype=q.dtype, device=q.device)
        affine = torch.linalg.solve(normal, by_weight.transpose(1, 2) @ q)
        # The image of the eyes' distance as a camera straight ahead has it: by the affine map's larger singular value.
        (a, b), (_, c) = (affine[:, :3].transpose(1, 2) @ affine[:, :3]).permute(1, 2, 0)
        scale = eyes * (0.5 * (a + c + ((a - c).square() + 4 * b.square()).sqrt())).clamp(min=1e-18).sqrt()
        relative = (q - x @ affine) / scale[:, None, None]
        size = relative.norm(dim=-1)
        if float((size * (weight > 0)).max()) < _SMALL:  # least squares spread an outlier, but leave most of it
            break
        least = _LEAST * torch.where(weight > 0, size, torch.nan).nanmedian(1, keepdim=True).values.nan_to_num(1.0)
        factor = weight / size.clamp(min=least.clamp(min=1e-9))
    return relative


def _running_median(values: Tensor) -> Tensor:
    """Of (T,68,2) along time, NaN left out; frames beside the first and last are not made up."""
    edge = values.new_full((_WINDOW // 2, *values.shape[1:]), torch.nan)
    return torch.cat([edge, values, edge]).unfold(0, _WINDOW, 1).nanmedian(-1).values
