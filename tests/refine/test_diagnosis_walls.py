"""An obstacle's coordinates turn it along the outline of what touches it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from effect_scenes import CAMERA

from mjx_refine.batch import batch_from_scenes
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, term
from mjx_refine.diagnosis.fits.numbers import values_of
from mjx_refine.diagnosis.search.screen import term_of
from mjx_refine.effects.hidden_obstacle import HiddenObstacle, gaps
from mjx_refine.effects.kind import FitView
from mjx_refine.scene import Body, Scene
from mjx_refine.space import Space

TURNED = (0.9192, 0.1459, -0.0973, 0.3525)
BODIES = {
    "sphere": Body("sphere", "it", (0.25,), (1.3, -2.0, 0.5), TURNED),
    "box": Body("box", "it", (0.3, 0.2, 0.15), (1.3, -2.0, 0.5), TURNED),
    "cylinder": Body("cylinder", "it", (0.2, 0.3), (1.3, -2.0, 0.5), TURNED),
}
FRAMES = 12


def touched(shape: str, angle: float):
    """The view of a body that stands still, and the term of a wall that it touches."""
    scene = Scene((BODIES[shape],), CAMERA)
    batch = batch_from_scenes([scene])
    pose = np.concatenate([batch.position[0], batch.quaternion[0]], -1)
    poses = np.repeat(pose[None], FRAMES, 0)
    still = np.zeros((FRAMES, 1, 3))
    view = FitView(
        batch, poses, still, still, np.zeros((FRAMES, 1), bool), np.zeros((FRAMES - 1, 0, 2)), (), (480, 320), 30.0
    )
    start = HiddenObstacle().facing(view, 0, 3, angle)
    return scene, view, term_of("hidden_obstacle", 0, start, FRAMES)


@pytest.mark.parametrize("shape", sorted(BODIES))
@pytest.mark.parametrize("turn", [-50.0, -8.0, 0.0, 3.0, 70.0])
def test_however_an_obstacle_is_turned_it_touches_the_body(shape, turn):
    _, view, one = touched(shape, 37.0)
    values = one.values(np.array([[turn / one.width[0], 0.0, 0.0]]))[0]
    assert values[0] == pytest.approx(37.0 + turn)
    # About the world's origin, 2.4 m away, a turn of 3 degrees would move it by 12 cm.
    assert abs(gaps(view.batch, view.poses, 0, values)[3]) < 0.006


@pytest.mark.parametrize("shape", sorted(BODIES))
def test_coordinates_and_numbers_are_each_others_inverse(shape):
    _, _, one = touched(shape, -120.0)
    z = np.array([[0.4, -0.7, 0.2], [-1.1, 0.3, -0.5]])
    assert one.at(one.values(z)) == pytest.approx(z)


def test_numbers_that_depend_on_several_coordinates_have_errors_of_all():
    _, _, one = touched("sphere", 0.0)
    z, deviation = np.array([0.2, 0.1, 0.0]), np.array([0.02, 0.01, 0.3])
    told = values_of(one, z, np.diag(deviation**2), FRAMES)
    draws = one.values(z + np.random.default_rng(0).normal(size=(20000, 3)) * deviation)
    for k, name in enumerate(("angle", "distance", "restitution")):
        value = told[name]
        assert value.value == pytest.approx(one.values(z[None])[0, k])
        if name != "restitution":
            assert (value.high - value.low) / 2 == pytest.approx(1.645 * draws[:, k].std(), rel=0.03)
    # At its bounds an interval ends.
    assert told["restitution"].high <= 0.98


def test_a_hypothesis_rolls_out_the_same_wall_in_either_coordinates():
    scene, _, one = touched("box", 20.0)
    plain = term("hidden_obstacle", 0, FRAMES, one.values(np.zeros((1, 3)))[0], width=one.width)
    space = Space.around(scene)
    wanted = np.array([0.3, -0.2, 0.1])
    hypothesis = Hypothesis(space, (one,))
    values = hypothesis.values(np.concatenate([np.zeros(space.dimension), wanted])[None], 0)
    other = dataclasses.replace(hypothesis, terms=(plain,))
    z = np.concatenate([np.zeros(space.dimension), plain.at(values)[0]])
    assert other.values(z[None], 0) == pytest.approx(values)
