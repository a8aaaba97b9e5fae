"""Objects that do not meet are moved in the same rollouts, and derivatives stay what they are."""

import dataclasses

import numpy as np
import pytest

from mjx_refine.diagnosis.fits import apart
from mjx_refine.diagnosis.fits.apart import beside, companies, meetings, moved_together
from mjx_refine.diagnosis.fits.hypothesis import WHOLE, Hypothesis, term
from mjx_refine.diagnosis.fits.nodes import Node, missed_by, missing
from mjx_refine.effects.magnus import Magnus
from mjx_refine.scene import Body, Camera, Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.space import Space

NODES, FRAMES = ((0, 4), (1, 6), (0, 8)), 12


def missed_of(hypothesis, z, fly):
    batch = hypothesis.batch(z[None])
    return missed_by(hypothesis.nodes, fly(batch)[1], batch.restarts)


def path(*places):
    """Poses of bodies whose centres are at these places, frame by frame."""
    centres = np.array(places, np.float64)
    return np.concatenate([centres, np.tile([1.0, 0.0, 0.0, 0.0], (*centres.shape[:2], 1))], -1)[None]


def test_spheres_meet_in_a_frame_or_between_two():
    away = path([[0, 0, 1], [3, 0, 1], [0, 9, 1]], [[0, 0, 1], [1.0, 0, 1], [0, 9, 1]])
    past = path([[0, 0, 1], [-3, 0.5, 1], [0, 9, 1]], [[0, 0, 1], [3, 0.5, 1], [0, 9, 1]])
    radius = np.full((1, 3), 0.4)
    assert not meetings(away, radius).any()
    met = meetings(past, radius)
    assert met.tolist() == (~np.eye(3, dtype=bool) & (np.arange(3) < 2) & (np.arange(3)[:, None] < 2)).tolist()
    assert meetings(away, np.full((1, 3), 0.6))[0, 1]


def test_one_frame_and_diverged_paths_can_be_asked():
    assert not meetings(path([[0, 0, 1], [3, 0, 1]]), np.full((1, 2), 0.4)).any()
    assert not meetings(np.full((1, 3, 2, 7), np.nan), np.full((1, 2), 0.4)).any()


def test_who_meets_a_third_is_of_one_company():
    met = np.zeros((4, 4), bool)
    met[0, 2] = met[2, 0] = met[2, 3] = met[3, 2] = True
    company = companies(met)
    assert company[0] == company[2] == company[3] != company[1]


def test_every_coordinate_is_moved_once_and_companies_never_twice_in_a_row():
    owner = np.array([-1, 0, 0, 0, 1, 1, 2, -1])
    moves = np.array([1, 0, 1, 1, 1, 0, 1, 0], bool)
    rows = moved_together(owner, np.array([0, 1, 1]), moves, np.full(8, WHOLE))
    assert (rows.sum(0) == 1).all()
    assert len(rows) == 2 + 3
    for row in rows:
        owners = [min(o, 1) for o in owner[row]]
        assert len(owners) == len(set(owners))
    # What moves goes with what moves.
    assert sum((row & moves).any() for row in rows) == 1 + 2


def scene(distance: float) -> Scene:
    bodies = [
        Body("box", "left", (0.1, 0.12, 0.14), (0.0, 0.0, 0.3), linear_velocity=(0.3, 0.0, 0.5)),
        Body("sphere", "right", (0.15,), (distance, 0.1, 0.5), linear_velocity=(-0.2, 0.0, 0.0)),
    ]
    return Scene(tuple(bodies), Camera((0.0, -3.0, 1.5), 20.0, 45.0))


@pytest.mark.parametrize(("distance", "fewer"), [(1.5, True), (0.35, False)])
def test_rollouts_are_shared_only_where_objects_do_not_meet(distance, fewer):
    one = scene(distance)
    hypothesis = Hypothesis(Space.around(one)).added(term("magnus", 0, 12))
    simulator, asked = MujocoSimulator(one.shapes, 30.0, 1), []

    def fly(batch):
        asked.append(len(batch))
        return simulator.rollout(batch, 12), np.zeros((len(batch), 0, 13))

    z, step = np.zeros(hypothesis.dimension), np.full(hypothesis.dimension, 0.01)
    told = beside(hypothesis, z, step, fly)
    assert (len(told.batch) < hypothesis.dimension) == fewer
    for k in range(hypothesis.dimension):
        alone = z.copy()
        alone[k] += step[k]
        wanted = simulator.rollout(hypothesis.batch(alone[None]), 12)[0]
        found = np.where(told.felt[k, :2, None], told.poses[told.row[k]], told.poses[0])
        assert found == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize(
    ("distance", "effect"), [(1.5, "magnus"), (1.5, "slope"), (0.35, "magnus"), (1.5, "dropped_frames")]
)
def test_stretches_that_nodes_keep_apart_share_rollouts(distance, effect):
    one = scene(distance)
    state = np.array([0.3, 0, 0.9, 1, 0, 0, 0, 0.2, 0.1, 1.0, 1.0, 2.0, 0.5])
    nodes = [
        Node(target, frame, state + target * distance * np.eye(13)[0], np.full(12, 0.1), ()) for target, frame in NODES
    ]
    start = np.array([5.0, 1.0]) if effect == "dropped_frames" else None
    extra = term(effect, 0 if effect == "magnus" else -1, FRAMES, start)
    hypothesis = dataclasses.replace(Hypothesis(Space.around(one)), nodes=tuple(nodes)).added(extra)
    simulator, asked = MujocoSimulator(one.shapes, 30.0, 1), []

    def fly(batch):
        asked.append(len(batch))
        return simulator.shot(batch, FRAMES)

    z, step = np.zeros(hypothesis.dimension), np.full(hypothesis.dimension, 0.01)
    told = beside(hypothesis, z, step, fly)
    # Of each object: its own numbers, and twelve of its state at a time.
    most = 1 + np.sum(hypothesis.owners < 0) + 12 + 7
    assert (sum(asked) <= most) == (distance == 1.5 and effect != "dropped_frames")
    change = told.change_of_missed(missing(hypothesis.nodes))
    (still,), (begun,) = fly(hypothesis.batch(z[None]))[0], missed_of(hypothesis, z, fly)
    for k in range(hypothesis.dimension):
        alone = z.copy()
        alone[k] += step[k]
        found = np.where(told.felt[k, :2, None], told.poses[told.row[k]], still)
        assert found == pytest.approx(fly(hypothesis.batch(alone[None]))[0][0], abs=1e-8)
        assert change[k] == pytest.approx(missed_of(hypothesis, alone, fly)[0] - begun, abs=1e-6)


def test_stretches_are_told_apart_beside_a_larger_company():
    """Two objects that meet have more numbers than a third with a node: as many rollouts as rows, in another order."""
    pair = scene(0.35)
    third = Body("sphere", "third", (0.15,), (2.0, 0.1, 0.5), linear_velocity=(-0.2, 0.0, 0.0))
    one = dataclasses.replace(pair, objects=(*pair.objects, third))
    state = np.array([2.3, 0, 0.9, 1, 0, 0, 0, 0.2, 0.1, 1.0, 1.0, 2.0, 0.5])
    hypothesis = dataclasses.replace(Hypothesis(Space.around(one)), nodes=(Node(2, 6, state, np.full(12, 0.1), ()),))
    simulator = MujocoSimulator(one.shapes, 30.0, 1)
    sizes = [int((np.isin(hypothesis.owners, company)).sum()) for company in ([0, 1], [2])]
    assert sizes[0] >= sizes[1]

    def fly(batch):
        return simulator.shot(batch, FRAMES)

    z, step = np.zeros(hypothesis.dimension), np.full(hypothesis.dimension, 0.01)
    told = beside(hypothesis, z, step, fly)
    change = told.change_of_missed(missing(hypothesis.nodes))
    still, begun = fly(hypothesis.batch(z[None]))[0][0], missed_of(hypothesis, z, fly)[0]
    for k in range(hypothesis.dimension):
        alone = z.copy()
        alone[k] += step[k]
        found = np.where(told.felt[k, :3, None], told.poses[told.row[k]], still)
        assert found == pytest.approx(fly(hypothesis.batch(alone[None]))[0][0], abs=1e-8)
        assert change[k] == pytest.approx(missed_of(hypothesis, alone, fly)[0] - begun, abs=1e-6)


def test_effects_that_couple_objects_keep_rollouts_apart(monkeypatch):
    one = scene(1.5)
    hypothesis = Hypothesis(Space.around(one)).added(term("magnus", 0, 12))
    simulator = MujocoSimulator(one.shapes, 30.0, 1)
    monkeypatch.setattr(Magnus, "couples", True)
    z = np.zeros(hypothesis.dimension)
    told = beside(
        hypothesis,
        z,
        z + 0.01,
        lambda batch: (simulator.rollout(batch, 12), np.zeros((len(batch), 0, 13))),
    )
    assert len(told.batch) == 1 + hypothesis.dimension
    assert told.felt.all()


def test_where_a_moved_object_meets_another_rollouts_are_made_again(monkeypatch):
    one = scene(1.5)
    hypothesis = Hypothesis(Space.around(one))
    simulator, asked = MujocoSimulator(one.shapes, 30.0, 1), []

    def fly(batch):
        asked.append(len(batch))
        return simulator.rollout(batch, 12), np.zeros((len(batch), 0, 13))

    told = iter([np.zeros((2, 2), bool), ~np.eye(2, dtype=bool)])
    monkeypatch.setattr(apart, "meetings", lambda poses, radius: next(told))
    z = np.zeros(hypothesis.dimension)
    found = beside(hypothesis, z, z + 0.01, fly)
    assert len(asked) == 3
    assert found.felt.all()
    assert len(found.batch) == 1 + hypothesis.dimension
