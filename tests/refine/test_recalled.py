"""Rollouts that are asked for again."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_diagnosis import FLIGHT

from mjx_refine.batch import SceneBatch
from mjx_refine.effects.acting import batch_with_effects
from mjx_refine.scene import Effect
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.recalled import Memory, Recalling

FRAMES = 12


def batch_of(*effects: Effect) -> SceneBatch:
    return batch_with_effects([dataclasses.replace(FLIGHT, effects=effects)] * 3)


def simulator(memory: Memory) -> Recalling:
    return Recalling(MujocoSimulator(FLIGHT.shapes, 30.0, 1), memory)


def test_what_moves_alike_is_rolled_out_once_and_is_what_the_simulator_says():
    roll = simulator(Memory())
    drag = Effect("drag", FLIGHT.names[0], (("quadratic", 0.2),))
    wind = Effect("wind", None, (("x", 2.0),))
    rolled = Effect("camera_roll", None, (("angle", 3.0),))
    plain = batch_of()
    turned = dataclasses.replace(plain, camera_pitch=plain.camera_pitch + 0.1)
    heavier = dataclasses.replace(plain, mass=2 * plain.mass)
    alike = [[plain, turned, batch_of(rolled)], [batch_of(drag), batch_of(drag, rolled)], [batch_of(wind)], [heavier]]
    for group in alike:
        before = roll.recalled
        for batch in group:
            assert np.array_equal(roll.rollout(batch, FRAMES), roll.simulator.rollout(batch, FRAMES))
        assert roll.recalled - before == len(group) - 1
    assert roll.rollout(plain, FRAMES - 1).shape[1] == FRAMES - 1


def test_the_oldest_are_given_up():
    one = np.zeros(100)
    memory = Memory(most=2 * one.nbytes)
    for key in "abc":
        memory.keep(key, one.copy())
        assert memory.recall("a") is not None or key == "c"
    assert [memory.recall(key) is None for key in "abc"] == [False, True, False]
    memory.keep("large", np.zeros(1000))
    assert memory.recall("large") is None


def test_processes_share_a_folder(tmp_path):
    mine, yours = Memory(most=2000), Memory()
    for memory in (mine, yours):
        memory.share(tmp_path)
    mine.keep("a", np.arange(100.0))
    assert np.array_equal(yours.recall("a"), np.arange(100.0))
    mine.keep("b", np.arange(200.0))
    assert yours.recall("a") is None
    assert [path.name for path in tmp_path.iterdir()] == ["b.npy"]
    (tmp_path / "b.npy").write_bytes(b"half of it")
    assert yours.recall("b") is None
    mine.share(tmp_path / "gone")
    mine.keep("c", np.arange(9.0))
    assert mine.recall("c") is not None


def test_what_is_kept_is_not_written_to():
    poses = simulator(Memory()).rollout(batch_of(), FRAMES)
    with pytest.raises(ValueError, match="read-only"):
        poses[0] = 0.0
