"""Population searches of many clips of one kind in lock-step: one rollout and one comparison of pictures a generation for all."""

from __future__ import annotations

import dataclasses
import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from mjx_fitness import Scores

from mjx_refine.errors import InputError
from mjx_refine.search.checkpoint import damaged, load_checkpoint, save_checkpoint
from mjx_refine.search.objective import launched, price_of_overlap
from mjx_refine.search.population import PopulationSearch
from mjx_refine.search.progress import Step
from mjx_refine.search.ready import Ready, Searched
from mjx_refine.search.undetermined import around, unmoved
from mjx_refine.sim.backends import Simulator
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.space import decode_together
from mjx_refine.view.grid import GridScorer

log = logging.getLogger("mjx_refine")

CANDIDATES = 8192
"""Most in one batch: what is more goes one batch after the other. Halved for good where a device's memory does not suffice."""

LEAST = 64
"""A batch that does not fit in memory and is no larger than this fails."""

MOST_OF_THEM = 0.6
"""Part of a group's candidates from which those that leave at once are looked at once more together."""

DEVICE = threading.RLock()
"""One thread at a time gives the device something to do: Warp builds and records its kernels for all of a process. Threads wait
for their rollouts without it."""

CHECKPOINT_SECONDS = 10.0
"""Between two checkpoints of a clip; what is lost is computed again."""


class Member:
    """One clip's search and its checkpoint.

    Args:
      ready: what a run left.
      digest: of the run, which its checkpoint must have.

    Raises:
      InputError: the checkpoint is damaged, or of another run.
    """

    def __init__(self, ready: Ready, digest: str):
        self.ready = ready
        loaded = load_checkpoint(ready.checkpoint, digest)
        if loaded is None:
            raise InputError(f"{ready.checkpoint}: it is gone; expected the checkpoint that was just written")
        self.values, self.arrays = loaded
        self.began, self.written = time.monotonic(), time.monotonic()
        self.before = float(self.values["seconds"])
        space = ready.space
        evaluations = int(self.values["evaluations"])
        self.search = PopulationSearch(
            ready.options, ready.mean, ready.covariance, space.start, ready.landed, evaluations
        )
        if self.values["searching"]:
            try:
                self.search.restore(self.values, self.arrays)
            except (KeyError, ValueError, TypeError) as error:
                raise damaged(ready.checkpoint, error) from error

    def told(self, points: np.ndarray, costs: np.ndarray, scores: Scores) -> None:
        """Takes a generation's costs; saves the search now and then."""
        if self.search.told(points, costs, scores):
            fitness, iou, epe = self.search.best
            step = Step(
                phase="search",
                iteration=sum(row[0] == "search" for row in self.values["history"]),
                evaluations=self.search.evaluations,
                budget=self.ready.options.budget,
                seconds=self._seconds,
                fitness=fitness,
                iou=iou,
                epe=epe,
                spread=self.search.spread,
            )
            self.values["history"].append(list(dataclasses.astuple(step)))
        if time.monotonic() - self.written > CHECKPOINT_SECONDS:
            self.save()

    def save(self, searched: Searched | None = None, loose: np.ndarray | None = None) -> None:
        """Writes the checkpoint; with ``searched`` a resumed run goes on to the finish, and knows ``loose`` parameters."""
        saved = self.search.saved()
        if saved is not None:
            self.values.update(saved[0], searching=True)
            self.arrays.update(saved[1])
        self.values.update(evaluations=self.search.evaluations, seconds=self._seconds)
        if searched is not None:
            self.values["searched"] = dataclasses.astuple(searched)
        if loose is not None:
            self.arrays["loose"] = loose
        values = {key: value for key, value in self.values.items() if key != "version"}
        save_checkpoint(self.ready.checkpoint, values, self.arrays)
        self.written = time.monotonic()

    @property
    def _seconds(self) -> float:
        return self.before + time.monotonic() - self.began


Asked: TypeAlias = tuple[Member, np.ndarray]
"""A member and the points of the unit box that it asks for."""

Ended = Callable[[Member, Exception | None], object]
"""Is told each member whose search has ended; with an error, that it has failed."""


class Together:
    """Searches of clips of one kind, a generation of all of them at a time.

    Args:
      members: of one ``Ready.kind``.
      simulator: of the kind; with ``launch`` the poses stay on its device.
      ended: is told.
      going: is told the number of evaluations of every member, after each generation.
    """

    def __init__(
        self,
        members: Sequence[Member],
        simulator: Simulator,
        ended: Ended,
        going: Callable[[Sequence[Member]], object] = lambda members: None,
    ):
        self.members, self.simulator, self.ended, self.going = list(members), simulator, ended, going
        first = members[0].ready
        self.reference = MujocoSimulator(first.shapes, first.fps, 1)
        self.most = CANDIDATES
        self.began = time.monotonic()
        clips, weights = [m.ready.samples for m in members], [m.ready.options.weights for m in members]
        with DEVICE:
            self.scorer = GridScorer(first.shapes, clips, weights)
        self.rows = {id(member): row for row, member in enumerate(members)}
        self._candidates = sum(member.search.population for member in members)

    def run(self) -> None:
        """Runs all searches to their ends."""
        count, generations = len(self.members), 0
        while self.members:
            for part in _parts(self._asked(), self.most):
                self._generation(part)
            self.going(self.members)
            generations += 1
        log.info("%d clips searched in %d generations, %.1f s", count, generations, time.monotonic() - self.began)

    def _asked(self) -> list[Asked]:
        """Members that go on, and their points; the others leave."""
        asked, staying, leaving = [], [], []
        for member in self.members:
            try:
                points = member.search.points()
                if points is None:
                    leaving.append(member)
                    continue
                asked.append((member, member.ready.space.checked(points)))
                staying.append(member)
            except Exception as error:  # one clip's failure is its own
                self.ended(member, error)
        self.members = staying
        self._leave(leaving)
        return asked

    def _leave(self, members: list[Member]) -> None:
        seconds = time.monotonic() - self.began
        loose = self._insensitive(members)
        for member in members:
            try:
                searched = Searched(str(member.search.reason), self.simulator.name, self.simulator.device, seconds)
                member.save(searched, loose.get(id(member)))
                self.ended(member, None)
            except Exception as error:
                self.ended(member, error)

    def _insensitive(self, members: list[Member]) -> dict[int, np.ndarray]:
        """Parameters on which the score does not depend around the best candidate, by member: of all together that takes a
        generation or two, of each alone a second of a core. Where few leave it is left to them: a batch as large as a
        generation's compiles nothing, a smaller one would."""
        if sum(member.search.population for member in members) < MOST_OF_THEM * self._candidates:
            return {}
        points = {id(m): around(m.ready.space, m.search.elites[0]) for m in members}
        costs: dict[int, list[np.ndarray]] = {key: [] for key in points}
        sizes = {id(m): m.search.population for m in members}
        try:
            for k in range(max((-(-len(points[key]) // size) for key, size in sizes.items()), default=0)):
                asked = [(m, _rows(points[id(m)], k, sizes[id(m)])) for m in members]
                for part in _parts(asked, self.most):
                    for (member, _), (own, _) in zip(part, self._evaluated(part), strict=True):
                        costs[id(member)].append(own)
        except Exception as error:
            log.info("parameters that do not act are found clip by clip (%s)", error)
            return {}
        return {key: unmoved(np.concatenate(own)[: len(points[key])]) for key, own in costs.items()}

    def _generation(self, part: list[Asked]) -> None:
        try:
            told = self._evaluated(part)
        except Exception as error:
            total = sum(len(points) for _, points in part)
            if _memory_is_short(error) and total > LEAST and len(part) > 1:
                self.most = max(LEAST, total // 2)
                log.warning("%d candidates do not fit in the device's memory; now at most %d at once", total, self.most)
                for less in _parts(part, self.most):
                    self._generation(less)
                return
            for member, _ in part:
                self._failed(member, error)
            return
        for (member, points), (costs, scores) in zip(part, told, strict=True):
            try:
                member.told(points, costs, scores)
            except Exception as error:
                self._failed(member, error)

    def _failed(self, member: Member, error: Exception) -> None:
        self.members = [other for other in self.members if other is not member]
        self.ended(member, error)

    def _evaluated(self, part: list[Asked]) -> list[tuple[np.ndarray, Scores]]:
        """(costs, scores) of each member's points."""
        batch = decode_together([member.ready.space for member, _ in part], [points for _, points in part])
        counts = [0] * len(self.rows)  # those that have left keep their places
        for member, points in part:
            counts[self.rows[id(member)]] = len(points)
        with DEVICE:
            poses = launched(self.simulator, batch, self.scorer.length)
        prices = price_of_overlap(self.reference, batch)  # while the device computes
        shown = poses()
        with DEVICE:
            sums = self.scorer.compared(shown, batch, counts)
        scores = self.scorer.scored(sums, counts)
        own = np.split(prices, np.cumsum(counts)[:-1])
        rows = [self.rows[id(member)] for member, _ in part]
        return [(own[row] - scores[row].fitness, scores[row]) for row in rows]


def _rows(points: np.ndarray, k: int, size: int) -> np.ndarray:
    """The k-th ``size`` rows, the first one again beyond the last."""
    rows = np.arange(k * size, (k + 1) * size)
    return points[np.where(rows < len(points), rows, 0)]


def _parts(asked: list[Asked], most: int) -> list[list[Asked]]:
    """Members whose candidates fit in one batch, in order; a member alone may have more."""
    parts: list[list[Asked]] = []
    room = 0
    for entry in asked:
        count = len(entry[1])
        if not parts or count > room:
            parts.append([])
            room = most
        parts[-1].append(entry)
        room -= count
    return parts


def _memory_is_short(error: Exception) -> bool:
    """As JAX ("out of memory") and Warp ("Failed to allocate ... bytes") say it."""
    told = str(error).lower()
    return isinstance(error, MemoryError | RuntimeError) and ("memory" in told or "failed to allocate" in told)
