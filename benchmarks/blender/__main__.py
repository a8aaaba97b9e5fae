"""`python -m benchmarks.blender`: a CLEVRER-like set made by Blender, and its refinement.

python -m benchmarks.blender make --count 100 --seed 7 --out SET --bpy BPY_PYTHON   # needs Blender and PyBullet
python -m benchmarks.blender observe SET --processes 64                             # from here on neither
python -m benchmarks.blender guess SET --processes 64
python -m benchmarks.blender refine SET --samples perturbed --optimizer cmaes --out OUT --workers 64
python -m benchmarks.paper_tables refined OUT --truths SET
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import click

from benchmarks.commands import exit_status
from mjx_refine.errors import InputError

_SET = click.argument("folder", type=click.Path(path_type=Path))
_PROCESSES = click.option("--processes", type=click.IntRange(1, 1024), default=1, show_default=True)
_BPY = click.option("--bpy", default=sys.executable, help="The Python that has bpy (requirements.txt); this one.")
_OUT = click.option("--out", type=click.Path(path_type=Path), required=True)
_SEED = click.option("--seed", type=click.IntRange(0), required=True, help="The same seed gives the same clips.")


@click.group(help=__doc__)
def main() -> None:
    """The group of commands."""


@main.command()
@click.option("--count", type=click.IntRange(1, 9999), default=100, show_default=True)
@_SEED
@_OUT
@_BPY
def make(count: int, seed: int, out: Path, bpy: str) -> None:
    """Clips of one second with 1, 2, 3, 4 objects in turn; those that are there already are left alone."""
    from benchmarks.blender.clip import make_film
    from benchmarks.blender.folders import write_film
    from benchmarks.blender.studio import Studio

    with Studio(bpy) as studio:
        for index in range(count):
            objects = index % 4 + 1
            folder = out / f"{index:03d}_{objects}"
            if (folder / "meta.json").exists():
                continue
            start = time.perf_counter()
            film = make_film(studio, seed, index, objects)
            write_film(folder, film, 1000 * seed + index)
            said = f"samples' IoU {film.guesses.iou.mean():.3f} mean, {film.guesses.iou.max():.3f} best"
            click.echo(f"{folder}: {len(film.collisions)} collisions, {said}, {time.perf_counter() - start:.0f} s")


@main.command()
@click.option("--count", type=click.IntRange(1, 9999), default=2, show_default=True)
@_SEED
@_OUT
@_BPY
def clevrer(count: int, seed: int, out: Path, bpy: str) -> None:
    """Instead: videos of five seconds in CLEVRER's format, for `python -m benchmarks.clevrer`."""
    from benchmarks.blender.clevrer import make_video
    from benchmarks.blender.studio import Studio

    with Studio(bpy) as studio:
        for number in range(count):
            start = time.perf_counter()
            said = make_video(studio, seed, number, out)
            click.echo(f"{said}, {time.perf_counter() - start:.0f} s")


@main.command()
@_SET
@_PROCESSES
def observe(folder: Path, processes: int) -> None:
    """Measures the flow of every clip by OpenCV: flows.npz."""
    from benchmarks.blender import folders
    from benchmarks.processes import each

    for name in each(folders.observe, folders.clip_folders(folder), processes):
        click.echo(name)


@main.command()
@_SET
@_PROCESSES
def guess(folder: Path, processes: int) -> None:
    """Makes 32 samples of every clip from its observation alone: guess.yaml."""
    from benchmarks.blender import folders
    from benchmarks.processes import each

    for name in each(folders.guess, folders.clip_folders(folder), processes):
        click.echo(name)


@main.command()
@_SET
@_OUT
@click.option("--samples", type=click.Choice(["perturbed", "guess"]), default="perturbed", show_default=True)
@click.option("--optimizer", type=click.Choice(["cmaes", "gradient", "hybrid"]), default="hybrid", show_default=True)
@click.option("--population", type=click.IntRange(4, 65536), default=128, show_default=True)
@click.option("--iterations", type=click.IntRange(1, 100000), default=100, show_default=True)
@click.option("--only", default="", help="Names of clips, with commas.")
@click.option("--workers", type=click.IntRange(1, 4096), help="By default one a core.")
def refine(folder: Path, out: Path, samples: str, only: str, workers: int | None, **options) -> int:
    """Refines every clip with C MuJoCo, as `refine --jobs … --resume` does; finished ones are left alone."""
    from benchmarks.blender.folders import jobs
    from mjx_refine import Options, refine_many
    from mjx_refine.many import ManyProgress, Outcome

    class Told(ManyProgress):
        """A line a clip."""

        def ended(self, outcome: Outcome) -> None:
            after = "" if outcome.iou_after is None else f"IoU {outcome.iou_before:.3f} -> {outcome.iou_after:.3f}"
            click.echo(f"{outcome.name}: {outcome.status} {after} {outcome.reason}".rstrip())

    wanted = set(only.split(",")) if only else None
    chosen = [job for job in jobs(folder, samples) if wanted is None or job.name in wanted]
    if not chosen:
        raise InputError(f"--only {only}: no such clip in {folder}; name its folders")
    many = refine_many(
        chosen, Options(backend="mujoco", **options), out=out, workers=workers, resume=True, progress=Told()
    )
    return many.status


def run(arguments: list[str] | None = None) -> int:
    """The command; its exit status: 0 done, 2 wrong input, with one line on standard error, 1 what `refine` says."""
    return exit_status(main, "blender", arguments)


if __name__ == "__main__":
    sys.exit(run())
