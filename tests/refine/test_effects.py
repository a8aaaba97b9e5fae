"""Effects in the rollout, against closed forms."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest
from effect_scenes import BALL, CAMERA, FPS, GRAVITY, STEP, effect, rolled_out

from mjx_refine import rotations
from mjx_refine.diagnosis.fits import slack
from mjx_refine.effects import batch_with_effects
from mjx_refine.effects.friction_patch import _stretches
from mjx_refine.effects.loading import Loading
from mjx_refine.scene import Body, Scene
from mjx_refine.sim.c import MujocoSimulator


def speeds(poses: np.ndarray) -> np.ndarray:
    return np.diff(poses[:, 0, :3], axis=0) * FPS


# In the rollout ---------------------------------------------------------------------------------------------------------


def test_linear_drag_is_an_exponential():
    poses = rolled_out(effect("drag", "ball", linear=1.4), linear_velocity=(3.0, -1.0, 0.5))
    n = 8 * np.arange(31)
    # MuJoCo's Euler steps: v <- v (1 - c h / m), then x <- x + h v.
    q = 1 - 1.4 * STEP / 0.7
    travelled = STEP * q * (1 - q**n) / (1 - q)
    np.testing.assert_allclose(poses[:, 0, :3], BALL.position + travelled[:, None] * [3.0, -1.0, 0.5], atol=1e-9)
    np.testing.assert_allclose(poses[-1, 0, 0], 3.0 * 0.5 * (1 - np.exp(-2.0)), rtol=0.01)


def test_quadratic_drag_has_a_terminal_speed():
    falling = rolled_out(effect("drag", "ball", quadratic=0.3), frames=121, gravity=GRAVITY)
    np.testing.assert_allclose(-speeds(falling)[-1, 2], np.sqrt(0.7 * GRAVITY / 0.3), rtol=1e-3)


def test_magnus_bends_a_path_to_a_circle():
    poses = rolled_out(
        effect("magnus", "ball", coefficient=0.07), linear_velocity=(2.0, 0.0, 0.0), angular_velocity=(0, 0, 15.0)
    )
    # F = c (spin x v): to the left of a body that spins counter-clockwise; radius m v / (c spin).
    radius = 0.7 * 2.0 / (0.07 * 15.0)
    distance = np.linalg.norm(poses[:, 0, :2] - [0.0, radius], axis=-1)
    np.testing.assert_allclose(distance, radius, rtol=0.01)
    assert poses[-1, 0, 1] > 0.5
    assert np.ptp(poses[:, 0, 2]) < 1e-9


def test_wind_pushes_every_object_by_its_mean_shadow_and_shape():
    box = Body("box", "box", (0.1, 0.2, 0.3), (5.0, 0.0, 50.0), mass=2.0)
    can = Body("cylinder", "can", (0.1, 0.4), (-5.0, 0.0, 50.0))
    poses = rolled_out(effect("wind", x=10.0, y=-5.0), others=(box, can))
    surfaces = [4 * np.pi * 0.2**2, 8 * (0.1 * 0.2 + 0.2 * 0.3 + 0.1 * 0.3), 2 * np.pi * 0.1 * (0.1 + 0.4)]
    n = 8 * 30
    # Times the drag coefficients of a ball, a box and a can, over that of the ball, which is the first.
    shapes = (1.0, 1.05 / 0.47, 0.8 / 0.47)
    for k, (surface, mass, more) in enumerate(zip(surfaces, (0.7, 2.0, 1.0), shapes, strict=True)):
        expected = np.array([10.0, -5.0]) * more * surface / 4 / mass * STEP**2 * n * (n + 1) / 2
        np.testing.assert_allclose(poses[-1, k, :2] - poses[0, k, :2], expected, rtol=1e-9)


def test_wind_is_drag_by_air_that_moves():
    # F = p A |r| r with r = w - v / 5 for air of 5 m/s along x; m dv/dt = -k (5 - v)^2 has v = 5 - 5 / (1 + 5 k t).
    poses = rolled_out(effect("wind", x=40.0, slowness=0.2))
    shadow, mass, time = np.pi * 0.2**2, 0.7, (len(poses) - 1) / FPS
    k = 40.0 * shadow / 25.0 / mass
    assert speeds(poses)[-1][0] == pytest.approx(5.0 - 5.0 / (1.0 + 5.0 * k * time), rel=0.02)
    still = rolled_out(effect("wind", x=40.0, slowness=0.2), linear_velocity=(5.0, 0.0, 0.0))
    np.testing.assert_allclose(speeds(still), np.tile([5.0, 0.0, 0.0], (len(still) - 1, 1)), atol=1e-9)
    # What flies across is held up as well.
    across = rolled_out(effect("wind", x=40.0, slowness=0.2), linear_velocity=(0.0, 0.0, 5.0))
    assert speeds(across)[-1][2] < 4.0
    plain = rolled_out(effect("wind", x=40.0), linear_velocity=(0.0, 0.0, 5.0))
    np.testing.assert_allclose(speeds(plain)[-1][2], 5.0, atol=1e-9)


@pytest.mark.parametrize("time", [0.3, 0.30217, 0.4999])
def test_a_push_is_an_impulse(time):
    poses = rolled_out(effect("push", "ball", time=time, x=0.7, y=-1.4, z=0.35), linear_velocity=(1.0, 0.0, 0.0))
    np.testing.assert_allclose(speeds(poses)[-1], [2.0, -2.0, 0.5], atol=1e-9)
    before = int(time * FPS)
    np.testing.assert_allclose(speeds(poses)[:before], np.tile([1.0, 0.0, 0.0], (before, 1)), atol=1e-9)


def test_a_push_is_smooth_in_its_time():
    ends = np.array([rolled_out(effect("push", "ball", time=t, x=0.7))[-1, 0, 0] for t in 0.4 + 0.0005 * np.arange(12)])
    # A later push leaves less time to travel: a straight line, across steps and frames.
    np.testing.assert_allclose(np.diff(ends), -0.0005, atol=1e-9)


def test_a_ball_rolls_down_a_slope_by_five_sevenths():
    slope, angle = effect("slope", y=6.0), np.deg2rad(6.0)
    up = np.array([np.sin(angle), 0.0, np.cos(angle)])
    start = 0.2 * up
    poses = rolled_out(slope, gravity=GRAVITY, position=tuple(start), friction=(1.0, 0.0), damping=-100.0)
    moved = poses[:, 0, :3] - start
    downhill = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    np.testing.assert_allclose(moved[-1] @ downhill, 0.5 * 5 / 7 * GRAVITY * np.sin(angle), rtol=0.01)
    assert np.abs(moved @ up).max() < 0.005
    assert np.abs(moved[:, 1]).max() < 1e-6


def test_a_slope_about_x_then_y_turns_the_floors_normal():
    a, b = np.deg2rad([10.0, 20.0])
    normal = np.array([np.sin(b) * np.cos(a), -np.sin(a), np.cos(b) * np.cos(a)])
    ball = {"position": tuple(0.2 * normal), "friction": (1.0, 0.0), "damping": -100.0}
    moved = np.diff(rolled_out(effect("slope", x=10.0, y=20.0), gravity=GRAVITY, **ball)[[0, -1], 0, :3], axis=0)[0]
    downhill = -np.array([0.0, 0.0, 1.0]) + normal[2] * normal
    np.testing.assert_allclose(moved / np.linalg.norm(moved), downhill / np.linalg.norm(downhill), atol=0.01)


def test_a_body_in_flight_does_not_feel_a_slope():
    state = {"gravity": GRAVITY, "linear_velocity": (1.0, 2.0, 3.0), "angular_velocity": (1.0, -2.0, 3.0)}
    flown, plain = rolled_out(effect("slope", x=9.0, y=-4.0), **state), rolled_out(**state)
    np.testing.assert_allclose(flown[..., :3], plain[..., :3], atol=1e-9)
    # Both signs of a quaternion are one turn.
    assert np.abs((flown[..., 3:] * plain[..., 3:]).sum(-1)).min() > 1 - 1e-9


def test_a_patch_has_its_own_stopping_distance():
    box = Body("box", "ball", (0.3, 0.3, 0.05), (0.0, 0.0, 0.05), friction=(0.1, 0.0), damping=-100.0)
    state = {"gravity": GRAVITY, "body": box, "linear_velocity": (2.0, 0.0, 0.0), "frames": 46}
    inside = rolled_out(effect("friction_patch", x=0.5, y=0.0, radius=5.0, friction=0.4), **state)
    np.testing.assert_allclose(inside[-1, 0, 0], 2.0**2 / (2 * 0.4 * GRAVITY), rtol=0.03)
    # Entered at 0.5 m: what is left of the energy is spent there.
    entered = rolled_out(effect("friction_patch", x=5.5, y=0.0, radius=5.0, friction=0.4), **state)
    left = (2.0**2 - 2 * 0.1 * GRAVITY * 0.5) / (2 * 0.4 * GRAVITY)
    np.testing.assert_allclose(entered[-1, 0, 0], 0.5 + left, rtol=0.03)
    beside = rolled_out(effect("friction_patch", x=0.0, y=9.0, radius=5.0, friction=0.4), **state)
    np.testing.assert_allclose(beside, rolled_out(**state), atol=1e-6)


def test_a_path_is_smooth_in_where_a_patch_begins():
    """A step covers some 8 mm: were all of it inside or none, most borders would change nothing, and some 6 mm at once."""
    box = Body("box", "ball", (0.3, 0.3, 0.05), (0.0, 0.0, 0.05), friction=(0.1, 0.0), damping=-100.0)
    state = {"gravity": GRAVITY, "body": box, "linear_velocity": (2.0, 0.0, 0.0), "frames": 31}
    borders = np.arange(0.49, 0.508, 0.001)
    patches = [effect("friction_patch", x=border + 5.0, y=0.0, radius=5.0, friction=0.4) for border in borders]
    ends = np.array([rolled_out(patch, **state)[-1, 0, 0] for patch in patches])
    assert np.abs(np.diff(ends)).max() < 0.0025
    assert (np.abs(np.diff(ends)) > 1e-5).mean() > 0.75
    # It gets 0.75 m farther for every metre that the border does: 1 - 0.1 / 0.4.
    np.testing.assert_allclose(np.polyfit(borders, ends, 1)[0], 0.75, atol=0.25)


def test_the_centre_of_mass_flies_a_parabola():
    centre = np.array([0.05, -0.02, 0.08])
    poses = rolled_out(
        effect("offset_com", "ball", x=0.05, y=-0.02, z=0.08),
        gravity=GRAVITY, linear_velocity=(1.0, 0.5, 4.0), angular_velocity=(3.0, 4.0, 0.0), frames=21,
    )[:, 0]  # fmt: skip
    masses = poses[:, :3] + rotations.rotate(poses[:, 3:], np.broadcast_to(centre, (21, 3)))
    time = np.arange(21)[:, None] / FPS
    start = np.array([1.0, 0.5, 4.0]) + np.cross([3.0, 4.0, 0.0], centre)
    path = masses[0] + start * time - 0.5 * GRAVITY * time * (time + STEP) * [0.0, 0.0, 1.0]
    np.testing.assert_allclose(masses, path, atol=0.004)
    assert np.abs(poses[:, :3] - (path - centre)).max() > 0.05, "the centre itself flies no parabola"


def test_wind_on_a_body_off_centre_acts_at_its_centre():
    poses = rolled_out(effect("wind", x=50.0), effect("offset_com", "ball", z=0.1), frames=4)
    # The torque about the mass, arm (0, 0, -0.1) x force, turns it about -y.
    assert poses[-1, 0, 5] < -1e-3
    assert np.abs(poses[-1, 0, [4, 6]]).max() < 1e-9


@pytest.mark.parametrize("restitution", [0.2, 0.5, 0.9])
def test_a_hidden_obstacle_returns_its_part_of_the_speed(restitution):
    wall = effect("hidden_obstacle", "ball", angle=210.0, distance=0.3, restitution=restitution)
    normal = np.array([np.cos(np.deg2rad(210.0)), np.sin(np.deg2rad(210.0)), 0.0])
    along = np.array([-normal[1], normal[0], 0.0])
    start = 1.2 * normal + [0.0, 0.0, 50.0]
    returned = []
    # Wherever within a step the wall is reached.
    for shift in (np.arange(8) + 0.5) / 8 * 2 * STEP:
        place = tuple(start - shift * normal)
        poses = rolled_out(wall, position=place, linear_velocity=tuple(-2 * normal + along), friction=(0.0, 0.0))
        after = speeds(poses)[-1]
        returned.append(after @ normal / 2)
        assert after @ along == pytest.approx(1.0, abs=1e-9)
        # It turns where the wall is, having sunk in a little.
        assert 0.25 < (poses[:, 0, :3] @ normal).min() - 0.2 < 0.31
    assert np.mean(returned) == pytest.approx(restitution, abs=0.02)
    np.testing.assert_allclose(returned, restitution, atol=0.035)


@pytest.mark.parametrize(("restitution", "returned"), [(0.05, -0.05), (0.5, -0.5), (0.9, -0.9)])
def test_a_path_is_smooth_in_where_an_obstacle_stands(restitution, returned):
    """A step covers 8 mm: where the wall is felt only once a step begins in it, 1 mm more at the border of one moved where a ball
    is after half a second by 0.3 m and more."""

    def end(distance: float) -> float:
        wall = effect("hidden_obstacle", "ball", angle=180.0, distance=distance, restitution=restitution)
        return float(rolled_out(wall, linear_velocity=(2.0, 0.0, 0.0), frames=31)[-1, 0, 0])

    places = np.arange(-0.83, -0.8, 0.001)
    ends = np.array([end(place) for place in places])
    assert np.abs(np.diff(ends)).max() < 0.04
    # A wall that stands 1 m farther turns the ball 1 m later; until then it comes, and thereafter it goes.
    np.testing.assert_allclose(np.polyfit(places, ends, 1)[0], returned - 1.0, atol=0.6)


@pytest.mark.parametrize("restitution", [0.1, 0.6])
def test_an_obstacle_returns_its_part_of_the_speed_of_what_touches_it(restitution):
    """Of a box that comes with an edge first, which then turns: Newton's law is about the edge, not the centre."""
    turned = rotations.exponential(np.array([[0.0, 0.0, 0.4]]))[0]
    box = Body("box", "ball", (0.3, 0.2, 0.2), (0.0, 0.0, 50.0), tuple(turned), friction=(0.0, 0.0))
    wall = effect("hidden_obstacle", "ball", angle=180.0, distance=-0.9, restitution=restitution)
    poses = rolled_out(wall, body=box, linear_velocity=(2.0, 0.0, 0.0), frames=31)
    velocity, spin = speeds(poses)[-1], slack.spins(poses, FPS)[-1, 0]
    assert abs(spin[2]) > 1.0
    # The edge that touched, as it was turned then.
    edge = max((rotations.rotate(turned, np.array([0.3, y, 0.0])) for y in (-0.2, 0.2)), key=lambda arm: arm[0])
    assert (velocity + np.cross(spin, edge))[0] == pytest.approx(-2.0 * restitution, abs=0.25)


def test_a_hidden_obstacle_rubs_by_coulombs_law():
    wall = effect("hidden_obstacle", "ball", angle=0.0, distance=-1.0, restitution=0.5)
    poses = rolled_out(wall, linear_velocity=(-2.0, 3.0, 0.0), friction=(0.2, 0.0))
    before, after = speeds(poses)[0], speeds(poses)[-1]
    # While it slips, the impulse along the wall is the friction's part of that across.
    assert before[1] - after[1] == pytest.approx(0.2 * (after[0] - before[0]), rel=1e-6)


def test_only_its_target_feels_a_hidden_obstacle():
    wall = effect("hidden_obstacle", "ball", angle=0.0, distance=-1.0)
    other = dataclasses.replace(BALL, name="other", position=(0.0, 3.0, 50.0), linear_velocity=(-2.0, 0.0, 0.0))
    poses = rolled_out(wall, linear_velocity=(-2.0, 0.0, 0.0), others=(other,))
    assert poses[-1, 0, 0] > -0.7
    assert poses[-1, 1, 0] == pytest.approx(-2.0, abs=1e-9)


@pytest.mark.parametrize(("count", "expected"), [(3, [0, 1, 2, 6, 7, 8]), (-2, [0, 1, 2, 2, 2, 3])])
def test_dropped_and_doubled_frames(count, expected):
    state = {"gravity": GRAVITY, "linear_velocity": (1.0, 0.0, 2.0)}
    shown = rolled_out(effect("dropped_frames", frame=3, count=count), frames=6, **state)
    np.testing.assert_array_equal(shown, rolled_out(frames=9, **state)[expected])


def test_a_rollout_that_diverges_does_so_in_silence():
    batch = batch_with_effects(
        [Scene((BALL,), CAMERA, (0.0, 0.0, -GRAVITY), effects=(effect("drag", "ball", quadratic=1.0),))]
    )
    fast = dataclasses.replace(batch, linear_velocity=np.full_like(batch.linear_velocity, 1e200))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        poses = MujocoSimulator(batch.shapes, 30.0).rollout(fast, 5)
    assert not np.isfinite(poses[:, 1:]).all()


def test_the_same_again_and_row_by_row():
    effects = (effect("drag", "ball", quadratic=0.2), effect("slope", x=5.0))
    scenes = [
        Scene(
            (dataclasses.replace(BALL, position=(0.0, 0.0, 0.5), linear_velocity=(v, 0.0, 0.0)),),
            CAMERA,
            effects=effects,
        )
        for v in (1.0, 2.0, 3.0)
    ]
    batch = batch_with_effects(scenes)
    one, other = (MujocoSimulator(batch.shapes, FPS, threads).rollout(batch, 20) for threads in (1, 2))
    np.testing.assert_array_equal(one, other)
    alone = MujocoSimulator(batch.shapes, FPS, 1).rollout(batch[1:2], 20)
    np.testing.assert_allclose(alone[0], one[1], atol=1e-12)


IDLING = (
    effect("push", "ball", time=0.31, x=1.0, z=0.5),
    effect("hidden_obstacle", "ball", angle=180.0, distance=-0.9, restitution=0.6),
    effect("friction_patch", x=0.5, y=0.0, radius=0.3, friction=0.05),
    effect("wind", x=60.0, y=20.0),
    effect("wind", x=60.0, y=20.0, slowness=0.1),
)


def single_steps(monkeypatch) -> None:
    monkeypatch.setattr(Loading, "idle", lambda loading, motion: 0.0)


@pytest.mark.parametrize("entry", IDLING, ids=lambda e: e.effect)
def test_steps_taken_together_end_where_single_ones_do(entry, monkeypatch):
    ball = dataclasses.replace(BALL, position=(0.0, 0.0, 0.2))
    state = {"gravity": GRAVITY, "body": ball, "linear_velocity": (1.6, 0.0, 0.0), "angular_velocity": (0.0, 2.0, 0.0)}
    together = rolled_out(entry, **state)
    single_steps(monkeypatch)
    np.testing.assert_allclose(together, rolled_out(entry, **state), atol=1e-4)
    assert np.abs(together - rolled_out(**state)).max() > 0.05


def test_a_steady_force_beside_the_centre_of_mass_is_looked_at_in_every_step(monkeypatch):
    ball = dataclasses.replace(BALL, position=(0.0, 0.0, 2.0))
    entries = effect("wind", x=60.0, y=20.0), effect("offset_com", "ball", x=0.04, y=0.0, z=0.02)
    state = {"gravity": GRAVITY, "body": ball, "angular_velocity": (0.0, 9.0, 0.0)}
    together = rolled_out(*entries, **state)
    single_steps(monkeypatch)
    np.testing.assert_allclose(together, rolled_out(*entries, **state), atol=1e-6)
    # A force at the mass itself would not turn the ball.
    assert np.abs(together - rolled_out(entries[1], **state))[..., 3:].max() > 0.05


SIZES = {"sphere": (0.15,), "box": (0.1, 0.15, 0.2), "cylinder": (0.12, 0.2)}


def tumble_at_a_wall(seed: int) -> Scene:
    """A body that falls, spins and flies to a wall, and another that comes behind it."""
    generator = np.random.default_rng(seed)

    def thrown(name: str, x: float) -> Body:
        shape = str(generator.choice(list(SIZES)))
        turn = rotations.normalise(generator.normal(size=4))
        return Body(
            shape,
            name,
            SIZES[shape],
            (x, generator.uniform(-0.1, 0.1), generator.uniform(0.3, 0.5)),
            tuple(turn),
            linear_velocity=(generator.uniform(-3, 0), generator.uniform(-0.5, 0.5), generator.uniform(-1, 1)),
            angular_velocity=tuple(generator.normal(0, 4, 3)),
        )

    bodies = thrown("one", 0.0), thrown("two", generator.uniform(0.5, 0.9))
    angle, distance = generator.uniform(-40, 40), generator.uniform(-0.8, -0.4)
    wall = effect("hidden_obstacle", "one", angle=angle, distance=distance, restitution=0.5)
    return Scene(bodies, CAMERA, (0.0, 0.0, -GRAVITY), (wall,))


def test_a_wall_is_looked_at_seldom_and_never_too_late(monkeypatch):
    """Steps together differ from single ones by the solver's first guess alone, which bounces let grow."""
    scenes, looks, idle = [tumble_at_a_wall(seed) for seed in range(30)], [0, 0], Loading.idle

    def run(each: int) -> np.ndarray:
        def counted(loading, motion):
            looks[each] += 1
            return 0.0 if each else idle(loading, motion)

        monkeypatch.setattr(Loading, "idle", counted)
        return np.array(
            [MujocoSimulator(s.shapes, FPS, 1).rollout(batch_with_effects([s]), 16)[0, ..., :3] for s in scenes]
        )

    apart = np.abs(run(0) - run(1)).max((1, 2, 3))
    assert np.median(apart) < 1e-6
    assert np.quantile(apart, 0.9) < 1e-4
    assert looks[0] < 0.4 * looks[1]


def test_patches_begin_where_a_path_may_lead_in_and_out():
    path = np.stack([np.linspace(0.0, 1.4, 15), np.zeros(15)], 1)
    found = _stretches(path)
    assert all(centre[1] == 0.0 and radius > 0.05 for centre, radius in found)
    borders = {round(float(centre[0] + side * radius), 6) for centre, radius in found for side in (-1, 1)}
    assert borders == {-0.42, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.82}
    # All pairs of eight borders but the first with the last.
    assert len(found) == 27
