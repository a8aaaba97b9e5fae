"""Effects beyond our own rollouts: entries of scene files, plugins, a tilted parameter space, the other backends, export."""

from __future__ import annotations

import dataclasses
import importlib.metadata

import mujoco
import numpy as np
import pytest
import yaml
from effect_scenes import BALL, CAMERA, FPS, GRAVITY, effect, rolled_out

from mjx_refine import rotations
from mjx_refine.cli.main import run
from mjx_refine.effects import EffectKind, EffectParameter, batch_with_effects, catalogue
from mjx_refine.effects.registry import ENTRY_POINT
from mjx_refine.errors import InputError
from mjx_refine.export import export_xml
from mjx_refine.observation import load_observation
from mjx_refine.scene import Body, Scene, load_scene
from mjx_refine.scene.write import dump_scene, save_scene
from mjx_refine.sim import backends
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.simulate import simulate
from mjx_refine.space import Space

# Entries of scene files -------------------------------------------------------------------------------------------------

SCENE = Scene(
    (
        Body("sphere", "ball", (0.25,), (-0.6, 0.3, 0.8), (1.0, 0.0, 0.0, 0.0), (2.5, 0.0, 1.0), (0.0, 0.0, 20.0)),
        Body("box", "crate", (0.3, 0.2, 0.2), (0.7, 0.2, 0.2), linear_velocity=(-2.0, 0.5, 0.0)),
    ),
    CAMERA,
)
EVERY = (
    effect("drag", "ball", linear=0.1, quadratic=0.2),
    effect("magnus", "ball", coefficient=0.1),
    effect("wind", x=10.0, y=3.0),
    effect("push", "crate", time=0.05, x=1.0, z=2.0),
    effect("slope", x=3.0, y=-2.0),
    effect("friction_patch", x=0.5, y=0.2, radius=0.4, friction=1.5),
    effect("offset_com", "crate", x=0.05, z=0.03),
    effect("hidden_obstacle", "crate", angle=0.0, distance=0.2),
    effect("camera_motion", pan=10.0, tilt=-5.0, x=0.3),
    effect("camera_shake", yaw=[0.0, 0.5, -0.5, 0.2], pitch=[0.0, 0.1, 0.4, -0.3]),
    effect("camera_roll", angle=7.0),
    effect("lens_distortion", k1=-0.2),
    effect("rolling_shutter", readout=0.015),
    effect("dropped_frames", frame=2, count=1),
    effect("mask_bias", width=1.5),
    effect("occluder", left=20, top=5, right=30, bottom=40),
    effect("shape", "crate", bulge=[0.02] * 21),
)


def test_every_kind_is_tried():
    assert {e.effect for e in EVERY} == set(catalogue())


@pytest.mark.parametrize("entry", EVERY, ids=lambda e: e.effect)
def test_files_hold_every_effect_and_are_simulated(tmp_path, entry):
    scene, out = dataclasses.replace(SCENE, effects=(entry,)), tmp_path / "clip.npz"
    path = save_scene(tmp_path / "scene.yaml", scene)
    assert load_scene(path) == scene
    assert run(["simulate", str(path), "--out", str(out), "--size", "48x32", "--frames", "5"]) == 0
    told, plain = load_observation(out), simulate(SCENE, (48, 32), 5)
    assert told.masks is not None
    assert plain.masks is not None
    assert (told.masks != plain.masks).any() or (np.abs(told.flow - plain.flow) > 0.01).any()
    assert np.isfinite(told.flow).all()
    assert (told.masks > 0).any()
    again = simulate(scene, (48, 32), 5)
    # Files hold half precision.
    np.testing.assert_array_equal(again.flow.astype(np.float16), told.flow.astype(np.float16))


@pytest.mark.parametrize("name", [e.effect for e in EVERY if e.effect not in ("occluder", "friction_patch")])
def test_an_effect_of_no_size_changes_nothing(name):
    given = next(e for e in EVERY if e.effect == name)
    nought = {
        "push": {"time": 0.05},
        "hidden_obstacle": {"angle": 0.0, "distance": -50.0},
        "dropped_frames": {"frame": 2, "count": 0},
    }
    entry = effect(name, given.target, **nought.get(name, {"bulge": [0.0] * 21} if name == "shape" else {}))
    told, plain = simulate(dataclasses.replace(SCENE, effects=(entry,)), (48, 32), 4), simulate(SCENE, (48, 32), 4)
    assert told.masks is not None
    assert plain.masks is not None
    # An outline that an effect might change is drawn by its tangents: a pixel of the edge may fall to the other side.
    assert (told.masks != plain.masks).mean() < (1e-3 if name == "shape" else 1e-9)
    same = told.masks[:-1] == plain.masks[:-1]
    np.testing.assert_allclose(told.flow[same], plain.flow[same], atol=2e-3)


WRONG = {
    "unknown effect": ({"effect": "dragg", "target": "ball"}, "dragg"),
    "unknown parameter": ({"effect": "drag", "target": "ball", "parameters": {"square": 1.0}}, "square"),
    "missing parameter": ({"effect": "push", "target": "ball", "parameters": {"x": 1.0}}, "time is missing"),
    "missing target": ({"effect": "drag", "parameters": {"linear": 1.0}}, "target"),
    "out of bounds": ({"effect": "drag", "target": "ball", "parameters": {"linear": -1.0}}, "0 <= value"),
    "no number": ({"effect": "wind", "parameters": {"x": "much"}}, "much"),
    "a list": ({"effect": "wind", "parameters": {"x": [1.0, 2.0]}}, "one number"),
    "no list": ({"effect": "shape", "target": "ball", "parameters": {"bulge": 1.0}}, "list"),
    "part of a frame": ({"effect": "dropped_frames", "parameters": {"frame": 2.5, "count": 1}}, "whole"),
}


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clip")
    save_scene(folder / "plain.yaml", SCENE)
    arguments = ["simulate", str(folder / "plain.yaml"), "--out", str(folder / "clip.npz"), "--size", "48x32"]
    assert run([*arguments, "--frames", "4"]) == 0
    return folder / "clip.npz"


@pytest.mark.parametrize("command", ["simulate", "export", "evaluate", "refine"])
@pytest.mark.parametrize(("entry", "told"), WRONG.values(), ids=WRONG)
def test_wrong_entries_are_told_in_one_line(tmp_path, capsys, clip, command, entry, told):
    path, out = tmp_path / "scene.yaml", str(tmp_path / "out")
    path.write_text(dump_scene(SCENE) + yaml.safe_dump([{"type": "effect", **entry}]))
    calls = {
        "simulate": ["simulate", str(path), "--out", out],
        "export": ["export", str(path), "--out", out],
        "evaluate": ["evaluate", "--scene", str(path), "--video", str(clip)],
        "refine": ["--init", str(path), "--video", str(clip), "--out", out],
    }
    assert run(calls[command]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert told in lines[0]
    assert entry["effect"] in lines[0]


class Lift(EffectKind):
    """A plugin: upward force."""

    name = "lift"
    sentence = "{target} is lifted"
    targeted = True
    physical = True
    parameters = (EffectParameter("force", "N", 1.0),)

    def loads(self, motion, target, values):
        force = np.zeros_like(motion.position)
        force[:, target, 2] = values[:, 0]
        return force, np.zeros_like(force)


class _Entry:
    def __init__(self, name, value):
        self.name, self.value, self._loaded = name, f"package:{name}", value

    def load(self):
        if isinstance(self._loaded, Exception):
            raise self._loaded
        return self._loaded


@pytest.fixture
def plugin(monkeypatch):
    def install(value):
        def found(group):
            return [_Entry("lift", value)] if group == ENTRY_POINT else []

        monkeypatch.setattr(importlib.metadata, "entry_points", found)
        catalogue.cache_clear()

    yield install
    catalogue.cache_clear()


def test_a_plugin_acts_like_our_own(plugin):
    plugin(Lift)
    poses = rolled_out(effect("lift", "ball", force=0.7 * GRAVITY), gravity=GRAVITY, linear_velocity=(1.0, 0.0, 0.0))
    np.testing.assert_allclose(poses[:, 0, 2], 50.0, atol=1e-9)


@pytest.mark.parametrize(
    ("value", "told"),
    [(ImportError("no module"), "does not load"), (int, "expected a subclass"), (catalogue, "expected a subclass")],
)
def test_a_broken_plugin_is_named(plugin, value, told):
    plugin(value)
    with pytest.raises(InputError, match=rf"{ENTRY_POINT}: lift = package:lift.*{told}"):
        catalogue()


@pytest.mark.parametrize("name", ["drag", "free_force"])
def test_a_plugin_cannot_take_a_name_of_ours(plugin, name):
    plugin(type("Other", (Lift,), {"name": name}))
    with pytest.raises(InputError, match=f"'{name}' is taken"):
        catalogue()


# Elsewhere --------------------------------------------------------------------------------------------------------------


def test_a_tilted_floor_carries_the_parameter_space():
    angle = np.deg2rad(12.0)
    standing = dataclasses.replace(SCENE.objects[1], position=(0.5, 0.0, 0.2), orientation=(1.0, 0.0, 0.0, 0.0))
    turn = np.array([np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0])
    place = rotations.rotate(turn, np.array(standing.position))
    body = dataclasses.replace(
        standing, position=tuple(place), orientation=tuple(turn), linear_velocity=(0.0, 0.0, 0.0)
    )
    scene = Scene((body,), CAMERA, effects=(effect("slope", y=12.0),))
    space = Space.around(scene)
    clearance = next(p for p in space.parameters if p.field == "clearance")
    assert clearance.start == pytest.approx(0.0, abs=1e-9)
    back = space.scene_at(space.start)
    np.testing.assert_allclose(back.objects[0].position, place, atol=1e-9)
    np.testing.assert_allclose(back.objects[0].orientation, turn, atol=1e-9)
    assert back.effects == scene.effects


def test_auto_falls_back_to_mujoco_and_others_refuse(monkeypatch):
    batch = batch_with_effects([dataclasses.replace(SCENE, effects=(EVERY[0],))])
    seen = batch_with_effects([dataclasses.replace(SCENE, effects=(EVERY[4], EVERY[8]))])
    monkeypatch.setattr(backends, "resolve_backend", lambda name: "warp" if name == "auto" else name)
    assert backends.backend_for("auto", batch) == "mujoco"
    assert backends.backend_for("auto", seen) == "warp"
    assert backends.backend_for("mjx", seen) == "mjx"
    with pytest.raises(InputError, match="effect drag: backend mjx cannot carry it; use --backend mujoco"):
        backends.backend_for("mjx", batch)


@pytest.mark.slow
def test_mjx_carries_floor_timing_and_centre_of_mass():
    from mjx_refine.sim.mjx import MjxSimulator

    effects = (
        effect("slope", y=10.0),
        effect("offset_com", "ball", x=0.05),
        effect("dropped_frames", frame=3, count=2),
    )
    ball = dataclasses.replace(BALL, position=(0.0, 0.0, 0.45), linear_velocity=(0.5, 0.2, -1.0), damping=-40.0)
    scene = Scene((dataclasses.replace(ball, angular_velocity=(5.0, 0.0, 2.0)),), CAMERA, effects=effects)
    batch = batch_with_effects([scene])
    told, expected = (
        MjxSimulator(("sphere",), FPS).rollout(batch, 10),
        MujocoSimulator(("sphere",), FPS, 1).rollout(batch, 10),
    )
    np.testing.assert_allclose(told, expected, atol=2e-3)
    drag = batch_with_effects([dataclasses.replace(scene, effects=(effect("drag", linear=1.0),))])
    with pytest.raises(InputError, match="effect drag: backend mjx cannot carry it"):
        MjxSimulator(("sphere",), FPS).rollout(drag, 10)


def exported(scene: Scene, frames: int) -> np.ndarray:
    model = mujoco.MjModel.from_xml_string(export_xml(scene, FPS))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    poses = [data.qpos.copy()]
    for _ in range(frames - 1):
        mujoco.mj_step(model, data, 8)
        poses.append(data.qpos.copy())
    return np.array(poses).reshape(frames, -1, 7)


@pytest.mark.parametrize(
    ("entry", "friction", "tolerance"),
    [
        (effect("slope", x=4.0, y=-3.0), 0.5, 1e-6),
        (effect("offset_com", "ball", x=0.05, z=-0.04), 0.5, 1e-6),
        (effect("wind", x=20.0, y=-5.0), 0.5, 1e-6),
        (effect("drag", "ball", linear=0.8), 0.5, 1e-6),
        (effect("hidden_obstacle", "ball", angle=180.0, distance=-1.0, restitution=0.6), 0.0, 2e-3),
        # MuJoCo's friction is no spring's, nor the effect's, which lets slow slip creep.
        (effect("hidden_obstacle", "ball", angle=180.0, distance=-1.0, restitution=0.6), 0.5, 0.03),
    ],
    ids=lambda value: getattr(value, "effect", ""),
)
def test_exported_effects_are_the_simulators(entry, friction, tolerance):
    ball = dataclasses.replace(
        SCENE.objects[0], angular_velocity=(4.0, 1.0, 0.0), damping=-60.0, friction=(friction, 0.01)
    )
    scene = Scene((ball,), CAMERA, effects=(entry,))
    expected = MujocoSimulator(scene.shapes, FPS, 1).rollout(batch_with_effects([scene]), 25)[0]
    plain = MujocoSimulator(scene.shapes, FPS, 1).rollout(
        batch_with_effects([dataclasses.replace(scene, effects=())]), 25
    )[0]
    told = exported(scene, 25)
    assert np.abs(expected[..., :3] - plain[..., :3]).max() > 0.01, "the effect must act"
    np.testing.assert_allclose(told[..., :3], expected[..., :3], atol=tolerance)


def test_an_exported_camera_is_rolled():
    model = mujoco.MjModel.from_xml_string(
        export_xml(dataclasses.replace(SCENE, effects=(effect("camera_roll", angle=30.0),)))
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    pitch, roll = np.deg2rad([60.0, 30.0])
    right, up = np.array([1.0, 0.0, 0.0]), np.array([0.0, np.cos(pitch), np.sin(pitch)])
    axes = data.camera("camera").xmat.reshape(3, 3)
    # Counter-clockwise as seen from behind it: its right side goes up.
    np.testing.assert_allclose(axes[:, 0], np.cos(roll) * right + np.sin(roll) * up, atol=1e-12)
    np.testing.assert_allclose(axes[:, 2], np.cross(right, up), atol=1e-12)


HELD = ("slope", "offset_com", "camera_roll", "wind", "hidden_obstacle")


@pytest.mark.parametrize("entry", [e for e in EVERY if e.effect not in HELD], ids=lambda e: e.effect)
def test_what_xml_cannot_hold_is_refused_by_name(entry):
    with pytest.raises(InputError, match=f"effect {entry.effect}: .*remove the entry"):
        export_xml(dataclasses.replace(SCENE, effects=(entry,)))


def test_a_wind_with_a_speed_is_not_exported():
    with pytest.raises(InputError, match=r"slowness = 0\.2"):
        export_xml(dataclasses.replace(SCENE, effects=(effect("wind", x=20.0, slowness=0.2),)))
