"""The base model's refit: what ordinary parameters explain is no gap."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Bool

from mjx_refine import rotations
from mjx_refine.batch import GRIP, batch_from_scenes
from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.store import remembered
from mjx_refine.observation import Observation
from mjx_refine.scene import Body, Scene
from mjx_refine.search.features import Outlines, flow_points, outlines
from mjx_refine.search.landing import LeastSquares
from mjx_refine.search.schedule import stages
from mjx_refine.space import Space
from mjx_refine.space.layout import logarithmic, lowest_extent
from mjx_refine.view.tiles import foreground

FLAT = {("clearance", 0), ("tilt", 0), ("tilt", 1), ("linear_velocity", 2), ("spin", 0), ("spin", 1)}
ROUND = {("clearance", 0), ("lean", 0), ("linear_velocity", 2)}
"""Fields of a body, and which of their numbers, that are held where it lies flat on the floor, and where it may roll."""

LEVEL = math.radians(1.5)
"""Slant up to which a body is thought to lie on a side or along its axis [rad]."""

TRUST = 0.2
"""Width of the prior around the given scene, in errors of a language model: the scene is thought to be refined. Its tails
are heavy (``Hypothesis.tails``), so that a rough scene may move."""

FIELD = "grip"
"""Of a space's coordinates, how soon contacts take slip away."""

GRIP_WIDTH, SOFTEST, FIRMEST = 0.7, 8.0, 300.0
"""Width of the prior of a contact's grip, in natural logarithms, and its bounds [1/s]. With all other numbers the same,
PyBullet's path after an impact was met best at 60 to 140 for a cylinder (0.31 m off after a second at 30, 0.08 at 100), and
at 30 for a box."""

NOTABLE = 2.0
"""Factor to a scene file's grip from which a note says so."""

GOOD = 2.5
"""Mean square residual below which no further start is tried."""


def base_space(scene: Scene) -> Space:
    """The parameters of the base model, with bodies that lie flat on the floor kept there.

    A body at rest on the floor has no lift, tilt, vertical speed or spin about horizontal axes; least squares would use
    them to explain other things.
    """
    space = Space.around(scene)
    fixed = [_held_on_floor(scene, i, body) for i, body in enumerate(scene.objects)]
    held = np.array([i >= 0 and (p.field, k) in fixed[i] for p in space.parameters for i, k in [p.index]], bool)
    space = space.freeze(held, space.start, "it lies on the floor") if held.any() else space
    return _scaled(space, TRUST)


def _scaled(space: Space, factor: float) -> Space:
    """The space with a prior so many times as wide; of grips, which no scene tells, it stays."""
    rows = (p if p.field == FIELD else dataclasses.replace(p, width=factor * p.width) for p in space.parameters)
    return dataclasses.replace(space, parameters=tuple(rows))


def with_grips(space: Space) -> Space:
    """The space, and how soon each object's contacts take slip away, which a scene file does not tell.

    A scene file's contacts take 1/30 s, longer than an impact lasts: what strikes the floor obliquely gets less spin than from a
    rigid contact, and a fit bends velocities, sizes and gravity to make up for it.
    """
    grips = [
        logarithmic(f"{body.name}.grip", "1/s", FIELD, (i, 0), GRIP, GRIP_WIDTH, SOFTEST, FIRMEST)
        for i, body in enumerate(space.scene.objects)
    ]
    return dataclasses.replace(space, parameters=(*space.parameters, *grips))


def without_grips(space: Space) -> tuple[Space, Bool[np.ndarray, "dimension"]]:
    """The space with contacts as every scene file has them, and which coordinates stay."""
    held = np.array([p.field == FIELD for p in space.parameters], bool)
    return (space.freeze(held, space.start, "a scene file does not tell it") if held.any() else space), ~held


def grip_notes(fit: Fit) -> list[str]:
    """Sentences about contacts that take slip away much sooner or later than a scene file's do."""
    told = []
    for name, grip in zip(fit.hypothesis.space.scene.names, fit.hypothesis.batch(fit.z[None]).grip[0], strict=True):
        if not 1 / NOTABLE < grip / GRIP < NOTABLE:
            when, change = ("sooner", "less") if grip > GRIP else ("later", "more")
            told.append(
                f"Contacts of {name} take slip away {when} than a scene file's do ({grip:.0f} 1/s for {GRIP:.0f}): in the "
                f"replayed scene oblique impacts change spin {change} than in the clip."
            )
    return told


def _held_on_floor(scene: Scene, i: int, body: Body) -> set[tuple[str, int]]:
    """What of a body is held since it lies on the floor, flat or round; nothing where it does not."""
    batch = batch_from_scenes([scene])
    gap = body.position[2] - float(lowest_extent(body.shape, batch.size[0, i], batch.quaternion[0, i]))
    if abs(gap) >= 0.01 or abs(body.linear_velocity[2]) >= 0.1:
        return set()
    up = np.abs(rotations.matrix(np.array(body.orientation))[2])
    if body.shape == "sphere" or (body.shape == "cylinder" and up[2] < math.sin(LEVEL)):
        return ROUND
    spin = rotations.rotate(np.array(body.orientation), np.array(body.angular_velocity))
    level = (up.max() if body.shape == "box" else up[2]) > math.cos(LEVEL)
    return FLAT if level and float(np.abs(spin[:2]).max()) < 0.5 else set()


def stored_base(clip: ClipFit, space: Space, observation: Observation, masks_of: tuple[int, ...]) -> Fit:
    """``fit_base``, kept whole: the landing in it keeps nothing."""
    return _kept_base(_Landed(clip, observation, masks_of), Hypothesis(space))


class _Landed:
    """A clip with what its base model's fit needs, as ``remembered`` wants it."""

    def __init__(self, clip: ClipFit, observation: Observation, masks_of: tuple[int, ...]):
        self.clip, self.observation, self.masks_of = clip, observation, masks_of
        self.store, self.state, self.pack, self.unpack = clip.store, clip.state, clip.pack, clip.unpack
        self.counted, self.count = clip.counted, clip.count


@remembered
def _kept_base(landed: _Landed, hypothesis: Hypothesis) -> Fit:
    return fit_base(landed.clip, hypothesis.space, landed.observation, landed.masks_of)


def fit_base(clip: ClipFit, space: Space, observation: Observation, masks_of: tuple[int, ...]) -> Fit:
    """The base model's fit: landed frame by frame as a refinement is, from the scene as it is given and with hops."""
    hypothesis, masks = Hypothesis(space), foreground(observation)
    seen = outlines(masks)
    columns = tuple(seen.ids.index(i) if i in seen.ids else -1 for i in masks_of)
    told = seen, columns, flow_points(masks, observation.flow, seen.ids)
    fits = clip.crew.each(clip, _from_start, [(hypothesis, hops, *told) for hops in (None, 0)])
    if not clip.misfit(min(fits, key=lambda fit: fit.cost)) < GOOD:
        fits.append(_from_start(clip, hypothesis, 2, *told))
    return min(fits, key=lambda fit: fit.cost)


def _from_start(
    clip: ClipFit, hypothesis: Hypothesis, hops: int | None, seen: Outlines, columns: tuple[int, ...], flow
) -> Fit:
    """The fit from the scene as it is given, landed with so many hops, or not at all."""
    space = hypothesis.space
    if hops is None:
        return clip.fit(hypothesis, np.zeros(space.dimension), 10)
    landing = LeastSquares(_scaled(space, 1 / TRUST), clip.rollout, seen, columns, clip.image, flow)
    point = landing.run(space.start, stages(clip.frames), hops).point
    return clip.fit(hypothesis, (point - space.start) / space.sigma, 12)
