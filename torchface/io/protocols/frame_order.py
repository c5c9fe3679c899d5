"""Order of frames that come by packets: those that were lost, came late or from somebody else are counted."""

from collections import deque
from dataclasses import dataclass

_FAR = 300  # frames; a number so much further, or so much earlier, is a clock that was set
_SET = 0.2  # seconds: no network holds frames back for longer; older numbers after that are a clock that was set
_RECENT = 30
_FREE = 2.0  # seconds after which another sender may take over


@dataclass
class PacketCounts:
    """What came."""

    taken: int = 0
    lost: int = 0
    late: int = 0  # those that came after a newer one
    others: int = 0  # of a second sender while the first was there
    jumps: int = 0  # how often the sender's count was set
    malformed: int = 0  # packets that are none of the protocol
    fault: str = ""  # what is wrong with the last of these

    def words(self) -> str:
        """What went wrong, for people; empty if nothing did."""
        names = {"lost": "lost", "late": "late", "others": "of another sender", "jumps": "jumps of its clock"}
        found = [f"{getattr(self, name)} {words}" for name, words in names.items() if getattr(self, name)]
        return ", ".join([*found, *([f"{self.malformed} not understood ({self.fault})"] if self.malformed else [])])


class FrameOrder:
    """Says of each frame whether it is the next one to show."""

    def __init__(self) -> None:
        self.counts = PacketCounts()
        self.sender = ""
        self._last: int | None = None
        self._before: int | None = None  # of the clock that was in use until it jumped
        self._stands = False  # whether the sender's clock does not go on
        self._heard = self._taken = self._jumped = float("-inf")
        self._steps: deque[int] = deque(maxlen=_RECENT)

    def takes(self, sender: str, number: int | None, now: float) -> bool:
        """Whether a frame is taken, by the sender's number, if it counts, and the time in seconds; counts it."""
        if sender != self.sender:
            if now - self._heard < _FREE:
                self.counts.others += 1
                return False
            self.sender, self._last, self._before = sender, None, None
            self._steps.clear()
        self._heard = now
        if number is not None and self._last is not None:
            step = number - self._last
            back = -_FAR < step <= 0 and now - self._taken < _SET and not (step == 0 and self._stands)
            old = self._before is not None and now - self._jumped < _SET and abs(number - self._before) < _FAR
            if back or (old and abs(step) >= _FAR):
                self.counts.late += 1
                return False
            self._stands = step == 0
            if step < 0 or step >= _FAR:
                self.counts.jumps += 1
                self._before, self._jumped = self._last, now
                self._steps.clear()
            elif step > 0:
                self._steps.append(step)
                # A phone at half its clock's rate counts every other one.
                usual = sorted(self._steps)[len(self._steps) // 4]
                self.counts.lost += max(0, round(step / usual) - 1)
        self._last, self._taken = number, now
        self.counts.taken += 1
        return True
