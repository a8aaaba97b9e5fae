"""The whole: shards dealt out to machines and processes, progress, and a summary."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from mjx_refine import files
from mjx_refine.errors import InputError
from mjx_refine.generate.make import Maker, Tally
from mjx_refine.generate.options import GenerateOptions
from mjx_refine.generate.shards import finished, make_folder, tally_of, write_shard, written_options

MOST_RECORDS = 10**8
DEVICES = ("auto", "cpu", "gpu")

ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
}
"""Environment of a worker: the processes share the cores, and a GPU's memory."""


class GenerateProgress:
    """A display that shows nothing."""

    def update(self, records: int, total: int, tally: Tally) -> None:
        """So many records of ``total`` are written; ``tally`` has what was counted."""

    def close(self) -> None:
        """All is over."""


@dataclasses.dataclass(frozen=True)
class Summary:
    """What a call did.

    Attributes:
      out: folder of the shards.
      tally: counts of all shards of this call's share, also of those that stood there before.
      made: records that this call made.
      bytes: of all shards of the share.
      seconds: that the call took.
      device: where the pictures were drawn.
      path: the JSON file with all this.
    """

    out: Path
    tally: Tally
    made: int
    bytes: int
    seconds: float
    device: str
    path: Path

    @property
    def rate(self) -> float:
        """Scenes a second that this call made."""
        return self.made / self.seconds


@dataclasses.dataclass(frozen=True)
class _Job:
    """One shard to be written."""

    out: Path
    number: int
    records: int
    options: GenerateOptions
    device: str


def generate_scenes(
    count: int,
    out: str | os.PathLike,
    options: GenerateOptions | None = None,
    *,
    workers: int | None = None,
    shard: tuple[int, int] = (1, 1),
    resume: bool = False,
    device: str = "auto",
    progress: GenerateProgress | None = None,
) -> Summary:
    """Makes records 0 to ``count`` - 1 and writes them as shards.

    Record k depends on ``options`` and k alone, and so do a shard's bytes on one kind of machine.

    Args:
      count: how many records, over all machines.
      out: folder.
      options: what to generate.
      workers: processes; None: as many as there are cores.
      shard: (i, n): the i-th of n machines, from 1, writes every n-th shard.
      resume: keep whole shards of the same options, also of a smaller count.
      device: where pictures are drawn: ``auto`` (a GPU where JAX sees one), ``cpu``, ``gpu``; physics is C MuJoCo's.
      progress: a display.

    Raises:
      InputError: a value is out of range, ``out`` cannot be written or holds other shards, or there is no such device or
        renderer.
    """
    options, progress = options or GenerateOptions(), progress or GenerateProgress()
    began, out = time.perf_counter(), Path(out)
    jobs = _jobs(count, out, options, shard, resume, device)
    tally, made, size, drawn_on = Tally(), 0, 0, ""
    kept, total = jobs.kept, sum(job.records for job in jobs.left) + sum(told["records"] for told in jobs.kept)
    for told in kept:
        tally.add(tally_of(told))
        size += told["bytes"]
    try:
        for part, written, drawn_on in _worked(jobs.left, _workers(workers, len(jobs.left), options)):
            tally.add(part)
            made, size = made + part.records, size + written
            progress.update(tally.records, total, tally)
    finally:
        progress.close()
    path = out / _summary_name(options, shard)
    summary = Summary(out, tally, made, size, time.perf_counter() - began, drawn_on, path)
    files.write_text(path, json.dumps(told_summary(summary, options, shard), indent=1) + "\n")
    return summary


def told_summary(summary: Summary, options: GenerateOptions, shard: tuple[int, int]) -> dict:
    """The summary as plain numbers; seconds are of this call, those of the parts summed over its processes."""
    tally = summary.tally
    return {
        "format": 1,
        "options": written_options(options),
        "shard": f"{shard[0]}/{shard[1]}",
        "records": tally.records,
        "proposals": tally.proposals,
        "filters": tally.rates(),
        "kinds": dict(sorted(tally.kinds.items())),
        "bytes": summary.bytes,
        "bytes_a_record": summary.bytes / max(tally.records, 1),
        "this_call": {
            "records": summary.made,
            "seconds": summary.seconds,
            "device": summary.device,
            "parts": {name: round(seconds, 3) for name, seconds in sorted(tally.seconds.items())},
        },
    }


def _summary_name(options: GenerateOptions, shard: tuple[int, int]) -> str:
    part = "" if shard[1] == 1 else f".{shard[0]}of{shard[1]}"
    return f"{options.split}{part}.json"


@dataclasses.dataclass(frozen=True)
class _Jobs:
    left: list[_Job]
    kept: list[dict]


def _jobs(count: int, out: Path, options: GenerateOptions, shard: tuple[int, int], resume: bool, device: str) -> _Jobs:
    """The shards of this machine that are still to be written, and those that are there; makes ``out``."""
    if not 1 <= count <= MOST_RECORDS:
        raise InputError(f"{count} scenes; expected 1 <= count <= {MOST_RECORDS}")
    if not 1 <= shard[0] <= shard[1]:
        raise InputError(
            f"shard {shard[0]}/{shard[1]}; expected I/N with 1 <= I <= N, such as 1/4 on the first of four"
        )
    if device not in DEVICES:
        raise InputError(f"device {device!r}; expected one of {', '.join(DEVICES)}")
    files.writable_directory(out, [_summary_name(options, shard)])
    there = finished(out, options, resume or shard[1] > 1) if out.is_dir() else {}
    numbers = range(shard[0] - 1, -(-count // options.per_shard), shard[1])
    if not resume and any(number in there for number in numbers):
        raise InputError(
            f"{out}: holds shards of part {shard[0]}/{shard[1]}; go on with --resume or name another --out"
        )
    left, kept = [], []
    for number in numbers:
        records = min(options.per_shard, count - number * options.per_shard)
        told = there.get(number)
        if told is not None and told["records"] >= records:
            kept.append(told)
        else:
            left.append(_Job(out, number, records, options, device))
    make_folder(out)
    if shard[1] == 1:
        files.remove_stale_parts(out)
    return _Jobs(left, kept)


def cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _workers(workers: int | None, jobs: int, options: GenerateOptions) -> int:
    """How many processes; 0: this one."""
    if workers is not None and not 1 <= workers <= 4096:
        raise InputError(f"{workers} workers; expected 1 to 4096")
    wanted = max(1, min(workers or cores(), jobs))
    # A renderer is chosen when MuJoCo is imported, which this process has done.
    return wanted if wanted > 1 or options.rgb else 0


def _worked(jobs: list[_Job], workers: int) -> Iterator[tuple[Tally, int, str]]:
    """The outcome of every job, as they end."""
    if not jobs:
        return
    if workers == 0:
        maker = Maker(jobs[0].options)
        for job in jobs:
            yield _write(job, maker)
        return
    context = multiprocessing.get_context("spawn")
    pool = concurrent.futures.ProcessPoolExecutor(workers, context, _begin, (jobs[0],))
    try:
        with _environment(jobs[0]):
            futures = [pool.submit(_work, job) for job in jobs]
        for future in concurrent.futures.as_completed(futures):
            yield future.result()
        pool.shutdown()
    except BrokenProcessPool as error:
        raise RuntimeError(
            "a worker process ended: was memory short (choose fewer --workers), or does a script call generate_scenes "
            "without `if __name__ == '__main__':` around it?"
        ) from error
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()
        for process in multiprocessing.active_children():
            process.join()


@contextlib.contextmanager
def _environment(job: _Job) -> Iterator[None]:
    """What worker processes inherit; what the user has set stays."""
    values = dict(ONE_THREAD)
    if job.options.rgb and "DISPLAY" not in os.environ:
        values["MUJOCO_GL"] = "egl"
    if job.device == "cpu":
        values["JAX_PLATFORMS"] = "cpu"
    added = [name for name in values if name not in os.environ]
    os.environ.update({name: values[name] for name in added})
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


_MAKERS: dict[GenerateOptions, Maker] = {}


def _begin(job: _Job) -> None:
    """Before a worker's first job."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted, and ends us
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _MAKERS[job.options] = Maker(job.options)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(job: _Job) -> tuple[Tally, int, str]:
    return _write(job, _MAKERS[job.options])


def _write(job: _Job, maker: Maker) -> tuple[Tally, int, str]:
    """Writes one shard."""
    import jax

    from mjx_refine.compile_cache import enable_cache

    enable_cache()
    device = _device(job.device)
    if job.options.rgb:
        from mjx_refine.generate.rgb import check_renderer

        check_renderer()
    tally, first = Tally(), job.number * job.options.per_shard
    began = time.perf_counter()
    with jax.default_device(device):
        indices = range(first, first + job.records)
        size = write_shard(job.out, job.number, job.options, maker.records(indices, tally), tally)
    tally.seconds["writing"] += time.perf_counter() - began - sum(tally.seconds.values())
    return tally, size, device.device_kind


def _device(name: str):
    """The JAX device that ``name`` means here."""
    import jax

    try:
        return jax.devices(None if name == "auto" else name)[0]
    except RuntimeError as error:
        raise InputError(
            f"device {name}: JAX sees none here; pip install 'mjx-refine[warp]' on a machine with an NVIDIA GPU, or choose "
            "--device cpu"
        ) from error
