"""Generated scenes: what is sampled, simulated, drawn and kept, against MuJoCo and the plain drawing."""

import dataclasses
import io
import multiprocessing
import zipfile

import mujoco
import numpy as np
import pytest

from mjx_refine import GenerateOptions, InputError, generate_scenes, read_records
from mjx_refine.batch import batch_from_scenes
from mjx_refine.generate import HELD_OUT, SPLITS, Seen, replayed
from mjx_refine.generate.casting import slots_of
from mjx_refine.generate.make import CLOSEST, FILTERS, Maker, Tally, _rejected
from mjx_refine.generate.npz import packed
from mjx_refine.generate.options import LEAST_PIXELS, SIZE, combinations
from mjx_refine.generate.physics import RecordingSimulator
from mjx_refine.generate.pictures import Clip, draw_clips, expanded
from mjx_refine.generate.record import differences, from_jpeg, from_members, jpeg, members, summed
from mjx_refine.generate.renderer import VARIABLE, choose_renderer
from mjx_refine.generate.rgb import _add_camera, _dress, film
from mjx_refine.generate.sample import half_height, propose, rotated, shapes_of
from mjx_refine.generate.tiles import HIGH, WIDE
from mjx_refine.scene import Body, Camera, Scene, dump_scene, parse_scenes, write
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.model import SUBSTEPS, apply_fields, build_spec, contact_pairs, initial_state, model_fields
from mjx_refine.simulate import simulate
from mjx_refine.view.picture import draw

OPTIONS = GenerateOptions(seed=5, per_shard=4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("generated") / "data"
    generate_scenes(8, out, OPTIONS, workers=0)
    return out


@pytest.fixture(scope="module")
def records(folder):
    return list(read_records(folder))


def clip_of(scene):
    batch = batch_from_scenes([scene])
    return Clip(RecordingSimulator(scene.shapes).record(batch)[0].qpos, batch, 0)


# Sampling -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("split", SPLITS)
def test_the_text_is_the_scene_that_is_simulated(split):
    for index in range(8):
        proposal = propose(GenerateOptions(split=split), index, 0)
        assert parse_scenes(dump_scene(proposal.written))[0] == proposal.scene
        assert proposal.scene.camera.position[:2] == (0.0, -2.0)


def test_the_text_is_the_same_without_libyaml(monkeypatch):
    scenes = [propose(GenerateOptions(split=split), index, 0).written for split in SPLITS for index in range(8)]
    quick = [dump_scene(scene) for scene in scenes]
    monkeypatch.setattr(write, "_QuickDumper", write._Dumper)
    assert [dump_scene(scene) for scene in scenes] == quick


def test_splits_have_the_objects_that_they_should():
    shapes = {split: [shapes_of(GenerateOptions(split=split), index) for index in range(400)] for split in SPLITS}
    assert {len(kind) for kind in shapes["train"]} == {1, 2, 3, 4}
    assert not set(shapes["train"]) & set(HELD_OUT)
    allowed = {kind for count in range(1, 5) for kind in combinations(count)} - set(HELD_OUT)
    assert set(shapes["train"]) == allowed
    assert set(shapes["compositional"]) == set(HELD_OUT)
    assert {len(kind) for kind in shapes["five"]} == {5}
    assert {len(kind) for kind in shapes["six"]} == {6}
    assert {len(shapes_of(GenerateOptions(objects=7), index)) for index in range(200)} == set(range(1, 8))


def test_held_out_combinations_are_four_and_hold_every_shape():
    assert len(set(HELD_OUT)) == 4
    assert set(HELD_OUT) <= set(combinations(4))
    assert {shape for kind in HELD_OUT for shape in kind} == {"sphere", "box", "cylinder"}


def test_number_and_seed_decide():
    options = GenerateOptions(seed=1)
    assert propose(options, 3, 2) == propose(options, 3, 2)
    others = [propose(options, 3, 1), propose(options, 4, 2), propose(GenerateOptions(seed=2), 3, 2)]
    others.append(propose(GenerateOptions(seed=1, split="five"), 3, 2))
    assert all(other != propose(options, 3, 2) for other in others)


def test_nothing_begins_inside_the_floor():
    for index in range(60):
        scene = propose(GenerateOptions(seed=9), index, 0).scene
        simulator = MujocoSimulator(scene.shapes, 30.0, threads=1)
        told = simulator.contacts(batch_from_scenes([scene]), 0)
        assert min((distance for first, _, distance, _ in told if first < 0), default=0.0) > -1e-5


def test_rotations_and_heights_against_mujoco():
    generator = np.random.default_rng(0)
    for _ in range(20):
        quaternion, vector = generator.normal(size=4), generator.normal(size=3)
        quaternion /= np.linalg.norm(quaternion)
        expected = np.zeros(3)
        mujoco.mju_rotVecQuat(expected, vector, quaternion)
        np.testing.assert_allclose(rotated(tuple(quaternion), tuple(vector)), expected, atol=1e-12)
    corners = [np.array([x, y, z]) for x in (-0.1, 0.1) for y in (-0.2, 0.2) for z in (-0.3, 0.3)]
    turned = tuple(quaternion)
    lowest = min(rotated(turned, tuple(corner))[2] for corner in corners)
    assert half_height("box", (0.1, 0.2, 0.3), turned) == pytest.approx(-lowest)
    rim = [(0.2 * np.cos(a), 0.2 * np.sin(a), z) for a in np.linspace(0, 2 * np.pi, 2000) for z in (-0.3, 0.3)]
    lowest = min(rotated(turned, point)[2] for point in rim)
    assert half_height("cylinder", (0.2, 0.6), turned) == pytest.approx(-lowest, abs=1e-5)
    assert half_height("sphere", (0.2,), turned) == 0.2


# Physics --------------------------------------------------------------------------------------------------------------


def test_states_and_contacts_are_those_of_plain_steps():
    scene = propose(GenerateOptions(seed=1, split="compositional"), 2, 0).scene
    batch = batch_from_scenes([scene, scene])
    motion = RecordingSimulator(scene.shapes).record(batch)[1]
    np.testing.assert_array_equal(motion.qpos, MujocoSimulator(scene.shapes, 30.0, threads=1).rollout(batch, 30)[1])
    model = build_spec(scene.shapes, 30.0).compile()
    apply_fields(model, model_fields(batch), 0)
    data, count = mujoco.MjData(model), len(scene.shapes)
    qpos, qvel = initial_state(batch)
    data.qpos[:], data.qvel[:] = qpos[0], qvel[0]
    told = {}
    for step in range(29 * SUBSTEPS + 1):
        if step % SUBSTEPS == 0:
            np.testing.assert_allclose(motion.qvel[step // SUBSTEPS], data.qvel.reshape(count, 6), atol=1e-9)
        mujoco.mj_step(model, data)
        for k, contact in enumerate(data.contact):
            force, pair = np.zeros(6), (int(min(contact.geom)) - 1, int(max(contact.geom)) - 1)
            mujoco.mj_contactForce(model, data, k, force)
            # MuJoCo's force is on the contact's second geom, whichever that is.
            sign = 1 if contact.geom[0] < contact.geom[1] else -1
            points, total = told.get((step, pair), (0, np.zeros(3)))
            told[step, pair] = points + 1, total + sign * contact.frame.reshape(3, 3).T @ force[:3]
    contacts = motion.contacts
    found = {(int(s), tuple(map(int, p))): k for k, (s, p) in enumerate(zip(contacts.step, contacts.pair, strict=True))}
    assert set(found) == set(told)
    assert {pair for _, pair in found} <= set(contact_pairs(count))
    for key, (points, total) in told.items():
        assert contacts.points[found[key]] == points
        np.testing.assert_allclose(contacts.force[found[key]], total, rtol=1e-3, atol=1e-2)
    assert len(found) > 100


# Pictures -------------------------------------------------------------------------------------------------------------


def crowd():
    """Six objects that hide one another."""
    bodies = [
        Body(shape, f"{shape}_{k}", size, (0.12 * k - 0.2, 0.1 * k, 0.5 + 0.1 * k), angular_velocity=(3.0, 1.0, 2.0))
        for k, (shape, size) in enumerate(
            [("sphere", (0.3,)), ("sphere", (0.2,)), ("sphere", (0.25,)), ("box", (0.3, 0.1, 0.2)),
             ("box", (0.1, 0.4, 0.1)), ("cylinder", (0.2, 0.7))]
        )
    ]  # fmt: skip
    return Scene(tuple(bodies), Camera((0.0, -2.0, 2.5), 50.0, 45.0))


def four(seed, count):
    """Scenes of one kind with every shape, since the plain drawing is compiled for each kind."""
    options = GenerateOptions(seed=seed, split="compositional")
    numbers = [index for index in range(20 * count) if shapes_of(options, index) == HELD_OUT[2]]
    return [propose(options, index, 0).scene for index in numbers[:count]]


def test_masks_and_flow_are_the_plain_drawing_s():
    scenes = [crowd(), *four(3, 5)]
    clips = [clip_of(scene) for scene in scenes]
    for clip, pictures in zip(clips, draw_clips(clips), strict=True):
        masks, flow = expanded(pictures.runs, pictures.flow)
        expected, exact = draw(clip.qpos, clip.batch, SIZE)
        assert np.count_nonzero(masks != expected) <= 1e-5 * np.count_nonzero(expected)
        assert [np.count_nonzero(masks == n + 1) for n in range(len(pictures.pixels))] == list(pictures.pixels)
        same = ((masks == expected) & (masks > 0))[:-1]
        rounding = 0.5 * np.spacing(np.abs(flow[same])).astype(float)
        assert np.all(np.abs(flow[same] - exact[same]) <= rounding + 4e-3)
        assert not flow[masks[:-1] == 0].any()


def test_a_clip_s_pixels_do_not_depend_on_the_others():
    clips = [clip_of(propose(GenerateOptions(seed=4, objects=6), index, 0).scene) for index in range(6)]
    together = list(draw_clips(clips))
    for clip, pictures in zip(clips, together, strict=True):
        alone = next(draw_clips([clip]))
        np.testing.assert_array_equal(alone.runs, pictures.runs)
        np.testing.assert_array_equal(alone.flow, pictures.flow)


def test_more_clips_than_are_prepared_together():
    clip = clip_of(crowd())
    many = list(draw_clips([clip] * 45))
    assert len(many) == 45
    assert all(np.array_equal(other.runs, many[0].runs) for other in many)


def test_nothing_in_view_is_no_runs():
    scene = crowd()
    away = dataclasses.replace(scene, camera=Camera((0.0, 50.0, 2.5), 90.0, 45.0))
    pictures = next(draw_clips([clip_of(away)]))
    assert pictures.runs.shape == (3, 0)
    assert pictures.flow.shape == (2, 0)
    assert not expanded(pictures.runs, pictures.flow)[0].any()


def test_bounds_miss_no_pixel():
    scenes = [crowd(), *four(6, 8)]
    near = dataclasses.replace(crowd(), camera=Camera((0.2, -0.3, 1.0), 60.0, 70.0))
    for scene in [*scenes, near]:
        clip = clip_of(scene)
        bounds = clip.bounds
        masks, _ = draw(clip.qpos, clip.batch, SIZE)
        tiles = masks.reshape(30, SIZE[1] // HIGH, HIGH, SIZE[0] // WIDE, WIDE).swapaxes(2, 3)
        for n in range(len(scene.objects)):
            assert bounds.touched[n][(tiles == n + 1).any((3, 4))].all()
            assert bounds.seen[n] or not (masks == n + 1).any()
            assert np.all(bounds.pixels[n] >= (masks == n + 1).sum((1, 2)))


def test_slots_hold_every_object_once():
    for shapes in [kind for count in range(1, 7) for kind in combinations(count)]:
        for few in (True, False):
            signature, slots = slots_of(shapes, few)
            assert [signature[slots.index(k)] for k in range(len(shapes))] == list(shapes)
            assert sorted(k for k in slots if k is not None) == list(range(len(shapes)))
    for few, most in ((True, 7), (False, 2)):
        assert len({slots_of(kind, few)[0] for count in range(1, 7) for kind in combinations(count)}) <= most


# Filters --------------------------------------------------------------------------------------------------------------


def test_every_record_passes_the_filters_and_replays(records):
    assert [record.key for record in records] == [f"{k:08d}" for k in range(8)]
    for record in records:
        counts = np.bincount(record.masks.reshape(-1), minlength=len(record.scene.objects) + 1)[1:]
        assert counts.min() >= LEAST_PIXELS
        simulator = MujocoSimulator(record.scene.shapes, 30.0, threads=1)
        assert simulator.overlap(batch_from_scenes([record.scene]))[0] == 0
        motion, pictures = replayed(record.scene)
        np.testing.assert_array_equal(motion.qpos, record.motion.qpos)
        np.testing.assert_array_equal(motion.qvel, record.motion.qvel)
        np.testing.assert_array_equal(motion.contacts.force, record.motion.contacts.force)
        np.testing.assert_array_equal(pictures.runs, record.pictures.runs)
        np.testing.assert_array_equal(pictures.flow, record.pictures.flow)


def test_simulate_gives_the_same_masks(records):
    record = records[0]
    again = simulate(record.scene).masks
    assert np.count_nonzero(again != record.masks) <= 1e-5 * np.count_nonzero(again)


def moving(*bodies, camera=None):
    return Scene(tuple(bodies), camera or Camera((0.0, -2.0, 3.0), 45.0, 45.0))


@pytest.mark.parametrize(
    ("scene", "reason"),
    [
        (moving(Body("sphere", "a", (0.3,), (0.0, 1.0, 0.3))), None),
        (moving(Body("sphere", "a", (0.3,), (0.0, 1.0, 0.3), linear_velocity=(2e4, 0.0, 2e4))), "diverged"),
        (moving(Body("sphere", "a", (0.3,), (0.0, -2.0 + 0.3 + 0.9 * CLOSEST, 3.0))), "camera"),
        (
            moving(
                Body("sphere", "a", (0.3,), (0.0, 1.0, 0.3)),
                Body("sphere", "b", (0.3,), (20.0, 1.0, 0.3)),
                Body("sphere", "c", (0.3,), (-20.0, 1.0, 0.3)),
            ),
            "outside",
        ),
        (
            moving(Body("sphere", "a", (0.3,), (0.0, 1.0, 0.3)), Body("sphere", "b", (0.3,), (20.0, 1.0, 0.3))),
            "pixels",
        ),
    ],
)
def test_each_filter_rejects_what_it_should(scene, reason):
    batch = batch_from_scenes([scene])
    motion = RecordingSimulator(scene.shapes).record(batch)[0]
    assert _rejected(motion, Clip(motion.qpos, batch, 0)) == reason


def test_overlap_and_pixels_are_rejected():
    one = Body("sphere", "a", (0.3,), (0.0, 1.0, 0.3))
    other = dataclasses.replace(one, name="b", position=(0.5, 1.0, 0.3))
    far = dataclasses.replace(one, name="b", size=(0.05,), position=(0.5, 1.5, 0.05))
    proposals = [type("P", (), {"scene": moving(one, body)})() for body in (other, far, dataclasses.replace(
        other, position=(0.7, 1.0, 0.3)))]  # fmt: skip
    judged = Maker(GenerateOptions())._judged(proposals, Tally())
    assert [candidate.rejected for candidate in judged] == ["overlap", "pixels", None]


def test_rates_follow_the_order_of_the_filters():
    tally = Tally(records=3, proposals=10)
    tally.rejected.update(overlap=2, pixels=5)
    rates = tally.rates()
    assert list(rates) == list(FILTERS)
    assert rates["overlap"] == {"seen": 10, "passed": 8, "rate": 0.8}
    assert rates["pixels"] == {"seen": 8, "passed": 3, "rate": 0.375}
    assert Tally().rates()["overlap"]["rate"] == 1.0


# Records --------------------------------------------------------------------------------------------------------------


def test_members_are_read_back(records):
    for record in records[:3]:
        told = members(record)
        again = from_members(record.key, told, "here")
        assert again.text == record.text
        assert again.scene == record.scene
        np.testing.assert_array_equal(again.masks, record.masks)
        np.testing.assert_array_equal(again.flow, record.flow)
        np.testing.assert_array_equal(again.motion.qvel, record.motion.qvel)
        np.testing.assert_array_equal(again.motion.contacts.position, record.motion.contacts.position)
        assert members(again) == told


@pytest.mark.parametrize("change", ["missing", "cut", "other"])
def test_damaged_members_are_refused(records, change):
    told = members(records[0])
    if change == "missing":
        del told["motion.npz"]
    elif change == "cut":
        told["pictures.npz"] = told["pictures.npz"][:1000]
    else:
        told["pictures.npz"] = b"no zip"
    with pytest.raises(InputError, match="record 00000000"):
        from_members("00000000", told, "shard")


def test_differences_are_undone():
    flow = np.random.default_rng(0).normal(size=(2, 1001)).astype(np.float16)
    flow[:, ::7] = [[0.0], [-0.0]]
    np.testing.assert_array_equal(summed(differences(flow)).view(np.uint16), flow.view(np.uint16))
    assert summed(differences(flow[:, :0])).shape == (2, 0)


def test_an_npz_is_what_numpy_reads():
    arrays = {
        "many": np.arange(70_000, dtype=np.int32).reshape(7, 1, -1),
        "none": np.empty((0, 3), np.float16),
        "one": np.float64(30.0),
        "turned": np.arange(6.0).reshape(2, 3).T,
    }
    with zipfile.ZipFile(io.BytesIO(packed(arrays))) as archive:
        assert archive.testzip() is None
        assert all(info.compress_type == zipfile.ZIP_DEFLATED for info in archive.infolist())
    with np.load(io.BytesIO(packed(arrays)), allow_pickle=False) as told:
        assert told.files == list(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(told[name], array)
            assert told[name].dtype == np.asarray(array).dtype
    assert packed(arrays) == packed(dict(arrays))
    assert len(packed({"zeros": np.zeros(10**6)})) < 20_000


def test_an_observation_is_made_of_a_record(records):
    observation = records[1].observation
    assert observation.size == SIZE
    assert observation.length == 30
    assert observation.mask_ids() == list(range(1, len(records[1].scene.objects) + 1))
    assert records[1].measured is None


# RGB ------------------------------------------------------------------------------------------------------------------


def test_frames_survive_jpeg_nearly():
    ramp = np.linspace(0, 255, SIZE[0]).astype(np.uint8)
    frames = np.broadcast_to(ramp[:, None], (30, SIZE[1], SIZE[0], 3)).copy()
    assert np.abs(from_jpeg(jpeg(frames)).astype(int) - frames).max() <= 8


def test_looks_compile_and_change_no_motion():
    scene = crowd()
    spec = build_spec(scene.shapes, 30.0)
    _add_camera(spec, scene)
    _dress(spec, scene, np.random.default_rng(0))
    model = spec.compile()
    plain = build_spec(scene.shapes, 30.0).compile()
    assert model.nmat == 7
    assert model.ntex == 8
    assert model.nlight >= 1
    np.testing.assert_array_equal(model.geom_type, plain.geom_type)
    np.testing.assert_array_equal(model.pair_geom1, plain.pair_geom1)


@pytest.mark.slow
def test_frames_masks_and_flow_agree(records, monkeypatch):
    """In a process of its own: MuJoCo's renderer is chosen once, when it is imported."""
    monkeypatch.setenv(VARIABLE, choose_renderer())
    record = records[0]
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        seen = pool.apply(film, (record, OPTIONS, 0))
    assert isinstance(seen, Seen)
    errors = []
    for n in range(len(record.scene.objects)):
        mask = record.masks[:-1] == n + 1
        off = np.linalg.norm(seen.flow[mask].astype(float) - record.flow[mask], axis=-1)
        errors.append(np.nanmedian(off) / max(1.0, np.linalg.norm(record.flow[mask].astype(float), axis=-1).mean()))
    assert np.median(errors) < 0.5
    again = from_members(record.key, members(dataclasses.replace(record, seen=seen)), "here")
    assert again.seen is not None
    # JPEG of what came out of a JPEG is not quite the same again.
    assert np.abs(again.seen.frames.astype(int) - seen.frames).mean() < 2
    np.testing.assert_array_equal(again.seen.flow, seen.flow)
    assert again.measured is not None
