"""Scores of hand-made pictures, whose every pixel can be counted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from mjx_fitness import UNMATCHED, Sums, Weights, picture_sums, score_pictures, scores_from_sums


def still(frames: int = 2, height: int = 4, width: int = 6) -> np.ndarray:
    return np.zeros((frames - 1, height, width, 2))


def square(ids: dict[int, tuple[slice, slice]], frames: int = 2, height: int = 4, width: int = 6) -> np.ndarray:
    masks = np.zeros((frames, height, width), int)
    for i, (rows, columns) in ids.items():
        masks[:, rows, columns] = i
    return masks


TOP_LEFT = (slice(0, 2), slice(0, 3))
SHIFTED = (slice(0, 2), slice(1, 4))
BOTTOM = (slice(3, 4), slice(0, 6))


def test_sums_of_hand_made_pictures():
    simulated, observed = square({1: TOP_LEFT, 2: BOTTOM}), square({7: SHIFTED, 5: BOTTOM})
    flow, seen = still(), still()
    flow[0, 0, 0] = 3.0, 4.0  # Simulated object, observed background.
    seen[0, 1, 3] = 0.0, 2.0  # Observed object.
    seen[0, 3, 5] = np.nan, 0.0  # Not measured, on an object.
    sums = picture_sums(simulated, flow, observed, seen, (7, 5))
    np.testing.assert_array_equal(sums.intersection, [[10, 10]])
    np.testing.assert_array_equal(sums.union, [[14, 14]])
    np.testing.assert_array_equal(sums.object_intersection, [[[4, 6], [4, 6]]])
    np.testing.assert_array_equal(sums.object_union, [[[8, 6], [8, 6]]])
    np.testing.assert_array_equal(sums.error, [[7.0]])
    np.testing.assert_array_equal(sums.measured, [[23]])
    np.testing.assert_array_equal(sums.object_error, [[2.0]])
    np.testing.assert_array_equal(sums.object_measured, [[11]])
    scores = scores_from_sums(sums)
    assert scores.iou[0] == pytest.approx(10 / 14)
    assert scores.epe[0] == pytest.approx(7 / 23)
    assert scores.object_epe[0] == pytest.approx(2 / 11)
    assert scores.fitness[0] == pytest.approx(10 / 14 - 7 / 23)
    np.testing.assert_allclose(scores.object_iou, [[0.5, 1.0]])


def test_foreground_counts_whatever_object_it_is():
    scores = score_pictures(square({1: TOP_LEFT}), still(), square({9: TOP_LEFT}), still(), (UNMATCHED,))
    assert scores.iou[0] == 1.0
    assert scores.object_iou[0, 0] == 0.0


def test_frame_without_foreground_on_either_side_says_nothing():
    simulated, observed = square({1: TOP_LEFT}), square({1: SHIFTED})
    simulated[1] = observed[1] = 0
    scores = score_pictures(simulated, still(), observed, still(), (1,))
    assert np.isnan(scores.frame_iou[0, 1])
    assert scores.iou[0] == scores.first_frame_iou[0] == pytest.approx(0.5)


def test_foreground_on_one_side_only_counts_as_zero():
    simulated, observed = square({1: TOP_LEFT}), square({1: TOP_LEFT})
    simulated[1] = 0
    assert score_pictures(simulated, still(), observed, still(), (1,)).iou[0] == 0.5


def test_everything_empty():
    empty = square({})
    scores = score_pictures(empty, still(), empty, still(), (UNMATCHED, UNMATCHED))
    assert scores.iou[0] == scores.first_frame_iou[0] == scores.fitness[0] == 0.0
    assert np.isnan(scores.object_iou).all()


def test_flow_that_was_never_measured():
    seen = still() * np.nan
    scores = score_pictures(square({1: TOP_LEFT}), still() + 3, square({1: TOP_LEFT}), seen, (1,))
    assert np.isnan(scores.frame_epe).all()
    assert scores.epe[0] == scores.object_epe[0] == scores.first_frame_epe[0] == 0.0
    assert scores.fitness[0] == 1.0


def test_an_interval_without_flow_is_left_out_of_the_mean():
    masks, seen = square({1: TOP_LEFT}, 3), still(3)
    seen[1] = np.nan
    assert score_pictures(masks, still(3) + np.array([3.0, 4.0]), masks, seen, (1,)).epe[0] == pytest.approx(5.0)


def test_weights_enter_as_documented():
    simulated, observed = square({1: TOP_LEFT, 2: BOTTOM}), square({7: SHIFTED, 5: BOTTOM})
    weights = Weights(iou=0.3, epe=0.7, instance=2.0, object_epe=0.11)
    scores = score_pictures(simulated, still() + np.array([0.6, 0.8]), observed, still(), (7, 5), weights)
    expected = 0.3 * 10 / 14 - 0.7 * 1.0 + 2.0 * 0.75 - 0.11 * 1.0
    assert scores.fitness[0] == pytest.approx(expected)


@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
@pytest.mark.parametrize("name", ["iou", "epe", "instance", "object_epe"])
def test_weights_are_checked(name, value):
    with pytest.raises(ValueError, match=f"Weights.{name}"):
        Weights(**{name: value})


def test_pictures_of_different_shapes_are_refused():
    with pytest.raises(ValueError, match="masks"):
        score_pictures(square({}), still(), square({}, width=7), still(), ())
    with pytest.raises(ValueError, match="flow"):
        score_pictures(square({}), still(), square({}), still(width=7), ())


def test_a_batch_is_its_candidates_one_by_one():
    generator = np.random.default_rng(0)
    parts = []
    for _ in range(3):
        a, b = generator.integers(0, 3, (2, 3, 5, 5))
        parts.append(
            picture_sums(a, generator.normal(size=(2, 5, 5, 2)), b, generator.normal(size=(2, 5, 5, 2)), (2, 1))
        )
    names = Sums.__dataclass_fields__
    batch = scores_from_sums(Sums(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names}))
    for row, part in enumerate(parts):
        single = scores_from_sums(part)
        for name in single.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(batch.candidate(row), name), getattr(single, name))


masks = arrays.arrays(np.int64, (2, 4, 5), elements=st.integers(0, 3))


@given(masks, masks)
def test_iou_is_symmetric_bounded_and_one_for_equal_foregrounds(a, b):
    there = score_pictures(a, still(width=5), b, still(width=5), (1, 2, 3))
    back = score_pictures(b, still(width=5), a, still(width=5), (1, 2, 3))
    np.testing.assert_array_equal(there.frame_iou, back.frame_iou)
    np.testing.assert_array_equal(there.object_iou, back.object_iou)
    assert 0 <= there.iou[0] <= 1
    for t in range(2):
        if a[t].any() or b[t].any():
            assert (there.frame_iou[0, t] == 1) == (((a[t] > 0) == (b[t] > 0)).all())
