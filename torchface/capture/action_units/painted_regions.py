"""Regions of the face sampled from every frame, stabilised, at one size."""

import warnings
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from torchface.errors import NameMismatchError, ValueRangeError
from torchface.io.action_labels import ActionLabels, Box, RegionGroup

GROUPS: tuple[RegionGroup, ...] = (
    RegionGroup("forehead", ("brow_left", "brow_right"), ("1+2", "4")),
    RegionGroup("between_brows", ("between_brows",), ("9",), ("1+2", "4")),
    RegionGroup("eyes", ("eye_left", "eye_right"), ("7", "45", "6+43"), ("4",)),
    RegionGroup("mouth", ("mouth",), ("18L", "18R"), ("9",)),
)
"""The forehead's two regions and the two eyes merge their features; ``18L``, ``18R`` are lip puckers to either side.

Between the brows AU 4 shows too, but other performers' lowered brows are classified better by the strokes over them.
"""


def performed_groups(labels: Sequence[ActionLabels]) -> tuple[RegionGroup, ...]:
    """The groups that labels name, or the usual ones, of those units that are performed; warns of others they name."""
    performed = {unit for own in labels for unit in own.units}
    usual = next((own.groups for own in labels if own.groups), GROUPS)
    known = {unit for group in usual for unit in group.units}
    if not performed & known or performed - known - {unit for group in usual for unit in group.other_units}:
        found = ", ".join(sorted(performed)) or "none"
        raise NameMismatchError(
            f"labels: found the units {found}, expected some of {', '.join(sorted(known))}; others need [[groups]] in "
            "the labels, with name, regions and units"
        )
    if usual is not GROUPS and known - performed:
        lacking = ", ".join(sorted(known - performed))
        warnings.warn(f"labels: no frame shows {lacking}, which [[groups]] name; not learned", stacklevel=2)
    shown = [
        RegionGroup(group.name, group.regions, *(tuple(unit for unit in units if unit in performed) for units in both))
        for group in usual
        for both in [(group.units, group.other_units)]
    ]
    return tuple(group for group in shown if group.units)


def region_grid(boxes: Mapping[str, Box], names: Sequence[str], size: int, width: int, height: int) -> Tensor:
    """The pixels (R,size,size,2) of a neutral image at which regions in boxes (left, top, right, bottom) are read."""
    lacking = [name for name in names if name not in boxes]
    if lacking:
        raise NameMismatchError(f"regions: found no {', '.join(lacking)}, expected {', '.join(names)}")
    grids = []
    for name in names:
        left, top, right, bottom = boxes[name]
        if left < -0.5 or top < -0.5 or right > width - 0.5 or bottom > height - 0.5:
            raise ValueRangeError(
                f"region {name!r} is ({left:.1f}, {top:.1f}) to ({right:.1f}, {bottom:.1f}), expected it inside the "
                f"image of {width} x {height} pixels"
            )
        step = (torch.arange(size) + 0.5) / size
        y, x = torch.meshgrid(top + (bottom - top) * step, left + (right - left) * step, indexing="ij")
        grids.append(torch.stack([x, y], dim=-1))
    return torch.stack(grids).float()


def sample_regions(frames: Tensor, grid: Tensor, transforms: Tensor) -> Tensor:
    """Regions (t,R,h,w) of frames (t,H,W) at pixels (R,h,w,2) of the neutral image, which (t,2,3) transform to the
    frames."""
    regions, height, width = grid.shape[:3]
    pixels = torch.einsum("nc,tdc->tnd", grid.reshape(-1, 2), transforms[..., :2]) + transforms[:, None, :, 2]
    size = torch.tensor([frames.shape[2], frames.shape[1]], dtype=torch.float32)
    places = (2 * pixels + 1) / size - 1
    sampled = grid_sample(
        frames[:, None], places.view(len(frames), -1, width, 2), padding_mode="border", align_corners=False
    )
    return sampled.view(len(frames), regions, height, width)
