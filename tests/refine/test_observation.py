"""Observations: types that are read, what is checked, and save -> load is the same."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.bad_cases import GONE, arrays
from mjx_refine.errors import InputError
from mjx_refine.observation import MAX_FLOW, load_observation, make_observation, save_observation


def written(folder, **changes):
    np.savez(folder / "clip.npz", **arrays(**changes))
    return folder / "clip.npz"


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.longdouble, ">f4"])
def test_flow_of_every_float_type(dtype, tmp_path):
    flow = np.random.default_rng(0).normal(0, 3, (3, 16, 24, 2)).astype(dtype)
    flow[0, 0, 0] = np.nan
    observation = load_observation(written(tmp_path, flow=flow))
    assert observation.flow.dtype == np.float32
    np.testing.assert_array_equal(observation.flow, flow.astype(np.float32))
    assert observation.length == 4
    assert observation.size == (24, 16)
    assert observation.source == str(tmp_path / "clip.npz")


@pytest.mark.parametrize(
    "dtype", [bool, np.int8, np.uint8, np.int16, np.uint16, np.int32, np.uint32, np.int64, np.uint64]
)
def test_masks_of_every_integer_type(dtype, tmp_path):
    masks = np.zeros((4, 16, 24), dtype)
    masks[1:, 3:9, 2:8] = 1
    observation = load_observation(written(tmp_path, masks=masks))
    assert observation.masks is not None
    assert observation.masks.dtype == np.int32
    np.testing.assert_array_equal(observation.masks, masks.astype(int))
    assert observation.mask_ids() == [1]


def test_only_flow_and_fps_are_needed(tmp_path):
    observation = load_observation(written(tmp_path, masks=GONE))
    assert (observation.masks, observation.frames, observation.flow_sigma) == (None, None, None)
    assert observation.mask_ids() == []


@pytest.mark.parametrize("fps", [30, 29.97, np.float32(30), np.array([30]), np.int64(240), 0.1, 1e5])
def test_rates(fps, tmp_path):
    observation = load_observation(written(tmp_path, fps=fps))
    assert isinstance(observation.fps, float)
    assert observation.fps == pytest.approx(float(np.asarray(fps).reshape(())))


@pytest.mark.parametrize("fps", [0, -30, np.inf, np.nan, 1e6, 30j, True, [30, 30]])
def test_wrong_rates(fps):
    with pytest.raises(InputError, match="fps"):
        make_observation(**arrays(fps=fps))


@pytest.mark.parametrize("sigma", [0.0, 0.2, np.float32(0.5), np.full((3, 16, 24), 0.1), np.array(2)])
def test_noise_of_the_flow(sigma, tmp_path):
    observation = load_observation(written(tmp_path, flow_sigma=sigma))
    np.testing.assert_allclose(np.asarray(observation.flow_sigma), np.asarray(sigma, np.float32), rtol=1e-6)
    assert isinstance(observation.flow_sigma, float) == (np.ndim(sigma) == 0)


def test_noise_may_be_unknown_in_places():
    sigma = np.full((3, 16, 24), 0.1)
    sigma[0, :4], sigma[1, :4] = np.nan, np.inf
    assert make_observation(**arrays(flow_sigma=sigma)).flow_sigma is not None


def test_ids_need_no_order(tmp_path):
    masks = np.zeros((4, 16, 24), np.int32)
    masks[0, 0, 0], masks[1, 3, 3], masks[2, 1, 1] = 2**30, 7, 200
    assert load_observation(written(tmp_path, masks=masks)).mask_ids() == [7, 200, 2**30]


def test_64_objects_and_no_more():
    masks = np.zeros((4, 16, 24), int)
    masks.flat[:64] = np.arange(1, 65)
    assert len(make_observation(**arrays(masks=masks)).mask_ids()) == 64
    masks.flat[64] = 65
    with pytest.raises(InputError, match="at most 64"):
        make_observation(**arrays(masks=masks))


def test_the_largest_flow():
    flow = np.full((3, 16, 24, 2), MAX_FLOW, np.float32)
    assert make_observation(**arrays(flow=flow)).flow.max() == MAX_FLOW
    with pytest.raises(InputError, match="at most"):
        make_observation(**arrays(flow=flow * 1.01))


@given(
    st.integers(1, 4),
    st.integers(8, 20),
    st.integers(8, 20),
    st.integers(0, 2**32 - 1),
    st.sampled_from([1.0, 30.0, 300.0]),
    st.sets(st.sampled_from(["masks", "frames", "flow_sigma"])),
)
def test_save_and_load_is_the_same(tmp_path_factory, intervals, height, width, seed, scale, keys):
    rng = np.random.default_rng(seed)
    flow = rng.uniform(-scale, scale, (intervals, height, width, 2)).astype(np.float32)
    flow[rng.random(flow.shape[:3]) < 0.1] = np.nan
    shape = (intervals + 1, height, width)
    ids = rng.choice([1, 5, 255, 256, 70000], shape)
    optional = {
        "masks": np.where(rng.random(shape) < 0.5, ids, 0),
        "frames": rng.integers(0, 256, (*shape, 3), dtype=np.uint8),
        "flow_sigma": rng.uniform(0, 2, flow.shape[:3]).astype(np.float32),
    }
    given = make_observation(flow, 29.97, **{key: optional[key] for key in keys})
    path = save_observation(tmp_path_factory.mktemp("clip") / "clip.npz", given)
    read = load_observation(path)
    assert list(path.parent.iterdir()) == [path]
    assert read.fps == given.fps
    np.testing.assert_array_equal(np.isnan(read.flow), np.isnan(given.flow))
    np.testing.assert_allclose(read.flow, given.flow, atol=0.02)
    for key in ("masks", "frames", "flow_sigma"):
        np.testing.assert_array_equal(getattr(read, key), getattr(given, key))
    again = load_observation(save_observation(path, dataclasses.replace(read)))
    np.testing.assert_array_equal(again.flow, read.flow)


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path):
    path = save_observation(tmp_path / "clip.npz", make_observation(**arrays()))
    before = path.read_bytes()
    (tmp_path / "taken").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        save_observation(tmp_path / "taken", make_observation(**arrays()))
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["clip.npz", "taken"]


def test_the_shipped_clip_is_read():
    observation = load_observation("examples/clip/flows.npz")
    assert observation.masks is not None
    assert observation.frames is not None
    assert len(observation.mask_ids()) == 2
