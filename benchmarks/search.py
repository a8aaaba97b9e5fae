"""The population search against its peers, at population 128 and 100 generations.

    python benchmarks/search.py [--seeds 10] [--first-seed 0] [--quick]

Every optimiser gets the same start, the same initial standard deviation (1/6) and the same 128 x 100 evaluations
inside the unit box; its figure is the lowest cost evaluated, the start included. Printed: medians over seeds; the ratio
of ours to the better peer; "no worse" where ours is at most the better peer's median, costs below 1e-12 counting as 0.

Peers: pycma (`cma`, bounds [0, 1] by its default handling, its tolerances switched off) and evosax CMA_ES, which knows no
bounds: its points are clipped for evaluation and either told as drawn ("evosax") or told clipped ("evosax/clip").
The problems are deterministic in (kind, dimension, seed). Our defaults were tuned on seeds 1000 and above.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

# One thread: matrices are small, and the machine may be shared. To be set before numpy loads.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "cmaes"))

import numpy as np  # noqa: E402
from mjx_cmaes import Settings, ask, init, inject, tell  # noqa: E402

POPULATION = 128
GENERATIONS = 100
STD = 1 / 6
SOLVED = 1e-12
KINDS = ("sphere", "ellipsoid", "rotated ellipsoid", "Rosenbrock", "plateau")
PLACES = ("inside", "on bounds")

Function = Callable[[np.ndarray], np.ndarray]


def problem(kind: str, place: str, dimension: int, seed: int) -> tuple[Function, np.ndarray]:
    """A cost (points (k, n) to costs (k,)) with minimum 0 in the box, and a start.

    The optimum is drawn from [0.2, 0.8]^n; "on bounds" puts a quarter of its coordinates, at random, at 0 or 1.
    The start is anywhere in the box.
    """
    generator = np.random.default_rng([seed, dimension])
    optimum = generator.uniform(0.2, 0.8, dimension)
    start = generator.uniform(0.0, 1.0, dimension)
    if place == "on bounds":
        chosen = generator.permutation(dimension)[: dimension // 4]
        optimum[chosen] = generator.integers(0, 2, len(chosen))
    rotation = np.linalg.qr(generator.standard_normal((dimension, dimension)))[0]
    stiffness = 10.0 ** (6 * np.arange(dimension) / max(dimension - 1, 1))  # condition 1e6

    def rosenbrock(x: np.ndarray) -> np.ndarray:
        z = 4 * (x - optimum) + 1
        return (100 * (z[:, 1:] - z[:, :-1] ** 2) ** 2 + (1 - z[:, :-1]) ** 2).sum(axis=1)

    functions: dict[str, Function] = {
        "sphere": lambda x: ((x - optimum) ** 2).sum(axis=1),
        "ellipsoid": lambda x: (x - optimum) ** 2 @ stiffness,
        "rotated ellipsoid": lambda x: ((x - optimum) @ rotation.T) ** 2 @ stiffness,
        "Rosenbrock": rosenbrock,
        # 256 levels a coordinate, then rounded together: whole regions tie, and late generations nearly all do.
        "plateau": lambda x: np.floor(np.floor(256 * np.abs(x - optimum)).mean(axis=1) * 4) / 4,
    }
    return functions[kind], start


def run_ours(function: Function, start: np.ndarray, seed: int) -> float:
    """Our search with its defaults; the start replaces a point of the first generation."""
    settings = Settings(len(start), population=POPULATION, tolerance_x=0.0, tolerance_cost=0.0)
    state = init(settings, start, STD, seed=seed)
    for generation in range(GENERATIONS):
        points, state = ask(settings, state)
        if generation == 0:
            points = inject(points, start[None])
        state, _ = tell(settings, state, points, function(points))
    return state.best_cost


def run_pycma(function: Function, start: np.ndarray, seed: int) -> float:
    """pycma with bounds; its generator wants a seed above 0."""
    import cma

    options = {
        "bounds": [0, 1],
        "popsize": POPULATION,
        "seed": seed + 1,
        "verbose": -9,
        "tolfun": 0,
        "tolx": 0,
        "tolfunhist": 0,
    }
    strategy = cma.CMAEvolutionStrategy(start, STD, options)
    best = float(function(start[None])[0])
    for _ in range(GENERATIONS):
        points = strategy.ask()
        costs = function(np.array(points))
        best = min(best, float(costs.min()))
        strategy.tell(points, costs.tolist())
    return best


def run_evosax(function: Function, start: np.ndarray, seed: int, told_clipped: bool) -> float:
    """evosax CMA_ES; costs are taken in float64 at the clipped points, the strategy itself runs in float32."""
    import jax
    import jax.numpy as jnp

    strategy, parameters = _evosax(len(start))
    key, first = jax.random.split(jax.random.key(seed))
    state = strategy.init(first, jnp.asarray(start, jnp.float32), parameters)
    best = float(function(start[None])[0])
    for _ in range(GENERATIONS):
        key, for_ask, for_tell = jax.random.split(key, 3)
        points, state = strategy.ask(for_ask, state, parameters)
        clipped = np.clip(np.asarray(points, dtype=np.float64), 0.0, 1.0)
        costs = function(clipped)
        best = min(best, float(np.nanmin(costs)))
        told = jnp.asarray(clipped, jnp.float32) if told_clipped else points
        state, _ = strategy.tell(for_tell, told, jnp.asarray(costs, jnp.float32), state, parameters)
    return best


_STRATEGIES: dict = {}


def _evosax(dimension: int) -> tuple:
    """One compiled strategy a dimension."""
    if dimension not in _STRATEGIES:
        import jax.numpy as jnp
        from evosax.algorithms import CMA_ES

        strategy = CMA_ES(population_size=POPULATION, solution=jnp.zeros(dimension))
        _STRATEGIES[dimension] = strategy, strategy.default_params.replace(std_init=STD)
    return _STRATEGIES[dimension]


RUNNERS: dict[str, Callable[[Function, np.ndarray, int], float]] = {
    "ours": run_ours,
    "pycma": run_pycma,
    "evosax": lambda function, start, seed: run_evosax(function, start, seed, told_clipped=False),
    "evosax/clip": lambda function, start, seed: run_evosax(function, start, seed, told_clipped=True),
}


def time_update(dimension: int = 84, generations: int = 200) -> tuple[float, float, float]:
    """Ask plus tell on the sphere, evaluation left out, ms: median wall, 95th percentile wall, mean processor time.

    On a busy machine wall time tells of the neighbours, processor time of the update.
    """
    function, start = problem("sphere", "inside", dimension, 0)
    settings = Settings(dimension, population=POPULATION)
    state = init(settings, start, STD)
    wall, processor = [], 0.0
    for _ in range(generations):
        begin, used = time.perf_counter(), time.process_time()
        points, state = ask(settings, state)
        elapsed, spent = time.perf_counter() - begin, time.process_time() - used
        costs = function(points)
        begin, used = time.perf_counter(), time.process_time()
        state, _ = tell(settings, state, points, costs)
        wall.append(1e3 * (elapsed + time.perf_counter() - begin))
        processor += 1e3 * (spent + time.process_time() - used)
    return float(np.median(wall)), float(np.percentile(wall, 95)), processor / generations


def machine() -> str:
    """Processor, cores and versions."""
    model = platform.processor() or platform.machine()
    listing = Path("/proc/cpuinfo")
    if listing.exists():
        names = [line.split(":", 1)[1].strip() for line in listing.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "cma", "evosax", "jax"))
    return f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}, {packages}; CPU only, 1 BLAS thread"


def ratio(ours: float, peer: float) -> float:
    """Ours over the peer's, costs below SOLVED counting as SOLVED."""
    return max(ours, SOLVED) / max(peer, SOLVED)


def main() -> int:
    """Prints the table; 0 where ours is no worse on every row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="seeds a row (default 10)")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="three seeds, 20 and 84 dimensions")
    arguments = parser.parse_args()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    warnings.filterwarnings("ignore", module="cma")
    count = 3 if arguments.quick else arguments.seeds
    dimensions = (20, 84) if arguments.quick else (20, 40, 84)
    seeds = range(arguments.first_seed, arguments.first_seed + count)

    print(machine())
    print(
        f"population {POPULATION}, {GENERATIONS} generations, std {STD:.4f}, medians of {count} seeds from {seeds[0]}\n"
    )
    print(
        f"{'problem':18s}{'optimum':11s}{'n':>3s}" + "".join(f"{name:>13s}" for name in RUNNERS) + "   ratio  no worse"
    )
    passed = True
    for kind in KINDS:
        for place in PLACES:
            for dimension in dimensions:
                medians = {}
                for name, runner in RUNNERS.items():
                    costs = [runner(*problem(kind, place, dimension, seed), seed) for seed in seeds]
                    medians[name] = float(np.median(costs))
                best = min(value for name, value in medians.items() if name != "ours")
                share = ratio(medians["ours"], best)
                passed &= share <= 1
                figures = "".join(f"{medians[name]:13.3g}" for name in RUNNERS)
                verdict = "pass" if share <= 1 else "FAIL"
                print(f"{kind:18s}{place:11s}{dimension:3d}{figures}{share:8.1g}  {verdict}", flush=True)
    median, high, processor = time_update()
    print(
        f"\nask + tell at n = 84: wall median {median:.2f} ms, 95th percentile {high:.2f} ms; processor {processor:.2f} ms"
    )
    return 0 if passed else 1


if __name__ == "__main__":
    raise SystemExit(main())
