"""Tables and plots of what ``benchmarks.optimizers`` measured."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from mjx_refine.files import write_atomic

MARKS = (640, 2560, 12800)
"""Evaluations at which the tables read the curves."""

FEW = 2560
"""Evaluations with which ``hybrid`` is to reach what CMA-ES reaches with all of its budget."""


def iou_at(run: dict, evaluations: int) -> float | None:
    """IoU of the best candidate after so many rollouts; None beyond the run's budget."""
    if evaluations > run["budget"]:
        return None
    return [row[3] for row in run["curve"] if row[0] <= evaluations or row is run["curve"][0]][-1]


def seconds_to(run: dict, iou: float) -> float | None:
    """Seconds until the best candidate's IoU is that, None if never."""
    return next((row[1] for row in run["curve"] if row[3] >= iou), None)


def _done(runs: list[dict]) -> dict[str, dict[str, dict]]:
    """Runs that were made, by method and clip."""
    found: dict[str, dict[str, dict]] = {}
    for run in runs:
        if "skipped" not in run:
            found.setdefault(run["method"], {})[run["clip"]] = run
    return found


def _cell(values: list[float | None], digits: int = 3) -> str:
    known = [v for v in values if v is not None]
    return f"{np.mean(known):.{digits}f}" if known and len(known) == len(values) else "–"


def _row(kind: str, method: str, chosen: dict[str, dict], targets: dict[str, float]) -> str:
    cells = [_cell([iou_at(run, mark) for run in chosen.values()]) for mark in MARKS]
    cells.append(_cell([run["final"]["iou"] for run in chosen.values()]))
    compared = [clip for clip in chosen if clip in targets]
    times = [t for clip in compared if (t := seconds_to(chosen[clip], targets[clip])) is not None]
    cells.append(f"{np.median(times):.1f} ({len(times)} of {len(compared)})" if times else f"– (0 of {len(compared)})")
    cells.append(_cell([run["seconds"] for run in chosen.values()], 1))
    return f"| {kind} | {method} | {len(chosen)} | " + " | ".join(cells) + " |"


def _truths(runs: list[dict]) -> list[str]:
    """What the true scenes themselves reach: the oracle's ceiling."""
    known = {run["clip"]: (run["kind"], run["truth_iou"]) for run in runs if run.get("truth_iou") is not None}
    if not known:
        return []
    kinds = sorted({kind for kind, _ in known.values()})
    parts = [f"{kind} {np.mean([iou for k, iou in known.values() if k == kind]):.3f}" for kind in kinds]
    mean = np.mean([iou for _, iou in known.values()])
    return [f"the true scenes, simulated by C MuJoCo, have an IoU of {mean:.3f}: {', '.join(parts)}"]


def tables(runs: list[dict]) -> str:
    """Means by kind of motion, and the share of clips on which ``hybrid`` needs few rollouts."""
    done = _done(runs)
    targets = {clip: run["curve"][-1][3] for clip, run in done.get("cmaes", {}).items()}
    heads = [f"IoU at {mark:,}" for mark in MARKS]
    heads += ["final IoU, full resolution", "median seconds to CMA-ES's last IoU (reached)", "seconds"]
    lines = ["| kind | method | clips | " + " | ".join(heads) + " |", "| --- " * (len(heads) + 3) + "|"]
    kinds = sorted({run["kind"] for run in runs})
    for kind in [*kinds, "all"]:
        for method, clips in done.items():
            chosen = {clip: run for clip, run in clips.items() if kind in ("all", run["kind"])}
            if chosen:
                lines.append(_row(kind, method, chosen, targets))
    lines.append("")
    for method in (m for m in done if m.split("@")[0] == "hybrid"):
        both = [run for clip, run in done[method].items() if clip in targets]
        reached = [(iou_at(run, min(FEW, run["budget"])) or 0.0) >= targets[run["clip"]] for run in both]
        if both:
            share = f"{sum(reached)} of {len(both)} clips ({np.mean(reached):.0%})"
            lines.append(f"{method} with at most {FEW:,} rollouts reaches CMA-ES's last IoU on {share}")
    lines += _truths(runs)
    skipped = sorted({f"{run['method']}: {run['skipped']}" for run in runs if "skipped" in run})
    return "\n".join([*lines, *(f"left out: {text}" for text in skipped)])


def mean_curve(runs: list[dict], column: int, grid: np.ndarray) -> np.ndarray:
    """Mean IoU of the best candidates at each value of a column of the curves; the first row holds before it."""
    values = []
    for run in runs:
        curve = np.array(run["curve"], float)
        index = np.searchsorted(curve[:, column], grid, side="right") - 1
        values.append(curve[np.maximum(index, 0), 3])
    return np.mean(values, 0)


def plot(runs: list[dict], path: Path) -> None:
    """Writes a PNG: mean IoU against rollouts and against seconds, over the clips that every method has."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    done = _done(runs)
    common = sorted(set.intersection(*(set(clips) for clips in done.values()))) if done else []
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, column, label in zip(figure.subplots(1, 2), (0, 1), ("rollouts", "seconds"), strict=True):
        for method, clips in done.items():
            chosen = [clips[clip] for clip in common]
            ends = [run["curve"][-1][column] for run in chosen]
            if not ends:
                continue
            low = 20.0 if column == 0 else 0.1
            grid = np.geomspace(low, max(*ends, 2 * low), 300)
            style = ":" if method == "oracle" else "-"
            axes.plot(grid, mean_curve(chosen, column, grid), style, label=method)
        axes.set(
            xscale="log",
            xlabel=label,
            ylabel=f"mean IoU, {len(common)} clip{'s' * (len(common) != 1)}",
            ylim=(0.0, 1.02),
        )
        axes.grid(alpha=0.3)
    if common:
        axes.legend(loc="lower right")
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    write_atomic(path, lambda target: target.write(stream.getvalue()))
