"""How many threads numpy's linear algebra takes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from threadpoolctl import threadpool_limits


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """While it lasts, linear algebra takes one thread, in the whole process.

    A search decomposes matrices of a few dozen rows between rollouts on all cores: threads for them wait for one another, and for
    rollouts of other clips, longer than they compute (an update of CMA-ES among 15 busy workers took 15 ms instead of 1).
    """
    with threadpool_limits(1, user_api="blas"):
        yield
