"""The diagnosis: slack, held-out gap, the answer's rule, refusals, and a clip of our own from end to end."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from own_clip import CAMERA, SIZE

from mjx_refine.diagnosis import diagnose
from mjx_refine.diagnosis.answer.verdict import (
    AT_WORK,
    LIKELY,
    LIKELY_OF_A_VIDEO,
    UNLIKELY,
    UNLIKELY_OF_A_VIDEO,
    Answer,
    answer,
    upheld,
)
from mjx_refine.diagnosis.diagnose import verdict_of
from mjx_refine.diagnosis.fits.fitted import prior
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, term
from mjx_refine.diagnosis.fits.slack import impacts, slack_of, spins
from mjx_refine.diagnosis.misfit import signs as reading
from mjx_refine.diagnosis.misfit.heldout import HeldOut, kept_frames
from mjx_refine.diagnosis.misfit.signs import Signs, signs
from mjx_refine.effects import batch_with_effects, catalogue
from mjx_refine.effects.acting import apparent
from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.scene import Body, Effect, Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.space import Space
from mjx_refine.view.picture import draw

BALL = Body(
    "sphere", "ball", (0.2,), (-0.9, 0.3, 0.9), linear_velocity=(2.6, 0.3, 2.0), angular_velocity=(1.0, 4.0, 2.0)
)
FLIGHT = Scene((BALL,), CAMERA, (0.0, 0.0, -9.81))


def clip_of(scene: Scene, frames: int = 20, seed: int = 0) -> Observation:
    """A clip of our own engine with noisy flow."""
    batch = batch_with_effects([scene])
    poses = MujocoSimulator(scene.shapes, 30.0, 1).rollout(batch, frames)
    masks, flow = draw(apparent(poses, batch, 30.0)[0], batch, SIZE)
    noise = np.random.default_rng(seed).normal(0.0, 0.1, flow.shape)
    return Observation((flow + noise).astype(np.float32), masks, 30.0, flow_sigma=0.1, source="clip.npz")


def without_residuals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Signs that are read off residuals are as noise has them."""
    monkeypatch.setattr(reading, "structure", lambda clip, fit: 1.0)
    monkeypatch.setattr(reading, "unsteadiness", lambda clip, fit: 0.0)


def test_slack_whitens_the_covariance_of_its_columns():
    columns = np.random.default_rng(0).normal(size=(12, 3)) * [3.0, 1.0, 0.5]
    whitened = slack_of(columns)(np.eye(12))
    assert whitened @ (np.eye(12) + columns @ columns.T) @ whitened.T == pytest.approx(np.eye(12), abs=1e-9)


def test_impacts_are_where_a_ball_bounces():
    scene = Scene((dataclasses.replace(BALL, linear_velocity=(1.0, 0.0, 0.0)),), CAMERA)
    batch = batch_with_effects([scene])
    poses = MujocoSimulator(scene.shapes, 30.0, 1).rollout(batch, 30)[0]
    found = impacts(batch, poses, 30.0)
    lowest = int(poses[:, 0, 2].argmin())
    assert found
    assert abs(found[0].frame - lowest) <= 1


def test_spins_of_a_steady_turn():
    angle = np.arange(5) * 0.1
    poses = np.zeros((5, 1, 7))
    poses[:, 0, 3], poses[:, 0, 6] = np.cos(angle / 2), np.sin(angle / 2)
    assert spins(poses, 30.0) == pytest.approx(np.tile([0.0, 0.0, 3.0], (4, 1, 1)), abs=1e-9)


def test_the_prior_is_normal_near_the_given_scene_and_heavy_far_from_it():
    hypothesis = Hypothesis(Space.around(FLIGHT), (term("drag", 0, 10),))
    near, far = np.full(hypothesis.dimension, 0.01), np.full(hypothesis.dimension, 30.0)
    assert prior(hypothesis, near)[0] == pytest.approx(near, rel=1e-4)
    residual = prior(hypothesis, far)[0]
    assert residual[-1] == 30.0  # an effect's
    own = hypothesis.ordinary
    tails = hypothesis.tails[own]
    assert residual[own] == pytest.approx(tails * np.sqrt(np.log1p((30.0 / tails) ** 2)))
    assert tails.min() < 3 < tails[0]  # contacts mean something else in every engine
    step = 1e-6
    slope = (prior(hypothesis, far + step)[0] - prior(hypothesis, far - step)[0]) / (2 * step)
    assert np.maximum(slope, 0.1)[:-2] == pytest.approx(prior(hypothesis, far)[1][:-2], rel=1e-5)


def test_a_third_of_the_frames_is_held_out_in_blocks():
    keep = kept_frames(30)
    assert keep.sum() == 21
    assert not keep[6:9].any()
    assert keep[:6].all()


def test_closed_is_what_is_left_of_the_gap():
    gap = HeldOut(np.full(9, 3.0), np.full(9, 1.5), 1.0, 0.0)
    assert gap.closed == pytest.approx(0.75)
    assert gap.interval(0) == (pytest.approx(0.75), pytest.approx(0.75))
    assert HeldOut(np.ones(3), np.ones(3), 1.0, 0.0).closed == 0.0


def test_what_the_background_shows_counts_whatever_effect_leads_a_little(monkeypatch):
    without_residuals(monkeypatch)
    clip = SimpleNamespace(misfit=lambda fit: 1.0, expected=lambda: 100.0, measured=SimpleNamespace(drawn=False))
    base = SimpleNamespace(data=400.0)
    one = SimpleNamespace(fit=base, lead=22.0, names=("slope",))
    told = signs(clip, SimpleNamespace(base=base, candidates=(one,), pairs=(), freed=None), 0.0)
    assert told.whole == pytest.approx(8.0)
    assert answer(told, [22.0]).kind == "unknown"


def test_two_effects_are_beside_each_other_or_both_forces_by_what_they_change(monkeypatch):
    without_residuals(monkeypatch)
    clip = SimpleNamespace(misfit=lambda fit: 1.0, expected=lambda: 100.0, measured=SimpleNamespace(drawn=False))

    def fitted(*names):
        terms = [SimpleNamespace(name=name, kind=catalogue()[name]) for name in names]
        return SimpleNamespace(
            fit=SimpleNamespace(data=400.0, hypothesis=SimpleNamespace(terms=terms)), lead=9.0, names=names
        )

    def told(*names):
        found = SimpleNamespace(base=fitted().fit, candidates=(fitted(names[0]),), pairs=(fitted(*names),), freed=None)
        return signs(clip, found, 0.0)

    for one, other in (("push", "camera_motion"), ("camera_shake", "drag")):
        assert told(one, other).beside == 1.0
    for one, other in (("push", "drag"), ("camera_shake", "camera_motion"), ("camera_motion", "mask_bias")):
        assert told(one, other).beside == 0.0
    for one, other in (("push", "drag"), ("offset_com", "wind")):
        assert told(one, other).forces == 1.0
    for one, other in (("shape", "wind"), ("camera_motion", "push")):
        assert told(one, other).forces == 0.0


@pytest.mark.parametrize(
    ("name", "behind", "sure"),
    [("mask_bias", 150.0, 1.0), ("mask_bias", 350.0, 0.0), ("dropped_frames", 150.0, 1.0), ("push", 150.0, 0.0)],
)
def test_what_nothing_else_looks_like_is_unmistakable_where_it_leads_by_far(monkeypatch, name, behind, sure):
    without_residuals(monkeypatch)
    clip = SimpleNamespace(misfit=lambda fit: 2.0, expected=lambda: 100.0, measured=SimpleNamespace(drawn=False))
    base = SimpleNamespace(data=400.0)
    one, other = (SimpleNamespace(fit=base, lead=lead, names=(n,)) for lead, n in ((400.0, name), (behind, "shape")))
    assert (
        signs(clip, SimpleNamespace(base=base, candidates=(one, other), pairs=(), freed=None), 0.0).unmistakable == sure
    )


SIGNS = Signs(300.0, 150.0, 0.0, 1.25, 0.8, 10.0, 1.2, 80.0, 1.0)


def changed(changes):
    """Other signs; the best single effect leaves what the best hypothesis does, unless it is said what."""
    return dataclasses.replace(SIGNS, **{"structure_first": changes.get("structure_after", 1.2)} | changes)


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({}, "single"),
        ({"lead": 20.0}, "none"),
        ({"lead": 20.0, "before": 1.65, "drawn": 1.0}, "unknown"),
        ({"lead": 20.0, "before": 1.55, "drawn": 1.0}, "none"),
        ({"lead": 20.0, "before": 1.65, "drawn": 1.0, "structure_before": 0.9}, "none"),
        ({"lead": 20.0, "before": 1.35, "structure_before": 0.9}, "unknown"),
        ({"lead": 20.0, "before": 1.35}, "unknown"),
        ({"lead": 20.0, "before": 1.25}, "none"),
        ({"lead": 20.0, "structure_after": 9.0}, "unknown"),
        ({"lead": 5.0, "whole": 9.0}, "unknown"),
        ({"structure_after": 40.0, "after": 5.0}, "unknown"),
        ({"pair": 200.0}, "pair"),
        ({"pair": 90.0}, "single"),
        ({"lead": 3000.0, "pair": 200.0}, "single"),
        ({"lead": 3000.0, "pair": 200.0, "structure_first": 9.0}, "pair"),
        ({"lead": 3000.0, "pair": 200.0, "structure_first": 1.9}, "single"),
        ({"lead": 3000.0, "pair": 110.0, "structure_first": 9.0}, "pair"),
        ({"pair": 90.0, "structure_first": 9.0}, "unknown"),
        ({"pair": 390.0, "forces": 1.0}, "single"),
        ({"pair": 390.0, "structure_first": 9.0, "forces": 1.0}, "unknown"),
        ({"pair": 410.0, "forces": 1.0}, "pair"),
        ({"pair": 55.0, "structure_first": 9.0}, "unknown"),
        ({"pair": 55.0, "structure_first": 2.5}, "single"),
        ({"pair": 55.0, "structure_first": 9.0, "inimitable": 1.0}, "single"),
        ({"pair": 85.0, "beside": 1.0}, "pair"),
        ({"pair": 75.0, "beside": 1.0}, "single"),
        ({"lead": 55.0, "structure_before": 3.9}, "none"),
        ({"lead": 35.0, "structure_before": 4.1}, "single"),
        ({"lead": 65.0, "structure_before": 1.9}, "single"),
        ({"lead": 50.0, "structure_before": 1.9, "inimitable": 1.0}, "single"),
        ({"lead": 35.0, "structure_before": 9.0, "inimitable": 1.0}, "none"),
        ({"lead": 3000.0, "pair": 200.0, "beside": 1.0}, "pair"),
        ({"lead": 30000.0, "pair": 90.0, "beside": 1.0}, "pair"),
        ({"lead": 30000.0, "pair": 70.0, "beside": 1.0}, "single"),
        ({"pair": 200.0, "structure_after": 1.6, "closed": 0.7}, "unknown"),
        ({"pair": 200.0, "structure_after": 1.6, "closed": 0.9}, "pair"),
        ({"pair": 200.0, "structure_after": 3.1, "closed": 0.9}, "pair"),
        ({"pair": 200.0, "structure_after": 3.3, "closed": 0.9}, "unknown"),
        ({"closed": 0.05, "held_out": 60.0, "inimitable": 1.0}, "single"),
        ({"closed": 0.2}, "unknown"),
        ({"closed": 0.2, "inimitable": 1.0}, "single"),
        ({"closed": 0.05, "held_out": 9.0, "tilted": 1.0}, "single"),
        ({"closed": 0.05, "held_out": 7.0, "tilted": 1.0}, "unknown"),
        ({"closed": 0.2, "held_out": 9.0, "tilted": 1.0}, "single"),
        ({"closed": 0.2, "held_out": 7.0, "tilted": 1.0}, "unknown"),
        ({"closed": 0.05, "lead": 110.0, "structure_before": 1.2, "tilted": 1.0}, "none"),
        ({"structure_after": 3.0, "margin": 30.0, "tilted": 1.0}, "unknown"),
        ({"closed": 0.2, "structure_after": 0.75}, "single"),
        ({"closed": 0.2, "structure_after": 0.75, "structure_first": 0.85}, "unknown"),
        ({"closed": 0.05, "structure_after": 0.75}, "unknown"),
        ({"structure_after": 3.0, "margin": 30.0}, "unknown"),
        ({"structure_after": 3.0, "margin": 30.0, "inimitable": 1.0}, "single"),
        ({"structure_after": 3.5, "margin": 900.0, "inimitable": 1.0}, "unknown"),
        ({"closed": 0.3}, "single"),
        ({"closed": 0.05, "held_out": 20.0, "inimitable": 1.0}, "unknown"),
        ({"after": 2.2}, "unknown"),
        ({"after": 2.2, "unmistakable": 1.0}, "single"),
        ({"structure_after": 9.0, "structure_first": 5.9, "unmistakable": 1.0}, "single"),
        ({"structure_after": 5.9, "unmistakable": 1.0}, "single"),
        ({"structure_first": 6.1, "unmistakable": 1.0}, "unknown"),
        ({"structure_first": 6.1, "unmistakable": 1.0, "pair": 200.0}, "pair"),
        ({"closed": 0.2, "unmistakable": 1.0}, "single"),
        ({"closed": 0.05, "unmistakable": 1.0, "before": 1.9}, "unknown"),
        ({"closed": 0.05, "unmistakable": 1.0, "before": 2.1}, "single"),
        ({"closed": 0.05, "before": 2.1}, "unknown"),
        ({"closed": 0.05, "unmistakable": 1.0, "before": 2.1, "structure_after": 1.4}, "unknown"),
        ({"pair": 200.0, "structure_after": 9.0, "structure_first": 5.9, "unmistakable": 1.0}, "single"),
        ({"pair": 200.0, "unmistakable": 1.0}, "pair"),
        ({"lead": 20.0, "after": 2.2, "unmistakable": 1.0}, "unknown"),
        ({"pair": 200.0, "structure_after": 9.0, "structure_first": 90.0}, "unknown"),
        ({"after": 5.0}, "unknown"),
        ({"lead": 20.0, "after": 2.1}, "unknown"),
        ({"structure_after": 3.0, "margin": 900.0}, "single"),
        ({"structure_after": 3.5, "margin": 900.0}, "unknown"),
        ({"pliant": 1.0, "margin": 900.0, "closed": 0.8}, "unknown"),
        ({"pliant": 1.0, "margin": 900.0, "closed": 0.86}, "single"),
        ({"pliant": 1.0, "structure_after": 3.0, "closed": 0.86}, "unknown"),
        ({"pliant": 1.0, "structure_after": 1.0, "closed": 0.8}, "single"),
        ({"pliant": 1.0, "structure_after": 1.0, "structure_first": 1.2, "closed": 0.8}, "unknown"),
        ({"pliant": 1.0, "pair": 200.0, "closed": 0.8}, "pair"),
        ({"pliant": 1.0, "unnamed": -140.0, "closed": 0.8}, "unknown"),
        ({"pliant": 1.0, "unnamed": -160.0, "closed": 0.8}, "single"),
        ({"pliant": 1.0, "unnamed": -160.0, "structure_after": 3.3, "margin": 900.0}, "unknown"),
        ({"touched": 1.0, "unnamed": -1.0, "structure_after": 3.5, "closed": 0.84}, "unknown"),
        ({"touched": 1.0, "unnamed": -1.0, "structure_after": 3.5, "closed": 0.86}, "single"),
        ({"touched": 1.0, "unnamed": 1.0, "structure_after": 3.5, "closed": 0.86}, "unknown"),
        ({"unnamed": -1.0, "structure_after": 3.5, "closed": 0.86}, "unknown"),
        ({"after": 5.0, "pair": 200.0}, "unknown"),
        ({"closed": 0.05}, "unknown"),
        ({"closed": 0.05, "pair": 200.0}, "unknown"),
        ({"closed": 0.05, "lead": 20.0}, "none"),
        ({"closed": 0.05, "lead": 55.0}, "none"),
        ({"lead": 20.0, "pair": 90.0}, "unknown"),
        ({"lead": 20.0, "pair": 70.0}, "none"),
        ({"closed": 0.05, "lead": 55.0, "structure_after": 1.4}, "unknown"),
        ({"closed": 0.05, "lead": 110.0, "structure_before": 1.2}, "none"),
        ({"closed": 0.05, "lead": 130.0, "structure_before": 1.2}, "unknown"),
        ({"closed": 0.05, "lead": 110.0, "structure_before": 1.4}, "unknown"),
        ({"closed": 0.15, "lead": 110.0, "structure_before": 1.2, "structure_after": 0.7}, "single"),
    ],
)
def test_the_answer_follows_the_signs(changes, kind):
    said = answer(changed(changes), [300.0, 150.0], video=True)
    assert said.kind == kind
    assert 0.0 < said.probability < 1.0
    assert sum(said.shares) == pytest.approx(1.0)
    assert said.shares[0] > said.shares[1]


@pytest.mark.parametrize("changes", [{"after": 5.0}, {"structure_after": 3.5, "margin": 900.0}])
def test_poses_may_err_smoothly_and_more_than_their_noise_says(changes):
    assert answer(dataclasses.replace(SIGNS, **changes), [300.0, 150.0]).kind == "single"
    assert answer(dataclasses.replace(SIGNS, **changes, pair=200.0), [300.0, 150.0]).kind == "pair"
    far = dataclasses.replace(SIGNS, lead=3000.0, pair=200.0, structure_first=9.0)
    assert answer(far, [300.0, 150.0]).kind == "single"


@pytest.mark.parametrize(
    ("changes", "likely"),
    [
        ({}, True),
        ({"pair": 12.0}, True),
        ({"pair": 30.0}, False),
        ({"pair": 30.0, "margin": 900.0}, True),
        ({"pair": 12.0, "margin": 10.0}, False),
        ({"pair": 90.0}, False),
        ({"pair": 200.0}, True),
        ({"after": 5.0}, True),
        ({"lead": 20.0, "held_out": 0.0}, True),
        ({"lead": 20.0, "held_out": 9.0}, False),
        ({"lead": 20.0, "held_out": 0.0, "before": 1.25}, True),
        ({"lead": 20.0, "held_out": 0.0, "before": 1.35}, False),
        ({"lead": 20.0, "held_out": 0.0, "before": 1.65, "drawn": 1.0, "structure_before": 0.9}, False),
    ],
)
def test_an_answer_is_less_likely_where_something_else_gains_as_well(changes, likely):
    said = answer(changed(changes), [300.0, 150.0], video=True)
    least = UNLIKELY_OF_A_VIDEO
    assert said.probability == ((LIKELY if said.kind == "unknown" else LIKELY_OF_A_VIDEO) if likely else least)


def test_levels_of_a_video_are_its_own_and_a_name_is_no_likelier_than_its_effect():
    for changes in ({}, {"closed": 0.05}, {"lead": 20.0, "held_out": 0.0}):
        told = changed(changes)
        of_video, other = answer(told, [300.0, 150.0], video=True), answer(told, [300.0, 150.0])
        assert of_video.kind == other.kind
        expected = LIKELY if of_video.kind == "unknown" else LIKELY_OF_A_VIDEO
        assert of_video.probability == expected >= other.probability == LIKELY
    named, missed = (answer(changed(changes), [300.0, 150.0], video=True) for changes in ({}, {"closed": 0.05}))
    assert named.at_work >= LIKELY_OF_A_VIDEO
    assert missed.at_work < 1 - LIKELY_OF_A_VIDEO + 0.01
    less = [answer(changed({"pair": 30.0}), [300.0, 150.0], video=video) for video in (True, False)]
    assert [one.probability for one in less] == [UNLIKELY_OF_A_VIDEO, UNLIKELY]
    assert [one.at_work for one in less] == [AT_WORK["less"]] * 2


@pytest.mark.parametrize(
    ("second", "closed", "changes", "kind"),
    [
        (310.0, 0.05, {}, "unknown"),
        (310.0, 0.5, {}, "single"),
        (290.0, 0.05, {}, "single"),
        (310.0, 0.05, {"inimitable": 1.0}, "single"),
        (310.0, 0.05, {"inimitable": 1.0, "held_out": 20.0}, "unknown"),
        (310.0, 0.05, {"tilted": 1.0}, "single"),
    ],
)
def test_one_effect_of_two_that_lead_must_close_the_gap_alone(second, closed, changes, kind):
    told = dataclasses.replace(SIGNS, **changes)
    one, two = SimpleNamespace(fit="one", lead=300.0), SimpleNamespace(fit="two", lead=second)
    asked = []
    said = upheld(
        answer(told, [300.0, 150.0], video=True),
        SimpleNamespace(candidates=(one,), pairs=(two,)),
        told,
        lambda fit: asked.append(fit) or closed,
        video=True,
    )
    assert said.kind == kind
    # An effect that contacts do not imitate, or that tilts the world, needs not ask where it gains.
    gains = (told.inimitable and told.held_out > 40.0) or told.tilted
    assert asked == (["one"] if second > 300.0 and not gains else [])


def test_of_poses_what_tilts_the_world_must_close_the_gap_as_well():
    told = dataclasses.replace(SIGNS, closed=0.05, tilted=1.0)
    assert answer(told, [300.0, 150.0], video=True).kind == "single"
    assert answer(told, [300.0, 150.0]).kind == "unknown"


def test_of_two_named_effects_the_better_one_is_the_surer():
    said = answer(dataclasses.replace(SIGNS, pair=200.0), [300.0, 150.0])
    alone = answer(SIGNS, [300.0, 150.0])
    assert alone.at_work > said.of_pair("drag", "drag") == said.at_work > said.probability
    assert said.of_pair("push", "drag") == said.probability


def test_of_two_named_effects_the_one_that_leads_by_itself_comes_first():
    def candidate(*names):
        terms = tuple(term(name, 0 if catalogue()[name].targeted else -1, 10) for name in names)
        return SimpleNamespace(names=names, fit=SimpleNamespace(hypothesis=SimpleNamespace(terms=terms)))

    found = SimpleNamespace(candidates=(candidate("push"), candidate("drag")), pairs=(candidate("slope", "push"),))
    said = Answer("pair", 0.3, (0.9, 0.1), 0.6)
    verdict, best = verdict_of(found, said, ("ball",), ("sphere",))
    assert verdict.effects == ("push", "slope")
    assert best is found.pairs[0]
    assert verdict.sentence.index("ball") < verdict.sentence.index("floor")


def test_an_effect_that_is_not_named_is_hardly_at_work():
    named, silent = (
        answer(SIGNS, [300.0, 150.0]),
        answer(dataclasses.replace(SIGNS, lead=20.0, held_out=0.0), [20.0, 9.0]),
    )
    perhaps, strange = (
        answer(dataclasses.replace(SIGNS, **changes), [20.0, 9.0]) for changes in ({"lead": 20.0}, {"closed": 0.0})
    )
    assert named.at_work > named.probability
    assert [silent.kind, perhaps.kind, strange.kind] == ["none", "none", "unknown"]
    assert silent.at_work < strange.at_work < perhaps.at_work < 0.25


def test_every_kind_proposes_starts_that_a_fit_can_begin_from():
    from mjx_refine.effects.kind import FitView

    batch = batch_with_effects([FLIGHT])
    poses = MujocoSimulator(FLIGHT.shapes, 30.0, 1).rollout(batch, 20)[0]
    velocity = np.gradient(poses[..., :3], axis=0) * 30
    jitter = np.random.default_rng(0).normal(size=(19, 24, 2))
    floor = np.ones((20, 1), bool)
    view = FitView(batch, poses, velocity, 0 * velocity, floor, jitter, ((10.0, 10.0, 50.0, 60.0),), SIZE, 30.0)
    for name, kind in catalogue().items():
        starts = kind.starts(view, 0 if kind.targeted else -1)
        assert starts, name
        for start in starts:
            assert len(start.values) == kind.length(20), name
            low, high = (np.array([getattr(p, side) for p in kind.spread(20)]) for side in ("low", "high"))
            assert (start.values >= low).all(), name
            assert (start.values <= high).all(), name


@pytest.mark.parametrize(
    ("scene", "clip", "words"),
    [
        (dataclasses.replace(FLIGHT, effects=(Effect("drag", "ball"),)), None, "has an effect already"),
        (FLIGHT, 5, "cannot tell from 5 frames"),
        (
            dataclasses.replace(FLIGHT, objects=(dataclasses.replace(BALL, position=(0.9, 3.0, 0.2)),)),
            None,
            "overlaps the clip",
        ),
    ],
)
def test_what_cannot_be_told_is_refused(scene, clip, words):
    with pytest.raises(InputError, match=words):
        diagnose(scene, clip_of(FLIGHT, clip or 12), threads=1)


def test_a_still_clip_is_refused():
    still = Scene(
        (dataclasses.replace(BALL, position=(0.0, 0.3, 0.2), linear_velocity=(0, 0, 0), angular_velocity=(0, 0, 0)),),
        CAMERA,
    )
    with pytest.raises(InputError, match="nothing moves"):
        diagnose(still, clip_of(still, 12), threads=1)


def test_drag_is_named_and_measured():
    given = dataclasses.replace(FLIGHT, objects=(dataclasses.replace(BALL, linear_velocity=(2.7, 0.3, 2.05)),))
    clip = clip_of(dataclasses.replace(FLIGHT, effects=(Effect("drag", "ball", (("quadratic", 0.5),)),)))
    found = diagnose(given, clip, threads=1)
    first = found.candidates[0]
    assert first.effect == "drag"
    assert first.target == "ball"
    assert found.scene.effects
    assert found.gap.after < found.gap.before
    # A force of any course has more numbers and explains no more.
    assert found.signs["unnamed"] < 0
    speed = 2.5
    force = sum(first.parameters[name].value * speed**power for name, power in (("linear", 1), ("quadratic", 2)))
    assert force == pytest.approx(0.5 * speed**2, rel=0.3)
    assert sum(p.share for p in found.where) <= 1.0


@pytest.mark.parametrize("at_work", [0.3, 0.9])
def test_what_leads_is_likelier_at_work_than_what_does_not(at_work):
    shares = (0.6, 0.3, 0.1)
    said = Answer("single", 0.25, shares, at_work)
    told = [said.of(share) for share in shares]
    assert told[0] == at_work
    assert told == sorted(told, reverse=True)
    assert sum(told) <= 1.0 + 1e-9
