"""A worker process: a job in, its outcome out. What ends it ends one job."""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from mjx_refine.children import ONE_THREAD, cores, exit_with_parent, inherited
from mjx_refine.errors import InputError
from mjx_refine.many.groups import Kind
from mjx_refine.many.jobs import Job
from mjx_refine.many.work import ahead, prepare, work
from mjx_refine.search import Options
from mjx_refine.sim.backends import OFFERED, resolve_backend

IDLE = 0.05
"""Seconds without a task after which a worker does something ahead."""

MOST_FALSE_STARTS = 3
"""Workers that may end before they are ready, since the last that was."""

UNGUARDED = (
    "a script that calls refine_many needs `if __name__ == '__main__':` around its calls, since each process imports it"
)


class Worker:
    """One process, from outside.

    Args:
      out: folder of all jobs.
      options: of all jobs.
      beside: how many processes there are in all.
      elsewhere: the backend that searches in another process, which then has the device; None: this one searches.

    Attributes:
      pipe: takes (task, job), a name in ``TASKS``; says ("ready", backend), ("part", done in [0, 1]), ("done", result).
      job, task, kind: at work on, None where idle; the last one's kind.
      ready: whether it has begun.
      part: of its job that is done.
    """

    def __init__(self, out: Path, options: Options, beside: int, elsewhere: str | None = None):
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        if beside > 1:
            options = dataclasses.replace(options, threads=options.threads or max(1, cores() // beside))
        self.process = context.Process(target=_serve, args=(theirs, out, options, elsewhere), daemon=True)
        with inherited(ONE_THREAD if beside > 1 else {}):
            self.process.start()
        theirs.close()
        self.job: Job | None = None
        self.task = "refine"
        self.ready = False
        self.kind: Kind | None = None
        self.part = 0.0

    def end(self) -> str:
        """Ends the process, if it has not ended; returns how it did."""
        self.pipe.close()
        if self.job is not None:
            # Dead, or at a job that nobody waits for any more.
            self.process.join(0.5)
            self.process.terminate()
        self.process.join(5.0)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        return _how(self.process.exitcode)


def _how(code: int | None) -> str:
    if code is None or code >= 0:
        return f"exit status {code}"
    with contextlib.suppress(ValueError):
        name = signal.Signals(-code).name
        memory = "; was memory short? choose fewer --workers" if name == "SIGKILL" else ""
        return f"killed by {name}{memory}"
    return f"killed by signal {-code}"


TASKS: dict[str, Callable[..., object]] = {"refine": work, "prepare": prepare}


def _serve(pipe: Any, out: Path, options: Options, elsewhere: str | None) -> None:
    """A worker process: a job in, its outcome out, until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted, and ends us
    threading.Thread(target=exit_with_parent, daemon=True).start()
    if elsewhere is not None:
        os.environ[OFFERED] = elsewhere
    if elsewhere is not None or options.backend == "mujoco":
        jax.config.update("jax_platforms", "cpu")  # a GPU's memory is not for every worker
    with contextlib.suppress(EOFError, OSError):
        try:
            pipe.send(("ready", resolve_backend(options.backend)))
        except InputError:
            pipe.send(("ready", options.backend))  # every job says why it cannot run
        while True:
            while not pipe.poll(IDLE) and ahead():
                pass
            task, job = pipe.recv()
            pipe.send(("done", TASKS[task](job, out, options, lambda part: pipe.send(("part", part)))))
