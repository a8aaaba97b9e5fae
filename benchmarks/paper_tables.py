"""Tables in the layout of Δynamics (CVPR 2026), with its figures beside ours.

    python -m benchmarks.paper_tables refinement OUT [OUT...]
    python -m benchmarks.paper_tables evaluation TRUTHS --predictions LABEL=FOLDER [...] [--best 1,32] [--csv table.csv]

`refinement` reads what `refine --jobs … --out OUT` wrote (OUT/NAME/result.json): the table on CLEVRER. `evaluation`
judges samples, or refined scenes, by the true scenes. In TRUTHS and in every FOLDER a clip is a file or a folder:

    TRUTHS/NAME.yaml and NAME.npz   (as `refine generate --unpack` writes them; without .npz the truth is simulated)
    TRUTHS/NAME/truth.yaml and flows.npz                             (sets of `benchmarks.blender`, `benchmarks.clips`)
    FOLDER/NAME.yaml   or   FOLDER/NAME/refined.yaml, best32.yaml, guess.yaml      (one: LABEL=FOLDER/*/guess.yaml)
"""

from __future__ import annotations

import csv
import io
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

from benchmarks.commands import exit_status
from benchmarks.processes import each
from mjx_refine.errors import InputError

PAPER_CLEVRER = {
    "paper: mean sample": {"iou": 0.30},
    "paper: best of 32 samples": {"iou": 0.38, "first_frame_iou": 0.76, "epe": 5.17},
    "paper: with CMA-ES": {"iou": 0.66, "first_frame_iou": 0.62, "epe": 0.11},
}
"""Published for CLEVRER, which is not these clips."""

SCORES = ("iou", "first_frame_iou", "epe", "first_frame_epe")
SCORE_HEADS = ("IoU", "first frame", "EPE px", "first frame")
HEADS = {
    "composition": "objects right",
    "iou": "IoU",
    "first_frame_iou": "first",
    "epe": "EPE px",
    "first_frame_epe": "first",
    "position": "position m",
    "velocity": "velocity m/s",
    "damping": "damping 1/s",
    "sliding_friction": "sliding",
    "rolling_friction": "rolling m",
}
FILES = ("refined.yaml", "best32.yaml", "guess.yaml", "truth.yaml")


@dataclass(frozen=True)
class Refinement:
    """One clip's scores before and after, as result.json has them, and the seconds it took."""

    clip: str
    before: dict[str, float]
    after: dict[str, float]
    seconds: float


def load_refinements(out: Path) -> list[Refinement]:
    """All finished refinements of a folder, by name.

    Raises:
      InputError: there are none, or one's result cannot be read.
    """
    paths = sorted(out.glob("*/result.json")) if out.is_dir() else []
    if not paths:
        raise InputError(
            f"{out}: no NAME/result.json in it; expected what `refine --jobs … --out` writes; name another"
        )
    found = []
    for path in paths:
        try:
            told = json.loads(path.read_text())
            before, after = ({key: _number(told[part][key]) for key in SCORES} for part in ("init", "refined"))
            found.append(Refinement(path.parent.name, before, after, float(told["seconds"]["total"])))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: cannot be read ({error!r}); refine that clip again") from error
    return found


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def means(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """The mean of each score over the rows where it is a number."""
    return {key: _mean([row[key] for row in rows]) for key in SCORES}


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return float(np.mean(known)) if known else math.nan


def refinement_table(runs: dict[str, list[Refinement]]) -> str:
    """The paper's table on CLEVRER and, of every run, the best sample and the refined scene; then what stands out."""
    rows = [[name, "", *_cells(figures, SCORES), ""] for name, figures in PAPER_CLEVRER.items()]
    notes = []
    for label, found in runs.items():
        before, after = [one.before for one in found], [one.after for one in found]
        seconds = f"{np.mean([one.seconds for one in found]):.0f}"
        rows.append([f"{label}: best sample", str(len(found)), *_cells(means(before), SCORES), ""])
        rows.append([f"{label}: refined", str(len(found)), *_cells(means(after), SCORES), seconds])
        for key, name in (("iou", "IoU"), ("first_frame_iou", "first frame's IoU")):
            lower = [one for one in found if one.after[key] < one.before[key]]
            notes.append(f"{label}: {name} lower than the sample's in {len(lower)} of {len(found)} clips")
        worst = min(found, key=lambda one: one.after["iou"])
        notes.append(f"{label}: least IoU {worst.after['iou']:.3f} ({worst.clip})")
    return markdown(["", "clips", *SCORE_HEADS, "s a clip"], rows) + "\n" + "\n".join(notes) + "\n"


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def _cells(figures: dict[str, float], keys: Sequence[str]) -> list[str]:
    values = [figures.get(key, math.nan) for key in keys]
    return [f"{value:.3f}" if math.isfinite(value) else "–" for value in values]


def collect(folder: Path, wanted: str = "") -> dict[str, Path]:
    """By name, the scene file of every clip: `NAME.yaml` (also .yml, .txt), or a file in the folder `NAME`.

    Args:
      folder: of the clips. wanted: name of that file; by default the first of FILES that is there.

    Raises:
      InputError: there is none.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected scenes as NAME.yaml or NAME/FILE.yaml; name another")
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            there = [path / name for name in ((wanted,) if wanted else FILES) if (path / name).is_file()]
            if there:
                found[path.name] = there[0]
        elif not wanted and path.suffix in (".yaml", ".yml", ".txt"):
            found[path.stem] = path
    if not found:
        expected = f"*/{wanted}" if wanted else "NAME.yaml or NAME/FILE.yaml"
        raise InputError(f"{folder}: no {expected} in it; expected a scene file a clip; name another folder")
    return found


def collect_truths(folder: Path) -> dict[str, Path]:
    """By name, the true scene of every clip: `NAME/truth.yaml`, where there are such, else `NAME.yaml`.

    Raises:
      InputError: there is none.
    """
    nested = folder.is_dir() and any(folder.glob("*/truth.yaml"))
    return collect(folder, "truth.yaml" if nested else "")


def judge(paths: tuple[Path, Path]) -> tuple[list, list[str]]:
    """Every sample of a clip, `mjx_refine.evaluate.Judged`, and why some could not be read.

    Args:
      paths: of the true scene (its clip beside it) and of the samples.

    Raises:
      InputError: the truth or its clip cannot be read.
    """
    from mjx_refine.evaluate import Judged, judge_samples
    from mjx_refine.observation import load_observation
    from mjx_refine.scene import load_scene, load_scenes
    from mjx_refine.simulate import simulate

    true, told = paths
    truth, seen = load_scene(true), true.with_suffix(".npz")
    if true.name == "truth.yaml":
        seen = true.with_name("flows.npz")
        if not seen.exists():
            raise InputError(f"{seen}: not there yet; expected the clip's observation; measure it first")
    observation = load_observation(seen) if seen.exists() else simulate(truth)
    try:
        samples = load_scenes(told)
        return judge_samples(samples, truth, observation), [problem.reason for problem in samples.problems]
    except InputError as error:  # nothing in the file can be used: one wrong answer
        return [Judged(0)], [str(error)]


def evaluate(truths: dict[str, Path], predictions: dict[str, Path], best: Sequence[int], processes: int = 1):
    """`mjx_refine.evaluate.Evaluation` of the clips that both have.

    Raises:
      InputError: no clip has both, or a truth or clip cannot be read.
    """
    from mjx_refine.evaluate import Evaluation, Row, best_of

    names = sorted(truths.keys() & predictions.keys())
    if not names:
        some = next(iter(predictions.values()))
        raise InputError(f"{some}: no truth of that name; expected clips named alike; name other folders")
    every = list(zip(names, each(judge, [(truths[n], predictions[n]) for n in names], processes), strict=True))
    rows = [Row(name, count, len(judged), best_of(judged, count)) for count in best for name, (judged, _) in every]
    return Evaluation(tuple(rows), tuple((name, reason) for name, (_, reasons) in every for reason in reasons))


def evaluation_table(evaluations: dict) -> str:
    """A row a predictor and K: means over the clips; errors of parameters only where the objects are the right ones."""
    rows = []
    for label, evaluation in evaluations.items():
        clips = len({row.clip for row in evaluation.rows})
        for count, figures in evaluation.means().items():
            most = max(row.samples for row in evaluation.rows)
            if count == 1 or most > 1:
                rows.append(
                    [f"{label}, Best@{count}" if most > 1 else label, str(clips), *_cells(figures, list(HEADS))]
                )
    return markdown(["", "clips", *HEADS.values()], rows)


def evaluation_csv(evaluations: dict) -> str:
    """Every clip's row of every predictor."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["predictor", "clip", "best_at", "samples", "index", *HEADS])
    for label, evaluation in evaluations.items():
        for row in evaluation.rows:
            values = [getattr(row.judged, name) for name in HEADS]
            told = [f"{value:.6f}" if math.isfinite(value) else "" for value in values]
            writer.writerow([label, row.clip, row.best_at, row.samples, row.judged.index, *told])
    return stream.getvalue()


@click.group(help=__doc__)
def main() -> None:
    """The group of commands."""


@main.command()
@click.argument("outs", nargs=-1, required=True, type=click.Path(path_type=Path))
def refinement(outs: tuple[Path, ...]) -> None:
    """The table on CLEVRER, with the refinements in each OUT."""
    click.echo(refinement_table({out.name: load_refinements(out) for out in outs}), nl=False)


@main.command()
@click.argument("truths", type=click.Path(path_type=Path))
@click.option("--predictions", multiple=True, required=True, help="LABEL=FOLDER, or LABEL=FOLDER/*/FILE.")
@click.option("--best", default="1,32", show_default=True, help="Of how many first samples the best is taken.")
@click.option("--csv", "table", type=click.Path(path_type=Path), help="Where to write every clip's row.")
@click.option("--processes", type=click.IntRange(1, 1024), default=1, show_default=True)
def evaluation(truths: Path, predictions: tuple[str, ...], best: str, table: Path | None, processes: int) -> None:
    """How right predictions are: objects, pictures, parameters."""
    from mjx_refine.files import writable_file, write_text

    if not all(part.isascii() and part.isdigit() and 1 <= int(part) <= 4096 for part in best.split(",")):
        raise InputError(f"--best {best}: expected whole numbers from 1 with commas, such as 1,32; correct it")
    if table is not None:
        writable_file(table)
    counts, known = list(dict.fromkeys(int(part) for part in best.split(","))), collect_truths(truths)
    found = {}
    for text in predictions:
        label, parted, place = text.partition("=")
        if not parted or not label or label in found:
            raise InputError(f"--predictions {text}: expected LABEL=FOLDER, each label once; correct it")
        folder, starred, file = place.partition("/*/")
        found[label] = evaluate(known, collect(Path(folder), file if starred else ""), counts, processes)
        for clip, reason in found[label].unread:
            click.echo(f"{label}: {clip}: counted as wrong: {reason}", err=True)
    click.echo(evaluation_table(found), nl=False)
    if table is not None:
        write_text(table, evaluation_csv(found))


def run(arguments: list[str] | None = None) -> int:
    """The command; its exit status: 0 done, 2 wrong input, with one line on standard error."""
    return exit_status(main, "paper_tables", arguments)


if __name__ == "__main__":
    sys.exit(run())
