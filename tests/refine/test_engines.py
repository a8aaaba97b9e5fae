"""What simulates which part of a refinement, on whatever device there is."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("warp")

from benchmarks.speed_scenes import KINDS, near
from mjx_refine import refine
from mjx_refine.effects import batch_with_effects
from mjx_refine.scene import Effect
from mjx_refine.search import Options, engines, run
from mjx_refine.sim import backends
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.fused.simulator import FusedSimulator
from mjx_refine.simulate import simulate
from mjx_refine.view.at_once import reach_and_flow
from mjx_refine.view.seen import seen_reach_and_flow

SPHERE = KINDS["sphere"]


@pytest.fixture
def gpu(monkeypatch):
    """As if the device were a GPU: sizes of the batches that the kernel was asked for."""
    asked: list[int] = []

    class Counted(FusedSimulator):
        def __init__(self, shapes, fps):
            super().__init__(shapes, fps, any_device=True)

        def rollout(self, batch, frames):
            asked.append(len(batch))
            return super().rollout(batch, frames)

    monkeypatch.setattr(backends, "resolve_backend", lambda name: "warp" if name == "auto" else name)
    monkeypatch.setattr(backends, "cores", lambda: 4)
    monkeypatch.setattr(engines, "make_simulator", lambda name, shapes, fps, quick: Counted(shapes, fps))
    return asked


def test_jacobians_are_simulated_where_that_is_faster(gpu):
    reference = MujocoSimulator(SPHERE.shapes, 30.0, 1)
    problem = SimpleNamespace(
        options=Options(), observation=SimpleNamespace(fps=30.0), reference=lambda shapes: reference
    )
    made = engines.Engines(problem)  # type: ignore[arg-type]
    batch = batch_with_effects([near(SPHERE, k) for k in range(3)])
    few, many = made.rollout(SPHERE, 8)(batch, 10), made.rollout(SPHERE, 9)(batch, 10)
    assert gpu == [3]
    np.testing.assert_array_equal(few, reference.rollout(batch, 10))
    np.testing.assert_allclose(many[..., :3], few[..., :3], atol=1e-4)
    # What the kernel does not carry is C MuJoCo's.
    windy = dataclasses.replace(SPHERE, effects=(Effect("wind", None, (("pressure", (1.0, 0.0)),)),))
    made.rollout(windy, 100)(batch, 10)
    crowd = dataclasses.replace(SPHERE, objects=SPHERE.objects * 9)
    assert made.rollout(crowd, 20) == reference.rollout
    assert gpu == [3]


@pytest.mark.parametrize("rows", [3, 70])
def test_outlines_and_flow_at_once_are_those_one_after_the_other(rows):
    scene = KINDS["four mixed"]
    batch = batch_with_effects([near(scene, k) for k in range(rows)])
    poses = MujocoSimulator(scene.shapes, 30.0, 1).rollout(batch, 6)
    pixels = np.random.default_rng(0).uniform(40, 200, (6, 4, 5, 2))
    reach, flow = reach_and_flow(poses, batch, pixels, (240, 160), 16)
    apart, moved = seen_reach_and_flow(poses, batch, pixels, (240, 160), 16, 30.0)
    np.testing.assert_allclose(reach, apart, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(flow, moved, rtol=1e-4, atol=1e-3)


def test_a_refinement_whose_least_squares_are_the_kernels(gpu, monkeypatch):
    monkeypatch.setattr(run, "fastest", lambda *_: "mujoco")  # the search is another test's
    video = simulate(SPHERE, size=(240, 160), frames=15)
    result = refine(near(SPHERE, 1), video, Options(population=8, iterations=40, refits=1))
    assert len(gpu) > 10
    # Scored by C MuJoCo: the kernel's optimum is its own.
    assert result.history[-1].iou > 0.97
