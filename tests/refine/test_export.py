"""Exported XML, stepped by MuJoCo alone, against the simulator."""

from __future__ import annotations

import dataclasses
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from mjx_refine.batch import batch_from_scenes
from mjx_refine.errors import InputError
from mjx_refine.export import KEYFRAME, export_xml, save_export
from mjx_refine.scene import Body, Camera, Effect, Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.model import apply_fields, model_fields

UNIT = np.array([0.9, 0.1, 0.3, 0.3]) / np.linalg.norm([0.9, 0.1, 0.3, 0.3])
BOX = Body(
    "box", "box_0", (0.25, 0.2, 0.1 + 0.1 / 3), (-0.9, 0.0, 0.45), tuple(UNIT.tolist()), (3.0, 0.2, 0.0),
    (1.0, 2.0, 0.5), friction=(0.9, 0.02), mass=1.7, damping=-20.0, stiffness=7000.0,
)  # fmt: skip
CYLINDER = Body(
    "cylinder", "cylinder_0", (0.2, 0.5), (0.3, 0.1, 0.22), (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0), (-0.5, 0.0, 0.3),
    (0.0, 0.0, 3.0), friction=(0.4, 0.05), mass=0.6, damping=-30.0,
)  # fmt: skip
SPHERE = Body("sphere", "sphere_0", (0.15,), (1.2, -0.1, 0.9), linear_velocity=(-1.0, 0.0, -1.0), damping=-40.0)
SCENE = Scene((BOX, CYLINDER, SPHERE), Camera((0.1, -3.0, 3.0), 47.0, 38.0), (0.1, 0.0, -9.81))


APART = dataclasses.replace(
    SCENE,
    objects=(
        BOX,
        dataclasses.replace(CYLINDER, position=(0.3, 1.8, 0.22)),
        dataclasses.replace(SPHERE, position=(0.5, 0.0, 0.3), linear_velocity=(-2.0, 0.0, 0.0)),
    ),
)
"""Box and sphere collide; no cylinder meets a box, whose collider is iterative and stops at 1e-6."""


def stepped(model: mujoco.MjModel, frames: int) -> np.ndarray:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    poses = [data.qpos.copy()]
    for _ in range(frames - 1):
        mujoco.mj_step(model, data, 8)
        poses.append(data.qpos.copy())
    return np.array(poses).reshape(frames, -1, 7)


@pytest.mark.parametrize("fps", [30.0, 23.976, 60.0])
def test_one_second_of_the_file_is_the_simulator(tmp_path, fps):
    path = save_export(tmp_path / "scene.xml", APART, fps)
    frames = round(fps) + 1
    expected = MujocoSimulator(APART.shapes, fps).rollout(batch_from_scenes([APART]), frames)[0]
    alone = MujocoSimulator(("sphere",), fps).rollout(
        batch_from_scenes([dataclasses.replace(APART, objects=APART.objects[2:])]), frames
    )[0]
    assert np.abs(alone[-1, 0] - expected[-1, 2]).max() > 0.05, "the sphere must hit the box"
    np.testing.assert_allclose(stepped(mujoco.MjModel.from_xml_path(str(path)), frames), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("fps", [30.0, 23.976, 60.0])
def test_when_a_box_hits_a_cylinder_the_file_is_the_simulator_but_for_rounding(fps):
    frames = round(fps) + 1
    batch = batch_from_scenes([SCENE])
    expected = MujocoSimulator(SCENE.shapes, fps).rollout(batch, frames)[0]
    model = mujoco.MjModel.from_xml_string(export_xml(SCENE, fps))
    # An iterative collider magnifies the last bit of these; without that bit nothing may differ.
    exact = mujoco.MjModel.from_xml_string(export_xml(SCENE, fps))
    apply_fields(exact, model_fields(batch), 0)
    for name in ("dof_M0", "dof_invweight0", "body_invweight0"):
        np.testing.assert_allclose(getattr(model, name), getattr(exact, name), rtol=1e-12)
        getattr(model, name)[:] = getattr(exact, name)
    np.testing.assert_allclose(stepped(model, frames), expected, rtol=0, atol=1e-9)


def test_a_viewer_starts_at_the_initial_poses_and_the_keyframe_adds_velocities():
    model = mujoco.MjModel.from_xml_string(export_xml(SCENE))
    poses = np.array([[*b.position, *b.orientation] for b in SCENE.objects]).reshape(-1)
    np.testing.assert_allclose(model.qpos0, poses, atol=1e-15)
    np.testing.assert_allclose(model.key(KEYFRAME).qpos, poses, atol=1e-15)
    speeds = [[*b.linear_velocity, *b.angular_velocity] for b in SCENE.objects]
    np.testing.assert_array_equal(model.key(KEYFRAME).qvel, np.ravel(speeds))


def test_fixed_and_free_camera_are_the_scenes():
    model = mujoco.MjModel.from_xml_string(export_xml(SCENE))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    pitch = np.deg2rad(47.0)
    forward = [0.0, np.sin(pitch), -np.cos(pitch)]
    np.testing.assert_allclose(data.camera("camera").xpos, [0.1, -3.0, 3.0])
    np.testing.assert_allclose(-data.camera("camera").xmat.reshape(3, 3)[:, 2], forward, atol=1e-12)
    assert model.camera("camera").fovy[0] == model.vis.global_.fovy == 38.0
    free = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, free)
    azimuth, elevation = np.deg2rad(free.azimuth), np.deg2rad(free.elevation)
    seen = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    np.testing.assert_allclose(seen, forward, atol=1e-6)
    np.testing.assert_allclose(free.lookat - free.distance * np.array(seen), [0.1, -3.0, 3.0], atol=1e-6)


@pytest.mark.parametrize("name", ["world", "floor", '<script>"&', "a b", "ö\x01\n", " ", "a--b"])
def test_any_name_makes_a_loadable_file(tmp_path, name):
    objects = (dataclasses.replace(SPHERE, name=name), dataclasses.replace(CYLINDER, name="object"))
    path = save_export(tmp_path / "scene.xml", dataclasses.replace(SCENE, objects=objects))
    model = mujoco.MjModel.from_xml_path(str(path))
    assert (model.nbody, model.npair) == (3, 3)


def test_names_and_comment_are_in_the_file():
    root = ElementTree.fromstring(export_xml(SCENE))
    assert [body.get("name") for body in root.iter("body")] == ["box_0", "cylinder_0", "sphere_0"]
    assert "Load key" in export_xml(SCENE)


def test_an_effect_that_xml_cannot_hold_is_refused():
    scene = dataclasses.replace(SCENE, effects=(Effect("drag", "box_0", (("quadratic", 0.1),)),))
    with pytest.raises(InputError, match="effect drag: MuJoCo's XML holds only its linear part"):
        export_xml(scene)


@pytest.mark.parametrize("fps", [0.0, -30.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(fps):
    with pytest.raises(InputError, match="fps"):
        export_xml(SCENE, fps)
