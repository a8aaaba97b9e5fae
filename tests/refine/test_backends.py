"""MJX colliders and rollouts against C MuJoCo; which backend is chosen; what happens without a GPU."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from benchmarks.parity import pair_rows, scene_batch, single_rows
from mjx_refine import compile_cache
from mjx_refine.errors import InputError
from mjx_refine.sim import backends
from mjx_refine.sim.buckets import BUCKETS, bucket, diverged_to_nan
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.colliders import hook
from mjx_refine.sim.colliders.box_box import box_box
from mjx_refine.sim.colliders.cylinder_box import cylinder_box
from mjx_refine.sim.colliders.cylinder_cylinder import cylinder_cylinder
from mjx_refine.sim.colliders.plane import plane_box, plane_cylinder
from mjx_refine.sim.colliders.sphere import sphere_box, sphere_cylinder
from mjx_refine.sim.leaves import leaves_of
from mjx_refine.sim.mjx import MjxSimulator, padded
from mjx_refine.sim.model import build_spec, initial_state
from mjx_refine.sim.warp import WarpSimulator, contact_points
from mjx_refine.sim.warp_problem import warp_problem

EXACT = {
    ("plane", "box"): plane_box,
    ("plane", "cylinder"): plane_cylinder,
    ("sphere", "box"): sphere_box,
    ("sphere", "cylinder"): sphere_cylinder,
    ("box", "box"): box_box,
}
CONVEX = {("cylinder", "box"): cylinder_box, ("cylinder", "cylinder"): cylinder_cylinder}
COMPILED = {kinds: jax.jit(collider) for kinds, collider in (EXACT | CONVEX).items()}


def random_contacts(kinds: tuple[str, str], count: int, tilt: float | None):
    """Random poses that touch, and C MuJoCo's contacts: geoms, distances, positions, normals from first to second."""
    generator = np.random.default_rng(5)
    shapes = kinds[1:] if kinds[0] == "plane" else kinds
    model = build_spec(shapes, 30.0).compile()
    data = mujoco.MjData(model)
    ids = (0, 1) if kinds[0] == "plane" else (1, 2)
    model.geom_rbound[1:] = 2.0
    model.geom_aabb[1:, 3:] = 2.0
    found = 0
    while found < count:
        for i, shape in enumerate(shapes):
            x, y, z = generator.uniform(0.1, 0.4, 3)
            model.geom_size[i + 1] = {"sphere": (x, 0, 0), "cylinder": (x, y, 0), "box": (x, y, z)}[shape]
            turn = generator.standard_normal(4)
            if tilt is not None:
                turn = np.array([1.0, tilt * turn[0], tilt * turn[1], turn[2]])
            data.qpos[7 * i : 7 * i + 3] = 0.25 * generator.standard_normal(3)
            data.qpos[7 * i + 3 : 7 * i + 7] = turn / np.linalg.norm(turn)
        mujoco.mj_forward(model, data)
        got = [c for c in data.contact if tuple(sorted(c.geom)) == ids]
        if not got or min(c.dist for c in got) < -0.15:
            continue
        found += 1
        geoms = [(data.geom_xpos[k], data.geom_xmat[k].reshape(3, 3), model.geom_size[k]) for k in ids]
        sign = 1.0 if tuple(got[0].geom) == ids else -1.0
        yield (
            jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), geoms),
            np.array([c.dist for c in got]),
            np.array([c.pos for c in got]),
            sign * np.array(got[0].frame[:3]),
        )


def worst_difference(collider, geoms, distance, position, normal) -> float:
    """The largest difference of any number of any contact; infinite where their count differs."""
    ours = [np.asarray(array) for array in collider(*geoms)]
    touching = ours[0] < 0
    if touching.sum() != len(distance):
        return np.inf
    d, p = ours[0][touching], ours[1][touching]
    order = [
        int(np.argmin(np.linalg.norm(p - q, axis=1) + np.abs(d - e))) for q, e in zip(position, distance, strict=True)
    ]
    parts = (
        np.abs(d[order] - distance).max(),
        np.abs(p[order] - position).max(),
        np.abs(ours[2][touching] - normal).max(),
    )
    return float(max(parts))


@pytest.mark.parametrize("kinds", EXACT)
@pytest.mark.parametrize("tilt", [None, 0.05])
def test_contacts_are_those_of_c_mujoco(kinds, tilt):
    collider = COMPILED[kinds]
    errors = [worst_difference(collider, *case) for case in random_contacts(kinds, 60, tilt)]
    assert max(errors) < 1e-4


@pytest.mark.parametrize("kinds", CONVEX)
def test_convex_contacts_are_those_of_c_mujoco_but_few(kinds):
    """C's search ends at a tolerance, and its choice of several points is its own: nine in ten agree to 5 mm."""
    collider = COMPILED[kinds]
    errors = np.array([worst_difference(collider, *case) for case in random_contacts(kinds, 80, None)])
    assert np.mean(errors < 5e-3) > 0.9
    assert np.median(errors) < 5e-4


@pytest.mark.parametrize("kinds", COMPILED)
def test_colliders_find_nothing_between_bodies_apart(kinds):
    eye = jnp.eye(3)
    size = jnp.array([0.2, 0.2, 0.2])
    place = jnp.array([0.1, 0.05, 1.5])
    distance, position, normal = COMPILED[kinds]((jnp.zeros(3), eye, size), (place, eye, size))
    assert (distance > 0).all()
    assert jnp.isfinite(position).all()
    assert jnp.isfinite(normal).all()


@pytest.mark.parametrize("kinds", [k for k in COMPILED if k[0] != "plane"])
def test_colliders_stay_finite_in_awkward_poses(kinds):
    """Aligned, concentric and parallel bodies: no NaN, no unit vector of another length."""
    size = jnp.array([0.2, 0.2, 0.2])
    quarter = jnp.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    for turn in (jnp.eye(3), quarter):
        for place in ([0.0, 0.0, 0.0], [0.0, 0.0, 0.39], [0.39, 0.0, 0.0], [0.2, 0.2, 0.3]):
            outcome = COMPILED[kinds]((jnp.zeros(3), jnp.eye(3), size), (jnp.array(place), turn, size))
            assert all(bool(jnp.isfinite(array).all()) for array in outcome)
            np.testing.assert_allclose(jnp.linalg.norm(outcome[2], axis=-1), 1.0, atol=1e-5)


def test_hook_is_undone_and_guarded(monkeypatch):
    before = dict(hook.collision_driver._COLLISION_FUNC)
    assert not hook.collision_driver.has_collision_fn(hook.GeomType.CYLINDER, hook.GeomType.BOX)
    with hook.installed():
        assert hook.collision_driver.has_collision_fn(hook.GeomType.CYLINDER, hook.GeomType.BOX)
    assert before == hook.collision_driver._COLLISION_FUNC
    monkeypatch.setattr(hook.collision_driver, "_COLLISION_FUNC", {})
    with pytest.raises(InputError, match=r"mujoco-mjx==3\.17\.0"), hook.installed():
        pass
    monkeypatch.delattr(hook.collision_driver, "_COLLISION_FUNC")
    with pytest.raises(InputError, match=r"collision_driver\._COLLISION_FUNC"), hook.installed():
        pass


def test_mjx_driver_calls_our_collider_as_it_calls_its_own():
    """The hook's oracle: MJX's whole collision step, for a cylinder on a box, gives C MuJoCo's contacts."""
    batch = scene_batch(pair_rows(-4.0)["box-cylinder"], 1, 0)
    position = np.array([[[0.0, 0.0, 0.15], [0.02, 0.01, 0.44]]])
    batch = batch.map(np.copy)
    batch.position[:] = position
    batch.quaternion[:] = np.array([1.0, 0.0, 0.0, 0.0])
    simulator = MjxSimulator(batch.shapes, 30.0)
    depths = simulator.contact_distances(batch)[0]
    expected = sorted(c[2] for c in MujocoSimulator(batch.shapes, 30.0).contacts(batch, 0))
    np.testing.assert_allclose(sorted(d for d in depths if d < 0), expected, atol=1e-5)


def test_free_flight_and_bounce_of_a_sphere():
    batch = scene_batch(single_rows(-4.0)["bounce"], 3, 1)
    truth = MujocoSimulator(batch.shapes, 30.0).rollout(batch, 31)
    simulator = MjxSimulator(batch.shapes, 30.0)
    poses = simulator.rollout(batch, 31)
    flight = 8
    np.testing.assert_allclose(poses[:, :flight], truth[:, :flight], rtol=0, atol=2e-5)
    assert np.linalg.norm((poses - truth)[:, -1, 0, :3], axis=-1).max() < 1e-3


@pytest.mark.slow
def test_trajectory_is_pure_and_differentiable():
    """In flight the end position changes with the velocity times the time, and with gravity times half its square."""
    batch = scene_batch(single_rows(-4.0)["bounce"], 1, 1).map(np.copy)
    batch.position[..., 2] = 5.0
    simulator = MjxSimulator(batch.shapes, 30.0)
    qpos, qvel = (jnp.asarray(array[0]) for array in initial_state(batch))
    leaves = jax.tree.map(lambda leaf: leaf[0], leaves_of(batch))

    def end(velocity, gravity):
        return simulator.trajectory(leaves._replace(gravity=gravity), qpos, velocity, 3)[-1, 0, :3]

    along = (jnp.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0]), jnp.array([0.0, -4.0, 5.0]))
    _, change = jax.jit(lambda *at: jax.jvp(end, at, along))(qvel, leaves.gravity)
    steps, dt = 16, 1 / 240
    expected = along[0][:3] * steps * dt + along[1] * dt**2 * steps * (steps + 1) / 2
    np.testing.assert_allclose(change, expected, atol=1e-5)


@pytest.mark.parametrize("kinds", CONVEX)
def test_depth_of_convex_contacts_has_the_derivative_of_its_motion(kinds):
    """Moving the second body along the normal changes the deepest distance one for one (envelope theorem)."""
    slopes = []
    for (first, second), _, _, normal in random_contacts(kinds, 6, None):

        def deepest(way, first=first, second=second):
            return COMPILED[kinds](first, (second[0] + way, *second[1:]))[0].min()

        along = jnp.asarray(normal, jnp.float32)
        slopes.append(float(jax.jvp(deepest, (jnp.zeros(3),), (along,))[1]))
    assert np.isfinite(slopes).all()
    assert np.median(slopes) == pytest.approx(1.0, abs=0.01)


def test_batches_are_padded_with_the_last_candidate():
    assert [bucket(n) for n in (1, 2, 16, 17, 128, 129)] == [1, 4, 16, 32, 128, 256]
    assert bucket(BUCKETS[-1] + 1) == 2 * BUCKETS[-1]
    batch = scene_batch(single_rows(-4.0)["slide"], 3, 0)
    full = padded(batch)
    assert len(full) == 4
    np.testing.assert_array_equal(full.mass[3], batch.mass[2])


def test_divergence_is_nan_from_then_on():
    poses = np.zeros((2, 4, 1, 7))
    poses[1, 2, 0, 0] = np.inf
    poses[1, 3] = 0.0
    out = diverged_to_nan(poses)
    assert np.isfinite(out[0]).all()
    assert np.isfinite(out[1, :2]).all()
    assert np.isnan(out[1, 2:]).all()


def test_backend_names():
    with pytest.raises(InputError, match="expected one of auto, mjx, warp, mujoco"):
        backends.make_simulator("bullet", ("sphere",), 30.0)
    assert isinstance(backends.make_simulator("mujoco", ("sphere",), 30.0), MujocoSimulator)
    assert isinstance(backends.make_simulator("mjx", ("sphere",), 30.0), MjxSimulator)


@pytest.mark.skipif(warp_problem() is None, reason="this machine runs MJX-Warp")
def test_without_a_gpu_auto_is_c_and_warp_says_what_to_do():
    assert backends.resolve_backend("auto") == "mujoco"
    for call in (lambda: backends.make_simulator("warp", ("sphere",), 30.0), lambda: WarpSimulator(("sphere",), 30.0)):
        with pytest.raises(InputError, match=r"pip install 'mjx-refine\[warp\]'"):
            call()


def test_room_for_contacts():
    # Two boxes: eight corners of each with the floor, eight points between.
    assert contact_points(("box", "box")) == 24
    assert contact_points(("sphere", "sphere")) == 3


def test_cache_folder(monkeypatch, tmp_path):
    monkeypatch.setenv(compile_cache.VARIABLE, str(tmp_path / "cache"))
    before = jax.config.jax_compilation_cache_dir
    try:
        assert compile_cache.enable_cache() == tmp_path / "cache"
        assert jax.config.jax_compilation_cache_dir == str(tmp_path / "cache" / "jax")
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
    monkeypatch.setenv(compile_cache.VARIABLE, "off")
    assert compile_cache.enable_cache() is None


ENABLED_AGAIN = """
from mjx_refine.compile_cache import enable_cache
enable_cache()
from mjx_refine.sim.mjx_import import warp
warp.init()
enable_cache()
print(warp.config.kernel_cache_dir)
"""


def test_warp_is_told_where_to_keep_kernels_once(monkeypatch, tmp_path):
    # Told again, it would keep them beside its version's folder, where the next process takes them for another version's.
    pytest.importorskip("warp")
    monkeypatch.setenv(compile_cache.VARIABLE, str(tmp_path))
    done = subprocess.run([sys.executable, "-c", ENABLED_AGAIN], capture_output=True, text=True, check=True)
    assert Path(done.stdout.strip()).parent == tmp_path / "kernels"


@pytest.mark.slow
@pytest.mark.parametrize("row", ["slide", "topple", "bounce-box", "box-box", "box-cylinder", "cylinder-cylinder"])
def test_mjx_parity(row):
    from benchmarks.parity import run

    (measured,) = run("mjx", 16, 0, [row], [-4.0])
    assert measured.verdict in ("ok", "stated")


@pytest.mark.gpu
@pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="Warp is not installed")
@pytest.mark.parametrize("row", ["slide", "box-cylinder", "cylinder-cylinder"])
def test_warp_parity(row):
    from benchmarks.parity import run

    (measured,) = run("warp", 16, 0, [row], [-4.0])
    assert measured.verdict in ("ok", "stated")


def test_who_searches_on_the_cores_imports_neither_mjx_nor_warp():
    """They take seconds, of which a second process has few."""
    said = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", STARTED], capture_output=True, text=True, check=True, timeout=120
    )
    assert said.stdout.split() == ["mujoco"]


STARTED = """
import sys
from mjx_refine import load_observation, load_scenes, refine
from mjx_refine.sim.backends import fastest
print(fastest("auto", 1, 2))
print(*[name for name in ("mujoco.mjx", "warp", "scipy.stats", "scipy.optimize") if name in sys.modules])
"""
