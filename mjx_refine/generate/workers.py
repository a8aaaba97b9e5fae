"""Shards written by this process or by several, each of which is warned, watched and ended with the call."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import os
import signal
import threading
import time
from collections.abc import Generator, Mapping
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from mjx_refine.children import ONE_THREAD, exit_with_parent, inherited, pool
from mjx_refine.errors import InputError
from mjx_refine.generate.make import Maker, Tally
from mjx_refine.generate.options import GenerateOptions
from mjx_refine.generate.shards import shard_name, write_shard

_KEPT = {
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(1 << 32),
    "MALLOC_TOP_PAD_": str(64 << 20),
}
"""glibc then keeps what arrays of some megabytes leave, instead of asking for new pages for each, a fifth of the time of
pictures; other C libraries take no notice."""

SHARED = {**ONE_THREAD, **_KEPT, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
"""Environment of a worker: the processes share the cores, and a GPU's memory."""


@dataclasses.dataclass(frozen=True)
class Job:
    """One shard to be written.

    Attributes:
      out: folder.
      number: of the shard.
      records: in it.
      options: of all records.
      device: where pictures are drawn.
    """

    out: Path
    number: int
    records: int
    options: GenerateOptions
    device: str


def worked(jobs: list[Job], workers: int, environment: Mapping[str, str]) -> Generator[tuple[Tally, int, str]]:
    """(tally, bytes, device) of every job, as they end, by so many processes with ``environment``; 0: by this one.

    Raises:
      InputError: a job cannot be done.
      RuntimeError: a process was killed.
    """
    if not jobs:
        return
    if workers == 0:
        maker = Maker(jobs[0].options)
        for job in jobs:
            yield _write(job, maker)
        return
    try:
        with pool(workers, _begin, (jobs[0],)) as processes:
            with inherited({**SHARED, **environment}):
                futures = [processes.submit(_work, job) for job in jobs]
            for future in concurrent.futures.as_completed(futures):
                yield future.result()
            processes.shutdown()
    except BrokenProcessPool as error:
        raise RuntimeError(
            "a worker process ended: was memory short (choose fewer --workers), or does a script call generate_scenes "
            "without `if __name__ == '__main__':` around it?"
        ) from error


_MAKERS: dict[GenerateOptions, Maker] = {}
_AT_WORK: list[Job] = []


def _begin(job: Job) -> None:
    """Before a worker's first job."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted, and ends us
    signal.signal(signal.SIGTERM, lambda *_: _end())
    threading.Thread(target=exit_with_parent, args=(_end,), daemon=True).start()
    _MAKERS[job.options] = Maker(job.options)


def _end() -> None:
    """Ends this worker without leaving half a shard."""
    for job in _AT_WORK:
        for part in job.out.glob(f".{shard_name(job.options.split, job.number)}.*.part"):
            part.unlink(missing_ok=True)
    os._exit(1)


def _work(job: Job) -> tuple[Tally, int, str]:
    _AT_WORK[:] = [job]
    return _write(job, _MAKERS[job.options])


def _write(job: Job, maker: Maker) -> tuple[Tally, int, str]:
    """Writes one shard."""
    import jax

    from mjx_refine.compile_cache import enable_cache

    enable_cache()
    device = _device(job.device)
    tally, first = Tally(), job.number * job.options.per_shard
    began, busy = time.perf_counter(), time.process_time()
    with jax.default_device(device):
        indices = range(first, first + job.records)
        size = write_shard(job.out, job.number, job.options, maker.records(indices, tally), tally)
    tally.spent("writing", time.perf_counter() - began - sum(tally.seconds.values()))
    tally.processor = time.process_time() - busy
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
