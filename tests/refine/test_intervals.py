"""Intervals of parameters: they hold the truth on clips of our own, and say what a clip cannot tell."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from own_clip import FLIGHT, SIZE, OwnClip, perturbed

from mjx_refine import Options, refine
from mjx_refine.observation import Observation
from mjx_refine.search.features import flow_points
from mjx_refine.search.intervals import intervals
from mjx_refine.search.schedule import stages
from mjx_refine.space import Space

FRAMES = 16


class Clip(OwnClip):
    """A clip of ``FLIGHT`` with noise, and least squares on it from a start beside the truth."""

    def __init__(self, seed: int, noise: float = 0.5):
        super().__init__(FLIGHT, FRAMES)
        generator = np.random.default_rng(seed)
        self.flow = self.flow + noise * generator.standard_normal(self.flow.shape)
        self.start = perturbed(FLIGHT, seed)
        self.fit = self.squares(self.start, flow=flow_points(self.masks, self.flow, self.seen.ids))
        self.space = self.fit.space

    def truth(self) -> np.ndarray:
        true = {p.name: p.start for p in Space.around(FLIGHT).parameters}
        return np.array([p.to_unit(true[p.name]) for p in self.space.parameters])


@pytest.fixture(scope="module")
def known():
    """Intervals on six noisy clips, from points near the truth."""
    result = []
    for seed in range(6):
        clip = Clip(seed)
        near = clip.truth() + 0.05 * clip.space.sigma * np.random.default_rng(seed + 50).standard_normal(
            clip.space.dimension
        )
        result.append((clip, intervals(clip.fit, np.clip(near, 0, 1), 4, seed)))
    return result


def test_intervals_hold_the_truth(known):
    inside = [(told.low <= clip.truth()) & (clip.truth() <= told.high) for clip, told in known]
    determined = np.array([told.determined for _, told in known])
    assert np.array(inside)[determined].mean() > 0.8
    assert determined.sum() > 6 * 3


def test_what_a_flight_does_not_show_is_not_determined(known):
    for clip, told in known:
        row = dict(zip(clip.space.names, range(clip.space.dimension), strict=True))
        for name in ("ball.friction.sliding", "ball.friction.rolling", "ball.damping"):
            assert not told.determined[row[name]]
            assert told.standard_error[row[name]] > 0.9
        for name in ("ball.spin.x", "ball.spin.y", "ball.spin.z", "ball.velocity.y"):
            assert told.determined[row[name]]
        widest = dict(told.free[0].weights)
        assert {"camera.height", "ball.radius", "gravity"} <= set(widest)  # the overall scale
        assert len({np.sign(widest[name]) for name in ("camera.height", "ball.radius", "gravity")}) == 1
        assert (told.standard_error <= 1.0).all()


def test_more_noise_gives_wider_intervals():
    errors = []
    for noise in (0.3, 3.0):
        clip = Clip(3, noise)
        told = intervals(clip.fit, clip.truth(), 3, 0)
        assert told.motion[0] == pytest.approx(noise * 480 / SIZE[0], rel=0.25)
        spin = [name.startswith("ball.spin") for name in clip.space.names]
        errors.append(told.standard_error[spin])
    assert (errors[1] > 3 * errors[0]).all()


def test_the_same_seed_gives_the_same_intervals():
    one, two = (intervals(clip.fit, clip.truth(), 2, 5) for clip in (Clip(1), Clip(1)))
    np.testing.assert_array_equal(one.low, two.low)
    np.testing.assert_array_equal(one.covariance, two.covariance)
    assert one.free == two.free


def test_no_point_is_simulated_twice_by_itself(monkeypatch):
    clip, asked = Clip(1), []
    simulated = clip.fit.distances

    def distances(points, frames):
        asked.extend(point.tobytes() for point in points if len(points) == 1)
        return simulated(points, frames)

    monkeypatch.setattr(clip.fit, "distances", distances)
    intervals(clip.fit, clip.space.start, 2, 0)
    assert asked
    assert len(set(asked)) == len(asked)


def test_an_unseen_object_determines_nothing():
    clip = Clip(2)
    clip.fit.target[:] = np.nan
    clip.fit.flow[:] = np.nan
    told = intervals(clip.fit, clip.space.start, 2, 0)
    assert not told.determined.any()
    np.testing.assert_allclose(told.standard_error, 1.0, rtol=0.05)


def test_results_carry_intervals_around_their_values():
    clip = Clip(4)
    observation = Observation(clip.flow.astype(np.float32), clip.masks, 30.0)
    options = Options(population=8, iterations=60, threads=1, refits=3, starts=1)
    result = refine(clip.start, observation, options)
    assert result.known is not None
    for row in result.parameters:
        assert row.low <= row.after <= row.high
        assert row.determined == (row.note == "")
    without = refine(clip.start, observation, dataclasses.replace(options, refits=0))
    assert without.known is None
    assert all(row.low is None for row in without.parameters)
    assert result.refined.scores.fitness[0] >= without.refined.scores.fitness[0] - 1e-9


def test_what_is_not_fitted_widens_errors():
    clip = Clip(5)
    truth = clip.truth()
    fitted = intervals(clip.fit, truth, 2, 0)
    np.testing.assert_array_equal(fitted.misfit, [1.0])
    # Outlines of another motion, which no throw of this ball explains: up and down, ten times a second.
    clip.fit.target += np.where(np.arange(FRAMES) % 3 == 0, 6.0, -3.0)[:, None, None]
    lost = intervals(clip.fit, truth, 2, 0)
    assert lost.misfit[0] > 3
    assert (lost.standard_error[fitted.determined] > 1.5 * fitted.standard_error[fitted.determined]).all()
    assert lost.determined.sum() < fitted.determined.sum()


def test_looking_ahead_changes_no_number_and_asks_less_often():
    told = []
    for foresees in (False, True):
        # Without flow: its last bits depend on the size of a batch.
        clip = Clip(3)
        squares, calls = clip.squares(clip.start, foresees=foresees), []
        squares.rollout = lambda batch, frames, r=clip.rollout, c=calls: c.append(len(batch)) or r(batch, frames)
        point = squares.run(clip.space.start, stages(FRAMES), hops=1).point
        told.append((intervals(squares, point, 2, 0), squares.evaluations, len(calls)))
    (plain, spent, often), (ahead, same, seldom) = told
    assert seldom < 0.65 * often
    assert same == spent
    for field in dataclasses.fields(plain):
        np.testing.assert_array_equal(getattr(plain, field.name), getattr(ahead, field.name))
