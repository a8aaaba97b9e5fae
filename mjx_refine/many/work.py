"""One job, from its files to its folder: what a worker process and a Ray task do."""

from __future__ import annotations

import dataclasses
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from mjx_refine.errors import InputError
from mjx_refine.files import remove_stale_parts
from mjx_refine.many.jobs import Job
from mjx_refine.many.outcome import BAD_INPUT, DONE, FAILED, SKIPPED, Outcome, outcome_of, result_of
from mjx_refine.observation import load_observation
from mjx_refine.report import write_result
from mjx_refine.scene import load_scenes
from mjx_refine.search import Options, Progress, Step, refine
from mjx_refine.search.checkpoint import input_digest, load_checkpoint
from mjx_refine.search.refine import CHECKPOINT

RESULTS = ("refined.yaml", "result.json", "history.csv", "report.html", "overlay.gif")

SEARCHING = 0.8
"""Part of a job's time that its rollouts take, for the time left; refits, report and animation come after."""

SECONDS = 0.5
"""Between two messages about a job's progress."""


def work(job: Job, out: Path, common: Options, told: Callable[[float], object] = lambda part: None) -> Outcome:
    """Refines one job into its folder; goes on from its checkpoint, and leaves a finished result of the same input alone.

    Args:
      job: what to refine.
      out: folder of all jobs; the job's is ``out / job.name``.
      common: options of all jobs.
      told: is told the part of the job that is done, in [0, 1].

    Returns:
      the outcome; nothing is raised but what ends a process.
    """
    try:
        return _refined(job, out / job.name, job.options(common), told)
    except InputError as error:
        return Outcome(job.name, BAD_INPUT, str(error))
    except MemoryError:
        return Outcome(job.name, FAILED, "out of memory; choose fewer --workers or a smaller --resolution")
    except Exception as error:
        return Outcome(job.name, FAILED, _told_of(error))


def _refined(job: Job, folder: Path, options: Options, told: Callable[[float], object]) -> Outcome:
    samples, observation = load_scenes(job.init), load_observation(job.video)
    expected = input_digest(samples, observation, options)
    if finished(folder, expected):
        return outcome_of(job.name, SKIPPED, folder, "finished before")
    remove_stale_parts(folder)
    notes = [f"left out: {problem.reason}" for problem in samples.problems]
    checkpoint = folder / CHECKPOINT
    try:
        load_checkpoint(checkpoint, expected)
        resume = checkpoint.exists()
    except InputError as error:
        # Of other options or another clip: what was asked for now is made from the beginning.
        notes.append(f"begun anew: {error}")
        resume = False
    result = refine(samples, observation, options, progress=_Told(told), folder=folder, resume=resume)
    write_result(folder, result, observation)
    return outcome_of(job.name, DONE, folder, "; ".join(notes))


def finished(folder: Path, digest: str) -> bool:
    """Whether ``folder`` holds the whole result of the call with this digest."""
    numbers = result_of(folder)
    return numbers is not None and numbers["digest"] == digest and all((folder / name).is_file() for name in RESULTS)


def cleared(folder: Path) -> None:
    """Removes what would let a job go on from an earlier call.

    Raises:
      InputError: a file cannot be removed.
    """
    for name in ("result.json", CHECKPOINT):
        try:
            (folder / name).unlink(missing_ok=True)
        except NotADirectoryError:
            return
        except OSError as error:
            raise InputError(f"{folder / name}: cannot be removed ({error.strerror}); remove it by hand") from error


@dataclasses.dataclass
class _Told(Progress):
    """Passes on how far a refinement is."""

    told: Callable[[float], object]
    last: float = 0.0

    def step(self, step: Step) -> None:
        """A step was done."""
        if time.monotonic() - self.last >= SECONDS:
            self.last = time.monotonic()
            self.told(SEARCHING * min(1.0, step.evaluations / step.budget))


def _told_of(error: Exception) -> str:
    """An unexpected error in one line, with its place."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return " ".join(f"{type(error).__name__}: {error}{place}".split())
