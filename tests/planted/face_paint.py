"""Face paint for the embedded head: a mask round the eyes, stripes on the cheeks, red lips; with transparency."""

import torch
from torch import Tensor

from torchface.synthetic.head.head_annotations import head_annotations
from torchface.synthetic.head.identity import ramp, sculpted_vertices
from torchface.synthetic.head.skin_texture import texel_values

_BLUE, _GOLD, _RED = (0.05, 0.30, 0.42), (0.95, 0.75, 0.20), (0.62, 0.04, 0.12)
_STRIPES = (34.0, 44.0, 54.0)  # millimetres aside of the middle


def face_paint(size: int = 1024) -> Tensor:
    """Red, green, blue and alpha in the texture coordinates that all performers share, (4,size,size), first row on top.

    Args:
        size: pixels a side.
    """
    regions = head_annotations().regions
    lips = (regions["upper_lip"] | regions["lower_lip"]).float()[:, None]
    texels, values = texel_values(size, torch.cat([sculpted_vertices().float(), lips], dim=1))
    x, y, front = values[:, 0].abs(), values[:, 1], values[:, 2] > 20
    eyes = ((x - 30) / 30) ** 2 + ((y - 3 - 0.18 * (x - 30)) / 19) ** 2
    outline = torch.minimum(eyes, (x / 14) ** 2 + ((y - 2) / 11) ** 2)  # 1 at the edge of the mask
    mask = (1 - ramp(outline, 0.94, 1.06)) * front
    rim = (1 - (outline - 0.98).abs() / 0.10).clamp(0, 1) * front
    on_cheek = front & (y < -22) & (y > -62)
    stripes = torch.stack([1 - ramp((x - at - 0.15 * (y + 30)).abs(), 1.8, 2.8) for at in _STRIPES]).amax(0) * on_cheek
    layers = ((_BLUE, 0.92 * mask), (_GOLD, 0.95 * rim), (_GOLD, 0.9 * stripes))
    paint = torch.zeros(len(values), 4)
    for color, share in (*layers, (_RED, 0.8 * ramp(values[:, 3], 0.35, 0.75))):  # each over the ones before
        paint[:, :3] = torch.lerp(paint[:, :3], torch.tensor(color).expand(len(values), 3), _over(share, paint[:, 3]))
        paint[:, 3] = share + paint[:, 3] * (1 - share)
    image = torch.zeros(size * size, 4)
    image[texels.texels] = paint
    return image.T.reshape(4, size, size).contiguous()


def _over(share: Tensor, below: Tensor) -> Tensor:
    """How much of the mixed colour is the upper one, (N,1), where the lower lies on nothing."""
    total = share + below * (1 - share)
    return (share / total.clamp(min=1e-6))[:, None]
