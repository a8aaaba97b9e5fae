"""``refine evaluate``: scores of one scene, or of a folder of predictions."""

from __future__ import annotations

import json
from pathlib import Path

import click

from mjx_refine.cli.types import FiniteFloat, Size
from mjx_refine.errors import InputError

_PATH = click.Path(path_type=Path)


class Counts(click.ParamType):
    """Whole numbers from 1, separated by commas."""

    name = "K,K"

    def convert(self, value, param, ctx):
        """A tuple of them, or a usage error."""
        if isinstance(value, tuple):
            return value
        parts = value.split(",")
        if not all(part.strip().isascii() and part.strip().isdigit() and 1 <= int(part) <= 4096 for part in parts):
            self.fail(f"{value!r}; expected whole numbers from 1 to 4096 with commas, such as 1,32", param, ctx)
        return tuple(dict.fromkeys(int(part) for part in parts))


@click.command(context_settings={"show_default": True})
@click.option("--scene", type=_PATH, help="The scene to judge.")
@click.option("--video", type=_PATH, help="The observation.")
@click.option("--truth", type=_PATH, help="The true scene, to compare parameters with.")
@click.option("--predictions", type=_PATH, help="Instead: a folder of sample files, NAME.yaml for every clip.")
@click.option(
    "--truths", type=_PATH, help="Their folder of true scenes, NAME.yaml, and clips, NAME.npz, where there are."
)
@click.option("--out", type=_PATH, help="Where to write the folder's table as CSV.")
@click.option("--best", type=Counts(), default="1,32", help="Of how many first samples the best is taken.")
@click.option("--size", type=Size(), default="480x320", help="Of clips simulated from truths without .npz.")
@click.option("--frames", type=click.IntRange(2, 100000), default=30, help="Ditto.")
@click.option("--fps", type=FiniteFloat(0.1, 1e5), default=30.0, help="Ditto.")
@click.pass_context
def evaluate(context: click.Context, scene, video, truth, predictions, truths, out, best, **simulated) -> None:
    """Scores a scene against an observation, and against the true scene; prints JSON.

    With --predictions and --truths: how right the samples of many clips are, as a table and as CSV.
    """
    if predictions is not None or truths is not None:
        idle = {"--scene": scene, "--video": video, "--truth": truth}
        _check(context, {"--predictions": predictions, "--truths": truths}, idle)
    if predictions is not None and truths is not None:
        _folder(predictions, truths, out, best, simulated)
        return
    _check(context, {"--scene": scene, "--video": video}, {"--out": out})
    _one(scene, video, truth)


def _check(context: click.Context, needed: dict, idle: dict) -> None:
    for name, value in needed.items():
        if value is None:
            raise click.UsageError(f"Missing option {name!r}", ctx=context)
    for name, value in idle.items():
        if value is not None:
            raise click.UsageError(f"{name} does not go with {' and '.join(needed)}; leave it out", ctx=context)


def _one(scene: Path, video: Path, truth: Path | None) -> None:
    from mjx_refine.observation import load_observation
    from mjx_refine.scene import load_scene

    judged, observation = load_scene(scene), load_observation(video)
    true = None if truth is None else load_scene(truth)

    from mjx_refine.evaluate import compare_scenes, evaluate_scene

    try:
        report = evaluate_scene(judged, observation)
    except InputError as error:
        message = str(error).removeprefix("<scene>: ")
        raise error if message.startswith(str(scene)) else InputError(f"{scene}: {message}") from error
    if true is not None:
        report["truth"] = compare_scenes(judged, true, str(truth))
    click.echo(json.dumps(report, indent=1))


def _folder(predictions: Path, truths: Path, out: Path | None, best: tuple[int, ...], simulated: dict) -> None:
    from mjx_refine.files import writable_file, write_text

    if out is not None:
        writable_file(out)

    from mjx_refine.evaluate import evaluate_folder

    evaluation = evaluate_folder(predictions, truths, best, **simulated)
    for clip, reason in evaluation.unread:
        click.echo(f"refine: {clip}: counted as wrong: {reason}", err=True)
    if out is not None:
        write_text(out, evaluation.csv())
    clips = len({row.clip for row in evaluation.rows})
    click.echo(evaluation.table() + f"{clips} clips" + ("" if out is None else f"; {out}"))
