"""How far refined parameters are from the truth, and whether their intervals hold it.

    python -m benchmarks.parameters --scenes DIR --seed 500 --count 60      # once: the truths and rough samples
    python -m benchmarks.parameters --scenes DIR --json parameters.json     # refine, print the table
    python -m benchmarks.parameters --merge a.json b.json ...

The clips are simulated and drawn by the project itself (C MuJoCo, analytic pictures), so that every parameter has a true
value: every second one with exact flow, the others with noise of 0.5 px a pixel and 0.3 px that is smooth over 8 px. The
samples are eight rough guesses, as of ``benchmarks.clips``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from scipy import ndimage

from benchmarks.quality import machine
from mjx_refine import Options, load_scenes, refine
from mjx_refine.batch import batch_from_scenes
from mjx_refine.files import write_text
from mjx_refine.observation import Observation
from mjx_refine.scene import Scene
from mjx_refine.search.result import RefineResult
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.space import Space
from mjx_refine.view.picture import draw

SIZE, FRAMES, FPS = (480, 320), 30, 30.0
SAMPLES = 8
PIXEL_NOISE, SMOOTH_NOISE, SMOOTH = 0.5, 0.3, 8.0
GROUPS = {
    "velocity": ("velocity.",),
    "spin": ("spin.",),
    "friction": ("friction.sliding",),
    "rolling": ("friction.rolling",),
    "damping": (".damping",),
    "gravity": ("gravity",),
    "size": (".radius", ".half_height", ".size."),
    "position": (".position.", ".clearance"),
    "turn": (".yaw", ".tilt"),
    "mass": (".mass",),
    "camera": ("camera.",),
}


def write_scenes(folder: Path, seed: int, count: int) -> None:
    """Truths of every kind of motion with 1-4 objects, as YAML, and samples beside them."""
    from benchmarks.clips.clip import mask_fault
    from benchmarks.clips.folders import plan
    from benchmarks.clips.samples import Noise, guess_scene
    from benchmarks.clips.scenes import draw_scene
    from benchmarks.clips.writing import samples_text, scene_text

    folder.mkdir(parents=True, exist_ok=True)
    for index, (kind, objects) in enumerate(plan(count)):
        for again in range(200):
            rng = np.random.default_rng([seed, index, again])
            truth = draw_scene(rng, kind, objects)
            name = f"{index:02d}_{objects}_{kind}"
            write_text(folder / f"{name}.truth.yaml", scene_text(truth))
            observation, _ = film(load_scenes(folder / f"{name}.truth.yaml").scenes[0], 0.0, 0)
            if observation is not None and mask_fault(np.asarray(observation.masks), objects, FRAMES) is None:
                break
        own = np.random.default_rng([seed, index, 1])
        noise = Noise(int(own.integers(2**31)), own)
        guesses = [guess_scene(truth, SIZE, noise, 1.0, 1.0, 2) for _ in range(SAMPLES)]
        write_text(folder / f"{name}.samples.yaml", samples_text(guesses, tagged=False, seed=index))
        print(name, f"try {again + 1}", flush=True)


def film(scene: Scene, noise: float, seed: int) -> tuple[Observation | None, np.ndarray]:
    """The clip of a scene, its flow with ``noise`` times the noise above; None if the simulation diverges."""
    simulator = MujocoSimulator(scene.shapes, FPS, 1)
    batch = batch_from_scenes([scene])
    poses = simulator.rollout(batch, FRAMES)[0]
    if not np.isfinite(poses).all() or simulator.overlap(batch)[0] > 0.002:
        return None, poses
    masks, flow = draw(poses, batch, SIZE)
    if noise:
        generator = np.random.default_rng([seed, 3])
        flow = flow + noise * PIXEL_NOISE * generator.standard_normal(flow.shape)
        smooth = ndimage.gaussian_filter(generator.standard_normal(flow.shape), (0, SMOOTH, SMOOTH, 0))
        flow = flow + noise * SMOOTH_NOISE * smooth / smooth.std()
    return Observation(flow.astype(np.float16).astype(np.float32), masks, FPS), poses


def measure(folder: Path, name: str, options: Options) -> dict:
    """Refines one clip and compares every parameter with the truth."""
    truth = load_scenes(folder / f"{name}.truth.yaml").scenes[0]
    noise = float(int(name.split("_")[0]) % 2)
    observation, _ = film(truth, noise, int(name.split("_")[0]))
    assert observation is not None
    result = refine(load_scenes(folder / f"{name}.samples.yaml"), observation, options)
    return {
        "clip": name,
        "noise": noise,
        "iou": float(result.refined.scores.iou[0]),
        "epe": float(result.refined.scores.epe[0]),
        "seconds": result.seconds["total"],
        "rows": compared(result, truth),
    }


def compared(result: RefineResult, truth: Scene) -> list[dict]:
    """A row a parameter that has a true value: error, standard error, interval, whether it holds the truth.

    Angles are not compared one by one: the truth's are not coordinates of the refined scene's space.
    """
    true = {p.name: p.start for p in Space.around(truth).parameters}
    rows = []
    known = result.known
    for j, row in enumerate(result.parameters):
        if known is None or row.name not in true or any(part in row.name for part in (".yaw", ".tilt")):
            continue
        value = true[row.name]
        rows.append(
            {
                "name": row.name,
                "value": row.after,
                "truth": value,
                "before": row.before,
                "low": row.low,
                "high": row.high,
                "standard_error": float(known.standard_error[j]),
                "determined": row.determined,
                "inside": bool(row.low <= value <= row.high),
                "reach": (row.high - row.low) / 2,
            }
        )
    return rows


def table(clips: list[dict]) -> str:
    """Errors and coverage by group of parameters, for clips without noise and with it."""
    lines = [
        "| parameters | noise | n | determined | error before | error | error, determined | inside 90 %, determined | all |",
        "| --- " * 9 + "|",
    ]
    for noise in (0.0, 1.0, None):
        rows = [row for clip in clips if noise is None or clip["noise"] == noise for row in clip["rows"]]
        groups = GROUPS if noise is not None else {}
        for group, parts in {**groups, "all": ("",)}.items():
            chosen = [row for row in rows if any(part in row["name"] for part in parts)]
            if chosen:
                lines.append(_line(group, {0.0: "none", 1.0: "noisy", None: "both"}[noise], chosen))
    fitted = ", ".join(f"{clip['clip']} {clip['iou']:.3f}" for clip in sorted(clips, key=lambda c: c["iou"])[:5])
    return "\n".join([*lines, f"{len(clips)} clips; least IoU: {fitted}"])


def _line(group: str, noise: str, rows: list[dict]) -> str:
    determined = [row for row in rows if row["determined"]]

    def relative(row: dict, key: str) -> float:
        scale = abs(row["truth"]) if group in ("size", "friction", "rolling", "damping", "gravity", "mass") else 1.0
        return abs(row[key] - row["truth"]) / max(scale, 1e-9)

    def median(chosen: list[dict], key: str) -> str:
        return f"{np.median([relative(row, key) for row in chosen]):.3g}" if chosen else "–"

    def share(chosen: list[dict]) -> str:
        return f"{np.mean([row['inside'] for row in chosen]):.2f}" if chosen else "–"

    cells = (
        group, noise, str(len(rows)), str(len(determined)), median(rows, "before"), median(rows, "value"),
        median(determined, "value"), share(determined), share(rows),
    )  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Writes scenes, or refines and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path)
    parser.add_argument("--seed", type=int, help="make the scenes")
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--only", help="names of clips, with commas")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--merge", type=Path, nargs="+", help="print the table of earlier --json files")
    arguments = parser.parse_args()
    if arguments.merge:
        print(table([clip for path in arguments.merge for clip in json.loads(path.read_text())["clips"]]))
        return
    if arguments.seed is not None:
        write_scenes(arguments.scenes, arguments.seed, arguments.count)
        return
    options = Options(backend="mujoco", iterations=arguments.iterations, threads=arguments.threads)
    clips = []
    for path in sorted(arguments.scenes.glob("*.truth.yaml")):
        name = path.name.removesuffix(".truth.yaml")
        if arguments.only and name not in arguments.only.split(","):
            continue
        clips.append(measure(arguments.scenes, name, options))
        clip = clips[-1]
        inside = [row["inside"] for row in clip["rows"] if row["determined"]]
        print(
            name, f"IoU {clip['iou']:.3f}, {sum(inside)} of {len(inside)} inside, {clip['seconds']:.0f} s", flush=True
        )
    if arguments.json:
        write_text(arguments.json, json.dumps({"machine": machine(), "clips": clips}, indent=1))
    print(f"\n{machine()}\n\n{table(clips)}")


if __name__ == "__main__":
    main()
