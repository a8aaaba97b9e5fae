"""Clips that are searched together: the same costs as alone, the same files, a failure of one stops no other."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from mjx_fitness import Weights
from own_clip import FLIGHT, SLIDE, perturbed

from mjx_refine.batch import batch_from_scenes
from mjx_refine.many import Job, refine_many
from mjx_refine.many.warm import warm_up
from mjx_refine.many.work import RESULTS, Prepared, ahead, prepare, work
from mjx_refine.observation import load_observation, save_observation
from mjx_refine.scene import Effect, Scene, load_scenes, save_scenes
from mjx_refine.search import Options
from mjx_refine.search.checkpoint import load_checkpoint
from mjx_refine.search.objective import Objective
from mjx_refine.search.ready import Searched
from mjx_refine.search.together import Member, Together
from mjx_refine.search.undetermined import insensitive
from mjx_refine.sim import backends
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.fused import LARGEST
from mjx_refine.sim.mjx import room
from mjx_refine.simulate import simulate
from mjx_refine.space import Space
from mjx_refine.view import grid
from mjx_refine.view.grid import GridScorer, sampled
from mjx_refine.view.tiles import TileScorer

SIZE, FRAMES = (96, 64), 8
TINY = Options(population=8, iterations=6, seed=3, refits=0, resolution=(48, 32), backend="mujoco")


def sphere_clip(folder: Path, seed: int) -> Path:
    folder.mkdir(parents=True)
    truth = perturbed(FLIGHT, seed, 0.2)
    save_observation(folder / "flows.npz", simulate(truth, size=SIZE, frames=FRAMES))
    save_scenes(folder / "best32.yaml", [perturbed(truth, 10 * seed + k) for k in range(2)])
    return folder


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("clips")
    return [sphere_clip(folder / name, seed) for name, seed in (("a", 1), ("b", 2), ("c", 3))]


def jobs_of(clips: list[Path], **overrides) -> list[Job]:
    return [Job(clip / "best32.yaml", clip / "flows.npz", overrides=overrides) for clip in clips]


def members_of(clips: list[Path], out: Path, options: Options) -> list[Member]:
    prepared = [prepare(job, out, options) for job in jobs_of(clips)]
    assert all(isinstance(one, Prepared) for one in prepared)
    return [Member(one.ready, one.digest) for one in prepared]  # type: ignore[union-attr]


def objective_alone(member: Member, clip: Path) -> Objective:
    """What the clip's own refinement would minimise."""
    ready = member.ready
    simulator = MujocoSimulator(ready.shapes, ready.fps, 1)
    scorer = TileScorer(ready.shapes, load_observation(clip / "flows.npz"), (1,), ready.samples.resolution)
    return Objective(ready.space, simulator, simulator, scorer)


def recorded(member: Member) -> list[tuple[np.ndarray, np.ndarray]]:
    """(points, costs) of every call of the member's search, filled while it runs."""
    calls: list[tuple[np.ndarray, np.ndarray]] = []
    inner = member.search.told

    def told(points, costs, scores):
        calls.append((points, costs))
        return inner(points, costs, scores)

    member.search.told = told  # type: ignore[method-assign]
    return calls


@pytest.mark.parametrize("optimizer", ["cmaes", "hybrid"])
def test_candidates_cost_the_same_together_as_alone(clips, tmp_path, optimizer):
    # Landings leave different populations: the batch is not a multiple of anything.
    members = members_of(clips, tmp_path, dataclasses.replace(TINY, optimizer=optimizer, iterations=30))
    calls, ended = [recorded(member) for member in members], []
    simulator = MujocoSimulator(("sphere",), members[0].ready.fps, 1)
    together = Together(members, simulator, lambda member, error: ended.append((member, error)))
    together.most = 20  # and does not fit in one
    together.run()
    assert {id(member) for member, _ in ended} == {id(member) for member in members}
    assert [error for _, error in ended] == [None] * 3
    for member, clip, own in zip(members, clips, calls, strict=True):
        assert own
        alone = objective_alone(member, clip)
        for points, costs in (own[0], own[-1]):
            np.testing.assert_allclose(costs, alone(points)[0], atol=2e-6)
        values, arrays = load_checkpoint(member.ready.checkpoint, members_digest(member)) or ({}, {})
        assert Searched(*values["searched"]).backend == "mujoco"
        assert values["evaluations"] == member.search.evaluations <= member.ready.options.budget
        assert [row[2] for row in values["history"]] == sorted(row[2] for row in values["history"])
        assert arrays["elite_costs"].min() == min(costs.min() for _, costs in own if len(costs) <= 8)


def members_digest(member: Member) -> str:
    return member.values["digest"]


def test_a_search_that_was_cut_off_goes_on_where_it_was(clips, tmp_path):
    simulator = MujocoSimulator(("sphere",), 30.0, 1)
    options = dataclasses.replace(TINY, optimizer="cmaes")
    (whole,) = members_of(clips[:1], tmp_path / "whole", options)
    Together([whole], simulator, lambda member, error: None).run()

    class Cut(Exception):
        pass

    def cut(members):
        if members[0].search.evaluations >= 24:
            members[0].save()
            raise Cut

    (first,) = members_of(clips[:1], tmp_path / "cut", options)
    with pytest.raises(Cut):
        Together([first], simulator, lambda member, error: None, cut).run()
    (second,) = members_of(clips[:1], tmp_path / "cut", options)
    assert second.search.evaluations == 24
    Together([second], simulator, lambda member, error: None).run()
    assert second.search.evaluations == whole.search.evaluations
    np.testing.assert_array_equal(np.array(second.search.found), np.array(whole.search.found))


def test_one_that_fails_leaves_the_others(clips, tmp_path):
    members = members_of(clips, tmp_path, dataclasses.replace(TINY, optimizer="cmaes"))
    ended = {}

    def broken(points, costs, scores):
        raise ValueError("no such thing")

    members[1].search.told = broken  # type: ignore[method-assign]
    simulator = MujocoSimulator(("sphere",), 30.0, 1)
    Together(members, simulator, lambda member, error: ended.setdefault(id(member), error)).run()
    errors = [ended[id(member)] for member in members]
    assert [type(error) for error in errors] == [type(None), ValueError, type(None)]


@pytest.mark.parametrize(
    "short", [MemoryError("out of memory"), RuntimeError("Failed to allocate 9000 bytes on device 'cuda:0'")]
)
def test_a_batch_that_is_too_large_for_the_device_is_halved(clips, tmp_path, monkeypatch, short):
    monkeypatch.setattr("mjx_refine.search.together.LEAST", 8)
    members = members_of(clips, tmp_path, dataclasses.replace(TINY, optimizer="cmaes"))
    ended, sizes = [], []

    class Small(MujocoSimulator):
        def rollout(self, batch, frames):
            sizes.append(len(batch))
            if len(batch) > 16:
                raise short
            return super().rollout(batch, frames)

    Together(members, Small(("sphere",), 30.0, 1), lambda member, error: ended.append(error)).run()
    assert ended == [None] * 3
    assert sizes[0] == 24
    assert max(sizes[1:]) <= 16


def test_many_clips_through_a_device_backend(clips, tmp_path):
    """MJX-JAX searches here, two processes land and finish: every clip has its files, and is then skipped."""
    (tmp_path / "damaged.npz").write_bytes(b"PK\3\4")
    jobs = [*jobs_of(clips[:2]), Job(clips[0] / "best32.yaml", tmp_path / "damaged.npz")]
    options = dataclasses.replace(TINY, backend="mjx", optimizer="cmaes", iterations=4)
    many = refine_many(jobs, options, out=tmp_path / "out", workers=2)
    assert [(o.name, o.status) for o in many.outcomes] == [("a", "done"), ("b", "done"), ("damaged", "bad input")]
    for name in ("a", "b"):
        assert all((tmp_path / "out" / name / file).is_file() for file in RESULTS)
        told = json.loads((tmp_path / "out" / name / "result.json").read_text())
        assert (told["backend"], told["evaluations"]) == ("mjx", 32)
        assert told["refined"]["fitness"] >= told["init"]["fitness"]
        assert len((tmp_path / "out" / name / "history.csv").read_text().splitlines()) == 5
    assert [prepare(job, tmp_path / "out", options).status for job in jobs[:2]] == ["skipped"] * 2  # type: ignore


def test_after_a_search_elsewhere_a_run_finishes_without_one(clips, tmp_path, monkeypatch):
    options = dataclasses.replace(TINY, optimizer="cmaes")
    (member,) = members_of(clips[:1], tmp_path, options)
    Together([member], MujocoSimulator(("sphere",), 30.0, 1), lambda member, error: None).run()
    monkeypatch.setattr("mjx_refine.search.engines.make_simulator", lambda *_, **__: pytest.fail("searched again"))
    monkeypatch.setattr("mjx_refine.search.run.insensitive", lambda *_: pytest.fail("looked at again"))
    outcome = work(jobs_of(clips[:1])[0], tmp_path, options)
    assert outcome.status == "done"
    assert outcome.evaluations == 48
    assert load_scenes(tmp_path / "a/refined.yaml")


def test_what_a_search_does_not_change_is_done_while_it_runs(clips, tmp_path, monkeypatch):
    """Each piece once; and the end is what it would have been, without judging derivatives again."""
    options = dataclasses.replace(TINY, optimizer="cmaes")
    ends = []
    for early in (False, True):
        while ahead():  # what other tests left
            pass
        (member,) = members_of(clips[:1], tmp_path / str(early), options)
        if early:
            assert ahead()
            assert not ahead()
            monkeypatch.setattr("mjx_refine.search.derivatives.check", lambda *_, **__: pytest.fail("judged again"))
        Together([member], MujocoSimulator(("sphere",), 30.0, 1), lambda member, error: None).run()
        assert work(jobs_of(clips[:1])[0], tmp_path / str(early), options).status == "done"
        ends.append(json.loads((tmp_path / str(early) / "a/result.json").read_text()))
    assert ends[0]["derivatives"] == ends[1]["derivatives"]
    assert ends[0]["refined"] == ends[1]["refined"]


def test_parameters_that_do_not_act_are_found_before_clips_leave(clips, tmp_path):
    """In as many rows as a generation has, which here are fewer than the points around the best candidate."""
    members = members_of(clips[:2], tmp_path, dataclasses.replace(TINY, optimizer="cmaes"))
    Together(members, MujocoSimulator(("sphere",), 30.0, 1), lambda member, error: None).run()
    for member, clip in zip(members, clips, strict=False):
        space, best = member.ready.space, member.search.elites[0]
        assert 1 + 2 * space.dimension > member.search.population
        alone = objective_alone(member, clip)
        expected = insensitive(space, best, lambda points, alone=alone: alone(points)[0])
        assert 0 < expected.sum() < space.dimension
        found = load_checkpoint(member.ready.checkpoint, member.values["digest"])
        assert found is not None
        np.testing.assert_array_equal(found[1]["loose"], expected)


def test_a_clip_that_leaves_before_the_others_looks_for_itself(clips, tmp_path):
    members = members_of(clips[:2], tmp_path, dataclasses.replace(TINY, optimizer="cmaes"))
    members[0].search.reason = "over"
    Together(members, MujocoSimulator(("sphere",), 30.0, 1), lambda member, error: None).run()
    kept = [load_checkpoint(member.ready.checkpoint, member.values["digest"]) for member in members]
    assert [found is not None and "loose" in found[1] for found in kept] == [False, False]


@pytest.mark.parametrize("masks", [True, False])
def test_grids_score_as_tiles_do(clips, masks):
    scene: Scene = load_scenes(clips[0] / "best32.yaml")[0]
    observation = load_observation(clips[0] / "flows.npz")
    observation = observation if masks else dataclasses.replace(observation, masks=None)
    space = Space.around(scene)
    steps = 0.5 * space.sigma * np.random.default_rng(0).normal(size=(9, space.dimension))
    batch = space.decode(np.clip(space.start + steps, 0, 1))
    poses = MujocoSimulator(("sphere",), 30.0, 1).rollout(batch, FRAMES)
    poses[4, 3:] = np.nan
    for resolution in ((48, 32), None, (40, 30)):
        tiles = TileScorer(("sphere",), observation, (1,), resolution)(poses, batch)
        grid = GridScorer(("sphere",), [sampled(observation, (1,), resolution)])(poses, batch)
        assert np.isneginf(grid.fitness[4])
        for field in dataclasses.fields(tiles):
            ours, theirs = getattr(grid, field.name), getattr(tiles, field.name)
            np.testing.assert_allclose(ours, theirs, atol=2e-6, err_msg=field.name)


def test_grids_of_different_clips_are_refused(clips):
    observation = load_observation(clips[0] / "flows.npz")
    with pytest.raises(ValueError, match="all of one kind"):
        GridScorer(("sphere",), [sampled(observation, (1,)), sampled(observation, (1,), (48, 32))])
    scorer = GridScorer(("sphere",), [sampled(observation, (1,))])
    batch = batch_from_scenes([FLIGHT] * 4)
    with pytest.raises(ValueError, match="counts add up to 3; expected the batch's 4"):
        scorer.score(np.zeros((4, FRAMES, 1, 7)), batch, [3])  # type: ignore[arg-type]


def test_large_pictures_are_compared_a_few_candidates_at_a_time(clips, monkeypatch):
    """What a kernel holds stays below a limit, and scores are the same."""
    observation = load_observation(clips[0] / "flows.npz")
    space = Space.around(load_scenes(clips[0] / "best32.yaml")[0])
    generator = np.random.default_rng(3)
    points = space.start + space.sigma * generator.normal(size=(20, space.dimension))
    batch = space.decode(np.clip(points, 0, 1))
    poses = MujocoSimulator(batch.shapes, observation.fps, 1).rollout(batch, observation.length)
    clip = sampled(observation, (1,))

    def scored() -> tuple[int, np.ndarray]:
        monkeypatch.setattr(grid, "_USED", {})
        scorer = GridScorer(batch.shapes, [clip])
        scores = scorer(poses, batch)
        return scorer._layout((20,), 20).chunk, scores.fitness

    whole, fitness = scored()
    assert whole == 16
    monkeypatch.setattr(grid, "MOST", 5 * clip.ids.size)
    few, again = scored()
    assert few == 4
    np.testing.assert_allclose(again, fitness, rtol=1e-5)


def test_clips_that_leave_keep_their_room(clips):
    observations = [load_observation(clip / "flows.npz") for clip in clips]
    scorer = GridScorer(("sphere",), [sampled(one, (1,), (48, 32)) for one in observations])
    batch = batch_from_scenes([perturbed(FLIGHT, k, 0.2) for k in range(120)])
    poses = MujocoSimulator(("sphere",), 30.0, 1).rollout(batch, FRAMES)
    all_three = scorer.score(poses, batch, [40, 40, 40])
    used = set(scorer._used)  # also those of other scorers of the kind
    left = np.r_[0:40, 80:120]
    two = scorer.score(poses[left], batch[left], [40, 0, 40])
    assert scorer._used == used  # nothing is compiled anew
    assert [len(one.fitness) for one in two] == [40, 0, 40]
    for k in (0, 2):
        np.testing.assert_array_equal(two[k].fitness, all_three[k].fitness)
    # But few candidates are not drawn in the room of many.
    few = scorer._layout((5, 0, 0), 5)
    assert few.chunk * len(few.clip) <= 128 < 9 * 16


def test_what_is_compiled_beforehand_is_what_the_clips_then_run(clips, tmp_path):
    options = dataclasses.replace(TINY, optimizer="cmaes", population=12)
    simulator = MujocoSimulator(("sphere",), 30.0, 1)
    asked = []

    def made(backend, shapes, fps):
        asked.append((backend, shapes, fps))
        return simulator

    warm_up(jobs_of(clips)[0], 3, options, made)
    assert asked == [("mujoco", ("sphere",), 30.0)]
    compiled = grid._compared._cache_size()
    assert compiled > 0
    ended = []
    Together(members_of(clips, tmp_path, options), simulator, lambda member, error: ended.append(error)).run()
    assert ended == [None] * 3
    assert grid._compared._cache_size() == compiled
    warm_up(Job(tmp_path / "none.yaml", tmp_path / "none.npz", "none"), 3, options, made)  # its worker will say so
    assert len(asked) == 1


def test_weights_are_each_clips_own(clips):
    observation = load_observation(clips[0] / "flows.npz")
    clip = sampled(observation, (1,), (48, 32))
    batch = batch_from_scenes([perturbed(FLIGHT, k, 0.2) for k in range(6)])
    poses = MujocoSimulator(("sphere",), 30.0, 1).rollout(batch, FRAMES)
    weights = (Weights(), Weights(epe=0.0))
    first, second = GridScorer(("sphere",), [clip, clip], weights).score(poses, batch, [3, 3])
    np.testing.assert_allclose(first.fitness, first.iou - first.epe)
    np.testing.assert_allclose(second.fitness, second.iou)


def test_batches_take_a_size_that_is_compiled():
    assert room(100, []) == 128
    assert room(100, [4096, 256, 300]) == 256
    assert room(100, [64, 4096]) == 128
    assert room(100, [], 3) == 129


def test_few_candidates_are_for_the_cores(monkeypatch):
    monkeypatch.setattr(backends, "resolve_backend", lambda name: "warp" if name == "auto" else name)
    monkeypatch.setattr(backends, "cores", lambda: 16)
    assert [backends.fastest("auto", n, 2) for n in (16, 32, 33)] == ["mujoco", "mujoco", "warp"]
    assert [backends.fastest("auto", n, LARGEST + 1) for n in (384, 385)] == ["mujoco", "warp"]
    assert backends.fastest("warp", 1, 2) == "warp"
    assert backends.fastest("mjx", 1, 2) == "mjx"
    monkeypatch.setenv(backends.OFFERED, "warp")  # what a worker beside the GPU's process has
    assert backends.fastest("auto", 385, 2) == "mujoco"


def test_a_scene_with_an_effect_is_refined_by_its_worker_alone(clips, tmp_path):
    scene = dataclasses.replace(
        load_scenes(clips[0] / "best32.yaml")[0], effects=(Effect("slope", None, (("x", 0.02),)),)
    )
    save_scenes(tmp_path / "slope.yaml", [scene])
    job = Job(tmp_path / "slope.yaml", clips[0] / "flows.npz", "slope")
    outcome = prepare(job, tmp_path, dataclasses.replace(TINY, optimizer="cmaes", iterations=2))
    assert not isinstance(outcome, Prepared)
    assert (outcome.status, outcome.evaluations) == ("done", 16)


@pytest.mark.gpu
def test_clips_are_searched_together_on_a_gpu(clips, tmp_path):
    """Two groups side by side, and costs near those of C MuJoCo where nothing is chaotic yet."""
    options = dataclasses.replace(TINY, optimizer="cmaes", backend="warp", population=16)
    members = members_of(clips, tmp_path, options)
    calls = [recorded(member) for member in members]
    simulator = backends.make_simulator("warp", ("sphere",), 30.0, quick=True)
    Together(members, simulator, lambda member, error: pytest.fail(str(error)) if error else None).run()
    for member, clip, own in zip(members, clips, calls, strict=True):
        points, costs = own[0]
        np.testing.assert_allclose(costs, objective_alone(member, clip)(points)[0], atol=0.02)
    crate = tmp_path / "crate"
    crate.mkdir()
    save_observation(crate / "flows.npz", simulate(SLIDE, size=SIZE, frames=FRAMES))
    save_scenes(crate / "best32.yaml", [perturbed(SLIDE, 5)])
    many = refine_many(jobs_of([*clips, crate]), options, out=tmp_path / "out", workers=2)
    assert [outcome.status for outcome in many.outcomes] == ["done"] * 4
