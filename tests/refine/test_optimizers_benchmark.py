"""The benchmark of optimisers: small runs of every method, and what its tables and its oracle say."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import math
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import optimizers
from benchmarks.optimizer_curves import iou_at, mean_curve, seconds_to, tables
from benchmarks.optimizers import Curve, Method, Poses, measure
from mjx_refine import load_observation, load_scenes
from mjx_refine.batch import batch_from_scenes
from mjx_refine.observation import Observation
from mjx_refine.scene import Body, Camera, Samples, Scene
from mjx_refine.search import Options
from mjx_refine.search.problem import Problem
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.space import Space
from mjx_refine.view.picture import draw

EXAMPLE = Path(__file__).parent.parent.parent / "examples/clip"
TINY = Options(population=8, iterations=4, backend="mujoco", threads=1, refits=0)
SIZE, FRAMES = (160, 108), 10
TRUTH = Scene(
    (
        Body("sphere", "ball", (0.25,), (-0.6, 0.3, 0.8), linear_velocity=(2.5, 0.0, 1.0)),
        Body("box", "crate", (0.3, 0.2, 0.15), (0.5, 0.2, 0.6), (0.5, 0.5, -0.1, 0.7), angular_velocity=(0.0, 2.0, 1.0)),
        Body("cylinder", "can", (0.15, 0.25), (0.0, 0.9, 0.25), linear_velocity=(0.5, -0.3, 0.0)),
    ),
    Camera((0.0, -3.0, 1.8), 62.0, 45.0),
)  # fmt: skip


@pytest.fixture(scope="module")
def observation() -> Observation:
    batch = batch_from_scenes([TRUTH])
    masks, flow = draw(MujocoSimulator(TRUTH.shapes, 30.0, 1).rollout(batch, FRAMES)[0], batch, SIZE)
    return Observation(flow, masks.astype(np.int32), 30.0)


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("clips") / "example"
    shutil.copytree(EXAMPLE, folder)
    return folder


def poses_from(scene: Scene, observation: Observation) -> Poses:
    return Poses(Problem(Samples("<test>", (scene,), (0,)), observation, TINY), TRUTH, TINY)


def needs(method: str) -> None:
    for name in {"pycma": ["cma"], "oracle": ["colorama", "tabulate"]}.get(method, []):
        if importlib.util.find_spec(name) is None:
            pytest.skip(f"{method} needs {name}")


@pytest.mark.parametrize("label", ["hybrid", "gradient:gauss-newton", "cmaes@16", "pycma"])
def test_methods_keep_their_budget_and_never_fall(clip, label):
    needs(label)
    method = Method.parse(label)
    run = measure(clip, method, TINY)
    assert run["budget"] == method.options(TINY).budget == (16 if "@" in label else 32)
    assert run["evaluations"] <= run["budget"]
    evaluations, seconds, fitness, _ = np.array(run["curve"]).T
    assert evaluations[0] == 0
    assert evaluations[-1] <= run["budget"]
    for rising in (evaluations, seconds, fitness):
        assert (np.diff(rising) >= 0).all()
    assert run["final"]["fitness"] >= run["start"]["fitness"] - 1e-9
    json.dumps(run, allow_nan=False)


def test_the_best_sample_scores_as_it_does_alone():
    samples, observation = load_scenes(EXAMPLE / "best32.yaml"), load_observation(EXAMPLE / "flows.npz")
    problem = Problem(samples, observation, TINY)
    start = problem.starts[0]
    assert problem.score([start.given], start.matching).fitness[0] == start.fitness


def test_without_its_truth_the_oracle_is_left_out(clip):
    run = measure(clip, Method.parse("oracle"), TINY)
    assert run["skipped"] == "no truth.yaml"
    assert "left out: oracle: no truth.yaml" in tables([run])


def test_from_folder_to_table_and_picture(clip, tmp_path, monkeypatch, capsys):
    out, picture = tmp_path / "one.json", tmp_path / "curves.png"
    common = ["--population", "8", "--iterations", "2", "--threads", "1", "--json", str(out)]
    call = ["optimizers", str(clip.parent), "--only", "example", "--methods", "cmaes,hybrid@8", *common]
    monkeypatch.setattr(sys, "argv", call)
    optimizers.main()
    monkeypatch.setattr(sys, "argv", ["optimizers", "--merge", str(out), "--plot", str(picture)])
    capsys.readouterr()
    optimizers.main()
    printed = capsys.readouterr().out
    assert "| unknown | cmaes | 1 |" in printed
    assert "hybrid@8 with at most 2,560 rollouts reaches CMA-ES's last IoU on" in printed
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_methods_are_read():
    method = Method.parse("gradient:adam@2560")
    assert (method.name, method.solver, method.budget) == ("gradient", "adam", 2560)
    assert method.options(Options()).budget == 2560
    with pytest.raises(ValueError, match="one of hybrid, cmaes, gradient, pycma, oracle"):
        Method.parse("newton")


def run_of(method: str, clip: str, rows: list, budget: int = 12800) -> dict:
    final, truth = {"iou": rows[-1][3]}, {"a": 0.8, "b": 0.9}[clip]
    return {"clip": clip, "kind": "slide", "method": method, "budget": budget, "curve": rows, "final": final,
            "seconds": rows[-1][1], "truth_iou": truth}  # fmt: skip


def test_tables_read_the_curves():
    few = run_of("hybrid", "a", [(0, 0.0, 0.1, 0.3), (600, 1.0, 0.5, 0.6), (2000, 2.0, 0.8, 0.9)])
    full = run_of("cmaes", "a", [(0, 0.0, 0.1, 0.3), (2000, 3.0, 0.5, 0.7), (12800, 9.0, 0.8, 0.85)])
    other = run_of("cmaes", "b", [(0, 0.0, 0.1, 0.3), (12800, 9.0, 0.8, 0.95)])
    worse = run_of("hybrid", "b", [(0, 0.0, 0.1, 0.3), (2561, 1.0, 0.9, 0.96)])
    assert [iou_at(few, n) for n in (0, 599, 640, 12800)] == [0.3, 0.3, 0.6, 0.9]
    assert iou_at({**few, "budget": 2560}, 12800) is None
    assert (seconds_to(few, 0.85), seconds_to(few, 0.95)) == (2.0, None)
    text = tables([few, full, other, worse])
    assert "| slide | hybrid | 2 | 0.450 | 0.600 | 0.930 | 0.930 | 1.5 (2 of 2) | 1.5 |" in text
    assert "reaches CMA-ES's last IoU on 1 of 2 clips (50%)" in text
    assert "the true scenes, simulated by C MuJoCo, have an IoU of 0.850: slide 0.850" in text
    np.testing.assert_allclose(mean_curve([few, worse], 0, np.array([1.0, 700.0, 3000.0])), [0.3, 0.45, 0.93])


def test_a_curve_keeps_the_best():
    curve = Curve()
    for n, (fitness, iou) in enumerate([(0.1, 0.5), (0.4, 0.3), (0.2, 0.9), (math.nan, 1.0)]):
        curve.add(n, fitness, iou, float(n))
    assert [row[2:] for row in curve.rows] == [(0.1, 0.5), (0.4, 0.3), (0.4, 0.3), (0.4, 0.3)]


# The oracle -----------------------------------------------------------------------------------------------------------


def test_at_the_truth_poses_agree(observation):
    poses = poses_from(TRUTH, observation)
    assert sorted(poses.partner) == [0, 1, 2]
    assert not {p.field for p in poses.space.parameters} & set(optimizers.GIVEN)
    assert np.abs(poses.residuals(poses.space.start[None], FRAMES)).max() < 1e-6
    moved = poses.space.start + 0.3 * poses.space.sigma
    assert np.abs(poses.residuals(np.clip(moved, 0, 1)[None], FRAMES)).max() > 1


def test_a_box_told_by_other_axes_is_the_same_box(observation):
    crate = TRUTH.objects[1]
    # The same box with its first axis along the old second: a quarter turn about the third.
    w, x, y, z = crate.orientation
    half = math.sqrt(0.5)
    turned = (half * (w - z), half * (x + y), half * (y - x), half * (z + w))
    spin = (crate.angular_velocity[1], -crate.angular_velocity[0], crate.angular_velocity[2])
    other = dataclasses.replace(crate, size=(0.2, 0.3, 0.15), orientation=turned, angular_velocity=spin)
    scene = dataclasses.replace(TRUTH, objects=(TRUTH.objects[0], other, TRUTH.objects[2]))
    poses = poses_from(scene, observation)
    np.testing.assert_allclose(poses.start.scene.objects[1].size, other.size)
    assert np.abs(poses.residuals(poses.space.start[None], FRAMES)).max() < 0.1


def test_the_oracle_finds_the_truth_from_nearby(observation):
    needs("oracle")
    space = Space.around(TRUTH)
    near = space.start + 0.1 * space.sigma * np.random.default_rng(1).normal(size=space.dimension)
    samples = Samples("<test>", (space.scene_at(np.clip(near, 0, 1)),), (0,))
    outcome = optimizers.oracle(samples, observation, dataclasses.replace(TINY, iterations=300), TRUTH)
    assert outcome.evaluations <= 2400
    assert outcome.final["iou"] > 0.99
