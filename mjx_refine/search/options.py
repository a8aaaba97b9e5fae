"""The choices of a refinement."""

from __future__ import annotations

import dataclasses

from mjx_fitness import Weights

from mjx_refine.errors import InputError

OPTIMIZERS = ("hybrid", "cmaes", "gradient")

DERIVATIVES = ("auto", "differences", "autodiff")

SEARCH_WIDTH = 160
"""Samples across a picture during the search, by default."""

FINER = 2
"""Times as many samples across and down a picture in the last part of the search."""

SOLVERS = ("lm", "adam", "gauss-newton", "levenberg-marquardt")


@dataclasses.dataclass(frozen=True)
class Options:
    """How to refine.

    Attributes:
      seed: of everything random.
      population: candidates a generation.
      iterations: generations; population * iterations is the budget of rollouts, whatever the optimiser spends them on.
      optimizer: ``cmaes`` searches from the best sample; ``gradient`` is least squares alone (Levenberg-Marquardt on
        outlines); ``hybrid`` lands with least squares and searches from there with the rest.
      solver: of each stage of least squares: ``lm``, our own Levenberg-Marquardt, which tries several step lengths at
        once; ``adam`` (optax); ``gauss-newton`` and ``levenberg-marquardt`` (jaxopt).
      derivatives: of least squares: ``differences`` of rollouts in C MuJoCo; ``autodiff`` through MJX-JAX, where a check
        finds that they hold; ``auto``: differences, far cheaper on a CPU.
      backend: ``mujoco`` (C, all cores), ``mjx``, ``warp``, or ``auto`` for the fastest here.
      resolution: (width, height) at which the search compares pictures; None: about 160 wide. Reported scores are
        always at full resolution.
      weights: of the fitness.
      starts: samples from which least squares lands, at most.
      refits: fits around the solution that tell the parameters' intervals; 0: none.
      threads: of C MuJoCo; None: all cores.
    """

    seed: int = 0
    population: int = 128
    iterations: int = 100
    optimizer: str = "hybrid"
    solver: str = "lm"
    derivatives: str = "auto"
    backend: str = "auto"
    resolution: tuple[int, int] | None = None
    weights: Weights = dataclasses.field(default_factory=Weights)
    starts: int = 3
    refits: int = 6
    threads: int | None = None

    def __post_init__(self):
        if self.optimizer not in OPTIMIZERS:
            raise InputError(f"optimizer = {self.optimizer!r}; expected one of {', '.join(OPTIMIZERS)}")
        if self.solver not in SOLVERS:
            raise InputError(f"solver = {self.solver!r}; expected one of {', '.join(SOLVERS)}")
        if self.derivatives not in DERIVATIVES:
            raise InputError(f"derivatives = {self.derivatives!r}; expected one of {', '.join(DERIVATIVES)}")
        for name, low, high in (
            ("population", 4, 65536),
            ("iterations", 1, 10**6),
            ("starts", 1, 64),
            ("refits", 0, 1000),
            ("seed", 0, 2**32 - 1),
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise InputError(f"{name} = {value!r}; expected a whole number, {low} <= {name} <= {high}")
        if not isinstance(self.weights, Weights):
            raise InputError(f"weights = {self.weights!r}; expected mjx_fitness.Weights")
        if self.resolution is not None and (len(self.resolution) != 2 or min(self.resolution) < 8):
            raise InputError(f"resolution = {self.resolution!r}; expected (width, height) of at least 8 x 8")

    @property
    def budget(self) -> int:
        """Rollouts in all."""
        return self.population * self.iterations


def search_resolution(options: Options, size: tuple[int, int], fine: bool = False) -> tuple[int, int]:
    """(width, height) of the samples at which a search compares pictures of ``size``; ``fine``: in its last part."""
    width, height = size
    wanted = options.resolution or (SEARCH_WIDTH, round(SEARCH_WIDTH * height / width))
    times = FINER if fine else 1
    return min(width, times * wanted[0]), min(height, times * max(wanted[1], 8))
