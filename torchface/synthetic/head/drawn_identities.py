"""Identities of random people, in which what differs between the sexes goes together."""

import torch
from torch import Tensor

from torchface.synthetic.head.identity import IDENTITY

# How far men's mean lies above women's, in standard deviations within a sex. Lengths: Farkas 1994, Anthropometry of
# the Head and Face; pupils: Dodgson 2004; ridge and forehead: Garvin and Ruff 2012; the signs of the rest are Farkas's,
# their sizes are ours.
_MEN_OVER_WOMEN = {
    "head_length": 1.3, "head_width": 1.2, "face_width": 1.4, "jaw_width": 1.1, "jaw_angle": -0.5, "face_height": 1.5,
    "chin_height": 1.0, "chin_width": 1.0, "chin_protrusion": 0.6, "nose_length": 1.2, "nose_width": 1.3,
    "nose_protrusion": 0.3, "nose_bridge": 0.6, "nose_root": -0.5, "nose_bridge_width": 0.6, "nose_tip_turn": -0.8,
    "pupil_distance": 0.65, "eye_depth": -0.6, "brow_ridge": 1.6, "brow_height": -1.2, "forehead_slope": 1.0,
    "temple_fullness": 0.3, "cheekbones": -0.3, "cheek_fullness": -0.4, "mouth_width": 1.0, "upper_lip": -0.4,
    "lip_fullness": -0.5, "ear_size": 1.1, "neck_width": 2.0, "eye_width": 0.4, "eye_opening": -0.4, "eye_slant": -0.4,
}  # fmt: skip


def draw_identities(count: int, generator: torch.Generator, scale: float = 1.0) -> Tensor:
    """Random heads: coefficients (count,K) in standard deviations, clipped to ±2.5; half are women's, half men's.

    What differs between the sexes goes together: who has a narrow face and jaw has mostly no ridge under the brows.

    Args:
        count: how many heads.
        generator: where the randomness comes from.
        scale: of the standard deviations; 1 is the variation of people.

    Example:
        >>> identities = draw_identities(3, torch.Generator().manual_seed(0))
        >>> identities.shape == (3, len(IDENTITY)), bool(identities.abs().max() <= 2.5)
        (True, True)
    """
    drawn = torch.randn(count, len(IDENTITY), generator=generator, device=generator.device).cpu()
    sex = 1.0 - 2.0 * (torch.rand(count, 1, generator=generator, device=generator.device).cpu() < 0.5)
    half = 0.5 * torch.tensor([_MEN_OVER_WOMEN.get(parameter.name, 0.0) for parameter in IDENTITY])
    return (scale * (drawn + sex * half) / (1 + half**2).sqrt()).clamp(-2.5, 2.5)
