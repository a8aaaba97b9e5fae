"""`python -m benchmarks.withheld make | answer | left | foretold | score`: the diagnosis' withheld exam."""

from __future__ import annotations

import json
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import click
import cv2

from benchmarks.withheld import answer as answers_
from benchmarks.withheld import exam, foretold, plan
from benchmarks.withheld import left as lefts
from benchmarks.withheld import score as scores
from benchmarks.withheld import sheet as sheets
from mjx_refine.files import write_text

COUNTS = {"one": 36, "two": 12, "none": 14, "withheld": 8, "strange": 8}


@click.group()
def main() -> None:
    """Makes an exam, has it answered, and scores the answers."""


@main.command()
@click.option("--seed", type=int, required=True, help="The same seed gives the same exam.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the exam.")
@click.option("--one", type=click.IntRange(0), default=COUNTS["one"], show_default=True)
@click.option("--two", type=click.IntRange(0), default=COUNTS["two"], show_default=True)
@click.option("--none", type=click.IntRange(0), default=COUNTS["none"], show_default=True)
@click.option("--withheld", type=click.IntRange(0), default=COUNTS["withheld"], show_default=True)
@click.option("--strange", type=click.IntRange(0), default=COUNTS["strange"], show_default=True)
@click.option("--only", default="", help="Effects to keep to, parted by commas.")
@click.option("--clips", type=click.IntRange(1, 9), default=1, show_default=True, help="Of each set-up.")
@click.option("--left", type=click.FloatRange(0), default=0.0, help="Px that a refit must leave of every effect.")
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True)
def make(seed: int, out: Path, only: str, clips: int, left: float, jobs: int, **counts: int) -> None:
    """Makes clips and their keys; those that are there already are left alone."""
    try:
        listed = plan.orders(seed, counts, tuple(n for n in only.split(",") if n), clips, left)
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    missing = [(i, o) for i, o in enumerate(listed) if not (out / "key" / f"{i:03d}.json").exists()]
    out.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for done in as_completed([pool.submit(exam.write_clip, out, i, o) for i, o in missing]):
            click.echo(done.result())
    summary = {
        "seed": seed,
        "clips": len(listed),
        "splits": dict(Counter(o.split for o in listed)),
        "effects": dict(Counter(e for o in listed for e in o.effects)),
        "flow": dict(Counter(o.flow for o in listed)),
        "left": left,
    }
    (out / "key").mkdir(exist_ok=True)
    write_text(out / "key" / "exam.json", json.dumps(summary, indent=1) + "\n")


@main.command()
@click.argument("folder", metavar="EXAM", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the answers.")
@click.option("--alone", is_flag=True, help="Of several clips of a set-up, the first by itself.")
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True)
def answer(folder: Path, out: Path, alone: bool, jobs: int) -> None:
    """Diagnoses every clip that has no answer yet."""
    failed = 0
    for result in answers_.answer(folder, out, jobs, alone=alone):
        failed += result["status"] != 0
        click.echo(f"{result['clip']}: exit {result['status']}, {result['seconds']} s, {result['peak_mb']} MB")
    if failed:
        raise click.ClickException(f"{failed} diagnoses failed; see log.txt in their folders, and call again")


@main.command("left")
@click.argument("folder", metavar="EXAM", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True)
def measure_left(folder: Path, jobs: int) -> None:
    """Measures what a refit of the scene leaves of every effect's size, into left.json; goes on where it stopped."""
    faults = 0
    try:
        for one in lefts.measure(folder, jobs):
            faults += "fault" in one
            each = [f"{e['effect']} {e['px']:.1f} px, {e['px_left']:.1f} left" for e in one.get("effects", ())]
            click.echo(f"{one['clip']}: {one.get('fault') or ', '.join(each)} ({one.get('seconds', 0):.0f} s)")
    except ValueError as error:
        raise click.ClickException(str(error)) from error
    if faults:
        raise click.ClickException(f"{faults} clips cannot be made again here; measure them where the exam was made")


@main.command()
@click.argument("folder", metavar="EXAM", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.argument("answers", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--out", type=click.Path(path_type=Path), default=None, help="Also write the tables to this file.")
def score(folder: Path, answers: Path, out: Path | None) -> None:
    """Prints the results; refuses until every clip has its answer."""
    try:
        text = scores.report(scores.marks(folder, answers))
    except ValueError as error:
        raise click.ClickException(str(error)) from error
    click.echo(text)
    if out is not None:
        write_text(out, text)


@main.command("foretold")
@click.argument("folder", metavar="EXAM", type=click.Path(path_type=Path, exists=True, file_okay=False))
def foretold_errors(folder: Path) -> None:
    """Prints how far predictions with the key's own numbers are off in the first frames: an open exam's, for development."""
    click.echo("clip: centroid px (worst), radius px, flow px/frame; effects")
    for one in foretold.foretold(folder):
        numbers = f"{one.centroid:.2f} ({one.worst:.2f}), {one.radius:.2f}, {one.flow:.2f}"
        click.echo(f"{one.clip}: {numbers}; {' and '.join(one.effects) or 'none'}")


@main.command()
@click.argument("folder", metavar="EXAM", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="A PNG.")
@click.option("--first", type=click.IntRange(0), default=0, show_default=True)
@click.option("--count", type=click.IntRange(1), default=12, show_default=True)
def sheet(folder: Path, out: Path, first: int, count: int) -> None:
    """Draws a contact sheet, titled from the key, for a look by eye."""
    numbers = [path.name for path in answers_.clips(folder)][first : first + count]
    if not numbers:
        raise click.UsageError(f"--first {first}: the exam has fewer clips")
    cv2.imwrite(str(out), sheets.sheet(folder, numbers))


if __name__ == "__main__":
    main()
