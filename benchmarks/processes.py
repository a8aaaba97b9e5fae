"""Work on many items by several processes, each with one thread of linear algebra."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}


def each(work: Callable[[Item], Result], items: Sequence[Item], processes: int) -> Iterator[Result]:
    """The results of all items, in order, as they come; in this process where one is enough.

    Args:
      work: a function of a module, since processes are spawned. items: what they get. processes: at most so many.
    """
    processes = min(processes, len(items))
    if processes <= 1:
        yield from map(work, items)
        return
    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)  # for the children
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(work, items)
