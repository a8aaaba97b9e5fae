"""Effects' numbers are parameters of a space as the scene's own are."""

import numpy as np
import pytest

from mjx_refine.effects import batch_with_effects
from mjx_refine.scene import Body, Camera, Effect, Scene
from mjx_refine.search import Options, refine
from mjx_refine.simulate import simulate
from mjx_refine.space import Space

BALL = Body("sphere", "ball", (0.2,), (-0.9, 0.2, 1.6), linear_velocity=(2.4, 0.2, 1.8), damping=-20.0)
CAMERA = Camera((0.0, -3.2, 2.2), 58.0, 45.0)


def _scene(*effects: Effect) -> Scene:
    return Scene((BALL,), CAMERA, effects=effects)


DRAG = Effect("drag", "ball", (("quadratic", 0.05),))
PUSH = Effect("push", "ball", (("time", 0.4), ("x", 0.5), ("y", 0.0), ("z", 0.2)))


def test_single_numbers_are_parameters_and_the_start_is_the_scene():
    scene = _scene(DRAG, PUSH)
    space = Space.around(scene)
    assert {"ball.drag.quadratic", "ball.push.time", "ball.push.x", "ball.push.z"} <= set(space.names)
    again = space.scene_at(space.start)
    first, second = batch_with_effects([scene]), batch_with_effects([again])
    for a, b in zip(first.effects, second.effects, strict=True):
        assert np.allclose(a.values, b.values, atol=1e-9)


def test_a_number_that_is_varied_is_written_into_the_scene():
    space = Space.around(_scene(DRAG))
    k = space.names.index("ball.drag.quadratic")
    u = space.start
    u[k] = space.parameters[k].to_unit(0.2)
    (effect,) = space.scene_at(u).effects
    assert dict(effect.parameters)["quadratic"] == pytest.approx(0.2)
    assert space.decode(u[None]).effects[0].values[0, 1] == pytest.approx(0.2)


def test_two_of_a_kind_on_one_object_have_names_of_their_own():
    names = Space.around(_scene(PUSH, PUSH)).names
    assert len(set(names)) == len(names)
    assert "ball.push.x" in names
    assert "ball.push2.x" in names


def test_series_and_counts_stay_as_they_are_and_are_told():
    shake = Effect("camera_shake", None, (("yaw", (0.1, -0.1, 0.2)), ("pitch", (0.0, 0.1, 0.0))))
    dropped = Effect("dropped_frames", None, (("frame", 2.0), ("count", 1.0)))
    space = Space.around(_scene(shake, dropped))
    assert not [n for n in space.names if "camera_shake" in n or "dropped" in n]
    told = dict(space.fixed)
    assert {"camera_shake.yaw", "camera_shake.pitch"} <= set(told)
    assert told["dropped_frames.frame"] == "only whole numbers mean something"
    assert space.scene_at(space.start).effects == (shake, dropped)


def test_a_tilted_floor_is_refined_with_what_stands_on_it():
    resting = Body(
        "box", "crate", (0.2, 0.2, 0.2), (0.0, 0.4, 0.2 / np.cos(0.1)), (np.cos(0.05), np.sin(0.05), 0.0, 0.0)
    )
    scene = Scene((resting,), CAMERA, effects=(Effect("slope", None, (("x", float(np.degrees(0.1))), ("y", 0.0))),))
    space = Space.around(scene)
    k = space.names.index("slope.x")
    u = space.start
    u[k] = space.parameters[k].to_unit(0.0)
    level = space.scene_at(u)
    assert dict(level.effects[0].parameters)["x"] == pytest.approx(0.0, abs=1e-9)
    assert abs(level.objects[0].orientation[1]) < 0.01


def test_a_refinement_finds_an_effects_size():
    truth = _scene(Effect("drag", "ball", (("quadratic", 0.25),)))
    clip = simulate(truth, size=(160, 120), frames=16)
    result = refine(_scene(DRAG), clip, Options(iterations=6, refits=0, optimizer="cmaes"))
    (effect,) = result.refined.scene.effects
    assert dict(effect.parameters)["quadratic"] != 0.05
    assert float(result.refined.scores.fitness[0]) > float(result.init.scores.fitness[0])
    assert any(p.name == "ball.drag.quadratic" for p in result.parameters)
