"""Lengths in another unit are told by the extent of what they show, with the cure."""

import re

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchface.errors import ValueRangeError
from torchface.geometry.meshes.unit_check import check_unit, extent

BOX = torch.tensor([[0.0, 0.0, 0.0], [120.0, 160.0, 150.0]])  # its diagonal is 250 mm


@pytest.mark.parametrize(
    ("factor", "told"),
    [
        (1e-3, r"in metres \(load with unit='m'; on the command line --unit m\)"),
        (0.1, r"in centimetres \(load with unit='cm'; on the command line --unit cm\)"),
        (1 / 25.4, r"in inches \(load with unit='in'; on the command line --unit in\)"),
        (10.0, r"in millimetres and were read as centimetres \(leave the unit out\)"),
        (1e3, r"in millimetres and were read as metres \(leave the unit out, or say --unit mm\)"),
        (1e5, r"of 250 mm; expected both in millimetres"),
    ],
)
def test_the_unit_is_told(factor: float, told: str) -> None:
    size = re.escape(f"{extent(BOX * factor):.4g}")
    with pytest.raises(ValueRangeError, match=rf"scan: found an extent of {size} mm beside a face.*{told}"):
        check_unit("scan", BOX * factor, 250.0, "a face", 0.4, 2.5)


@given(st.floats(0.41, 2.4))
def test_heads_of_other_sizes_are_taken(factor: float) -> None:
    check_unit("scan", BOX * factor, extent(BOX), "a face", 0.4, 2.5)
