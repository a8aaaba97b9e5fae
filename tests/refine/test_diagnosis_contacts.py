"""What contacts may err by along a path with effects, and patches of the floor that begin where pushes were found."""

from __future__ import annotations

import dataclasses

import numpy as np
from own_clip import CAMERA, SLIDE
from test_diagnosis import BALL, FLIGHT, clip_of
from test_diagnosis_replay import started

from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, term
from mjx_refine.diagnosis.fits.shown import view_of
from mjx_refine.diagnosis.fits.slack import contacts, impacts, sustained, touching
from mjx_refine.diagnosis.search.patches import patches_from_pushes
from mjx_refine.effects import batch_with_effects
from mjx_refine.effects.acting import on_the_floor
from mjx_refine.scene import Effect, Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.space import Space

FPS = 30.0
PUSH = Effect("push", "ball", (("time", 0.4), ("x", 0.0), ("y", 1.5), ("z", 0.0)))


def path(scene: Scene, effects: tuple[Effect, ...] = (), frames: int = 24):
    """(batch, poses) of a scene with effects."""
    batch = on_the_floor(batch_with_effects([dataclasses.replace(scene, effects=effects)]))
    return batch, MujocoSimulator(scene.shapes, FPS, 1).rollout(batch, frames)[0]


def test_a_push_in_flight_is_no_impact():
    high = dataclasses.replace(FLIGHT, objects=(dataclasses.replace(BALL, position=(-0.9, 0.3, 3.0)),))
    batch, poses = path(high, (PUSH,))
    plain = path(high)[1]
    jumps = impacts(batch, poses, FPS)
    assert [abs(one.frame - 0.4 * FPS) <= 1 for one in jumps]
    assert contacts(batch, poses, plain, FPS) == ([], [])


def test_an_impact_that_happens_anyway_stays_one():
    _, plain = path(FLIGHT)
    bounce = impacts(path(FLIGHT)[0], plain, FPS)[0]
    then = dataclasses.replace(PUSH, parameters=(("time", (bounce.frame - 0.5) / FPS), *PUSH.parameters[1:]))
    batch, poses = path(FLIGHT, (then,))
    found, _ = contacts(batch, poses, plain, FPS)
    assert any(abs(one.frame - bounce.frame) <= 1 for one in found)


def test_what_friction_does_to_a_sliding_or_rolling_body_is_no_impact():
    (crate,) = SLIDE.objects
    rough = dataclasses.replace(SLIDE, objects=(dataclasses.replace(crate, friction=(1.2, 0.01)),))
    batch, poses = path(rough)
    speed = np.linalg.norm(np.diff(poses[:, 0, :3], axis=0), axis=-1) * FPS
    assert (speed[:-1] - speed[1:]).max() > 0.25  # More than an impact's least change of velocity.
    assert impacts(batch, poses, FPS) == []
    push = Effect("push", crate.name, (("time", 0.2), ("x", 0.0), ("y", 2.0), ("z", 0.0)))
    assert [one.frame for one in impacts(*path(rough, (push,)), FPS)][:1] == [6]


def test_bodies_touch_a_tilted_floor():
    slope = Effect("slope", None, (("x", 0.0), ("y", 5.0)))
    batch, poses = path(SLIDE, (slope,))
    assert touching(batch, poses).all()
    # Heights alone tell nothing there.
    level = dataclasses.replace(batch, effects=())
    assert not touching(level, poses).all()


def test_what_an_effect_does_to_a_sliding_body_is_not_blamed_on_the_floor():
    wind = Effect("wind", None, (("x", 6.0), ("y", 0.0)))
    batch, poses = path(SLIDE, (wind,))
    plain = path(SLIDE)[1]
    on_floor = touching(batch, poses)
    long = contacts(batch, poses, plain, FPS)[1]
    assert long == sustained(batch, plain, on_floor, FPS) != sustained(batch, poses, on_floor, FPS)


def test_a_patch_is_found_from_a_push_where_it_was_crossed():
    (crate,), own = SLIDE.objects, 0.5
    slide = Scene((dataclasses.replace(crate, friction=(own, 0.01)),), CAMERA, SLIDE.gravity)
    patch = Effect("friction_patch", None, (("x", -0.15), ("y", 0.08), ("radius", 0.12), ("friction", 0.05)))
    clip = clip_of(dataclasses.replace(slide, effects=(patch,)), frames=18)
    _, start, fit_of = started(slide, clip)
    plain = Hypothesis(Space.around(start.scene))
    base = fit_of.fit(plain, np.zeros(plain.dimension), 8)
    pushed = plain.added(term("push", 0, clip.length, np.array([0.25, 0.1, 0.0, 0.0])))
    push = fit_of.fit(pushed, np.concatenate([base.z, np.zeros(int(pushed.terms[0].free.sum()))]), 12)
    (found,) = patches_from_pushes(fit_of, [(push, view_of(fit_of, base, clip, start.matching))])
    assert found is not None
    assert found.cost < min(push.cost, base.cost)
    x, y, radius, friction = found.hypothesis.values(found.z[None], 0)[0]
    assert np.hypot(x + 0.15, y - 0.08) < radius
    assert friction < own


def test_no_patch_is_sought_for_a_push_in_the_air():
    clip = clip_of(FLIGHT, frames=12)
    _, start, fit_of = started(FLIGHT, clip)
    pushed = Hypothesis(Space.around(start.scene)).added(term("push", 0, 12, np.array([0.2, 0.1, 0.0, 0.0])))
    push = fit_of.at(pushed, np.zeros(pushed.dimension))
    assert patches_from_pushes(fit_of, [(push, view_of(fit_of, push, clip, start.matching))]) == [None]
