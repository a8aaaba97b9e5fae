"""What a rollout and its view depend on, and how it moves with each coordinate of the unit box."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from mjx_refine.batch import SceneBatch
from mjx_refine.sim.model import initial_state, model_fields
from mjx_refine.space import Space

if TYPE_CHECKING:
    from mjx_refine.sim.leaves import Leaves

STEP = 1e-6
"""Step in the unit box. The decoder is closed form in double precision: its differences are exact to about 1e-9."""

KINK = 1e-3
"""Slopes to the left and to the right that differ by more than this part of the larger are a kink."""


class Inputs(NamedTuple):
    """Everything that a rollout and its view depend on, for one candidate with N objects (a batch: a leading axis);
    arrays of numpy or of JAX.

    Attributes:
      leaves: the model's fields.
      qpos: initial positions [m] and quaternions wxyz, (7N,).
      qvel: initial velocities [m/s, rad/s], (6N,).
      size: MuJoCo's ``geom_size`` [m], (N, 3).
      camera_position: [m], (3,).
      camera_pitch: [rad].
      camera_fovy: [rad].
    """

    leaves: Leaves
    qpos: Any
    qvel: Any
    size: Any
    camera_position: Any
    camera_pitch: Any
    camera_fovy: Any


def inputs_of(batch: SceneBatch) -> Inputs:
    """The inputs of every candidate, in double precision, with a leading batch axis."""
    # It imports MJX, which takes its time.
    from mjx_refine.sim.leaves import Leaves

    fields = model_fields(batch)
    leaves = Leaves(*(getattr(fields, field.name) for field in dataclasses.fields(fields)))
    camera = (batch.camera_position, batch.camera_pitch, batch.camera_fovy)
    return Inputs(leaves, *initial_state(batch), batch.size, *camera)


def stencil(
    point: Float[np.ndarray, "dimension"], steps: Float[np.ndarray, "dimension"]
) -> tuple[Float[np.ndarray, "dimension 2 dimension"], Float[np.ndarray, "dimension 3"]]:
    """Points and weights of second-order differences that stay inside the unit box.

    Central where there is room on both sides, otherwise (-3 f(u) + 4 f(u + h) - f(u + 2h)) / 2h, towards the inside.

    Returns:
      two points a coordinate, and the weights of f(u) and of f at these.
    """
    points = np.repeat(np.repeat(point[None, None], len(point), 0), 2, 1)
    weights = np.zeros((len(point), 3))
    for j, h in enumerate(steps):
        room = (point[j] >= h, point[j] <= 1.0 - h)
        if all(room):
            moves, weights[j] = (h, -h), (0.0, 0.5 / h, -0.5 / h)
        else:
            h = h if room[1] else -h
            moves, weights[j] = (h, 2 * h), (-1.5 / h, 2.0 / h, -0.5 / h)
        points[j, :, j] += moves
    return points, weights


def tangents(space: Space, point: Float[np.ndarray, "dimension"]) -> tuple[Inputs, Inputs]:
    """The inputs at a point of the unit box, and their derivatives in each coordinate (leading axis ``dimension``).

    A lowest height that moves with the size, or with the turn, is in here: an object that touches the floor at the start
    keeps touching it along the tangent.

    Raises:
      ValueError: the point has the wrong shape, is not finite, or lies outside of the box.
    """
    point = np.clip(np.asarray(point, np.float64), 0.0, 1.0) if _inside(point) else np.asarray(point)
    points, weights = stencil(point, np.full(len(point), STEP))
    batch = space.decode(np.concatenate([point[None], points.reshape(-1, len(point))]))
    everything = inputs_of(batch)

    def slope(array: np.ndarray) -> np.ndarray:
        base, moved = array[0], array[1:].reshape(len(point), 2, *array.shape[1:])
        change = moved - base
        # Weights sum to zero: differences from f(u) first, so that what does not move has a slope of exactly zero.
        return np.einsum("dk,dk...->d...", weights[:, 1:], change)

    return jax.tree.map(lambda array: array[0], everything), jax.tree.map(slope, everything)


def _inside(point: np.ndarray) -> bool:
    # The space allows for rounding at the bounds; the stencil must not leave them.
    return bool(np.all(np.abs(np.asarray(point) - 0.5) <= 0.5 + 1e-9))


def kinked(space: Space, point: Float[np.ndarray, "dimension"]) -> Bool[np.ndarray, "dimension"]:
    """Coordinates in which the scene itself has no derivative at ``point``: the slopes to both sides differ.

    A box that lies flat rises whichever way it is tilted.
    """
    point = np.clip(np.asarray(point, np.float64), 0.0, 1.0)
    points, weights = stencil(point, np.full(len(point), STEP))
    batch = space.decode(np.concatenate([point[None], points.reshape(-1, len(point))]))
    result = np.zeros(len(point), bool)
    central = weights[:, 0] == 0.0
    fields = model_fields(batch)
    arrays = [getattr(fields, field.name) for field in dataclasses.fields(fields)]
    arrays += [*initial_state(batch), batch.camera_position, batch.camera_pitch, batch.camera_fovy]
    for array in arrays:
        change = array[1:].reshape(len(point), 2, -1) - array[0].reshape(-1)
        # Against the largest change in the array: a part that only curves changes by the step squared.
        scale = np.abs(change).max((1, 2), initial=0.0) + 1e-6 * STEP
        result |= central & (np.abs(change.sum(1)).max(1, initial=0.0) > KINK * scale)
    return result
