"""Check that two meshes of people can be in one unit: heads differ by less than units do."""

import math

from torch import Tensor

from torchface.errors import ValueRangeError

# What a length in millimetres becomes where a file's unit was not the one that it was read with, and the cure.
_LOAD = "load with unit={0!r}; on the command line --unit {0}"
_UNITS = {
    1e-3: ("in metres", _LOAD.format("m")),
    0.1: ("in centimetres", _LOAD.format("cm")),
    1 / 25.4: ("in inches", "scale them by 25.4"),
    10.0: ("in millimetres and were read as centimetres", "leave the unit out"),
    1e3: ("in millimetres and were read as metres", "leave the unit out, or say --unit mm"),
}
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
    nearest = min(_UNITS, key=lambda unit: abs(math.log(max(ratio, 1e-30) / unit)))
    near = 1 / _NEAR < ratio / nearest < _NEAR
    unit, cure = _UNITS[nearest]
    cure = f"scale this one by {1 / nearest:g}" if alone else cure
    looks = f"; it looks as if the lengths were {unit} ({cure})" if near else ""
    raise ValueRangeError(
        f"{name}: found an extent of {size:.4g} mm beside {what} of {beside:.4g} mm{looks}; "
        "expected both in millimetres"
    )
