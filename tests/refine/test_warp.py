"""MJX-Warp's own engine on whatever device there is: against C MuJoCo, and our kernel against the engine's."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from benchmarks.speed_scenes import KINDS, near
from mjx_refine.sim.buckets import FINE, SPARE
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.warp import KEPT, WarpSimulator
from mjx_refine.space import Space


def candidates(kind: str, count: int):
    """A few candidates about a rough guess."""
    space = Space.around(near(KINDS[kind], 1))
    steps = 0.3 * space.sigma * np.random.default_rng(0).normal(size=(count, space.dimension))
    return space.decode(np.clip(space.start + steps, 0, 1))


def made(kind: str) -> WarpSimulator:
    return WarpSimulator(KINDS[kind].shapes, 30.0, 20, 20, any_device=True)


@pytest.mark.parametrize("kind", KINDS)
def test_rollouts_are_those_of_c_mujoco_before_contacts_make_them_chaotic(kind):
    batch = candidates(kind, 4)
    own, reference = made(kind).rollout(batch, 6), MujocoSimulator(batch.shapes, 30.0, 1).rollout(batch, 6)
    assert np.abs(own - reference)[..., :3].max() < 5e-3
    np.testing.assert_allclose(own[:, 0], reference[:, 0], atol=1e-6)


def test_a_rollout_does_not_depend_on_the_one_before():
    """A world that diverged leaves nothing behind."""
    simulator, batch = made("box+cylinder"), candidates("box+cylinder", 4)
    before = simulator.rollout(batch, 6)
    wild = batch.map(np.copy)
    wild.linear_velocity[:] = np.nan
    assert np.isnan(simulator.rollout(wild, 6)).any()
    np.testing.assert_allclose(simulator.rollout(batch, 6), before, atol=1e-4)


def test_rollouts_that_overlap_in_time_do_not_mix():
    simulator, batch = made("sphere"), candidates("sphere", 8)
    alone = [simulator.rollout(batch[half], 5) for half in (slice(0, 4), slice(4, 8))]
    waiting = [simulator.launch(batch[half], 5) for half in (slice(0, 4), slice(4, 8))]
    for poses, expected in zip([wait() for wait in waiting], alone, strict=True):
        np.testing.assert_allclose(poses, expected, atol=1e-6)
    assert [worlds.busy for worlds in simulator._worlds] == [False, False]


def test_worlds_are_few_and_little_larger_than_asked_for():
    simulator = made("sphere")
    for count in (1, 4, 16, 32, 64, 128):
        simulator.rollout(candidates("sphere", count), 2)
    assert len(simulator._worlds) == KEPT
    assert simulator._room(3 * FINE - 5, 2) == 3 * FINE
    assert simulator._room(int(128 / SPARE) + 1, 2) == 128


def test_cone_curvature_is_the_engines(monkeypatch):
    """The Hessian of every step of a scene of four objects, by both kernels."""
    import warp as wp

    from mjx_refine.sim import cones, worlds

    monkeypatch.setattr(worlds, "fast_cones", contextlib.nullcontext)
    launch, found = wp.launch, []

    def both(kernel, *args, **rest):
        if kernel is not cones._solver._update_gradient_JTCJ_dense:
            return launch(kernel, *args, **rest)
        (hessian,) = rest["outputs"]
        before = hessian.numpy().copy()
        launch(cones.cone_curvature, *args, **rest)
        ours = hessian.numpy() - before
        hessian.assign(before)
        launch(kernel, *args, **rest)
        theirs = hessian.numpy() - before
        found.append((np.abs(theirs).max(), np.abs(ours - theirs).max()))
        return None

    monkeypatch.setattr(wp, "launch", both)
    made("four mixed").rollout(candidates("four mixed", 4), 10)
    largest, worst = np.array(found).max(0)
    assert largest > 1.0
    assert worst < 1e-6 * largest


def test_the_kernel_that_ours_stands_for_is_put_back():
    from mjx_refine.sim import cones

    own = cones._solver._update_gradient_JTCJ_dense
    with cones.fast_cones():
        assert cones._solver._update_gradient_JTCJ_dense is cones.cone_curvature
    assert cones._solver._update_gradient_JTCJ_dense is own
