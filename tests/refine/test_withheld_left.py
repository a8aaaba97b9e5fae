"""What is left of an effect once the scene has been refitted: the model against the film, widths against draws, files."""

from __future__ import annotations

import contextlib
import json

import numpy as np
import pytest

pytest.importorskip("pybullet", reason="the exam needs the bench extra")

from click.testing import CliRunner

from benchmarks.withheld import __main__ as commands
from benchmarks.withheld import exam, left, masks, physics, plan, refit, solve, start
from benchmarks.withheld.base import Base
from benchmarks.withheld.effect import Effect
from benchmarks.withheld.stage import Stage


def body(kind, name, position, velocity, spin, **size):
    return {
        "type": kind,
        "name": name,
        **size,
        "state": {
            "position": list(position),
            "orientation": [1.0, 0, 0, 0],
            "linear_velocity": list(velocity),
            "angular_velocity": list(spin),
        },
        "physics": {"friction": [0.5, 0.002], "mass": 1.5, "damping": -60.0},
    }


def scene(*objects):
    return [
        *objects,
        {"type": "camera", "fovy": 45.0, "orientation": 45.0, "position": [0.0, -2.0, 3.5]},
        {"type": "gravity", "gravity": [0.0, 0.0, -9.81]},
    ]


BALL = body("sphere", "sphere_0", (-0.8, 0.5, 0.6), (1.5, 0.6, 2.5), (3.0, 2.0, 6.0), radius=0.25)
BOX = body("box", "box_1", (0.9, 1.8, 0.2), (0.0, 0, 0), (0.0, 0, 0), size=[0.3, 0.25, 0.2])
SHAKE = Effect("camera_shake", None, {"yaw": [0.3, -0.3] * 15, "pitch": [0.1, 0.0, -0.1] * 10, "amplitude": 0.2})
DRAG = Effect("drag", 0, {"linear": 0.1, "quadratic": 0.1})


def stage():
    return Stage(scene(BALL, BOX), "flight")


@pytest.mark.parametrize(
    "effects",
    [
        (),
        (SHAKE, Effect("lens_distortion", None, {"k1": 0.1})),
        (Effect("dropped_frames", None, {"frame": 9, "count": 3}),),
        (Effect("shape", 0, {}, {"form": "ellipsoid", "strength": 0.5, "lean": [1.0, -0.8, 0.2]}),),
        (Effect("shrinking", 0, {"rate": 0.5}),),
        (Effect("rolling_shutter", None, {"readout": 0.02}),),
    ],
)
def test_reaches_are_the_outlines(effects):
    film = stage().film(effects)
    np.testing.assert_allclose(refit.reaches(film), film.outlines, atol=1e-9)


def test_flow_is_that_of_the_points():
    film, radius = stage().film((SHAKE,)), np.array([0.25, 0.3])
    flow = refit.flows(film, radius)
    place, turn, _ = film.track.at(film.view.times, 0)
    arm = turn[4].T @ (film.view.turn[4] @ (0.8 * 0.25 * refit.NEAR[1]))
    there = film.view.show(film.track, 0, arm[None], 5) - film.view.show(film.track, 0, arm[None], 4)
    np.testing.assert_allclose(flow[4, 0, 1], there[0], atol=1e-9)
    assert (film.view.turn[4].T @ (place[4] + turn[4] @ arm - film.view.origin[4]))[2] < -0.5  # before the camera


def test_quick_poses_are_the_motion():
    entries = stage().entries
    with physics.engine() as opened:
        opened.run(scene(BALL), (DRAG,), 0.3)
        track, slow = opened.poses(entries, 0.8), physics.simulate(entries, (), 0.8)
    np.testing.assert_array_equal(track.position, slow.position)
    np.testing.assert_array_equal(track.quaternion, slow.quaternion)


@pytest.mark.parametrize(
    "effects",
    [(DRAG,), (DRAG, SHAKE), (Effect("mask_bias", None, {"width": -4.0}),), (Effect("slope", None, {"x": 2, "y": 1}),)],
)
def test_nothing_is_left_of_what_is_known(effects):
    with physics.engine() as opened:
        known = refit.Refit(opened, stage(), effects, effects)
        zero = np.zeros(len(known.base.numbers))
        assert known.ended(zero).cost == pytest.approx(0, abs=1e-12)
        assert refit.Refit(opened, stage(), effects).ended(zero).reach > 1


def test_the_base_moves_as_rough_scenes_do():
    entries = scene(BALL, BOX)
    base, rng = Base(entries), np.random.default_rng(0)
    assert base.at(np.zeros(len(base.numbers))) == entries

    def numbers(drawn):
        camera = next(e for e in drawn if e["type"] == "camera")
        pull = next(e for e in drawn if e["type"] == "gravity")
        out = [camera["orientation"], camera["fovy"], camera["position"][2], pull["gravity"][2]]
        for entry in drawn[:2]:
            state = entry["state"]
            out += [*state["position"], *state["linear_velocity"], *state["angular_velocity"]]
            out += [*np.log(entry["physics"]["friction"]), np.log(-entry["physics"]["damping"])]
        return np.array([*out, drawn[0]["radius"], *drawn[1]["size"]])

    drawn = np.std([numbers(start.rough(entries, rng)) for _ in range(600)], 0)
    moved = np.sqrt(
        np.mean([(numbers(base.at(s)) - numbers(entries)) ** 2 for s in rng.normal(size=(600, len(base.numbers)))], 0)
    )
    told = drawn > 0
    np.testing.assert_allclose(moved[told], drawn[told], rtol=0.15)
    names = {number.name for number in base.numbers}
    assert {"box_1.velocity.x", "box_1.spin.up", "sphere_0.position.z"} <= names
    assert not {"box_1.position.z", "box_1.turn.x", "sphere_0.mass"} & names
    assert "box_1.mass" in {number.name for number in Base(entries, (0, 1)).numbers}


def test_less_gravity_takes_up_part_of_a_drag(monkeypatch):
    for name in ("ANNEALED", "GROWING", "HOPS"):
        monkeypatch.setattr(refit, name, ())
    with physics.engine() as opened:
        alone = Stage(scene(BALL), "flight")
        px = solve.displacement(alone, DRAG, "objects")
        found = left.left(opened, alone, (DRAG,), (), np.random.default_rng(0))
        whole = left.left(opened, alone, (DRAG, SHAKE), (DRAG,), np.random.default_rng(0))
    assert 0 < found["px_left"] == found["reach"] < 0.5 * px
    assert found["background"] == 0
    assert found["shifts"]
    assert found["cost"] == pytest.approx(min(found["costs"]), abs=0.1)
    assert whole["px_left"] == pytest.approx(solve.displacement(alone, SHAKE, "picture"), abs=1e-3)


def test_a_refit_is_carried_along_while_the_effect_grows():
    slope = Effect("slope", None, {"x": 2.0, "y": 1.0})
    with physics.engine() as opened:
        model = refit.Refit(opened, Stage(scene(BALL), "flight"), (slope,))
        zero, whole = np.zeros(len(model.base.numbers)), model.target
        plain = model.seen(zero)
        with model.partly(0.25):
            np.testing.assert_allclose(model.target.reach, 0.75 * plain.reach + 0.25 * whole.reach, atol=1e-9)
            np.testing.assert_allclose(model.target.flow, 0.75 * plain.flow + 0.25 * whole.flow, atol=1e-9)
        assert model.target is whole


def test_a_search_goes_on_as_long_as_it_leads_lower(monkeypatch):
    monkeypatch.setattr(refit, "HOPS", (0.5,))
    lowering = iter([80.0, 60.0, 59.0, 58.0, 57.0, 56.0])

    class Told:
        base = type("Base", (), {"numbers": [0, 0]})

        def descend(self, start, leg):
            return start

        def partly(self, part):
            return contextlib.nullcontext()

        def ended(self, shifts):
            # Starts beside the best end are those that are not at it.
            return refit.Fit(shifts, next(lowering) if shifts.any() else 100.0, 9.0, 9.0)

    end, costs = refit.best(Told(), np.random.default_rng(0), draws=0)  # type: ignore[arg-type]
    # The last is the best end with finer steps; three that were hardly lower have ended the search.
    assert end.cost == 56.0
    assert len([cost for cost in costs if cost < 100]) == 6


def test_least_is_asked_of_every_effect():
    alone = Stage(scene(BALL), "flight")
    pan = Effect("camera_motion", None, {"pan": 2.0, "tilt": 0.0, "x": 0.0, "y": 0.0, "z": 0.0})

    def found(effects, least):
        return left.lefts(alone, effects, least, np.random.default_rng(0))

    floor = left.background(alone, (pan,))
    assert floor > 5
    # No refit is looked for where the floor tells enough.
    assert found((pan,), 5.0) == (floor,)
    # A fall with drag is nearly one with less gravity, whatever moves the camera.
    assert found((pan, DRAG), 5.0) is None
    assert found((pan, DRAG), 0.01) is not None


def test_an_exam_of_effects_that_leave_something(monkeypatch):
    order = plan.orders(3, {"one": 1}, ("drag",), left=3.0)[0]
    assert order.left == 3.0
    asked, tries = [], iter([None, None, (4.5,)])

    def lefts(stage, effects, least, rng):
        asked.append((effects[0].name, least, float(rng.random())))
        return next(tries)

    monkeypatch.setattr(left, "lefts", lefts)
    take, _ = exam.find(order)
    assert take.lefts == (4.5,)
    assert [told[:2] for told in asked] == [("drag", 3.0)] * 3
    assert len({told[2] for told in asked}) == 3
    told = exam.key(order, take, [1])["effects"][0]
    assert told["px_left"] == 4.5
    monkeypatch.setattr(left, "lefts", lambda *_: None)
    monkeypatch.setattr(exam, "ATTEMPTS", 3)
    with pytest.raises(ValueError, match="a refit leaves too little"):
        exam.find(order)


def test_what_an_occluder_hides_is_not_explained():
    film = stage().base
    reach = film.outlines[10, 0]
    low, high = float(-reach[12]), float(reach[4])
    right = float(round(reach[0]))
    effect = Effect("occluder", None, {"left": right - 8, "top": low - 5, "right": right + 30, "bottom": high + 5})
    bites = masks.bites(film, effect)
    assert bites.max() == masks.bitten(film, effect)
    assert bites[:, 1].max() == 0
    with physics.engine() as opened:
        fit = refit.Refit(opened, stage(), (effect,))
        np.testing.assert_allclose(fit.ended(np.zeros(len(fit.base.numbers))).reach, bites.max())


def test_an_exam_is_measured_once(tmp_path):
    alone = Stage(scene(BALL), "flight")
    px = solve.displacement(alone, SHAKE, "picture")
    told = {"effect": SHAKE.name, "target": None, "parameters": SHAKE.parameters, "hidden": {}, "px": round(px, 3)}
    key = {
        "split": "one",
        "effects": [told],
        "kind": "flight",
        "objects": ["sphere_0"],
        "seed": [1, 2],
        "truth": alone.entries,
    }
    folder = tmp_path / "key"
    folder.mkdir()
    (folder / "000.json").write_text(json.dumps({**key, "effects": []}))
    (folder / "001.json").write_text(json.dumps(key))
    (folder / "002.json").write_text(json.dumps({**key, "effects": [{**told, "px": 2 * px}]}))
    done = CliRunner().invoke(commands.main, ["left", str(tmp_path)])
    assert done.exit_code == 1
    assert f"002: camera_shake moves the picture by {px:.3f} px here" in done.output
    assert "1 clips cannot be made again here" in done.output
    found = left.read(tmp_path)
    assert list(found) == ["001"]
    assert found["001"]["effects"][0]["px_left"] == pytest.approx(px, abs=1e-3)
    (folder / "002.json").unlink()
    again = CliRunner().invoke(commands.main, ["left", str(tmp_path)])
    assert (again.exit_code, again.output) == (0, "")
    (folder / "001.json").unlink()
    (folder / "000.json").unlink()
    none = CliRunner().invoke(commands.main, ["left", str(tmp_path)])
    assert none.exit_code == 1
    assert "holds no clip's key" in none.output
