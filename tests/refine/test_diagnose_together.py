"""Diagnosis of several recordings of one set-up: the joint least squares against plain ones, and known effects end to end."""

from __future__ import annotations

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
from own_poses import BALL, CAMERA, GIVEN, THROW, recorded

from mjx_refine.cli.main import run
from mjx_refine.diagnosis import Poses, diagnose_poses
from mjx_refine.diagnosis.fits.fit import prior
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, term
from mjx_refine.diagnosis.fits.pace import STEPS
from mjx_refine.diagnosis.joint.answer import no_better_than_one
from mjx_refine.diagnosis.joint.arrow import Arrow
from mjx_refine.diagnosis.joint.fit import Clips
from mjx_refine.diagnosis.joint.heldout import Foretold, Outside, early_part, foretell, split
from mjx_refine.diagnosis.joint.hypothesis import JointHypothesis, common_scenes, with_frozen_setup
from mjx_refine.diagnosis.joint.recordings import Recordings
from mjx_refine.diagnosis.joint.slack import GRID, with_slackness
from mjx_refine.errors import InputError
from mjx_refine.scene import Body, Effect, Scene, load_scene, save_scene

SLOW = ("offset_com", "hidden_obstacle", "friction_patch", "magnus", "slope")
"""Left out of the catalogue to save time."""

DRAG = Effect("drag", "ball", (("quadratic", 0.006),))


def throws(count: int, *effects: Effect, rate: float = 74.0, span: float = 0.6) -> list[Poses]:
    """Recordings of one ball thrown in different ways."""
    generator = np.random.default_rng(5)
    made = []
    for k in range(count):
        velocity = (np.array([2.0, 0.0, 2.0]) + generator.normal(0, [1.0, 1.0, 0.5])).tolist()
        spin = generator.normal(0, 4, 3).tolist()
        ball = dataclasses.replace(BALL, linear_velocity=tuple(velocity), angular_velocity=tuple(spin))
        one = recorded(dataclasses.replace(THROW, objects=(ball,), effects=effects), rate, span + 0.05 * k, k)
        made.append(dataclasses.replace(one, source=f"throw_{k}.npz"))
    return made


@pytest.fixture(scope="module")
def set_up() -> Recordings:
    return Recordings([GIVEN] * 3, throws(3, DRAG), 1)


def joint(set_up: Recordings, *names: str) -> JointHypothesis:
    told = JointHypothesis(tuple(Hypothesis(space) for space in set_up.spaces))
    for name in names:
        told = told.added(term(name, 0, 30, width=np.full(2, 0.05)))
    return told


# --- the algebra ------------------------------------------------------------------------------------------------------


def arrow(seed: int, sizes=(3, 5, 4)) -> tuple[Arrow, np.ndarray]:
    """An arrow of a shared block of 2 and clips of several sizes, and the same matrix whole."""
    generator = np.random.default_rng(seed)
    masks = tuple(np.isin(np.arange(n + 2), generator.permutation(n + 2)[:2]) for n in sizes)
    parts = [a @ a.T for a in (generator.normal(size=(n + 2, n + 3)) for n in sizes)]
    diagonal = generator.uniform(0.1, 1.0, 2 + sum(sizes))
    whole = np.diag(diagonal)
    first = 2
    for part, mask in zip(parts, masks, strict=True):
        index = np.empty(len(mask), int)
        index[mask], index[~mask] = np.arange(2), np.arange(first, first + (~mask).sum())
        whole[np.ix_(index, index)] += part
        first += int((~mask).sum())
    return Arrow.of(parts, masks, diagonal), whole


@pytest.mark.parametrize("seed", range(3))
def test_an_arrow_is_solved_as_the_whole_matrix(seed):
    told, whole = arrow(seed)
    right = np.random.default_rng(seed).normal(size=(len(whole), 3))
    assert told.solve(right) == pytest.approx(np.linalg.solve(whole, right), rel=1e-8, abs=1e-9)
    assert told.solve(right[:, 0]) == pytest.approx(np.linalg.solve(whole, right[:, 0]), rel=1e-8, abs=1e-9)
    assert told.logdet == pytest.approx(np.linalg.slogdet(whole)[1])
    assert told.diagonal == pytest.approx(np.diag(whole))
    assert np.linalg.inv(told.schur) == pytest.approx(np.linalg.inv(whole)[:2, :2])


def test_an_arrow_with_fixed_coordinates():
    told, whole = arrow(1)
    free = np.ones(len(whole), bool)
    free[[0, 4, 9]] = False
    right = np.where(free, np.arange(len(whole), dtype=float), 0.0)
    solved = told.only(free).solve(right)
    assert solved[~free] == pytest.approx(0.0)
    assert solved[free] == pytest.approx(np.linalg.solve(whole[np.ix_(free, free)], right[free]))


def test_clips_share_the_set_up_and_own_their_starts(set_up):
    told = joint(set_up, "drag")
    names = np.array(told.space.names)
    assert set(names[told.masks[0][: len(names)]]) == {
        "ball.radius",
        "ball.friction.sliding",
        "ball.friction.rolling",
        "ball.damping",
        "gravity",
    }
    assert told.count == 5 + 2
    assert told.dimension == 7 + 3 * 9
    z = np.arange(told.dimension, dtype=float)
    parts = told.split(z)
    assert told.joined(parts) == pytest.approx(z)
    assert [part[mask].tolist() for part, mask in zip(parts, told.masks, strict=True)] == [list(range(7))] * 3
    owned = np.concatenate([part[~mask] for part, mask in zip(parts, told.masks, strict=True)])
    assert sorted(owned) == list(range(7, told.dimension))
    bare = joint(set_up)
    grown = told.grown(bare.joined(bare.split(np.arange(32.0))), np.array([-1.0, -2.0]))
    assert grown[told.ordinary] == pytest.approx(np.arange(32.0))
    assert told.values(grown[None], 0)[0] == pytest.approx([0.0, 0.0])  # below the bounds


def test_a_frozen_set_up_leaves_the_start(set_up):
    part = joint(set_up, "drag").parts[0]
    z = np.random.default_rng(0).uniform(0.0, 0.5, part.dimension)
    own = with_frozen_setup(part, z)
    mask = joint(set_up, "drag").masks[0]
    assert own.dimension == int((~mask).sum())
    for a, b in zip(_arrays(own.batch(z[~mask][None])), _arrays(part.batch(z[None])), strict=True):
        assert a == pytest.approx(b, rel=1e-9, abs=1e-12)


def _arrays(batch) -> list[np.ndarray]:
    return [batch.size, batch.friction, batch.position, batch.linear_velocity, batch.gravity, batch.effects[0].values]


def test_scenes_of_a_set_up_become_one():
    box = Body("box", "crate", (0.2, 0.3, 0.1), (0.0, 0.0, 0.1), friction=(0.2, 0.01))
    others = [
        dataclasses.replace(box, size=(0.2, 0.3, h), position=(x, 0.0, h), friction=(f, 0.01))
        for h, x, f in ((0.1, 0.0, 0.2), (0.12, 1.0, 0.5), (0.2, 2.0, 0.3))
    ]
    told = common_scenes([Scene((b,), CAMERA, (0.0, 0.0, g)) for b, g in zip(others, (-9.0, -9.5, -12.0), strict=True)])
    assert {(s.objects[0].size, s.objects[0].friction, s.gravity) for s in told} == {
        ((0.2, 0.3, 0.12), (0.3, 0.01), (0.0, 0.0, -9.5))
    }
    assert [s.objects[0].position for s in told] == [(x, 0.0, pytest.approx(0.12)) for x in (0.0, 1.0, 2.0)]


# --- least squares ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("names", [(), ("drag",)])
def test_joint_residuals_and_derivatives_are_the_clips_own(set_up, names):
    clips, told = Clips(set_up.clips), joint(set_up, *names)
    z = np.random.default_rng(3).uniform(-0.2, 0.2, (2, told.dimension))
    z = np.clip(z, *told.bounds)
    rows, costs = clips.residuals(told, z)
    halves = 0.0
    for clip, part, row, at in zip(set_up.clips, told.parts, rows, told.split(z), strict=True):
        alone, _ = clip.residuals(part, at)
        assert row == pytest.approx(alone, rel=1e-6, abs=1e-6)
        halves = halves + 0.5 * (alone**2).sum(1)
    price = prior(told, z)[0]  # type: ignore[arg-type]
    assert costs == pytest.approx(halves + 0.5 * (price**2).sum(1), rel=1e-6)
    base = [row[0] for row in rows]
    for clip, part, at, jacobian in zip(
        set_up.clips, told.parts, told.split(z[0]), clips.jacobians(told, z[0], base, [STEPS[0]] * 3), strict=True
    ):
        assert jacobian == pytest.approx(clip.jacobian(part, at), rel=1e-4, abs=1e-3)


def test_joint_evidence_of_one_clip_is_the_clips_own(set_up):
    clip, space = set_up.clips[0], set_up.spaces[0]
    alone = clip.at(Hypothesis(space), np.zeros(space.dimension))
    told = JointHypothesis((Hypothesis(space),))
    fit = Clips([clip]).at(told, np.zeros(told.dimension))
    assert fit.cost == pytest.approx(alone.cost)
    assert fit.evidence == pytest.approx(alone.evidence)
    assert fit.gradient[told.index[0]] == pytest.approx(alone.gradient)


def test_a_joint_fit_finds_what_its_clips_share(set_up):
    clips, told = Clips(set_up.clips), joint(set_up, "drag")
    fit = clips.hop(clips.fit(told, np.zeros(told.dimension), 20), 0, 1)
    assert clips.misfit(fit) == pytest.approx(1.0, abs=0.3)
    linear, quadratic = told.values(fit.z[None], 0)[0]
    assert linear * 3 + quadratic * 9 == pytest.approx(0.006 * 9, rel=0.2)
    assert clips.misfit(clips.fit(joint(set_up), np.zeros(told.dimension - 2), 20)) > 1.5


def test_contacts_that_do_not_err_get_no_slack():
    told = Recordings([GIVEN] * 2, throws(2, rate=74.0, span=0.9), 1)
    clips, base = Clips(told.clips), joint(told)
    fit = clips.fit(base, np.zeros(base.dimension), 15)
    assert sum(clip.allow_slack(part) for clip, part in zip(clips.clips, fit.parts, strict=True)) > 0
    best, slackness = with_slackness(clips, fit)
    assert slackness == 0.0
    assert GRID[-1] == 1.0
    assert [clip.slackness for clip in clips.clips] == [0.0, 0.0]
    assert clips.misfit(best) == pytest.approx(1.0, abs=0.3)


# --- held-out clips ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "judged"), [(2, 1), (3, 1), (4, 2), (9, 4), (40, 20)])
def test_half_of_the_clips_are_judged(count, judged):
    fitted, others = split(count, 7)
    assert len(others) == judged
    assert sorted(fitted + others) == list(range(count))
    assert fitted[0] == 0
    assert split(count, 7) == (fitted, others)
    assert count < 9 or len({split(count, seed) for seed in range(6)}) > 1


def test_what_is_foretold_was_not_seen():
    one = throws(1)[0]
    late = one.time > one.time[0] + 0.4 * (one.time[-1] - one.time[0])
    moved = dataclasses.replace(one, position=one.position + np.where(late[:, None], 0.03, 0.0), sigma_pos=1e-3)
    told = []
    for poses in (dataclasses.replace(one, sigma_pos=1e-3), moved):
        set_up = Recordings([GIVEN], [poses], 1)
        part = Hypothesis(set_up.spaces[0])
        early = early_part(set_up.clips[0].time)
        assert early.tolist() == (~late).tolist()
        told.append(foretell(set_up.clips[0], part, np.zeros(part.dimension), early, 0))
    assert np.array_equal(told[0].fit.z, told[1].fit.z)
    assert told[0].error < 2.0
    assert told[1].error > 15.0
    assert told[0].likelihood > told[1].likelihood + 100
    assert told[0].energy.shape == (late.sum(),)
    assert 1.0 < told[0].floor < 2.0


def foretold(error: float, likelihood: float) -> Foretold:
    return Foretold(None, np.full(6, error**2), likelihood, 1.0)  # type: ignore[arg-type]


def test_the_gap_of_held_out_clips():
    before = tuple(foretold(e, 0.0) for e in (5.0, 9.0, 100.0))
    after = tuple(foretold(e, g) for e, g in ((1.0, 8.0), (3.0, 9.0), (100.0, -1.0)))
    told = Outside(before, after)
    assert told.numbers == pytest.approx((9.0, 3.0, 1.0))
    assert told.closed == pytest.approx(6.0 / 8.0)
    low, high = told.interval(0)
    assert low <= told.closed <= high
    assert told.gains.tolist() == [8.0, 9.0, -1.0]
    assert not told.sure(0)  # a third of the clips loses
    assert Outside(before[:2], after[:2]).sure(0)
    assert not Outside(before[1:], after[1:]).sure(0)


@pytest.mark.parametrize(("gain", "refuted"), [(30.0, True), (50.0, True), (51.0, False)])
def test_a_second_effect_that_foretells_nothing_more_is_refuted(gain, refuted):
    """However much more two effects explain of the fitted clips, of the others one alone foretells as much."""
    before = (foretold(5.0, 0.0), foretold(9.0, 0.0))

    def judged(likelihood: float) -> Outside:
        return Outside(before, (foretold(2.0, 10.0), foretold(3.0, likelihood - 10.0)))

    two, one, third = (SimpleNamespace(names=names) for names in (("wind", "shape"), ("wind",), ("drag",)))
    outside = [(one, judged(50.0)), (third, judged(400.0)), (two, judged(gain))]
    assert no_better_than_one(two, outside[2][1], outside) == refuted  # type: ignore[arg-type]
    assert not no_better_than_one(one, outside[0][1], outside)  # type: ignore[arg-type]


# --- from end to end --------------------------------------------------------------------------------------------------


def test_an_effect_that_all_share_is_named_and_foretells_the_others():
    found = diagnose_poses(GIVEN, throws(4, DRAG), threads=1, without=(*SLOW, "wind"))
    assert found.verdict.effects == ("drag",)
    first = found.candidates[0]
    force = sum(first.parameters[k].value * 3.0**p for k, p in (("linear", 1), ("quadratic", 2)))
    assert force == pytest.approx(0.006 * 9, rel=0.2)
    assert found.gap.closed > 0.5
    assert found.gap.position_after < 0.7 * found.gap.position_before
    assert [one.fitted for one in found.clips].count(True) == 2
    judged = [one for one in found.clips if not one.fitted]
    assert all(one.gain > 0 and one.after < one.before for one in judged)
    assert all(one.source in found.gap.held_out for one in judged)
    assert {place.clip for place in found.where} <= {k for k, one in enumerate(found.clips) if one.fitted}


def test_nothing_is_missing_from_the_base_model():
    found = diagnose_poses([GIVEN] * 3, throws(3), threads=1, without=SLOW)
    assert found.verdict.effects == ()
    assert found.gap.before < 2.5


@pytest.mark.slow
def test_what_happens_in_one_clip_alone_is_not_named():
    push = Effect("push", "ball", (("time", 0.25), ("x", 0.1), ("y", 0.1)))
    odd = throws(4, push)
    plain = throws(4)
    fitted, _ = split(4, 0)
    mixed = [odd[k] if k == fitted[1] else plain[k] for k in range(4)]
    found = diagnose_poses(GIVEN, mixed, threads=1, without=SLOW)
    assert set(found.verdict.effects) <= {"unknown"}
    assert "push" not in {c.effect for c in found.candidates}


OTHER = Scene((dataclasses.replace(BALL, name="puck"),), CAMERA)
BOX = Scene((Body("box", "ball", (0.1, 0.1, 0.1), (0.0, 0.0, 1.0)),), CAMERA)


@pytest.mark.parametrize(
    ("scenes", "chosen", "says"),
    [
        ([GIVEN, GIVEN], (0, 1, 2), "2 scenes and 3 recordings; expected as many of each, or one scene for all"),
        ([GIVEN, OTHER], (0, 1), "scene 2 of 2 holds puck (sphere); expected the objects of the first, ball (sphere)"),
        ([GIVEN, BOX], (0, 1), "scene 2 of 2 holds ball (box)"),
        ([GIVEN], (0, 1, 0), "throw_0.npz: the same clip as throw_0.npz; expected different ones"),
        (
            [dataclasses.replace(GIVEN, effects=(DRAG,))],
            (0, 1),
            "scene: it has an effect already (drag)",
        ),
    ],
)
def test_what_cannot_be_told(scenes, chosen, says):
    recordings = throws(3)
    with pytest.raises(InputError) as error:
        diagnose_poses(scenes, [recordings[k] for k in chosen], threads=1)
    assert says in str(error.value)


def test_files_of_a_diagnosis_of_several(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_scene("scene.yaml", GIVEN)
    call = ["diagnose", "--init", "scene.yaml", "--out", "out", "--threads", "1"]
    for k, one in enumerate(throws(3, DRAG, span=0.5)):
        np.savez(f"{k}.npz", time=one.time, pos=one.position[0], quat=one.quaternion[0])
        call += ["--poses", f"{k}.npz"]
    for name in (*SLOW, "push"):
        call += ["--without", name]
    assert run(call) == 0
    numbers = json.loads((tmp_path / "out/diagnosis.json").read_text())
    assert numbers["call"]["poses"] == ["0.npz", "1.npz", "2.npz"]
    assert [one["source"] for one in numbers["clips"]] == ["0.npz", "1.npz", "2.npz"]
    assert sorted(one["role"] for one in numbers["clips"]) == ["fitted", "fitted", "judged"]
    assert all("noise_floor" in one for one in numbers["clips"] if one["role"] == "judged")
    assert all(place["clip"] in (0, 1, 2) for place in numbers["where"])
    page = (tmp_path / "out/report.html").read_text()
    assert "3 recordings" in page
    assert "judged" in page
    assert load_scene("out/diagnosed.yaml").names == ("ball",)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "diagnosed.yaml",
        "diagnosis.json",
        "report.html",
    ]
