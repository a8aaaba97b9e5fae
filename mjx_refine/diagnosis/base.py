"""The base model's refit: what ordinary parameters explain is no gap."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Bool

from mjx_refine import rotations
from mjx_refine.batch import GRIP, batch_from_scenes
from mjx_refine.diagnosis.fit import ClipFit, Fit
from mjx_refine.diagnosis.hypothesis import Hypothesis
from mjx_refine.diagnosis.store import remembered
from mjx_refine.observation import Observation
from mjx_refine.scene import Body, Scene
from mjx_refine.search.features import flow_points, outlines
from mjx_refine.search.landing import LeastSquares
from mjx_refine.search.schedule import stages
from mjx_refine.space import Space
from mjx_refine.space.layout import logarithmic, lowest_extent
from mjx_refine.view.tiles import foreground

RESTING = ("clearance", "tilt")

TRUST = 0.2
"""Width of the prior around the given scene, in errors of a language model: the scene is thought to be refined. Its tails
are heavy (``Hypothesis.tails``), so that a rough scene may move."""

GRIP_WIDTH, SOFTEST, FIRMEST = 0.7, 8.0, 300.0
"""Width of the prior of a contact's grip, in natural logarithms, and its bounds [1/s]."""

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
    flat = [_lies_flat(scene, i, body) for i, body in enumerate(scene.objects)]
    held = np.array(
        [
            p.index[0] >= 0
            and flat[p.index[0]]
            and (
                p.field in RESTING
                or (p.field == "linear_velocity" and p.index[1] == 2)
                or (p.field == "spin" and p.index[1] < 2)
            )
            for p in space.parameters
        ],
        bool,
    )
    space = space.freeze(held, space.start, "it lies on the floor") if held.any() else space
    return dataclasses.replace(
        space, parameters=tuple(dataclasses.replace(p, width=TRUST * p.width) for p in space.parameters)
    )


def with_grips(space: Space) -> Space:
    """The space, and how soon each object's contacts take slip away, which a scene file does not tell.

    A scene file's contacts take 1/30 s, longer than an impact lasts: what strikes the floor obliquely gets less spin than from a
    rigid contact, and a fit bends velocities, sizes and gravity to make up for it.
    """
    grips = [
        logarithmic(f"{body.name}.grip", "1/s", "grip", (i, 0), GRIP, GRIP_WIDTH, SOFTEST, FIRMEST)
        for i, body in enumerate(space.scene.objects)
    ]
    return dataclasses.replace(space, parameters=(*space.parameters, *grips))


def without_grips(space: Space) -> tuple[Space, Bool[np.ndarray, "dimension"]]:
    """The space with contacts as every scene file has them, and which coordinates stay."""
    held = np.array([p.field == "grip" for p in space.parameters], bool)
    return (space.freeze(held, space.start, "a scene file does not tell it") if held.any() else space), ~held


def grip_notes(fit: Fit) -> list[str]:
    """Sentences about contacts that take slip away much sooner or later than a scene file's do."""
    space = fit.hypothesis.space
    told = []
    for k, p in enumerate(space.parameters):
        if p.field == "grip":
            unit = np.clip(space.start[k] + fit.z[k] * space.sigma[k], 0.0, 1.0)
            value, name = float(p.from_unit(unit)), p.name.removesuffix(".grip")
            if not 1 / NOTABLE < value / GRIP < NOTABLE:
                how = "sooner" if value > GRIP else "later"
                told.append(
                    f"Contacts of {name} take slip away {how} than a scene file's do ({value:.0f} 1/s for {GRIP:.0f}): in the "
                    f"replayed scene oblique impacts change spin {'less' if value > GRIP else 'more'} than in the clip."
                )
    return told


def _lies_flat(scene: Scene, i: int, body: Body) -> bool:
    if body.shape == "sphere":
        return False
    batch = batch_from_scenes([scene])
    gap = body.position[2] - float(lowest_extent(body.shape, batch.size[0, i], batch.quaternion[0, i]))
    up = np.abs(rotations.matrix(np.array(body.orientation))[2])
    level = (up.max() if body.shape == "box" else up[2]) > math.cos(math.radians(1.5))
    spin = rotations.rotate(np.array(body.orientation), np.array(body.angular_velocity))
    return level and abs(gap) < 0.01 and abs(body.linear_velocity[2]) < 0.1 and float(np.abs(spin[:2]).max()) < 0.5


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
    hypothesis = Hypothesis(space)
    masks = foreground(observation)
    seen = outlines(masks)
    columns = tuple(seen.ids.index(i) if i in seen.ids else -1 for i in masks_of)
    flow = flow_points(masks, observation.flow, seen.ids)
    fits: list[Fit] = [clip.fit(hypothesis, np.zeros(space.dimension), 10)]
    rough = [p if p.field == "grip" else dataclasses.replace(p, width=p.width / TRUST) for p in space.parameters]
    wide = dataclasses.replace(space, parameters=tuple(rough))
    for hops in (0, 2):
        landing = LeastSquares(wide, clip.rollout, seen, columns, observation.size, flow)
        point = landing.run(space.start, stages(observation.length), hops).point
        fits.append(clip.fit(hypothesis, (point - space.start) / space.sigma, 12))
        if clip.misfit(min(fits, key=lambda fit: fit.cost)) < GOOD:
            break
    return min(fits, key=lambda fit: fit.cost)
