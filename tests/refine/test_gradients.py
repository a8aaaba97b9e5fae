"""Derivatives of rollouts and views against differences of C MuJoCo in double precision."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_refine.gradients import DerivativeError, Differentiator, check
from mjx_refine.gradients.check import Verdict, cosines, differences
from mjx_refine.gradients.finite import require_finite
from mjx_refine.gradients.steps import differentiable_steps, quat_integrate
from mjx_refine.gradients.tangents import inputs_of, kinked, stencil, tangents
from mjx_refine.scene import Body, Camera, Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.mjx import MjxSimulator
from mjx_refine.space import Space

CAMERA = Camera((0.0, -3.0, 3.0), 45.0)
IMAGE = (320, 240)
FRAMES = 16
FLYING = Body("sphere", "s", (0.2,), (0.0, 0.0, 2.0), (1, 0, 0, 0), (1.0, 0.5, 1.0), (0.0, 3.0, 1.0))
FALLING = dataclasses.replace(FLYING, position=(0.0, 0.0, 0.5), linear_velocity=(1.0, 0.0, 0.0))
ROLLING = dataclasses.replace(
    FLYING, position=(0.0, 0.0, 0.2), linear_velocity=(2.0, 0.0, 0.0), angular_velocity=(0.0, 10.0, 0.0), damping=-40.0
)
FLAT = Body("box", "b", (0.25, 0.2, 0.15), (0, 0, 0.15), (1, 0, 0, 0), (3.0, 0.5, 0.0), (0.0, 0.0, 1.0), damping=-40.0)
RESTING = dataclasses.replace(ROLLING, linear_velocity=(0.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, 0.0))
TURN = (0.9, 0.1, 0.3, 0.3)
UNIT = tuple((np.array(TURN) / np.linalg.norm(TURN)).tolist())
TUMBLING = dataclasses.replace(FLAT, position=(0.0, 0.0, 1.5), orientation=UNIT, angular_velocity=(1.0, 3.0, 0.5))


def space_of(*bodies: Body) -> Space:
    return Space.around(Scene(bodies, CAMERA))


@functools.cache
def simulator(*shapes) -> MjxSimulator:
    return MjxSimulator(shapes, 30.0)


@functools.cache
def reference(*shapes) -> MujocoSimulator:
    """C MuJoCo whose solver goes on to the last digit."""
    made = MujocoSimulator(shapes, 30.0, threads=1)
    made.model.opt.tolerance = 1e-14
    return made


def relative(one: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Error of each parameter's derivative over its size, or over a thousandth of the largest one's."""
    one, truth = one.reshape(len(one), -1), truth.reshape(len(truth), -1)
    size = np.linalg.norm(truth, axis=1)
    return np.linalg.norm(one - truth, axis=1) / np.maximum(size, 1e-3 * size.max())


# Tangents: from the unit box to the simulator ---------------------------------------------------------------------------


def test_stencils_are_of_second_order_and_stay_inside():
    point = np.array([0.0, 0.3, 1.0, 0.9999])
    points, weights = stencil(point, np.full(4, 1e-3))
    assert points.min() >= 0
    assert points.max() <= 1
    for power, slope in ((0, 0.0), (1, 1.0), (2, 2.0)):
        values = np.concatenate([point[:, None] ** power, np.stack([points[j, :, j] ** power for j in range(4)])], 1)
        np.testing.assert_allclose((weights * values).sum(1), slope * point ** max(power - 1, 0), atol=1e-9)


def test_a_body_on_the_floor_stays_there_along_the_tangent_of_its_size():
    space = space_of(ROLLING)
    inputs, moves = tangents(space, space.start)
    radius = space.names.index("s.radius")
    assert moves.qpos[radius, 2] == pytest.approx(moves.size[radius, 0, 0], rel=1e-8)
    # The coordinate is logarithmic: the slope is the radius times the span of the bounds.
    assert moves.size[radius, 0, 0] == pytest.approx(0.2 * space.parameters[radius].span, rel=1e-8)
    # Mass 1, I = 2/5 m r^2.
    assert moves.leaves.body_inertia[radius, 0, 0] == pytest.approx(0.8 * 0.2 * moves.size[radius, 0, 0], rel=1e-8)
    assert inputs.qpos[2] == pytest.approx(0.2)


def test_the_tangent_at_a_bound_looks_inside():
    space = space_of(ROLLING)
    lift = space.names.index("s.clearance")
    assert space.start[lift] == 0.0
    _, moves = tangents(space, space.start)
    assert moves.qpos[lift, 2] == pytest.approx(space.parameters[lift].span, rel=1e-8)


def test_the_camera_moves_nothing_of_physics():
    space = space_of(FLYING)
    _, moves = tangents(space, space.start)
    pitch = space.names.index("camera.pitch")
    assert moves.camera_pitch[pitch] == pytest.approx(space.parameters[pitch].span, rel=1e-8)
    assert not any(np.any(leaf[pitch]) for leaf in jax.tree.leaves((moves.leaves, moves.qpos, moves.qvel)))


def test_a_point_outside_of_the_box_is_refused():
    space = space_of(FLYING)
    with pytest.raises(ValueError, match="unit box"):
        tangents(space, space.start + 2.0)


def test_a_box_that_lies_flat_has_kinks_in_its_tilts_alone():
    space = space_of(FLAT)
    assert {n for n, k in zip(space.names, kinked(space, space.start), strict=True) if k} == {"b.tilt.x", "b.tilt.y"}
    space = space_of(TUMBLING)
    assert not kinked(space, space.start).any()


# Through MJX ------------------------------------------------------------------------------------------------------------


@functools.cache
def slopes(body: Body) -> tuple[Space, np.ndarray]:
    """Derivatives of the outlines [px per prior width]."""
    space = space_of(body)
    columns = Differentiator(space, simulator(body.shape)).outlines(space.start, FRAMES, IMAGE)[1]
    return space, columns * space.sigma[:, None, None, None]


@pytest.mark.parametrize(
    ("body", "limit"),
    [
        (FLYING, 1e-4),
        (ROLLING, 1e-3),
        (RESTING, 1e-3),
        pytest.param(TUMBLING, 1e-4, marks=pytest.mark.slow),
    ],
)
def test_outlines_have_the_derivatives_of_double_precision(body, limit):
    space, columns = slopes(body)
    truth = differences(space, space.start, FRAMES, 1e-5, reference(body.shape), IMAGE)
    error = relative(columns, truth)
    # A lift off the floor, where the contact starts, is no smooth change: its differences jump.
    smooth = np.array(
        [body is FLYING or body is TUMBLING or not name.endswith(("clearance", "damping")) for name in space.names]
    )
    assert error[smooth].max() <= limit, dict(zip(space.names, error.tolist(), strict=True))


def test_a_bounce_has_the_direction_of_double_precision():
    space, columns = slopes(FALLING)
    truth = differences(space, space.start, FRAMES, 1e-4, reference("sphere"), IMAGE)
    poses = reference("sphere").rollout(space.decode(space.start[None]), FRAMES)[0, :, 0, 2]
    touching = int(np.argmin(poses))
    assert 2 < touching < FRAMES - 3
    away = np.abs(np.arange(FRAMES) - touching) > 1
    assert cosines(columns, truth)[away].min() >= 0.99


def test_poses_are_the_simulators_own():
    space = space_of(FALLING)
    poses, columns = Differentiator(space, simulator("sphere")).poses(space.start, FRAMES)
    assert columns.shape == (space.dimension, FRAMES, 1, 7)
    expected = MujocoSimulator(("sphere",), 30.0).rollout(space.decode(space.start[None]), FRAMES)[0]
    np.testing.assert_allclose(poses, expected, atol=1e-4)


def test_a_shorter_horizon_is_the_start_of_the_longer():
    space = space_of(FALLING)
    derivatives = Differentiator(space, simulator("sphere"))
    poses, columns = derivatives.poses(space.start, FRAMES)
    fewer, parts = derivatives.poses(space.start, 11)
    np.testing.assert_array_equal(fewer, poses[:11])
    np.testing.assert_array_equal(parts, columns[:, :11])


def _spread(poses, size, position, pitch, fovy, target):
    return ((poses[..., :3] - target) ** 2).sum() + poses[-1, 0, 4] + size.sum() * fovy + position[2] * pitch


@pytest.mark.slow
def test_reverse_mode_is_forward_mode():
    space = space_of(FALLING)
    derivatives = Differentiator(space, simulator("sphere"))
    target = np.linspace(0.0, 1.0, FRAMES * 3).reshape(FRAMES, 1, 3)
    value, pulled = derivatives.gradient(space.start, FRAMES, _spread, target)
    same, pushed = derivatives.jacobian(space.start, FRAMES, _spread, target)
    assert value == pytest.approx(float(same), rel=1e-5)
    np.testing.assert_allclose(pulled, pushed, atol=1e-4 * np.abs(pushed).max())


def random_ball(generator: np.random.Generator) -> Body:
    """In the air, touching, resting or out of view."""
    radius = float(np.exp(generator.uniform(-3.0, 0.5)))
    kind = generator.integers(4)
    gap = float(generator.uniform(0.0, 2.0)) if kind == 0 else 0.0
    speed = generator.normal(size=(2, 3)) * (0.0 if kind == 2 else 3.0)
    place = generator.normal(size=2) * (30.0 if kind == 3 else 1.0)
    return Body(
        "sphere", "s", (radius,), (*place.tolist(), radius + gap), (1, 0, 0, 0), tuple(speed[0].tolist()),
        tuple(speed[1].tolist()), friction=(float(generator.uniform(0, 2)), float(generator.uniform(0, 0.1))),
        damping=float(-generator.uniform(0, 100)),
    )  # fmt: skip


def test_derivatives_of_random_scenes_are_numbers():
    generator = np.random.default_rng(0)
    pixels = generator.uniform(0, 240, (FRAMES, 1, 8, 2))
    for _ in range(20):
        space = space_of(random_ball(generator))
        derivatives = Differentiator(space, simulator("sphere"))
        # A rollout or a derivative that is not finite would raise.
        reach, columns = derivatives.outlines(space.start, FRAMES, IMAGE)
        assert np.isfinite(reach).all()
        assert np.isfinite(columns).all()
        flow, columns = derivatives.flow(space.start, FRAMES, pixels, IMAGE)
        assert flow.shape == (FRAMES, 1, 8, 2)
        assert np.isfinite(columns).all()


@pytest.mark.parametrize("body", [ROLLING, FLYING])
def test_derivatives_without_friction_are_numbers(body):
    space = space_of(dataclasses.replace(body, friction=(0.0, 0.0)))
    columns = Differentiator(space, simulator("sphere")).outlines(space.start, FRAMES, IMAGE)[1]
    assert np.isfinite(columns).all()


def test_what_is_not_a_number_is_told():
    space = space_of(FLYING)
    derivatives = Differentiator(space, simulator("sphere"))

    def root(poses, size, position, pitch, fovy):
        # The camera does not move sideways: an infinite slope times zero.
        return jnp.sqrt(jnp.maximum(poses[:, 0, 0] - poses[:, 0, 0], 0.0))

    with pytest.raises(DerivativeError, match=r"s\.position\.x"):
        derivatives.jacobian(space.start, FRAMES, root)


def test_columns_that_are_not_finite_are_named():
    bad = np.zeros((2, 3))
    bad[1, 2] = np.inf
    with pytest.raises(DerivativeError, match="in b is not finite from row 2 of 3"):
        require_finite(np.zeros(3), bad, ("a", "b"))
    with pytest.raises(DerivativeError, match="the rollout"):
        require_finite(np.array([0.0, np.nan]), np.zeros((2, 2)), ("a", "b"))


def test_another_scene_kind_is_refused():
    with pytest.raises(ValueError, match="scene kind"):
        Differentiator(space_of(FLAT), simulator("sphere"))


def test_the_solver_is_put_back():
    from mujoco.mjx._src import math, solver

    before = solver.solve, math.quat_integrate
    with differentiable_steps():
        assert solver.solve is not before[0]
        assert math.quat_integrate is not before[1]
    assert (solver.solve, math.quat_integrate) == before


@pytest.mark.parametrize("speed", [0.0, 1e-9, 1e-3, 0.4, 0.5, 30.0, 1e3])
def test_the_turn_is_mujocos_and_has_derivatives_also_at_rest(speed):
    q, v, dt = np.array(UNIT), speed * np.array([0.6, -0.64, 0.48]), 1 / 240
    expected = q.copy()
    mujoco.mju_quatIntegrate(expected, v, dt)
    with jax.enable_x64(True):
        turned = quat_integrate(jnp.asarray(q), jnp.asarray(v), jnp.asarray(dt))
        slope = jax.jacobian(quat_integrate, 1)(jnp.asarray(q), jnp.asarray(v), jnp.asarray(dt))
    np.testing.assert_allclose(turned, expected, atol=1e-12)
    for k, unit in enumerate(np.eye(3)):
        ends = [q.copy(), q.copy()]
        for end, sign in zip(ends, (1, -1), strict=True):
            mujoco.mju_quatIntegrate(end, v + sign * 1e-4 * unit, dt)
        np.testing.assert_allclose(slope[:, k], (ends[0] - ends[1]) / 2e-4, atol=1e-9)


@pytest.mark.slow
def test_implicit_derivatives_are_those_of_a_converged_solver():
    """In double precision, the iterations differentiated one by one end where the implicit function theorem does."""
    with jax.enable_x64(True):
        tight = MjxSimulator(("sphere",), 30.0, iterations=50, ls_iterations=50)
        widen = functools.partial(
            jax.tree.map, lambda a: a.astype(jnp.float64) if getattr(a, "dtype", None) == jnp.float32 else a
        )
        tight._model, tight._data = widen(tight._model), widen(tight._data)
        tight._model = tight._model.tree_replace({"opt.tolerance": jnp.asarray(1e-13)})
        space = space_of(ROLLING)
        inputs, moves = jax.tree.map(jnp.asarray, tangents(space, space.start))

        def trajectory(values):
            return tight.trajectory(values.leaves, values.qpos, values.qvel, 3)

        def push(values, along):
            return jax.vmap(lambda move: jax.jvp(trajectory, (values,), (move,))[1])(along)

        loop = np.asarray(jax.jit(push)(inputs, moves))
        with differentiable_steps():
            implicit = np.asarray(jax.jit(lambda a, b: push(a, b))(inputs, moves))
    np.testing.assert_allclose(implicit, loop, atol=1e-6 * np.abs(loop).max())


# Which derivatives to trust ---------------------------------------------------------------------------------------------


def verdict(body: Body, with_autodiff: bool) -> Verdict:
    space = space_of(body)
    derivatives = Differentiator(space, simulator(body.shape)) if with_autodiff else None
    return check(space, space.start, FRAMES, IMAGE, autodiff=derivatives)


def test_check_trusts_automatic_derivatives_in_flight():
    told = verdict(FLYING, True)
    assert told.method == "autodiff"
    assert told.autodiff_parts == FRAMES
    assert told.autodiff is not None
    assert told.autodiff.min() > 0.999
    assert told.reason == "automatic derivatives agree with finite differences in every frame"


def test_check_works_without_automatic_derivatives():
    told = verdict(FALLING, False)
    assert told.method == "differences"
    assert told.autodiff is None
    assert told.autodiff_parts is None


def test_check_sees_the_jags_of_a_ball_that_hardly_damped_chatters_on_the_floor():
    told = verdict(dataclasses.replace(ROLLING, damping=-4.0), True)
    assert told.method == "differences"
    assert told.narrow.min() < 0.9
    assert "fine jag" in told.reason


def test_check_gives_up_where_even_wide_differences_disagree():
    # A die that hardly loses speed lands on one corner after another.
    die = Body("box", "b", (0.2, 0.2, 0.2), (0.0, 0.0, 1.0), UNIT, (1.0, 0.0, 0.0), (3.0, 7.0, 2.0), damping=-4.0)
    space = space_of(die)
    told = check(space, space.start, 40, IMAGE)
    assert told.method == "population"
    assert told.differences_part < 20
    assert "jagged" in told.reason


def test_check_names_kinks():
    told = verdict(FLAT, False)
    assert told.kinks == ("b.tilt.x", "b.tilt.y")
    assert "no derivative here in b.tilt.x, b.tilt.y" in told.reason


def test_inputs_are_double_and_batched():
    space = space_of(FLAT)
    everything = inputs_of(space.decode(np.repeat(space.start[None], 3, 0)))
    assert {leaf.dtype for leaf in jax.tree.leaves(everything)} == {np.dtype(np.float64)}
    assert {len(leaf) for leaf in jax.tree.leaves(everything)} == {3}
