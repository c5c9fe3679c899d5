"""Frames in order: loss, lateness, a second sender and a clock that jumps are counted."""

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


def test_a_clock_that_is_set_back_a_little_stops_nothing_for_longer_than_a_network_does() -> None:
    order = FrameOrder()
    assert all(order.takes("phone", number, number / 60) for number in range(120, 300))
    back = [order.takes("phone", number, 5 + (number - 150) / 60) for number in range(150, 240)]
    assert back == [False] * 11 + [True] * 79
    assert (order.counts.jumps, order.counts.late) == (1, 11)


def test_a_frame_of_the_clock_before_a_jump_is_late() -> None:
    order = FrameOrder()
    assert took(order, [100_000, 100_002, 5, 100_001, 6, 7]) == [True, True, True, False, True, True]
    assert (order.counts.jumps, order.counts.late) == (1, 1)


def test_a_sender_whose_number_never_changes_is_taken_as_it_comes() -> None:
    order = FrameOrder()
    taken = [order.takes("phone", 0, frame / 60) for frame in range(120)]
    assert all(taken[12:])
    assert order.counts.jumps == 0


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
