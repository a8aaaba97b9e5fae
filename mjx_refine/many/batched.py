"""Many clips on one device: worker processes land and finish them, this process searches all clips of a kind in lock-step."""

from __future__ import annotations

import functools
import logging
import threading
from collections import deque
from collections.abc import Generator, Sequence
from multiprocessing import connection
from pathlib import Path
from queue import SimpleQueue

from mjx_refine.children import cores
from mjx_refine.compile_cache import enable_cache
from mjx_refine.linear_algebra import one_thread
from mjx_refine.many.groups import Kind
from mjx_refine.many.jobs import Job
from mjx_refine.many.outcome import FAILED, Outcome
from mjx_refine.many.progress import ManyProgress
from mjx_refine.many.warm import warm_up
from mjx_refine.many.work import SEARCHING, Prepared, told_of
from mjx_refine.many.worker import MOST_FALSE_STARTS, UNGUARDED, Worker
from mjx_refine.search import Options
from mjx_refine.search.together import CANDIDATES, DEVICE, Member, Together
from mjx_refine.sim.backends import fastest, make_simulator
from mjx_refine.sim.devices import has_accelerator

log = logging.getLogger("mjx_refine")

AT_ONCE = 3
"""Groups that are searched side by side: while one waits for the device, the others think. Smaller groups that begin before all
of a kind have landed are no gain: 64 mixed clips took 135 s by 8 clips, six groups at once, and 125 s by 21."""


class _Stopped(Exception):
    """Nobody waits for the search any more."""


class Batched:
    """Works through jobs: land (in processes), search (here, on the device), finish (in processes).

    Args:
      jobs: with their kinds; those of a kind are searched together once all have landed.
      out: folder of all jobs.
      options: of all jobs.
      backend: that searches, ``warp`` or ``mjx``.
      workers: processes that land and finish; None: a core each, but one.
      progress: a display.
    """

    def __init__(
        self,
        jobs: Sequence[tuple[Job, Kind]],
        out: Path,
        options: Options,
        backend: str,
        workers: int | None,
        progress: ManyProgress,
    ):
        self.out, self.options, self.backend, self.progress = out, options, backend, progress
        self.count = min(workers or max(1, cores() - 1), max(1, len(jobs)))
        self.jobs = {job.name: job for job, _ in jobs}
        self.kinds = {job.name: kind for job, kind in jobs}
        self.parts = dict.fromkeys(self.jobs, 0.0)
        # Kinds one after the other, so that the first can soon be searched; that whose search takes longest first, since the
        # device has room for others beside it.
        order = sorted(dict.fromkeys(kind for _, kind in jobs), key=_weight, reverse=True)
        self.to_land = deque(sorted(self.jobs, key=lambda name: order.index(self.kinds[name])))
        self.landed: dict[Kind, list[Prepared]] = {kind: [] for kind in order}
        self.unlanded = {kind: sum(k == kind for k in self.kinds.values()) for kind in order}
        self.to_search: deque[list[Prepared]] = deque()
        self.searching: list[threading.Thread] = []
        self.to_finish: deque[str] = deque()
        self.workers: list[Worker] = []
        self.home: dict[str, Worker] = {}
        self.ended: SimpleQueue[tuple[str, Exception | None]] = SimpleQueue()
        self.bell, self._ring = connection.Pipe(duplex=False)
        self._telling = threading.Lock()
        # Groups of the same shapes share compiled programs.
        self._simulator = functools.cache(functools.partial(make_simulator, quick=True))
        self.stop, self.false_starts, self.left = False, 0, len(self.jobs)

    def outcomes(self) -> Generator[Outcome]:
        """Every job's outcome, as they end.

        Raises:
          RuntimeError: workers end before they begin.
        """
        with one_thread():
            yield from self._outcomes()

    def _outcomes(self) -> Generator[Outcome]:
        enable_cache()
        if has_accelerator():
            threading.Thread(target=self._warm_up, daemon=True).start()
        try:
            while self.left:
                self._hire()
                self._deal()
                self._search()
                pipes = {worker.pipe: worker for worker in self.workers}
                for pipe in connection.wait([self.bell, *pipes], timeout=1.0):
                    outcome = self._searched() if pipe is self.bell else self._heard(pipes[pipe])  # type: ignore[index]
                    if outcome is not None:
                        self.left -= 1
                        self.parts.pop(outcome.name, None)
                        yield outcome
                self._show()
        finally:
            self.stop = True
            for worker in self.workers:  # first all are told, so that they end side by side
                worker.pipe.close()
            for worker in self.workers:
                worker.end()
            for thread in self.searching:
                thread.join(30.0)

    # Processes ----------------------------------------------------------------------------------------------------

    def _hire(self) -> None:
        while len(self.workers) < self.count and len(self.to_land) + len(self.to_finish) > self._idle():
            self.workers.append(Worker(self.out, self.options, self.count, elsewhere=self.backend))

    def _idle(self) -> int:
        return sum(worker.job is None for worker in self.workers)

    def _deal(self) -> None:
        """Gives every worker that is ready something to do: landings first, since the device waits for them."""
        for worker in self.workers:
            if worker.job is not None or not worker.ready:
                continue
            if self.to_land:
                self._give(worker, "prepare", self.to_land.popleft(), self.to_land)
            elif self.to_finish:
                own = [name for name in self.to_finish if self.home.get(name) is worker]
                # What takes longest first, so that workers end together.
                name = max(own or self.to_finish, key=lambda name: _weight(self.kinds[name]))
                self.to_finish.remove(name)
                self._give(worker, "refine", name, self.to_finish)

    def _give(self, worker: Worker, task: str, name: str, queue: deque[str]) -> None:
        try:
            worker.pipe.send((task, self.jobs[name]))
        except OSError:  # it has just ended, which the next message tells
            queue.appendleft(name)
            return
        worker.job, worker.task = self.jobs[name], task

    def _heard(self, worker: Worker) -> Outcome | None:
        try:
            what, value = worker.pipe.recv()
        except (EOFError, OSError):
            self.workers.remove(worker)
            return self._lost(worker)
        if what == "part":
            if worker.job is not None:
                self.parts[worker.job.name] = value
            return None
        if what == "ready":
            worker.ready, self.false_starts = True, 0
            return None
        name, task, worker.job = worker.job.name, worker.task, None  # type: ignore[union-attr]
        if task == "prepare":
            self.home[name] = worker
            self._landed(name, value if isinstance(value, Prepared) else None)
        return value if isinstance(value, Outcome) else None

    def _lost(self, worker: Worker) -> Outcome | None:
        reason = worker.end()
        if worker.job is None:
            self.false_starts += 0 if worker.ready else 1
            if self.false_starts >= MOST_FALSE_STARTS:
                raise RuntimeError(f"worker processes end before they begin ({reason}); {UNGUARDED}")
            return None
        if worker.task == "prepare":
            self._landed(worker.job.name, None)
        return Outcome(worker.job.name, FAILED, f"its process ended: {reason}")

    # Searches -----------------------------------------------------------------------------------------------------

    def _landed(self, name: str, prepared: Prepared | None) -> None:
        """Puts a group together once the last of its kind has landed, or a batch is full."""
        kind = self.kinds[name]
        group = self.landed[kind]
        self.unlanded[kind] -= 1
        if prepared is not None:
            group.append(prepared)
        full = sum(one.ready.options.population for one in group) >= CANDIDATES
        if group and (full or not self.unlanded[kind]):
            self.landed[kind] = []
            alike: dict[tuple, list[Prepared]] = {}
            for one in group:
                alike.setdefault(one.ready.kind, []).append(one)
            self.to_search.extend(alike.values())

    def _search(self) -> None:
        self.searching = [thread for thread in self.searching if thread.is_alive()]
        while self.to_search and len(self.searching) < AT_ONCE:
            thread = threading.Thread(target=self._search_group, args=(self.to_search.popleft(),), daemon=True)
            self.searching.append(thread)
            thread.start()

    def _warm_up(self) -> None:
        """Compiles a group's programs while its clips land, group by group."""
        for kind in list(self.landed):
            names = [name for name in self.jobs if self.kinds[name] == kind]
            if not self.stop and self.unlanded[kind]:
                warm_up(self.jobs[names[0]], len(names), self.options, self._simulator)

    def _search_group(self, group: list[Prepared]) -> None:
        members: dict[int, str] = {}

        def ended(member: Member, error: Exception | None) -> None:
            self._tell(members.pop(id(member)), error)

        def going(some: Sequence[Member]) -> None:
            if self.stop:
                raise _Stopped
            for member in some:
                part = member.search.evaluations / member.ready.options.budget
                self.parts[members[id(member)]] = SEARCHING * min(1.0, part)

        try:
            ready = []
            for one in group:
                try:
                    ready.append(Member(one.ready, one.digest))
                    members[id(ready[-1])] = one.name
                except Exception as error:
                    self._tell(one.name, error)
            first = group[0].ready
            candidates = sum(member.search.population for member in ready)
            backend = fastest(self.options.backend, candidates, len(first.shapes)) if ready else self.backend
            log.info("%d clips of %s are searched together by %s", len(ready), "+".join(first.shapes), backend)
            if ready:
                with DEVICE:
                    simulator = self._simulator(backend, first.shapes, first.fps)
                Together(ready, simulator, ended, going).run()
        except _Stopped:
            return
        except Exception as error:
            for name in list(members.values()):
                self._tell(name, error)

    def _tell(self, name: str, error: Exception | None) -> None:
        with self._telling:  # several groups may end at once
            self.ended.put((name, error))
            self._ring.send_bytes(b".")

    def _searched(self) -> Outcome | None:
        """A search has ended: its clip is to be finished, or has failed."""
        self.bell.recv_bytes()
        name, error = self.ended.get()
        if error is not None:
            return Outcome(name, FAILED, told_of(error))
        self.to_finish.append(name)
        return None

    def _show(self) -> None:
        total = len(self.jobs)
        finished = total - self.left
        names = [worker.job.name for worker in self.workers if worker.job is not None]
        part = (finished + sum(self.parts.values())) / max(total, 1)
        self.progress.update(finished, total, part, tuple(names))


def _weight(kind: Kind) -> int:
    """Objects in the largest scene of a kind, as ``kind_of_job`` makes it."""
    scenes, _ = kind  # type: ignore[misc]
    return max((len(shapes) for shapes, _ in scenes), default=0)
