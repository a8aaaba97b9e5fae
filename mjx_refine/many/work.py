"""One job, from its files to its folder: what a worker process and a Ray task do."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from mjx_refine.compile_cache import enable_cache
from mjx_refine.errors import InputError
from mjx_refine.files import remove_stale_parts
from mjx_refine.many.jobs import Job
from mjx_refine.many.outcome import BAD_INPUT, DONE, FAILED, SKIPPED, Outcome, outcome_of, result_of
from mjx_refine.observation import Observation, load_observation
from mjx_refine.scene import Samples, load_scenes
from mjx_refine.search import Options, Progress, Step, refine
from mjx_refine.search.checkpoint import input_digest, load_checkpoint
from mjx_refine.search.problem import Problem
from mjx_refine.search.ready import Ready
from mjx_refine.search.refine import CHECKPOINT
from mjx_refine.search.run import Run

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
    return _caught(job, lambda: _refined(job, out / job.name, job.options(common), told))


@dataclasses.dataclass(frozen=True)
class Prepared:
    """A job that has landed and waits for its population search elsewhere.

    Attributes:
      name: of the job.
      ready: what the search needs; it adds to the checkpoint, from which ``work`` then goes on.
      digest: of the job, and of its checkpoint.
    """

    name: str
    ready: Ready
    digest: str


def prepare(
    job: Job, out: Path, common: Options, told: Callable[[float], object] = lambda part: None
) -> Outcome | Prepared:
    """The first part of a job whose population search happens elsewhere; ``work`` is the last.

    A job that needs no such search, or has its own (scenes with effects), is worked to its end.
    """
    return _caught(job, lambda: _prepared(job, out / job.name, job.options(common), told))


T = TypeVar("T")


def _caught(job: Job, made: Callable[[], T]) -> T | Outcome:
    try:
        return made()
    except InputError as error:
        return Outcome(job.name, BAD_INPUT, str(error))
    except MemoryError:
        return Outcome(job.name, FAILED, "out of memory; choose fewer --workers or a smaller --resolution")
    except Exception as error:
        return Outcome(job.name, FAILED, told_of(error))


@dataclasses.dataclass(frozen=True)
class _Opened:
    """A job's files, and whether its checkpoint can be gone on from."""

    samples: Samples
    observation: Observation
    digest: str
    resume: bool
    notes: list[str]


def _opened(job: Job, folder: Path, options: Options) -> _Opened | Outcome:
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
    return _Opened(samples, observation, expected, resume, notes)


_KEPT: dict[str, Problem] = {}
"""Problems of jobs that were prepared here, for their ends, by digest."""

_AHEAD: dict[str, Run] = {}
"""Runs of those of them for which something can be done ahead."""

MOST_KEPT = 8

REPORT = "mjx_refine.report"


def ahead() -> bool:
    """Does a piece of what the ends of prepared jobs need and their searches do not change; False where nothing is left."""
    if not _KEPT:
        return False
    if REPORT not in sys.modules:
        importlib.import_module(REPORT)
        return True
    while _AHEAD:
        digest = next(iter(_AHEAD))
        run = _AHEAD.pop(digest)
        if digest in _KEPT:
            with contextlib.suppress(Exception):  # whoever ends the job says it
                run.ahead()
            return True
    return False


def _refined(job: Job, folder: Path, options: Options, told: Callable[[float], object]) -> Outcome:
    opened = _opened(job, folder, options)
    if isinstance(opened, Outcome):
        return opened
    return _ended(job, folder, options, opened, told)


def _ended(job: Job, folder: Path, options: Options, opened: _Opened, told: Callable[[float], object]) -> Outcome:
    result = refine(
        opened.samples,
        opened.observation,
        options,
        progress=_Told(told),
        folder=folder,
        resume=opened.resume,
        problem=_KEPT.pop(opened.digest, None),
    )
    # Matplotlib takes a while to import, which clips that wait for a device should not.
    from mjx_refine.report import warnings, write_result

    write_result(folder, result, opened.observation)
    notes = [*opened.notes, *warnings(result, opened.observation)]
    return outcome_of(job.name, DONE, folder, "; ".join(notes))


def _prepared(job: Job, folder: Path, options: Options, told: Callable[[float], object]) -> Outcome | Prepared:
    opened = _opened(job, folder, options)
    if isinstance(opened, Outcome):
        return opened
    enable_cache()
    problem = Problem(opened.samples, opened.observation, options)
    folder.mkdir(parents=True, exist_ok=True)
    run = Run(problem, _Told(told), folder / CHECKPOINT, opened.resume)
    ready = run.ready()
    while len(_KEPT) >= MOST_KEPT:
        _KEPT.pop(next(iter(_KEPT)))
    _KEPT[opened.digest] = problem
    if ready is None:
        here = dataclasses.replace(opened, resume=(folder / CHECKPOINT).exists())
        return _ended(job, folder, options, here, told)
    _AHEAD[opened.digest] = run
    return Prepared(job.name, ready, opened.digest)


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


def told_of(error: Exception) -> str:
    """An unexpected error in one line, with its place."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return " ".join(f"{type(error).__name__}: {error}{place}".split())
