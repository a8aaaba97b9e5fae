"""`python -m benchmarks.withheld make | answer | score`: the diagnosis' withheld exam."""

from __future__ import annotations

import json
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import click

from benchmarks.withheld import exam, plan
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
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True)
def make(seed: int, out: Path, only: str, jobs: int, **counts: int) -> None:
    """Makes clips and their keys; those that are there already are left alone."""
    try:
        listed = plan.orders(seed, counts, tuple(n for n in only.split(",") if n))
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
    }
    (out / "key").mkdir(exist_ok=True)
    write_text(out / "key" / "exam.json", json.dumps(summary, indent=1) + "\n")


if __name__ == "__main__":
    main()
