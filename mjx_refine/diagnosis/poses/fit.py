"""Least squares on measured poses: a clip's, with positions and rotations in the place of outlines and flow.

``Parts`` then mean: ``moments`` positions [m], ``reach`` rotation vectors from the measured to the simulated orientation,
world frame [rad]; ``flow`` and ``background`` are empty.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Bool, Float

from mjx_refine import rotations
from mjx_refine.batch import SceneBatch
from mjx_refine.diagnosis.fits.apart import Flight
from mjx_refine.diagnosis.fits.fit import SCALE, ClipFit, Fit
from mjx_refine.diagnosis.fits.pace import STEPS
from mjx_refine.diagnosis.fits.settled import Loose
from mjx_refine.diagnosis.fits.slack import Contacts, Impact, contacts
from mjx_refine.diagnosis.fits.store import fingerprint
from mjx_refine.diagnosis.poses.data import Poses, noise_of, rotation_vector
from mjx_refine.diagnosis.seen.measure import Measured, Parts
from mjx_refine.diagnosis.seen.noise import Counts, Noise
from mjx_refine.diagnosis.seen.predict import Prediction
from mjx_refine.search.residuals import slowed
from mjx_refine.sim.backends import Restarting

VIDEO = 30.0
"""Frames a second of the clips that the constants of impacts were chosen on."""

LEAST_RATE, MOST_RATE = 30.0, 45.0
"""Simulated frames a second: the measured rate, a multiple or a part of it between these where there is one. Eight steps a
frame are then about a video's, and parabolas between frames are exact in flight."""

PATIENCE = 6.0
"""Multiples of the robust loss's scale: a tracked pose is seldom wild, and a misfit of centimetres must be felt."""

LATE = 0.2 / VIDEO
"""How uncertain the moment of an impact is [s]: laboratories' floors are no engine's."""

EXCUSED = 2.0
"""As ``chaos.EXCUSED``, which was measured on videos: with that, three of five light balls that fall have no `drag` named any
more, and one of them a `hidden_obstacle`."""

UNSEEN_TURN = 3.0
"""Standard deviation of a turn that a picture would not show (of a sphere, of a cylinder about its axis), and that no
parameter holds, in noise widths of one measured rotation: the first measured pose is the start's."""


@dataclasses.dataclass(frozen=True)
class PosesMeasured(Measured):
    """Measured poses as ``Measured``, with all samples equally fresh."""

    @functools.cached_property
    def freshness(self) -> Float[np.ndarray, "times objects"]:
        """One everywhere: each sample is a new measurement."""
        return np.ones(self.present.shape)


def measured_poses(poses: Poses, columns: tuple[int, ...]) -> PosesMeasured:
    """Poses in the scene's order of objects.

    Args:
      poses: the measured ones.
      columns: for each object its index among the poses, or -1.
    """
    place, rot = noise_of(poses)
    count, objects = len(poses.time), len(columns)
    chosen, lost = [max(j, 0) for j in columns], np.array([j < 0 for j in columns])
    position = np.moveaxis(poses.position[chosen], 0, 1)
    turned = np.isfinite(poses.quaternion[chosen]).all(-1).T
    position = np.where(lost[None, :, None], np.nan, position)
    reach = np.where((turned & ~lost)[..., None], np.zeros(3), np.nan)
    return PosesMeasured(
        reach=reach,
        moments=position,
        pixels=np.zeros((count, objects, 1, 2)),
        flow=np.full((count - 1, objects, 1, 2), np.nan),
        places=np.zeros((1, 2)),
        background=np.full((count - 1, 1, 2), np.nan),
        present=np.asarray(np.isfinite(position).any(-1) | np.isfinite(reach).any(-1)),
        edge_noise=rot[chosen],
        flow_noise=np.ones(objects),
        moment_noise=place[chosen],
        background_noise=1.0,
        stated=poses.sigma_pos is not None,
    )


def rate_of(time: Float[np.ndarray, "times"]) -> float:
    """Simulated frames a second: one a median time step, or a multiple or part within ``LEAST_RATE, MOST_RATE``."""
    rate = 1.0 / float(np.median(np.diff(time)))
    return rate * np.ceil(LEAST_RATE / rate - 0.02) if rate < LEAST_RATE else rate / np.ceil(rate / MOST_RATE - 1e-3)


def at_times(
    poses: Float[np.ndarray, "batch frames objects 7"], place: Float[np.ndarray, "times"]
) -> tuple[Float[np.ndarray, "batch times objects 3"], Float[np.ndarray, "batch times objects 4"]]:
    """Positions and quaternions between simulated frames; ``place`` counts frames.

    Positions go along parabolas, which is exact in free flight; orientations by spherical interpolation.
    """
    frames = poses.shape[1]
    first = np.clip(np.floor(place + 1e-6), 0, frames - 2).astype(int)
    part = np.clip(place - first, 0.0, 1.0)[:, None, None]
    where, turn = poses[..., :3], poses[..., 3:]
    bend = np.zeros_like(where)
    if frames > 2:
        bend[:, 1:-1] = np.diff(where, 2, axis=1)
        bend[:, 0], bend[:, -1] = bend[:, 1], bend[:, -2]
    position = where[:, first] + part * (where[:, first + 1] - where[:, first])
    position -= 0.25 * part * (1.0 - part) * (bend[:, first] + bend[:, first + 1])
    step = rotation_vector(rotations.multiply(rotations.conjugate(turn[:, first]), turn[:, first + 1]))
    return position, rotations.multiply(turn[:, first], rotations.exponential(part * step))


class PosesPredictor:
    """What scenes predict of measured poses, see the module's head.

    Args:
      place: of the measured times, in simulated frames.
      quaternion: measured, in the scene's order; NaN where unknown.
    """

    def __init__(self, place: Float[np.ndarray, "times"], quaternion: Float[np.ndarray, "times objects 4"]):
        self.place, self.quaternion = place, quaternion

    def __call__(self, poses: Float[np.ndarray, "batch frames objects 7"], batch: SceneBatch) -> Prediction:
        """The prediction for ``poses`` of a simulator."""
        bad = np.logical_not(np.isfinite(poses).all((1, 2, 3)))
        poses = np.where(bad[:, None, None, None], [0.0, 0.0, -1e3, 1.0, 0.0, 0.0, 0.0], poses)
        position, turn = at_times(poses, self.place)
        off = rotation_vector(rotations.multiply(turn, rotations.conjugate(self.quaternion)))
        count, times, objects = position.shape[:3]
        flow, beside = np.zeros((count, times - 1, objects, 1, 2)), np.zeros((count, times - 1, 1, 2))
        return Prediction(off, flow, position, beside, bad, position)


class PosesFit(ClipFit):
    """Residuals and least squares for measured poses.

    Args:
      simulator: of the scene kind, at ``rate_of`` the times.
      poses: what was measured.
      columns: for each object its index among the poses, or -1.
      weight: as how many independent samples each counts.
    """

    def __init__(self, simulator: Restarting, poses: Poses, columns: tuple[int, ...], weight: float = 1.0):
        self.weight = weight
        measured = measured_poses(poses, columns)
        self.time = poses.time - poses.time[0]
        place = self.time * simulator.fps
        frames = max(int(np.ceil(place[-1] - 1e-3)) + 1, 3)
        count = len(place)
        noise = Noise(
            np.repeat(measured.edge_noise[None], count, 0),
            np.ones((count - 1, len(columns))),
            np.repeat(measured.moment_noise[None], count, 0),
            1.0,
        )
        super().__init__(simulator, measured, (1, 1), frames, noise)
        self.counts = Counts(3.0, 1.0)
        self.place = place
        chosen = poses.quaternion[[max(j, 0) for j in columns]]
        self.quaternion = np.where(np.isfinite(measured.reach[..., :1]), np.moveaxis(chosen, 0, 1), np.nan)
        self.predictor = PosesPredictor(place, self.quaternion)

    @functools.cached_property
    def facts(self) -> str:
        """A fingerprint of the recording."""
        told = (self.place, self.quaternion, self.measured.moments, self.measured.reach, self.weight)
        return fingerprint(told, self.frames, self.simulator.fps)

    def settle_noise(self, fit: Fit, order: int = 2) -> None:
        """Does nothing: the noise is stated, or comes from third differences, which owe nothing to a fit."""

    def allow_chaos(self, fit: Fit, seed: int, excused: float = EXCUSED) -> None:
        """As ``ClipFit.allow_chaos``."""
        super().allow_chaos(fit, seed, excused)

    def _loosened(self, batch: SceneBatch, poses: np.ndarray, found: list[Impact], still: Prediction, kicks) -> Loose:
        blur = functools.partial(self._blurred, self.noise, batch, found)
        return Loose(self._unseen_turns(batch, poses), kicks, blur)

    def _contacts(self, batch: SceneBatch, poses: np.ndarray, plain: np.ndarray | None) -> Contacts:
        """Impacts and times on the floor, looked for at a video's rate, which the constants were chosen at."""
        every = max(1, round(self.simulator.fps / VIDEO))
        coarse, rate = poses[::every], self.simulator.fps / every
        if len(coarse) < 3:
            return [], []
        told = contacts(batch, coarse, None if plain is None else plain[::every], rate)
        last = len(poses) - 2
        found, long = ([dataclasses.replace(i, frame=min(i.frame * every, last)) for i in part] for part in told)
        return found, long

    def _blurred(self, sharp: Noise, batch: SceneBatch, found: list[Impact], factor: float) -> Noise:
        """The noise with what the uncertain moment of impacts makes of it around them."""
        edge, moments = sharp.edge.copy(), sharp.moments.copy()
        for one in found:
            near = np.abs(self.time - one.frame / self.simulator.fps) < 2.0 / VIDEO
            size = float(batch.size[0, one.target].max())
            late = factor * LATE
            moments[near, one.target] = np.hypot(moments[near, one.target], late * one.change)
            edge[near, one.target] = np.hypot(edge[near, one.target], late * one.turn / size)
        return dataclasses.replace(sharp, edge=edge, moments=moments)

    def _unseen_turns(self, batch: SceneBatch, poses: np.ndarray) -> Parts:
        """Turns in the body's frame that the space does not hold, a row each: they turn with the body."""
        rows = []
        matrix = rotations.matrix(at_times(poses[None], self.place)[1][0])
        for n, shape in enumerate(batch.shapes):
            for axis in {"sphere": (0, 1, 2), "cylinder": (2,), "box": ()}[shape]:
                row = np.zeros((len(self.time), len(batch.shapes), 3))
                width = UNSEEN_TURN * self.measured.edge_noise[n]
                row[:, n] = np.where(np.isfinite(self.measured.reach[:, n]), width * matrix[:, n, :, axis], 0.0)
                rows.append(row)
        none = np.zeros((1, *self.measured.reach.shape))
        reach = np.array(rows) if rows else none
        return Parts(reach, *(np.zeros((len(reach), *part.shape)) for part in self.measured.parts[1:]))

    def expected(self, without: tuple[str, ...] = ()) -> float:
        """As ``ClipFit.expected``, with the samples' weight."""
        return max(self.weight * super().expected(without), 1e-9)

    def flown(self, batch: SceneBatch, keep: np.ndarray | None = None) -> Flight:
        """As ``ClipFit.flown``, to the end: samples are not frames, and the last one that is kept lies at any of these."""
        return super().flown(batch)

    def jacobian(self, hypothesis, z, keep=None, scale=SCALE, size=STEPS[0]):
        """As ``ClipFit.jacobian``, in one rollout, since every parameter moves something."""
        low, high = hypothesis.bounds
        step = np.where(z + size > high, -size, size)
        points = np.concatenate([z[None], np.clip(z + np.diag(step), low, high)])
        prediction = self.predictor(self.poses(hypothesis, points), hypothesis.batch(points))
        white = self.whitened(self.distances(prediction), keep, scale, hypothesis)
        return (np.where(prediction.bad[1:, None], 0.0, white[1:] - white[0]) / step[:, None]).T

    def distances(self, prediction: Prediction) -> Parts:
        """Simulated minus measured [rad], [m]; NaN where nothing was measured."""
        told = zip(prediction.parts, self.measured.parts, strict=True)
        return Parts(*(np.where(np.isfinite(seen), a - np.nan_to_num(seen), np.nan) for a, seen in told))

    @property
    def widths(self) -> Parts:
        """Standard deviations of each part, to be broadcast [rad], [m]."""
        return Parts(self.noise.edge[:, :, None], 1.0, self.noise.moments, 1.0)

    def rigid(
        self, distances: Parts, keep: Bool[np.ndarray, "times"] | None, scale: float = SCALE
    ) -> Float[np.ndarray, "batch residuals"]:
        """Robust residuals in noise widths; zero where nothing was measured, and in samples that are not kept."""
        raw = [np.nan_to_num(part) / width for part, width in zip(distances, self.widths, strict=True)]
        white = Parts(*(slowed(part, scale * PATIENCE) for part in raw)).flat() * np.sqrt(self.weight)
        return white if keep is None else white * self.measured.kept(keep)
