"""Matching against every possible assignment."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from mjx_fitness import UNMATCHED, match_costs, match_instances


def costs_of(draw_shape):
    rows, columns = draw_shape
    number = st.one_of(st.floats(-5, 5), st.just(np.inf))
    return st.lists(st.lists(number, min_size=columns, max_size=columns), min_size=rows, max_size=rows)


def best_by_trying(costs: np.ndarray) -> tuple[int, float]:
    """(pairs, cost) of the best assignment: as many possible pairs as can be, then the least cost."""
    rows, columns = costs.shape
    best = (0, 0.0)
    options = [*range(columns), *[None] * rows]
    for chosen in itertools.permutations(options, rows):
        pairs = [costs[r, c] for r, c in enumerate(chosen) if c is not None]
        if all(np.isfinite(pairs)):
            best = max(best, (len(pairs), -float(np.sum(pairs))))
    return best[0], -best[1]


@given(st.tuples(st.integers(1, 3), st.integers(1, 3)).flatmap(costs_of))
def test_least_cost_against_all_permutations(rows):
    costs = np.array(rows)
    ids = [10 + 3 * j for j in range(costs.shape[1])]
    matching = match_costs(costs, ids)
    used = [i for i in matching if i != UNMATCHED]
    assert len(used) == len(set(used))
    pairs = [costs[n, ids.index(i)] for n, i in enumerate(matching) if i != UNMATCHED]
    assert np.isfinite(pairs).all()
    count, cost = best_by_trying(costs)
    assert len(pairs) == count
    np.testing.assert_allclose(np.sum(pairs), cost, atol=1e-6)


def test_the_greedy_choice_is_not_taken():
    assert match_costs(np.array([[0.0, 1.0], [0.1, 9.0]]), [4, 8]) == (8, 4)


def test_dear_pairs_stay_unmatched():
    assert match_costs(np.array([[3.0, 9.0], [9.0, 7.0]]), [1, 2], limit=5.0) == (1, UNMATCHED)


def test_nothing_to_match():
    assert match_costs(np.zeros((2, 0)), []) == (UNMATCHED, UNMATCHED)
    assert match_costs(np.zeros((0, 2)), [1, 2]) == ()
    assert match_costs(np.full((2, 2), np.inf), [1, 2]) == (UNMATCHED, UNMATCHED)
    assert match_costs(np.full((1, 1), np.nan), [1]) == (UNMATCHED,)


def test_ids_are_those_of_the_clip_not_of_one_frame():
    # The objects cross: in the last frames alone the ids would be the other way round.
    simulated, observed = np.zeros((2, 6, 4, 20), int)
    for t in range(6):
        simulated[t, :2, t : t + 4], simulated[t, :2, 14 - t : 18 - t] = 1, 2
        late = 0 if t < 4 else 4
        observed[t, :2, t + late : t + late + 4], observed[t, :2, 14 - t - late : 18 - t - late] = 33, 7
    assert match_instances(simulated, observed, 2) == (33, 7)
    assert match_instances(simulated[4:], observed[4:], 2) != (33, 7)


def test_more_objects_than_masks_and_more_masks_than_objects():
    simulated, observed = np.zeros((2, 1, 4, 9), int)
    simulated[0, :, :3], simulated[0, :, 3:6], simulated[0, :, 6:] = 1, 2, 3
    observed[0, :, 3:6] = 5
    assert match_instances(simulated, observed, 3) == (UNMATCHED, 5, UNMATCHED)
    assert match_instances(observed // 5, simulated, 1) == (2,)


def test_an_object_that_overlaps_no_mask_stays_unmatched():
    simulated, observed = np.zeros((2, 1, 4, 9), int)
    simulated[0, :, :3], observed[0, :, 5:] = 1, 2
    assert match_instances(simulated, observed, 1) == (UNMATCHED,)
    assert match_instances(simulated, np.zeros_like(simulated), 1) == (UNMATCHED,)
