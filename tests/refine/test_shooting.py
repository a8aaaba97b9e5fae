"""Objects that go on from states of their own after impacts."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_diagnosis import clip_of
from test_diagnosis_replay import started

from mjx_refine.batch import Restart, concatenate
from mjx_refine.diagnosis.fits.base import base_space
from mjx_refine.diagnosis.fits.candidates import Candidate
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, term
from mjx_refine.diagnosis.fits.nodes import COORDINATES, LEAST_LEFT, missing, with_struck
from mjx_refine.diagnosis.fits.slack import Impact
from mjx_refine.diagnosis.search.shooting import base_with_nodes, found_before, with_nodes, with_nodes_of
from mjx_refine.diagnosis.search.tempered import tempered
from mjx_refine.effects.acting import batch_with_effects
from mjx_refine.scene import Body, Camera, Effect, Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.carried import refuse_loads
from mjx_refine.sim.recalled import Memory, Recalling

FRAMES, CAMERA = 24, Camera((0.0, -3.0, 1.6), 65.0, 45.0)
BOUNCE = Scene(
    (
        Body("sphere", "ball", (0.2,), (-0.8, 0.3, 0.7), linear_velocity=(1.6, 0.3, -1.0), damping=-12.0),
        Body(
            "box",
            "crate",
            (0.1, 0.15, 0.12),
            (0.9, 0.5, 0.9),
            linear_velocity=(0.2, 0.1, 0.5),
            angular_velocity=(1, 2, 0),
        ),
    ),
    CAMERA,
    (0.0, 0.0, -9.81),
)
BALL = dataclasses.replace(BOUNCE, objects=BOUNCE.objects[:1])
EFFECTS = {
    "none": (),
    "drag": (Effect("drag", "ball", (("linear", 0.3), ("quadratic", 0.1))),),
    "push": (Effect("push", "ball", (("time", 0.55), ("x", 0.5), ("y", 0.2), ("z", 0.3))),),
    "slope": (Effect("slope", None, (("x", 5.0), ("y", -4.0))),),
    "dropped_frames": (Effect("dropped_frames", None, (("frame", 6), ("count", 2))),),
    "offset_com": (Effect("offset_com", "crate", (("x", 0.02), ("y", 0.0), ("z", 0.01))),),
}


def batch_of(name: str):
    return batch_with_effects([dataclasses.replace(BOUNCE, effects=EFFECTS[name])])


def from_there(batch, simulator: MujocoSimulator, frame: int, target: int):
    """The batch with a restart of ``target`` where, and as, it is anyway."""
    nowhere = Restart(frame, target, np.tile([0.0, 0, 5, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0], (len(batch), 1)))
    _, arrived = simulator.shot(dataclasses.replace(batch, restarts=(nowhere,)), FRAMES)
    return dataclasses.replace(batch, restarts=(dataclasses.replace(nowhere, state=arrived[:, 0]),))


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("target", [0, 1])
def test_what_restarts_as_it_is_goes_on_as_it_would(name, target):
    batch, simulator = batch_of(name), MujocoSimulator(BOUNCE.shapes, 30.0, 1)
    again = from_there(batch, simulator, 14, target)
    poses, arrived = simulator.shot(again, FRAMES)
    assert np.abs(arrived[:, 0] - again.restarts[0].state).max() < 1e-6
    assert np.abs(poses - simulator.rollout(batch, FRAMES)).max() < 2e-3
    assert np.abs(poses[:, 14, target, :3] - arrived[:, 0, :3]).max() < 1e-9


def test_what_restarts_elsewhere_is_there_and_others_go_on():
    batch, simulator = batch_of("none"), MujocoSimulator(BOUNCE.shapes, 30.0, 1)
    place = np.array([[0.0, 1.0, 2.0, 0.5, 0.5, 0.5, 0.5, 1.0, -1.0, 0.5, 0.0, 0.0, 3.0]])
    moved = dataclasses.replace(batch, restarts=(Restart(10, 0, place), Restart(99, 1, place)))
    poses, arrived = simulator.shot(moved, FRAMES)
    plain = simulator.rollout(batch, FRAMES)
    assert np.array_equal(poses[:, :10], plain[:, :10])
    assert np.abs(poses[0, 10, 0] - place[0, :7]).max() < 1e-12
    time = (np.arange(10, FRAMES) - 10) / 30.0
    free = place[0, 2] + place[0, 9] * time - 0.5 * 9.81 * time**2
    assert np.abs(poses[0, 10:, 0, 2] - free).max() < 0.02
    assert np.abs(poses[0, :, 1] - plain[0, :, 1]).max() < 1e-3
    assert np.isnan(arrived[:, 1]).all()
    assert np.abs(arrived[0, 0, :3] - plain[0, 10, 0, :3]).max() < 1e-9


def test_restarts_are_mapped_joined_and_remembered():
    batch = from_there(batch_of("drag"), MujocoSimulator(BOUNCE.shapes, 30.0, 1), 9, 0)
    both = concatenate([batch, batch])
    assert both.restarts[0].state.shape == (2, 13)
    assert both[:1].restarts[0].state.shape == (1, 13)
    with pytest.raises(ValueError, match="restarts"):
        concatenate([batch, dataclasses.replace(batch, restarts=())])
    recalling = Recalling(MujocoSimulator(BOUNCE.shapes, 30.0, 1), Memory())
    first, again = recalling.shot(both, FRAMES), recalling.shot(both, FRAMES)
    assert recalling.recalled == 1
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert np.array_equal(recalling.rollout(both, FRAMES), first[0])
    elsewhere = dataclasses.replace(both.restarts[0], state=both.restarts[0].state + 0.1)
    other = recalling.shot(dataclasses.replace(both, restarts=(elsewhere,)), FRAMES)
    assert np.abs(other[0] - first[0]).max() > 0.05


def test_other_backends_refuse_restarts():
    with pytest.raises(ValueError, match="restarts no objects"):
        refuse_loads(from_there(batch_of("none"), MujocoSimulator(BOUNCE.shapes, 30.0, 1), 9, 0), "warp")


@pytest.fixture(scope="module")
def bounced():
    """Residuals of a ball that bounces with a quarter more of spin and speed than an engine says, and its base model's fit."""
    struck = Effect("push", "ball", (("time", 0.31), ("x", 0.25), ("y", -0.2), ("z", 0.4)))
    observation = clip_of(dataclasses.replace(BALL, effects=(struck,)), 30)
    _, start, clip = started(BALL, observation)
    hypothesis = Hypothesis(base_space(start.scene))
    base = clip.fit(hypothesis, np.zeros(hypothesis.dimension), 10)
    clip.settle_noise(base)
    clip.allow_slack(base)
    return clip, base


def test_a_path_has_a_node_in_the_air_after_its_impact(bounced):
    clip, base = bounced
    there = with_nodes(clip, base)
    (node,) = there.hypothesis.nodes
    assert node.target == 0
    assert len(there.z) == len(base.z) + COORDINATES
    assert there.hypothesis.ordinary.all()
    assert max(i.frame for i in node.struck) < node.frame <= clip.frames - LEAST_LEFT
    assert missing(there.hypothesis.nodes).tolist() == [0] * COORDINATES
    # The state is told by differences of poses, which the air does not disturb.
    at = clip.shot(there.hypothesis, there.hypothesis.batch(there.z[None]))[1]
    assert np.abs(at).max() < 1.0


def test_nodes_take_up_what_an_engine_does_not_know_of_an_impact(bounced):
    clip, base = bounced
    before = clip.fit(dataclasses.replace(base.hypothesis, slack=clip.slack_along(base)), base.z, 20)
    kept = clip.settled
    fit = base_with_nodes(clip, before, [with_nodes(clip, before)], 0)
    clip.settled = kept
    same = clip.at(fit.hypothesis, fit.z)
    assert clip.misfit(same) < clip.misfit(before)
    assert same.evidence > before.evidence + 50
    # Without it the numbers of the ball bend: its true ones are the given scene's.
    own = [k for k, p in enumerate(fit.hypothesis.space.parameters) if p.field in ("linear_velocity", "size")]
    assert np.abs(fit.z[own]).max() < np.abs(before.z[own]).max()


def test_derivatives_by_states_are_those_of_residuals(bounced):
    clip, base = bounced
    there = with_nodes(clip, base)
    hypothesis = there.hypothesis.added(term("drag", 0, clip.frames))
    z = np.concatenate([there.z, np.full(2, 0.1)])
    jacobian, still = clip.jacobian(hypothesis, z), clip.residuals(hypothesis, z[None])[0][0]
    assert jacobian.shape == (len(still), len(z))
    for k in range(len(z)):
        moved = z.copy()
        moved[k] += 0.002
        change = (clip.residuals(hypothesis, moved[None])[0][0] - still) / 0.002
        assert np.abs(change - jacobian[:, k]).max() < 1e-3 * max(np.abs(change).max(), 1.0)
    known = len(clip.measured.objects)
    place = slice(hypothesis.space.dimension, hypothesis.ground)
    # What is seen before the node does not depend on it (but by what contacts may err by, here nothing).
    with tempered(clip, 1.0):
        rigid = clip.jacobian(hypothesis.rigid, z)
    parts = clip.measured.split(rigid[:known, place.start])
    assert np.abs(parts.moments[: hypothesis.nodes[0].frame]).max() == 0.0
    assert np.abs(parts.moments[hypothesis.nodes[0].frame :]).max() > 0.0
    assert np.abs(jacobian[known:, place]).max() > 0.0


def test_derivatives_that_are_not_asked_for_cost_no_rollouts(bounced):
    clip, base = bounced
    hypothesis, z = base.hypothesis, base.z
    asked = np.arange(len(z)) % 3 == 0
    counted, told = [clip.rollouts], []
    for size in (0.02, np.where(asked, 0.02, 0.0)):
        told.append(clip.jacobian(hypothesis, z, size=size))
        counted.append(clip.rollouts)
    whole, part = told
    assert np.array_equal(part[:, asked], whole[:, asked])
    assert whole[:, ~asked].any()
    assert not part[:, ~asked].any()
    many, few = np.diff(counted)
    assert few < 0.5 * many


def test_an_effect_that_was_found_without_nodes_is_fitted_with_them(bounced):
    clip, base = bounced
    there = clip.fit(with_nodes(clip, base).hypothesis, with_nodes(clip, base).z, 8)
    one = base.hypothesis.added(term("drag", 0, clip.frames))
    found = Candidate(clip.at(one, np.concatenate([base.z, np.zeros(2)])), 0.0, 3.0)
    same = with_nodes_of(found.fit, there)
    assert np.array_equal(same.z[-2:], found.fit.z[-2:])
    assert same.hypothesis.values(same.z[None], 0).shape == (1, 2)
    ((fit, promise),) = found_before(clip, there, (found,)).values()
    assert promise == 3.0
    assert fit.hypothesis.nodes == there.hypothesis.nodes
    assert fit.cost < found.fit.cost


def test_impacts_beside_nodes_are_those_that_nodes_were_made_of(bounced):
    clip, base = bounced
    nodes = with_nodes(clip, base).hypothesis.nodes
    jump, far = Impact(0, nodes[0].frame, 9.0, 0.0), Impact(0, nodes[0].frame + 5, 1.0, 0.0)
    found = with_struck([jump, far], nodes)
    assert jump not in found
    assert far in found
    assert {i.frame for i in found} <= {far.frame, *(i.frame for i in nodes[0].struck)}
