"""Cores that processes share."""

from __future__ import annotations

import dataclasses
import multiprocessing

import numpy as np
import pytest
from own_clip import FLIGHT

from mjx_refine.children import cores as available
from mjx_refine.effects.acting import batch_with_effects
from mjx_refine.scene import Effect
from mjx_refine.sim import cores
from mjx_refine.sim.c import MujocoSimulator


def test_all_cores_are_mine_until_they_are_shared():
    own = cores.Cores()
    assert own.mine == available()
    with own.at_work():
        assert own.mine == available()


def test_those_at_work_divide_the_cores():
    working = multiprocessing.get_context("spawn").Value("i", 0)
    one, other = cores.Cores(), cores.Cores()
    one.share(7, working)
    other.share(7, working)
    assert one.mine == 7
    with one.at_work():
        assert one.mine == other.mine == 7
        with other.at_work():
            assert one.mine == other.mine == 3
        assert one.mine == 7
    assert working.value == 0
    one.release()
    assert one.mine == available()


def test_who_fails_is_at_work_no_more():
    working = multiprocessing.get_context("spawn").Value("i", 0)
    own = cores.Cores()
    own.share(4, working)
    with pytest.raises(ValueError, match="diverged"), own.at_work():
        raise ValueError("diverged")
    assert working.value == 0


def test_however_many_are_at_work_one_core_is_left():
    working = multiprocessing.get_context("spawn").Value("i", 40)
    own = cores.Cores()
    own.share(4, working)
    assert own.mine == 1


def test_rollouts_are_the_same_with_any_part_of_the_cores(monkeypatch):
    drag = Effect("drag", FLIGHT.names[0], (("linear", 0.2), ("quadratic", 0.1)))
    scene = dataclasses.replace(FLIGHT, effects=(drag,))
    batch = batch_with_effects([scene] * 300)
    batch.linear_velocity[:] *= np.linspace(0.5, 1.5, 300)[:, None, None]
    simulator, found = MujocoSimulator(FLIGHT.shapes, 30.0, 4), []
    for mine in (1, 2, 4):
        shared = cores.Cores()
        shared.share(mine, multiprocessing.get_context("spawn").Value("i", 0))
        monkeypatch.setattr(cores, "PROCESS", shared)
        found.append(simulator.rollout(batch, 12))
    assert np.array_equal(found[0], found[1])
    assert np.array_equal(found[0], found[2])
    assert not np.array_equal(found[0][0], found[0][-1])
