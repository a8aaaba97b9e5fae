"""``refine describe``: what happens in a scene, in words."""

from __future__ import annotations

from pathlib import Path

import click

from mjx_refine.cli.types import FiniteFloat, Size
from mjx_refine.errors import InputError

_PATH = click.Path(path_type=Path)


@click.command(context_settings={"show_default": True})
@click.argument("scene", type=_PATH)
@click.option("--out", type=_PATH, help="Where to write the description; without it, it is printed.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, help="Which of the paraphrases.")
@click.option("--frames", type=click.IntRange(2, 100000), default=30, help="Frames.")
@click.option("--fps", type=FiniteFloat(0.1, 1e5), default=30.0, help="Frames a second.")
@click.option("--size", type=Size(), default="480x320", help="Of the pictures in which objects are seen or not.")
def describe(scene: Path, out: Path | None, seed: int, frames: int, fps: float, size) -> None:
    """Tells what happens in a scene's simulation: who is seen, moves, lands, collides and rests, when and where.

    Prints <think>...</think> and the scene in <answer>...</answer>, which every command reads as a scene file.
    """
    from mjx_refine.files import writable_file, write_text
    from mjx_refine.scene import load_scene

    if out is not None:
        writable_file(out)
    given = load_scene(scene)

    from mjx_refine.describe import describe as run

    try:
        description = run(given, frames, fps, size, seed)
    except InputError as error:
        raise InputError(f"{scene}: {error}") from error
    if out is None:
        click.echo(description.text, nl=False)
    else:
        write_text(out, description.text)
        click.echo(f"{out}: {len(description.statements)} statements about {len(given.objects)} objects")
