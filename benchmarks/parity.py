"""How far a backend's rollouts are from C MuJoCo's, row by row, beside C's own spread under a tiny perturbation.

python -m benchmarks.parity --backend mjx [--count 16] [--rows slide,box-box] [--json parity.json]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import platform
import time
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_refine.batch import SceneBatch, batch_from_scenes, concatenate
from mjx_refine.scene import Body, Camera, Scene, Shape
from mjx_refine.sim.backends import Simulator, make_simulator
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.model import SUBSTEPS, apply_fields, build_spec, initial_state, model_fields

FPS = 30.0
FRAMES = 31
LIMITS = {"mjx": 0.03, "warp": 0.01, "mujoco": 0.0}
"""Median difference after one second that a row may have [m], where C's own spread is smaller."""

BEFORE_LIMIT = 1e-4
"""Difference that identical scenes may have before the first contact [m]."""

PERTURBATION = 1e-4
"""Relative change of the initial state under which C's own spread is measured."""

COPIES = 4
"""Perturbed copies of every scene for that spread."""

SIZES = {"sphere": (0.2,), "box": (0.25, 0.2, 0.15), "cylinder": (0.2, 0.4)}


@dataclasses.dataclass(frozen=True)
class Row:
    """What was measured of one kind of motion at one damping; distances are of positions [m]."""

    name: str
    damping: float
    scenes: int
    before_contact: float
    before_meeting: float
    median: float
    worst: float
    c_spread: float
    diverged: int
    verdict: str
    seconds: float


def body(shape: str, position, damping: float, turn=(1.0, 0.0, 0.0, 0.0), velocity=(0, 0, 0), spin=(0, 0, 0)) -> Body:
    """A body of the benchmark's size; ``turn`` need not be normalised."""
    unit = np.asarray(turn, float) / np.linalg.norm(turn)
    return Body(
        shape=shape,
        name=f"{shape}_{position[0]}",
        size=SIZES[shape],
        position=tuple(map(float, position)),
        orientation=tuple(unit.tolist()),
        linear_velocity=tuple(map(float, velocity)),
        angular_velocity=tuple(map(float, spin)),
        friction=(0.5, 0.01),
        damping=damping,
    )


def single_rows(damping: float) -> dict[str, tuple[Body, ...]]:
    """One object on, over or falling to the floor."""
    lying = (1.0, 1.0, 0.0, 0.0)
    roll = body("cylinder", (0, 0, 0.2), damping, lying, velocity=(2, 0, 0), spin=(0, 0, -10))
    tall = dataclasses.replace(
        body("box", (0, 0, 0.47), damping, (1, 0, 0.12, 0), spin=(0, 1.5, 0)), size=(0.12, 0.2, 0.45)
    )
    tilted = (1.0, 0.2, 0.15, 0.3)
    return {
        "slide": (body("box", (0, 0, 0.15), damping, velocity=(3, 0.5, 0), spin=(0, 0, 1)),),
        "roll": (roll,),
        "topple": (tall,),
        "bounce": (body("sphere", (0, 0, 0.8), damping, velocity=(1, 0, 0), spin=(0, 3, 0)),),
        "bounce-box": (body("box", (0, 0, 0.8), damping, tilted, velocity=(0.5, 0, 0), spin=(0, 1, 0)),),
        "bounce-cylinder": (body("cylinder", (0, 0, 0.8), damping, tilted, velocity=(0.5, 0, 0), spin=(1, 0, 0)),),
    }


def pair_rows(damping: float) -> dict[str, tuple[Body, ...]]:
    """Two objects that meet just above the floor and then land on it, for every pairing of shapes."""
    rows = {}
    shapes = ("sphere", "box", "cylinder")
    for i, first in enumerate(shapes):
        for second in shapes[i:]:
            rows[f"{first}-{second}"] = (
                body(first, (-0.8, 0.03, 0.40), damping, (1, 0.1, 0.2, 0.1), (3, 0, 0.5), (0.5, 0.3, 0)),
                body(second, (0.0, -0.02, 0.35), damping, (1, 0.15, -0.1, 0.3), (0, 0, 0.4), (0, 0, 0.5)),
            )
    return rows


def scene_batch(bodies: tuple[Body, ...], count: int, seed: int) -> SceneBatch:
    """``count`` scenes like ``bodies`` with other sizes, masses, frictions, poses and velocities."""
    generator = np.random.default_rng(seed)
    scene = Scene(bodies, Camera((0.0, -3.0, 3.0), 45.0), (0.0, 0.0, -9.81))
    batch = batch_from_scenes([scene] * count)
    shape = batch.mass.shape

    def scale(array: np.ndarray, width: float, factor: tuple[int, ...]) -> np.ndarray:
        return array * np.exp(width * generator.standard_normal(factor))

    # What slides or rolls on the floor from the start keeps the axis of its spin.
    on_floor = len(bodies) == 1 and abs(bodies[0].linear_velocity[0]) >= 2
    spin = scale(batch.angular_velocity, 0.05, (*shape, 1))
    if not on_floor:
        spin = batch.angular_velocity + 0.2 * generator.standard_normal((*shape, 3))
    size = scale(batch.size, 0.05, (*shape, 1))
    position = batch.position + 0.01 * generator.standard_normal((*shape, 3)) * np.array([1, 1, 0])
    # A larger body starts higher by as much: what rests on the floor stays there.
    position[..., 2] *= size[..., 0] / batch.size[..., 0]
    return dataclasses.replace(
        batch,
        size=size,
        mass=scale(batch.mass, 0.2, shape),
        friction=scale(batch.friction, 0.2, (*shape, 2)),
        position=position,
        linear_velocity=scale(batch.linear_velocity, 0.05, (*shape, 3)),
        angular_velocity=spin,
    )


def perturbed(batch: SceneBatch, seed: int) -> SceneBatch:
    """The batch with every number of the initial state changed by about 1e-4 of itself."""
    generator = np.random.default_rng(seed)
    changed = {}
    for name in ("position", "quaternion", "linear_velocity", "angular_velocity"):
        array = getattr(batch, name)
        changed[name] = array * (1 + PERTURBATION * generator.standard_normal(array.shape))
    changed["quaternion"] /= np.linalg.norm(changed["quaternion"], axis=-1, keepdims=True)
    return dataclasses.replace(batch, **changed)


def first_contacts(batch: SceneBatch, frames: int) -> Float[np.ndarray, "batch 2"]:
    """The last frame before any contact, and before any contact of two objects, by stepping C MuJoCo."""
    model = build_spec(batch.shapes, FPS).compile()
    fields = model_fields(batch)
    qpos, qvel = initial_state(batch)
    last = np.full((len(batch), 2), frames - 1)
    for row in range(len(batch)):
        apply_fields(model, fields, row)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos[row], qvel[row]
        for step in range((frames - 1) * SUBSTEPS):
            mujoco.mj_step(model, data)
            # The contacts are those of the state before this step, which frame `step // SUBSTEPS` may still show.
            if data.ncon:
                last[row, 0] = min(last[row, 0], step // SUBSTEPS)
                if data.contact.geom.min(axis=1).max() > 0:
                    last[row, 1] = step // SUBSTEPS
                    break
    return last


def distance(one: np.ndarray, other: np.ndarray) -> Float[np.ndarray, "batch frames"]:
    """The farthest that any object's centre is from its twin [m], for every candidate and frame."""
    return np.linalg.norm(one[..., :3] - other[..., :3], axis=-1).max(-1)


def up_to(apart: Float[np.ndarray, "batch frames"], last: np.ndarray) -> float:
    """The largest difference in frames 0 to ``last`` of every candidate; 0 where that is frame 0 alone."""
    return float(max(apart[row, : frame + 1].max() for row, frame in enumerate(last)))


def measure(name: str, damping: float, batch: SceneBatch, simulator: Simulator, reference: MujocoSimulator) -> Row:
    """One row of the table."""
    truth = reference.rollout(batch, FRAMES)
    copies = concatenate([perturbed(batch, seed) for seed in range(COPIES)])
    others = reference.rollout(copies, FRAMES).reshape(COPIES, *truth.shape)
    spread = float(np.median(np.median([distance(other, truth)[:, -1] for other in others], axis=0)))
    start = time.perf_counter()
    poses = simulator.rollout(batch, FRAMES)
    seconds = time.perf_counter() - start
    apart = distance(poses, truth)
    last = first_contacts(batch, FRAMES)
    before = up_to(apart, last[:, 0])
    end = np.nan_to_num(apart[:, -1], nan=np.inf)
    median = float(np.median(end))
    limit = LIMITS[simulator.name]
    within = "ok" if median <= limit else ("stated" if spread > limit else "FAIL")
    if not before <= BEFORE_LIMIT:
        within = "FAIL"
    return Row(
        name=name,
        damping=damping,
        scenes=len(batch),
        before_contact=before,
        before_meeting=up_to(apart, last[:, 1]),
        median=median,
        worst=float(end.max()),
        c_spread=spread,
        diverged=int(np.isnan(poses[:, -1]).any((1, 2)).sum()),
        verdict=within,
        seconds=round(seconds, 2),
    )


def simulator_of(backend: str, shapes: tuple[Shape, ...], any_device: bool) -> Simulator:
    """The backend; ``any_device``: MJX-Warp's kernels on a CPU, where there is no GPU."""
    if any_device and backend == "warp":
        from mjx_refine.sim.warp import WarpSimulator

        return WarpSimulator(shapes, FPS, any_device=True)
    return make_simulator(backend, shapes, FPS)


def run(
    backend: str, count: int, seed: int, chosen: list[str] | None, dampings: list[float], any_device: bool = False
) -> list[Row]:
    """Measures and prints every row; scenes of one kind share a compiled program."""
    heading = f"{'row':18}{'damping':>8}{'before':>10}{'meeting':>10}{'median':>10}{'worst':>10}{'C spread':>10}"
    print(f"{heading}{'NaN':>5}{'s':>8}  verdict", flush=True)
    simulators: dict[tuple[str, ...], tuple[Simulator, MujocoSimulator]] = {}
    rows = []
    names = [*single_rows(0.0), *pair_rows(0.0)]
    for name in chosen or names:
        for damping in dampings:
            bodies = {**single_rows(damping), **pair_rows(damping)}[name]
            batch = scene_batch(bodies, count, seed + names.index(name))
            if batch.shapes not in simulators:
                pair = (simulator_of(backend, batch.shapes, any_device), MujocoSimulator(batch.shapes, FPS))
                simulators[batch.shapes] = pair
            row = measure(name, damping, batch, *simulators[batch.shapes])
            rows.append(row)
            print(
                f"{row.name:18}{row.damping:8.0f}{row.before_contact:10.1e}{row.before_meeting:10.1e}{row.median:10.4f}"
                f"{row.worst:10.4f}{row.c_spread:10.4f}{row.diverged:5d}{row.seconds:8.1f}  {row.verdict}",
                flush=True,
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", choices=("mjx", "warp", "mujoco"), default="mjx")
    parser.add_argument("--count", type=int, default=16, help="scenes a row")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rows", help="names, separated by commas; all by default")
    parser.add_argument("--damping", help="dampings, separated by commas", default="-4,-30")
    parser.add_argument("--any-device", action="store_true", help="warp: run its kernels on a CPU, slowly")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    arguments = parser.parse_args()
    chosen = arguments.rows.split(",") if arguments.rows else None
    dampings = [float(text) for text in arguments.damping.split(",")]
    rows = run(arguments.backend, arguments.count, arguments.seed, chosen, dampings, arguments.any_device)
    if arguments.json:
        machine = {
            "machine": platform.machine(),
            "processor": platform.processor(),
            "python": platform.python_version(),
        }
        report = {"backend": arguments.backend, "machine": machine, "rows": [dataclasses.asdict(row) for row in rows]}
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
