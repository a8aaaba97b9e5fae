"""Whole refinements of tiny clips: never worse, the same twice, and the same when interrupted and resumed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from mjx_refine.batch import batch_from_scenes
from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.scene import Body, Camera, Scene
from mjx_refine.scene.write import dump_scene
from mjx_refine.search import OPTIMIZERS, Options, Progress, RefineResult, Step, refine
from mjx_refine.search import run as run_module
from mjx_refine.search.checkpoint import load_checkpoint, save_checkpoint
from mjx_refine.search.refine import CHECKPOINT, UNASKED, UNDETERMINED
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.space import Space
from mjx_refine.view.picture import draw

SIZE, FRAMES = (96, 64), 8
BALL = Body("sphere", "ball", (0.25,), (-0.6, 0.3, 0.8), linear_velocity=(2.5, 0.0, 1.0))
CRATE = Body("box", "crate", (0.3, 0.2, 0.2), (0.7, 0.2, 0.2), linear_velocity=(-2.0, 0.5, 0.0))
TRUTH = Scene((BALL, CRATE), Camera((0.0, -3.0, 1.8), 62.0, 45.0))
TINY = Options(population=8, iterations=4, backend="mujoco", threads=1, refits=0)


def clip_of(scene: Scene, **changes) -> Observation:
    batch = batch_from_scenes([scene])
    poses = MujocoSimulator(scene.shapes, 30.0, 1).rollout(batch, FRAMES)
    masks, flow = draw(poses[0], batch, SIZE)
    return dataclasses.replace(Observation(flow, masks.astype(np.int32), 30.0), **changes)


def perturbed(seed: int, scene: Scene = TRUTH, scale: float = 0.4) -> Scene:
    space = Space.around(scene)
    step = scale * space.sigma * np.random.default_rng(seed).normal(size=space.dimension)
    return space.scene_at(np.clip(space.start + step, 0, 1))


@pytest.fixture(scope="module")
def clip() -> Observation:
    return clip_of(TRUTH)


SAMPLES = [perturbed(seed) for seed in range(3)]


def test_without_refits_nothing_says_that_the_clip_determines_a_parameter(clip):
    result = refine(SAMPLES[0], clip, TINY)
    assert not any(row.determined for row in result.parameters)
    assert {row.note for row in result.parameters} <= {UNASKED, UNDETERMINED}


def test_a_path_or_plain_weights_are_refused():
    with pytest.raises(InputError, match=r"is a str; expected an Observation; read one with load_observation"):
        refine(SAMPLES[0], "one.npz", TINY)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"expected mjx_fitness\.Weights"):
        Options(weights={"iou": 1.0})  # type: ignore[arg-type]


def history_of(result: RefineResult) -> list[Step]:
    """The steps, without what the clock says."""
    return [dataclasses.replace(step, seconds=0.0) for step in result.history]


def check(result: RefineResult, options: Options) -> None:
    """What every result promises."""
    assert result.refined.scores.fitness[0] >= result.init.scores.fitness[0]
    assert np.isfinite(result.refined.scores.fitness[0])
    assert result.evaluations <= options.budget
    assert [step.evaluations for step in result.history] == sorted(step.evaluations for step in result.history)
    assert result.scene.objects
    assert len(result.matching) == len(result.scene.objects)
    assert result.reason
    values = dict(
        zip(Space.around(result.scene).names, (p.start for p in Space.around(result.scene).parameters), strict=True)
    )
    for row in result.parameters:
        if row.name in values and "tilt" not in row.name and "yaw" not in row.name:
            assert row.after == pytest.approx(values[row.name], rel=1e-6, abs=1e-6), row.name


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_never_worse_than_the_best_sample_and_the_same_twice(clip, optimizer):
    options = dataclasses.replace(TINY, optimizer=optimizer, iterations=12, seed=3)
    one, two = refine(SAMPLES, clip, options), refine(SAMPLES, clip, options)
    check(one, options)
    best = max(refine([s], clip, dataclasses.replace(TINY, iterations=1)).init.scores.fitness[0] for s in SAMPLES)
    assert one.init.scores.fitness[0] == best
    assert dump_scene(one.scene) == dump_scene(two.scene)
    assert history_of(one) == history_of(two)
    assert one.evaluations == two.evaluations
    other = refine(SAMPLES, clip, dataclasses.replace(options, seed=4))
    if optimizer == "cmaes":
        assert dump_scene(other.scene) != dump_scene(one.scene)


def test_a_real_budget_gains(clip):
    options = dataclasses.replace(TINY, population=16, iterations=60)
    result = refine(SAMPLES, clip, options)
    check(result, options)
    assert result.refined.scores.iou[0] > max(0.85, result.init.scores.iou[0])


def test_the_truth_is_not_spoilt(clip):
    result = refine(TRUTH, clip, dataclasses.replace(TINY, optimizer="cmaes"))
    assert result.refined.scores.iou[0] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(("population", "iterations"), [(8, 4), (4, 1), (5, 2), (4, 40)])
@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_small_budgets(clip, optimizer, population, iterations):
    options = dataclasses.replace(TINY, optimizer=optimizer, population=population, iterations=iterations)
    check(refine(SAMPLES[:2], clip, options), options)


# Interrupted and resumed ------------------------------------------------------------------------------------------------


class Interrupting(Progress):
    """Stops the run at its n-th step, as Ctrl-C would."""

    def __init__(self, at: int):
        self.left = at

    def step(self, step: Step) -> None:
        self.left -= 1
        if self.left == 0:
            raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("optimizer", "samples", "iterations"), [("cmaes", 3, 9), ("hybrid", 1, 80), ("hybrid", 3, 40)]
)
def test_resuming_ends_where_the_whole_run_ends(clip, optimizer, samples, iterations, tmp_path, monkeypatch):
    monkeypatch.setattr(run_module, "CHECKPOINT_SECONDS", 0.0)
    options = dataclasses.replace(TINY, optimizer=optimizer, population=10, iterations=iterations, seed=1)
    whole = refine(SAMPLES[:samples], clip, options, folder=tmp_path / "whole")
    steps = len(whole.history)
    landing = sum(step.phase == "land" for step in whole.history)
    moments = sorted({1, max(landing, 2), min(landing + 2, steps), steps})
    for moment in moments:
        folder = tmp_path / str(moment)
        with pytest.raises(KeyboardInterrupt):
            refine(SAMPLES[:samples], clip, options, folder=folder, progress=Interrupting(moment))
        again = refine(SAMPLES[:samples], clip, options, folder=folder, resume=True)
        assert dump_scene(again.scene) == dump_scene(whole.scene), moment
        assert history_of(again) == history_of(whole), moment
        assert again.evaluations == whole.evaluations
        assert again.reason == whole.reason


def test_interrupted_twice_and_resumed_after_the_end(clip, tmp_path, monkeypatch):
    monkeypatch.setattr(run_module, "CHECKPOINT_SECONDS", 0.0)
    options = dataclasses.replace(TINY, optimizer="cmaes", iterations=9)
    whole = refine(SAMPLES, clip, options)
    for moment, resume in ((4, False), (3, True)):
        with pytest.raises(KeyboardInterrupt):
            refine(SAMPLES, clip, options, folder=tmp_path, progress=Interrupting(moment), resume=resume)
    for _ in range(2):
        again = refine(SAMPLES, clip, options, folder=tmp_path, resume=True)
        assert dump_scene(again.scene) == dump_scene(whole.scene)
        assert history_of(again) == history_of(whole)


def test_resuming_without_a_checkpoint_starts_from_the_beginning(clip, tmp_path):
    options = dataclasses.replace(TINY, optimizer="cmaes")
    fresh = refine(SAMPLES, clip, options, folder=tmp_path, resume=True)
    assert dump_scene(fresh.scene) == dump_scene(refine(SAMPLES, clip, options).scene)


@pytest.fixture
def checkpoint(clip, tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr(run_module, "CHECKPOINT_SECONDS", 0.0)
    refine(SAMPLES, clip, dataclasses.replace(TINY, optimizer="cmaes"), folder=tmp_path)
    assert (tmp_path / CHECKPOINT).exists()
    return tmp_path / CHECKPOINT


@pytest.mark.parametrize("other", ["seed", "samples", "flow", "masks", "fps"])
def test_a_checkpoint_of_another_input_is_refused(clip, checkpoint, other):
    options = dataclasses.replace(TINY, optimizer="cmaes", seed=int(other == "seed"))
    changed = {
        "flow": {"flow": clip.flow + np.float32(1e-3)},
        "masks": {"masks": np.where(clip.masks == 2, 3, clip.masks)},
        "fps": {"fps": 29.0},
    }.get(other, {})
    samples = SAMPLES[:2] if other == "samples" else SAMPLES
    with pytest.raises(InputError, match="another input"):
        refine(samples, dataclasses.replace(clip, **changed), options, folder=checkpoint.parent, resume=True)


@pytest.mark.parametrize(
    "damage", ["empty", "noise", "truncated", "a flipped byte", "an array", "no values", "no arrays"]
)
def test_a_damaged_checkpoint_is_refused(clip, checkpoint, damage):
    content = checkpoint.read_bytes()
    middle = len(content) // 2
    if damage == "an array":
        with open(checkpoint, "wb") as stream:
            np.save(stream, np.zeros(3))
    elif damage == "no values":
        np.savez(checkpoint, other=np.zeros(3))
    elif damage == "no arrays":
        with np.load(checkpoint) as archive:
            np.savez(checkpoint, __values__=archive["__values__"])
    else:
        checkpoint.write_bytes(
            {
                "empty": b"",
                "noise": bytes(range(256)) * 8,
                "truncated": content[:middle],
                "a flipped byte": content[:middle] + bytes([content[middle] ^ 255]) + content[middle + 1 :],
            }[damage]
        )
    with pytest.raises(InputError, match=CHECKPOINT):
        refine(SAMPLES, clip, dataclasses.replace(TINY, optimizer="cmaes"), folder=checkpoint.parent, resume=True)


def test_checkpoints_keep_every_bit(tmp_path):
    values = {"digest": "d", "number": 0.1 + 0.2, "rows": [1, 2.5, "x"]}
    arrays = {"a": np.array([np.pi, -0.0, np.inf]), "b": np.arange(4, dtype=np.uint64)}
    save_checkpoint(tmp_path / "c.npz", values, arrays)
    loaded = load_checkpoint(tmp_path / "c.npz", "d")
    assert loaded is not None
    assert {k: loaded[0][k] for k in values} == values
    for name, array in arrays.items():
        assert loaded[1][name].tobytes() == array.tobytes()


# Awkward input ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_samples_of_different_kinds(clip, optimizer):
    lacking = dataclasses.replace(SAMPLES[0], objects=SAMPLES[0].objects[1:])
    swapped = dataclasses.replace(SAMPLES[1], objects=SAMPLES[1].objects[::-1])
    options = dataclasses.replace(TINY, optimizer=optimizer, iterations=8)
    check(refine([lacking, swapped, SAMPLES[2]], clip, options), options)
    check(refine([lacking], clip, options), options)


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_a_clip_without_masks(clip, optimizer):
    options = dataclasses.replace(TINY, optimizer=optimizer, iterations=10)
    check(refine(SAMPLES, dataclasses.replace(clip, masks=None, flow=clip.flow), options), options)


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_an_object_whose_mask_never_appears(clip, optimizer):
    options = dataclasses.replace(TINY, optimizer=optimizer, iterations=12)
    result = refine(SAMPLES, dataclasses.replace(clip, masks=np.where(clip.masks == 1, 1, 0)), options)
    check(result, options)
    assert sorted(result.matching) == [-1, 1]


def test_an_object_whose_mask_appears_late_finds_it(clip):
    masks = clip.masks.copy()
    masks[:5][masks[:5] == 2] = 0
    result = refine(SAMPLES, dataclasses.replace(clip, masks=masks), TINY)
    check(result, TINY)
    assert result.matching == (1, 2)


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_flow_that_was_never_measured(clip, optimizer):
    options = dataclasses.replace(TINY, optimizer=optimizer, iterations=12)
    result = refine(SAMPLES, dataclasses.replace(clip, flow=clip.flow * np.nan), options)
    check(result, options)
    assert result.refined.scores.epe[0] == 0.0


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_samples_that_show_nothing_of_the_clip(clip, optimizer):
    away = dataclasses.replace(TRUTH, camera=Camera((0.0, 300.0, 1.8), 80.0, 30.0))
    options = dataclasses.replace(TINY, optimizer=optimizer, iterations=10)
    check(refine([away], clip, options), options)


def test_a_clip_of_two_frames(clip):
    short = Observation(clip.flow[:1], clip.masks[:2], 30.0)
    options = dataclasses.replace(TINY, iterations=20)
    check(refine(SAMPLES, short, options), options)


def test_objects_that_start_inside_one_another(clip):
    inside = dataclasses.replace(TRUTH, objects=(BALL, dataclasses.replace(CRATE, position=BALL.position)))
    options = dataclasses.replace(TINY, iterations=10)
    result = refine([inside], clip, options)
    check(result, options)


def test_wrong_input_is_named(clip):
    with pytest.raises(InputError, match="empty"):
        refine([], clip, TINY)
    for wrong in ({"population": 3}, {"iterations": 0}, {"optimizer": "x"}, {"resolution": (4, 4)}, {"seed": -1}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            dataclasses.replace(TINY, **wrong)
    with pytest.raises(InputError, match="backend"):
        refine(SAMPLES, clip, dataclasses.replace(TINY, backend="none"))
