"""Child processes that compute: what they inherit, and that they end with their parent."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor

ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}
"""Environment of a process that computes with one thread, read when numpy is imported and JAX begins: several processes
whose linear algebra has a thread for every core wait for one another ten times as long as they compute."""


def cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def inherited(values: Mapping[str, str]) -> Iterator[None]:
    """This process's environment with ``values`` for a while, for a child to inherit; what the user has set stays."""
    added = [name for name in values if name not in os.environ]
    os.environ.update({name: values[name] for name in added})
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


def exit_with_parent(last: Callable[[], None] = lambda: None) -> None:
    """Waits for the parent's end, does ``last`` and ends this process, which must not write on in a folder that a next call
    may be working in; does nothing in a process without a parent."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        last()
        os._exit(1)


@contextlib.contextmanager
def pool(count: int, begin: Callable[..., None], arguments: tuple[object, ...] = ()) -> Iterator[ProcessPoolExecutor]:
    """So many processes, each begun with ``begin(*arguments)``; whatever they are at when the block is left, they end.

    They start when work is submitted, with this process's environment of that moment.
    """
    workers = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), begin, arguments)
    try:
        yield workers
    finally:
        mine = list((getattr(workers, "_processes", None) or {}).values())
        workers.shutdown(wait=False, cancel_futures=True)
        for process in mine:
            process.terminate()
        for process in mine:
            process.join()


@contextlib.contextmanager
def without_main() -> Iterator[None]:
    """Processes that start meanwhile do not import the caller's script, which then needs no guard against running again."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
