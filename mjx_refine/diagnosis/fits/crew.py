"""Pieces of a diagnosis that wait for none of the others, side by side in several processes.

Whoever does a piece, its result is the same, and results are taken in the order of the pieces: what a diagnosis says does
not depend on how many processes there are, nor on which of them live.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
import multiprocessing
import queue
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import jax

from mjx_refine.children import ONE_THREAD, exit_with_parent, inherited, pool, without_main
from mjx_refine.diagnosis.fits.settled import Settled
from mjx_refine.diagnosis.fits.store import Arrays, Borrowed, Store
from mjx_refine.sim import cores, recalled

log = logging.getLogger("mjx_refine")

MOST = 12
"""Processes: hardly ever are there more pieces at a time, and each takes half a gigabyte."""


Piece = Callable[..., Any]
"""Called with a clip, which it leaves as it is, and a row of arguments."""


@dataclasses.dataclass(frozen=True)
class _Done:
    """A piece's result, the rollouts that it took, fits to be kept, and how many were not made but read."""

    result: Any
    rollouts: float
    made: tuple[tuple[str, Arrays], ...]
    recalled: int


@dataclasses.dataclass(frozen=True)
class _Order:
    """What a process must know of a clip to do pieces, and how many threads it may have for them at most."""

    facts: str
    state: str
    make: Callable[[int], Any]
    settled: Settled
    threads: int

    @classmethod
    def of(cls, clip: Any, threads: int) -> _Order:
        return cls(clip.facts, clip.state(), clip.again(), clip.settled, threads)


class _Bench:
    """The clip that a process works on, kept from piece to piece."""

    def __init__(self):
        self.clip: Any = None
        self.made, self.state = "", ""

    def fetch(self, order: _Order) -> Any:
        """The clip as ordered, not yet counted or stored anything for."""
        if self.made != order.facts:
            self.clip, self.made, self.state = order.make(order.threads), order.facts, ""
        if self.state != order.state:
            self.clip.settled, self.state = order.settled, order.state
        self.clip.rollouts = 0.0
        return self.clip


class Crew:
    """Those who do pieces: this process alone, unless ``crew_of`` gave it others."""

    def __init__(self, others: ProcessPoolExecutor | None = None, count: int = 0, threads: int = 1):
        self._others, self._count, self._threads, self._bench = others, count, threads, _Bench()

    def warm(self, clip: Any) -> None:
        """Lets the other processes compile what they will need, while this one goes on."""
        if self._others is not None:
            order = _Order.of(clip, self._threads)
            with contextlib.suppress(RuntimeError):
                for _ in range(self._count):
                    self._others.submit(_warm, order)

    def each(
        self,
        clip: Any,
        piece: Piece,
        rows: Sequence[tuple[Any, ...]],
        told: Callable[[str], None] | None = None,
        lines: Sequence[str] = (),
    ) -> list[Any]:
        """``piece(clip, *row)`` of every row, in their order.

        Args:
          clip: a ``ClipFit``; its rollouts are counted, and its store keeps what was fitted.
          piece: a function of a module.
          rows: arguments, small against the work.
          told: is called with the line of a piece that begins here, or has come from elsewhere.
          lines: one a row.
        """

        def say(k: int) -> None:
            if told is not None and lines:
                told(lines[k])

        if self._others is not None and len(rows) > 1:
            done = self._side_by_side(self._others, clip, piece, rows, say)
        else:
            done = []
            for k, row in enumerate(rows):
                say(k)
                done.append(_alone(clip, piece, row))
        clip.rollouts += sum(one.rollouts for one in done)
        return [one.result for one in done]

    def _side_by_side(self, others, clip: Any, piece: Piece, rows, say: Callable[[int], None]) -> list[_Done]:
        order, folder = _Order.of(clip, self._threads), clip.store.folder
        left, arrived = iter(range(len(rows))), queue.SimpleQueue()
        done: dict[int, _Done] = {}

        def hand_out() -> None:
            """Gives one of the others the next piece; called anew whenever a piece has been done."""
            for k in left:
                try:
                    future = others.submit(_elsewhere, order, folder, piece, rows[k])
                except RuntimeError:  # they have ended
                    arrived.put((k, None))
                    continue
                future.add_done_callback(functools.partial(came, k))
                return

        def came(k: int, future: Future) -> None:
            arrived.put((k, future))
            hand_out()

        def here(k: int) -> _Done:
            own = self._bench.fetch(order)
            own.store = clip.store
            return _alone(own, piece, rows[k])

        for _ in range(self._count):
            hand_out()
        while len(done) < len(rows):
            k = next(left, None)
            if k is not None:
                say(k)
                done[k] = here(k)
            while len(done) < len(rows) and (k is None or not arrived.empty()):
                j, future = arrived.get()
                say(j)
                done[j] = self._received(clip.store, future) or here(j)
        return [done[k] for k in range(len(rows))]

    def _received(self, store: Store, future: Future | None) -> _Done | None:
        """A piece that was done elsewhere, with its fits kept; None where who had it has ended."""
        try:
            found: _Done | None = None if future is None else future.result()
        except BrokenProcessPool:
            found = None
        if found is None:
            if self._others is not None:
                log.warning("a process that fitted hypotheses has ended; this one goes on alone")
            self._others = None
            return None
        for key, arrays in found.made:
            store.keep(key, arrays)
        store.recalled += found.recalled
        return found


def _alone(clip: Any, piece: Piece, row: tuple[Any, ...]) -> _Done:
    before, clip.rollouts = clip.rollouts, 0.0
    try:
        with cores.PROCESS.at_work():
            result = piece(clip, *row)
        return _Done(result, clip.rollouts, (), 0)
    finally:
        clip.rollouts = before


@contextlib.contextmanager
def crew_of(threads: int) -> Iterator[Crew]:
    """A crew for so many cores, this process among it; the others begin at once and end with the block.

    Whoever has a piece also has the cores of those that have none.
    """
    count = min(threads, MOST) - 1
    # A daemon may have no children.
    if count < 1 or multiprocessing.current_process().daemon:
        yield Crew()
        return
    working = multiprocessing.get_context("spawn").Value("i", 0)
    with (
        tempfile.TemporaryDirectory(prefix="mjx-refine-", ignore_cleanup_errors=True) as rollouts,
        pool(count, _begin, (jax.config.jax_compilation_cache_dir, rollouts, threads, working)) as others,
    ):
        with without_main(), inherited(ONE_THREAD):
            for _ in range(count):
                others.submit(_begun)
        recalled.PROCESS.share(Path(rollouts))
        cores.PROCESS.share(threads, working)
        try:
            yield Crew(others, count, threads)
        finally:
            recalled.PROCESS.share(None)
            cores.PROCESS.release()


# --- the other processes ----------------------------------------------------------------------------------------------

_BENCH = _Bench()


def _begin(cache: str | None, rollouts: str, threads: int, working: cores.Counter) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted, and ends us
    threading.Thread(target=exit_with_parent, daemon=True).start()
    recalled.PROCESS.share(Path(rollouts))
    cores.PROCESS.share(threads, working)
    jax.config.update("jax_platforms", "cpu")  # as the parent predicts, and a GPU's memory is not for every process
    if cache is not None:
        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def _begun() -> None:
    """Work for a process to begin with."""


def _warm(order: _Order) -> None:
    _BENCH.fetch(order).warm()


def _elsewhere(order: _Order, folder: Any, piece: Piece, row: tuple[Any, ...]) -> _Done:
    clip = _BENCH.fetch(order)
    clip.store = store = Borrowed(folder)
    done = _alone(clip, piece, row)
    return dataclasses.replace(done, made=tuple(store.made), recalled=store.recalled)
