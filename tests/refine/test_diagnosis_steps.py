"""How a diagnosis' fits step, look around their ends, share base parameters, and what of chaos they believe."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_diagnosis import FLIGHT, clip_of
from test_diagnosis_replay import started

from mjx_refine.diagnosis.fits.chaos import DRAWS, EXCUSED, believed, drawn, jaggedness
from mjx_refine.diagnosis.fits.crew import Crew
from mjx_refine.diagnosis.fits.fitted import Fit
from mjx_refine.diagnosis.fits.hypothesis import term
from mjx_refine.diagnosis.fits.numbers import tied
from mjx_refine.diagnosis.fits.pace import ATTEMPTS, STEPS, Differences, Effort, damped, descended, updated
from mjx_refine.diagnosis.fits.roam import Strategy
from mjx_refine.diagnosis.search.exchange import at_least_nothing, exchanged, surely
from mjx_refine.diagnosis.seen.measure import Parts, moment_roughness
from mjx_refine.diagnosis.seen.noise import Counts, settled

RNG = np.random.default_rng(0)


def test_updated_derivatives_predict_the_step_and_change_nothing_across_it():
    jacobian, step, change = RNG.normal(size=(7, 3)), RNG.normal(size=3), RNG.normal(size=7)
    new = updated(jacobian, step, change)
    across = np.cross(step, [0.3, -0.2, 0.9])
    assert np.allclose(new @ step, change)
    assert np.allclose(new @ across, jacobian @ across)


def test_a_step_of_length_zero_leaves_the_derivatives():
    jacobian = RNG.normal(size=(7, 3))
    assert np.array_equal(updated(jacobian, np.zeros(3), np.zeros(7)), jacobian)


def test_an_undamped_step_ends_at_the_bottom_and_within_the_bounds():
    jacobian, target = RNG.normal(size=(9, 3)), np.array([0.5, -1.0, 2.0])
    curvature, gradient = jacobian.T @ jacobian, -jacobian.T @ jacobian @ target
    wide = damped(np.zeros(3), gradient, curvature, 1e-9, -np.full(3, 10.0), np.full(3, 10.0))
    narrow = damped(np.zeros(3), gradient, curvature, 1e-9, -np.full(3, 10.0), np.full(3, 1.5))
    assert np.allclose(wide, target, atol=1e-5)
    assert np.allclose(narrow, [0.5, -1.0, 1.5], atol=1e-5)


class Curved:
    """Residuals of a narrow curved valley (Rosenbrock 1960), counted, with a prior of no weight."""

    def __init__(self):
        self.rows = self.slopes = 0
        self.sizes = []

    def residuals(self, points):
        self.rows += len(points)
        x, y = points.T
        white = np.stack([10 * (y - x**2), 1 - x, np.full(len(x), 3.0)], 1)
        return white, 0.5 * (white**2).sum(1)

    def jacobian(self, z, size):
        self.slopes += 1
        self.sizes.append(size)
        assert size in STEPS
        return np.array([[-20 * z[0], 10.0], [-1.0, 0.0], [0.0, 0.0]])

    def descended(self, iterations, rival=np.inf, attempts=None, start=None, thorough=True):
        wide = np.full(2, 1e3)
        nothing = np.zeros(2)
        return descended(
            np.array([-1.2, 1.0]) if start is None else start,
            Differences(self.residuals, self.jacobian, (-wide, wide)),
            lambda z: (nothing, nothing),
            Effort(iterations, rival, attempts, thorough),
        )


def test_least_squares_follow_a_valley_to_its_end_with_derivatives_of_where_they_ended():
    z, base, cost, slopes, ended = Curved().descended(100)
    assert ended
    assert cost == pytest.approx(0.5 * base @ base)
    assert 0.5 * base @ base < 4.5 + 0.05
    assert np.allclose(base, [10 * (z[1] - z[0] ** 2), 1 - z[0], 3.0])
    # A last step that gained next to nothing is not worth others.
    assert np.allclose(slopes, [[-20 * z[0], 10.0], [-1.0, 0.0], [0.0, 0.0]], atol=0.3)


def test_what_stays_far_behind_a_rival_is_given_up_and_what_is_near_is_not():
    whole, near, far = Curved(), Curved(), Curved()
    z = whole.descended(100).z
    assert np.array_equal(near.descended(100, rival=4.5).z, z)
    assert near.rows == whole.rows
    # The constant alone costs 4.5, and 30 more than any rival are always allowed.
    given_up = far.descended(100, rival=-1e3)
    assert not given_up.ended
    assert far.rows < whole.rows
    assert far.slopes <= ATTEMPTS
    assert not np.allclose(given_up.z, 1.0, atol=1e-2)


def test_what_was_interrupted_goes_on_from_its_derivatives():
    curved = Curved()
    part = curved.descended(100, attempts=3)
    assert not part.ended
    made, rows = curved.slopes, curved.rows
    first = curved.descended(1, start=part)
    assert first.cost < part.cost
    # One look for the trial steps; the derivatives are made anew once, where it ends, and asked there whether they tell jags.
    assert curved.slopes == made + 1
    assert curved.rows == rows + 5 + 1
    whole = curved.descended(100, start=part)
    assert whole.ended
    assert whole.cost < 4.5 + 0.05


def test_larger_differences_are_tried_by_the_last_of_several_fits_alone():
    thorough, passing = Curved(), Curved()
    thorough.descended(100)
    ended = passing.descended(100, thorough=False)
    assert set(thorough.sizes) == set(STEPS)
    assert set(passing.sizes) == {STEPS[0]}
    assert ended.ended
    assert ended.cost < 4.5 + 0.05
    assert len(passing.sizes) < len(thorough.sizes)


def _ended(seed: int, jag: float) -> float:
    strategy, best = Strategy(12, 2.0, seed), np.inf
    goal = np.full(12, 1.5)
    for _ in range(60):
        points = strategy.ask()
        costs = ((points - goal) ** 2).sum(1) + jag * np.sin(40 * points).sum(1) ** 2
        best = min(best, float(costs.min()))
        strategy.tell(costs)
    return best


def test_the_strategy_descends_also_over_jags_and_the_same_seed_does_the_same():
    assert _ended(1, 0.0) < 0.1 < 27.0
    assert _ended(1, 0.02) < 3.0
    assert _ended(3, 0.02) == _ended(3, 0.02) != _ended(4, 0.02)


def test_the_strategy_passes_over_what_diverged():
    strategy = Strategy(4, 1.0, 0)
    points = strategy.ask()
    strategy.tell(np.where(points[:, 0] > 0, np.inf, (points**2).sum(1)))
    assert np.isfinite(strategy.ask()).all()


def test_smooth_paths_are_not_jagged_and_jumps_are():
    z = drawn(np.zeros(2), np.eye(2), 0)
    assert len(z) == 2 * DRAWS + 1
    assert np.allclose(z[:DRAWS], -z[DRAWS:-1])
    frames = np.arange(8.0)[None, :, None, None]
    line = z[:, 0, None, None, None] * frames
    jump = np.where((z[:, 0, None, None, None] > 0.3) & (frames > 4), 6.0, 0.0)

    def told(values):
        flow = np.repeat(values[:, :-1, :, :, None], 2, -1)
        return SimpleNamespace(
            reach=values, flow=flow, moments=np.repeat(values, 3, -1), bad=np.zeros(len(z), bool), background=None
        )

    smooth, jagged = jaggedness(told(line)), jaggedness(told(line + jump))
    assert np.allclose(smooth.reach, 0, atol=1e-9)
    assert np.allclose(smooth.moments, 0, atol=1e-9)
    assert np.allclose(jagged.reach[:5], 0, atol=1e-9)
    assert (jagged.reach[5:] > 1).all()
    assert jagged.flow.shape == (7, 1)
    assert jagged.moments.shape == (8, 1, 3)


def test_chaos_is_believed_as_far_as_the_fit_leaves_something():
    jagged = Parts(np.full((9, 2), 5.0), np.full((8, 2), 5.0), np.full((9, 2, 3), 0.01), None)
    left = Parts(np.full((9, 2, 6), 0.5), np.full((8, 2, 4, 2), 10.0), np.full((9, 2, 3), 0.5), None)
    found = believed(jagged, left)
    assert np.allclose(found.reach, EXCUSED * 0.5)
    assert np.allclose(found.flow, 5.0)
    assert np.allclose(found.moments, 0.01)
    assert np.allclose(believed(jagged, left, 2.0).reach, 1.0)


@dataclasses.dataclass(frozen=True)
class _Bowl:
    """Stands in for a hypothesis of a bowl around ``bottom`` and, of effects with a number each, ``terms``."""

    bottom: tuple[float, ...]
    terms: tuple[float, ...] = ()
    slack: None = None
    excused: None = None

    @property
    def whole(self) -> tuple[float, ...]:
        return self.bottom + self.terms

    @property
    def dimension(self) -> int:
        return len(self.whole)


class _Stuck:
    """Least squares that stays where it begins."""

    rollouts = 0.0
    crew = Crew()

    def residuals(self, hypothesis, points):
        return None, ((points - np.array(hypothesis.whole)) ** 2).sum(1) + 1.0

    def slack_along(self, fit):
        return None

    def fit(self, hypothesis, z, iterations, thorough=True):
        cost = float(self.residuals(hypothesis, z[None])[1][0])
        return Fit(hypothesis, z, cost, cost, np.eye(len(z)), z, -cost)


def test_hypotheses_hand_each_other_base_parameters_and_none_gets_worse():
    clip = _Stuck()
    base = clip.fit(_Bowl((0.0, 0.0)), np.array([3.0, 3.0]), 0)
    near = clip.fit(_Bowl((0.0, 0.0, 1.0)), np.array([0.1, 0.0, 1.0]), 0)
    far = clip.fit(_Bowl((0.0, 0.0, 0.0)), np.array([2.0, 2.0, 0.0]), 0)
    best = clip.fit(_Bowl((5.0, 5.0, 1.0)), np.array([5.0, 5.0, 1.0]), 0)
    fitted = {("near", -1): (near, 1.0), ("far", -1): (far, 2.0), ("best", -1): (best, 3.0)}
    again, shared = exchanged(clip, base, fitted)  # type: ignore[arg-type]
    assert np.allclose(again.z, [0.1, 0.0])
    assert np.allclose(shared[("far", -1)][0].z, [0.1, 0.0, 0.0])
    assert shared[("best", -1)][0] is best
    assert shared[("far", -1)][1] == 2.0
    assert all(shared[key][0].cost <= fit.cost for key, (fit, _) in fitted.items())


def test_effects_that_ended_behind_the_base_model_stand_at_no_size():
    clip = _Stuck()
    clip.at = lambda hypothesis, z: clip.fit(hypothesis, z, 0)  # type: ignore[attr-defined]
    base = clip.fit(_Bowl((0.0, 0.0)), np.array([0.5, 0.0]), 0)
    ahead = clip.fit(_Bowl((0.0, 0.0), (1.0,)), np.array([0.1, 0.0, 1.0]), 0)
    behind = clip.fit(_Bowl((0.0, 0.0), (0.0,)), np.array([2.0, 2.0, 0.5]), 0)
    placed = clip.fit(_Bowl((0.0, 0.0), (9.0,)), np.array([0.0, 0.0, 8.0]), 0)  # of which size nothing is another place
    # A base model's numbers may be fewer, as without states after impacts.
    longer = clip.fit(_Bowl((0.0, 0.0, 0.0, 0.0), (0.0,)), np.array([2.0, 2.0, 1.0, 1.0, 0.5]), 0)
    fitted = {
        ("ahead", -1): (ahead, 1.0),
        ("behind", -1): (behind, 2.0),
        ("placed", 0): (placed, 3.0),
        ("longer", 0): (longer, 4.0),
    }
    told = at_least_nothing(clip, base, fitted)  # type: ignore[arg-type]
    assert told[("ahead", -1)][0] is ahead
    assert np.allclose(told[("behind", -1)][0].z, [0.5, 0.0, 0.0])
    assert told[("behind", -1)][1] == 2.0
    assert told[("placed", 0)][0] is placed
    assert np.allclose(told[("longer", 0)][0].z, [0.5, 0.0, 0.0])


def test_what_gains_is_weighed_by_larger_differences_as_the_base_model_is():
    """With the same numbers one hypothesis may have told its jags and another not: then evidence differs by nothing else."""
    asked: list[Any] = []

    def at(hypothesis, z, doubted):
        asked.append((hypothesis, doubted))
        return SimpleNamespace(hypothesis=hypothesis, z=z, cost=0.0, evidence=-50.0)

    clip: Any = SimpleNamespace(
        at=at, crew=SimpleNamespace(each=lambda clip, piece, rows: [piece(clip, *r) for r in rows])
    )

    def fit(name: str, evidence: float, cost: float) -> Any:
        return SimpleNamespace(hypothesis=name, z=np.zeros(1), evidence=evidence, cost=cost)

    base = fit("base", -250.0, 80.0)
    rows = {
        "leads": fit("leads", -50.0, 80.0),
        "costs less": fit("costs less", -260.0, 60.0),
        "idle": fit("idle", -252.0, 79.0),
    }
    fitted = {(name, -1): (one, 7.0) for name, one in rows.items()}
    again, told = surely(clip, base, fitted)
    assert asked == [("base", True), ("leads", True), ("costs less", True)]
    assert again.evidence == told["leads", -1][0].evidence
    assert told["idle", -1][0] is rows["idle"]
    assert [promise for _, promise in told.values()] == [7.0] * 3
    asked.clear()
    assert surely(clip, base, {("idle", -1): (rows["idle"], 0.0)})[0] is base
    assert not asked


@pytest.mark.parametrize(("likeness", "told"), [(0.99, 1), (0.5, 0)])
def test_numbers_of_an_effect_that_do_each_others_work_are_told(likeness, told):
    drag = term("drag", 0, 10)
    hypothesis = SimpleNamespace(
        ground=1, terms=(drag,), tails=np.array([6.0, np.inf, np.inf]), loose=np.zeros(3, bool)
    )
    across = np.sqrt(1 - likeness**2)
    jacobian = 50 * np.array([[1.0, 0.0, 0.0], [0.0, 1.0, likeness], [0.0, 0.0, across]])
    fit = Fit(hypothesis, np.zeros(3), 0.0, 0.0, jacobian, np.zeros(3), 0.0)  # type: ignore[arg-type]
    sentences = tied(fit)
    assert len(sentences) == told
    assert all(line.startswith("linear and quadratic of drag") for line in sentences)


def test_centroids_are_not_noisier_than_their_own_third_differences():
    clip = clip_of(FLIGHT, frames=20)
    fit_of = started(FLIGHT, clip)[2]
    generator = np.random.default_rng(0)
    measured = fit_of.measured
    away = Parts(*(np.zeros(part.shape) for part in measured.parts))
    # A misfit that alternates is as large as noise could be, but what was measured runs smoothly.
    away.moments[:] = 40.0 * generator.standard_normal(away.moments.shape)
    found, _ = settled(measured, away, Counts(), 2)
    assert (found.moment_noise <= 1.25 * moment_roughness(measured.moments)).all()
    assert (found.moment_noise > 1.2 * moment_roughness(measured.moments)).any()
