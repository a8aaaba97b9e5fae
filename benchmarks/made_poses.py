"""How often a diagnosis of poses is right on simulated throws with a hidden effect, and with which probability it says so.

    python -m benchmarks.made_poses [--count 16] [--seed 0]

Throws of a ball or a box by our own engine, recorded at 148 Hz for 0.8 s with noise of 1 mm and 0.5 degrees; the effect and
its size are drawn. The fit knows its simulator, so these figures say less than those of another engine would.
"""

from __future__ import annotations

import argparse
import dataclasses

import numpy as np

from benchmarks.quality import machine
from mjx_refine import rotations
from mjx_refine.diagnosis import Poses, diagnose_poses, make_poses
from mjx_refine.effects import batch_with_effects
from mjx_refine.scene import Body, Camera, Effect, Scene
from mjx_refine.sim.c import MujocoSimulator

CAMERA = Camera((0.0, -3.0, 1.6), 65.0)
RATE, SPAN = 148.0, 0.8  # Hz, s
NOISE = 1e-3, float(np.radians(0.5))  # m, rad
KINDS = ("none", "drag", "wind", "push", "magnus")


def drawn(generator: np.random.Generator, kind: str) -> Scene:
    """A throw with one effect, worth 0.3 to 3 m/s^2."""
    velocity = tuple(generator.uniform([1.5, -1.0, 1.0], [3.5, 1.0, 3.0]).tolist())
    spin = tuple(generator.normal(0.0, 5.0, 3).tolist())
    box = generator.random() < 0.5
    size = (0.09, 0.08, 0.07) if box else (0.1,)
    friction, damping = (0.3, 0.01), -40.0
    body = Body("box" if box else "sphere", "body", size, (-0.8, 0.2, 0.9), (1.0, 0.0, 0.0, 0.0), velocity, spin, friction,
                0.3, damping)  # fmt: skip
    strength = float(np.exp(generator.uniform(np.log(0.3), np.log(3.0)))) * body.mass
    way = generator.normal(size=3)
    way /= np.linalg.norm(way[:2])
    speed = float(np.linalg.norm(velocity))
    effects = {
        "none": (),
        "drag": (Effect("drag", "body", (("quadratic", strength / speed**2),)),),
        "wind": (Effect("wind", None, (("x", strength * way[0] / 0.03), ("y", strength * way[1] / 0.03))),),
        "push": (
            Effect(
                "push",
                "body",
                (
                    ("time", float(generator.uniform(0.15, 0.5))),
                    *((a, 0.2 * strength * w) for a, w in zip("xyz", way, strict=True)),
                ),
            ),
        ),
        "magnus": (Effect("magnus", "body", (("coefficient", strength / speed / 8.0),)),),
    }[kind]
    return Scene((body,), CAMERA, (0.0, 0.0, -9.81), effects)


def recorded(scene: Scene, generator: np.random.Generator) -> Poses:
    """What a tracker with noise would give."""
    count = int(SPAN * RATE) + 1
    poses = MujocoSimulator(scene.shapes, RATE, 1).rollout(batch_with_effects([scene]), count)[0, :, 0]
    turn = rotations.exponential(generator.normal(0.0, NOISE[1], (count, 3)))
    place = poses[:, :3] + generator.normal(0.0, NOISE[0], (count, 3))
    return make_poses(np.arange(count) / RATE, place, rotations.multiply(turn, poses[:, 3:]))


def main() -> None:
    """Prints a row a throw and the summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print(f"{machine()}\n\n| shape | hidden | verdict | probability | lead | gap before | after | closed | s |")
    print("| --- " * 9 + "|", flush=True)
    rows = []
    for k in range(arguments.count):
        generator = np.random.default_rng((arguments.seed, k))
        kind = KINDS[k % len(KINDS)]
        scene = drawn(generator, kind)
        poses = recorded(scene, generator)
        given = dataclasses.replace(scene, effects=())
        told = diagnose_poses(given, poses)
        said = "+".join(told.verdict.effects) or "none"
        rows.append((said == kind, told.verdict.probability))
        lead = told.candidates[0].evidence if told.candidates else 0.0
        print(
            f"| {scene.shapes[0]} | {kind} | {said} | {told.verdict.probability:.2f} | {lead:.0f} | {told.gap.before:.2f} | "
            f"{told.gap.after:.2f} | {told.gap.closed:.2f} | {told.seconds:.0f} |",
            flush=True,
        )
    right, sure = np.array(rows).T
    print(f"\nright {int(right.sum())} of {len(rows)}; mean probability {sure.mean():.2f}, of the right ones "
          f"{sure[right > 0].mean() if right.any() else 0:.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
