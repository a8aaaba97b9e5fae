"""Least squares over jags: which differences tell derivatives, and where they lead."""

from types import SimpleNamespace

import numpy as np
import pytest

from mjx_refine.diagnosis.fits import pace
from mjx_refine.diagnosis.fits.pace import OWN, STEPS, Differences, Effort, descended
from mjx_refine.diagnosis.joint.differences import JointDifferences

SLOPES = np.random.default_rng(0).normal(size=(40, 3)) * [30.0, 10.0, 3.0]
BOUNDS = np.full(3, -5.0), np.full(3, 5.0)
TRUE = np.array([0.3, -0.4, 0.6])


def jags(z, jagged, size=0.4):
    """What jumps each time one of the numbers passes a multiple of 1e-4, by another amount each time, of standard deviation
    ``size``."""
    cells = np.floor(z[..., jagged] * 1e4).astype(int)
    rows = [np.random.default_rng(np.abs(cell) + 7).normal(size=len(SLOPES)) for cell in cells.reshape(-1, len(jagged))]
    return size * np.reshape(rows, (*z.shape[:-1], len(SLOPES)))


def differences_of(jagged, curved=0.0):
    """Of residuals that are linear in three numbers but for a curvature, and jump with some of these."""

    def residuals(points):
        flat = (points - TRUE) @ SLOPES.T
        rows = flat + curved * flat * np.abs(flat) + (jags(points, jagged) if jagged else 0.0)
        return rows, 0.5 * (rows**2).sum(1) + 0.5 * (points**2).sum(1)

    def jacobian(z, size):
        step = np.broadcast_to(size, z.shape)
        moved, _ = residuals(z + np.diag(step))
        return ((moved - residuals(z[None])[0]) / np.where(step, step, 1.0)[:, None]).T

    return Differences(residuals, jacobian, BOUNDS)


def prior(z):
    return z, np.ones(len(z))


def test_without_jags_the_smallest_differences_are_the_surest():
    """What is smooth, and bends, is told by the smallest ones, bit for bit."""
    differences = differences_of([], curved=0.02)
    z = np.zeros(3)
    told = differences.surest(z, differences.residuals(z[None])[0][0])
    np.testing.assert_array_equal(told, differences.of(z, np.zeros(40), STEPS[0]))
    assert differences.tried(True) == STEPS


def test_a_number_with_jags_is_told_by_longer_differences_and_the_others_are_not():
    """A jump of 0.4 over a difference of 0.002 is 200, and slopes are 3 to 30."""
    differences = differences_of([1])
    z = np.zeros(3)
    told = differences.surest(z, differences.residuals(z[None])[0][0])
    fine = differences.of(z, np.zeros(40), STEPS[0])
    np.testing.assert_array_equal(told[:, [0, 2]], fine[:, [0, 2]])
    assert np.linalg.norm(fine[:, 1]) > 10 * np.linalg.norm(SLOPES[:, 1])
    assert np.linalg.norm(told[:, 1] - SLOPES[:, 1]) < 0.5 * np.linalg.norm(SLOPES[:, 1])
    assert differences.tried(False) == (OWN, STEPS[0])


def asked_of(differences):
    """The sizes that are asked for from now on."""
    inner, sizes = differences._jacobian, []
    differences._jacobian = lambda z, size: sizes.append(np.broadcast_to(size, z.shape).tolist()) or inner(z, size)
    return sizes


def test_the_longest_differences_are_made_of_the_numbers_with_jags_alone():
    differences, z = differences_of([1]), np.zeros(3)
    asked = asked_of(differences)
    differences.surest(z, differences.residuals(z[None])[0][0])
    assert asked == [[STEPS[0]] * 3, [STEPS[1]] * 3, [0.0, STEPS[2], 0.0]]


def test_where_no_longer_difference_tells_a_jag_none_still_longer_is_made():
    differences, z = differences_of([]), np.zeros(3)
    asked = asked_of(differences)
    differences.surest(z, differences.residuals(z[None])[0][0], doubted=True)
    assert asked == [[STEPS[0]] * 3, [STEPS[1]] * 3]


def test_the_posterior_is_not_made_narrower_by_jags():
    """Its volume with jags is that without, within a tenth of a standard deviation in each number or so."""
    z = np.zeros(3)

    def volume(told):
        return 0.5 * np.linalg.slogdet(told.T @ told + np.eye(3))[1]

    jagged = differences_of([0, 1, 2])
    base = jagged.residuals(z[None])[0][0]
    wrong = volume(jagged.of(z, base, STEPS[0]))
    assert volume(jagged.surest(z, base)) == pytest.approx(volume(SLOPES), abs=0.6)
    assert wrong > volume(SLOPES) + 5


def test_jags_that_one_longer_step_does_not_show_are_told_where_they_are_doubted(monkeypatch):
    z, differences = np.zeros(3), differences_of([0, 1, 2])
    monkeypatch.setattr(pace, "tells_jags", lambda told, change: False)
    base = differences.residuals(z[None])[0][0]
    plain, doubted = differences.surest(z, base), differences.surest(z, base, doubted=True)
    assert np.linalg.norm(plain - SLOPES) > 10 * np.linalg.norm(doubted - SLOPES)


def test_least_squares_cross_the_jags():
    """From a start four prior widths off least squares end at the truth, as far as jags let them."""
    ended = descended(np.array([4.0, 4.0, -4.0]), differences_of([0, 1, 2]), prior, Effort(12))
    assert np.abs(ended.z - TRUE).max() < 0.2
    assert ended.ended


def test_least_squares_go_on_from_where_they_were_interrupted_over_jags_too():
    """The rough derivatives that an interrupted fit ends with do not hide which differences are needed."""
    differences = differences_of([0, 1, 2])
    stopped = descended(np.array([4.0, 4.0, -4.0]), differences, prior, Effort(12, attempts=1))
    assert not stopped.ended
    ended = descended(stopped, differences_of([0, 1, 2]), prior, Effort(12))
    assert np.abs(ended.z - TRUE).max() < 0.2


def test_where_only_the_place_counts_no_derivatives_are_made_there():
    start, made = np.array([4.0, 4.0, -4.0]), []
    for passing in (False, True):
        differences = differences_of([0, 1, 2])
        inner, calls = differences._jacobian, []
        differences._jacobian = lambda z, size, inner=inner, calls=calls: calls.append(size) or inner(z, size)
        made.append((descended(start, differences, prior, Effort(2, passing=passing)), len(calls)))
    (whole, many), (passing, few) = made
    assert np.array_equal(whole.z, passing.z)
    assert whole.cost == passing.cost
    assert whole.ended
    assert not passing.ended
    assert few < many


# --- several clips ----------------------------------------------------------------------------------------------------


def joint_differences_of(*jagged):
    """Of clips that share two numbers and have one each of their own; of each: which of its numbers have jags."""
    clips = [differences_of(list(which)) for which in jagged]
    index = [np.array([0, 1, 2 + c]) for c in range(len(clips))]
    asked = []

    def split(z):
        return [z[..., own] for own in index]

    def residuals(points):
        told = [clip.residuals(own) for clip, own in zip(clips, split(points), strict=True)]
        return [rows for rows, _ in told], sum(costs for _, costs in told)

    def jacobians(z, base, sizes):
        asked.append(list(sizes))
        rows = zip(clips, split(z), sizes, strict=True)
        return [None if size is None else clip._jacobian(own, size) for clip, own, size in rows]

    bounds = np.full(2 + len(clips), -5.0), np.full(2 + len(clips), 5.0)
    return JointDifferences(SimpleNamespace(split=split, bounds=bounds), residuals, jacobians), asked


def test_a_clip_with_jags_is_told_by_longer_differences_and_the_others_cost_nothing_more():
    """A shared number may jump in one clip and be smooth in another."""
    differences, asked = joint_differences_of([1], [])
    z = np.zeros(4)
    base = [rows[0] for rows in differences.residuals(z[None])[0]]
    jagged, smooth = differences.surest(z, base)
    assert [sizes[1] for sizes in asked] == [STEPS[0], None, None]
    assert np.linalg.norm(jagged[:, 1] - SLOPES[:, 1]) < 0.5 * np.linalg.norm(SLOPES[:, 1])
    np.testing.assert_allclose(smooth, SLOPES, atol=1e-9)
    again = differences.of(z, base, OWN)
    np.testing.assert_array_equal(again[0], jagged)
    assert differences.tried() == (OWN, *STEPS)


def test_clips_without_jags_are_told_by_the_smallest_differences():
    differences, asked = joint_differences_of([], [])
    base = [rows[0] for rows in differences.residuals(np.zeros((1, 4)))[0]]
    differences.surest(np.zeros(4), base)
    assert asked == [[STEPS[0], STEPS[0]]]
    assert differences.tried() == STEPS
