"""Check that two meshes of people can be in one unit: heads differ by less than units do."""

import math

from torch import Tensor

from torchface.errors import ValueRangeError

# What a length in millimetres becomes where a file's unit was not the one that it was read with, and the cure.
_LOAD = "load with unit={0!r}; on the command line --unit {0}"
_UNITS = {
    1e-3: ("in metres", _LOAD.format("m")),
    0.1: ("in centimetres", _LOAD.format("cm")),
    1 / 25.4: ("in inches", _LOAD.format("in")),
    10.0: ("in millimetres and were read as centimetres", "leave the unit out"),
    1e3: ("in millimetres and were read as metres", "leave the unit out, or say --unit mm"),
}
LEAST_OF_A_HEAD = 0.3
"""A face's extent in a head's, below which its unit is doubted."""
_NEAR = 6.0  # a scan may show less than the other mesh, or more


def extent(points: Tensor) -> float:
    """The diagonal of the box around points (n,3), such as those that a mesh's triangles use; millimetres."""
    return float((points.amax(0) - points.amin(0)).double().norm())


def check_unit(
    name: str, points: Tensor, beside: float, what: str, least: float, most: float, alone: bool = False
) -> None:
    """Refuses points whose extent is not ``least`` to ``most`` times that of ``what``, ``beside``, millimetres.

    ``alone``: others that are read with them have another unit, so that no option cures these.
    """
    size = extent(points)
    ratio = size / max(beside, 1e-30)
    if least <= ratio <= most:
        return
    nearest, near = _nearest(ratio)
    unit, cure = _UNITS[nearest]
    cure = f"scale this one by {1 / nearest:g}" if alone else cure
    looks = f"; it looks as if the lengths were {unit} ({cure})" if near else ""
    raise ValueRangeError(
        f"{name}: found an extent of {size:.4g} mm beside {what} of {beside:.4g} mm{looks}; "
        "expected both in millimetres"
    )


def likely_unit(points: Tensor, beside: float) -> str | None:
    """The unit, m or cm, that points (n,3) are in as their size beside a head's says; None where it may be mm."""
    ratio = extent(points) / beside
    nearest, near = _nearest(ratio)
    return {1e-3: "m", 0.1: "cm"}.get(nearest) if near and ratio < LEAST_OF_A_HEAD else None


def _nearest(ratio: float) -> tuple[float, bool]:
    """The unit that explains a ratio of sizes best, and whether it does."""
    nearest = min(_UNITS, key=lambda unit: abs(math.log(max(ratio, 1e-30) / unit)))
    return nearest, 1 / _NEAR < ratio / nearest < _NEAR
