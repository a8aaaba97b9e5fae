"""Blender-made clips: all that needs no Blender; with BPY_PYTHON (a Python that has bpy) also the engine and the pictures."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("pybullet", reason="the clips need the bench extra")

from benchmarks.blender import clevrer, clip, folders
from benchmarks.blender.__main__ import run
from benchmarks.blender.scenes import Drawn, Look, draw_scene, half_extents
from benchmarks.blender.studio import MARGIN, Studio, regions
from benchmarks.clips import rotation
from benchmarks.clips.camera import Camera
from benchmarks.clips.samples import SampleSet
from benchmarks.clips.writing import scene_text
from mjx_refine import load_observation
from mjx_refine.errors import InputError
from mjx_refine.scene import parse_scenes


def ball(place, velocity=(0.0, 0.0, 0.0), name="sphere_0", radius=0.2, friction=0.3):
    state = {
        "position": [*place, radius],
        "orientation": [1.0, 0.0, 0.0, 0.0],
        "linear_velocity": list(velocity),
        "angular_velocity": [0.0, 0.0, 0.0],
    }
    physics = {"friction": [friction, 0.0], "mass": 1.0, "damping": -40.0}
    return {"type": "sphere", "name": name, "radius": radius, "state": state, "physics": physics}


VIEW = [
    {"type": "camera", "fovy": 42.0, "orientation": 50.0, "position": [0.0, -2.0, 3.0]},
    {"type": "gravity", "gravity": [0.0, 0.0, -9.81]},
]
LIGHT = draw_scene(np.random.default_rng(0), 1).light


def drawn(*objects):
    return Drawn(
        [*objects, *VIEW], [Look("red", "rubber"), Look("blue", "metal")][: len(objects)], [0.5] * len(objects), LIGHT
    )


def straight(scene, frames=30, fps=30):
    """Poses of objects that keep their velocities and do not turn."""
    time = np.arange(frames)[:, None, None] / fps
    start = np.array([entry["state"]["position"] for entry in scene.objects])
    position = start + time * np.array([entry["state"]["linear_velocity"] for entry in scene.objects])
    turn = np.array([entry["state"]["orientation"] for entry in scene.objects])
    return position, np.broadcast_to(turn, (frames, *turn.shape)).copy()


@pytest.mark.parametrize("objects", [1, 2, 3, 4])
def test_scenes_are_sound(objects):
    for seed in range(5):
        scene = draw_scene(np.random.default_rng(seed), objects)
        again = draw_scene(np.random.default_rng(seed), objects)
        assert scene == again
        read = parse_scenes(scene_text(scene.entries))[0]
        assert len(read.objects) == len(set(scene.looks)) == objects
        assert np.linalg.norm(scene.objects[0]["state"]["linear_velocity"]) >= 0.9
        for entry, body in zip(scene.objects, scene.bodies(), strict=True):
            turn = np.array(body["quaternion"])
            assert body["position"][2] == pytest.approx(rotation.half_height(entry, turn), abs=1e-9)
            spin = rotation.matrix(turn) @ np.array(entry["state"]["angular_velocity"])
            assert np.allclose(body["spin"], spin)
            assert body["size"] == half_extents(entry)


def test_regions_hold_bodies_and_shadows():
    scene = draw_scene(np.random.default_rng(4), 3)
    camera, bodies = Camera.of(scene.entries), scene.bodies()
    position, _ = straight(scene)
    boxes = regions(bodies, camera, scene.light, position)
    assert (boxes[:, 2:] > boxes[:, :2]).all()
    assert (boxes >= 0).all()
    assert (boxes[:, [0, 2]] <= camera.width).all()
    assert (boxes[:, [1, 3]] <= camera.height).all()
    rng, way = np.random.default_rng(0), np.array(scene.light["way"])
    for i, body in enumerate(bodies):
        inside = rng.normal(size=(500, 3))
        inside *= max(body["size"]) / np.linalg.norm(inside, axis=1, keepdims=True)
        for t in (0, 13, 29):
            points = position[t, i] + inside
            points = points[points[:, 2] >= 0]
            shadow = points - way * (points[:, 2:] / way[2])
            image = camera.project(np.concatenate([points, shadow]))[:, :2]
            image = image[((image >= 0) & (image <= [camera.width, camera.height])).all(1)]
            x0, y0, x1, y1 = boxes[t]
            low, high = np.array([x0, camera.height - y1]), np.array([x1, camera.height - y0])
            assert ((image >= low) & (image <= high)).all()
    assert MARGIN > 0


def test_collisions_come_when_they_should():
    """A ball at 2 m/s has 1.0 - 0.4 m to go, less what counts as touching; a third passes by."""
    scene = drawn(ball((-0.5, 1.0), (2.0, 0, 0)), ball((0.5, 1.0), name="sphere_1"))
    position, quaternion = straight(scene, 240, 240)
    position[100:, 0] = position[100, 0]
    ((i, j, time),) = clip.collisions(scene.objects, position, quaternion)
    assert (i, j) == (0, 1)
    assert time == pytest.approx((0.6 - clip.TOUCH) / 2, abs=1 / 240)
    apart = drawn(ball((-0.5, 1.0), (2.0, 0, 0)), ball((0.5, 1.5), name="sphere_1"))
    assert clip.collisions(apart.objects, *straight(apart, 240, 240)) == []


@pytest.mark.parametrize(
    ("objects", "meetings", "says"),
    [
        ([ball((-0.8, 1.0), (1.6, 0, 0))], [], None),
        ([ball((-0.8, 1.0), (0.02, 0, 0))], [], "something rests"),
        ([ball((-0.8, 1.0), (1.6, 0, 0)), ball((0.5, 1.5), (0, -1.0, 0), "sphere_1")], [], "nothing meets"),
        ([ball((-0.8, 1.0), (1.6, 0, 0)), ball((0.5, 1.5), name="sphere_1")], [(0, 1, 0.5)], "something rests"),
        (
            [ball((-0.8, 1.0), (1.6, 0, 0)), ball((0.5, 1.5), (0, -1, 0), "sphere_1")],
            [(0, 1, 0.0)],
            "overlap at the start",
        ),
        ([ball((-0.8, 1.0), (1.6, 0, -2.0))], [], "unstable"),
        ([ball((0.0, 1.0), (8.0, 0, 0))], [], "out of view"),
        ([ball((-0.8, 1.0), (1.6, 0, 0), radius=0.06)], [], "too few pixels"),
    ],
)
def test_filters(objects, meetings, says):
    scene = drawn(*objects)
    assert clip.fault(scene, *straight(scene), meetings) == says


FRAMES = 10


def film(speed=1.2):
    """A clip drawn by MuJoCo's rays, in place of Blender."""
    scene = drawn(ball((-0.7, 1.0), (speed, 0, 0)), ball((0.6, 1.3), (-0.5, 0.3, 0), "sphere_1"))
    position, quaternion = straight(scene, FRAMES)
    masks = clip.exact_masks(scene, position, quaternion)
    rng = np.random.default_rng(0)
    frames = np.broadcast_to(rng.integers(80, 120, (320, 480, 1)).repeat(3, 2), (FRAMES, 320, 480, 3)).astype(np.uint8)
    frames = np.where(masks[..., None] == 1, (200, 40, 40), np.where(masks[..., None] == 2, (40, 40, 200), frames))
    ids = np.array([0, 2, 1], np.uint8)[masks]
    guesses = SampleSet([scene.entries] * 2, np.array([0.3, 0.4]), np.array([0.6, 0.7]))
    meetings = [(0, 1, 0.5)]
    return clip.Film(scene, frames.astype(np.uint8), ids, (2, 1), position, quaternion, meetings, guesses, "none")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    root = tmp_path_factory.mktemp("set")
    folders.write_film(root / "000_2", film(), 7000)
    return root


def test_a_clip_folder_is_small_and_whole(made):
    folder, clip_ = made / "000_2", film()
    size = sum(path.stat().st_size for path in folder.iterdir())
    assert size < 3_000_000  # the noisy ground of this test; Blender's floor takes a tenth
    frames, masks, fps = folders.read_pictures(folder)
    assert (masks == clip_.masks).all()
    assert fps == 30
    assert np.abs(frames.astype(int) - clip_.frames).mean() < 12
    still = (clip_.masks == 0).all(0)
    block = np.zeros_like(still)  # of a JPEG, with the neighbours that its colours are blended with
    for r in range(16, 304, 16):
        for c in range(16, 464, 16):
            block[r : r + 16, c : c + 16] = still[r - 16 : r + 32, c - 16 : c + 32].all()
    assert block.mean() > 0.3
    assert (frames[:, block] == frames[0][block]).all()  # what does not change stays exactly the same
    meta = json.loads((folder / "meta.json").read_text())
    assert meta["mask_ids"] == [2, 1]
    assert meta["masks_iou_with_rays"] == 1.0
    assert meta["collisions"] == [{"objects": ["sphere_0", "sphere_1"], "time": 0.5}]
    with np.load(folder / "poses.npz", allow_pickle=False) as poses:
        assert np.allclose(poses["pos"][0], clip_.position[:, 0])
        assert poses["names"].tolist() == ["sphere_0", "sphere_1"]


def test_commands_on_a_set(made, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(["refine", str(made), "--out", str(out)]) == 2
    assert "run `python -m benchmarks.blender observe" in capsys.readouterr().err
    assert run(["observe", str(made)]) == 0
    seen, clip_ = load_observation(made / "000_2/flows.npz"), film()
    assert (seen.masks == clip_.masks).all()
    camera = Camera.of(clip_.drawn.entries)
    moved = np.diff(camera.project(clip_.position[:, 0])[:, :2], axis=0)
    measured = np.array([np.nanmedian(seen.flow[t][seen.masks[t] == 2], 0) for t in range(FRAMES - 1)])
    assert np.abs(measured - moved).mean() < 0.3
    written = (made / "000_2/flows.npz").stat().st_mtime_ns
    assert run(["observe", str(made)]) == 0
    assert (made / "000_2/flows.npz").stat().st_mtime_ns == written
    assert [job.name for job in folders.jobs(made, "perturbed")] == ["000_2"]
    with pytest.raises(InputError, match=r"guess\.yaml: not there yet"):
        folders.jobs(made, "guess")
    assert not out.exists()


def test_only_making_needs_blender_and_pybullet(made):
    code = (
        "import sys; sys.modules.update(pybullet=None, bpy=None)\n"
        "from benchmarks.blender.__main__ import run\n"
        "import benchmarks.paper_tables\n"
        "sys.exit(run(sys.argv[1:]))"
    )
    call = [sys.executable, "-c", code, "refine", str(made), "--out", str(made / "out"), "--samples", "guess"]
    done = subprocess.run(
        call, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    )
    assert done.returncode == 2
    assert "not there yet" in done.stderr


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (["observe", "nowhere"], "no clips in it"),
        (["refine", "nowhere", "--out", "out"], "no clips in it"),
        (["make", "--seed", "1", "--out", "out", "--bpy", "nowhere"], "cannot be run"),
        (["make", "--seed", "1", "--out", "out", "--count", "0"], "--count"),
        (["observe", "broken"], "cannot be read"),
        (["observe", "stripped"], "no strip of frames"),
    ],
)
def test_wrong_calls(tmp_path, monkeypatch, capsys, call, says):
    monkeypatch.chdir(tmp_path)
    for name, text in (("broken", "{}"), ("stripped", '{"size": [480, 320], "fps": 30}')):
        (tmp_path / name / "clip").mkdir(parents=True)
        (tmp_path / name / "clip" / "meta.json").write_text(text)
    before = sorted(tmp_path.rglob("*"))
    assert run(call) == 2
    said = capsys.readouterr().err
    assert says in said
    assert said.startswith("blender: ")
    assert said.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_a_python_without_blender_is_told(tmp_path):
    fake = tmp_path / "python"
    fake.write_text("#!/bin/sh\necho 'ModuleNotFoundError: no bpy' >&2\nexit 1\n")
    fake.chmod(0o755)
    with Studio(str(fake)) as studio, pytest.raises(InputError, match="no bpy"):
        studio.simulate([], -9.81, 0.1)


def test_annotated_motion():
    """A body that turns at 3 rad/s about z and moves at 2 m/s."""
    steps = np.arange(clevrer.RATE + 1) / clevrer.RATE
    position = np.stack([2 * steps, 0 * steps, 0 * steps], -1)[:, None]
    turn = np.stack([np.cos(1.5 * steps), 0 * steps, 0 * steps, np.sin(1.5 * steps)], -1)[:, None]
    told = clevrer.motion(position, turn)
    assert told["location"].shape == (clevrer.FPS + 1, 1, 3)
    assert np.allclose(told["velocity"], [2, 0, 0])
    assert np.allclose(told["angular_velocity"], [0, 0, 3])
    assert np.allclose(told["orientation"][10, 0], [0, 0, 3 * 10 / clevrer.FPS])


@pytest.mark.blender
def test_blender_simulates_and_draws():
    """A cube that slides as Coulomb says, the same twice; masks as rays of MuJoCo say; pictures that show it."""
    cube = {**ball((-0.7, 1.0), (1.8, 0, 0), "box_0", friction=0.3), "type": "box", "size": [0.17] * 3}
    del cube["radius"]
    cube["state"]["position"][2] = 0.17
    scene = drawn(cube, ball((0.5, 1.6), name="sphere_1"))
    bodies = scene.bodies()
    for body in bodies:
        body["linear_damping"] = body["angular_damping"] = 0.0
    with Studio(os.environ["BPY_PYTHON"]) as studio:
        position, quaternion = studio.simulate(bodies, -9.81, 1.0)
        again, _ = studio.simulate(bodies, -9.81, 1.0)
        assert (position == again).all()
        stop = 1.8**2 / (2 * 0.3 * 9.81)
        assert position[-1, 0, 0] + 0.7 == pytest.approx(stop, rel=0.06)
        assert np.abs(position[:, 1] - position[0, 1]).max() < 1e-3
        some = slice(0, 240, 80)
        frames, masks = studio.render(bodies, Camera.of(scene.entries), LIGHT, position[some], quaternion[some])
    exact = clip.exact_masks(scene, position[some], quaternion[some])
    for i in (1, 2):
        assert ((masks == i) & (exact == i)).sum() / ((masks == i) | (exact == i)).sum() > 0.99
    inside = frames[masks == 1].mean(0)
    assert inside[0] > 2 * inside[2]  # red
    assert np.abs(frames[0].astype(int) - frames[-1])[:20].max() == 0  # nothing happens there
