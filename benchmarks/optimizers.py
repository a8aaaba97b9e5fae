"""Quality against evaluations and against seconds, optimiser by optimiser, on clips of different motions.

    python -m benchmarks.clips --out clips --seed 100
    python -m benchmarks.optimizers clips --only 00_1_flight --methods hybrid,cmaes --threads 1 --json 00.json
    python -m benchmarks.optimizers --merge *.json --plot curves.png

A method is ``NAME[:SOLVER][@BUDGET]``: ``hybrid``, ``cmaes`` and ``gradient`` are ours, ``hybrid@2560`` has that budget,
``gradient:adam`` another solver in its stages. ``pycma`` is the package cma on our objective and space from the best
sample, with the prior's widths, the same population and bounds; like ours, it is never worse than that sample.
``oracle`` is told what no video tells: see the function.

Curves are of the best candidate so far, its fitness and IoU over the whole clip at the search's resolution; ``final`` is
C MuJoCo at full resolution. Seconds leave out reading and scoring of the samples, which all have in common. They hold
JAX's compilation, which whatever runs first in a process pays for all: ``--twice`` runs everything once before.
"""

from __future__ import annotations

import argparse
import dataclasses
import io
import itertools
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from benchmarks.quality import machine
from mjx_refine import Options, load_observation, load_scenes, refine, rotations
from mjx_refine.batch import SceneBatch, batch_from_scenes
from mjx_refine.files import write_text
from mjx_refine.observation import Observation
from mjx_refine.scene import Body, Samples, Scene, load_scene
from mjx_refine.search.objective import Objective
from mjx_refine.search.options import search_resolution
from mjx_refine.search.problem import Problem, Start
from mjx_refine.search.schedule import HORIZONS
from mjx_refine.space import Space

METHODS = ("hybrid", "cmaes", "gradient", "pycma", "oracle")
OURS = ("hybrid", "cmaes", "gradient")
POSE_NOISE = 0.01
"""Standard deviation of the oracle's poses [m]."""

STEP = 1e-4
"""The oracle's finite difference in the unit box: its default, 1.5e-8, sees the roughness of contacts, no slope."""

GIVEN = ("size", "camera_position", "camera_pitch", "camera_fovy")
"""Fields of the parameter space that the oracle is told, since poses do not show them."""


@dataclasses.dataclass(frozen=True)
class Method:
    """What ``NAME[:SOLVER][@BUDGET]`` says."""

    label: str
    name: str
    solver: str
    budget: int | None

    @classmethod
    def parse(cls, label: str) -> Method:
        """Raises ValueError for a name that is none of ``METHODS``."""
        rest, _, budget = label.partition("@")
        name, _, solver = rest.partition(":")
        if name not in METHODS:
            raise ValueError(f"method {label!r}; expected NAME[:SOLVER][@BUDGET], NAME one of {', '.join(METHODS)}")
        return cls(label, name, solver or "lm", int(budget) if budget else None)

    def options(self, base: Options) -> Options:
        """``base`` with what the method changes."""
        iterations = base.iterations if self.budget is None else max(1, self.budget // base.population)
        optimizer = self.name if self.name in OURS else base.optimizer
        return dataclasses.replace(base, optimizer=optimizer, solver=self.solver, iterations=iterations)


class Curve:
    """The best so far: rows of (evaluations, seconds, fitness, IoU)."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, float, float, float]] = []
        self.began = time.monotonic()

    def add(self, evaluations: int, fitness: float, iou: float, seconds: float | None = None) -> None:
        """A candidate was found after so many rollouts; seconds are since the curve began unless told."""
        seconds = time.monotonic() - self.began if seconds is None else seconds
        if self.rows and not fitness > self.rows[-1][2]:
            fitness, iou = self.rows[-1][2:]
        self.rows.append((int(evaluations), round(seconds, 3), float(fitness), float(iou)))


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a method did on a clip: curve, full-resolution scores of its result, rollouts, why it ended."""

    curve: Curve
    final: dict[str, float]
    evaluations: int
    reason: str


def _scores(scores) -> dict[str, float]:
    names = {"iou": "iou", "first": "first_frame_iou", "epe": "epe", "fitness": "fitness"}
    return {key: float(getattr(scores, name)[0]) for key, name in names.items()}


def _objective(problem: Problem, start: Start, space: Space) -> Objective:
    """What the population search minimises, by C MuJoCo at the search's resolution."""
    resolution = search_resolution(problem.options, problem.observation.size)
    reference = problem.reference(start.scene.shapes)
    return Objective(space, reference, reference, problem.scorer(start.scene.shapes, start.matching, resolution))


def _best(problem: Problem, start: Start, space: Space, points: list[np.ndarray]) -> dict[str, float]:
    """Full-resolution scores of the best of some points."""
    scores = problem.score([space.scene_at(p) for p in points], start.matching)
    return _scores(scores.candidate(int(np.argmax(np.nan_to_num(scores.fitness, nan=-np.inf)))))


def ours(samples: Samples, observation: Observation, options: Options) -> Outcome:
    """``refine`` without intervals; the curve is its history."""
    result = refine(samples, observation, options)
    curve = Curve()
    for step in result.history:
        curve.add(step.evaluations, step.fitness, step.iou, step.seconds)
    return Outcome(curve, _scores(result.refined.scores), result.evaluations, result.reason)


def pycma(samples: Samples, observation: Observation, options: Options) -> Outcome:
    """Hansen's own CMA-ES (package cma) on our objective.

    Raises:
      ImportError: without the package.
    """
    import cma

    problem = Problem(samples, observation, options)
    start = problem.starts[0]
    space = Space.around(start.scene)
    objective = _objective(problem, start, space)
    settings = {"CMA_stds": space.sigma, "popsize": options.population, "bounds": [0.0, 1.0], "verbose": -9}
    search = cma.CMAEvolutionStrategy(space.start, 1.0, {**settings, "seed": options.seed + 1})
    curve, best, lowest, evaluations = Curve(), space.start, np.inf, 0
    while not search.stop() and evaluations + options.population <= options.budget:
        asked = search.ask()
        points = np.clip(np.array(asked), 0.0, 1.0)
        costs, scores = objective(points)
        search.tell(asked, np.where(np.isfinite(costs), costs, 1e6).tolist())
        evaluations += len(points)
        row = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
        if costs[row] < lowest:
            lowest, best = float(costs[row]), points[row]
        curve.add(evaluations, -float(costs[row]), float(scores.iou[row]))
    reason = f"pycma stopped: {search.stop()}" if search.stop() else "The budget of rollouts is spent."
    points = [best, np.clip(search.mean, 0.0, 1.0), space.start]
    found = max(_best(problem, start, space, points), _scores(start.scores), key=lambda scores: scores["fitness"])
    return Outcome(curve, found, evaluations, reason)


# Oracle ---------------------------------------------------------------------------------------------------------------


class _Spent(Exception):
    """The budget of rollouts is spent."""


def _turns(shape: str) -> np.ndarray:
    """Rotations after which a body of this shape fills the same space, or would with its sizes renamed, (T, 3, 3)."""
    if shape != "box":
        return np.array([np.eye(3), np.diag([1.0, -1.0, -1.0])])
    signed = [
        np.eye(3)[:, list(order)] * signs
        for order in itertools.permutations(range(3))
        for signs in itertools.product([1.0, -1.0], repeat=3)
    ]
    return np.array([turn for turn in signed if np.linalg.det(turn) > 0])


class Poses:
    """The true motion, seen as the places of every body's centre and of the ends of its axes.

    Args:
      problem: the samples and the clip.
      truth: the true scene; C MuJoCo simulates it.
      options: of the problem.
    """

    def __init__(self, problem: Problem, truth: Scene, options: Options):
        observation, start = problem.observation, problem.starts[0]
        true = Problem(Samples("<truth>", (truth,), (0,)), observation, options).starts[0]
        pairs = {mask: n for n, mask in enumerate(true.matching) if mask >= 0}
        self.partner = [pairs.get(mask, -1) for mask in start.matching]
        motion = self._frames(problem, batch_from_scenes([true.given]), observation.length)
        bodies = list(start.scene.objects)
        self.seen = np.full((observation.length, len(bodies), 4, 3), np.nan)
        self.sizes = np.zeros((len(bodies), 3))
        for i, n in enumerate(self.partner):
            other = truth.objects[n]
            if n < 0 or bodies[i].shape != other.shape:
                continue
            first = rotations.matrix(np.array(bodies[i].orientation))
            turns = _turns(other.shape)
            nearest = turns[int(np.argmax(np.einsum("ij,ik,tkj->t", first, motion[0, 0, n, :, 1:], turns)))]
            bodies[i], self.sizes[i] = self._sized(bodies[i], other, nearest)
            centre, axes = motion[0, :, n, :, 0], motion[0, :, n, :, 1:] @ nearest
            self.seen[:, i] = np.concatenate([centre[:, None], self._ends(centre, axes, i)], 1)
        scene = dataclasses.replace(start.scene, objects=tuple(bodies), camera=truth.camera)
        self.problem = Problem(Samples("<oracle>", (scene,), (0,)), observation, options)
        self.start = dataclasses.replace(self.problem.starts[0], matching=start.matching)
        whole = Space.around(self.start.scene)
        held = np.array([p.field in GIVEN for p in whole.parameters])
        self.space = whole.freeze(held, whole.start, "given")

    @staticmethod
    def _sized(body: Body, true: Body, turn: np.ndarray) -> tuple[Body, np.ndarray]:
        """The body with the true sizes, and how far along each axis of its own poses are compared [m]."""
        if true.shape == "sphere":
            return dataclasses.replace(body, size=true.size), np.zeros(3)
        if true.shape == "cylinder":
            return dataclasses.replace(body, size=true.size), np.array([0.0, 0.0, max(true.size)])
        size = np.abs(turn).T @ np.array(true.size)
        return dataclasses.replace(body, size=tuple(float(s) for s in size)), size

    @staticmethod
    def _frames(problem: Problem, batch: SceneBatch, length: int) -> Float[np.ndarray, "batch frames bodies 3 4"]:
        """Place and axes of every body; far below the floor where a candidate diverges."""
        poses = problem.reference(batch.shapes).rollout(batch, length)
        good = np.isfinite(poses).all((1, 2, 3), keepdims=True)
        poses = np.where(good, poses, [0.0, 0.0, -1e2, 1.0, 0.0, 0.0, 0.0])
        return np.concatenate([poses[..., :3, None], rotations.matrix(poses[..., 3:])], -1)

    def _ends(self, centre: np.ndarray, axes: np.ndarray, i: int) -> np.ndarray:
        return centre[..., None, :] + np.swapaxes(axes * self.sizes[i], -1, -2)

    def residuals(
        self, points: Float[np.ndarray, "batch dimension"], frames: int
    ) -> Float[np.ndarray, "batch residuals"]:
        """Distances of points on the bodies in the first ``frames``, and of the parameters from the start, both in
        standard deviations."""
        moved = self._frames(self.problem, self.space.decode(points), frames)
        away = []
        for i in range(len(self.partner)):
            centre, axes = moved[:, :, i, :, 0], moved[:, :, i, :, 1:]
            now = np.concatenate([centre[..., None, :], self._ends(centre, axes, i)], -2)
            away.append(np.nan_to_num((now - self.seen[None, :frames, i]) / POSE_NOISE).reshape(len(points), -1))
        # Every frame says much the same of a smooth motion.
        poses = np.concatenate(away, -1) / np.sqrt(len(self.seen))
        return np.concatenate([poses, (points - self.space.start) / self.space.sigma], -1)


def oracle(samples: Samples, observation: Observation, options: Options, truth: Scene) -> Outcome:
    """``mujoco.sysid.optimize`` told the true poses of every frame, sizes and camera: the same-engine problem.

    The poses are C MuJoCo's simulation of the true scene. The clip may come from another engine, and its IoU with that
    simulation, not 1, is then what this can reach; fits of the clip itself may reach more. sysid's own residual
    starts every rollout from measured initial states, which are here the greater part of what is asked for. So its
    routine (``optimize``, with MuJoCo's least squares, bounds and finite differences) is given our residual: places of
    points on the bodies [cm], beside the prior, over a horizon that grows as ours does. It is an oracle for what poses
    would tell from one start, not a method: no video gives them.

    Raises:
      ImportError: without what mujoco.sysid needs (colorama, tabulate).
    """
    try:
        from mujoco.sysid import Parameter, ParameterDict, optimize
    except ImportError as error:
        raise ImportError("mujoco.sysid needs the packages colorama and tabulate") from error
    poses = Poses(Problem(samples, observation, options), truth, options)
    space, problem, start, length = poses.space, poses.problem, poses.start, observation.length
    objective, curve = _objective(problem, start, space), Curve()
    parameters = ParameterDict(
        {"scene": Parameter("scene", space.start, np.zeros(space.dimension), np.ones(space.dimension))}
    )
    spent, reason = 0.0, "Least squares converged."
    settings = {"x_scale": space.sigma, "eps": STEP, "max_iters": 30, "output": io.StringIO()}
    for frames in sorted({max(2, round(length * part)) for part in HORIZONS}):
        lowest, best = np.inf, parameters.as_vector()

        def residual(x: np.ndarray, _, frames=frames) -> tuple[list[np.ndarray], list, list]:
            nonlocal spent, lowest, best
            points = np.clip(np.atleast_2d(x.T), 0.0, 1.0)
            if spent + len(points) * frames / length > options.budget:
                raise _Spent
            spent += len(points) * frames / length
            values = poses.residuals(points, frames)
            squares = (values**2).sum(-1)
            row = int(np.argmin(squares))
            if squares[row] < lowest:
                lowest, best = float(squares[row]), points[row]
                costs, scores = objective(best[None])
                curve.add(int(np.ceil(spent)), -float(costs[0]), float(scores.iou[0]))
            return [values.T if x.ndim == 2 else values[0]], [], []

        parameters.move_off_bounds()
        try:
            parameters, _ = optimize(parameters, residual, verbose=False, **settings)
        except _Spent:
            reason = "The budget of rollouts is spent."
            break
    return Outcome(curve, _best(problem, start, space, [best]), int(np.ceil(spent)), reason)


# Measure --------------------------------------------------------------------------------------------------------------


def measure(folder: Path, method: Method, base: Options) -> dict:
    """One method on one clip; ``skipped`` says why where it cannot run."""
    meta = json.loads((folder / "meta.json").read_text()) if (folder / "meta.json").exists() else {}
    samples, observation = load_scenes(folder / "best32.yaml"), load_observation(folder / "flows.npz")
    options = method.options(base)
    row = {
        "clip": folder.name,
        "kind": meta.get("kind", "unknown"),
        "objects": meta.get("objects", len(samples.scenes[0].objects)),
        "method": method.label,
        "budget": options.budget,
        "truth_iou": meta.get("truth_iou_in_mujoco"),
    }
    run: Callable[..., Outcome] = ours if method.name in OURS else globals()[method.name]
    truth = folder / "truth.yaml"
    if method.name == "oracle" and not truth.exists():
        return {**row, "skipped": "no truth.yaml"}
    extra = (load_scene(truth),) if method.name == "oracle" else ()
    problem = Problem(samples, observation, options)
    start = problem.starts[0]
    space = Space.around(start.scene)
    costs, scores = _objective(problem, start, space)(space.start[None])
    first = (0, 0.0, -float(costs[0]), float(scores.iou[0]))
    try:
        outcome = run(samples, observation, options, *extra)
    except ImportError as error:
        return {**row, "skipped": str(error)}
    curve = outcome.curve.rows if method.name == "oracle" else _from(first, outcome.curve.rows)
    return {
        **row,
        "start": _scores(start.scores),
        "curve": curve,
        "final": outcome.final,
        "evaluations": outcome.evaluations,
        "seconds": curve[-1][1],
        "reason": outcome.reason,
    }


def _from(first: tuple[int, float, float, float], rows: list[tuple[int, float, float, float]]) -> list:
    """A curve that begins with the best sample, and so never lies below it."""
    curve = Curve()
    for evaluations, seconds, fitness, iou in [first, *rows]:
        curve.add(evaluations, fitness, iou, seconds)
    return curve.rows


def main() -> None:
    """Measures, or merges and draws."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--only", help="names of clips, with commas")
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--backend", default="mujoco")
    parser.add_argument("--population", type=int, default=128)
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--twice", action="store_true", help="measure the second of two runs, without compilation")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--merge", type=Path, nargs="+", help="print the tables of earlier --json files")
    parser.add_argument("--plot", type=Path, help="PNG of the mean curves")
    arguments = parser.parse_args()
    from benchmarks.optimizer_curves import plot, tables

    if arguments.merge:
        found = [json.loads(path.read_text()) for path in arguments.merge]
        runs, machines = [run for one in found for run in one["runs"]], sorted({one["machine"] for one in found})
    elif arguments.folder:
        methods = [Method.parse(label) for label in arguments.methods.split(",")]
        names = ("seed", "population", "iterations", "backend", "threads")
        base = Options(**{name: getattr(arguments, name) for name in names}, refits=0)
        runs, machines = [], [machine()]
        for folder in sorted(path.parent for path in arguments.folder.glob("*/flows.npz")):
            if arguments.only and folder.name not in arguments.only.split(","):
                continue
            for method in methods:
                if arguments.twice:
                    measure(folder, method, base)
                runs.append(measure(folder, method, base))
                print(json.dumps({k: v for k, v in runs[-1].items() if k != "curve"}), flush=True)
        if arguments.json:
            settings = {name: getattr(arguments, name) for name in (*names, "twice")}
            write_text(arguments.json, json.dumps({"machine": machines[0], **settings, "runs": runs}))
    else:
        parser.error("a folder of clips, or --merge")
    print(f"\n{'; '.join(machines)}\n\n{tables(runs)}")
    if arguments.plot:
        plot(runs, arguments.plot)


if __name__ == "__main__":
    main()
