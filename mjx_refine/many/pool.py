"""Worker processes, each with one job at a time: what ends one ends one job."""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Generator
from multiprocessing import connection
from pathlib import Path

from mjx_refine.children import cores
from mjx_refine.many.groups import Kind, Waiting
from mjx_refine.many.jobs import Job
from mjx_refine.many.outcome import FAILED, Outcome
from mjx_refine.many.progress import ManyProgress
from mjx_refine.many.worker import MOST_FALSE_STARTS, UNGUARDED, Worker
from mjx_refine.search import Options


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
        self.workers: list[Worker] = []

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
            self.workers.append(Worker(self.out, self.options, self.count or 1))
            idle += 1

    def _heard(self, worker: Worker) -> Outcome | None:
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

    def _give(self, worker: Worker, job: Job, kind: Kind) -> None:
        try:
            worker.pipe.send(("refine", job))
        except OSError:  # it has just ended, which the next message tells
            self.waiting.put_back(job, kind)
            return
        worker.job, worker.kind = job, kind

    def _lost(self, worker: Worker) -> Outcome | None:
        reason = worker.end()
        if worker.job is not None:
            return Outcome(worker.job.name, FAILED, f"its process ended: {reason}")
        self.false_starts += 1
        if self.false_starts >= MOST_FALSE_STARTS:
            raise RuntimeError(f"worker processes end before they begin ({reason}); {UNGUARDED}")
        return None

    def _show(self) -> None:
        at_work = [worker for worker in self.workers if worker.job is not None]
        part = (self.finished + sum(worker.part for worker in at_work)) / max(self.total, 1)
        names = tuple(worker.job.name for worker in at_work if worker.job is not None)
        self.progress.update(self.finished, self.total, part, names)
