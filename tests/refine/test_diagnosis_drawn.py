"""Measured flow is drawn along by outlines, and bodies that roll stay on the floor."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from own_clip import SIZE
from test_diagnosis import BALL, FLIGHT

from mjx_refine.diagnosis.answer.verdict import answer
from mjx_refine.diagnosis.diagnose import prepared
from mjx_refine.diagnosis.fits.base import base_space
from mjx_refine.diagnosis.fits.fit import ClipFit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.misfit.signs import Signs
from mjx_refine.diagnosis.seen.drawn_along import SHOWS, WHOLE, WITHIN, against, drawn_along, uncertain
from mjx_refine.effects import batch_with_effects
from mjx_refine.observation import Observation
from mjx_refine.scene import Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.view.picture import draw

SPEED = 1.1
ROLLING = dataclasses.replace(
    FLIGHT,
    objects=(
        dataclasses.replace(
            BALL,
            position=(*BALL.position[:2], BALL.size[0]),
            linear_velocity=(SPEED, 0.1, 0.0),
            angular_velocity=(-0.1 / BALL.size[0], SPEED / BALL.size[0], 0.0),
            friction=(0.6, 0.002),
        ),
    ),
)


def clip_of(scene: Scene, shows: float, sigma) -> Observation:
    """A clip whose flow shows this part of the surface's motion against the mask's centroid."""
    batch = batch_with_effects([scene])
    poses = MujocoSimulator(scene.shapes, 30.0, 1).rollout(batch, 16)
    masks, flow = draw(poses[0], batch, SIZE)
    rows, columns = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    centres = np.array([[columns[m > 0].mean(), rows[m > 0].mean()] for m in masks])
    for t, step in enumerate(np.diff(centres, axis=0)):
        here = masks[t] > 0
        flow[t][here] = step + shows * (flow[t][here] - step)
    noise = np.random.default_rng(0).normal(0.0, 0.1, flow.shape)
    return Observation((flow + noise).astype(np.float32), masks, 30.0, flow_sigma=sigma, source="clip.npz")


def fitted(observation: Observation):
    problem, start, measured = prepared(ROLLING, observation, 1)
    clip = ClipFit(problem.reference(ROLLING.shapes), measured, observation.size, observation.length)
    hypothesis = Hypothesis(base_space(start.scene))
    return clip, clip.fit(hypothesis, np.zeros(hypothesis.dimension), 12)


def test_only_what_moves_against_the_outline_is_drawn_along():
    moments = np.cumsum(np.tile([3.0, -1.0, 0.0], (1, 4, 1, 1)), axis=1)
    flow = np.tile([3.0, -1.0], (1, 3, 1, 5, 1))
    assert drawn_along(flow, moments) == pytest.approx(flow)
    turning = flow + np.linspace(-1.0, 2.0, 5)[:, None]
    assert against(turning, moments) == pytest.approx(turning - flow)
    assert drawn_along(turning, moments) == pytest.approx(flow + SHOWS * (turning - flow))
    moments[:, 1] = np.nan
    lost = against(turning, moments)
    assert lost[:, :2].mean(-2) == pytest.approx(np.zeros((1, 2, 1, 2)))
    assert lost[:, 2] == pytest.approx((turning - flow)[:, 2])


def test_how_far_it_is_drawn_is_not_known_for_each_object_by_itself():
    observation = clip_of(ROLLING, SHOWS, None)
    clip, fit = fitted(observation)
    told = clip.predictor(clip.poses(fit.hypothesis, fit.z[None]), fit.hypothesis.batch(fit.z[None]))
    rows = uncertain(clip.measured, told.flow, told.whole)
    assert len(rows.flow) == len(WHOLE) + len(WITHIN)
    assert not rows.reach.any()
    assert not rows.moments.any()
    seen = np.isfinite(clip.measured.flow)
    moved = against(told.flow, told.moments)[0] / SHOWS
    assert rows.flow[0] + rows.flow[2] == pytest.approx(np.where(seen, WHOLE[0] * moved, 0.0))
    assert rows.flow[1][-1] == pytest.approx(rows.flow[0][-1] * WHOLE[1] / WHOLE[0])
    assert rows.flow[1][0] == pytest.approx(-rows.flow[0][0] * WHOLE[1] / WHOLE[0])


def test_a_ball_that_rolls_keeps_its_friction_though_its_flow_is_drawn_along():
    drawn = clip_of(ROLLING, SHOWS, None)
    clip, fit = fitted(drawn)
    assert clip.predictor.drawn
    assert clip.misfit(fit) < 1.2
    assert fit.hypothesis.batch(fit.z[None]).friction[0, 0, 0] == pytest.approx(0.6, rel=0.3)
    held_to_all, whole = fitted(dataclasses.replace(drawn, flow_sigma=0.1))
    assert not held_to_all.predictor.drawn
    assert held_to_all.misfit(whole) > 2 * clip.misfit(fit)


@pytest.mark.parametrize(("sigma", "drawn"), [(None, True), (0.1, False), (np.full((15, *SIZE[::-1]), 0.1), True)])
def test_noise_by_pixel_is_a_measurements(sigma, drawn):
    assert prepared(ROLLING, clip_of(ROLLING, 1.0, sigma), 1)[2].drawn is drawn


def test_bodies_that_roll_are_held_on_the_floor():
    held = set(base_space(FLIGHT).names) - set(base_space(ROLLING).names)
    assert held == {"ball.clearance", "ball.velocity.z"}
    dropped = dataclasses.replace(ROLLING.objects[0], linear_velocity=(SPEED, 0.1, -0.4))
    assert "ball.velocity.z" in base_space(dataclasses.replace(ROLLING, objects=(dropped,))).names


def test_a_cylinder_on_its_side_is_held_and_a_slanting_one_is_not():
    def names(slant: float) -> set[str]:
        turn = 0.5 * (np.pi / 2 - slant)
        height = 0.2 * np.cos(slant) + 0.25 * abs(np.sin(slant))
        cylinder = dataclasses.replace(
            ROLLING.objects[0],
            shape="cylinder",
            name="roller",
            size=(0.2, 0.5),
            position=(0.0, 0.0, height),
            orientation=(float(np.cos(turn)), float(np.sin(turn)), 0.0, 0.0),
            linear_velocity=(SPEED, 0.0, 0.0),
            angular_velocity=(0.0, 0.0, 0.0),
        )
        return set(base_space(dataclasses.replace(ROLLING, objects=(cylinder,))).names)

    assert names(0.2) - names(0.0) == {"roller.clearance", "roller.tilt", "roller.velocity.z"}


def test_less_of_a_lead_is_asked_for_where_flow_was_measured():
    told = Signs(
        lead=50.0, margin=30.0, pair=0.0, before=1.2, after=0.9, structure_before=2.0, structure_after=0.6,
        held_out=20.0, whole=1.2, closed=0.6,
    )  # fmt: skip
    assert answer(told, [50.0], video=True).kind == "none"
    assert answer(dataclasses.replace(told, drawn=1.0), [50.0], video=True).kind == "single"
    assert answer(dataclasses.replace(told, drawn=1.0, lead=40.0), [40.0], video=True).kind == "none"
