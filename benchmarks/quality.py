"""Refines every clip of a folder at the published budget and prints the table.

    python -m benchmarks.clips --out clips --seed 100
    python -m benchmarks.quality clips [--optimizer hybrid] [--only 00_1_flight,...] [--json quality.json]
        [--refits 0] [--resolution 480x320]

Each clip is a folder with ``flows.npz`` and ``best32.yaml``, simulated by PyBullet and drawn by its renderer.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from pathlib import Path

import numpy as np

from mjx_refine import Options, load_observation, load_scenes, refine
from mjx_refine.files import write_text
from mjx_refine.scene import save_scene

COLUMNS = ("start_iou", "iou", "start_first", "first", "start_epe", "epe", "evaluations", "seconds")


def machine() -> str:
    """What this runs on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.split(":")[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    return f"{model}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"


def measure(folder: Path, options: Options, out: Path | None) -> dict:
    """Refines one clip; scores are C MuJoCo's at full resolution."""
    samples = load_scenes(folder / "best32.yaml")
    result = refine(samples, load_observation(folder / "flows.npz"), options)
    before, after = result.init.scores, result.refined.scores
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        save_scene(out / f"{folder.name}.yaml", result.scene)
    landed = [step for step in result.history if step.phase == "land"]
    return {
        "clip": folder.name,
        "start_iou": float(before.iou[0]),
        "iou": float(after.iou[0]),
        "start_first": float(before.first_frame_iou[0]),
        "first": float(after.first_frame_iou[0]),
        "start_epe": float(before.epe[0]),
        "epe": float(after.epe[0]),
        "start_fitness": float(before.fitness[0]),
        "fitness": float(after.fitness[0]),
        "landed_fitness": max((step.fitness for step in landed), default=None),
        "evaluations": result.evaluations,
        "seconds": result.seconds["total"],
        "reason": result.reason,
    }


def table(rows: list[dict]) -> str:
    """The rows, their mean and the requirement's verdict."""
    lines = ["| clip | " + " | ".join(COLUMNS) + " |", "| --- " * (len(COLUMNS) + 1) + "|"]
    mean = {"clip": f"mean of {len(rows)}", **{c: float(np.mean([row[c] for row in rows])) for c in COLUMNS}}
    for row in [*rows, mean]:
        cells = [f"{row[c]:.0f}" if c in ("evaluations", "seconds") else f"{row[c]:.3f}" for c in COLUMNS]
        lines.append(f"| {row['clip']} | " + " | ".join(cells) + " |")
    worse = [row["clip"] for row in rows if row["fitness"] < row["start_fitness"] or row["iou"] < row["start_iou"]]
    lines.append(f"below the start: {', '.join(worse) or 'none'}; least IoU {min(row['iou'] for row in rows):.3f}")
    return "\n".join(lines)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--optimizer", default="hybrid")
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--population", type=int, default=128)
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--refits", type=int, default=6)
    parser.add_argument(
        "--resolution", type=lambda text: tuple(map(int, text.split("x"))), help="of the search's pictures"
    )
    parser.add_argument("--only", help="names of clips, with commas")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--out", type=Path, help="folder for the refined scenes")
    parser.add_argument("--merge", type=Path, nargs="+", help="print the table of earlier --json files")
    arguments = parser.parse_args()
    if arguments.merge:
        rows = [row for path in arguments.merge for row in json.loads(path.read_text())["clips"]]
        print(table(sorted(rows, key=lambda row: row["clip"])))
        return
    names = ("seed", "population", "iterations", "optimizer", "backend", "threads", "refits", "resolution")
    options = Options(**{name: getattr(arguments, name) for name in names})
    rows = []
    for folder in sorted(path.parent for path in arguments.folder.glob("*/flows.npz")):
        if arguments.only and folder.name not in arguments.only.split(","):
            continue
        rows.append(measure(folder, options, arguments.out))
        print(json.dumps(rows[-1]), flush=True)
    print(f"\n{machine()}; optimizer {options.optimizer}, budget {options.budget}\n")
    print(table(rows))
    if arguments.json:
        write_text(arguments.json, json.dumps({"machine": machine(), "clips": rows}, indent=1))


if __name__ == "__main__":
    main()
