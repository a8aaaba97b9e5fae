"""Solvers of one stage's least squares that come from elsewhere: optax's Adam, jaxopt's Gauss-Newton and
Levenberg-Marquardt.

The only file that imports either package; whoever replaces one changes this file alone. Unknowns are prior widths from
the start, u = (point - start) / sigma, so that the prior is u itself and one step length suits all. Residuals and
Jacobian are numpy's, from rollouts by C MuJoCo: jaxopt sees them as a JAX function through ``pure_callback``, with the
Jacobian as its ``custom_jvp`` (linear in the tangent, hence transposable). Neither solver knows bounds: points are
projected onto the box, and coordinates that push out of it are held (Bertsekas 1982, projected Newton).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import warnings
from collections import OrderedDict
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", message="JAXopt is no longer maintained", category=DeprecationWarning)
    import jaxopt

KEPT = 8
"""Points whose residuals and Jacobian are remembered: a solver asks for the same ones many times."""

STEPS = {"adam": 10, "gauss-newton": 2, "levenberg-marquardt": 3}
"""Steps for one iteration of our own solver, which tries six step lengths and takes one Jacobian. Adam's are short;
jaxopt's Levenberg-Marquardt spends some on steps that it rejects."""

PEAK = 0.15
"""Adam's greatest step [prior widths]."""

WARM_UP = 0.1
"""Part of Adam's steps in which its step grows to the greatest."""

DAMPING = 1e-3
"""First damping of jaxopt's Levenberg-Marquardt, a multiple of the greatest curvature (Madsen & Nielsen 2010, 6.18)."""

HALVINGS = 8
"""Lengths of a Gauss-Newton step that are tried: 1, 1/2, 1/4..."""

SHORTEST = 1e-3
"""Steps [prior widths] below which a solver has arrived."""

DIVERGED = 1e4
"""Every residual of a candidate that diverges [noise widths]."""


@dataclasses.dataclass
class _Evaluated:
    """What is known of one point; ``base`` are the residuals without the prior."""

    base: np.ndarray
    cost: float
    jacobian: np.ndarray | None = None


class StageProblem:
    """The least squares of one stage, every point evaluated once.

    Args:
      residuals: of one point in the unit box, (R,), and its cost, half their sum of squares with the prior's.
      jacobian: of a point and its residuals, per prior width, (R, D).
      start: the prior's mean, unit box.
      sigma: its widths.
      size: length to which residuals are padded with zeros, so that all stages share one compiled program.
    """

    def __init__(
        self,
        residuals: Callable[[np.ndarray], tuple[np.ndarray, float]],
        jacobian: Callable[[np.ndarray, np.ndarray], np.ndarray],
        start: Float[np.ndarray, "dimension"],
        sigma: Float[np.ndarray, "dimension"],
        size: int,
    ):
        self._residuals, self._jacobian = residuals, jacobian
        self.start, self.sigma, self.size = start, sigma, size
        self._known: OrderedDict[bytes, _Evaluated] = OrderedDict()
        self.ceiling = np.inf
        """Cost above which a solver throws the Jacobian away, so that none is computed."""

    @property
    def dimension(self) -> int:
        return len(self.start)

    def inside(self, u: np.ndarray) -> np.ndarray:
        """The nearest point of the box."""
        return (np.clip(self.point(u), 0.0, 1.0) - self.start) / self.sigma

    def point(self, u: np.ndarray) -> np.ndarray:
        """In the unit box, where ``u`` is inside."""
        return self.start + np.asarray(u, np.float64) * self.sigma

    def at(self, u: np.ndarray) -> _Evaluated:
        """Residuals and cost of the nearest point of the box."""
        point = np.clip(self.point(u), 0.0, 1.0)
        key = point.tobytes()
        if key not in self._known:
            self._known[key] = _Evaluated(*self._residuals(point))
            while len(self._known) > KEPT:
                self._known.popitem(last=False)
        self._known.move_to_end(key)
        return self._known[key]

    def knows(self, u: np.ndarray) -> bool:
        """Whether ``values`` and ``slopes`` can be told without a rollout."""
        known = self._known.get(np.clip(self.point(u), 0.0, 1.0).tobytes())
        return known is not None and (known.jacobian is not None or self._beyond(known.cost))

    def _beyond(self, cost: float) -> bool:
        return cost > self.ceiling * (1 + 1e-9)

    def jacobian(self, u: np.ndarray) -> Float[np.ndarray, "residuals dimension"]:
        """d residuals / d u, without the prior."""
        known = self.at(u)
        if known.jacobian is None:
            known.jacobian = self._jacobian(np.clip(self.point(u), 0.0, 1.0), known.base)
        return known.jacobian

    def values(self, u: np.ndarray) -> Float[np.ndarray, "size"]:
        """Residuals, padded, and the prior's."""
        known = self.at(u)
        values = np.zeros(self.size + self.dimension)
        values[: len(known.base)] = known.base if np.isfinite(known.cost) else DIVERGED
        values[self.size :] = self.inside(u)
        return values

    def slopes(self, u: np.ndarray) -> Float[np.ndarray, "size dimension"]:
        """d values / d u; zero for coordinates at a bound that push outwards, and for points beyond the ceiling."""
        slopes = np.zeros((self.size + self.dimension, self.dimension))
        if self._beyond(self.at(u).cost):
            return slopes
        jacobian = self.jacobian(u)
        slopes[: len(jacobian)] = jacobian
        slopes[self.size :] = np.eye(self.dimension)
        gradient = slopes.T @ self.values(u)
        point = np.clip(self.point(u), 0.0, 1.0)
        slopes[:, ((point <= 0.0) & (gradient > 0)) | ((point >= 1.0) & (gradient < 0))] = 0.0
        return slopes

    def gradient(self, u: np.ndarray) -> Float[np.ndarray, "dimension"]:
        """Of the cost; zero for held coordinates."""
        return self.slopes(u).T @ self.values(u)


def improve(
    name: str, problem: StageProblem, point: np.ndarray, iterations: int, spent: Callable[[], bool]
) -> tuple[np.ndarray, float, np.ndarray]:
    """Steps of a solver from ``point``; the best point that it visits.

    Args:
      name: ``adam``, ``gauss-newton`` or ``levenberg-marquardt``.
      problem: of the stage.
      point: in the unit box.
      iterations: of our own solver; ``STEPS`` times as many are taken at most.
      spent: whether one more step, a few residuals and a Jacobian, is too much.

    Returns:
      (point in the unit box, cost, Jacobian per prior width without the prior; empty where nothing was left for one).
    """
    u = problem.inside((point - problem.start) / problem.sigma)
    best, cost = u, problem.at(u).cost
    if spent():
        return np.clip(point, 0.0, 1.0), cost, np.zeros((0, problem.dimension))
    jacobian = problem.jacobian(u)
    steps = STEPS[name] * iterations
    solver = _SOLVERS[name](problem, u, steps)
    for _ in range(steps):
        if spent() or np.abs(problem.gradient(u)).max(initial=0.0) < 1e-9:
            break
        u, length = solver.step(u)
        here = problem.at(u).cost
        known = problem.jacobian(u)
        if here < cost:
            best, cost, jacobian = u, here, known
        if length < SHORTEST:
            break
    return np.clip(problem.point(best), 0.0, 1.0), cost, jacobian


# Adam -----------------------------------------------------------------------------------------------------------------


class _Adam:
    """Kingma & Ba 2015, with a step that warms up linearly and decays as a cosine (Loshchilov & Hutter 2017)."""

    def __init__(self, problem: StageProblem, u: np.ndarray, steps: int):
        self.problem = problem
        warm = max(1, round(WARM_UP * steps))
        schedule = optax.warmup_cosine_decay_schedule(0.2 * PEAK, PEAK, warm, max(steps, warm + 1), 0.01 * PEAK)
        self.adam = optax.adam(schedule, b1=0.9, b2=0.95)
        self.state = self.adam.init(jnp.asarray(u, jnp.float32))

    def step(self, u: np.ndarray) -> tuple[np.ndarray, float]:
        """The next point, and how far a step may still go."""
        gradient = jnp.asarray(self.problem.gradient(u), jnp.float32)
        update, self.state = self.adam.update(gradient, self.state)
        return self.problem.inside(u + np.asarray(update)), np.inf


# jaxopt ---------------------------------------------------------------------------------------------------------------


class _Open:
    """A problem that a compiled program is working on, and the points at which it could not answer yet."""

    def __init__(self, problem: StageProblem):
        self.problem = problem
        self.asked: list[np.ndarray] = []

    def values(self, u: np.ndarray) -> np.ndarray:
        return self.problem.values(u) if self._knows(u) else np.zeros(self.problem.size + self.problem.dimension)

    def slopes(self, u: np.ndarray) -> np.ndarray:
        shape = (self.problem.size + self.problem.dimension, self.problem.dimension)
        return self.problem.slopes(u) if self._knows(u) else np.zeros(shape)

    def _knows(self, u: np.ndarray) -> bool:
        if not self.problem.knows(u):
            self.asked.append(u)
            return False
        return True


_OPEN: dict[int, _Open] = {}
"""What compiled programs work on; they name it by number, and so outlive each."""

_NUMBERS = itertools.count()


def _bits(values: np.ndarray) -> np.ndarray:
    """Doubles as pairs of words."""
    return np.ascontiguousarray(values, np.float64).view(np.uint32).reshape(*values.shape, 2)


@functools.lru_cache(maxsize=64)
def _bridge(size: int, dimension: int) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """``values`` of an open problem as a function of (u, its number) that JAX can differentiate in both modes."""

    def values(u, number) -> np.ndarray:
        return _bits(_OPEN[int(number)].values(np.array(u).view(np.float64)[:, 0]))

    def slopes(u, number) -> np.ndarray:
        return _bits(_OPEN[int(number)].slopes(np.array(u).view(np.float64)[:, 0]))

    def called(function: Callable, u: jax.Array, number: jax.Array, *shape: int) -> jax.Array:
        # A callback's thread has JAX's default precision, which would round what goes through it: bits go instead.
        bits = jax.lax.bitcast_convert_type(u, jnp.uint32)
        result = jax.ShapeDtypeStruct((*shape, 2), np.uint32)
        answer = jax.pure_callback(function, result, bits, number, vmap_method="sequential")
        return jax.lax.bitcast_convert_type(answer, jnp.float64)

    @jax.custom_jvp
    def residuals(u, number):
        return called(values, u, number, size + dimension)

    @residuals.defjvp
    def _(primals, tangents):
        return residuals(*primals), called(slopes, *primals, size + dimension, dimension) @ tangents[0]

    return residuals


@functools.lru_cache(maxsize=64)
def _compiled(name: str, size: int, dimension: int) -> tuple[Callable, Callable]:
    """(first state, update) of a solver, compiled once a size."""
    residuals = _bridge(size, dimension)
    solver = (
        jaxopt.GaussNewton(residual_fun=residuals)
        if name == "gauss-newton"
        else jaxopt.LevenbergMarquardt(
            residual_fun=residuals, damping_parameter=DAMPING, materialize_jac=True, solver="cholesky"
        )
    )
    return jax.jit(solver.init_state), jax.jit(solver.update)


class _Jaxopt:
    """A solver of jaxopt's, one ``update`` a step, points projected onto the box after each."""

    name: str

    def __init__(self, problem: StageProblem, u: np.ndarray, steps: int):
        self.problem = problem
        with jax.enable_x64(True):
            begin, self.update = _compiled(self.name, problem.size, problem.dimension)
        state = self._called(begin, u)
        # One type for the whole loop, hence one program.
        self.state = jax.tree.map(np.asarray, state)
        if hasattr(state, "increase_factor"):
            self.state = self.state._replace(increase_factor=np.float64(state.increase_factor))

    def _called(self, function: Callable, u: np.ndarray, *rest):
        """Calls a compiled program until it asks for nothing unknown.

        Rollouts and outlines use JAX, which must not be entered from a program's callback (it may wait for ever). A point
        that the program asks for is therefore noted, evaluated after the program has ended, and the program repeated.
        """
        unknown = [u]
        number = next(_NUMBERS)
        while True:
            for asked in unknown:
                self.problem.slopes(asked)
            _OPEN[number] = work = _Open(self.problem)
            try:
                with jax.enable_x64(True):
                    result = jax.block_until_ready(function(u, *rest, np.int32(number)))
            finally:
                del _OPEN[number]
            if not work.asked:
                return result
            unknown = work.asked

    def step(self, u: np.ndarray) -> tuple[np.ndarray, float]:
        """The next point, which is the old one where the step was rejected, and how long a step was tried."""
        moved, state = self._called(self.update, u, self.state)
        self.state = jax.tree.map(np.asarray, state)
        return self.problem.inside(np.asarray(moved)), float(np.abs(self.state.delta).max(initial=0.0))


class _GaussNewton(_Jaxopt):
    """jaxopt's takes whole steps, right or wrong; from as far away as here they must be halved until the cost falls."""

    name = "gauss-newton"

    def step(self, u: np.ndarray) -> tuple[np.ndarray, float]:
        whole, _ = super().step(u)
        for halvings in range(HALVINGS):
            step = (whole - u) * 0.5**halvings
            if self.problem.at(u + step).cost < self.problem.at(u).cost:
                return self.problem.inside(u + step), float(np.abs(step).max(initial=0.0))
        return u, 0.0


class _LevenbergMarquardt(_Jaxopt):
    """Madsen & Nielsen 2010, algorithm 6.18. jaxopt linearises at rejected points too and throws that away: the ceiling
    keeps it from costing rollouts."""

    name = "levenberg-marquardt"

    def __init__(self, problem: StageProblem, u: np.ndarray, steps: int):
        problem.ceiling = problem.at(u).cost
        super().__init__(problem, u, steps)

    def step(self, u: np.ndarray) -> tuple[np.ndarray, float]:
        self.problem.ceiling = self.problem.at(u).cost
        return super().step(u)


_SOLVERS = {"adam": _Adam, "gauss-newton": _GaussNewton, "levenberg-marquardt": _LevenbergMarquardt}
