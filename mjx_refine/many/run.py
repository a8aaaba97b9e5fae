"""``refine_many``: jobs in, a folder each and a summary out."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import os
from collections.abc import Generator, Sequence
from pathlib import Path

from mjx_refine.errors import InputError
from mjx_refine.files import remove_stale_parts, writable_directory
from mjx_refine.many.groups import Kind, Waiting, kind_of_job
from mjx_refine.many.jobs import SUMMARY, Job, check_names, load_jobs
from mjx_refine.many.outcome import BAD_INPUT, Outcome
from mjx_refine.many.pool import Pool
from mjx_refine.many.progress import ManyProgress
from mjx_refine.many.summary import write_summary
from mjx_refine.many.work import RESULTS, cleared
from mjx_refine.scene import load_scenes
from mjx_refine.search import Options
from mjx_refine.sim.backends import resolve_backend

ENGINES = ("processes", "ray")


@dataclasses.dataclass(frozen=True)
class Many:
    """How all jobs ended.

    Attributes:
      out: folder of the jobs' folders and of ``summary.csv``.
      outcomes: one a job, in the jobs' order.
    """

    out: Path
    outcomes: tuple[Outcome, ...]

    @property
    def failed(self) -> tuple[Outcome, ...]:
        """Those without a result."""
        return tuple(outcome for outcome in self.outcomes if not outcome.ok)

    @property
    def status(self) -> int:
        """Exit status: 0 all done, 2 every job was bad input, 1 anything else."""
        if not self.failed:
            return 0
        return 2 if all(outcome.status == BAD_INPUT for outcome in self.outcomes) else 1


def refine_many(
    jobs: Sequence[Job] | str | os.PathLike,
    options: Options | None = None,
    *,
    out: str | os.PathLike,
    workers: int | None = None,
    resume: bool = False,
    engine: str = "processes",
    address: str | None = None,
    progress: ManyProgress | None = None,
) -> Many:
    """Refines many clips, each into a folder of its own; one that fails stops no other.

    Args:
      jobs: what to refine, or the path of a ``jobs.yaml``.
      options: of all jobs; a job's overrides come before them.
      out: folder; a job writes in ``out / job.name`` what a refinement writes, and ``summary.csv`` has a row a job.
      workers: processes that share the cores; by default one a core. With MJX they land and finish clips, while this
        process searches all clips of a kind together on the device. With ``ray``: cores of a cluster that is made here.
        A script that calls this needs ``if __name__ == "__main__":``, since each process imports it.
      resume: leave finished jobs alone and go on with unfinished ones from their checkpoints; jobs whose clip, samples
        or options are others than then begin anew.
      engine: ``processes`` of this machine, or ``ray``.
      address: of a Ray cluster, see ``ray.init``; None: the one that RAY_ADDRESS names, else one of this machine.
      progress: a display; silent by default.

    Returns:
      every job's outcome.

    Raises:
      InputError: the jobs or the call are wrong, or ``out`` cannot be written; not where one job's files are.
      RuntimeError: no worker process can begin.
    """
    jobs = load_jobs(jobs) if isinstance(jobs, str | os.PathLike) else list(jobs)
    options, out, progress = options or Options(), Path(out), progress or ManyProgress()
    _check_call(jobs, workers, engine)
    _check_folder(out)
    outcomes: dict[str, Outcome] = {}

    def ended(outcome: Outcome) -> None:
        outcomes[outcome.name] = outcome
        write_summary(out, (outcomes[job.name] for job in jobs if job.name in outcomes))
        progress.ended(outcome)

    try:
        ready: list[tuple[Job, Kind]] = []
        for job in jobs:
            try:
                writable_directory(out / job.name, RESULTS)
                ready.append((job, kind_of_job(load_scenes(job.init), job.video)))
                if not resume:
                    cleared(out / job.name)
            except InputError as error:
                ended(Outcome(job.name, BAD_INPUT, str(error)))
        with contextlib.closing(_worked(engine, ready, out, options, workers, address, progress)) as worked:
            for outcome in worked:
                ended(outcome)
    finally:
        progress.close()
    return Many(out, tuple(outcomes[job.name] for job in jobs))


def _worked(engine: str, ready: list, out: Path, options: Options, workers, address, progress) -> Generator[Outcome]:
    if engine == "ray":
        from mjx_refine.many.ray import ray_outcomes

        return ray_outcomes(ready, out, options, workers, address, progress)
    backend = batching_backend(options)
    if backend is not None and ready:
        from mjx_refine.many.batched import Batched

        return Batched(ready, out, options, backend, workers, progress).outcomes()
    return Pool(Waiting(ready), out, options, workers, progress).outcomes()


def batching_backend(options: Options) -> str | None:
    """The backend for which clips are searched together; None for C MuJoCo, which has a core for each instead."""
    if options.backend == "mujoco" or (options.backend == "auto" and importlib.util.find_spec("warp") is None):
        return None
    with contextlib.suppress(InputError):  # where it cannot run, every job says why
        resolved = resolve_backend(options.backend)
        return None if resolved == "mujoco" else resolved
    return None


def _check_call(jobs: list[Job], workers: int | None, engine: str) -> None:
    if not jobs:
        raise InputError("jobs: an empty list; expected at least one")
    check_names(jobs, "jobs")
    if workers is not None and (isinstance(workers, bool) or not isinstance(workers, int) or not 1 <= workers <= 4096):
        raise InputError(f"workers = {workers!r}; expected a whole number, 1 <= workers <= 4096")
    if engine not in ENGINES:
        raise InputError(f"engine = {engine!r}; expected one of {', '.join(ENGINES)}")


def _check_folder(out: Path) -> None:
    writable_directory(out, (SUMMARY,))
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made ({error.strerror}); expected a folder to write in") from error
    remove_stale_parts(out)
