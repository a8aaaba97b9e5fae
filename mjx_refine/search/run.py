"""The search itself: land, search, finish; resumable after every step."""

from __future__ import annotations

import dataclasses
import functools
import time
from pathlib import Path

import numpy as np
from mjx_fitness import Scores

from mjx_refine.effects import batch_with_effects
from mjx_refine.scene import Scene
from mjx_refine.search.checkpoint import damaged, input_digest, load_checkpoint, save_checkpoint
from mjx_refine.search.derivatives import DerivativeChoice, Derivatives
from mjx_refine.search.engines import Engines
from mjx_refine.search.intervals import Intervals, intervals
from mjx_refine.search.landed import Landed, first_covariance, landed_well
from mjx_refine.search.landing import LeastSquares
from mjx_refine.search.landings import Landings
from mjx_refine.search.objective import Objective
from mjx_refine.search.objectives import Objectives
from mjx_refine.search.options import search_resolution
from mjx_refine.search.population import PopulationSearch
from mjx_refine.search.problem import Problem, Start, kind_of_scene
from mjx_refine.search.progress import Progress, Step
from mjx_refine.search.race import OPEN, TRIAL, Contender, Race, second_landing
from mjx_refine.search.ready import Ready, Searched
from mjx_refine.search.undetermined import back_to_start, insensitive
from mjx_refine.sim.backends import Simulator, fastest
from mjx_refine.sim.devices import on_device
from mjx_refine.space import Space
from mjx_refine.view.grid import sampled

LANDING_SHARE = 0.6
"""Part of the budget that least squares may spend before the population search (``hybrid``)."""

CHECKPOINT_SECONDS = 1.0


@dataclasses.dataclass(frozen=True)
class Found:
    """What the search found: the winning start, its space, the best scene and how it was reached.

    Attributes:
      start, space: what the scene was refined from.
      scene, scores: the best scene and its full-resolution scores by C MuJoCo.
      values: of the space's parameters.
      undetermined: names of those on which the score does not depend.
      known: intervals of the parameters, None if none were asked for or the best sample was kept as it came.
      derivatives: which could be trusted where the landings ended.
      history, evaluations, reason: the way there.
      backend, device: what searched.
      searched: seconds of the population search.
    """

    start: Start
    space: Space
    scene: Scene
    scores: Scores
    values: tuple[float, ...]
    undetermined: tuple[str, ...]
    known: Intervals | None
    derivatives: Derivatives
    history: tuple[Step, ...]
    evaluations: int
    reason: str
    backend: str
    device: str
    searched: float


@dataclasses.dataclass(frozen=True)
class Beginning:
    """Where a population search starts: a sample, its space, and the first generation's mean and covariance."""

    start: Start
    space: Space
    mean: np.ndarray
    covariance: np.ndarray


class Run:
    """One refinement.

    Args:
      problem: samples and observation.
      progress: a display.
      checkpoint: file for the state, or None to keep nothing.
      resume: go on from that file.
    """

    def __init__(self, problem: Problem, progress: Progress, checkpoint: Path | None, resume: bool):
        self.problem, self.options, self.progress = problem, problem.options, progress
        self.path, self.choice = checkpoint, DerivativeChoice(problem, progress.message)
        self.engines = Engines(problem)
        self.objectives = Objectives(problem, self.engines)
        self.began = time.monotonic()
        self.digest = input_digest(problem.samples, problem.observation, self.options)
        self.history: list[Step] = []
        share = LANDING_SHARE if self.options.optimizer == "hybrid" else 1.0
        limit = int(share * self.options.budget)
        self.landings = Landings(problem, self._squares, self.choice.automatic, self._shown, limit)
        self.evaluations = 0
        self.before = 0.0
        self._saved: tuple[dict, dict] | None = None
        self._written = 0.0
        self._searched: Searched | None = None
        self._loose: np.ndarray | None = None
        if resume and checkpoint is not None:
            loaded = load_checkpoint(checkpoint, self.digest)
            try:
                self._restore(loaded)
            except (KeyError, ValueError, TypeError, AttributeError) as error:
                raise damaged(checkpoint, error) from error

    @property
    def seconds(self) -> float:
        """Since the run began, earlier parts of a resumed run included."""
        return self.before + time.monotonic() - self.began

    def __call__(self) -> Found:
        """Runs to the end."""
        if self.options.optimizer != "cmaes":
            self._land()
        first = self._beginning()
        winner, where, found = first, Searched("Least squares converged.", "mujoco", "cpu", 0.0), []
        if self._searched is not None:
            where = self._searched
            found = self._race([first]).contenders[0].search.found
        elif self.options.optimizer != "gradient":
            began = time.monotonic()
            with on_device():
                chosen, simulator = self._search(first)
            winner = Beginning(chosen.start, chosen.space, chosen.search.mean, chosen.search.covariance)
            where = Searched(str(chosen.search.reason), simulator.name, simulator.device, time.monotonic() - began)
            found = chosen.search.found
        start, space = winner.start, winner.space
        derivatives = self.choice.final(start, space, winner.mean)
        elites = [winner.mean, *found]
        return Found(
            **self._finish(start, space, elites, self.objectives.of(start, space)),
            derivatives=derivatives,
            history=tuple(self.history),
            evaluations=self.evaluations,
            reason=where.reason,
            backend=where.backend,
            device=where.device,
            searched=where.seconds,
        )

    # Land ---------------------------------------------------------------------------------------------------------

    def _land(self) -> None:
        self.landings(lambda: self._save(force=True))
        self.evaluations = max(self.evaluations, self.landings.evaluations)

    def _shown(self, evaluations: int, start: Start, space: Space, point: np.ndarray, frames: int) -> None:
        self.evaluations = evaluations
        costs, scores = self.objectives.glance(start, space, point)
        self._step("land", (-float(costs[0]), float(scores.iou[0]), float(scores.epe[0])), float(frames))

    @property
    def landed(self) -> list[Landed]:
        """Where least squares arrived so far."""
        return self.landings.landed

    def _squares(self, start: Start, space: Space) -> LeastSquares:
        reference = self.problem.reference(start.scene.shapes)
        columns, image = self.problem.columns(start.matching), self.problem.observation.size
        return LeastSquares(
            space,
            self.engines.rollout(start.scene, space.dimension),
            self.problem.seen,
            columns,
            image,
            flow=self.problem.flow,
            seed=self.options.seed,
            solver=self.options.solver,
            fps=reference.fps,
            look=self.engines.look(start.scene, space.dimension),
            foresees=self.engines.on_device(start.scene, space.dimension),
        )

    def _beginning(self) -> Beginning:
        """Where the population search starts: the best landing, or the best sample."""
        if self.landed:
            best = max(self.landed, key=lambda landed: landed.fitness)
            start = self.problem.starts[best.rank]
            space = Space.around(start.scene)
            return Beginning(
                start, space, self.objectives.aimed(start, space, best.point), first_covariance(best, space)
            )
        start = self.problem.starts[0]
        space = Space.around(start.scene)
        return Beginning(start, space, space.start, np.diag(space.sigma**2))

    def _beginnings(self, first: Beginning) -> list[Beginning]:
        """``first``, and another landing where none is good."""
        alone = self.options.optimizer != "hybrid" or (self._saved is not None and "searches" not in self._saved[0])
        other = None if alone else second_landing(self.landed, self.options.budget - self.landings.evaluations)
        if other is None:
            return [first]
        start = self.problem.starts[other.rank]
        space = Space.around(start.scene)
        return [first, Beginning(start, space, other.point, np.diag((OPEN * space.sigma) ** 2))]

    # Search -------------------------------------------------------------------------------------------------------

    def ready(self) -> Ready | None:
        """Lands, and says what the population search needs, for a search elsewhere; None where none is left to do, or where
        effects must be searched here.

        The checkpoint is then written, to which a search elsewhere adds (``Ready.checkpoint``), and from which a resumed run
        goes on to the finish.
        """
        if self.options.optimizer == "gradient" or self._searched is not None or self.path is None:
            return None
        if self.options.optimizer != "cmaes":
            self._land()
        first = self._beginning()
        self._save(force=True)
        if batch_with_effects([first.start.scene]).effects:
            return None
        observation = self.problem.observation
        return Ready(
            shapes=first.start.scene.shapes,
            fps=observation.fps,
            samples=sampled(observation, first.start.matching, search_resolution(self.options, observation.size)),
            options=self.options,
            space=first.space,
            mean=first.mean,
            covariance=first.covariance,
            landed=landed_well(self.landed),
            checkpoint=self.path,
        )

    def ahead(self) -> None:
        """After ``ready``, what the finish needs and the search does not change: derivatives where it begins, kept by the
        problem."""
        first = self._beginning()
        self.choice.judge(first.start, first.space, first.mean)

    def _race(self, beginnings: list[Beginning]) -> Race:
        """The search from each, or what is saved of it."""
        options, before, landed = self.options, self.landings.evaluations, landed_well(self.landed)
        part = 1.0 - TRIAL * (len(beginnings) - 1)
        searches = [
            PopulationSearch(options, b.mean, b.covariance, b.space.start, landed, before, part) for b in beginnings
        ]
        contenders = [Contender(b.start, b.space, s) for b, s in zip(beginnings, searches, strict=True)]
        race = Race(contenders, options, before, self.objectives.finer)
        if self._saved is not None:
            try:
                race.restore(*self._saved)
            except (KeyError, ValueError, TypeError) as error:
                raise damaged(Path(self.path or ""), error) from error
            race.evaluations = self.evaluations
        return race

    def _search(self, first: Beginning) -> tuple[Contender, Simulator]:
        """Generations until the search ends; the search that came highest, and what simulated it."""
        race = self._race(self._beginnings(first))
        backend = self.problem.backends[kind_of_scene(first.start.given)]
        if backend != "mujoco":
            backend = fastest(self.options.backend, self.options.population, len(first.start.scene.shapes))

        @functools.cache
        def objective(k: int, fine: bool) -> Objective:
            start, space = race.contenders[k].start, race.contenders[k].space
            return self.objectives.of(start, space, self.engines.quick(backend, space.scene.shapes), fine)

        while (turn := race.turn()) is not None:
            k, points = turn
            costs, scores = objective(k, race.contenders[k].search.fine)(points)
            generation = race.told(k, points, costs, scores)
            self.evaluations = race.evaluations
            if generation:
                self._step("search", race.contenders[race.winner].search.best, race.contenders[k].search.spread)
                self._saved = race.saved()
                self._save()
        winner = race.contenders[race.winner]
        return winner, self.engines.quick(backend, winner.space.scene.shapes)

    # Finish -------------------------------------------------------------------------------------------------------

    def _finish(self, start: Start, space: Space, points: list[np.ndarray], objective: Objective) -> dict:
        """The best of samples, landing and elites at full resolution, by C MuJoCo, as fields of ``Found``."""
        points = [np.clip(p, 0.0, 1.0) for p in points]
        point = self._best_of(space, start, points)
        point = self._best_of(space, start, [point, self.objectives.aimed(start, space, point)])
        known = None
        if self.options.refits:
            self.progress.message(f"{self.options.refits} refits around the solution, for intervals")
            known = intervals(self._squares(start, space), point, self.options.refits, self.options.seed)
            point = self._best_of(space, start, [point, known.point])
        loose = self._loose
        if loose is None:
            loose = insensitive(space, point, lambda p: objective(p)[0])
        point = back_to_start(space, point, loose, lambda p: self._full_costs(space, start, p))
        scene = space.scene_at(point)
        scores = self.problem.score([scene], start.matching)
        first = self.problem.starts[0]
        if not scores.fitness[0] >= first.fitness:
            # Nothing better than the best sample as it came.
            space = Space.around(first.scene)
            start, point, scene, scores = first, space.start, first.given, first.scores
            loose, known = np.zeros(space.dimension, bool), None
        names = tuple(n for n, free in zip(space.names, loose, strict=True) if free)
        values = tuple(float(v) for v in space.values(point))
        return {
            "start": start,
            "space": space,
            "scene": scene,
            "scores": scores,
            "undetermined": names,
            "values": values,
            "known": known,
        }

    def _best_of(self, space: Space, start: Start, points: list[np.ndarray]) -> np.ndarray:
        return points[int(np.argmin(self._full_costs(space, start, np.stack(points))))]

    def _full_costs(self, space: Space, start: Start, points: np.ndarray) -> np.ndarray:
        scores = self.problem.score([space.scene_at(p) for p in points], start.matching)
        return np.where(np.isfinite(scores.fitness), -scores.fitness, np.inf)

    # Bookkeeping --------------------------------------------------------------------------------------------------

    def _step(self, phase: str, best: tuple[float, float, float], spread: float) -> None:
        iteration = sum(step.phase == phase for step in self.history)
        step = Step(
            phase=phase,
            iteration=iteration,
            evaluations=self.evaluations,
            budget=self.options.budget,
            seconds=self.seconds,
            fitness=best[0],
            iou=best[1],
            epe=best[2],
            spread=spread,
        )
        self.history.append(step)
        self.progress.step(step)

    def _save(self, force: bool = False) -> None:
        """Writes the checkpoint, at most once a second unless forced: a lost second is computed again."""
        if self.path is None or not (force or time.monotonic() - self._written > CHECKPOINT_SECONDS):
            return
        values = {
            "digest": self.digest,
            "evaluations": self.evaluations,
            "seconds": self.seconds,
            "history": [dataclasses.astuple(step) for step in self.history],
            "searching": self._saved is not None,
            "searched": None if self._searched is None else dataclasses.astuple(self._searched),
        }
        landed, arrays = self.landings.saved()
        values.update(landed)
        if self._saved is not None:
            values.update(self._saved[0])
            arrays.update(self._saved[1])
        save_checkpoint(self.path, values, arrays)
        self._written = time.monotonic()

    def _restore(self, loaded) -> None:
        if loaded is None:
            self.progress.message("no checkpoint yet: starting from the beginning")
            return
        values, arrays = loaded
        self.evaluations, self.before = values["evaluations"], values["seconds"]
        self.history = [Step(*row) for row in values["history"]]
        self.landings.restore(values, arrays)
        if values["searching"]:
            self._saved = (values, arrays)
        if values.get("searched") is not None:
            self._searched, self._loose = Searched(*values["searched"]), arrays.get("loose")
        self.progress.message(f"resumed after {self.evaluations} rollouts")
