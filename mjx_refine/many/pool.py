"""Worker processes, each with one job at a time: what ends one ends one job."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import multiprocessing
import signal
import threading
from collections.abc import Generator
from multiprocessing import connection
from pathlib import Path
from typing import Any

from mjx_refine.children import ONE_THREAD, cores, exit_with_parent, inherited
from mjx_refine.errors import InputError
from mjx_refine.many.groups import Kind, Waiting
from mjx_refine.many.jobs import Job
from mjx_refine.many.outcome import FAILED, Outcome
from mjx_refine.many.progress import ManyProgress
from mjx_refine.many.work import work
from mjx_refine.search import Options
from mjx_refine.sim.backends import resolve_backend

MOST_FALSE_STARTS = 3
"""Workers that may end before they are ready, since the last that was."""


def default_workers(options: Options) -> int | None:
    """How many processes: the cores for C MuJoCo; one for MJX, whose programs fill a device; None: ask a worker."""
    if options.backend == "mujoco" or (options.backend == "auto" and importlib.util.find_spec("warp") is None):
        return cores()
    return None if options.backend == "auto" else 1


class Pool:
    """Works through jobs in processes.

    Args:
      waiting: the jobs.
      out: folder of all jobs.
      options: of all jobs; several workers share the cores.
      workers: processes; None: the cores with C MuJoCo, one with MJX.
      progress: a display.

    Raises:
      RuntimeError: workers end before they begin.
    """

    def __init__(self, waiting: Waiting, out: Path, options: Options, workers: int | None, progress: ManyProgress):
        self.waiting, self.out, self.options, self.progress = waiting, out, options, progress
        self.total, self.finished, self.false_starts = len(waiting), 0, 0
        self.count = workers or default_workers(options)
        self.workers: list[_Worker] = []

    def outcomes(self) -> Generator[Outcome]:
        """Every job's outcome, as they end."""
        try:
            while self.waiting or any(worker.job for worker in self.workers):
                self._fill()
                pipes = {worker.pipe: worker for worker in self.workers}
                for pipe in connection.wait(list(pipes), timeout=1.0):
                    outcome = self._heard(pipes[pipe])  # type: ignore[index]
                    if outcome is not None:
                        self.finished += 1
                        yield outcome
                self._show()
        finally:
            for worker in self.workers:  # first all are told, so that they end side by side
                worker.pipe.close()
            for worker in self.workers:
                worker.end()

    def _fill(self) -> None:
        """Starts workers while there is work for them; a first one alone where the number depends on its device."""
        idle = sum(worker.job is None for worker in self.workers)
        while len(self.workers) < (self.count or 1) and idle < len(self.waiting):
            self.workers.append(_Worker(self.out, self.options, self.count or 1))
            idle += 1

    def _heard(self, worker: _Worker) -> Outcome | None:
        """Takes a worker's message; returns an outcome where it is one, or where the worker's end makes it one."""
        try:
            what, value = worker.pipe.recv()
        except (EOFError, OSError):
            self.workers.remove(worker)
            return self._lost(worker)
        if what == "part":
            worker.part = value
            return None
        outcome, worker.job, worker.part = (value, None, 0.0) if what == "done" else (None, worker.job, 0.0)
        if what == "ready":
            self.false_starts = 0
            if self.count is None:
                self.count = default_workers(dataclasses.replace(self.options, backend=value))
        if self.waiting:
            busy = [other.kind for other in self.workers if other.job is not None]
            self._give(worker, *self.waiting.take(worker.kind, busy))
        return outcome

    def _give(self, worker: _Worker, job: Job, kind: Kind) -> None:
        try:
            worker.pipe.send(job)
        except OSError:  # it has just ended, which the next message tells
            self.waiting.put_back(job, kind)
            return
        worker.job, worker.kind = job, kind

    def _lost(self, worker: _Worker) -> Outcome | None:
        reason = worker.end()
        if worker.job is not None:
            return Outcome(worker.job.name, FAILED, f"its process ended: {reason}")
        self.false_starts += 1
        if self.false_starts >= MOST_FALSE_STARTS:
            raise RuntimeError(
                f"worker processes end before they begin ({reason}); a script that calls refine_many needs "
                "`if __name__ == '__main__':` around its calls, since each process imports it"
            )
        return None

    def _show(self) -> None:
        at_work = [worker for worker in self.workers if worker.job is not None]
        part = (self.finished + sum(worker.part for worker in at_work)) / max(self.total, 1)
        names = tuple(worker.job.name for worker in at_work if worker.job is not None)
        self.progress.update(self.finished, self.total, part, names)


class _Worker:
    """One process, from outside; ``beside`` is how many there are in all."""

    def __init__(self, out: Path, options: Options, beside: int):
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        if beside > 1:
            options = dataclasses.replace(options, threads=options.threads or max(1, cores() // beside))
        self.process = context.Process(target=_serve, args=(theirs, out, options), daemon=True)
        with inherited(ONE_THREAD if beside > 1 else {}):
            self.process.start()
        theirs.close()
        self.job: Job | None = None
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


def _serve(pipe: Any, out: Path, options: Options) -> None:
    """A worker process: a job in, its outcome out, until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted, and ends us
    threading.Thread(target=exit_with_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError):
        try:
            pipe.send(("ready", resolve_backend(options.backend)))
        except InputError:
            pipe.send(("ready", options.backend))  # every job says why it cannot run
        while True:
            job = pipe.recv()
            pipe.send(("done", work(job, out, options, lambda part: pipe.send(("part", part)))))
