"""Progress reports of long work: one signature for every function."""

from typing import Protocol

__all__ = ["Progress", "ValueLog", "silent"]


class Progress(Protocol):
    """Called as work goes on: ``progress("rendering")``, or ``progress("rendering", 3, 20)`` after 3 of 20 images.

    Example:
        >>> def report(step: str, done: int = 0, total: int = 0) -> None:
        ...     print(f"{step}: {done} of {total}")
        >>> progress: Progress = report
        >>> progress("rendering", 3, 20)
        rendering: 3 of 20
    """

    def __call__(self, step: str, done: int = 0, total: int = 0) -> None:
        """Reports how far the work is.

        Args:
            step: what is being done; the next step's name ends this one.
            done: how many items of it are finished.
            total: of how many; 0 where that is not known, or where there is nothing to count.
        """


def silent(step: str, done: int = 0, total: int = 0) -> None:
    """The progress of work that nobody watches.

    Example:
        >>> silent("rendering", 3, 20)
    """


class ValueLog(Protocol):
    """Called with what is measured while something is learned: ``log(300, "loss", 0.25)``.

    Example:
        >>> def report(step: int, name: str, value: float) -> None:
        ...     print(f"{name} {value} at step {step}")
        >>> log: ValueLog = report
        >>> log(300, "loss", 0.25)
        loss 0.25 at step 300
    """

    def __call__(self, step: int, name: str, value: float) -> None:
        """Keeps a value.

        Args:
            step: at which it was measured; steps rise.
            name: of the value.
            value: as measured.
        """
