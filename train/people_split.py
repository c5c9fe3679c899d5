"""People held out for the test: never single pictures, scans or takes of someone who is learned from."""

from collections.abc import Sequence


def held_out_people(people: Sequence[str], count: int) -> tuple[list[int], list[int]]:
    """Which examples to learn from, and which to test on: all of the people whom the last ``count`` show, none if it
    is 0."""
    tested = set(people[max(len(people) - count, 0) :]) if count > 0 else set()
    learn = [number for number, who in enumerate(people) if who not in tested]
    return learn, [number for number, who in enumerate(people) if who in tested]
