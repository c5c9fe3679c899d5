"""Poses from which the wrinkle maps of a rig are learned, and their detail by the actor's model."""

from collections.abc import Callable

import torch
from torch import Tensor

from torchface.enhancement.detail.detail_basis import LearnedBasis, StreamingBasis
from torchface.enhancement.detail.detail_encodings import DisplacementDetail
from torchface.enhancement.enhancement_model import EnhancementModel
from torchface.optim.box_qp import box_qp
from torchface.progress import Progress, silent

_RANK = 64
_BATCH = 8  # frames
_RIDGE = 1e-3  # of a shape's mean effect: shapes that do the same share it
_STRONGEST = 1.2  # of what the actor showed


def captured_poses(model: EnhancementModel, shapes: Tensor) -> Tensor:
    r"""The rig's weights (K,N) in [0,1] that look most like each frame of the actor's.

    .. math:: \min_{0 \le w \le 1} \lVert \textstyle\sum_i w_i z_i - z_k \rVert^2

    over the features of patches, which small deformations add up in.

    Args:
        shapes: :math:`z_i`, features of the rig's shapes at weight 1 on the model's mesh, (N,P,9); see
            ``EnhancementModel.features``.
    """
    areas = model.prepared.patch_weights.sum(0).double()
    root = (areas / areas.sum()).sqrt()[:, None]
    own = (shapes.double() * root).flatten(1)
    shown = (model.database_features.double() * root).flatten(1)
    gram = own @ own.T
    scale = gram.diagonal().mean().clamp(min=1e-30)
    ridge = _RIDGE * torch.eye(len(gram), dtype=gram.dtype)
    return box_qp((gram + gram.T) / (2 * scale) + ridge, -(shown @ own.T) / scale).float()


def teaching_poses(captured: Tensor, areas_moved: Tensor, count: int) -> Tensor:
    """Poses (count,N) that weights are learned from: each shape alone; then the actor's own (K,N), evenly picked;
    half of the rest are mixtures of two of them, region by region, as far as each shape moves it (R,N)."""
    generator = torch.Generator().manual_seed(0)
    shapes = captured.shape[1]
    left = max(0, count - shapes)
    own = captured[torch.linspace(0, len(captured) - 1, min(len(captured), (left + 1) // 2)).round().long().unique()]
    mixed = left - len(own)
    first, second = torch.randint(len(captured), (2, mixed), generator=generator)
    # A shape goes with the region that it moves most: halves of faces are mixed, not single shapes.
    region = areas_moved.argmax(0)
    other = (torch.rand(mixed, len(areas_moved), generator=generator) < 0.5)[:, region]
    size = _STRONGEST * torch.rand(mixed, 1, generator=generator).sqrt()
    mixtures = (torch.where(other, captured[second], captured[first]) * size).clamp(0, 1)
    return torch.cat([torch.eye(shapes)[: max(0, count - len(own) - mixed)], own, mixtures])


def taught_details(
    model: EnhancementModel, read: Callable[[int, int], Tensor], count: int, progress: Progress | None = None
) -> LearnedBasis:
    """What the model adds to a rig's frames on its mesh, along two tangents and the normal of the rig's skin,
    (count,3V).

    ``read`` gives the frames (t,V,3) from one number up to another, without it.
    """
    progress = silent if progress is None else progress
    detail = DisplacementDetail(model.neutral, model.faces)
    basis = StreamingBasis(3 * len(model.neutral), min(_RANK, count))
    for begin in range(0, count, _BATCH):  # batches bound the memory
        coarse = read(begin, min(begin + _BATCH, count))
        with torch.no_grad():
            basis.add(detail.encode(coarse, model.enhance(coarse).vertices))
        progress("asking the model for wrinkles", min(begin + _BATCH, count), count)
    return basis.finished()
