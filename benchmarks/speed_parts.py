"""What a generation costs, part by part: our engines, and the peer (pycma, `mujoco.rollout`, MuJoCo's renderer)."""

from __future__ import annotations

import copy
import dataclasses
import time

import cma
import jax
import mjx_cmaes
import mujoco
import numpy as np
from mujoco import rollout

from benchmarks.speed_scenes import KINDS, Times, near, timed, times
from mjx_refine.observation import Observation
from mjx_refine.sim.backends import make_simulator
from mjx_refine.sim.model import SUBSTEPS, apply_fields, build_spec, initial_state, model_fields
from mjx_refine.simulate import simulate
from mjx_refine.space import Space
from mjx_refine.view.tiles import TileScorer

COMPILED = {"seconds": 0.0, "programs": 0}


def _count(event: str, seconds: float, **_: str | int) -> None:
    if event.endswith("backend_compile_duration"):
        COMPILED["seconds"] += seconds
        COMPILED["programs"] += 1


jax.monitoring.register_event_duration_secs_listener(_count)


@dataclasses.dataclass(frozen=True)
class Parts:
    """One scene kind.

    Attributes:
      dimension: parameters.
      first: the first generation, with compilation [s].
      compiled: of it, XLA's compilation [s].
      programs: how many were compiled.
      physics, pictures, search: of each later generation; pictures at the search's resolution.
      whole: of each later generation.
      full: pictures of a generation at full resolution.
    """

    dimension: int
    first: float
    compiled: float
    programs: int
    physics: Times
    pictures: Times
    search: Times
    whole: Times
    full: Times


class Clip:
    """An observed clip of a kind and a start near its truth."""

    def __init__(self, kind: str, size: tuple[int, int], frames: int):
        self.truth = KINDS[kind]
        self.observation: Observation = simulate(self.truth, size=size, frames=frames)
        self.space = Space.around(near(self.truth, 1))
        self.matching = tuple(range(1, len(self.truth.shapes) + 1))


def generations(clip: Clip, backend: str, population: int, count: int, width: int) -> Parts:
    """Runs the population search for a first and ``count`` further generations and times its parts."""
    observation, space = clip.observation, clip.space
    simulator = make_simulator(backend, clip.truth.shapes, observation.fps, quick=True)
    height = round(width * observation.size[1] / observation.size[0])
    scorer = TileScorer(clip.truth.shapes, observation, clip.matching, (width, height))
    settings = mjx_cmaes.Settings(dimension=space.dimension, population=population, tolerance_x=0.0, tolerance_cost=0.0)
    state = mjx_cmaes.init(settings, space.start, covariance=np.diag(space.sigma**2), seed=0)
    rows, last = [], None
    before = dict(COMPILED)
    for generation in range(count + 1):
        clock = [time.perf_counter()]
        points, state = mjx_cmaes.ask(settings, state)
        clock.append(time.perf_counter())
        batch = space.decode(points)
        poses = simulator.rollout(batch, observation.length)
        clock.append(time.perf_counter())
        scores = scorer(poses, batch)
        clock.append(time.perf_counter())
        state, _ = mjx_cmaes.tell(settings, state, points, -scores.fitness)
        clock.append(time.perf_counter())
        rows.append(np.diff(clock))
        last = poses, batch
        if generation == 0:
            compiled = {key: COMPILED[key] - before[key] for key in COMPILED}
    full = TileScorer(clip.truth.shapes, observation, clip.matching)
    full(*last)
    steps = np.array(rows)[1:]
    return Parts(
        dimension=space.dimension,
        first=float(rows[0].sum()),
        compiled=compiled["seconds"],
        programs=int(compiled["programs"]),
        physics=Times(tuple(steps[:, 1])),
        pictures=Times(tuple(steps[:, 2])),
        search=Times(tuple(steps[:, 0] + steps[:, 3])),
        whole=Times(tuple(steps.sum(1))),
        full=times(lambda: full(*last), 3),
    )


@dataclasses.dataclass(frozen=True)
class Peer:
    """Of one evaluation by the peer [s]: physics and search are shares of a generation's, pictures are one candidate's."""

    physics: Times
    pictures: Times
    search: Times

    @property
    def evaluation(self) -> float:
        """The medians' sum."""
        return self.physics.median + self.pictures.median + self.search.median


def peer(clip: Clip, population: int, evaluations: int) -> Peer:
    """pycma asks, `mujoco.rollout` steps all candidates on all cores, MuJoCo's renderer segments each frame of a candidate.

    Masks alone: the renderer has no flow. Models are edited in place, one renderer is kept: nothing is built twice.
    """
    space, observation = clip.space, clip.observation
    spec = build_spec(clip.truth.shapes, observation.fps)
    spec.worldbody.add_camera(name="view")
    spec.visual.global_.offwidth, spec.visual.global_.offheight = observation.size
    models = [spec.compile()]
    models += [copy.copy(models[0]) for _ in range(population - 1)]
    data = [mujoco.MjData(models[0]) for _ in range(2)]
    strategy = cma.CMAEvolutionStrategy(
        space.start, 1.0, {"popsize": population, "bounds": [0, 1], "CMA_stds": space.sigma, "seed": 1, "verbose": -9}
    )
    physics, search, pictures = [], [], []
    steps = (observation.length - 1) * SUBSTEPS
    with mujoco.Renderer(models[0], observation.size[1], observation.size[0]) as renderer:
        renderer.enable_segmentation_rendering()
        for _ in range(3):
            start = time.perf_counter()
            points = np.array(strategy.ask())
            asked = time.perf_counter() - start
            batch = space.decode(points)

            def rolled(batch=batch) -> np.ndarray:
                fields = model_fields(batch)
                for row, model in enumerate(models):
                    apply_fields(model, fields, row, None)
                qpos, qvel = initial_state(batch)
                state = np.zeros((population, mujoco.mj_stateSize(models[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)))
                state[:, 1 : 1 + qpos.shape[1] + qvel.shape[1]] = np.concatenate([qpos, qvel], 1)
                states, _ = rollout.rollout(models, data, state, nstep=steps)
                return np.concatenate([qpos[:, None], states[:, SUBSTEPS - 1 :: SUBSTEPS, 1 : 1 + qpos.shape[1]]], 1)

            physics.append(timed(rolled) / population)
            positions = rolled()
            costs = np.linalg.norm(points - 0.5, axis=1)
            for row in range(evaluations):
                start = time.perf_counter()
                apply_fields(models[0], model_fields(batch[row : row + 1]), 0, None)
                costs[row] = -segmented_iou(
                    renderer, models[0], data[0], positions[row], batch[row : row + 1], observation
                )
                pictures.append(time.perf_counter() - start)
            search.append((asked + timed(lambda p=points, c=costs: strategy.tell(list(p), list(c)))) / population)
    return Peer(Times(tuple(physics)), Times(tuple(pictures)), Times(tuple(search)))


def segmented_iou(
    renderer: mujoco.Renderer, model: mujoco.MjModel, data: mujoco.MjData, positions, batch, observation: Observation
) -> float:
    """Foreground IoU of one candidate (a batch of one, whose fields ``model`` has), by MuJoCo's segmentation."""
    half = batch.camera_pitch[0] / 2
    model.cam_pos[0], model.cam_quat[0] = batch.camera_position[0], [np.cos(half), np.sin(half), 0, 0]
    model.cam_fovy[0] = np.rad2deg(batch.camera_fovy[0])
    both = either = 0
    for position, mask in zip(positions, observation.masks, strict=True):
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        renderer.update_scene(data, "view")
        picture = renderer.render()
        seen = (picture[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)) & (picture[..., 0] > 0)
        both, either = both + int((seen & (mask > 0)).sum()), either + int((seen | (mask > 0)).sum())
    return both / max(either, 1)


def update_times(dimension: int, population: int, count: int) -> Times:
    """Ask and tell of our search alone, by generation."""
    settings = mjx_cmaes.Settings(dimension=dimension, population=population, tolerance_x=0.0, tolerance_cost=0.0)
    state = mjx_cmaes.init(settings, np.full(dimension, 0.4), 1 / 6, seed=0)
    seconds = []
    for _ in range(count):
        start = time.perf_counter()
        points, state = mjx_cmaes.ask(settings, state)
        asked = time.perf_counter()
        costs = ((points - 0.5) ** 2).sum(1)
        told = time.perf_counter()
        state, _ = mjx_cmaes.tell(settings, state, points, costs)
        seconds.append(asked - start + time.perf_counter() - told)
    return Times(tuple(seconds))
