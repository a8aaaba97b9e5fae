"""Which samples land, and the race of searches from poor landings."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from mjx_fitness import Scores
from own_clip import SCENES, OwnClip, perturbed

import mjx_refine.search.run as run_module
from mjx_refine import Options, refine
from mjx_refine.observation import Observation
from mjx_refine.scene import Samples
from mjx_refine.search.landed import Landed
from mjx_refine.search.population import STILL, PopulationSearch
from mjx_refine.search.problem import Problem
from mjx_refine.search.progress import Progress
from mjx_refine.search.race import FINE, LEAST, TRIAL, Contender, Race, second_landing
from mjx_refine.search.run import Run


def landed(rank: int, fitness: float) -> Landed:
    return Landed(rank, np.zeros(1), np.eye(1), fitness, iou=fitness)


def test_the_second_landing_is_from_another_sample():
    poor = [landed(0, 0.5), landed(0, 0.7), landed(2, 0.6), landed(1, 0.4)]
    second = second_landing(poor, LEAST)
    assert second is not None
    assert (second.rank, second.fitness) == (2, 0.6)
    assert second_landing(poor, LEAST - 1) is None
    assert second_landing(poor[:2], LEAST) is None
    assert second_landing([*poor, landed(3, 0.95)], LEAST) is None


def test_a_search_that_stands_still_begins_anew_at_its_best_point_and_so_does_one_that_is_resumed():
    options = Options(population=16, iterations=80)

    def begun():
        return PopulationSearch(options, np.full(4, 0.5), 0.04 * np.eye(4), np.full(4, 0.5), True, 0)

    search, resumed, best = begun(), None, []
    for generation in range(STILL + 3):
        points = search.points()
        costs = np.abs(points - 0.5).sum(1) * 10  # the beginning is the best, and all else is far worse
        if generation == 0:
            assert (points == 0.5).all(1).any()
        if resumed is not None:
            np.testing.assert_array_equal(resumed.points(), points)
            resumed.told(points, costs, scores(costs))
        search.told(points, costs, scores(costs))
        best.append(bool((points == 0.5).all(1).any()))
        if generation == STILL - 1:
            resumed = begun()
            resumed.restore(*search.saved())
    assert best.index(True, 1) == STILL + 1
    assert search.elites[0] == pytest.approx(0.5)


def race(budget: int = 4000, fine: bool = False) -> Race:
    options = Options(population=20, iterations=budget // 20)
    searches = [
        PopulationSearch(options, np.full(3, 0.5), 0.01 * np.eye(3), np.full(3, 0.5), False, 0, 1 - TRIAL)
        for _ in range(2)
    ]
    return Race([Contender(None, None, search) for search in searches], options, 0, fine)  # type: ignore[arg-type]


def scores(costs: np.ndarray) -> Scores:
    unused = {field.name: costs for field in dataclasses.fields(Scores)}
    return Scores(**{**unused, "fitness": -costs, "iou": -costs, "epe": costs})


def driven(running: Race, offsets: tuple[float, float], slopes: tuple[float, float]) -> list[int]:
    """Whose turn it was, generation by generation; each contender's costs fall from its offset by its slope."""
    turns = []
    while (turn := running.turn()) is not None:
        k, points = turn
        generation = turns.count(k)
        costs = offsets[k] - slopes[k] * generation + 0.01 * ((points - 0.6) ** 2).sum(1)
        running.told(k, points, costs, scores(costs))
        turns.append(k)
    return turns


@pytest.mark.parametrize("climber", [0, 1])
def test_the_one_that_still_climbs_gets_the_rest(climber):
    running = race()
    offsets = (1.0, 0.99) if climber == 0 else (0.99, 1.0)
    turns = driven(running, offsets, (1e-3, 0.0) if climber == 0 else (0.0, 1e-3))
    trial = turns.index(1)
    assert turns[:trial] == [0] * trial
    after = turns[2 * trial :]
    assert set(after) == {climber}
    assert running.winner == climber
    # The trials take their parts and no more.
    population = running.contenders[0].search.population
    assert trial * population <= TRIAL * 4000 + population
    assert running.evaluations <= 4000


def test_one_that_has_settled_waits_for_one_below_that_still_climbs():
    turns = driven(race(), (0.7, 1.0), (0.0, 2e-3))
    trial = turns.index(1)
    assert set(turns[2 * trial :]) == {1}


def test_the_finer_part_is_for_the_first_in_line_alone():
    running = race(fine=True)
    turns = driven(running, (1.0, 0.99), (1e-3, 0.0))
    fine = running.contenders[0].search
    assert (fine.fine, running.contenders[1].search.fine, running.winner) == (True, False, 0)
    # Coarse costs are forgotten: all that is kept was told in the last third, when costs were below any before.
    last = FINE * 4000 / fine.population
    assert set(turns[-int(last) :]) == {0}
    assert fine.saved()[1]["elite_costs"].max() < 1.0 - 1e-3 * (turns.count(0) - last - 1) + 0.01 * 0.75  # type: ignore[index]
    assert race(fine=False).contenders[0].search.fine is False


def test_a_race_goes_on_from_what_it_saved():
    whole, broken = race(), race()
    driven(whole, (1.0, 1.0), (1e-3, 2e-3))
    turns = []
    for _ in range(70):
        turn = broken.turn()
        assert turn is not None
        k, points = turn
        costs = 1.0 - (1e-3, 2e-3)[k] * turns.count(k) + 0.01 * ((points - 0.6) ** 2).sum(1)
        broken.told(k, points, costs, scores(costs))
        turns.append(k)
    saved = broken.saved()
    assert saved is not None
    resumed = race()
    resumed.restore(*saved)
    resumed.evaluations = broken.evaluations
    while (turn := resumed.turn()) is not None:
        k, points = turn
        costs = 1.0 - (1e-3, 2e-3)[k] * turns.count(k) + 0.01 * ((points - 0.6) ** 2).sum(1)
        resumed.told(k, points, costs, scores(costs))
        turns.append(k)
    assert resumed.winner == whole.winner
    for a, b in zip(resumed.contenders, whole.contenders, strict=True):
        assert a.trail == b.trail
        np.testing.assert_array_equal(a.search.elites, b.search.elites)


class Quiet(Progress):
    """Shows nothing."""


def far_off(clip: OwnClip, seed: int):
    """A sample of the right kind whose first frames are nowhere near the clip's."""
    scene = perturbed(clip.scene, seed)
    body = scene.objects[0]
    x, y, z = body.position
    moved = dataclasses.replace(body, position=(x + 2.5, y + 1.5, z + 0.4))
    return dataclasses.replace(scene, objects=(moved, *scene.objects[1:]))


def observed(clip: OwnClip) -> Observation:
    return Observation(clip.flow, clip.masks, 30.0)


@pytest.fixture(scope="module")
def clip() -> OwnClip:
    return OwnClip(SCENES["flight"], 16)


def test_samples_that_cannot_begin_right_land_last(clip):
    scenes = (far_off(clip, 5), *[perturbed(clip.scene, seed) for seed in (1, 2, 3, 4)])
    samples = Samples("drawn", scenes, tuple(range(5)))
    problem = Problem(samples, observed(clip), Options(population=20, iterations=100, threads=1))
    run = Run(problem, Quiet(), None, False)
    far = next(rank for rank, start in enumerate(problem.starts) if start.index == 0)
    run.landings._order = order = run.landings._heats()
    assert order[0] != far
    assert order.index(far) >= 3
    assert sorted(order) == list(range(5))
    # The heats are counted, and cheap.
    assert 0 < run.landings.evaluations < 0.25 * run.landings.limit


@pytest.mark.parametrize("part", [0.4, 0.9])
def test_a_run_killed_in_the_race_ends_where_the_whole_one_ends(part, clip, tmp_path, monkeypatch):
    monkeypatch.setattr(run_module, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr("mjx_refine.search.options.SEARCH_WIDTH", 48)
    monkeypatch.setattr("mjx_refine.search.race.LEAST", 100)
    monkeypatch.setattr("mjx_refine.search.landed.LANDED_WELL", 2.0)
    monkeypatch.setattr("mjx_refine.search.landings.LANDED_WELL", 2.0)
    options = Options(population=10, iterations=160, seed=1, refits=0, threads=1)
    samples = Samples("drawn", tuple(perturbed(clip.scene, seed) for seed in (1, 2, 3)), (0, 1, 2))
    whole = refine(samples, observed(clip), options, folder=tmp_path / "whole")
    search = [k for k, step in enumerate(whole.history) if step.phase == "search"]

    class Interrupting(Progress):
        left = search[int(part * len(search))]

        def step(self, step) -> None:
            self.left -= 1
            if self.left == 0:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        refine(samples, observed(clip), options, folder=tmp_path / "cut", progress=Interrupting())
    again = refine(samples, observed(clip), options, folder=tmp_path / "cut", resume=True)
    assert again.scene == whole.scene
    assert again.evaluations == whole.evaluations
