"""Programs for a group of clips, compiled while the clips are still landing."""

from __future__ import annotations

import logging
from collections.abc import Callable

from mjx_refine.batch import batch_from_scenes
from mjx_refine.many.jobs import Job
from mjx_refine.observation import load_observation
from mjx_refine.scene import Shape, load_scenes
from mjx_refine.search import Options
from mjx_refine.search.objective import launched
from mjx_refine.search.options import search_resolution
from mjx_refine.search.together import CANDIDATES, DEVICE
from mjx_refine.sim.backends import Simulator, fastest
from mjx_refine.view.grid import GridScorer, sampled

log = logging.getLogger("mjx_refine")

Made = Callable[[str, tuple[Shape, ...], float], Simulator]
"""The simulator of a backend, shapes and frames a second."""


def warm_up(job: Job, count: int, common: Options, simulator: Made) -> None:
    """Runs a generation of ``count`` clips like ``job``'s, for the compilers' sake.

    What is wrong with the job is for its worker to say.
    """
    try:
        options = job.options(common)
        scene, observation = load_scenes(job.init)[0], load_observation(job.video)
        if scene.effects or options.optimizer == "gradient":
            return
        population = options.population
        count = max(1, min(count, -(-CANDIDATES // population)))
        clip = sampled(observation, [-1] * len(scene.shapes), search_resolution(options, observation.size))
        batch = batch_from_scenes([scene] * (count * population))
        with DEVICE:
            made = simulator(fastest(options.backend, len(batch), len(batch.shapes)), scene.shapes, observation.fps)
            poses = launched(made, batch, observation.length)()
            GridScorer(scene.shapes, [clip] * count).compared(poses, batch, [population] * count)
    except Exception as error:
        log.info("%s: nothing compiled beforehand (%s)", job.name, error)
