"""What pictures alone can still improve: the camera, and where all objects stand together."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from own_clip import SCENES, OwnClip

from mjx_refine.observation import Observation
from mjx_refine.scene import Effect
from mjx_refine.search.aim import Aim, aimed
from mjx_refine.space import Space
from mjx_refine.view.tiles import TileScorer

FRAMES = 8


def own_scorer(clip: OwnClip) -> TileScorer:
    observation = Observation(clip.flow, clip.masks, 30.0)
    return TileScorer(clip.scene.shapes, observation, (1,), (160, 107))


def off(space: Space, fields: tuple[str, ...], widths: float) -> np.ndarray:
    moved = np.array([p.field in fields for p in space.parameters])
    return space.start + widths * space.sigma * moved


@pytest.mark.parametrize("scene", ["flight", "slide"])
def test_a_camera_that_is_off_is_found_again_with_one_rollout(scene):
    clip = OwnClip(SCENES[scene], FRAMES)
    scorer, space = own_scorer(clip), Space.around(clip.scene)
    rollouts = []

    class Counted:
        def rollout(self, batch, frames):
            rollouts.append(len(batch))
            return clip.simulator.rollout(batch, frames)

    point = off(space, ("camera_pitch", "camera_fovy"), 0.05)
    found = aimed(space, point, Counted(), scorer, seed=0)
    assert rollouts == [1]

    def fitness(p):
        batch = space.decode(p[None])
        return float(scorer(clip.simulator.rollout(batch, FRAMES), batch).fitness[0])

    # The rollout is the same from where the camera stood, so what was seen without it holds with it.
    assert fitness(found) > fitness(point) + 0.5 * (fitness(space.start) - fitness(point))
    changed = {space.parameters[k].field for k in np.nonzero(found != point)[0]}
    assert changed <= {"camera_position", "camera_pitch", "camera_fovy", "position"}
    np.testing.assert_array_equal(aimed(space, point, Counted(), scorer, seed=0), found)


def test_objects_move_together_by_the_same_metres():
    crate = SCENES["slide"].objects[0]
    other = dataclasses.replace(crate, name="other", position=(0.7, 0.9, 0.15))
    scene = dataclasses.replace(SCENES["slide"], objects=(crate, other))
    space = Space.around(scene)
    aim = Aim.of(space, space.start)
    steps = np.minimum(0.3, aim.high)
    moved = space.decode((space.start + steps @ aim.columns)[None]).position[0]
    shift = moved - space.decode(space.start[None]).position[0]
    assert shift[0] == pytest.approx(shift[1])
    assert abs(shift[0, 0]) > 0.01
    assert shift[0, 2] == pytest.approx(0.0)


def test_nobody_leaves_the_box():
    space = Space.around(SCENES["slide"])
    for corner in (np.zeros(space.dimension), np.ones(space.dimension)):
        aim = Aim.of(space, corner)
        ends = corner + np.stack([aim.low, aim.high]) @ aim.columns
        assert ends.min() > -1e-9
        assert ends.max() < 1 + 1e-9


def test_where_something_stands_in_its_place_only_the_camera_moves():
    pushed = dataclasses.replace(SCENES["slide"], effects=(Effect("slope", None, (("x", 1.0), ("y", 0.0))),))
    space = Space.around(pushed)
    aim = Aim.of(space, space.start)
    fields = {space.parameters[k].field for k in np.nonzero(aim.columns.any(0))[0]}
    assert fields == {"camera_position", "camera_pitch", "camera_fovy"}
