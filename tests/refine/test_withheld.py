"""The withheld exam: its physics against closed forms, its pictures against MuJoCo's rays, how it is made."""

from __future__ import annotations

import json
import math
from collections import Counter

import numpy as np
import pytest

pytest.importorskip("pybullet", reason="the exam needs the bench extra")

from benchmarks.clips import reference
from benchmarks.clips.camera import Camera
from benchmarks.withheld import exam, families, masks, physics, plan, solids, solve, start
from benchmarks.withheld.effect import Effect
from benchmarks.withheld.exam import Order
from benchmarks.withheld.film import Film
from benchmarks.withheld.stage import Stage, moved_picture
from benchmarks.withheld.view import view_of


def ball(position, velocity=(0.0, 0, 0), spin=(0.0, 0, 0), radius=0.25, friction=0.5, mass=1.5, rolling=0.0):
    return {
        "type": "sphere",
        "name": "sphere_0",
        "radius": radius,
        "state": {
            "position": list(position),
            "orientation": [1.0, 0, 0, 0],
            "linear_velocity": list(velocity),
            "angular_velocity": list(spin),
        },
        "physics": {"friction": [friction, rolling], "mass": mass, "damping": -60.0},
    }


def scene(*objects, gravity=9.81):
    return [
        *objects,
        {"type": "camera", "fovy": 45.0, "orientation": 45.0, "position": [0.0, -2.0, 3.5]},
        {"type": "gravity", "gravity": [0.0, 0.0, -gravity]},
    ]


def flying(**options):
    return Stage(scene(ball((-0.8, 0.5, 0.6), (1.5, 0.6, 2.5), (3.0, 2.0, 6.0)), **options), "flight")


def shapes():
    turned = [0.9, 0.2, -0.3, 0.25]
    box = {**ball((-0.9, 1.0, 0.7), (0.8, 0.3, 1.0), (1.0, -2.0, 0.5)), "type": "box", "name": "box_0"}
    rod = {**ball((0.8, 0.9, 0.8), (-0.5, 0.2, 1.0), (2.0, 1.0, 0.0)), "type": "cylinder", "name": "cylinder_0"}
    for body in (box, rod):
        del body["radius"]
        body["state"] = {**body["state"], "orientation": turned}
    box["size"] = [0.4, 0.25, 0.2]
    rod["radius"], rod["height"] = 0.2, 0.7
    return scene(box, rod, ball((0.0, 2.2, 0.6), (0.2, 0.5, 0.5)))


# ---- physics --------------------------------------------------------------------------------------------------------


def test_drag_follows_its_closed_form():
    linear, quadratic, mass, speed = 0.3, 0.2, 1.5, 3.0
    effect = Effect("drag", 0, {"linear": linear, "quadratic": quadratic})
    track = physics.simulate(scene(ball((0, 0, 3.0), (speed, 0, 0)), gravity=0.0), (effect,), 0.6)
    # v / (a + b v) = C exp(-a t / m)
    c = speed / (linear + quadratic * speed) * np.exp(-linear * 0.5 / mass)
    assert track.speed[240, 0] == pytest.approx(linear * c / (1 - quadratic * c), rel=2e-3)


def test_magnus_turns_in_a_circle():
    effect = Effect("magnus", 0, {"coefficient": 0.2})
    track = physics.simulate(scene(ball((0, 0, 3.0), (2, 0, 0), (0, 0, 6.0)), gravity=0.0), (effect,), 0.6)
    angle = 0.2 * 6.0 / 1.5 * 0.5
    way = track.position[241, 0] - track.position[240, 0]
    assert math.atan2(way[1], way[0]) == pytest.approx(angle, abs=0.01)
    assert track.speed[240, 0] == pytest.approx(2.0, rel=2e-3)


def test_push_gives_its_impulse_and_no_more():
    effect = Effect("push", 0, {"time": 0.2, "x": 1.5, "y": -0.6, "z": 0.0})
    track = physics.simulate(scene(ball((0, 0, 3.0)), gravity=0.0), (effect,), 0.5)
    velocity = (track.position[230, 0] - track.position[130, 0]) * 480 / 100
    np.testing.assert_allclose(velocity, [1.0, -0.4, 0.0], atol=1e-6)
    assert np.abs(track.position[96, 0] - [0, 0, 3.0]).max() < 1e-9
    assert np.nonzero(track.acting[0, :, 0])[0].tolist() == list(range(96, 104))


def test_wind_presses_a_resting_body_with_the_pressure_of_the_key():
    effect = families.CATALOGUE["wind"].draw(np.random.default_rng(0), flying())(6.0)
    track = physics.simulate(scene(ball((0, 0, 3.0), mass=50.0), gravity=0.0), (effect,), 0.2)
    force = 50.0 * (track.position[48, 0] - track.position[0, 0]) * 2 / (48 * 49 / 480**2)
    area = np.pi * 0.25**2
    np.testing.assert_allclose(force[:2] / area, [effect.parameters["x"], effect.parameters["y"]], rtol=0.01)


def test_a_ball_rolls_down_a_slope_as_it_should():
    effect = Effect("slope", None, {"x": 0.0, "y": 4.0})
    track = physics.simulate(scene(ball((0, 0, 0.25))), (effect,), 1.1)
    down = np.linalg.norm(track.position[480, 0] - track.position[0, 0])
    assert down == pytest.approx(0.5 * 5 / 7 * 9.81 * np.sin(np.radians(4)), rel=0.03)
    normal = physics.slope_rotation(0, 4.0)[:, 2]
    assert normal[0] > 0  # turned about +y, the floor falls towards +x
    np.testing.assert_allclose(track.position[:, 0] @ normal, 0.25, atol=2e-3)


def test_an_offset_centre_of_mass_swings_below_the_geometric_one():
    effect = Effect("offset_com", 0, {"x": 0.1, "y": 0.0, "z": 0.0})
    track = physics.simulate(scene(ball((0, 0, 0.25), mass=1.0)), (effect,), 0.3)
    np.testing.assert_allclose(track.position[0, 0], [0, 0, 0.25], atol=1e-6)
    assert track.position[100, 0, 0] > 0.01  # the heavy side goes down, so it rolls that way
    still = physics.simulate(scene(ball((0, 0, 0.25))), (Effect("offset_com", 0, {"x": 0, "y": 0, "z": -0.1}),), 0.3)
    np.testing.assert_allclose(still.position[-1, 0], [0, 0, 0.25], atol=1e-3)


def test_the_hidden_face_is_where_the_key_says():
    stage = Stage(scene(ball((-1.0, 1.0, 0.25), (2.5, 0.5, 0))), "roll")
    for draw in range(4):
        effect = families.CATALOGUE["hidden_obstacle"].draw(np.random.default_rng(draw), stage)(0.6)
        track = stage.run((effect,))
        angle, distance = track.wall
        normal = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
        step = int(np.nonzero(track.acting[0, :, 0])[0][0])
        assert track.position[step, 0, :2] @ normal - distance == pytest.approx(0.25, abs=0.01)
        before, after = track.position[step - 20, 0, :2], track.position[step, 0, :2]
        assert (after - before) @ normal < 0  # it came from the free side
        assert track.position[min(step + 100, 500), 0, :2] @ normal - distance > 0.24


def test_friction_changes_on_the_patch_alone():
    box = {**ball((0, 0.5, 0.2), (3.0, 0, 0), friction=0.2), "type": "box", "size": [0.3, 0.3, 0.2]}
    del box["radius"]
    patch = Effect("friction_patch", None, {"x": 1.2, "y": 0.5, "radius": 0.3, "friction": 0.8})
    track = physics.simulate(scene(box), (patch,), 1.0)
    slowing = -np.gradient(track.speed[:, 0]) * 480
    on = (np.abs(track.position[:, 0, 0] - 1.2) < 0.25) & (track.speed[:, 0] > 0.2)
    assert on.sum() > 50
    off = track.position[:, 0, 0] < 0.8
    assert np.median(slowing[on]) == pytest.approx(0.8 * 9.81, rel=0.05)
    assert np.median(slowing[off]) == pytest.approx(0.2 * 9.81, rel=0.05)
    np.testing.assert_array_equal(track.acting[0, :, 0][on], True)
    assert not track.acting[0, :, 0][off].any()


# ---- camera and pictures --------------------------------------------------------------------------------------------

POINT = np.array([[0.5, 1.0, 0.2]])


@pytest.mark.parametrize(
    ("name", "parameters", "way"),
    [
        ("camera_motion", {"pan": 3.0, "tilt": 0.0, "x": 0.0, "y": 0.0, "z": 0.0}, (-1, 0)),
        ("camera_motion", {"pan": 0.0, "tilt": 3.0, "x": 0.0, "y": 0.0, "z": 0.0}, (0, 1)),
        ("camera_motion", {"pan": 0.0, "tilt": 0.0, "x": 0.1, "y": 0.0, "z": 0.0}, (-1, 0)),
    ],
)
def test_camera_turns_the_way_the_names_say(name, parameters, way):
    view = view_of(Camera.of(scene()), (Effect(name, None, parameters),), 30)
    plain = Camera.of(scene()).project(POINT)[0, :2]
    np.testing.assert_allclose(view.project(POINT, 0)[0], plain, atol=1e-9)
    moved = view.project(POINT, 29)[0] - plain
    assert moved @ way > 5
    assert abs(moved @ way) > 0.95 * np.linalg.norm(moved)


def test_roll_turns_the_picture_clockwise():
    camera = Camera.of(scene())
    view = view_of(camera, (Effect("camera_roll", None, {"angle": 5.0}),), 3)
    arm, turned = (p[0, :2] - [240, 160] for p in (camera.project(POINT), view.project(POINT, 1)))
    c, s = np.cos(np.radians(5)), np.sin(np.radians(5))
    np.testing.assert_allclose(turned, [c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]], atol=1e-6)  # y is down


def test_lens_is_undone_by_its_rays():
    view = view_of(Camera.of(scene()), (Effect("lens_distortion", None, {"k1": -0.2}),), 2)
    image = np.random.default_rng(0).uniform((0, 0), (480, 320), (40, 2))
    world = view.origin[0] + view.rays(image) @ view.turn[0].T * 3
    np.testing.assert_allclose(view.project(world, 0), image, atol=1e-8)
    assert np.linalg.norm(view.project(world, 0)[0] - [240, 160]) < np.linalg.norm(
        Camera.of(scene()).project(world)[0, :2] - [240, 160]
    )


def test_lost_and_doubled_frames():
    def index(count):
        effect = Effect("dropped_frames", None, {"frame": 5, "count": count})
        return np.round(view_of(Camera.of(scene()), (effect,), 9).times * 30).astype(int).tolist()

    assert index(2) == [0, 1, 2, 3, 4, 7, 8, 9, 10]
    assert index(-2) == [0, 1, 2, 3, 4, 4, 4, 5, 6]


def test_ids_and_flow_are_those_of_mujocos_rays():
    stage = Stage(shapes(), "flight")
    film, steps = stage.base, (np.arange(30) * 16)
    poses = np.concatenate([film.track.position[steps], film.track.quaternion[steps]], -1)[3:5]
    ids = reference.id_images(stage.entries, poses, (480, 320), 1)
    mine = film.cast(3)
    assert (mine.ids != ids[0]).mean() < 1e-4
    flow = reference.exact_flow(stage.entries, poses, (480, 320), 1)[0]
    inside = (mine.ids > 0) & (ids[0] == mine.ids)
    assert np.abs(film.flow(3, mine) - flow)[inside].max() < 0.02
    assert np.abs(film.flow(3, mine)[mine.ids == 0]).max() == 0


def test_rolling_shutter_shows_each_row_at_its_moment():
    stage = flying()
    film = stage.film((Effect("rolling_shutter", None, {"readout": 0.03}),))
    hits = film.cast(12)
    rows, columns = np.nonzero(hits.ids == 1)
    times = 12 / 30 + 0.03 * ((rows + 0.5) / 320 - 0.5)
    place, turn, _ = film.track.at(times, 0)
    world = place + np.einsum("nij,nj->ni", turn, hits.local[rows, columns])
    image = stage.camera.project(world)[:, :2]
    np.testing.assert_allclose(image, np.stack([columns, rows], -1) + 0.5, atol=1e-3)


@pytest.mark.parametrize("form", ["ellipsoid", "rounded", "tapered"])
@pytest.mark.parametrize("index", [0, 1])
def test_other_solids_are_met_on_their_surface(form, index):
    solid = solids.another(shapes()[index], form, 0.5, np.array([0.3, -0.2, 0.1]))
    np.testing.assert_allclose(solid.level(solid.points), 1, atol=1e-6)
    rng = np.random.default_rng(1)
    origin = solids.directions(50) * 3
    way = rng.normal(0, 0.1, (50, 3)) - origin
    met = solid.meet(origin, way)
    hit = np.isfinite(met)
    assert hit.sum() > 30
    np.testing.assert_allclose(solid.level(origin[hit] + met[hit, None] * way[hit]), 1, atol=1e-4)
    # Nothing of the solid lies before the hit.
    assert (solid.level(origin[hit] + 0.98 * met[hit, None] * way[hit]) > 1).all()


# ---- sizes ----------------------------------------------------------------------------------------------------------


def solved(stage, name, target, seed=0):
    for again in range(20):
        found = solve.solve(np.random.default_rng([seed, again]), stage, name, target)
        if found is not None:
            assert abs(found.px / target - 1) < solve.TOLERANCE
            return found
    raise AssertionError(f"{name} was never solved")


@pytest.mark.parametrize("name", ["drag", "magnus", "push"])
def test_forces_move_the_ball_by_the_key_s_pixels(name):
    stage = flying()
    one = solved(stage, name, 12.0)
    track = stage.run((one.effect,))
    steps = np.arange(30) * 16
    image = [stage.camera.project(t.position[steps, 0])[:, :2] for t in (stage.track, track)]
    moved = np.linalg.norm(image[0] - image[1], axis=-1).max()
    assert moved == pytest.approx(one.px, rel=0.1)  # the outline also grows and shrinks with depth


def test_roll_moves_the_corners_by_the_key_s_pixels():
    one = solved(flying(), "camera_roll", 12.0)
    chord = 2 * np.sin(np.radians(abs(one.effect.parameters["angle"])) / 2) * np.hypot(240, 160)
    assert one.px == pytest.approx(chord, rel=0.01)


def test_pan_moves_the_floor_by_the_key_s_pixels():
    stage = flying()
    one = solved(stage, "camera_motion", 20.0)
    view = view_of(stage.camera, (one.effect,), 30)
    film = Film(stage.track, view, stage.base.solids)
    assert one.px == pytest.approx(moved_picture(stage.base, film), rel=1e-9)
    centre = stage.camera.on_plane(np.array([240.0, 160.0]), 0.0)
    assert np.linalg.norm(view.project(centre, 29) - [240, 160]) <= one.px * 1.001


@pytest.mark.parametrize("width", [5.0, -4.5])
def test_bias_moves_the_outline_by_its_width(width):
    film = flying().base
    plain, biased = film.cast(8).ids > 0, masks.widened(film, 8, width) > 0
    radius = [math.sqrt(m.sum() / math.pi) for m in (plain, biased)]
    assert radius[1] - radius[0] == pytest.approx(width, abs=0.2)


def test_an_occluder_bites_by_the_key_s_pixels():
    stage = flying()
    one = solved(stage, "occluder", 10.0)
    part = masks.rectangle(one.effect.parameters)
    most = 0.0
    for frame in range(30):
        seen = stage.base.cast(frame).ids > 0
        left = seen.copy()
        left[part] = False
        box = [np.array([v for axis in np.nonzero(m) for v in (axis.min(), axis.max())]) for m in (seen, left)]
        most = max(most, float(np.abs(box[0] - box[1]).max()))
    assert most == pytest.approx(one.px, abs=3.0)


# ---- making ---------------------------------------------------------------------------------------------------------


def test_plan_is_the_seed_s_and_shuffled():
    counts = {"one": 34, "two": 5, "none": 6, "withheld": 4, "strange": 7}
    a, b, c = (plan.orders(seed, counts) for seed in (3, 3, 4))
    assert a == b
    assert [o.effects for o in a] != [o.effects for o in c]
    assert Counter(o.split for o in a) == counts
    assert set(Counter(o.effects for o in a if o.split == "one").values()) == {2}
    assert [o.split for o in a] != sorted(o.split for o in a)
    assert abs(Counter(o.flow for o in a)["dis"] - 28) <= 3
    assert {o.effects for o in plan.orders(3, {"one": 6}, ("drag", "push"))} == {("drag",), ("push",)}
    with pytest.raises(ValueError, match="darg"):
        plan.orders(3, {"one": 1}, ("darg",))


def test_every_pair_and_name_is_known():
    assert set(families.CATALOGUE) & set(families.STRANGE) == set()
    assert {name for pair in families.PAIRS for name in pair} <= set(families.CATALOGUE)
    assert len(families.CATALOGUE) == 17
    for pair in families.PAIRS:  # some motion suits both
        assert set(families.CATALOGUE[pair[0]].kinds) & set(families.CATALOGUE[pair[1]].kinds)


def test_the_same_seed_writes_the_same_clip(tmp_path):
    order = Order("one", ("mask_bias",), "exact", (5, 2))
    lines = [exam.write_clip(tmp_path / name, 4, order) for name in "ab"]
    assert lines[0] == lines[1]
    for name in ("clips/004/init.yaml", "clips/004/without.txt", "key/004.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    with (
        np.load(tmp_path / "a/clips/004/flows.npz", allow_pickle=False) as a,
        np.load(tmp_path / "b/clips/004/flows.npz", allow_pickle=False) as b,
    ):
        assert sorted(a) == ["flow", "flow_sigma", "fps", "masks"]
        for name in a:
            np.testing.assert_array_equal(a[name], b[name])
        assert a["flow"].shape == (29, 320, 480, 2)
        noise = a["flow"][:, :4].astype(float)
    assert noise.std() == pytest.approx(0.2, rel=0.05)
    key = json.loads((tmp_path / "a/key/004.json").read_text())
    assert key["effects"][0]["px"] == pytest.approx(abs(key["effects"][0]["parameters"]["width"]), abs=1e-3)
    assert (tmp_path / "a/clips/004/without.txt").read_text() == ""


def test_the_start_is_rough_and_stands_on_the_floor():
    entries = scene(ball((0.3, 0.8, 0.25), (1.0, 0.5, 0)), ball((0.9, 0.8, 0.9)))
    guess = start.rough(entries, np.random.default_rng(0))
    assert guess[0]["state"]["position"][2] == pytest.approx(guess[0]["radius"])
    assert guess[0]["radius"] != entries[0]["radius"]
    assert guess[0]["state"]["linear_velocity"][2] == 0
    assert guess[0]["physics"]["mass"] == entries[0]["physics"]["mass"]
    assert entries[2]["fovy"] == 45.0  # the truth is left alone
    assert guess[2]["fovy"] != 45.0
