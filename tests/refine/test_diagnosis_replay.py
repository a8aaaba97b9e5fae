"""What a diagnosis shows replays the clip: contacts do not err there, effects stay as fitted, noise is the clip's own."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from own_clip import SIZE
from test_diagnosis import BALL, FLIGHT, clip_of

from mjx_refine.diagnosis import diagnose
from mjx_refine.diagnosis.answer.replay import COARSE, replays
from mjx_refine.diagnosis.diagnose import prepared
from mjx_refine.diagnosis.fits.fit import ClipFit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, term
from mjx_refine.diagnosis.search.compare import compare
from mjx_refine.observation import Observation
from mjx_refine.scene import Body, Effect, Scene
from mjx_refine.simulate import simulate
from mjx_refine.space import Space

BOUNCE = dataclasses.replace(FLIGHT, objects=(dataclasses.replace(BALL, linear_velocity=(1.6, 0.3, 0.5)),))


def started(given: Scene, clip: Observation):
    """(problem, its start, residuals) of a clip."""
    problem, start, measured = prepared(given, clip, 1)
    return problem, start, ClipFit(problem.reference(given.shapes), measured, clip.size, clip.length)


def aside(scene: Scene, by: float) -> Scene:
    """The scene with its object moved along x [m]."""
    (body,) = scene.objects
    x, y, z = body.position
    return dataclasses.replace(scene, objects=(dataclasses.replace(body, position=(x + by, y, z)),))


def test_replays_are_no_worse_than_the_given_scene_and_hold_effects():
    drag = Effect("drag", "ball", (("linear", 0.0), ("quadratic", 0.05)))
    clip = clip_of(dataclasses.replace(BOUNCE, effects=(drag,)))
    problem, start, fit_of = started(aside(BOUNCE, 0.02), clip)
    hypothesis = Hypothesis(Space.around(start.scene), (term("drag", 0, clip.length),))
    # Half a width of everything that the base model has, and some drag.
    z = np.where(hypothesis.ordinary, 0.5, 0.3)
    fit = fit_of.at(hypothesis, z)
    fit_of.allow_slack(fit)

    (found,) = replays(fit_of, [fit], problem, start.matching)
    begun = hypothesis.scene(z, clip.length)
    plain = hypothesis.scene(np.where(hypothesis.ordinary, 0.0, z), clip.length)
    assert dict(found.scene.effects[0].parameters) == pytest.approx(dict(begun.effects[0].parameters))
    scores = problem.score([begun, plain, found.scene], start.matching)
    assert scores.fitness[2] >= scores.fitness[:2].max()
    assert (found.iou, found.epe) == pytest.approx((scores.iou[2], scores.epe[2]))
    assert fit_of.slack_columns.shape[1] == 0


def test_what_comes_after_impacts_is_reached_by_ever_more_of_the_clip():
    box = Body(
        "box", "box", (0.12, 0.09, 0.07), (-0.6, 0.2, 0.8), (0.9, 0.3, 0.2, 0.1), (1.3, 0.2, 0.3), (1.0, 4.0, 2.0)
    )
    tumbling = dataclasses.replace(FLIGHT, objects=(box,))
    clip = simulate(tumbling, SIZE, 30)
    problem, start, fit_of = started(aside(tumbling, 0.05), clip)
    hypothesis = Hypothesis(Space.around(start.scene))
    # The fit that is replayed is off, as one is whose paths begin anew after each impact.
    off = np.random.default_rng(0).normal(0.0, 0.6, hypothesis.dimension)
    whole = fit_of.fit(hypothesis, off, 8, passing=True)
    scenes = [hypothesis.scene(z, clip.length) for z in (off, whole.z, np.zeros_like(off))]
    (found,) = replays(fit_of, [fit_of.at(hypothesis, off)], problem, start.matching)
    assert problem.score(scenes, start.matching).iou.max() < 0.8
    assert found.iou > 0.85


def test_scenes_whose_every_picture_is_drawn_are_compared_in_small_ones(monkeypatch):
    clip = clip_of(dataclasses.replace(BOUNCE, effects=(Effect("mask_bias", None, (("width", -2.0),)),)))
    problem, start, fit_of = started(aside(BOUNCE, 0.02), clip)
    hypothesis = Hypothesis(Space.around(start.scene), (term("mask_bias", -1, clip.length),))
    fit = fit_of.at(hypothesis, np.where(hypothesis.ordinary, 0.5, -1.0))
    asked, score = [], problem.score
    monkeypatch.setattr(
        problem, "score", lambda scenes, *rest: asked.append((len(scenes), *rest[1:])) or score(scenes, *rest)
    )
    (found,) = replays(fit_of, [fit], problem, start.matching)
    assert asked == [(4, COARSE), (1,)]
    scores = score([found.scene], start.matching)
    assert (found.iou, found.epe) == pytest.approx((scores.iou[0], scores.epe[0]))
    # Least squares of the base parameters went on with masks as thin as they are.
    assert found.iou > float(score([hypothesis.scene(fit.z, clip.length)], start.matching).iou[0])


def test_the_base_model_is_shown_no_worse_than_it_was_given():
    clip = clip_of(BOUNCE)
    given = aside(BOUNCE, 0.01)
    problem, start, _ = started(given, clip)
    found = diagnose(given, clip, threads=1)
    before = problem.score([start.scene], start.matching)
    assert found.gap.iou_before - found.gap.epe_before >= float(before.fitness[0]) - 1e-6
    assert found.gap.iou_before > 0.97


def test_a_shaking_camera_is_not_taken_for_noise():
    generator = np.random.default_rng(3)
    shake = tuple((name, tuple(generator.normal(0.0, 0.4, 20).tolist())) for name in ("yaw", "pitch"))
    seen = simulate(dataclasses.replace(FLIGHT, effects=(Effect("camera_shake", None, shake),)), SIZE, 20)
    noisy = seen.flow + generator.normal(0.0, 0.1, seen.flow.shape)
    clip = dataclasses.replace(seen, flow=noisy.astype(np.float32), flow_sigma=0.1)
    _, start, fit_of = started(FLIGHT, clip)
    before = float(fit_of.measured.moment_noise[:, :2].max())
    compared = compare(fit_of, start.scene, clip, start.matching, (), 0, lambda line: None)
    assert compared.candidates[0].names == ("camera_shake",)
    assert before > 0.5  # the shake is some pixels
    assert float(fit_of.measured.moment_noise[:, :2].max()) < 0.15
