"""How far refined parameters are from the truth, and whether their intervals hold it.

    python -m benchmarks.parameters --scenes DIR --seed 500 --count 60      # once: the truths and rough samples
    python -m benchmarks.parameters --scenes DIR --out OUT --jobs 60        # refine; goes on where it was stopped
    python -m benchmarks.parameters --summary OUT/parameters.csv ...        # the table, of several files together

The clips are simulated and drawn by the project itself (C MuJoCo, analytic pictures), so that every parameter has a true
value: every second one with exact flow, the others with noise of 0.5 px a pixel and 0.3 px that is smooth over 8 px. The
samples are eight rough guesses, as of ``benchmarks.clips``. A clip's rows are appended to the CSV the moment it is done;
clips that are there already are not refined again.
"""

from __future__ import annotations

import argparse
import csv
import io
import multiprocessing
import os
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
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

COLUMNS = (
    "clip", "noise", "iou", "epe", "seconds", "of", "name", "value", "truth", "before", "low", "high", "standard_error",
    "determined", "inside",
)  # fmt: skip
"""A row a parameter; ``of`` is how many rows its clip has, so that a clip whose writing was cut off is known."""

SINGLE = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}
"""What keeps a worker to one thread; read when numpy and JAX start, so set before workers do."""

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


def measure(folder: Path, name: str, options: Options) -> list[dict]:
    """Refines one clip and compares every parameter with the truth, in rows of ``COLUMNS``."""
    truth = load_scenes(folder / f"{name}.truth.yaml").scenes[0]
    noise = int(name.split("_")[0]) % 2
    observation, _ = film(truth, float(noise), int(name.split("_")[0]))
    assert observation is not None
    result = refine(load_scenes(folder / f"{name}.samples.yaml"), observation, options)
    scores = result.refined.scores
    clip = {"clip": name, "noise": noise, "iou": float(scores.iou[0]), "epe": float(scores.epe[0])}
    rows = compared(result, truth)
    clip.update(seconds=result.seconds["total"], of=len(rows))
    # A clip without intervals (the best sample was kept as it came) is done all the same.
    return [clip | row for row in rows] or [clip]


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
                "determined": int(row.determined),
                "inside": int(row.low <= value <= row.high),
            }
        )
    return rows


def append(path: Path, rows: list[dict]) -> None:
    """Adds a clip's rows to the CSV in one write that reaches the disk."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, restval="")
    if not path.exists():
        writer.writeheader()
    writer.writerows(rows)
    with open(path, "a", newline="") as stream:
        stream.write(text.getvalue())
        stream.flush()
        os.fsync(stream.fileno())


def read(paths: Iterable[Path]) -> list[dict]:
    """Rows of whole clips, numbers as numbers; what a cut-off write left of a clip is not among them."""
    clips: dict[tuple[Path, str], list[dict]] = {}
    for path in paths:
        with open(path, newline="") as stream:
            for row in csv.DictReader(stream):
                if None in row or None in row.values():
                    continue
                texts = ("clip", "name")
                row = {key: value if key in texts else float(value or "nan") for key, value in row.items()}
                clips.setdefault((path, row["clip"]), []).append(row)
    return [row for rows in clips.values() if len(rows) == max(rows[0]["of"], 1) for row in rows]


def refine_all(folder: Path, out: Path, names: list[str], jobs: int, options: Options) -> Path:
    """Refines the clips that ``out`` does not hold yet, ``jobs`` at a time, and says how far it is."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / "parameters.csv"
    if path.exists():
        kept = read([path])
        _rewrite(path, kept)
        finished = {row["clip"] for row in kept}
        names = [name for name in names if name not in finished]
        print(f"{path}: {len(finished)} clips are done, {len(names)} left", flush=True)
    # Those with most objects take longest.
    names = sorted(names, key=lambda name: -int(name.split("_")[1]))
    os.environ.update(SINGLE)
    began, failed = time.monotonic(), []
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        futures = {pool.submit(measure, folder, name, options): name for name in names}
        for done, future in enumerate(as_completed(futures), 1):
            name = futures[future]
            try:
                rows = future.result()
            except Exception as error:  # One clip's fault does not end the others.
                failed.append(name)
                print(f"{done}/{len(names)} {name}: {type(error).__name__}: {error}", flush=True)
                continue
            append(path, rows)
            inside = [row["inside"] for row in rows if row.get("determined")]
            print(
                f"{done}/{len(names)} {name}: IoU {rows[0]['iou']:.3f}, {sum(inside)} of {len(inside)} inside, "
                f"{rows[0]['seconds']:.0f} s; {time.monotonic() - began:.0f} s since the start",
                flush=True,
            )
    if failed:
        raise SystemExit(f"not refined: {', '.join(sorted(failed))}; run again for these alone")
    return path


def _rewrite(path: Path, rows: list[dict]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS)
    writer.writeheader()
    writer.writerows({key: "" if value != value else value for key, value in row.items()} for row in rows)
    write_text(path, text.getvalue())


def table(rows: list[dict]) -> str:
    """Errors and coverage by group of parameters, for clips without noise and with it, and by number of objects."""
    lines = [
        "| parameters | noise | n | determined | error before | error | error, determined | standard error, determined "
        "| inside 90 %, determined | not determined | all |",
        "| --- " * 11 + "|",
    ]
    of_clips = {row["clip"]: row for row in rows}
    rows = [row for row in rows if row["name"]]
    for noise, words in ((0, "none"), (1, "noisy"), (None, "both")):
        chosen = [row for row in rows if noise is None or row["noise"] == noise]
        for group, parts in {**GROUPS, "all": ("",)}.items():
            lines += _line(group, words, [row for row in chosen if any(part in row["name"] for part in parts)])
        for objects in "1234":
            lines += _line(f"{objects} objects", words, [row for row in chosen if row["clip"].split("_")[1] == objects])
    least = sorted(of_clips.values(), key=lambda row: row["iou"])[:5]
    fitted = ", ".join(f"{row['clip']} {row['iou']:.3f}" for row in least)
    return "\n".join([*lines, "", f"{len(of_clips)} clips; least IoU: {fitted}"])


def _line(group: str, noise: str, rows: list[dict]) -> list[str]:
    """A line of the table, none without rows. Errors of positive quantities are relative, others in their units; standard
    errors in prior widths."""
    if not rows:
        return []
    determined = [row for row in rows if row["determined"]]
    loose = [row for row in rows if not row["determined"]]

    def relative(row: dict, key: str) -> float:
        scale = abs(row["truth"]) if group in ("size", "friction", "rolling", "damping", "gravity", "mass") else 1.0
        return abs(row[key] - row["truth"]) / max(scale, 1e-9)

    def median(values: list[float]) -> str:
        return f"{np.median(values):.3g}" if values else "–"

    def share(chosen: list[dict]) -> str:
        return f"{np.mean([row['inside'] for row in chosen]):.2f}" if chosen else "–"

    # Groups of several units have no error of their own.
    mixed = group == "all" or group.endswith("objects")
    before, after, told = (
        "–" if mixed else median([relative(row, key) for row in chosen])
        for key, chosen in (("before", rows), ("value", rows), ("value", determined))
    )
    errors = median([row["standard_error"] for row in determined])
    cells = (
        group, noise, str(len(rows)), str(len(determined)), before, after, told, errors,
        share(determined), share(loose), share(rows),
    )  # fmt: skip
    return ["| " + " | ".join(cells) + " |"]


def main() -> None:
    """Writes scenes, or refines, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path)
    parser.add_argument("--seed", type=int, help="make the scenes")
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--only", help="names of clips, with commas")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=1, help="clips at a time, each on one thread")
    parser.add_argument("--out", type=Path, help="folder for parameters.csv; --scenes by default")
    parser.add_argument("--summary", type=Path, nargs="+", metavar="CSV", help="print the table of earlier runs")
    arguments = parser.parse_args()
    if arguments.summary:
        print(table(read(arguments.summary)))
        return
    if arguments.scenes is None or arguments.jobs < 1:
        parser.error("--scenes DIR and --jobs of at least 1, or --summary CSV, are needed")
    if arguments.seed is not None:
        write_scenes(arguments.scenes, arguments.seed, arguments.count)
        return
    options = Options(backend="mujoco", iterations=arguments.iterations, threads=1)
    names = sorted(path.name.removesuffix(".truth.yaml") for path in arguments.scenes.glob("*.truth.yaml"))
    if arguments.only:
        names = [name for name in names if name in arguments.only.split(",")]
    path = refine_all(arguments.scenes, arguments.out or arguments.scenes, names, arguments.jobs, options)
    print(f"\n{machine()}, {arguments.jobs} jobs, {arguments.iterations} iterations\n\n{table(read([path]))}")


if __name__ == "__main__":
    main()
