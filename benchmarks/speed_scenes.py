"""Scene kinds, clips and figures for the speed benchmark."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mjx_refine.observation import save_observation
from mjx_refine.scene import Body, Camera, Scene, save_scenes
from mjx_refine.simulate import simulate
from mjx_refine.space import Space

CAMERA = Camera((0.0, -3.2, 2.2), 58.0, 45.0)
_TURNED = (0.966, 0.0, 0.0, 0.2588)
_DULL = {"friction": (0.3, 0.01), "damping": -30.0}
_BALL = Body("sphere", "ball", (0.2,), (-0.9, 0.2, 0.6), linear_velocity=(1.6, 0.2, 0.8), damping=-20.0)
_CRATE = Body(
    "box",
    "crate",
    (0.25, 0.18, 0.15),
    (-0.5, 0.6, 0.15),
    _TURNED,
    (1.8, -0.2, 0.0),
    friction=(0.3, 0.01),
    damping=-30.0,
)
_DRUM = Body("cylinder", "drum", (0.18, 0.4), (0.5, 0.5, 0.2), linear_velocity=(-0.6, 0.1, 0.0), **_DULL)
_BRICK = Body("box", "brick", (0.15, 0.15, 0.12), (0.1, -0.3, 0.5), linear_velocity=(0.3, 0.6, 0.0), **_DULL)
KINDS = {
    "sphere": Scene((_BALL,), CAMERA),
    "box+cylinder": Scene((_CRATE, _DRUM), CAMERA),
    "four mixed": Scene((_BALL, _CRATE, _DRUM, _BRICK), CAMERA),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Times:
    """How long something took, several times over [s]."""

    seconds: tuple[float, ...]

    @property
    def median(self) -> float:
        return float(np.median(self.seconds))

    def __str__(self) -> str:
        """Median and quartiles [ms]."""
        low, middle, high = (1e3 * q for q in np.quantile(self.seconds, (0.25, 0.5, 0.75)))
        return f"{middle:.1f} [{low:.1f}, {high:.1f}]"


def timed(function: Callable[[], object]) -> float:
    """Seconds that a call takes."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def times(function: Callable[[], object], count: int) -> Times:
    """``count`` calls."""
    return Times(tuple(timed(function) for _ in range(count)))


def near(scene: Scene, seed: int, scale: float = 0.4) -> Scene:
    """A scene some prior widths away."""
    space = Space.around(scene)
    step = scale * space.sigma * np.random.default_rng(seed).normal(size=space.dimension)
    return space.scene_at(np.clip(space.start + step, 0, 1))


def make_clip(folder: Path, kind: str, seed: int, size: tuple[int, int], frames: int) -> Path:
    """A folder with ``flows.npz`` of a scene of the kind and ``best32.yaml`` with four samples near it."""
    folder.mkdir(parents=True)
    truth = near(KINDS[kind], seed, 0.1)
    save_observation(folder / "flows.npz", simulate(truth, size=size, frames=frames))
    save_scenes(folder / "best32.yaml", [near(truth, 1000 * seed + k) for k in range(4)])
    return folder
