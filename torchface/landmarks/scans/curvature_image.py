"""An image of form alone: shaded curvature, for scans without texture and for what should not depend on paint."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.landmarks.scans.cylinder import UnwrappedHead
from torchface.rendering.gaussian_blur import gaussian_blur


def curvature_image(head: UnwrappedHead, scale: float = 1.2, contrast: float = 8.0) -> Tensor:
    r"""Mean curvature of the unwrapped surface as grey: ridges bright, creases dark.

    .. math:: g = \tfrac12 + \tfrac12 \tanh(c H), \quad
       H = \tfrac12 \Big(\frac{n_u \cdot x_u}{x_u \cdot x_u} + \frac{n_v \cdot x_v}{x_v \cdot x_v}\Big)

    with x the surface after a Gaussian blur of its distance from the axis, n its unit normal, u and v along the
    image's axes (that they stay nearly perpendicular is the approximation).

    Between closed lids there is no furrow that a hand-held scanner resolves: the deepest one runs some 3 mm above the
    line where they meet. Tracing in this image therefore goes by the learned look of the line, not by darkness.

    Args:
        head: an unwrapped scan.
        scale: standard deviation of the blur, millimetres: below it all is scanner noise.
        contrast: c, millimetres.

    Returns:
        (1,S,S) in [0,1].

    Example:
        >>> from torchface.landmarks import CylinderLayout, unwrap
        >>> from torchface.geometry.similarity import Similarity
        >>> from torchface.synthetic import neutral_head
        >>> still = Similarity(torch.ones(1), torch.eye(3)[None], torch.zeros(1, 3))
        >>> grey = curvature_image(unwrap(neutral_head(texture=False), still, CylinderLayout(size=64, pitch=4.0)))
        >>> bool(grey.min() >= 0), bool(grey.max() <= 1)
        (True, True)
    """
    layout = head.layout
    smooth = gaussian_blur(head.radius[None, None], scale / layout.pitch)[0, 0].double()
    surface = layout.points(layout.grid(), smooth)
    along_x, along_y = _difference(surface, 1), _difference(surface, 0)
    normal = torch.nn.functional.normalize(torch.linalg.cross(along_y, along_x), dim=-1)
    bend = (_difference(normal, 1) * along_x).sum(-1) / along_x.square().sum(-1)
    bend = bend + (_difference(normal, 0) * along_y).sum(-1) / along_y.square().sum(-1)
    return (0.5 + 0.5 * torch.tanh(contrast * 0.5 * bend))[None].float()


def _difference(field: Tensor, axis: int) -> Tensor:
    """Central differences a pixel along an axis; one-sided at the border."""
    return torch.gradient(field, dim=axis)[0]
