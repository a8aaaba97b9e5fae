"""The same jobs on a Ray cluster: one task a clip. Ray schedules, retries and carries the outcomes; nothing here does."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import logging
import os
from collections.abc import Generator
from pathlib import Path
from typing import Any

from mjx_refine.children import ONE_THREAD
from mjx_refine.errors import InputError
from mjx_refine.many.groups import Kind
from mjx_refine.many.jobs import Job
from mjx_refine.many.outcome import FAILED, Outcome
from mjx_refine.many.progress import ManyProgress
from mjx_refine.many.work import work
from mjx_refine.search import Options

RETRIES = 3
"""Times that Ray begins a task again whose process or node was lost; it then goes on from its checkpoint."""

REMEDY = "pip install 'mjx-refine[ray]', or choose --engine processes"


def ray_outcomes(
    jobs: list[tuple[Job, Kind]],
    out: Path,
    options: Options,
    workers: int | None,
    address: str | None,
    progress: ManyProgress,
) -> Generator[Outcome]:
    """Every job's outcome, as they end.

    Args:
      jobs: with their kinds; those of a kind are submitted together, so that Ray's processes find compiled programs.
      out: folder of all jobs, which every node sees under the same path.
      options: of all jobs.
      workers: tasks at once of a cluster that is made here; None: its cores. A cluster that stands has its own room.
      address: of the cluster; None: the one that RAY_ADDRESS names, else one of this machine.
      progress: a display.

    Raises:
      InputError: Ray is not installed, or there is no cluster at the address.
    """
    if importlib.util.find_spec("ray") is None:
        raise InputError(f"engine ray: the package ray is not installed; {REMEDY}")
    ray = importlib.import_module("ray")
    ours = not ray.is_initialized()
    if ours:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a cluster of this machine tells nobody of itself
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **_room(workers, address))
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise InputError(f"engine ray: no cluster at {address!r} ({error}); check --address") from error
    try:
        yield from _outcomes(ray, jobs, out.absolute(), options, progress)
    finally:
        if ours:
            ray.shutdown()


def _outcomes(ray: Any, jobs: list[tuple[Job, Kind]], out: Path, options: Options, progress) -> Generator[Outcome]:
    kinds = list(dict.fromkeys(kind for _, kind in jobs))
    task, needs = ray.remote(_task), _needs(options, ray.cluster_resources())
    how = {"max_retries": RETRIES, "runtime_env": {"env_vars": ONE_THREAD}, **needs}
    pending = {}
    for job, _ in sorted(jobs, key=lambda pair: kinds.index(pair[1])):
        pending[task.options(name=job.name, **how).remote(_absolute(job), out, options)] = job.name
    total = len(pending)
    try:
        while pending:
            done, _ = ray.wait(list(pending), num_returns=1, timeout=1.0)
            for reference in done:
                yield _outcome(ray, reference, pending.pop(reference))
            finished = total - len(pending)
            progress.update(finished, total, finished / total, tuple(pending.values()))
    finally:
        for reference in pending:
            ray.cancel(reference, force=True)


def _outcome(ray: Any, reference: Any, name: str) -> Outcome:
    try:
        return ray.get(reference)
    except ray.exceptions.RayError as error:
        return Outcome(name, FAILED, " ".join(f"Ray gave it up after {RETRIES} retries: {error}".split())[:500])


def _task(job: Job, out: Path, options: Options) -> Outcome:
    """One job. A retry finds its checkpoint, or the finished result, and goes on from there."""
    return work(job, out, dataclasses.replace(options, threads=options.threads or 1))


def _absolute(job: Job) -> Job:
    return Job(job.init.absolute(), job.video.absolute(), job.name, job.overrides)


def _room(workers: int | None, address: str | None) -> dict[str, Any]:
    """For a cluster of this machine that is made here; a cluster that stands has its own."""
    return {"num_cpus": workers} if workers is not None and address is None else {}


def _needs(options: Options, resources: dict[str, float]) -> dict[str, float]:
    """What one task takes: a core, and a GPU where the backend is MJX and the cluster has one."""
    gpu = options.backend in ("mjx", "warp", "auto") and resources.get("GPU", 0) > 0
    return {"num_cpus": 1, "num_gpus": 1} if gpu else {"num_cpus": 1}
