"""The commands. Each loads what it needs when it runs, so that ``--help`` answers at once."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import click

from mjx_refine.cli.describe import describe
from mjx_refine.cli.diagnose import diagnose
from mjx_refine.cli.edit import edit
from mjx_refine.cli.evaluate import evaluate
from mjx_refine.cli.generate import generate
from mjx_refine.cli.many import ENGINES, refine_many_command
from mjx_refine.cli.types import FiniteFloat, Size
from mjx_refine.errors import InputError

_PATH = click.Path(path_type=Path)
BACKENDS = ("auto", "mjx", "warp", "mujoco")
RESULTS = ("refined.yaml", "result.json", "history.csv", "report.html", "overlay.gif", "checkpoint.npz")
OPTIMIZERS = ("cmaes", "gradient", "hybrid")
DERIVATIVES = ("auto", "differences", "autodiff")
SOLVERS = ("lm", "adam", "gauss-newton", "levenberg-marquardt")


@click.group(invoke_without_command=True, no_args_is_help=False, context_settings={"show_default": True})
@click.option(
    "--init",
    type=_PATH,
    multiple=True,
    help="Starting samples (YAML): one scene, or the 32 of a language model; again, with --video, for another clip.",
)
@click.option(
    "--video", type=_PATH, multiple=True, help="Observation (npz with flow, masks, fps); see `refine observe`."
)
@click.option("--jobs", type=_PATH, help="Many clips: a list of jobs (YAML), each with init, video and a name.")
@click.option(
    "--out", type=_PATH, default=Path("refined"), help="Folder for the results; of many clips, with a folder each."
)
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, help="Of everything random.")
@click.option("--population", type=click.IntRange(4, 65536), default=128, help="Candidates a generation.")
@click.option(
    "--iterations", type=click.IntRange(1, 10**6), default=100, help="Generations; times population: rollouts."
)
@click.option("--optimizer", type=click.Choice(OPTIMIZERS), default="hybrid", help="How to search.")
@click.option("--solver", type=click.Choice(SOLVERS), default="lm", help="Of each stage of least squares.")
@click.option("--derivatives", type=click.Choice(DERIVATIVES), default="auto", help="Of least squares.")
@click.option("--backend", type=click.Choice(BACKENDS), default="auto", help="Which engine simulates the search.")
@click.option("--resolution", type=Size(), help="Of the search's pictures; the default is about 160 wide.")
@click.option(
    "--refits", type=click.IntRange(0, 1000), default=6, help="Fits around the solution, for intervals; 0: none."
)
@click.option("--resume", is_flag=True, help="Go on from the checkpoint in --out; of many clips, skip finished ones.")
@click.option("--workers", type=click.IntRange(1, 4096), help="Of many clips, how many at once; all cores by default.")
@click.option("--engine", type=click.Choice(ENGINES), default="processes", help="What works through many clips.")
@click.option("--address", help="Of a Ray cluster, for --engine ray.")
@click.version_option(package_name="mjx-refine", prog_name="refine")
@click.pass_context
def app(context: click.Context, init, video, jobs, out, resume, workers, engine, address, **options) -> None:
    """Refines a rough scene until its MuJoCo simulation replays a video.

    refine --init best32.yaml --video flows.npz --out refined
    """
    logging.basicConfig(level=logging.INFO if sys.stderr.isatty() else logging.WARNING, format="%(message)s")
    if context.invoked_subcommand is not None:
        if init or video or jobs:
            raise click.UsageError("--init, --video and --jobs stand after the command's name")
        return
    _check_call(context, init, video, jobs)
    if jobs is None and len(init) == 1 and engine == "processes":
        _refine(init[0], video[0], out, resume, options)
    else:
        how = {"workers": workers, "resume": resume, "engine": engine, "address": address}
        refine_many_command(init, video, jobs, out, options, **how)


def _check_call(context: click.Context, init: Sequence[Path], video: Sequence[Path], jobs: Path | None) -> None:
    """Refuses a call whose options do not go together."""
    if jobs is not None:
        if init or video:
            raise click.UsageError("--jobs beside --init or --video; expected one of them; leave one out", ctx=context)
        return
    for name, values in (("--init", init), ("--video", video)):
        if not values:
            raise click.UsageError(f"Missing option {name!r}", ctx=context)
    if len(init) != len(video):
        raise click.UsageError(
            f"{len(init)} --init and {len(video)} --video; expected as many of each, in the same order; "
            "give a --video after every --init",
            ctx=context,
        )


def _refine(init: Path, video: Path, out: Path, resume: bool, options: dict) -> None:
    from mjx_refine.files import remove_stale_parts, writable_directory
    from mjx_refine.observation import load_observation
    from mjx_refine.scene import load_scenes

    writable_directory(out, RESULTS)
    samples = load_scenes(init)
    observation = load_observation(video)

    # Importing JAX takes seconds; bad input is told before.
    from mjx_refine.cli.display import display
    from mjx_refine.report import warnings, write_result
    from mjx_refine.search import Options, refine

    remove_stale_parts(out)
    for problem in samples.problems:
        click.echo(f"refine: left out: {problem.reason}", err=True)
    progress = display()
    try:
        result = refine(samples, observation, Options(**options), progress=progress, folder=out, resume=resume)
    finally:
        progress.close()
    write_result(out, result, observation)
    before, after = result.init.scores, result.refined.scores
    click.echo(
        f"IoU {before.iou[0]:.3f} -> {after.iou[0]:.3f}, first frame {before.first_frame_iou[0]:.3f} -> "
        f"{after.first_frame_iou[0]:.3f}, EPE {before.epe[0]:.3f} -> {after.epe[0]:.3f} px, "
        f"{result.seconds['total']:.0f} s ({result.backend}); {out}/report.html"
    )
    for warning in warnings(result, observation):
        click.echo(f"refine: {warning}", err=True)


@contextlib.contextmanager
def _about(path: Path) -> Iterator[None]:
    """Names the file in errors on what was read from it."""
    try:
        yield
    except InputError as error:
        message = str(error).removeprefix("<scene>: ")
        raise error if message.startswith(str(path)) else InputError(f"{path}: {message}") from error


@app.command()
@click.argument("scene", type=_PATH)
@click.option("--out", type=_PATH, required=True, help="Where to write flows.npz.")
@click.option("--size", type=Size(), default="480x320", help="Of the pictures.")
@click.option("--frames", type=click.IntRange(2, 100000), default=30, help="Frames.")
@click.option("--fps", type=FiniteFloat(0.1, 1e5), default=30.0, help="Frames a second.")
def simulate(scene: Path, out: Path, size, frames: int, fps: float) -> None:
    """Simulates a scene and writes its masks and exact flow."""
    from mjx_refine.files import writable_file
    from mjx_refine.observation import save_observation
    from mjx_refine.scene import load_scene
    from mjx_refine.simulate import simulate as run

    writable_file(out)
    given = load_scene(scene)
    with _about(scene):
        observation = run(given, size=size, frames=frames, fps=fps)
    save_observation(out, observation)
    click.echo(f"{out}: {frames} frames of {size[0]}x{size[1]} at {fps:g} fps")


@app.command()
@click.argument("clip", type=_PATH)
@click.option("--out", type=_PATH, required=True, help="Where to write flows.npz; a preview picture goes beside it.")
@click.option("--fps", type=float, help="True frames a second (slow motion); default: the file's.")
@click.option("--start", type=float, default=0.0, help="First second of the FILE's time to use.")
@click.option("--end", type=float, help="Second of the FILE's time to stop at.")
@click.option("--stride", type=int, default=1, help="Keep every N-th frame.")
@click.option("--size", type=Size(), help="Of the pictures; default: the file's.")
@click.option("--masks", type=_PATH, help="Folder with one PNG of instance ids a frame, instead of our own masks.")
def observe(clip: Path, out: Path, fps, start: float, end, stride: int, size, masks) -> None:
    """Turns a video into an observation: optical flow and masks of what moves."""
    from mjx_refine.observe import observe_command

    observe_command(
        clip, out, echo=click.echo, fps=fps, start=start, end=end, stride=stride, size=size, masks_dir=masks
    )


@app.command()
@click.argument("video", type=_PATH)
@click.option("--out", type=_PATH, required=True, help="Where to write the samples (YAML).")
@click.option("--samples", type=click.IntRange(1, 4096), default=32, help="How many.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, help="Of everything random.")
def guess(video: Path, out: Path, samples: int, seed: int) -> None:
    """Makes starting samples from an observation alone, without a language model."""
    from mjx_refine.files import writable_file
    from mjx_refine.observation import load_observation
    from mjx_refine.scene import save_scenes

    writable_file(out)
    observation = load_observation(video)

    from mjx_refine.guess import guess_scenes

    with _about(video):
        scenes = guess_scenes(observation, samples, seed)
    save_scenes(out, scenes)
    click.echo(f"{out}: {len(scenes)} samples, the most likely first")


@app.command()
@click.argument("scene", type=_PATH)
@click.option("--out", type=_PATH, required=True, help="Where to write the MuJoCo XML.")
@click.option("--fps", type=FiniteFloat(0.1, 1e5), default=30.0, help="Frames a second; the time step is 1 / (8 fps).")
def export(scene: Path, out: Path, fps: float) -> None:
    """Writes a scene as MuJoCo XML with a keyframe, for `python -m mujoco.viewer --mjcf=scene.xml`."""
    from mjx_refine.export import save_export
    from mjx_refine.files import writable_file
    from mjx_refine.scene import load_scene

    writable_file(out)
    given = load_scene(scene)
    with _about(scene):
        save_export(out, given, fps)
    click.echo(f"{out}: play it with `python -m mujoco.viewer --mjcf={out}` (load key 0 for the velocities)")


app.add_command(diagnose)
app.add_command(describe)
app.add_command(edit)
app.add_command(evaluate)
app.add_command(generate)
