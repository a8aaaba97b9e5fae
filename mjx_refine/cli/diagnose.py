"""``refine diagnose``: what a simulation lacks to replay a clip."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mjx_refine.errors import InputError

if TYPE_CHECKING:
    from mjx_refine.diagnosis.fits.store import Store

_PATH = click.Path(path_type=Path)
RESULTS = ("diagnosed.yaml", "report.html", "diagnosis.json")
UNFINISHED = "unfinished"
"""Folder in the results' for fits of a run that is not over."""


@click.command()
@click.option(
    "--init", type=_PATH, multiple=True, help="The refined scene (YAML); of several samples, the best is taken."
)
@click.option(
    "--video", type=_PATH, multiple=True, help="Its clip (npz); give --init and --video again for another clip."
)
@click.option(
    "--poses",
    type=_PATH,
    multiple=True,
    help="Measured poses (npz with time, pos, quat) instead of a clip; of several recordings give one each, and one --init "
    "for all or one each.",
)
@click.option("--out", type=_PATH, required=True, help="Folder for the results.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True, help="Of everything random.")
@click.option("--without", multiple=True, metavar="EFFECT", help="An effect to leave out; may be given again.")
@click.option("--threads", type=click.IntRange(1, 4096), help="Cores at work; all by default. The answer is the same.")
@click.option("--resume", is_flag=True, help="Go on from what an interrupted run of this very call left in --out.")
@click.pass_context
def diagnose(context: click.Context, init, video, poses, out: Path, seed: int, without, threads, resume: bool) -> None:
    """Says what a scene's simulation lacks to replay a clip: where they part, which effect it is, how far it helps.

    refine diagnose --init refined.yaml --video flows.npz --out diagnosis

    refine diagnose --init scene.yaml --poses poses.npz --out diagnosis

    Several clips or recordings of one set-up share objects, effects and camera; some are fitted, the others judged:

    refine diagnose --init scene.yaml --poses a.npz --poses b.npz --poses c.npz --out diagnosis
    """
    _check_call(context, init, video, poses)
    withheld = _withheld(without)
    from mjx_refine.files import remove_stale_parts, writable_directory

    writable_directory(out, RESULTS)
    inputs = Inputs.read(init, video, poses)
    call = inputs.call(seed, withheld)
    if resume and _done(out, call["digest"]):
        click.echo(f"{out / RESULTS[-1]}: the diagnosis of this call is there already; nothing to do")
        return
    remove_stale_parts(out)
    store = unfinished(out, call["digest"], resume)
    steps = step_display()
    try:
        diagnosis, call, clip = _diagnosed(inputs, call, withheld, seed, threads, steps.told, store)
        steps.told("report")
        from mjx_refine.report.diagnosis_files import write_diagnosis
        from mjx_refine.report.diagnosis_words import in_words

        write_diagnosis(out, diagnosis, clip, call)
        store.clear()
    except KeyboardInterrupt:
        steps.close()
        kept = f" with --resume: {store.kept + store.recalled} fits are kept" if store.kept + store.recalled else ""
        click.echo(f"refine: interrupted; run the same call again{kept}", err=True)
        raise click.exceptions.Exit(1) from None
    finally:
        steps.close()
    click.echo("\n".join([*in_words(diagnosis), f"{out}/report.html"]))
    for note in diagnosis.notes:
        click.echo(f"refine: {note}", err=True)


def _check_call(context: click.Context, init: Sequence[Path], video: Sequence[Path], poses: Sequence[Path]) -> None:
    """Refuses a call whose options do not go together."""
    if not init:
        raise click.UsageError("Missing option '--init'", ctx=context)
    if poses and video:
        raise click.UsageError("--poses and --video: expected one of them; leave one out", ctx=context)
    if not poses and not video:
        raise click.UsageError("Missing option '--video' (or '--poses')", ctx=context)
    if poses and len(init) not in (1, len(poses)):
        raise click.UsageError(
            f"{len(init)} --init and {len(poses)} --poses; expected one of each, in the same order, or one --init for all; "
            "leave some out",
            ctx=context,
        )
    if not poses and len(init) != len(video):
        raise click.UsageError(
            f"{len(init)} --init and {len(video)} --video; expected as many of each, in the same order; "
            "give a --video after every --init",
            ctx=context,
        )


def _withheld(names: Sequence[str]) -> tuple[str, ...]:
    """The names once each, in their order.

    Raises:
      InputError: the catalogue has no such effect.
    """
    from mjx_refine.effects import kind_of

    return tuple(dict.fromkeys(kind_of(name, "--without").name for name in names))


@dataclasses.dataclass(frozen=True)
class Inputs:
    """What was read.

    Attributes:
      init: the scenes' files.
      samples: what they hold, see ``mjx_refine.scene.Samples``.
      video: the clips' files.
      observations: the clips.
      poses: files of measured poses.
      recorded: the measured poses.
    """

    init: tuple[Path, ...]
    samples: tuple
    video: tuple[Path, ...]
    observations: tuple
    poses: tuple[Path, ...]
    recorded: tuple

    @classmethod
    def read(cls, init: Sequence[Path], video: Sequence[Path], poses: Sequence[Path]) -> Inputs:
        """Reads scenes, clips and poses, and tells of samples that were left out.

        Raises:
          InputError: a file is missing or wrong.
        """
        from mjx_refine.observation import load_observation
        from mjx_refine.scene import load_scenes

        samples = tuple(load_scenes(path) for path in init)
        observations = tuple(load_observation(path) for path in video)
        recorded: tuple = ()
        if poses:
            from mjx_refine.diagnosis import load_poses

            recorded = tuple(load_poses(path) for path in poses)
        for one in samples:
            for problem in one.problems:
                click.echo(f"refine: left out: {problem.reason}", err=True)
        return cls(tuple(init), samples, tuple(video), observations, tuple(poses), recorded)

    def call(self, seed: int, without: tuple[str, ...]) -> dict[str, Any]:
        """What was asked for, with a fingerprint of the files and of the options that change the result."""
        paths = [*self.init, *self.video, *self.poses]
        state = hashlib.sha256(repr((len(self.init), seed, sorted(without))).encode())
        for path in paths:
            with open(path, "rb") as stream:
                state.update(hashlib.file_digest(stream, "sha256").digest())
        call: dict[str, Any] = {"init": [path.name for path in self.init], "video": [path.name for path in self.video]}
        if self.poses:
            names = [path.name for path in self.poses]
            call["poses"] = names[0] if len(names) == 1 else names
        return {**call, "seed": seed, "without": list(without), "digest": state.hexdigest()}


def _done(out: Path, digest: str) -> bool:
    """Whether ``out`` holds the diagnosis of this very call.

    Raises:
      InputError: it holds another's, or one that cannot be read.
    """
    path = out / RESULTS[-1]
    if not all((out / name).is_file() for name in RESULTS):
        return False
    try:
        found = json.loads(path.read_text())["call"]["digest"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a readable diagnosis ({error}); run again without --resume") from error
    if found != digest:
        raise InputError(
            f"{path}: made for another input or other options; expected those of this call; "
            "repeat the first call's arguments, or run without --resume"
        )
    return True


def unfinished(out: Path, digest: str, resume: bool) -> Store:
    """Where this call's finished fits are kept: those of an interrupted run of the same call, or none.

    Fits of another call, or of other versions of what makes them, are of no use and removed.

    Args:
      out: folder of the results.
      digest: of the call.
      resume: whether to go on from what is there.
    """
    from mjx_refine.diagnosis.fits.store import Store, versions

    folder = out / UNFINISHED
    key = hashlib.sha256(f"{digest} {versions()}".encode()).hexdigest()[:16]
    if folder.is_dir():
        for other in folder.iterdir():
            if other.is_dir() and not (resume and other.name == key):
                shutil.rmtree(other, ignore_errors=True)
    return Store(folder / key)


def _diagnosed(inputs: Inputs, call: dict[str, Any], without, seed: int, threads: int | None, told, store):
    """The diagnosis, the call with the samples that were taken, and the clip to show (None with poses)."""
    from mjx_refine import diagnosis

    options = {"without": without, "seed": seed, "threads": threads, "told": told, "store": store}
    if inputs.poses:
        scenes = [_only(samples) for samples in inputs.samples]
        if len(inputs.recorded) == 1:
            return diagnosis.diagnose_poses(scenes[0], inputs.recorded[0], **options), call, None
        return diagnosis.diagnose_poses(scenes, list(inputs.recorded), **options), call, None
    several = len(inputs.observations) > 1
    function = _function(
        diagnosis,
        "diagnose_clips" if several else "diagnose",
        f"{len(inputs.observations)} pairs of --init and --video" if several else "refine diagnose",
        "diagnose each clip by itself" if several else "install a version that has it",
    )
    scenes, notes, taken = [], [], []
    for samples, observation in zip(inputs.samples, inputs.observations, strict=True):
        scene, index, note = best_sample(samples, observation, threads)
        scenes.append(scene)
        taken.append(index)
        if note:
            notes.append(note)
    if notes:
        call = {**call, "sample": taken}
    if several:
        notes.append(f"The pictures are of the first of {len(scenes)} clips.")
        result = function(scenes, list(inputs.observations), **options)
    else:
        result = function(scenes[0], inputs.observations[0], **options)
    return dataclasses.replace(result, notes=(*notes, *result.notes)), call, inputs.observations[0]


def _function(module: Any, name: str, asked: str, remedy: str) -> Callable:
    found = getattr(module, name, None)
    if found is None:
        raise InputError(f"{asked}: this version cannot diagnose that yet; {remedy}")
    return found


def _only(samples) -> Any:
    if len(samples) != 1:
        raise InputError(
            f"{samples.source}: {len(samples)} samples; expected one scene beside --poses; name a file with one"
        )
    return samples.scenes[0]


def best_sample(samples, observation, threads: int | None = None) -> tuple[Any, int, str]:
    """The scene to diagnose: the only one, or of several the one with the best fitness.

    Args:
      samples: ``Samples`` of a file.
      observation: the clip.
      threads: of the simulation.

    Returns:
      the scene, its index in the file, and a sentence on how it was chosen (empty if there was no choice).
    """
    if len(samples) == 1:
        return samples.scenes[0], samples.indices[0], ""
    from mjx_refine.search.options import Options
    from mjx_refine.search.problem import Problem

    best = Problem(samples, observation, Options(threads=threads)).starts[0]
    note = (
        f"{samples.source}: sample {best.index} of {len(samples)} is taken, the one with the best fitness "
        f"({best.fitness:.3f}, IoU {float(best.scores.iou[0]):.3f})"
    )
    return best.scene, best.index, note


class Steps:
    """Shows nothing."""

    def told(self, text: str) -> None:
        """A step begins."""

    def close(self) -> None:
        """The run is over."""


class TerminalSteps(Steps):
    """The step at work and the time since the start, in one line on stderr."""

    def __init__(self):
        from rich.console import Console
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        self.bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            TextColumn("step {task.completed}"),
            TimeElapsedColumn(),
            console=Console(stderr=True),
            transient=True,
        )
        self.task = self.bar.add_task("reading", total=None)
        self.bar.start()

    def told(self, text: str) -> None:
        self.bar.update(self.task, description=text, advance=1)

    def close(self) -> None:
        self.bar.stop()


def step_display() -> Steps:
    """A live line where stderr is a terminal, else one that shows nothing."""
    return TerminalSteps() if sys.stderr.isatty() else Steps()
