"""The camera, and where it stands over the floor, by pictures alone.

The same rollout may be seen from elsewhere: camera height, pitch and field of view do not act on it, and no more does
moving all objects together along the floor. So these few are searched without a single rollout.
"""

from __future__ import annotations

import dataclasses

import mjx_cmaes
import numpy as np
from jaxtyping import Float

from mjx_refine.sim.backends import Simulator
from mjx_refine.space import Space
from mjx_refine.view.grid import GridScorer
from mjx_refine.view.picture_scorer import PictureScorer
from mjx_refine.view.tiles import TileScorer

CAMERA = ("camera_position", "camera_pitch", "camera_fovy")

WIDTH = 0.02
"""Of the first generation [prior widths]."""

POPULATION, GENERATIONS = 16, 30


@dataclasses.dataclass(frozen=True)
class Aim:
    """Coordinates of a space that change how a rollout is seen, not the rollout.

    Attributes:
      columns: of the unit box, a row for each coordinate: the camera's numbers, then all objects together along x and y.
      low, high: how far each may go from the point.
    """

    columns: Float[np.ndarray, "coordinates dimension"]
    low: Float[np.ndarray, "coordinates"]
    high: Float[np.ndarray, "coordinates"]

    @classmethod
    def of(cls, space: Space, point: Float[np.ndarray, "dimension"]) -> Aim:
        """The coordinates around ``point``, in prior widths; where something stands in its place, the camera's alone."""
        groups = [[k] for k, p in enumerate(space.parameters) if p.field in CAMERA]
        if not space.scene.effects:
            for axis in (0, 1):
                along = [k for k, p in enumerate(space.parameters) if p.field == "position" and p.index[1] == axis]
                groups += [along] if len(along) == len(space.scene.objects) else []
        columns = np.zeros((len(groups), space.dimension))
        for row, group in zip(columns, groups, strict=True):
            # One width for all of a group: the box's sides differ, metres must not.
            spans = np.array([space.parameters[k].span for k in group])
            row[group] = space.sigma[group[0]] * spans[0] / spans
        rate = np.where(columns > 0, columns, np.inf)
        high = np.where(columns > 0, (1.0 - point) / rate, np.inf).min(1, initial=np.inf)
        low = np.where(columns > 0, -point / rate, -np.inf).max(1, initial=-np.inf)
        return cls(columns, low, high)


def aimed(
    space: Space,
    point: Float[np.ndarray, "dimension"],
    simulator: Simulator,
    scorer: TileScorer | PictureScorer | GridScorer,
    seed: int,
) -> Float[np.ndarray, "dimension"]:
    """The point after a short CMA-ES over ``Aim``; itself where nothing better is seen.

    Args:
      space: the parameters.
      point: in the unit box.
      simulator: makes the one rollout.
      scorer: of pictures.
      seed: of the draws.
    """
    aim = Aim.of(space, point)
    here = space.decode(point[None])
    poses = np.asarray(simulator.rollout(here, scorer.length))
    if not len(aim.columns) or not np.isfinite(poses).all():
        return point
    settings = mjx_cmaes.Settings(dimension=len(aim.columns), population=POPULATION)
    # CMA-ES keeps to the unit box: its middle is the point.
    state = mjx_cmaes.init(settings, np.full(len(aim.columns), 0.5), std=WIDTH, seed=seed)
    best, least = point, -float(scorer(poses, here).fitness[0])
    for _ in range(GENERATIONS):
        drawn, state = mjx_cmaes.ask(settings, state)
        steps = np.clip(np.asarray(drawn) - 0.5, aim.low, aim.high)
        points = np.clip(point + steps @ aim.columns, 0.0, 1.0)
        batch = space.decode(points)
        moved = np.repeat(poses, len(points), 0)
        moved[..., :2] += (batch.position - here.position)[:, None, :, :2]
        costs = -np.asarray(scorer(moved, batch).fitness)
        state, _ = mjx_cmaes.tell(settings, state, drawn, costs)
        first = int(np.argmin(costs))
        if costs[first] < least:
            best, least = points[first], float(costs[first])
    return best
