"""A force of any course: what stands for all that the catalogue does not hold."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from effect_scenes import BALL, CAMERA, FPS
from own_clip import SIZE
from test_diagnosis import BALL as THROWN
from test_diagnosis import FLIGHT, SIGNS, without_residuals

from mjx_refine.batch import BatchEffect, batch_from_scenes
from mjx_refine.diagnosis import diagnose
from mjx_refine.diagnosis.answer.verdict import UNNAMED, UNNAMED_ALONE, UNNAMED_ON_THE_FLOOR, Answer, answer
from mjx_refine.diagnosis.diagnose import TO_THE_NOISE, verdict_of
from mjx_refine.diagnosis.fits.candidates import Freed
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, term
from mjx_refine.diagnosis.misfit.signs import MOSTLY, signs
from mjx_refine.effects import acting_kind, catalogue, kind_of
from mjx_refine.effects.free_force import KNOTS
from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.scene import Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.space import Space
from mjx_refine.view.picture import draw


def forced(scene: Scene, until: float, force: np.ndarray):
    """A batch of one scene whose first object a force of this course (knots, 3) pushes."""
    values = np.concatenate([[until], np.asarray(force, float).T.ravel()])[None]
    return dataclasses.replace(batch_from_scenes([scene]), effects=(BatchEffect("free_force", 0, values),))


def strange_clip(scene: Scene, force: np.ndarray, frames: int = 20) -> Observation:
    batch = forced(scene, (frames - 1) / 30.0, force)
    poses = MujocoSimulator(scene.shapes, 30.0, 1).rollout(batch, frames)
    masks, flow = draw(poses[0], dataclasses.replace(batch, effects=()), SIZE)
    noise = np.random.default_rng(0).normal(0.0, 0.1, flow.shape)
    return Observation((flow + noise).astype(np.float32), masks, 30.0, flow_sigma=0.1, source="clip.npz")


def test_it_goes_straight_from_moment_to_moment():
    scene = Scene((BALL,), CAMERA, (0.0, 0.0, 0.0))
    force = np.zeros((KNOTS, 3))
    force[:, 0], force[KNOTS // 2, 1], force[:, 2] = 1.4, 0.7, np.linspace(0.0, 2.1, KNOTS)
    poses = MujocoSimulator(scene.shapes, FPS, 1).rollout(forced(scene, 1.0, force), 46)[0, :, 0, :3]
    speed = np.diff(poses, axis=0) * FPS
    # Constant: F t / m; a triangle of two intervals: F dt / m; growing: F t^2 / 2 m; after the last moment as in it.
    np.testing.assert_allclose(speed[29, 0], 2.0 * (30 - 0.5) / 30, rtol=0.01)
    np.testing.assert_allclose(speed[-1, 1], 1.0 / (KNOTS - 1), rtol=0.01)
    np.testing.assert_allclose(speed[29, 2], 3.0 * (29.5 / 30) ** 2 / 2, rtol=0.02)
    np.testing.assert_allclose(speed[-1, 2] - speed[-2, 2], 3.0 / 30, rtol=0.02)


def test_no_scene_and_no_call_may_name_it():
    assert "free_force" not in catalogue()
    with pytest.raises(InputError, match="expected one of drag"):
        kind_of("free_force")
    assert acting_kind("free_force").name == "free_force"
    assert acting_kind("drag") is kind_of("drag")


@pytest.mark.parametrize(
    ("changes", "kind", "forced"),
    [
        ({"unnamed": UNNAMED + 1, "aloft": 1.0}, "unknown", True),
        ({"unnamed": UNNAMED - 1, "aloft": 1.0}, "single", False),
        ({"unnamed": UNNAMED + 1}, "single", False),
        ({"unnamed": UNNAMED_ON_THE_FLOOR + 1}, "unknown", True),
        ({"unnamed": UNNAMED + 1, "aloft": 1.0, "pair": 200.0}, "unknown", True),
        ({"lead": 20.0, "unnamed": UNNAMED_ALONE + 1, "aloft": 1.0}, "unknown", True),
        ({"lead": 20.0, "unnamed": UNNAMED_ALONE - 1, "aloft": 1.0}, "none", False),
        ({"lead": 20.0, "unnamed": UNNAMED_ALONE + 1}, "none", False),
        ({"closed": 0.05, "unnamed": UNNAMED + 1, "aloft": 1.0}, "unknown", True),
        ({"closed": 0.05, "unnamed": UNNAMED - 1, "aloft": 1.0}, "unknown", False),
    ],
)
def test_what_explains_more_without_a_name_is_unknown(changes, kind, forced):
    said = answer(dataclasses.replace(SIGNS, **changes), [300.0, 150.0], video=True)
    assert (said.kind, said.forced) == (kind, forced)
    # Of poses, which err smoothly by themselves, nobody asked.
    assert not answer(dataclasses.replace(SIGNS, **changes), [300.0, 150.0]).forced


@pytest.mark.parametrize("on_floor", [MOSTLY - 0.1, MOSTLY + 0.1])
def test_its_gain_is_over_the_best_hypothesis(monkeypatch, on_floor):
    without_residuals(monkeypatch)
    clip = SimpleNamespace(misfit=lambda fit: 2.0, expected=lambda: 100.0, measured=SimpleNamespace(drawn=False))
    base = SimpleNamespace(data=400.0, evidence=-500.0)
    one = SimpleNamespace(fit=SimpleNamespace(evidence=-300.0, data=200.0), lead=200.0, names=("push",))
    freed = Freed(SimpleNamespace(evidence=-260.0), on_floor)  # type: ignore[arg-type]
    told = signs(clip, SimpleNamespace(base=base, candidates=(one,), pairs=(), freed=freed), 0.0)
    assert told.unnamed == pytest.approx(20.0)
    assert told.aloft == float(on_floor < MOSTLY)
    unasked = signs(clip, SimpleNamespace(base=base, candidates=(one,), pairs=(), freed=None), 0.0)
    assert (unasked.unnamed, unasked.aloft) == (0.0, 0.0)


def test_a_verdict_says_what_pushes_and_what_is_left():
    hypothesis = Hypothesis(Space.around(FLIGHT), (term("free_force", 0, 20),))
    freed = Freed(SimpleNamespace(hypothesis=hypothesis, z=np.zeros(hypothesis.dimension)), 0.0)  # type: ignore[arg-type]
    assert freed.words.count(" N at ") == KNOTS
    found = SimpleNamespace(candidates=(), pairs=(), freed=freed)
    told = [
        verdict_of(found, Answer("unknown", 0.7, (), 0.1, forced), ("ball",), ("sphere",))[0].sentence
        for forced in (True, False)
    ]
    assert "pushes ball" in told[0]
    assert "pushes" not in told[1]
    silent = Answer("none", 0.7, (), 0.1)
    near, far = (
        verdict_of(found, silent, ("ball",), ("sphere",), left)[0].sentence
        for left in (TO_THE_NOISE - 0.1, TO_THE_NOISE + 0.5)
    )
    assert "to the noise" in near
    assert "2.0 times what noise does" in far


FEW = ("wind", "push")


@pytest.mark.parametrize(
    "without",
    [
        pytest.param((), marks=pytest.mark.slow, id="whole"),
        pytest.param(tuple(sorted(set(catalogue()) - set(FEW))), id="few"),
    ],
)
def test_a_force_that_turns_round_twice_is_unknown(without):
    given = dataclasses.replace(FLIGHT, objects=(dataclasses.replace(THROWN, linear_velocity=(2.7, 0.3, 2.05)),))
    course = np.outer(np.array([1, 1, -1, -1, -1, 1, 1]) * 12.0 * THROWN.mass, [0.8, 0.0, 0.6])
    strange = diagnose(given, strange_clip(FLIGHT, course), without=without, threads=1)
    assert strange.verdict.effects == ("unknown",)
    assert strange.signs["unnamed"] > UNNAMED
    assert any("N at" in note for note in strange.notes)
