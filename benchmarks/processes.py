"""Work on many items by several processes, each with one thread of linear algebra."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

from mjx_refine.children import ONE_THREAD, inherited

Item = TypeVar("Item")
Result = TypeVar("Result")


def each(work: Callable[[Item], Result], items: Sequence[Item], processes: int) -> Iterator[Result]:
    """The results of all items, in order, as they come; in this process where one is enough.

    Args:
      work: a function of a module, since processes are spawned. items: what they get. processes: at most so many.
    """
    processes = min(processes, len(items))
    if processes <= 1:
        yield from map(work, items)
        return
    with inherited(ONE_THREAD), ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(work, items)
