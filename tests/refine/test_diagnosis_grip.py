"""Contacts that take slip away sooner than a scene file's: the base model may have them, what is replayed may not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from own_clip import SIZE
from test_diagnosis import BALL, FLIGHT

from mjx_refine.batch import GRIP
from mjx_refine.diagnosis.answer.replay import replays
from mjx_refine.diagnosis.answer.verdict import STILL, answer
from mjx_refine.diagnosis.diagnose import prepared
from mjx_refine.diagnosis.fits.base import base_space, grip_notes, with_grips, without_grips
from mjx_refine.diagnosis.fits.fit import ClipFit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.misfit.signs import Signs
from mjx_refine.effects import batch_with_effects
from mjx_refine.observation import Observation
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.view.picture import draw

FIRM = 150.0
TURNED = dataclasses.replace(
    FLIGHT,
    objects=(dataclasses.replace(BALL, linear_velocity=(2.2, 0.3, -1.0), angular_velocity=(0.0, -9.0, 0.0)),),
)


def gripping(grip: float):
    """A ball that spins backwards hits the floor with contacts of this grip: poses and batch."""
    batch = batch_with_effects([TURNED])
    batch = dataclasses.replace(batch, grip=np.full_like(batch.grip, grip))
    return MujocoSimulator(TURNED.shapes, 30.0, 1).rollout(batch, 20), batch


def clip_of_grip(grip: float) -> Observation:
    poses, batch = gripping(grip)
    masks, flow = draw(poses[0], batch, SIZE)
    noise = np.random.default_rng(0).normal(0.0, 0.1, flow.shape)
    return Observation((flow + noise).astype(np.float32), masks, 30.0, flow_sigma=0.1, source="clip.npz")


def test_firm_contacts_take_more_slip_away_in_an_impact():
    ends = [gripping(grip)[0][0, -1, 0, 0] for grip in (GRIP, FIRM)]
    assert ends[1] < ends[0] - 0.05


def test_grips_are_coordinates_of_their_own_and_can_be_held_again():
    plain = base_space(TURNED)
    space = with_grips(plain)
    assert space.dimension == plain.dimension + 1
    u = space.start
    assert space.decode(u[None]).grip == pytest.approx(np.array([[GRIP]]))
    u[-1] = space.parameters[-1].to_unit(FIRM)
    assert space.decode(u[None]).grip == pytest.approx(np.array([[FIRM]]))
    again, stay = without_grips(space)
    assert again.parameters == plain.parameters
    assert again.decode(u[None, stay]).grip == pytest.approx(np.array([[GRIP]]))
    assert without_grips(plain)[0] is plain


def test_a_fit_finds_the_grip_and_says_so_and_a_replay_has_a_scene_files():
    observation = clip_of_grip(FIRM)
    problem, start, measured = prepared(TURNED, observation, 1)
    clip = ClipFit(problem.reference(TURNED.shapes), measured, observation.size, observation.length)
    fits = []
    for space in (base_space(start.scene), with_grips(base_space(start.scene))):
        hypothesis = Hypothesis(space)
        fits.append(clip.fit(hypothesis, np.zeros(hypothesis.dimension), 12))
    soft, firm = fits
    assert firm.evidence > soft.evidence + 20.0
    found = firm.hypothesis.batch(firm.z[None]).grip[0, 0]
    assert 70.0 < found < 300.0
    assert grip_notes(soft) == []
    (note,) = grip_notes(firm)
    assert "ball" in note
    assert f"{found:.0f} 1/s" in note
    assert "sooner" in note
    (replay,) = replays(clip, [firm], problem, start.matching)
    scores = problem.score([replay.scene], start.matching)
    assert replay.iou == pytest.approx(float(scores.iou[0]))


def test_a_background_that_moves_unexplained_is_something_missing():
    quiet = Signs(0.5, 0.2, 0.0, 0.9, 0.9, 0.8, 0.8, 0.0, 0.9)
    assert answer(quiet, [0.5], video=True).kind == "none"
    moved = dataclasses.replace(quiet, background=1.1 * STILL)
    assert answer(moved, [0.5], video=True).kind == "unknown"
    assert answer(moved, [0.5]).kind == "none"
