"""The whole: shards dealt out to machines and processes, progress, and a summary."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

from mjx_refine import files
from mjx_refine.children import cores
from mjx_refine.errors import InputError
from mjx_refine.generate.make import Tally
from mjx_refine.generate.options import GenerateOptions
from mjx_refine.generate.renderer import VARIABLE, choose_renderer
from mjx_refine.generate.shards import finished, make_folder, tally_of, written_options
from mjx_refine.generate.workers import Job, worked

MOST_RECORDS = 10**8
DEVICES = ("auto", "cpu", "gpu")


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
      device: where the pictures were drawn; None: there was nothing left to draw.
      path: the JSON file with all this.
    """

    out: Path
    tally: Tally
    made: int
    bytes: int
    seconds: float
    device: str | None
    path: Path

    @property
    def rate(self) -> float:
        """Scenes a second that this call made."""
        return self.made / self.seconds


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
      workers: processes, each of one thread; None: as many as there are cores; 0: none but this one, whose renderer is
        the one with which MuJoCo was imported.
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
    tally, made, size, drawn_on = Tally(), 0, 0, None
    kept, total = jobs.kept, sum(job.records for job in jobs.left) + sum(told["records"] for told in jobs.kept)
    for told in kept:
        tally.add(tally_of(told))
        size += told["bytes"]
    processes = _workers(workers, len(jobs.left))
    environment = _environment(options, processes, device)
    with _folder(out, alone=shard[1] == 1), contextlib.closing(worked(jobs.left, processes, environment)) as outcomes:
        try:
            for part, written, kind in outcomes:
                tally.add(part)
                made, size, drawn_on = made + part.records, size + written, kind
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
            "processor_seconds": round(tally.processor, 3),
            "parts": {name: round(seconds, 3) for name, seconds in sorted(tally.seconds.items())},
        },
    }


def _summary_name(options: GenerateOptions, shard: tuple[int, int]) -> str:
    part = "" if shard[1] == 1 else f".{shard[0]}of{shard[1]}"
    return f"{options.split}{part}.json"


@dataclasses.dataclass(frozen=True)
class _Jobs:
    left: list[Job]
    kept: list[dict]


def _jobs(count: int, out: Path, options: GenerateOptions, shard: tuple[int, int], resume: bool, device: str) -> _Jobs:
    """The shards of this machine that are still to be written, and those that are there."""
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
            left.append(Job(out, number, records, options, device))
    return _Jobs(left, kept)


@contextlib.contextmanager
def _folder(out: Path, alone: bool) -> Iterator[None]:
    """Makes ``out``; where the call turns out to be wrong it is gone again. ``alone``: no other machine writes there."""
    added = [folder for folder in (out, *out.parents) if not folder.exists()]
    make_folder(out)
    if alone:
        files.remove_stale_parts(out)
    try:
        yield
    except InputError:
        for folder in added:
            with contextlib.suppress(OSError):  # it holds something
                folder.rmdir()
        raise


def _environment(options: GenerateOptions, processes: int, device: str) -> dict[str, str]:
    """What the workers' environment has beside this one's.

    Raises:
      InputError: no pictures can be drawn.
    """
    values = {"JAX_PLATFORMS": "cpu"} if device == "cpu" else {}
    if options.rgb and processes:
        values[VARIABLE] = choose_renderer()
    elif options.rgb:
        from mjx_refine.generate.rgb import check_renderer

        check_renderer()
    return values


def _workers(workers: int | None, jobs: int) -> int:
    """How many processes; 0: this one."""
    if workers == 0:
        return 0
    if workers is not None and not 1 <= workers <= 4096:
        raise InputError(f"{workers} workers; expected 0 (none but this process) to 4096")
    return max(1, min(workers or cores(), jobs))
