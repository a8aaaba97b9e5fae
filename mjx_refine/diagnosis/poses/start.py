"""The base model's fit to measured poses: where they say that the motion begins, and on from there."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from mjx_refine import rotations
from mjx_refine.diagnosis.fits.base import GOOD, base_space
from mjx_refine.diagnosis.fits.fit import Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.poses.data import Poses, rotation_vector
from mjx_refine.diagnosis.poses.fit import PosesFit
from mjx_refine.scene import Body, Scene
from mjx_refine.space import Parameter, Space

BEGINNING = 0.08
"""Time from the first sample on that the start's position and velocity are taken from [s]."""

FEWEST, MOST = 4, 14
"""Samples that they are taken from, at least and at most."""

METRIC = 0.25
"""Widths of sizes against those of pictures, which do not tell metres."""

GRAVITY = (0.005, 0.02)
"""Width and bound of gravity, as parts of the scene's: a tracker's scale errs by so much. Where metres and seconds are
measured, a body that falls slower than that is held by something."""

HORIZONS = (0.15, 0.3, 0.45, 0.6, 0.8)
"""Parts of the recording that are fitted one after the other: an early bounce must be right before what follows it."""

FORGIVING = 20.0
"""Scale of the robust loss while the horizon grows [noise widths]."""


def started(scene: Scene, poses: Poses, columns: tuple[int, ...]) -> Scene:
    """The scene with the poses and velocities that the first samples have."""
    bodies = [_started(b, poses, j) if j >= 0 else b for b, j in zip(scene.objects, columns, strict=True)]
    return dataclasses.replace(scene, objects=tuple(bodies))


def _started(body: Body, poses: Poses, j: int) -> Body:
    time = poses.time - poses.time[0]
    count = int(np.clip((time <= BEGINNING).sum(), FEWEST, MOST))
    position, velocity = list(body.position), list(body.linear_velocity)
    for k in range(3):
        told = _line(time[:count], poses.position[j, :count, k], 2)
        if told is not None:
            position[k], velocity[k] = told
    turn = poses.quaternion[j, :count]
    seen = np.isfinite(turn).all(-1)
    orientation, spin = body.orientation, body.angular_velocity
    if seen.any():
        first = turn[seen][0]
        off = rotation_vector(rotations.multiply(turn, rotations.conjugate(first)))
        lines = [_line(time[:count], off[:, k], 1) for k in range(3)]
        begin, rate = (np.array([0.0 if line is None else line[i] for line in lines]) for i in range(2))
        now = rotations.normalise(rotations.multiply(rotations.exponential(begin), first))
        orientation = tuple(now.tolist())
        spin = tuple(rotations.rotate(rotations.conjugate(now), rate).tolist())
    return dataclasses.replace(
        body,
        position=tuple(position),
        linear_velocity=tuple(velocity),
        orientation=orientation,
        angular_velocity=spin,
    )


def _line(
    time: Float[np.ndarray, "samples"], values: Float[np.ndarray, "samples"], degree: int
) -> tuple[float, float] | None:
    """Value and slope at time 0 of a polynomial through the known samples; None where none are."""
    known = np.isfinite(values)
    if not known.any():
        return None
    degree = min(degree, int(known.sum()) - 1)
    told = np.polynomial.polynomial.polyfit(time[known], values[known], degree)
    return float(told[0]), float(told[1]) if degree > 0 else 0.0


def poses_space(scene: Scene) -> Space:
    """The parameters of the base model without the camera; sizes are known better than from pictures, and so is gravity."""
    space = base_space(scene)
    camera = np.array([p.field.startswith("camera") for p in space.parameters], bool)
    space = space.freeze(camera, space.start, "poses do not show the camera")
    return dataclasses.replace(space, parameters=tuple(_metric(p) for p in space.parameters))


def _metric(p: Parameter) -> Parameter:
    if p.field == "size":
        return dataclasses.replace(p, width=METRIC * p.width)
    if p.field == "gravity":
        width, part = GRAVITY
        low, high = max(p.low, p.start * (1 - part)), min(p.high, p.start * (1 + part))
        return dataclasses.replace(p, width=width, low=low, high=high)
    return p


def fit_base(clip: PosesFit, space: Space, seed: int) -> Fit:
    """Least squares from the start: of the whole at once, with a growing horizon, and with hops where that is not enough."""
    hypothesis = Hypothesis(space)
    fits = [clip.fit(hypothesis, np.zeros(space.dimension), 12)]
    if clip.misfit(fits[0]) < GOOD:
        return fits[0]
    z = np.zeros(space.dimension)
    for part in HORIZONS:
        keep = clip.time <= part * clip.time[-1]
        if keep.sum() < FEWEST:
            continue
        grown = clip.fit(hypothesis, z, 4, keep, FORGIVING)
        z = (
            clip.hop(grown, seed, 1, 48, keep, FORGIVING).z
            if 2 * grown.data > GOOD * 6 * clip.weight * keep.sum()
            else grown.z
        )
    fits.append(clip.fit(hypothesis, z, 12))
    best = min(fits, key=lambda fit: fit.cost)
    return best if clip.misfit(best) < GOOD else clip.hop(best, seed, 2)
