"""The best refit of a scene without effects to a clip with them, in the exam's own engine and without noise."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from benchmarks.clips.camera import Camera
from benchmarks.withheld import masks, solids
from benchmarks.withheld.base import CAMERA, WORLD, Base
from benchmarks.withheld.effect import Effect, named
from benchmarks.withheld.film import OUTLINE, Film
from benchmarks.withheld.physics import Engine
from benchmarks.withheld.stage import EXTRA, FRAMES, MOVING, SIZE, Stage
from benchmarks.withheld.track import Track
from benchmarks.withheld.view import FPS, View, view_of

EDGE, FLOW = 0.3, 0.3
"""Measurement noise of an outline's reach and of the flow on an object, px."""

EDGE_COUNT, FLOW_COUNT = 6.0, 3.0
"""As how many independent numbers an object's outline and its flow (each axis) count in a frame; neighbours err together."""

NEAR = np.array([[0, 0, 1.0], [0.7, 0, 0.7], [-0.7, 0, 0.7], [0, 0.7, 0.7], [0, -0.7, 0.7]])
"""Where on an object its flow is taken: on a ball of 0.8 times its mean size, in the camera's axes (towards it, right,
left, up, down)."""

EVALUATIONS = 12  # of one least-squares fit


@dataclass(frozen=True)
class Seen:
    """What a viewer sees of the objects.

    Fields:
      reach: how far each object's outline reaches in 16 directions, px (see `Film.outlines`).
      flow: motion of five points of each object's near side to the next frame, px.
    """

    reach: Float[np.ndarray, "frames objects 16"]
    flow: Float[np.ndarray, "intervals objects 5 2"]


@dataclass(frozen=True)
class Fit:
    """A refit's end.

    Fields:
      shifts: of the base's numbers, in widths. cost: sum of squares, in noise widths, prior included.
      reach, flow: what is left, px: the largest distance between outlines, and between flows.
    """

    shifts: Float[np.ndarray, "numbers"]
    cost: float
    reach: float
    flow: float


@dataclass(frozen=True)
class Leg:
    """One least-squares fit of a way: frames that are fitted, by how much the noise is raised, the differences' step."""

    frames: int = FRAMES
    blur: float = 1.0
    step: float = 0.005


def reaches(film: Film) -> Float[np.ndarray, "frames objects 16"]:
    """`Film.outlines`, all frames at once; equal to a rounding error."""
    view, out = film.view, []
    if view.readout:
        return film.outlines
    for i, solid in enumerate(film.solids):
        place, turn, size = film.track.at(view.times, i)
        world = place[:, None] + (size[:, None, None] * solid.points) @ turn.transpose(0, 2, 1)
        local = (world - view.origin[:, None]) @ view.turn
        out.append((_bent(view, local) @ OUTLINE.T).max(1))
    return np.stack(out, 1)


def _bent(view: View, local: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """Points in the camera's frame [m] to image coordinates [px]."""
    plain = local[..., :2] / -local[..., 2:] * [1.0, -1.0]
    return view.middle + view.focal * plain * (1 + view.k1 * (plain**2).sum(-1, keepdims=True))


def flows(film: Film, radii: Float[np.ndarray, "objects"]) -> Float[np.ndarray, "intervals objects 5 2"]:
    """Motion of points of each object's near side, `radii` [m] from its centre, from each frame to the next, px."""
    view, out = film.view, []
    for i, radius in enumerate(radii):
        times = view.times
        if view.readout:
            centre = np.array([view.show(film.track, i, np.zeros((1, 3)), k)[0, 1] for k in range(film.frames)])
            times = times + view.readout * (centre / view.height - 0.5)
        place, turn, _ = film.track.at(times, i)
        arms = np.einsum("fij,nj->fni", view.turn, 0.8 * radius * NEAR)
        here = _bent(view, (place[:, None] + arms - view.origin[:, None]) @ view.turn)
        carried = arms[:-1] @ turn[:-1] @ turn[1:].transpose(0, 2, 1)
        there = _bent(view, (place[1:, None] + carried - view.origin[1:, None]) @ view.turn[1:])
        out.append(there - here[:-1])
    return np.stack(out, 1)


def seen(
    film: Film, effects: tuple[Effect, ...], radii: Float[np.ndarray, "objects"], hidden: np.ndarray | float
) -> Seen:
    """What is seen of a film.

    Args:
      film: with all effects but those of the masks. effects: those at work. radii: of the objects, m.
      hidden: by how much an occluder shortens the reaches, px.
    """
    bias = named(effects, "mask_bias")
    width = bias.parameters["width"] if bias else 0.0
    return Seen(reaches(film) + width - hidden, flows(film, radii))


class Refit:
    """Fits a scene with some of the effects, or none, to what is seen of it with all of them.

    Args:
      engine: that made the clip. stage: the scene without effects. effects: those at work.
      known: those that the model has too, as they truly are.
    """

    def __init__(self, engine: Engine, stage: Stage, effects: tuple[Effect, ...], known: tuple[Effect, ...] = ()):
        self.engine, self.stage, self.known = engine, stage, known
        self.radii = np.array([float(np.cbrt(np.prod(solids.half_extents(e)))) for e in stage.objects])
        film = stage.film(effects)
        blind = named(effects, "occluder")
        hidden = masks.bites(film, blind) if blind else 0.0
        self.hidden = hidden if named(known, "occluder") else 0.0
        self.target = seen(film, effects, self.radii, hidden)
        self.groups = _groups(film.track.touched | stage.track.touched)
        together = {i for group in self.groups if len(group) > 1 for i in group}
        self.base = Base(stage.entries, tuple(sorted(together)))
        self.owners = np.array([number.owner for number in self.base.numbers])
        self._kept: tuple[bytes, Track] | None = None

    def film(self, shifts: Float[np.ndarray, "numbers"]) -> Film:
        """The model's film; the motion is kept while only the camera changes."""
        entries = self.base.at(shifts)
        view = view_of(Camera.of(entries, *SIZE), self.known, FRAMES)
        moving = np.where(self.owners == CAMERA, 0.0, shifts).tobytes()
        if self._kept is None or self._kept[0] != moving:
            extra = EXTRA if named(self.known, "dropped_frames") else 0
            seconds, still = (FRAMES - 1 + extra) / FPS + 0.01, not any(e.name in MOVING for e in self.known)
            track = self.engine.poses(entries, seconds) if still else self.engine.run(entries, self.known, seconds)
            self._kept = moving, track
        form = named(self.known, "shape")
        scene = Stage(entries, self.stage.kind).objects
        drawn = [solids.of(entry) for entry in scene]
        if form is not None and form.target is not None:
            how = form.hidden
            drawn[form.target] = solids.another(scene[form.target], how["form"], how["strength"], np.array(how["lean"]))
        return Film(self._kept[1], view, tuple(drawn))

    @contextlib.contextmanager
    def partly(self, part: float) -> Iterator[None]:
        """Inside, what is fitted lies this part of the way from what is seen without the unknown effects to what is seen."""
        whole, plain = self.target, self.seen(np.zeros(len(self.base.numbers)))
        self.target = Seen(*(a + part * (b - a) for a, b in ((plain.reach, whole.reach), (plain.flow, whole.flow))))
        try:
            yield
        finally:
            self.target = whole

    def seen(self, shifts: Float[np.ndarray, "numbers"]) -> Seen:
        """What is seen of the model."""
        return seen(self.film(shifts), self.known, self.radii, self.hidden)

    def misfit(self, shifts: Float[np.ndarray, "numbers"], leg: Leg) -> Float[np.ndarray, "objects m"]:
        """Differences in noise widths, an object a row."""
        found = self.seen(shifts)
        edge = (
            (found.reach - self.target.reach)[: leg.frames]
            * np.sqrt(EDGE_COUNT / found.reach.shape[-1])
            / (EDGE * leg.blur)
        )
        flow = (found.flow - self.target.flow)[: leg.frames - 1] * np.sqrt(FLOW_COUNT / len(NEAR)) / (FLOW * leg.blur)
        count = len(self.radii)
        rows = [np.moveaxis(part, 1, 0).reshape(count, -1) for part in (edge, flow)]
        return np.clip(np.nan_to_num(np.concatenate(rows, 1), nan=1e4), -1e4, 1e4)

    def slopes(self, shifts: Float[np.ndarray, "numbers"], leg: Leg) -> Float[np.ndarray, "objects m numbers"]:
        """Derivatives of `misfit`; objects that never meet are moved at once, each number by itself."""
        here = self.misfit(shifts, leg)
        out = np.zeros((*here.shape, len(shifts)))
        for columns, group in self._batches():
            moved = shifts.copy()
            moved[columns] += leg.step
            change = (self.misfit(moved, leg) - here) / leg.step
            for column, members in zip(columns, group, strict=True):
                out[members, :, column] = change[members]
        return out

    def _batches(self) -> list[tuple[list[int], list[list[int]]]]:
        everyone = list(range(len(self.radii)))
        alone = [([k], [everyone]) for k in np.nonzero((self.owners == WORLD) | (self.owners == CAMERA))[0].tolist()]
        queues = [(np.nonzero(np.isin(self.owners, group))[0].tolist(), group) for group in self.groups]
        longest = max(len(queue) for queue, _ in queues)
        rounds = [[(q[k], group) for q, group in queues if k < len(q)] for k in range(longest)]
        return [([k for k, _ in one], [group for _, group in one]) for one in rounds] + alone

    def descend(self, start: Float[np.ndarray, "numbers"], leg: Leg) -> Float[np.ndarray, "numbers"]:
        """Least squares with the prior from a start."""

        def value(x: np.ndarray) -> np.ndarray:
            return np.concatenate([self.misfit(x, leg).ravel(), x])

        def slope(x: np.ndarray) -> np.ndarray:
            return np.concatenate([self.slopes(x, leg).reshape(-1, len(x)), np.eye(len(x))])

        return least_squares(value, start, slope, max_nfev=EVALUATIONS, ftol=1e-3, xtol=1e-4, gtol=1e-6).x  # type: ignore[arg-type]

    def ended(self, shifts: Float[np.ndarray, "numbers"]) -> Fit:
        """A point with what is left there."""
        found = self.seen(shifts)
        cost = float((self.misfit(shifts, Leg()) ** 2).sum() + (shifts**2).sum())
        reach = float(np.abs(found.reach - self.target.reach).max())
        return Fit(shifts, cost, reach, float(np.linalg.norm(found.flow - self.target.flow, axis=-1).max()))


def _groups(touched: Bool[np.ndarray, "objects objects"]) -> list[list[int]]:
    """Objects that meet, directly or by others, together."""
    reach = touched | np.eye(len(touched), dtype=bool)
    for _ in touched:
        reach = reach @ reach
    return [np.nonzero(row)[0].tolist() for i, row in enumerate(reach) if int(row.argmax()) == i]


COARSE, FINE = 0.05, 0.001  # steps, in widths: contacts make the misfit jagged, and no one step suits every clip
DIRECT = (Leg(step=COARSE),)
ANNEALED = (Leg(blur=10.0, step=COARSE), Leg(blur=3.0, step=COARSE), Leg())
GROWING = (Leg(10, 3.0), Leg(20, 3.0), Leg())
PARTS, CARRIED = (0.33, 0.67, 1.0), (Leg(step=0.02), Leg())  # of the effect, one after the other; steps of each
DRAWS = 4  # starts from the prior
HOPS = (0.5, 0.15)  # starts beside the best end so far, so many widths off
IDLE, WORTH = 3, 0.9  # so many hops in a row that end no lower than this part of the lowest cost end the search
NOTHING = 0.5  # px: with less left, no further start is tried


def best(refit: Refit, rng: np.random.Generator, enough: float = 0.0, draws: int = DRAWS) -> tuple[Fit, list[float]]:
    """The lowest of several fits, and all their costs in order.

    The starts: the truth at once; the truth, carried along while the effect grows; the truth with raised noise; the truth with
    more and more frames; draws of the prior with raised noise; points beside the best end so far, as long as they lead
    lower. Between them the best end is refined by other steps.

    Args:
      refit: what is fitted. rng: of the draws. enough: an end with less left of the outlines [px] ends the search, too.
      draws: how many starts from the prior.
    """
    zero = np.zeros(len(refit.base.numbers))
    ends: list[Fit] = []

    def along(start: Float[np.ndarray, "numbers"], legs: tuple[Leg, ...]) -> bool:
        for leg in legs:
            start = refit.descend(start, leg)
        ends.append(refit.ended(start))
        return least(ends).reach < max(NOTHING, enough)

    def from_best(hop: float, step: float) -> bool:
        return along(least(ends).shifts + rng.normal(0, hop, len(zero)), (Leg(step=step),))

    def carried() -> bool:
        start = zero
        for part in PARTS:
            with refit.partly(part):
                start = refit.descend(start, CARRIED[0])
        return along(start, CARRIED[1:])

    done = along(zero, DIRECT) or carried() or from_best(0, FINE) or along(zero, ANNEALED) or along(zero, GROWING)
    for _ in range(draws):
        done = done or along(rng.normal(size=len(zero)), ANNEALED)
    done = done or from_best(0, FINE)
    idle = 0
    for hop in itertools.cycle(HOPS):
        if done or idle == IDLE:
            break
        lowest = least(ends).cost
        done = from_best(hop, Leg().step)
        idle = 0 if least(ends).cost < WORTH * lowest else idle + 1
    if not done:
        from_best(0, FINE)
    return least(ends), [round(end.cost, 1) for end in ends]


def least(ends: list[Fit]) -> Fit:
    """The one of least cost."""
    return min(ends, key=lambda end: end.cost)
