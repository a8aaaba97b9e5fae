"""How the cost of a generation grows with clips, candidates, objects and pixels, and how soon a second process begins."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.speed_scenes import CAMERA, KINDS, Times, near, timed
from mjx_refine.scene import Scene
from mjx_refine.search.objective import launched, price_of_overlap
from mjx_refine.search.options import Options
from mjx_refine.search.population import PopulationSearch
from mjx_refine.sim.backends import make_simulator
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.simulate import simulate
from mjx_refine.space import Space, decode_together
from mjx_refine.view.grid import GridScorer, sampled

WIDTH = 160
SIX = Scene(
    tuple(
        dataclasses.replace(body, name=f"{body.name}_{k}", position=(body.position[0] + shift, *body.position[1:]))
        for k, shift in enumerate((0.0, 1.3))
        for body in (*KINDS["box+cylinder"].objects, *KINDS["sphere"].objects)
    ),
    CAMERA,
)
"""Six objects, of which the first n make a scene of n."""


@dataclasses.dataclass(frozen=True)
class Generation:
    """Parts of a generation of several clips [s]: proposing and decoding, physics, pictures, learning."""

    ask: Times
    physics: Times
    pictures: Times
    tell: Times
    whole: Times


def together(
    kind: str, clips: int, backend: str, population: int, count: int, size=(480, 320), frames=30
) -> Generation:
    """Generations of ``clips`` clips of a kind in lock-step, as ``mjx_refine.search.together`` makes them, timed part by
    part: here each part is waited for, there the next clips' thinking goes on beside the device."""
    truth = KINDS[kind]
    observation = simulate(truth, size=size, frames=frames)
    height = round(WIDTH * size[1] / size[0])
    clip = sampled(observation, tuple(range(1, len(truth.shapes) + 1)), (min(WIDTH, size[0]), min(height, size[1])))
    scorer = GridScorer(truth.shapes, [clip] * clips)
    simulator, reference = (
        make_simulator(backend, truth.shapes, 30.0, quick=True),
        MujocoSimulator(truth.shapes, 30.0, 1),
    )
    spaces = [Space.around(near(truth, 1 + k)) for k in range(clips)]
    options = Options(population=population, iterations=count + 2, optimizer="cmaes")
    searches = [
        PopulationSearch(options, space.start, np.diag(space.sigma**2), space.start, False, 0) for space in spaces
    ]
    rows = []
    for _ in range(count + 1):
        clock = [time.perf_counter()]
        asked = [search.points() for search in searches]
        batch = decode_together(spaces, asked)
        clock.append(time.perf_counter())
        poses = launched(simulator, batch, frames)()
        prices = np.split(price_of_overlap(reference, batch), clips)
        jax.block_until_ready(poses)
        clock.append(time.perf_counter())
        scores = scorer.score(poses, batch, [population] * clips)
        clock.append(time.perf_counter())
        for search, points, price, one in zip(searches, asked, prices, scores, strict=True):
            search.told(points, price - one.fitness, one)
        clock.append(time.perf_counter())
        rows.append(np.diff(clock))
    steps = np.array(rows)[1:]
    return Generation(*(Times(tuple(column)) for column in steps.T), Times(tuple(steps.sum(1))))


def pictures(objects: int, size: tuple[int, int], population: int, count: int, frames: int = 30) -> Times:
    """Pictures of a generation, every pixel compared."""
    scene = dataclasses.replace(SIX, objects=SIX.objects[:objects])
    observation = simulate(scene, size=size, frames=frames)
    space = Space.around(near(scene, 1))
    steps = 0.3 * space.sigma * np.random.default_rng(0).normal(size=(population, space.dimension))
    batch = space.decode(np.clip(space.start + steps, 0, 1))
    poses = jnp.asarray(MujocoSimulator(scene.shapes, 30.0).rollout(batch, frames), jnp.float32)
    scorer = GridScorer(scene.shapes, [sampled(observation, tuple(range(1, objects + 1)))])
    scorer.score(poses, batch, [population])
    seconds = [timed(lambda: scorer.score(poses, batch, [population])) for _ in range(count)]
    return Times(tuple(seconds))


FIRST = """
import sys, time
from mjx_refine import load_observation, load_scenes, refine
from mjx_refine.search import Options, Progress

class First(Progress):
    def step(self, step):
        if step.phase == "search":
            print("first generation", flush=True)
            sys.exit()

folder = sys.argv[1]
options = Options(optimizer="cmaes", backend=sys.argv[2])
refine(load_scenes(folder + "/best32.yaml"), load_observation(folder + "/flows.npz"), options, progress=First())
"""


def first_generation(folder: Path, backend: str) -> float:
    """Seconds from a process's start to the end of the first generation of 128 for the clip in ``folder``."""
    path = os.pathsep.join(os.path.abspath(entry or ".") for entry in sys.path)
    begun = time.perf_counter()
    command = [sys.executable, "-W", "ignore", "-c", FIRST, str(folder), backend]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        for line in child.stdout:
            if line.startswith("first generation"):
                return time.perf_counter() - begun
    raise RuntimeError("the process ended before its first generation")
