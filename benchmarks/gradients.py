"""Derivatives through MJX-JAX beside differences in double precision, scene by scene, and a hunt for NaN.

python -m benchmarks.gradients [--rows sphere-flight,box-slide] [--double] [--json gradients.json]
python -m benchmarks.gradients --hunt 1000 [--reverse]
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import itertools
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gradients_hunt import hunt
from mjx_refine.batch import SceneBatch
from mjx_refine.compile_cache import enable_cache
from mjx_refine.gradients import Differentiator, Verdict, check
from mjx_refine.gradients.check import cosines
from mjx_refine.gradients.tangents import inputs_of, kinked, stencil
from mjx_refine.gradients.views import precise_outlines
from mjx_refine.scene import Body, Camera, Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.mjx import MjxSimulator
from mjx_refine.space import Space

FPS = 30.0
FRAMES = 16
IMAGE = (480, 320)
DIRECTIONS = 16
STEPS = (1e-3, 1e-4, 1e-5)
"""Of the differences [prior widths]; the two that agree best are taken as the truth, by parameter."""

WEAK = 1e-3
"""Errors of a parameter that moves the picture by less than this part of the strongest are measured against that."""

JAG = 1e-3
"""Disagreement of the differences themselves above which a parameter has no derivative to compare with."""

SIZES = {"sphere": (0.2,), "box": (0.25, 0.2, 0.15), "cylinder": (0.2, 0.4)}
TILTED = (0.9, 0.2, 0.1, 0.25)
LYING = (1.0, 1.0, 0.0, 0.0)


def body(shape: str, place, turn=(1.0, 0.0, 0.0, 0.0), velocity=(0, 0, 0), spin=(0, 0, 0), damping=-40.0) -> Body:
    """A body of the benchmark's size; ``turn`` need not be normalised."""
    unit = np.asarray(turn, float) / np.linalg.norm(turn)
    numbers = (tuple(map(float, v)) for v in (place, unit, velocity, spin))
    return Body(shape, f"{shape}_{place[0]}", SIZES[shape], *numbers, friction=(0.4, 0.01), damping=damping)


def rows() -> dict[str, tuple[Body, ...]]:
    """Scenes by name."""
    flying = {"velocity": (1, 0.5, 1), "spin": (1, 3, 0.5)}
    # Turned a little: a box that the camera sees square on has an outline with kinks.
    sliding = {"turn": (1, 0, 0, 0.2), "velocity": (3, 0.5, 0), "spin": (0, 0, 1)}
    falling = {"velocity": (1, 0.2, 0), "spin": (0.5, 2, 0.3), "damping": -20.0}
    found = {}
    for shape, low in (("sphere", 0.2), ("box", 0.15), ("cylinder", 0.2)):
        found[f"{shape}-flight"] = (body(shape, (0, 0, 2), TILTED, **flying),)
        # A hair above the floor. Of a flat box that touches it exactly, rounding says which corners do.
        found[f"{shape}-slide"] = (body(shape, (0, 0, low + 1e-4), **sliding),)
        found[f"{shape}-bounce"] = (body(shape, (0, 0, 0.55), TILTED, **falling),)
    found["sphere-roll"] = (body("sphere", (0, 0, 0.2), velocity=(2, 0, 0), spin=(0, 10, 0)),)
    found["cylinder-roll"] = (body("cylinder", (0, 0, 0.2), LYING, (2, 0, 0), (0, 0, -10)),)
    found["box-slide-touching"] = (body("box", (0, 0, 0.15), **sliding),)
    found["box-square-on"] = (body("box", (0, 0, 0.15), velocity=(3, 0.5, 0), spin=(0, 0, 1)),)
    found["sphere-rest"] = (body("sphere", (0, 0, 0.2)),)
    found["box-rest"] = (body("box", (0, 0, 0.15), (1, 0, 0, 0.2)),)
    found["sphere-chatter"] = (body("sphere", (0, 0, 0.2), velocity=(2, 0, 0), spin=(0, 10, 0), damping=-4.0),)
    found["box-dice"] = (body("box", (0, 0, 1), TILTED, (1, 0, 0), (3, 7, 2), -4.0),)
    for first, second in (("sphere", "sphere"), ("sphere", "box"), ("box", "cylinder")):
        found[f"{first}-{second}-collision"] = (
            body(first, (-0.7, 0.03, 1.55), (1, 0.1, 0.2, 0.1), (3, 0, 0.5), (0.5, 0.3, 0)),
            body(second, (0.0, -0.02, 1.5), (1, 0.15, -0.1, 0.3), (0, 0, 0.4), (0, 0, 0.5)),
        )
    return found


class DoubleMjx(MjxSimulator):
    """MJX-JAX in double precision, its solver run to the end: the reference that shares its equations."""

    def __init__(self, shapes, fps: float):
        with jax.enable_x64(True):
            super().__init__(shapes, fps, iterations=50, ls_iterations=50)

            def widen(leaf):
                return leaf.astype(jnp.float64) if getattr(leaf, "dtype", None) == jnp.float32 else leaf

            self._model, self._data = jax.tree.map(widen, (self._model, self._data))
            self._model = self._model.tree_replace({"opt.tolerance": jnp.asarray(1e-13)})
        self._double = jax.jit(jax.vmap(functools.partial(self.trajectory, frames=FRAMES)))

    def rollout(self, batch: SceneBatch, frames: int) -> np.ndarray:
        """Poses in double precision."""
        full = inputs_of(batch[np.minimum(np.arange(-(-len(batch) // 64) * 64), len(batch) - 1)])
        parts = []
        with jax.enable_x64(True):
            for first in range(0, len(full.qpos), 64):
                part = jax.tree.map(lambda a, first=first: jnp.asarray(a[first : first + 64]), full)
                parts.append(np.asarray(self._double(part.leaves, part.qpos, part.qvel)))
        return np.concatenate(parts)[: len(batch), :frames]


@functools.cache
def reference(shapes) -> MujocoSimulator:
    """C MuJoCo whose solver goes on to the last digit."""
    made = MujocoSimulator(shapes, FPS, threads=1)
    made.model.opt.tolerance = 1e-14
    return made


@functools.cache
def simulator(shapes) -> MjxSimulator:
    """One a scene kind, with its compiled programs."""
    return MjxSimulator(shapes, FPS)


@functools.cache
def double(shapes) -> DoubleMjx:
    """Ditto in double precision."""
    return DoubleMjx(shapes, FPS)


def features(space: Space, batch: SceneBatch, poses: np.ndarray) -> np.ndarray:
    """Poses and outlines side by side, outlines in units of 100 px, (B, T, N, 7 + directions)."""
    camera = (batch.camera_position, batch.camera_pitch, batch.camera_fovy)
    reach = precise_outlines(space.scene.shapes, (poses, batch.size, *camera), IMAGE, DIRECTIONS)
    return np.concatenate([poses, reach / 100.0], -1)


def by_differences(space: Space, rollout: Callable, steps=STEPS) -> tuple[np.ndarray, np.ndarray]:
    """(derivatives a prior width (D, T, N, features), how far the two steps that agree best are apart (D,))."""
    point, found = space.start, []
    for step in steps:
        points, weights = stencil(point, step * space.sigma)
        batch = space.decode(np.concatenate([point[None], points.reshape(-1, len(point))]))
        seen = features(space, batch, rollout(batch, FRAMES))
        moved = seen[1:].reshape(len(point), 2, *seen.shape[1:]) - seen[0]
        found.append(np.einsum("dk,dk...->d...", weights[:, 1:], moved) * space.sigma[:, None, None, None])
    apart = np.stack([errors(a, b) for a, b in itertools.pairwise(found)])
    best = apart.argmin(0)
    return np.stack([found[k + 1][j] for j, k in enumerate(best)]), apart.min(0)


def errors(one: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Relative error of every parameter's derivative."""
    one, truth = one.reshape(len(one), -1), truth.reshape(len(truth), -1)
    size = np.linalg.norm(truth, axis=1)
    return np.linalg.norm(one - truth, axis=1) / np.maximum(size, WEAK * size.max())


@dataclasses.dataclass(frozen=True)
class Row:
    """What was measured of one scene."""

    name: str
    parameters: int
    worst: float
    worst_name: str
    total: float
    worst_double: float
    cosine: float
    method: str
    jagged: tuple[str, ...]
    kinks: tuple[str, ...]
    milliseconds: float
    differences_ms: float
    reason: str


def measure(name: str, bodies: tuple[Body, ...], with_double: bool) -> Row:
    """One row of the table."""
    space = Space.around(Scene(bodies, Camera((0.0, -3.0, 3.0), 45.0)))
    derivatives, exact = Differentiator(space, simulator(space.scene.shapes)), reference(space.scene.shapes)
    point, scale = space.start, space.sigma[:, None, None, None]
    derivatives.outlines(point, FRAMES, IMAGE, DIRECTIONS)
    derivatives._last = None
    start = time.perf_counter()
    reach = derivatives.outlines(point, FRAMES, IMAGE, DIRECTIONS)[1]
    spent = time.perf_counter() - start
    columns = np.concatenate([derivatives.poses(point, FRAMES)[1], reach / 100.0], -1) * scale
    truth, apart = by_differences(space, exact.rollout)
    start = time.perf_counter()
    verdict: Verdict = check(space, point, FRAMES, IMAGE, autodiff=derivatives)
    checked = time.perf_counter() - start
    kinks = kinked(space, point)
    smooth = (apart <= JAG) & ~kinks
    error = np.where(smooth, errors(columns, truth), 0.0)
    in_double = np.nan
    if with_double:
        own, own_apart = by_differences(space, double(space.scene.shapes).rollout)
        in_double = float(np.where((own_apart <= JAG) & ~kinks, errors(columns, own), 0.0).max())
    worst = int(error.argmax())
    return Row(
        name=name,
        parameters=space.dimension,
        worst=float(error[worst]),
        worst_name=space.names[worst],
        total=float(np.linalg.norm((columns - truth)[smooth]) / np.linalg.norm(truth[smooth])),
        worst_double=in_double,
        cosine=float(np.sort(cosines(columns[~kinks], truth[~kinks]))[2]),
        method=verdict.method,
        jagged=tuple(np.array(space.names)[(apart > JAG) & ~kinks].tolist()),
        kinks=tuple(np.array(space.names)[kinks].tolist()),
        milliseconds=1e3 * spent,
        differences_ms=1e3 * checked,
        reason=verdict.reason,
    )


def machine() -> str:
    """What this runs on."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    chip = names[0] if names else platform.processor()
    return f"{chip}, {os.cpu_count()} cores, JAX on {jax.devices()[0].device_kind}, Python {platform.python_version()}"


def table(chosen: list[str] | None, with_double: bool) -> list[Row]:
    """Measures and prints every row."""
    print(machine())
    print(
        "errors: of the worst parameter with a smooth derivative (C MuJoCo; MJX in double precision), of all together"
    )
    print("cosine: the least over frames, the two worst frames aside (those of the event)")
    heading = f"{'scene':26}{'par':>4}{'worst':>9}{'(MJX)':>9}{'all':>9}{'cosine':>8}{'ms':>7}{'check ms':>9}"
    print(f"{heading}  {'check':12} worst parameter; without a derivative", flush=True)
    found = []
    for name, bodies in rows().items():
        if chosen and name not in chosen:
            continue
        row = measure(name, bodies, with_double)
        found.append(row)
        rough = ", ".join((*row.jagged, *(f"{kink} (kink)" for kink in row.kinks)))
        numbers = f"{row.worst:9.1e}{row.worst_double:9.1e}{row.total:9.1e}{row.cosine:8.4f}"
        times = f"{row.milliseconds:7.0f}{row.differences_ms:9.0f}"
        print(
            f"{row.name:26}{row.parameters:4d}{numbers}{times}  {row.method:12} {row.worst_name}; {rough}", flush=True
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", help="names, separated by commas; all by default")
    parser.add_argument("--double", action="store_true", help="also against MJX in double precision")
    parser.add_argument("--hunt", type=int, metavar="SCENES", help="only count NaN over so many random scenes")
    parser.add_argument("--reverse", action="store_true", help="hunt in reverse mode too")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    arguments = parser.parse_args()
    enable_cache()
    if arguments.hunt:
        print(machine())
        raise SystemExit(hunt(arguments.hunt, arguments.reverse))
    found = table(arguments.rows.split(",") if arguments.rows else None, arguments.double)
    if arguments.json:
        report = {"machine": machine(), "rows": [dataclasses.asdict(row) for row in found]}
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
