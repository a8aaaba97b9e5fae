"""Cores that processes share: whoever is at work has a part of them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Protocol

from mjx_refine.children import cores


class Counter(Protocol):
    """As ``multiprocessing.Value`` of an integer."""

    value: int

    def get_lock(self) -> contextlib.AbstractContextManager[object]:
        """Held while the value is changed."""
        ...


class Cores:
    """So many cores, divided among the processes that are at work just now."""

    def __init__(self) -> None:
        self._count = cores()
        self._working: Counter | None = None

    def share(self, count: int, working: Counter) -> None:
        """From now on divides ``count`` cores with all that count themselves in ``working``."""
        self._count, self._working = count, working

    def release(self) -> None:
        """From now on has all cores again."""
        self._count, self._working = cores(), None

    @property
    def mine(self) -> int:
        """How many are this process's; at least one."""
        if self._working is None:
            return self._count
        return max(1, self._count // max(1, self._working.value))

    @contextlib.contextmanager
    def at_work(self) -> Iterator[None]:
        """Counts this process among those that are at work."""
        working = self._working
        if working is None:
            yield
            return
        self._add(working, 1)
        try:
            yield
        finally:
            self._add(working, -1)

    @staticmethod
    def _add(working: Counter, one: int) -> None:
        with working.get_lock():
            working.value += one


PROCESS = Cores()
"""Of this process."""
