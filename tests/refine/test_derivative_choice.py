"""Which derivatives least squares uses, and what a result says of them."""

from __future__ import annotations

import dataclasses
import functools
import json
import subprocess
import sys

import numpy as np
import pytest

from mjx_refine.batch import batch_from_scenes
from mjx_refine.cli import commands
from mjx_refine.errors import InputError
from mjx_refine.gradients import DerivativeError, Differentiator, check
from mjx_refine.observation import Observation
from mjx_refine.report.numbers import result_numbers
from mjx_refine.report.page import trust
from mjx_refine.scene import Body, Camera, Scene
from mjx_refine.search import Options, Progress, refine
from mjx_refine.search.derivatives import LEAST_PARAMETERS, WORK, Automatic, _simulator, extent
from mjx_refine.search.features import flow_points, outlines
from mjx_refine.search.landing import LeastSquares
from mjx_refine.search.options import DERIVATIVES
from mjx_refine.search.schedule import stages
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.space import Space
from mjx_refine.view.picture import draw

SIZE, FRAMES = (160, 107), 12
CAMERA = Camera((0.0, -3.0, 1.6), 65.0, 45.0)
FLIGHT = Scene((Body("sphere", "ball", (0.2,), (-0.8, 0.3, 0.9), linear_velocity=(2.0, 0.4, 2.2)),), CAMERA)
# A die that hardly loses speed lands on one corner after another.
UNIT = tuple((np.array([0.9, 0.1, 0.3, 0.3]) / np.linalg.norm([0.9, 0.1, 0.3, 0.3])).tolist())
DIE = Body("box", "die", (0.2, 0.2, 0.2), (0.0, 0.0, 1.0), UNIT, (1.0, 0.0, 0.0), (3.0, 7.0, 2.0), damping=-4.0)
CHAOS = Scene((DIE,), CAMERA)
SMALL = Options(population=8, iterations=20, backend="mujoco", threads=1, refits=0, starts=1)


def clip_of(scene: Scene, frames: int = FRAMES) -> Observation:
    batch = batch_from_scenes([scene])
    masks, flow = draw(MujocoSimulator(scene.shapes, 30.0, 1).rollout(batch, frames)[0], batch, SIZE)
    return Observation(flow, masks.astype(np.int32), 30.0)


def perturbed(scene: Scene, seed: int, scale: float) -> Scene:
    space = Space.around(scene)
    step = scale * space.sigma * np.random.default_rng(seed).normal(size=space.dimension)
    return space.scene_at(np.clip(space.start + step, 0, 1))


class Listener(Progress):
    """Keeps what the user is told."""

    def __init__(self):
        self.told: list[str] = []

    def message(self, text: str) -> None:
        self.told.append(text)


class Ours:
    """Least squares on the flight of a sphere, with and without automatic derivatives."""

    def __init__(self):
        clip = clip_of(FLIGHT)
        masks = np.asarray(clip.masks)
        self.space = Space.around(perturbed(FLIGHT, 2, 0.3))
        self.told: list[str] = []
        self.made = Differentiator(self.space, _simulator(FLIGHT.shapes, 30.0), frames=FRAMES)
        rollout = MujocoSimulator(FLIGHT.shapes, 30.0, 1).rollout
        make = functools.partial(
            LeastSquares, self.space, rollout, outlines(masks), (0,), SIZE, flow=flow_points(masks, clip.flow, (1,))
        )
        self.differences = make()
        self.automatic = make(automatic=Automatic(self.made, self.told.append))

    def jacobians(self, frames: int, scale: float = 6.0) -> tuple[np.ndarray, np.ndarray]:
        start = self.space.start
        base = self.differences.residuals(start[None], frames, scale)[0][0]
        return tuple(s.jacobian(start, base, frames, scale) for s in (self.differences, self.automatic))


@pytest.fixture(scope="module")
def ours() -> Ours:
    return Ours()


@pytest.mark.parametrize(("frames", "scale"), [(1, 12.0), (5, 12.0), (FRAMES, 2.0)])
def test_automatic_jacobian_is_that_of_central_differences(ours, frames, scale):
    start, sigma = ours.space.start, ours.space.sigma
    one_sided, automatic = ours.jacobians(frames, scale)
    assert automatic.shape == one_sided.shape
    # The one-sided differences bend with their step of 0.05; central ones of 0.01 are the oracle.
    inside = (start - 0.01 * sigma >= 0) & (start + 0.01 * sigma <= 1)
    points = (start + sign * 0.01 * np.diag(sigma) for sign in (1, -1))
    ahead, behind = (ours.differences.residuals(np.clip(p, 0, 1), frames, scale)[0] for p in points)
    central = ((ahead - behind) / 0.02).T
    lengths = np.linalg.norm(central, axis=0)
    assert lengths.max() > 10
    errors = np.linalg.norm(automatic - central, axis=0)[inside]
    assert (errors <= 0.02 * lengths[inside] + 1e-3 * lengths.max()).all()
    cosine = (automatic * one_sided).sum() / np.linalg.norm(automatic) / np.linalg.norm(one_sided)
    assert cosine > 0.97
    assert not ours.told


def test_a_column_counts_as_a_rollout(ours):
    before = ours.automatic.spent, ours.differences.spent
    ours.jacobians(6)
    expected = ours.space.dimension * 6 / FRAMES
    assert ours.automatic.spent - before[0] == pytest.approx(expected)
    # One rollout of it is the residuals' at the point itself.
    assert ours.differences.spent - before[1] == pytest.approx(expected + 6 / FRAMES)


def broken_twice(ours, monkeypatch, error: Exception) -> tuple[list[str], int]:
    """(what was said, how often it was tried) in two Jacobians without automatic derivatives, which are differences."""
    told, tried = [], []

    def broken(*_):
        tried.append(1)
        raise error

    monkeypatch.setattr(ours.automatic, "automatic", Automatic(ours.made, told.append))
    monkeypatch.setattr(ours.made, "_pushed", broken)
    for _ in range(2):
        one_sided, instead = ours.jacobians(5)
        np.testing.assert_array_equal(instead, one_sided)
    return told, len(tried)


def test_differences_step_in_and_it_is_said_once(ours, monkeypatch):
    problem = "the derivative in ball.radius is not finite from row 3 of 5 on"
    told, tried = broken_twice(ours, monkeypatch, DerivativeError(problem))
    assert told == [f"differences instead of automatic derivatives: {problem}"]
    assert tried == 2


def test_what_does_not_compile_is_not_tried_again(ours, monkeypatch):
    told, tried = broken_twice(ours, monkeypatch, InputError("mujoco-mjx: its solver is not as in 3.17.0"))
    assert len(told) == tried == 1


def test_kinks_are_left_to_differences(ours, monkeypatch):
    kink = np.arange(ours.space.dimension) == ours.space.names.index("ball.radius")
    one_sided, whole = ours.jacobians(5)
    monkeypatch.setattr("mjx_refine.search.derivatives.kinked", lambda *_: kink)
    mixed = ours.jacobians(5)[1]
    # In a batch of another size single precision rounds differently.
    np.testing.assert_allclose(mixed[:, kink], one_sided[:, kink], atol=1e-3)
    np.testing.assert_array_equal(mixed[:, ~kink], whole[:, ~kink])
    assert np.abs(whole - one_sided)[:, kink].max() > 1e-2


def test_automatic_derivatives_land_a_flight(monkeypatch):
    used = []
    original = Automatic.__call__

    def counted(self, *arguments):
        found = original(self, *arguments)
        used.append(found is not None)
        return found

    monkeypatch.setattr(Automatic, "__call__", counted)
    listener, clip, start = Listener(), clip_of(FLIGHT), perturbed(FLIGHT, 2, 0.7)
    options = dataclasses.replace(SMALL, optimizer="gradient", derivatives="autodiff", iterations=100)
    result = refine(start, clip, options, progress=listener)
    assert len(used) > len(stages(FRAMES)) / 2
    assert all(used)
    assert result.init.scores.iou[0] < 0.6
    assert result.refined.scores.iou[0] > 0.95
    assert result.evaluations <= options.budget
    assert result.derivatives is not None
    assert result.derivatives.method == "autodiff"
    assert result_numbers(result, clip)["derivatives"] == {
        "method": "autodiff",
        "reason": "automatic derivatives agree with finite differences in every frame",
    }
    assert "Automatic derivatives of this clip's simulation can be trusted" in trust(result)
    assert not listener.told


@pytest.mark.parametrize("optimizer", ["gradient", "cmaes"])
def test_a_chaotic_scene_is_said_to_be_one(optimizer):
    listener, clip = Listener(), clip_of(CHAOS, 40)
    result = refine(CHAOS, clip, dataclasses.replace(SMALL, optimizer=optimizer), progress=listener)
    told = result_numbers(result, clip)["derivatives"]
    assert told["method"] == "population"
    assert "jagged" in told["reason"]
    assert "No derivative of this clip's simulation can be trusted" in trust(result)
    warned = [text for text in listener.told if "--optimizer hybrid is the better choice" in text]
    assert len(warned) == (optimizer == "gradient")
    assert result.derivatives is not None
    assert result.derivatives.until < 20
    if warned:
        assert warned[0].startswith(
            f"derivatives cannot be trusted on this clip after frame {result.derivatives.until}:"
        )


def test_a_verdict_is_in_every_result_and_in_its_json_and_the_same_when_resumed(tmp_path):
    clip, start = clip_of(FLIGHT), perturbed(FLIGHT, 3, 0.3)
    one = refine(start, clip, SMALL, folder=tmp_path)
    again = refine(start, clip, SMALL, folder=tmp_path, resume=True)
    assert one.derivatives == again.derivatives
    told = json.loads(json.dumps(result_numbers(one, clip)))["derivatives"]
    assert set(told) == {"method", "reason"}
    assert told["method"] == "differences"
    assert told["reason"].startswith("wide finite differences agree with each other in every frame")
    assert trust(one).startswith("Differences of rollouts of this clip's simulation can be trusted")
    assert trust(dataclasses.replace(one, derivatives=None)) == ""
    assert result_numbers(dataclasses.replace(one, derivatives=None), clip)["derivatives"] is None


def test_a_check_stays_within_its_work():
    one = Space.around(FLIGHT)
    crowd = Space.around(Scene(tuple(dataclasses.replace(DIE, name=f"d{i}") for i in range(8)), CAMERA))
    assert extent(30, one) == (30, one.dimension)
    assert extent(60, crowd)[0] == 60
    for space, length in ((one, 10**4), (crowd, 60), (crowd, 10**4)):
        frames, most = extent(length, space)
        assert frames * (4 * most + 2) * len(space.scene.shapes) <= WORK
        assert LEAST_PARAMETERS <= most <= space.dimension


def test_a_part_of_the_parameters_tells_of_all():
    space, simulator = Space.around(CHAOS), MujocoSimulator(CHAOS.shapes, 30.0, 1)
    rows = []

    class Counting:
        fps = 30.0

        def rollout(self, batch, frames):
            rows.append(len(batch))
            return simulator.rollout(batch, frames)

    told = check(space, space.start, 40, SIZE, simulator=Counting(), most=6)
    assert rows == [13, 13]
    assert told.method == "population"


def test_a_search_without_automatic_derivatives_does_not_import_mjx():
    text = "import sys, mjx_refine.search.derivatives; assert 'mujoco.mjx' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", text], check=False).returncode == 0


def test_derivatives_have_one_list():
    assert commands.DERIVATIVES == DERIVATIVES
    with pytest.raises(InputError, match="derivatives = 'exact'; expected one of auto, differences, autodiff"):
        Options(derivatives="exact")
