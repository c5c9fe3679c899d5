"""Inputs that both the program and somebody at the page may change."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

_SAME = 5e-4


class SharedInput:
    """A slider, dropdown or checkbox of the page, which tells changes by the user from those by the program.

    Args:
        handle: viser's.
        lock: held while ``act`` runs.
        act: called with the newest value after the user changed it.
    """

    def __init__(self, handle: Any, lock: AbstractContextManager, act: Callable[[Any], Any]) -> None:
        self.handle = handle
        self._lock = lock
        self._act = act
        self._value = handle.value
        handle.on_update(self._changed)

    def push(self, value: Any) -> None:
        """Shows a value, unless the user has just set another that is still to be acted on."""
        if self.handle.value != self._value:
            return
        if isinstance(value, float | int) and abs(value - self._value) < _SAME:
            return
        self._value = value
        self.handle.value = value
        self._value = self.handle.value

    def _changed(self, event: Any) -> None:
        if event.client is None:  # the program's own doing
            return
        with self._lock:
            self._value = event.target.value
            self._act(self._value)
