"""Diagnosis from measured poses: files good and bad, noise, times between frames, and known effects from end to end."""

from __future__ import annotations

import dataclasses
import json
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
from own_poses import BALL, CAMERA, GIVEN, SIGMA, THROW, acting, exact, recorded

from mjx_refine import rotations
from mjx_refine.cli.main import run
from mjx_refine.diagnosis import diagnose_poses, load_poses, make_poses
from mjx_refine.diagnosis.fits import chaos
from mjx_refine.diagnosis.fits import fit as fitting
from mjx_refine.diagnosis.fits.candidates import Candidate, Compared
from mjx_refine.diagnosis.fits.fit import ClipFit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.misfit.signs import Signs
from mjx_refine.diagnosis.poses.data import noise_of, rotation_vector
from mjx_refine.diagnosis.poses.diagnose import unsettled
from mjx_refine.diagnosis.poses.fit import PosesFit, at_times, rate_of
from mjx_refine.diagnosis.poses.heldout import kept_samples
from mjx_refine.diagnosis.poses.start import fit_base, poses_space, started
from mjx_refine.diagnosis.poses.where import quiet
from mjx_refine.diagnosis.seen.measure import Parts
from mjx_refine.errors import InputError
from mjx_refine.scene import Body, Effect, Scene, load_scene, save_scene
from mjx_refine.sim.c import MujocoSimulator

TIME = np.arange(12) / 60
POS = np.stack([2.0 * TIME, 0 * TIME, 1.0 - 4.9 * TIME**2], 1)
QUAT = np.tile([1.0, 0.0, 0.0, 0.0], (12, 1))
GOOD = {"time": TIME, "pos": POS, "quat": QUAT}


def spoiled(key: str, at: tuple, value: float) -> dict:
    array = GOOD[key].copy()
    array[at] = value
    return {**GOOD, key: array}


# --- the file ---------------------------------------------------------------------------------------------------------


def test_a_good_file(tmp_path):
    np.savez(tmp_path / "p.npz", **GOOD, sigma_pos=2e-3, sigma_rot=0.02)
    poses = load_poses(tmp_path / "p.npz")
    assert poses.position.shape == (1, 12, 3)
    assert poses.quaternion.shape == (1, 12, 4)
    assert (poses.names, poses.sigma_pos, poses.sigma_rot) == ((), 2e-3, 0.02)


def test_several_objects_have_names():
    poses = make_poses(TIME, np.stack([POS, POS + 1]), np.stack([QUAT, -QUAT]), np.array(["a", "b"]))
    assert poses.names == ("a", "b")
    assert poses.position.shape == (2, 12, 3)


def test_what_was_not_measured_is_nan():
    poses = make_poses(**spoiled("quat", (3, 1), np.nan))
    assert np.isnan(poses.quaternion[0, 3]).all()
    assert np.isfinite(poses.quaternion[0, 4]).all()


BAD = {
    "no time": ({"pos": POS, "quat": QUAT}, "the key 'time' is missing; found pos, quat; add it"),
    "unknown key": ({**GOOD, "position": POS}, "unknown key 'position'; expected time, pos, quat"),
    "time runs back": (spoiled("time", (4,), 0.0), r"time[4] = 0 after 0.05; expected ascending"),
    "time stands": (spoiled("time", (4,), TIME[3]), "expected ascending times"),
    "time unknown": (spoiled("time", (4,), np.nan), "time[4] = nan; expected seconds"),
    "time is long": (spoiled("time", (11,), 1e9), "time[11] = 1e+09; expected seconds within 1e+06"),
    "time of two axes": ({**GOOD, "time": TIME[:, None]}, "time has shape (12, 1); expected (T,)"),
    "one sample": (
        {"time": TIME[:1], "pos": POS[:1], "quat": QUAT[:1]},
        "time has shape (1,); expected (T,) with T >= 2",
    ),
    "texts": ({**GOOD, "time": TIME.astype(str)}, "time has dtype <U"),
    "complex": ({**GOOD, "pos": POS.astype(complex)}, "pos has dtype complex128; expected numbers"),
    "other length": ({**GOOD, "pos": POS[:-1]}, "pos has shape (11, 3); expected (12, 3) for one object"),
    "flat": ({**GOOD, "quat": QUAT[:, :3]}, "quat has shape (12, 3); expected (12, 4)"),
    "no object": ({**GOOD, "pos": POS[None][:0], "quat": QUAT[None][:0]}, "pos has shape (0, 12, 3)"),
    "infinite": (spoiled("pos", (2, 0), np.inf), "pos holds infinities"),
    "millimetres": ({**GOOD, "pos": POS * 1e6}, "pos reaches 1e+06 m; expected at most 10000; write metres"),
    "degrees": (spoiled("quat", (2, 0), 90.0), "quat of object 0 at sample 2 has norm 90; expected a unit quaternion"),
    "zero quaternion": (spoiled("quat", (2, 0), 0.0), "has norm 0; expected a unit quaternion"),
    "nothing": ({**GOOD, "pos": POS * np.nan, "quat": QUAT * np.nan}, "pos and quat are NaN everywhere"),
    "counts differ": ({**GOOD, "pos": np.stack([POS, POS]), "names": ["a", "b"]}, "pos has 2 objects, quat 1"),
    "no names": ({**GOOD, "pos": POS[None], "quat": QUAT[None]}, "names are missing; expected 1 names"),
    "too many names": ({**GOOD, "names": ["a", "b"]}, "names are <U1 (2,); expected 1 texts"),
    "numbers as names": ({**GOOD, "names": [1]}, "names are int64 (1,); expected 1 texts"),
    "names no text": ({**GOOD, "names": np.array([b"\xff"])}, "names are no UTF-8"),
    "twice the name": (
        {**GOOD, "pos": np.stack([POS, POS]), "quat": np.stack([QUAT, QUAT]), "names": ["a", "a"]},
        "names = a, a; expected each once",
    ),
    "negative noise": ({**GOOD, "sigma_pos": -1.0}, "sigma_pos = -1; expected 1e-07 <= sigma_pos <= 10 m"),
    "noise unknown": ({**GOOD, "sigma_rot": np.nan}, "sigma_rot = nan; expected"),
    "noise by sample": ({**GOOD, "sigma_rot": TIME}, "sigma_rot is float64 (12,); expected one number [rad]"),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    save_scene(tmp_path / "scene.yaml", GIVEN)
    monkeypatch.chdir(tmp_path)
    return tmp_path


CALL = ["diagnose", "--init", "scene.yaml", "--poses", "poses.npz", "--out", "out"]


def refused(capsys) -> str:
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("refine: ")
    return err


@pytest.mark.parametrize("name", BAD)
def test_bad_files(name, folder, capsys):
    arrays, says = BAD[name]
    np.savez(folder / "poses.npz", **arrays)
    assert run(CALL) == 2
    told = refused(capsys)
    assert "poses.npz: " in told
    assert says in told
    assert not (folder / "out").exists()


def test_files_that_are_no_poses(folder, capsys):
    assert run(CALL) == 2
    assert "poses.npz: no such file; expected measured poses" in refused(capsys)
    (folder / "poses.npz").write_text("time")
    assert run(CALL) == 2
    assert "not a readable npz" in refused(capsys)
    (folder / "poses.npz").write_bytes(pickle.dumps(GOOD))
    assert run(CALL) == 2
    assert "not a readable npz" in refused(capsys)
    np.savez(folder / "poses.npz", **{**GOOD, "names": np.array([{"ball": 1}], object)})
    assert run(CALL) == 2
    assert "it holds pickled objects" in refused(capsys)
    np.savez(folder / "poses.npz", **GOOD)
    whole = (folder / "poses.npz").read_bytes()
    (folder / "poses.npz").write_bytes(whole[: len(whole) // 2])
    assert run(CALL) == 2
    refused(capsys)


@pytest.mark.parametrize(
    ("arrays", "scene", "says"),
    [
        (GOOD, dataclasses.replace(GIVEN, effects=(Effect("drag", "ball"),)), "has an effect already (drag)"),
        ({**GOOD, "names": ["puck"]}, GIVEN, "names holds 'puck'; expected objects of the scene (ball); rename it"),
        (GOOD, Scene((BALL, dataclasses.replace(BALL, name="b")), CAMERA), "the scene has 2 objects (ball, b)"),
        ({k: v[:8] for k, v in GOOD.items()}, GIVEN, "time has 8 samples; cannot tell from fewer than 9"),
        ({**GOOD, "pos": 0 * POS + 1.0}, GIVEN, "change by less than 5 noise widths"),
        ({**GOOD, "time": np.append(TIME[:-1], 900.0)}, GIVEN, "time spans 900 s"),
    ],
)
def test_what_cannot_be_told(arrays, scene, says):
    with pytest.raises(InputError) as error:
        diagnose_poses(scene, make_poses(**arrays), threads=1)
    assert says in str(error.value)


# --- noise and times --------------------------------------------------------------------------------------------------


def test_noise_is_found_by_third_differences_at_even_and_uneven_times():
    generator = np.random.default_rng(0)
    for time in (np.arange(400) / 100, np.sort(generator.uniform(0, 4, 400))):
        path = np.stack([np.sin(time), 3 * time, -4.9 * time**2], 1) + generator.normal(0, 2e-3, (400, 3))
        turn = np.stack([0 * time, 2 * time, 0 * time], 1)
        quat = rotations.multiply(
            rotations.exponential(turn), rotations.exponential(generator.normal(0, 0.01, (400, 3)))
        )
        place, rot = noise_of(make_poses(time, path, quat))
        assert place[0] == pytest.approx(np.full(3, 2e-3), rel=0.25)
        assert rot[0] == pytest.approx(0.01, rel=0.25)


def test_stated_noise_is_taken():
    place, rot = noise_of(make_poses(**GOOD, sigma_pos=0.02, sigma_rot=0.3))
    assert place.tolist() == [[0.02] * 3]
    assert rot.tolist() == [0.3]


def test_rotation_vectors_invert_the_exponential():
    generator = np.random.default_rng(1)
    v = generator.normal(size=(50, 3))
    v *= (generator.uniform(0, 3.1, 50) / np.linalg.norm(v, axis=1))[:, None]
    v[0] = 0.0
    assert rotation_vector(rotations.exponential(v)) == pytest.approx(v, abs=1e-9)
    assert rotation_vector(-rotations.exponential(v)) == pytest.approx(v, abs=1e-9)


@pytest.mark.parametrize(
    ("step", "rate"), [(1 / 148, 37.0), (1 / 15, 30.0), (1 / 60, 30.0), (1 / 40, 40.0), (1e-3, 1000 / 23), (0.2, 30.0)]
)
def test_the_simulated_rate_is_a_part_or_a_multiple_of_the_measured_one(step, rate):
    assert rate_of(np.arange(20) * step) == pytest.approx(rate)


def test_between_frames_flight_is_exact():
    coarse, fine = exact(THROW, 37.0, 16), exact(THROW, 148.0, 61)
    position, turn = at_times(coarse[None], np.arange(61) / 4)
    # Semi-implicit steps of another length are an eighth of a frame's fall apart, which grows with time.
    late = 0.5 * 9.81 * (1 / (37 * 8) - 1 / (148 * 8)) * np.arange(61) / 148
    assert position[0, :, 0, :2] == pytest.approx(fine[:, 0, :2], abs=1e-9)
    assert position[0, :, 0, 2] + late == pytest.approx(fine[:, 0, 2], abs=1e-6)
    assert np.abs((turn[0, :, 0] * fine[:, 0, 3:]).sum(-1)) == pytest.approx(np.ones(61), abs=1e-6)


def test_a_perfect_simulation_at_uneven_times_leaves_nothing():
    fine = exact(THROW, 800.0, 561)  # it lands later
    chosen = np.sort(np.random.default_rng(2).choice(np.arange(10, 561), 60, replace=False))
    chosen[0] = 0
    poses = make_poses(chosen / 800, fine[chosen, 0, :3], fine[chosen, 0, 3:], sigma_pos=1e-3, sigma_rot=0.01)
    scene = started(GIVEN, poses, (0,))
    clip = PosesFit(MujocoSimulator(scene.shapes, rate_of(poses.time), 1), poses, (0,))
    fit = fit_base(clip, poses_space(scene), 0)
    assert clip.misfit(fit) < 0.5
    found = fit.hypothesis.scene(fit.z, clip.frames).objects[0]
    assert found.linear_velocity == pytest.approx((3.0, 0.3, 2.5), abs=0.02)


@pytest.mark.parametrize("every", [1, 3])
def test_what_is_held_out_changes_nothing_of_what_is_kept(every):
    """Samples are not frames: of one in three frames, the last that is kept lies far beyond a frame of its number."""
    poses = recorded(THROW, 45.0, 1.2)
    poses = make_poses(poses.time[::every], poses.position[0, ::every], poses.quaternion[0, ::every], source="sparse")
    clip = PosesFit(MujocoSimulator(THROW.shapes, rate_of(poses.time), 1), poses, (0,))
    hypothesis = Hypothesis(poses_space(THROW))
    z = np.full((1, hypothesis.dimension), 0.1)
    keep = np.arange(len(poses.time)) < 0.6 * len(poses.time)
    white = clip.residuals(hypothesis, z)[0]
    np.testing.assert_array_equal(clip.residuals(hypothesis, z, keep)[0], white * clip.measured.kept(keep))


def test_what_impacts_excuse_is_told_all_the_same():
    poses = recorded(THROW, span=0.4)
    scene = started(GIVEN, poses, (0,))
    clip = PosesFit(MujocoSimulator(scene.shapes, rate_of(poses.time), 1), poses, (0,))
    far = dataclasses.replace(scene, objects=(dataclasses.replace(scene.objects[0], position=(-0.9, 0.4, 1.0)),))
    fit = clip.at(Hypothesis(poses_space(far)), np.zeros(poses_space(far).dimension))
    assert "what impacts may err, which here is much: ball is off by 1" in quiet(clip, fit)


def test_of_poses_more_is_excused_than_of_videos(monkeypatch):
    poses = recorded(THROW, span=0.4)
    scene = started(GIVEN, poses, (0,))

    def widened(allow) -> np.ndarray:
        clip = PosesFit(MujocoSimulator(scene.shapes, rate_of(poses.time), 1), poses, (0,))
        fit = clip.at(Hypothesis(poses_space(scene)), np.full(poses_space(scene).dimension, 0.3))
        allow(clip, fit)
        return np.sqrt(clip.noise.moments**2 - clip.measured.moment_noise**2)

    everything = Parts(np.full((1, 1), 1e9), np.full((1, 1), 1e9), np.full((1, 1, 3), 1e9), None)
    monkeypatch.setattr(fitting, "jaggedness", lambda told: everything)
    of_poses = widened(lambda clip, fit: clip.allow_chaos(fit, 0))
    of_videos = widened(lambda clip, fit: ClipFit.allow_chaos(clip, fit, 0))
    assert of_videos.max() > 0.0
    assert of_poses == pytest.approx(2.0 / chaos.EXCUSED * of_videos)


def test_the_start_is_taken_from_the_first_samples():
    body = started(GIVEN, recorded(THROW), (0,)).objects[0]
    assert body.position == pytest.approx(BALL.position, abs=3e-3)
    assert body.linear_velocity == pytest.approx(BALL.linear_velocity, abs=0.3)
    assert body.angular_velocity == pytest.approx(BALL.angular_velocity, abs=0.6)


def test_the_space_has_no_camera_and_gravity_is_nearly_known():
    space = poses_space(THROW)
    assert not [name for name in space.names if name.startswith("camera")]
    (gravity,) = (p for p in space.parameters if p.name == "gravity")
    assert (gravity.low, gravity.start, gravity.high) == pytest.approx((9.6138, 9.81, 10.0062))


def test_a_scene_without_gravity_has_none():
    assert "gravity" not in poses_space(dataclasses.replace(THROW, gravity=(0.0, 0.0, 0.0))).names


def test_held_out_blocks_last_a_tenth_of_a_second():
    keep = kept_samples(np.arange(148) / 148)
    lengths = np.diff(np.nonzero(np.diff(keep.astype(int)))[0])
    assert ((lengths >= 14) & (lengths <= 30)).all()
    assert 0.6 < keep.mean() < 0.75
    assert kept_samples(np.arange(9) / 15.0).tolist() == [True] * 6 + [False] * 3


def test_leads_do_not_grow_where_the_noise_is_overstated():
    fit = SimpleNamespace(evidence=0.0)
    compared = Compared(fit, (Candidate(fit, 20.0, 0.0),), (), 0)
    told = Signs(20.0 / 0.3, 10.0 / 0.3, 0.0, 0.1, 0.1, 1.0, 1.0, 3.0 / 0.3, 1.0)
    plain = unsettled(told, compared)
    assert (plain.lead, plain.margin, plain.held_out) == pytest.approx((20.0, 10.0, 3.0))
    assert unsettled(plain, compared) == plain
    assert unsettled(dataclasses.replace(told, lead=5.0), compared).lead == 5.0
    assert unsettled(told, Compared(fit, (), (), 0)) == told


# --- from end to end --------------------------------------------------------------------------------------------------


def test_nothing_is_missing_from_the_base_model():
    found = diagnose_poses(GIVEN, recorded(THROW), threads=1)
    assert found.verdict.effects == ()
    assert found.gap.before < 1.2
    assert found.gap.position_before == pytest.approx(SIGMA[0] * np.sqrt(3), rel=0.3)
    assert found.where == ()
    assert found.residual == "Nothing above the measurement's noise."


QUICK = ("offset_com", "hidden_obstacle", "friction_patch", "magnus")
"""Left out of the catalogue to save time; the slow test has all."""


@pytest.mark.parametrize(
    ("scene", "name", "values"),
    [
        (acting("drag", quadratic=0.02), "drag", {"quadratic": 0.02}),
        (acting("wind", None, x=3.0, y=-2.0), "wind", {"x": 3.0, "y": -2.0}),
    ],
)
def test_an_effect_is_named_and_measured(scene, name, values):
    poses = recorded(scene, 60.0, 0.5)
    found = diagnose_poses(GIVEN, poses, threads=1, without=QUICK)
    first = found.candidates[0]
    assert (found.verdict.effects, first.effect) == ((name,), name)
    if name == "wind":
        for key, value in values.items():
            assert first.parameters[key].value == pytest.approx(value, rel=0.1)
    else:
        speed = 3.5
        force = sum(first.parameters[k].value * speed**p for k, p in (("linear", 1), ("quadratic", 2)))
        assert force == pytest.approx(0.02 * speed**2, rel=0.15)
    assert found.gap.closed > 0.7
    assert found.gap.position_after < found.gap.position_before
    assert found.where[0].phase == "flight"
    assert found.where[0].channel == "motion"
    assert " mm and " in found.residual
    assert {c.effect for c in found.candidates}.isdisjoint({"camera_roll", "mask_bias", "shape", "occluder", *QUICK})


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("scene", "name"),
    [
        (acting("drag", quadratic=0.02), "drag"),
        (acting("wind", None, x=10.0, y=-8.0), "wind"),
        (acting("push", time=0.4, x=0.05, y=0.05), "push"),
        (THROW, None),
    ],
)
def test_every_effect_competes(scene, name, seed):
    found = diagnose_poses(GIVEN, recorded(scene, 148.0, 0.9, seed), threads=1)
    assert found.verdict.effects == (() if name is None else (name,))


def test_files_of_a_diagnosis(folder):
    two = Scene((BALL, Body("box", "crate", (0.2, 0.2, 0.1), (1.5, 0.5, 0.1))), CAMERA)
    save_scene("two.yaml", two)
    poses = recorded(THROW, 60.0, 0.4)
    np.savez("poses.npz", time=poses.time, pos=poses.position[0], quat=poses.quaternion[0], names=["ball"])
    call = ["diagnose", "--init", "two.yaml", *CALL[3:], "--threads", "1"]
    for name in (*QUICK, "push", "slope"):
        call += ["--without", name]
    assert run(call) == 0
    numbers = json.loads((folder / "out/diagnosis.json").read_text())
    assert numbers["verdict"]["effects"] == []
    assert numbers["gap"]["iou_before"] is None
    assert numbers["gap"]["position_before"] == pytest.approx(1.8e-3, rel=0.5)
    assert numbers["call"]["poses"] == "poses.npz"
    assert any("not on poses" in note for note in numbers["notes"])
    assert any("No poses of crate" in note for note in numbers["notes"])
    assert numbers["map"]["before"][1] == [None] * len(numbers["map"]["before"][1])
    page = (folder / "out/report.html").read_text()
    assert "ball: position error" in page
    assert "Position error" in page
    assert "IoU" not in page
    assert load_scene("out/diagnosed.yaml").names == ("ball", "crate")
    assert run([*call, "--resume"]) == 0
