"""``refine generate``: synthetic scenes with masks, flow, states and contacts, as shards."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from mjx_refine.generate import GenerateProgress, Summary

_PATH = click.Path(path_type=Path)
SPLITS = ("train", "compositional", "five", "six")


class Part(click.ParamType):
    """I/N: the I-th of N parts."""

    name = "I/N"

    def convert(self, value, param, ctx):
        """(i, n), or a usage error."""
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", value.strip())
        if match and 1 <= int(match[1]) <= int(match[2]):
            return int(match[1]), int(match[2])
        self.fail(f"{value!r}; expected I/N with 1 <= I <= N, such as 1/4 on the first of four machines", param, ctx)


@click.command(context_settings={"show_default": True})
@click.option("--count", type=click.IntRange(1, 10**8), help="Scenes, over all machines.")
@click.option("--out", type=_PATH, required=True, help="Folder for the shards.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, help="Of everything random.")
@click.option("--split", type=click.Choice(SPLITS), default="train", help="Training scenes, or one of the test sets.")
@click.option("--objects", type=click.IntRange(1, 12), help="The most in a training scene; 4 by default.")
@click.option("--rgb", is_flag=True, help="Also draw frames, and measure flow from them; takes OpenGL, and seconds.")
@click.option("--per-shard", type=click.IntRange(1, 10**6), default=100, help="Scenes in a shard.")
@click.option("--workers", type=click.IntRange(1, 4096), help="Processes; all cores by default.")
@click.option("--shard", type=Part(), default="1/1", help="This machine's part of the shards.")
@click.option("--device", type=click.Choice(("auto", "cpu", "gpu")), default="auto", help="Where pictures are drawn.")
@click.option("--resume", is_flag=True, help="Keep the shards in --out, write the missing ones.")
@click.option(
    "--unpack", type=_PATH, help="Instead: write the scenes and observations of a shard, or folder, as files."
)
def generate(count: int | None, out: Path, shard, workers, device: str, resume: bool, unpack, **options) -> None:
    """Generates scenes with masks, exact flow, states and contacts, in WebDataset shards.

    refine generate --count 10000 --out data

    refine generate --unpack data/train-000000.tar --out files
    """
    if unpack is not None:
        if count is not None:
            raise click.UsageError("--unpack beside --count; expected one of them; leave one out")
        from mjx_refine.generate import unpack as run

        click.echo(f"{out}: {run(unpack, out)} scenes, KEY.yaml for --init and KEY.npz for --video")
        return
    if count is None:
        raise click.UsageError("Missing option '--count'")
    from mjx_refine.generate import GenerateOptions, generate_scenes

    how = {"workers": workers, "shard": shard, "device": device, "resume": resume}
    summary = generate_scenes(count, out, GenerateOptions(**options), progress=_display(), **how)
    click.echo(told(summary))


def told(summary: Summary) -> str:
    """One line: how many, how fast, what passed, how large, where."""
    tally = summary.tally
    rates = ", ".join(f"{name} {told['rate']:.1%}" for name, told in tally.rates().items())
    return (
        f"{tally.records} scenes ({summary.made} new, {summary.rate:.1f} a second) of {tally.proposals} proposed; "
        f"passed: {rates}; {summary.bytes / max(tally.records, 1) / 1000:.0f} kB a scene; {summary.path}"
    )


def _display() -> GenerateProgress:
    """A bar where stderr is a terminal, else a display that shows nothing."""
    from mjx_refine.generate import GenerateProgress

    return _terminal_bar() if sys.stderr.isatty() else GenerateProgress()


def _terminal_bar() -> GenerateProgress:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from mjx_refine.generate import GenerateProgress

    class Bar(GenerateProgress):
        """Scenes written and time left."""

        def __init__(self):
            self.bar = Progress(
                BarColumn(bar_width=24),
                TextColumn("{task.completed}/{task.total} scenes"),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
                transient=True,
            )
            self.task = self.bar.add_task("", total=None)
            self.bar.start()

        def update(self, records: int, total: int, tally) -> None:
            self.bar.update(self.task, completed=records, total=total)

        def close(self) -> None:
            self.bar.stop()

    return Bar()
