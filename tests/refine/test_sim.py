"""C MuJoCo rollouts against a script that knows only MuJoCo and the written contract."""

from __future__ import annotations

import dataclasses
import itertools

import mujoco
import numpy as np
import pytest

from mjx_refine.batch import batch_from_scenes, concatenate
from mjx_refine.scene import Body, Camera, Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.separate import separate

CAMERA = Camera((0.0, -3.0, 3.0), 45.0)

BOX = Body(
    "box", "box_0", (0.25, 0.2, 0.15), (-0.6, 0.0, 0.2), (0.9, 0.1, 0.3, 0.3), (3.0, 0.2, 0.0), (1.0, 2.0, 0.5),
    friction=(0.9, 0.02), mass=1.7, damping=-6.0, stiffness=7000.0,
)  # fmt: skip
CYLINDER = Body(
    "cylinder", "cylinder_0", (0.2, 0.5), (0.2, 0.1, 0.22), (0.7, 0.7, 0.1, 0.1), (-0.5, 0.0, 0.3), (0.0, 0.0, 3.0),
    friction=(0.4, 0.05), mass=0.6, damping=-20.0,
)  # fmt: skip
SPHERE = Body("sphere", "sphere_0", (0.15,), (0.1, -0.1, 0.9), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 5.0, 0.0))


def normalised(body: Body) -> Body:
    quaternion = np.asarray(body.orientation) / np.linalg.norm(body.orientation)
    return dataclasses.replace(body, orientation=tuple(quaternion.tolist()))


def scene_of(*bodies: Body, gravity=(0.1, 0.0, -9.81)) -> Scene:
    return Scene(tuple(normalised(body) for body in bodies), CAMERA, gravity)


def plain_script(scene: Scene, fps: float, frames: int) -> np.ndarray:
    """Poses by XML and ``mj_step`` alone, written from the contract: no code of the project's."""
    geoms, pairs = [], []
    for body in scene.objects:
        size = {
            "sphere": body.size[:1],
            "box": body.size,
            "cylinder": (body.size[0], body.size[-1] / 2),
        }[body.shape]
        numbers = " ".join(repr(float(number)) for number in size)
        geoms.append(
            f'<body name="{body.name}"><freejoint/><geom name="{body.name}" type="{body.shape}" size="{numbers}" '
            f'mass="{body.mass!r}" contype="0" conaffinity="0"/></body>'
        )

    def pair(one: str, other: str, friction: tuple, stiffness: float, damping: float) -> str:
        slide, roll = friction
        return (
            f'<pair geom1="{one}" geom2="{other}" condim="6" friction="{slide!r} {slide!r} 0.005 {roll!r} {roll!r}" '
            f'solref="{-stiffness!r} {damping!r}" solreffriction="{-stiffness!r} -30"/>'
        )

    for i, a in enumerate(scene.objects):
        pairs.append(pair("floor", a.name, a.friction, a.stiffness, a.damping))
        for b in scene.objects[i + 1 :]:
            friction = tuple(max(x, y) for x, y in zip(a.friction, b.friction, strict=True))
            pairs.append(pair(a.name, b.name, friction, max(a.stiffness, b.stiffness), min(a.damping, b.damping)))
    gravity = " ".join(map(repr, scene.gravity))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{1 / (8 * fps)!r}" gravity="{gravity}" integrator="Euler" solver="Newton" '
        f'cone="elliptic"/><worldbody><geom name="floor" type="plane" size="0 0 1" contype="0" conaffinity="0"/>'
        f"{''.join(geoms)}</worldbody><contact>{''.join(pairs)}</contact></mujoco>"
    )
    data = mujoco.MjData(model)
    for i, body in enumerate(scene.objects):
        data.qpos[7 * i : 7 * i + 7] = [*body.position, *body.orientation]
        data.qvel[6 * i : 6 * i + 6] = [*body.linear_velocity, *body.angular_velocity]
    poses = [data.qpos.copy()]
    for _ in range(frames - 1):
        for _ in range(8):
            mujoco.mj_step(model, data)
        poses.append(data.qpos.copy())
    return np.array(poses).reshape(frames, -1, 7)


@pytest.mark.parametrize("bodies", [(SPHERE,), (BOX,), (BOX, CYLINDER), (BOX, CYLINDER, SPHERE)])
@pytest.mark.parametrize("fps", [30.0, 24.0, 240.0])
def test_rollout_is_plain_mujoco(bodies, fps):
    scene = scene_of(*bodies)
    poses = MujocoSimulator(scene.shapes, fps).rollout(batch_from_scenes([scene]), 20)[0]
    np.testing.assert_allclose(poses, plain_script(scene, fps, 20), rtol=0, atol=1e-9)


def test_frame_zero_is_the_initial_state():
    scene = scene_of(BOX, SPHERE)
    batch = batch_from_scenes([scene])
    poses = MujocoSimulator(scene.shapes, 30.0).rollout(batch, 1)
    np.testing.assert_array_equal(poses[0, 0, :, :3], batch.position[0])
    np.testing.assert_array_equal(poses[0, 0, :, 3:], batch.quaternion[0])


def test_time_does_not_depend_on_the_frame_rate():
    scene = scene_of(dataclasses.replace(SPHERE, position=(0.0, 0.0, 50.0)), gravity=(0.0, 0.0, -10.0))
    for fps in (15.0, 60.0):
        frames = int(fps) + 1
        poses = MujocoSimulator(scene.shapes, fps).rollout(batch_from_scenes([scene]), frames)
        # Semi-implicit Euler falls by g t dt / 2 further than the parabola.
        expected = 50.0 - 1.0 - 5.0 - 10.0 / (8 * fps) / 2
        assert poses[0, -1, 0, 2] == pytest.approx(expected, abs=1e-9)


def test_threads_and_neighbours_do_not_change_a_result():
    scenes = [scene_of(BOX, dataclasses.replace(CYLINDER, mass=0.5 + 0.1 * i)) for i in range(7)]
    batch = batch_from_scenes(scenes)
    one = MujocoSimulator(batch.shapes, 30.0, threads=1).rollout(batch, 15)
    many = MujocoSimulator(batch.shapes, 30.0, threads=3).rollout(batch, 15)
    np.testing.assert_array_equal(one, many)
    np.testing.assert_array_equal(one[4:5], MujocoSimulator(batch.shapes, 30.0).rollout(batch[4:5], 15))


def test_divergence_is_nan_from_then_on_and_stays_with_its_candidate():
    good = scene_of(SPHERE)
    runaway = scene_of(dataclasses.replace(SPHERE, linear_velocity=(1e6, 0.0, 0.0)))
    batch = concatenate([batch_from_scenes([good]), batch_from_scenes([runaway])])
    poses = MujocoSimulator(batch.shapes, 30.0).rollout(batch, 10)
    assert np.isfinite(poses[0]).all()
    assert np.isfinite(poses[1, 0]).all()
    assert np.isnan(poses[1, 1:]).all()


def test_another_kind_is_refused():
    with pytest.raises(ValueError, match="scene kind"):
        MujocoSimulator(("box",), 30.0).rollout(batch_from_scenes([scene_of(SPHERE)]), 2)


def ball(name: str, x: float, z: float = 0.2) -> Body:
    return Body("sphere", name, (0.2,), (x, 0.0, z))


def gaps(scene: Scene) -> list[float]:
    places = np.array([body.position for body in scene.objects])
    return [float(np.linalg.norm(b - a)) - 0.4 for a, b in itertools.pairwise(places)]


def test_separate_leaves_what_is_apart():
    scene = scene_of(ball("a", 0.0), ball("b", 0.5))
    same, moved = separate(scene, MujocoSimulator(scene.shapes, 30.0))
    assert same is scene
    assert moved == 0.0


def test_separate_two_spheres_by_half_the_overlap_each():
    scene = scene_of(ball("a", 0.0), ball("b", 0.3))
    apart, moved = separate(scene, MujocoSimulator(scene.shapes, 30.0))
    assert gaps(apart)[0] >= -2e-4
    assert moved == pytest.approx(0.05, abs=1e-3)
    assert apart.objects[0].position[0] == pytest.approx(-0.05, abs=1e-3)


def test_separate_lifts_a_box_out_of_the_floor():
    scene = scene_of(dataclasses.replace(BOX, position=(0.0, 0.0, 0.1), orientation=(1.0, 0.0, 0.0, 0.0)))
    apart, moved = separate(scene, MujocoSimulator(scene.shapes, 30.0))
    assert apart.objects[0].position[2] == pytest.approx(0.15, abs=2e-4)
    assert moved == pytest.approx(0.05, abs=2e-4)


def test_separate_a_chain_of_three():
    scene = scene_of(ball("a", 0.0), ball("b", 0.3), ball("c", 0.62))
    apart, moved = separate(scene, MujocoSimulator(scene.shapes, 30.0))
    assert min(gaps(apart)) >= -2e-4
    assert 0.05 < moved < 0.15
