"""Frames in order: loss, lateness, a second sender and a clock that jumps are counted."""

from __future__ import annotations

from torchface.io.protocols.frame_order import FrameOrder


def took(order: FrameOrder, numbers: list[int | None], sender: str = "phone", now: float = 0.0) -> list[bool]:
    return [order.takes(sender, number, now) for number in numbers]


def test_lost_and_late_frames_are_counted() -> None:
    order = FrameOrder()
    assert took(order, [10, 11, 12, 15, 14, 15, 16]) == [True, True, True, True, False, False, True]
    assert (order.counts.taken, order.counts.lost, order.counts.late) == (5, 2, 2)
    assert order.counts.words() == "2 lost, 2 late"


def test_a_phone_at_half_its_clocks_rate_loses_nothing() -> None:
    order = FrameOrder()
    assert all(took(order, list(range(0, 200, 2))))
    assert order.counts.lost == 0
    order.takes("phone", 202, 0.0)  # one of its frames is missing
    assert order.counts.lost == 1


def test_a_clock_that_jumps_goes_on_from_there() -> None:
    order = FrameOrder()
    assert all(took(order, [100_000, 100_001, 5, 6, 7, 2_000_000, 2_000_001]))
    assert (order.counts.jumps, order.counts.lost, order.counts.late) == (2, 0, 0)


def test_a_second_sender_waits_until_the_first_is_gone() -> None:
    order = FrameOrder()
    assert took(order, [1, 2], now=0.0) == [True, True]
    assert took(order, [500, 501], "other", now=1.0) == [False, False]
    assert took(order, [3], now=1.5) == [True]
    assert took(order, [502, 503], "other", now=4.0) == [True, True]
    assert order.sender == "other"
    assert took(order, [4], now=4.1) == [False]
    assert (order.counts.others, order.counts.lost, order.counts.jumps) == (3, 0, 0)


def test_senders_that_do_not_count_are_taken_as_they_come() -> None:
    order = FrameOrder()
    assert all(took(order, [None] * 5))
    assert order.counts.words() == ""
