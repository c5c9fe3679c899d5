"""What is said of a registration: whether it is to be used."""

import math
from dataclasses import replace

from torchface.registration.nonrigid.registration_record import RegistrationRecord

NEAR = RegistrationRecord("shape", 4.0, (), (), 0.04, 0.4, 1.0, 0.27, 0.5, 0.3, 0.2)


def test_the_verdict_is_of_the_distance_of_the_stretch_and_of_warnings() -> None:
    assert NEAR.verdict() == (
        "result: good, 95 % of what the scan shows lie within 0.27 mm of it (at most 1 mm is usual), "
        "edges are stretched by up to 20% (at most 45% is usual)"
    )
    for doubtful in (
        replace(NEAR, far_distance=1.4),
        replace(NEAR, stretch=0.52),
        replace(NEAR, notes=("warning: a",)),
        replace(NEAR, slid=8.2),
        replace(NEAR, far_distance=math.nan, stretch=math.nan),
    ):
        assert doubtful.verdict().startswith("result: partly usable, ")
    assert replace(NEAR, stretch=1.29).verdict().startswith("result: poor, ")
    assert replace(NEAR, notes=("a", "warning: b", "warning: c")).verdict().endswith("; 2 warnings below")


def test_a_head_that_was_taken_as_it_is_is_good_unless_something_warns() -> None:
    taken = replace(NEAR, notes=("taken as it is",), bent=False)
    assert taken.verdict() == "result: good, taken as it is"
    assert replace(taken, notes=("taken as it is", "warning: smiles")).verdict() == (
        "result: partly usable, taken as it is; 1 warning below"
    )
