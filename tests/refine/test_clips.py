"""Benchmark clips: camera geometry, engines, filters, determinism, and how rough the samples are."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest
import yaml

pytest.importorskip("pybullet", reason="the clips need the bench extra")

from benchmarks.clips import bounce, bullet, clip, folders, reference, rotation, samples, scenes, writing
from benchmarks.clips.camera import Camera

SIZE = (240, 160)


def ball(position, radius=0.3, velocity=(0.0, 0, 0), name="sphere_0", restitution=0.1):
    return {
        "type": "sphere",
        "name": name,
        "radius": radius,
        "state": {
            "position": list(position),
            "orientation": [1.0, 0, 0, 0],
            "linear_velocity": list(velocity),
            "angular_velocity": [0.0, 0, 0],
        },
        "physics": {"friction": [0.5, 0.001], "mass": 1.0, "damping": bounce.damping(restitution)},
    }


def scene(*objects, fovy=45.0, pitch=45.0, height=3.5, gravity=9.81):
    return [
        *objects,
        {"type": "camera", "fovy": fovy, "orientation": pitch, "position": [0.0, -2.0, height]},
        {"type": "gravity", "gravity": [0.0, 0.0, -gravity]},
    ]


def every_shape():
    turned = rotation.about(np.array([0.3, -0.5, 0.8]), 0.9).tolist()
    box = {**ball((-0.8, 1.0, 0.6)), "type": "box", "name": "box_0", "size": [0.4, 0.25, 0.2]}
    rod = {**ball((0.7, 0.9, 0.7)), "type": "cylinder", "name": "cylinder_0", "radius": 0.2, "height": 0.7}
    for body in (box, rod):
        del body["radius"]
        body["state"] = {**body["state"], "orientation": turned}
    rod["radius"] = 0.2
    return scene(box, rod, ball((0.0, 2.2, 0.5)))


@pytest.fixture(scope="module")
def film():
    return clip.make_clip(3, "collision", 2, size=SIZE, supersample=1)


def test_camera_looks_where_the_format_says():
    down = Camera((0.0, -2.0, 3.0), 0.0, 50.0)
    np.testing.assert_allclose(down.project(np.array([0.0, -2.0, 0.0])), [240, 160, 3], atol=1e-9)
    ahead = Camera((0.0, -2.0, 3.0), 90.0, 50.0)
    np.testing.assert_allclose(ahead.project(np.array([0.0, 5.0, 3.0])), [240, 160, 7], atol=1e-9)
    above, right = ahead.project(np.array([0.0, 5.0, 4.0])), ahead.project(np.array([1.0, 5.0, 3.0]))
    assert above[1] < 159
    assert right[0] > 241
    # The upper edge of the picture is half the field of view off the axis.
    edge = ahead.project(np.array([0.0, 5.0, 3.0 + 7 * np.tan(np.radians(25))]))
    assert edge[1] == pytest.approx(0, abs=1e-9)


def test_rays_invert_projection():
    rng = np.random.default_rng(0)
    camera = Camera((0.0, -2.0, 3.3), 41.0, 52.0)
    image = rng.uniform((0, 0), (480, 320), (50, 2))
    points = np.array(camera.position) + camera.rays(image) * rng.uniform(1, 9, (50, 1))
    np.testing.assert_allclose(camera.project(points)[:, :2], image, atol=1e-9)


@pytest.mark.parametrize(
    ("place", "pitch", "fovy"), [((0.0, 1.5, 0.3), 45, 45), ((-1.2, 0.6, 0.4), 35, 58), ((1.0, 2.0, 0.5), 52, 36)]
)
def test_bullet_samples_pixel_centres(place, pitch, fovy):
    entries = scene(ball(place), pitch=pitch, fovy=fovy)
    camera = Camera.of(entries)
    with bullet.quiet(), bullet.open_world(entries, 0) as world:
        mask = world.masks(world.simulate(1, 30.0), camera, [0])[0] > 0
    rays, to = camera.pixel_rays(), np.array(place) - np.array(camera.position)
    exact = np.linalg.norm(to - (rays @ to)[..., None] * rays, axis=-1) < 0.3
    assert (mask ^ exact).sum() <= 0.005 * exact.sum()  # half a pixel off would be about 4 %
    for found, true in zip(np.nonzero(mask), np.nonzero(exact), strict=True):
        assert found.mean() == pytest.approx(true.mean(), abs=0.05)


def test_both_rasterisers_see_the_same_shapes():
    entries = every_shape()
    camera = Camera.of(entries)
    with bullet.quiet(), bullet.open_world(entries, 0) as world:
        motion = world.simulate(1, 30.0)
        drawn = world.masks(motion, camera, [0])
    poses = np.concatenate([motion.position, motion.quaternion], -1)
    cast = reference.id_images(entries, poses, (480, 320), stride=1)
    assert set(np.unique(cast)) == {0, 1, 2, 3}
    for i in (1, 2, 3):
        assert ((drawn == i) & (cast == i)).sum() > 0.99 * ((drawn == i) | (cast == i)).sum()


def test_flight_follows_the_parabola_and_keeps_its_spin():
    body = every_shape()[1]
    body["state"] |= {"position": [0, 1, 3.0], "linear_velocity": [1.0, -0.5, 2.0], "angular_velocity": [0, 0, 5.0]}
    entries = scene(body, gravity=7.0)
    with bullet.quiet(), bullet.open_world(entries, 0, painted=False) as world:
        motion = world.simulate(20, 30.0)
    t = np.arange(20) / 30
    want = np.array([0, 1, 3.0]) + t[:, None] * [1.0, -0.5, 2.0] + np.outer(t**2, [0, 0, -3.5])
    np.testing.assert_allclose(motion.position[:, 0], want, atol=0.012)  # the step is 1/240 s, semi-implicit
    start, end = rotation.matrix(motion.quaternion[[0, -1], 0])
    turned = rotation.matrix(rotation.about(np.array([0, 0, 1.0]), 5.0 * t[-1]))
    np.testing.assert_allclose(start.T @ end, turned, atol=0.02)  # about the body's own axis


@pytest.mark.parametrize("drop", [0.25, 0.4, 0.7])
@pytest.mark.parametrize("restitution", [0.2, 0.5, 0.8])
def test_one_damping_means_one_rebound_in_both_engines(restitution, drop):
    assert bounce.restitution(bounce.damping(restitution)) == pytest.approx(restitution)
    entries = scene(ball((0, 1, 0.3 + drop), restitution=restitution))
    with bullet.quiet(), bullet.open_world(entries, 0, painted=False) as world:
        ours = world.simulate(30, 30.0).position[:, 0, 2]
    touch = int(np.ceil(30 * np.sqrt(2 * drop / 9.81)))
    for height, slack in ((ours, 0.09), (reference.simulate(entries)[:, 0, 2], 0.14)):
        rebound = max(height[touch:].max() - 0.3, 0.0)
        assert np.sqrt(rebound / drop) == pytest.approx(restitution, abs=slack)


def test_what_rests_stays_at_rest():
    box = {**ball((-0.8, 1.0, 0.2)), "type": "box", "name": "box_0", "size": [0.4, 0.25, 0.2]}
    can = {**ball((0.7, 0.9, 0.35)), "type": "cylinder", "name": "cylinder_0", "radius": 0.2, "height": 0.7}
    del box["radius"]
    entries = scene(box, can, ball((0.0, 2.2, 0.3)))
    with bullet.quiet(), bullet.open_world(entries, 0, painted=False) as world:
        motion = world.simulate(30, 30.0)
    assert np.abs(motion.position - motion.position[0]).max() < 0.003
    assert np.abs(motion.quaternion - motion.quaternion[0]).max() < 0.01


def test_rotations_agree_with_mujoco():
    rng = np.random.default_rng(1)
    a, b = rotation.random(rng), rotation.random(rng)
    matrix, product = np.zeros(9), np.zeros(4)
    mujoco.mju_quat2Mat(matrix, a)
    mujoco.mju_mulQuat(product, a, b)
    np.testing.assert_allclose(rotation.matrix(a), matrix.reshape(3, 3), atol=1e-12)
    np.testing.assert_allclose(rotation.product(a, b), product, atol=1e-12)
    rim = np.linspace(0, 2 * np.pi, 2000)
    ring = np.stack([0.2 * np.cos(rim), 0.2 * np.sin(rim), np.full_like(rim, 0.35)], -1)
    low = min((ring @ rotation.matrix(a).T)[:, 2].min(), (-ring @ rotation.matrix(a).T)[:, 2].min())
    assert rotation.half_height({"type": "cylinder", "radius": 0.2, "height": 0.7}, a) == pytest.approx(-low, abs=1e-5)


def test_clip_is_an_observation(film):
    assert film.frames.shape == (30, 160, 240, 3)
    assert film.frames.dtype == np.uint8
    assert film.masks.shape == (30, 160, 240)
    assert film.flow.shape == (29, 160, 240, 2)
    assert film.flow.dtype == np.float16
    assert np.isfinite(film.flow).all()
    assert set(np.unique(film.masks)) == {0, 1, 2}
    assert sorted(film.mask_ids) == [1, 2]
    for i, entry in enumerate(bullet.bodies(film.truth)):
        np.testing.assert_allclose(film.position[0, i], entry["state"]["position"], atol=1e-9)
        shown = np.argwhere(film.masks[0] == film.mask_ids[i])[:, ::-1].mean(0) + 0.5
        centre = Camera.of(film.truth, *SIZE).project(film.position[0, i])[:2]
        assert np.linalg.norm(shown - centre) < 6


def test_measured_flow_follows_the_exact_one(film):
    poses = np.concatenate([film.position, film.quaternion], -1)
    exact = reference.exact_flow(film.truth, poses, SIZE)
    moving = (film.masks[:-1] > 0) & (np.linalg.norm(exact, axis=-1) > 1)
    error = np.linalg.norm(exact - film.flow.astype(float), axis=-1)
    assert np.median(error[moving]) < 0.5 * np.median(np.linalg.norm(exact, axis=-1)[moving])
    assert np.median(np.abs(film.flow[film.masks[:-1] == 0])) < 0.05


def test_same_seed_same_clip(film):
    again = clip.make_clip(3, "collision", 2, size=SIZE, supersample=1)
    assert again.truth == film.truth
    assert again.mask_ids == film.mask_ids
    for key in ("frames", "masks", "flow", "position", "quaternion"):
        np.testing.assert_array_equal(getattr(again, key), getattr(film, key))


def test_filters_name_what_is_wrong():
    moving = np.zeros((30, 80, 120), int)
    for frame in range(30):
        moving[frame, 10:30, 3 * frame : 3 * frame + 20] = 1
        moving[frame, 50:70, 90 - 3 * frame : 110 - 3 * frame] = 2
    assert clip.mask_fault(moving, 2, 30) is None
    tiny = np.where(moving == 1, 0, moving)
    tiny[:, 10:12, 10:15] = 1
    assert clip.mask_fault(tiny, 2, 30) == "too few pixels"
    late = moving.copy()
    late[0][late[0] == 1] = 0
    assert clip.mask_fault(late, 2, 30) == "hidden at the start"
    gone = moving.copy()
    gone[25:] = 0
    assert clip.mask_fault(gone, 2, 30) == "out of view"
    gone[25:] = np.where(moving[25:] == 2, 2, 0)
    assert clip.mask_fault(gone, 2, 30) is None  # one of two may leave
    alone = np.where(moving == 1, 1, 0)
    alone[25:] = 0
    assert clip.mask_fault(alone, 1, 30) == "out of view"
    still = np.broadcast_to(moving[:1], moving.shape)
    assert clip.mask_fault(still, 2, 30) == "too much stays where it is"


@pytest.mark.parametrize(
    ("objects", "fault"),
    [
        ([ball((0, 1, 0.3), velocity=(2, 0, 0)), ball((0.5, 1, 0.3), name="b")], "overlap at the start"),
        ([ball((0, 1, 0.2), velocity=(2, 0, 0))], "overlap at the start"),
        ([ball((0, 1, 0.3))], "hardly moves"),
        ([ball((0, -1.8, 3.0), velocity=(2, 0, 0))], "too close to the camera"),
        ([ball((0, 1, 0.3), velocity=(2, 0, 0))], None),
    ],
)
def test_motion_filters(objects, fault):
    entries = scene(*objects)
    with bullet.quiet(), bullet.open_world(entries, 0, painted=False) as world:
        motion = world.simulate(30, 30.0)
    assert clip.motion_fault(entries, "roll", motion, Camera.of(entries)) == fault


def test_plan_has_six_clips_of_each_number_and_all_kinds():
    plan = folders.plan(24)
    for objects in (1, 2, 3, 4):
        kinds = [kind for kind, count in plan if count == objects]
        assert len(kinds) == 6
        assert set(kinds) == set(scenes.KINDS) - ({"collision"} if objects == 1 else set())


@pytest.mark.parametrize(("kind", "objects"), [("hover", 1), ("collision", 1), ("roll", 0), ("roll", 5)])
def test_impossible_scenes_are_refused(kind, objects):
    with pytest.raises(ValueError, match=r"expected"):
        scenes.draw_scene(np.random.default_rng(0), kind, objects)


@pytest.fixture(scope="module")
def guesses(film):
    return samples.rough_samples(film.truth, film.masks, 4, stride=3)


def test_samples_are_as_rough_as_a_model(film, guesses):
    assert len(guesses.scenes) == 32
    assert guesses.iou.mean() == pytest.approx(0.30, abs=0.02)
    assert guesses.iou.max() == pytest.approx(0.38, abs=0.02)
    assert 0.55 < np.median(guesses.first_iou) < 0.75
    # What is reported is what the scenes are worth, on all pixels too.
    best = int(guesses.iou.argmax())
    assert samples.sample_iou(guesses.scenes[best], film.masks, stride=1).mean() == pytest.approx(
        guesses.iou[best], abs=0.02
    )
    assert samples.sample_iou(film.truth, film.masks, stride=1).mean() > 0.75


def test_samples_keep_what_a_model_gets_right_and_round_the_rest(film, guesses):
    truth = bullet.bodies(film.truth)
    for guess in guesses.scenes:
        objects = bullet.bodies(guess)
        assert [(e["type"], e["name"]) for e in objects] == [(e["type"], e["name"]) for e in truth]
        for entry in objects:
            numbers = [*entry["state"]["position"], *entry["state"]["linear_velocity"], entry["physics"]["friction"][0]]
            assert numbers == [round(v, 2) for v in numbers]
            assert entry["physics"]["damping"] < 0 < entry["physics"]["mass"]
            assert entry["state"]["angular_velocity"] is not None
    assert len({yaml.safe_dump(guess) for guess in guesses.scenes}) == 32


def test_an_unstable_guess_is_worth_nothing(film, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warning in the working directory
    broken = copy.deepcopy(film.truth)
    broken[0]["state"]["linear_velocity"] = [1e12, 0, 0]
    assert not samples.sample_iou(broken, film.masks).any()


@pytest.mark.parametrize("tagged", [True, False])
def test_files_of_samples_read_back(guesses, tagged):
    text = writing.samples_text(guesses.scenes[:5], tagged=tagged, broken=1)
    parts = [p.split("</answer>")[0] for p in text.split("<answer>")[1:]] if tagged else text.split("---\n")
    assert len(parts) == 5
    read, failed = [], 0
    for part in parts:
        try:
            read.append(yaml.safe_load(part))
        except yaml.YAMLError:
            failed += 1
    assert failed == 1
    assert all(scene in guesses.scenes for scene in read)


def test_folders_are_whole_and_not_made_twice(film, guesses, tmp_path, monkeypatch):
    from click.testing import CliRunner

    from benchmarks.clips import __main__ as command

    made = []
    monkeypatch.setattr(command, "film", lambda *a: made.append(a) or (film, guesses))
    for _ in range(2):
        result = CliRunner().invoke(command.main, ["--out", str(tmp_path), "--seed", "2", "--count", "1"])
        assert result.exit_code == 0, result.output
    assert len(made) == 1
    folder = next(tmp_path.iterdir())
    assert {p.name for p in folder.iterdir()} == {"flows.npz", "best32.yaml", "truth.yaml", "meta.json"}
    with np.load(folder / "flows.npz", allow_pickle=False) as arrays:
        assert set(arrays) == {"flow", "masks", "fps", "frames"}
        np.testing.assert_array_equal(arrays["masks"], film.masks)
        assert arrays["fps"] == 30
    assert yaml.safe_load((folder / "truth.yaml").read_text()) == film.truth


@pytest.mark.parametrize("friction", [0.15, 0.6])
def test_sliding_obeys_coulomb(friction):
    box = {**ball((0, 1, 0.15), velocity=(3.0, 0, 0)), "type": "box", "size": [0.3, 0.3, 0.15]}
    del box["radius"]
    box["physics"]["friction"][0] = friction
    entries = scene(box)
    with bullet.quiet(), bullet.open_world(entries, 0, painted=False) as world:
        went = world.simulate(30, 30.0).position[-1, 0, 0]
    time = min(29 / 30, 3 / (friction * 9.81))
    assert went == pytest.approx(3 * time - friction * 9.81 * time**2 / 2, abs=0.015)
