"""`python -m benchmarks.clips --out DIR --seed N [--count 24]`: a set of benchmark clips, a folder each."""

from __future__ import annotations

import time
from pathlib import Path

import click
import cv2

from benchmarks.clips.folders import film, plan, write_clip


@click.command()
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the set.")
@click.option("--seed", type=int, required=True, help="The same seed gives the same clips.")
@click.option("--count", type=click.IntRange(1, 999), default=24, show_default=True)
@click.option(
    "--broken", type=click.IntRange(0, 31), default=0, show_default=True, help="Samples cut off in each file."
)
def main(out: Path, seed: int, count: int, broken: int) -> None:
    """Writes clips with their rough samples; clips that are there already are left alone."""
    cv2.setNumThreads(1)
    for index, (kind, objects) in enumerate(plan(count)):
        folder = out / f"{index:02d}_{objects}_{kind}"
        if (folder / "meta.json").exists():
            continue
        start = time.perf_counter()
        clip, guesses = film(1000 * seed + index, kind, objects)
        write_clip(folder, clip, guesses, broken=broken)
        click.echo(
            f"{folder}: samples' IoU {guesses.iou.mean():.3f} mean, {guesses.iou.max():.3f} best, "
            f"{time.perf_counter() - start:.0f} s"
        )


if __name__ == "__main__":
    main()
