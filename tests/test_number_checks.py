"""Numbers that callers give are finite, in range, and numbers at all."""

import math

import numpy as np
import pytest
import torch

from torchface.errors import FileFormatError, ValueRangeError
from torchface.number_checks import checked_count, checked_number


@pytest.mark.parametrize("value", [0, 2.5, np.float32(2.5), np.int64(3), torch.tensor(2.5), torch.tensor([4])])
def test_numbers_of_every_kind_come_back(value: object) -> None:
    assert checked_number("x", value) == float(value)


@pytest.mark.parametrize(
    "value",
    [math.nan, math.inf, -math.inf, -1.0, 5.1, 10**400, True, None, "2", 1j, torch.zeros(2), torch.tensor(True)],
)
def test_what_is_no_number_in_range_is_told(value: object) -> None:
    with pytest.raises(ValueRangeError, match=r"^x: found .*, expected a finite number from 0 to 5$"):
        checked_number("x", value, 0.0, 5.0)


def test_an_open_range_leaves_its_end_out() -> None:
    assert checked_number("x", 1e-300, above=True) > 0
    with pytest.raises(FileFormatError, match="x: found 0, expected a finite number above 0"):
        checked_number("x", 0.0, above=True, error=FileFormatError)


@pytest.mark.parametrize("value", [-1, 65536, 3.0, math.nan, "80", False, torch.tensor(2.5)])
def test_a_count_is_whole(value: object) -> None:
    assert checked_count("x", 80, 0, 65535) == 80
    with pytest.raises(ValueRangeError, match=r"^x: found .*, expected a whole number from 0 to 65535$"):
        checked_count("x", value, 0, 65535)
