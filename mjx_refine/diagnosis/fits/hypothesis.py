"""A hypothesis: the base model's parameters and the effects at work, as one vector with a standard normal prior."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_refine.batch import BatchEffect, SceneBatch, scene_from_batch
from mjx_refine.diagnosis.fits.nodes import COORDINATES, Node
from mjx_refine.effects import EffectKind, acting_kind, effect_entry
from mjx_refine.effects.acting import on_the_floor
from mjx_refine.scene import Effect, Scene
from mjx_refine.space import Space

TAIL = 6.0
"""Prior widths beyond which moving a base parameter costs ever less: half its price is TAIL^2 log(1 + (z / TAIL)^2). Nearer
tails let size, camera and velocity bend until they imitate an effect."""

CONTACTS, CONTACT_TAIL, ROLLING_TAIL = ("friction", "resistance", "grip"), 2.0, 5.0
"""Fields that mean something else in every engine, and on every real floor, and their tail; that of rolling friction is farther
off: with numbers 19 and 29 widths off two cylinders that met obstacles (seed 18, 039 and 043) were stopped by the floor."""


FARTHEST = 60.0
"""Bounds of nodes' coordinates, in their units."""

BEGIN = ("position", "clearance", "yaw", "tilt", "lean", "linear_velocity", "spin")
"""Fields that tell how an object begins."""

WHOLE = -1
"""The stretch of a coordinate that changes all of a path."""

SMALL = 1e-4
"""Prior widths by which coordinates are moved to see what that does to an effect's numbers."""


@dataclasses.dataclass(frozen=True)
class Term:
    """One effect in a hypothesis, with the prior of its numbers.

    Attributes:
      name: of its kind.
      target: index of the object, or -1.
      centre: prior mean.
      width: prior standard deviation.
      low: lower bounds.
      high: upper bounds.
      free: which numbers are fitted; the others stay at ``centre``.
      places: how many places or moments were looked through for this one; its logarithm is paid as evidence.
      excused: what the impact that the effect makes may err by, one standard deviation a column [noise widths]; None: nothing.
      pivot: an outline along which its coordinates turn what is turned; ``centre``, ``width`` and bounds are of these.
    """

    name: str
    target: int
    centre: Float[np.ndarray, "parameters"]
    width: Float[np.ndarray, "parameters"]
    low: Float[np.ndarray, "parameters"]
    high: Float[np.ndarray, "parameters"]
    free: Bool[np.ndarray, "parameters"]
    places: int = 1
    excused: Float[np.ndarray, "residuals columns"] | None = None
    pivot: Float[np.ndarray, "points 2"] | None = None

    @property
    def kind(self) -> EffectKind:
        return acting_kind(self.name)

    def values(self, z: Float[np.ndarray, "batch free"]) -> Float[np.ndarray, "batch parameters"]:
        """The effect's numbers at free coordinates in prior widths."""
        told = np.repeat(self.centre[None], len(z), 0)
        free = self.free
        told[:, free] = np.clip(self.centre[free] + z * self.width[free], self.low[free], self.high[free])
        return self._own(told)

    def slope(self, z: Float[np.ndarray, "free"]) -> Float[np.ndarray, "free parameters"]:
        """Change of the effect's numbers with each free coordinate, in prior widths."""
        steps = np.zeros((len(z) + 1, len(self.centre)))
        steps[:, self.free] = z + np.concatenate([np.zeros((1, len(z))), SMALL * np.eye(len(z))])
        told = self._own(self.centre + steps * self.width)
        return (told[1:] - told[0]) / SMALL

    def _own(self, coordinates: np.ndarray) -> np.ndarray:
        return coordinates if self.pivot is None else self.kind.from_pivot(coordinates, self.pivot)

    @property
    def bounds(self) -> tuple[Float[np.ndarray, "free"], Float[np.ndarray, "free"]]:
        """Lower and upper bounds of the free coordinates."""
        low, high = (((bound - self.centre) / self.width)[self.free] for bound in (self.low, self.high))
        return low, high

    def at(self, values: Float[np.ndarray, "batch parameters"]) -> Float[np.ndarray, "batch free"]:
        """The free coordinates in prior widths at which the effect's numbers are these."""
        told = values if self.pivot is None else self.kind.to_pivot(values, self.pivot)
        return ((told - self.centre) / self.width)[:, self.free]


def term(name: str, target: int, frames: int, start: np.ndarray | None = None, **changes) -> Term:
    """A term around its kind's prior, or around ``start`` where that is given."""
    kind = acting_kind(name)
    rows = kind.spread(frames)
    centre = np.array([p.centre for p in rows]) if start is None else np.asarray(start, np.float64)
    one = Term(
        name,
        target,
        centre,
        np.array([p.width for p in rows]),
        np.array([p.low for p in rows]),
        np.array([p.high for p in rows]),
        np.array([not p.whole for p in rows]),
    )
    return dataclasses.replace(one, **changes)


@dataclasses.dataclass(frozen=True)
class Hypothesis:
    """Base parameters and terms; the vector z is their distance from the prior's mean in prior widths.

    Attributes:
      space: the base model's parameters.
      terms: the effects at work.
      slack: what contacts along a path of this hypothesis may err by, one standard deviation a column [noise widths]; None:
        what the clip's may.
      nodes: where objects go on from states of their own, which are ordinary numbers too, after the base model's.
    """

    space: Space
    terms: tuple[Term, ...] = ()
    slack: Float[np.ndarray, "residuals columns"] | None = None
    nodes: tuple[Node, ...] = ()

    @property
    def dimension(self) -> int:
        return self.ground + sum(int(t.free.sum()) for t in self.terms)

    @property
    def ground(self) -> int:
        """How many coordinates are ordinary: those of the base model and of nodes, which come before the effects'."""
        return self.space.dimension + COORDINATES * len(self.nodes)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of z."""
        far = np.full(COORDINATES * len(self.nodes), FARTHEST)
        lows = [-self.space.start / self.space.sigma, -far]
        highs = [(1.0 - self.space.start) / self.space.sigma, far]
        for t in self.terms:
            low, high = t.bounds
            lows.append(low)
            highs.append(high)
        return np.concatenate(lows), np.concatenate(highs)

    @property
    def ordinary(self) -> Bool[np.ndarray, "dimension"]:
        """Which coordinates are the base model's."""
        return np.arange(self.dimension) < self.ground

    @property
    def loose(self) -> Bool[np.ndarray, "dimension"]:
        """Which coordinates are of nodes, which no prior holds."""
        place = np.arange(self.dimension)
        return (place >= self.space.dimension) & (place < self.ground)

    @property
    def rigid(self) -> Hypothesis:
        """The hypothesis with the clip's own contacts, and impacts with unseen things that do not err."""
        terms = tuple(dataclasses.replace(t, excused=None) for t in self.terms)
        return dataclasses.replace(self, slack=None, terms=terms)

    @functools.cached_property
    def excused(self) -> Float[np.ndarray, "residuals columns"] | None:
        """What the terms' impacts may err by, or None."""
        columns = [t.excused for t in self.terms if t.excused is not None]
        return (columns[0] if len(columns) == 1 else np.concatenate(columns, 1)) if columns else None

    @functools.cached_property
    def tails(self) -> Float[np.ndarray, "dimension"]:
        """Prior widths beyond which moving each coordinate costs ever less; infinite for effects, whose prior is normal."""
        contact = (CONTACT_TAIL, ROLLING_TAIL)
        told = [contact[p.index[1]] if p.field in CONTACTS else TAIL for p in self.space.parameters]
        return np.concatenate([told, np.full(self.dimension - len(told), np.inf)])

    @property
    def moves(self) -> Bool[np.ndarray, "dimension"]:
        """Which coordinates change the rollout, and not just how it is seen."""
        parts = [np.array([not p.field.startswith("camera") for p in self.space.parameters], bool)]
        parts.append(np.ones(COORDINATES * len(self.nodes), bool))
        for t in self.terms:
            acts = t.kind.physical or t.kind.retimes
            parts.append(np.full(int(t.free.sum()), acts))
        return np.concatenate(parts)

    @property
    def owners(self) -> Int[np.ndarray, "dimension"]:
        """The object that each coordinate is of, -1 where it is of none alone."""
        told = [p.index[0] for p in self.space.parameters] + [n.target for n in self.nodes for _ in range(COORDINATES)]
        return np.array(told + [t.target for t in self.terms for _ in range(int(t.free.sum()))], int)

    @functools.cached_property
    def stretches(self) -> Int[np.ndarray, "dimension"]:
        """Which stretch of its object's path each coordinate changes alone: 0 until the first node, 1 until the next, ...;
        ``WHOLE``: all of it."""
        told = [0 if p.field in BEGIN else WHOLE for p in self.space.parameters]
        for node in self.nodes:
            before = sum(n.target == node.target and n.frame <= node.frame for n in self.nodes)
            told += [before] * COORDINATES
        return np.array(told + [WHOLE] * (self.dimension - len(told)), int)

    def frames_of(self, target: int, stretch: int, frames: int) -> tuple[int, int]:
        """The first frame of a stretch of an object's path, and the first of the next one, or how many there are."""
        ends = [0, *sorted(n.frame for n in self.nodes if n.target == target), frames]
        return (0, frames) if stretch == WHOLE else (ends[stretch], ends[stretch + 1])

    @property
    def price(self) -> float:
        """What places and moments that were looked through, and what paths may miss, cost in evidence."""
        return sum(float(np.log(t.places)) for t in self.terms) + sum(n.price for n in self.nodes)

    @property
    def strikes(self) -> bool:
        """Whether an effect makes impacts."""
        return any(t.kind.strikes for t in self.terms)

    @property
    def couples(self) -> bool:
        """Whether an effect acts on one object by another's motion."""
        return any(t.kind.couples for t in self.terms)

    def values(self, z: Float[np.ndarray, "batch dimension"], k: int) -> Float[np.ndarray, "batch parameters"]:
        """The numbers of term ``k``."""
        start = self.ground + sum(int(t.free.sum()) for t in self.terms[:k])
        t = self.terms[k]
        return t.values(z[:, start : start + int(t.free.sum())])

    def batch(self, z: Float[np.ndarray, "batch dimension"]) -> SceneBatch:
        """The candidates at ``z``."""
        effects = tuple(BatchEffect(t.name, t.target, self.values(z, k)) for k, t in enumerate(self.terms))
        return self.batch_with(z, effects)

    def batch_with(self, z: Float[np.ndarray, "batch dimension"], effects: tuple[BatchEffect, ...]) -> SceneBatch:
        """The candidates at ``z`` with other effects than the terms'; a tilted floor carries its objects along."""
        u = np.clip(self.space.start + z[:, : self.space.dimension] * self.space.sigma, 0.0, 1.0)
        batch = on_the_floor(dataclasses.replace(self.space.decode(u), effects=effects))
        if not self.nodes:
            return batch
        own = np.split(z[:, self.space.dimension : self.ground], len(self.nodes), 1)
        return dataclasses.replace(
            batch, restarts=tuple(n.restart(part) for n, part in zip(self.nodes, own, strict=True))
        )

    def scene(self, z: Float[np.ndarray, "dimension"], frames: int) -> Scene:
        """The scene at ``z``, with its effects as entries."""
        batch = self.batch(z[None])
        names = self.space.scene.names
        entries: list[Effect] = []
        for k, t in enumerate(self.terms):
            target = names[t.target] if t.target >= 0 else None
            entries.append(effect_entry(t.kind, target, self.values(z[None], k)[0], frames))
        return dataclasses.replace(scene_from_batch(batch, 0, self.space.scene), effects=tuple(entries))

    def added(self, extra: Term) -> Hypothesis:
        """The hypothesis with one more effect."""
        return dataclasses.replace(self, terms=(*self.terms, extra))
