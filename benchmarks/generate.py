"""How fast scenes are generated, what the filters let pass, and whether records re-simulate to what they hold.

    python -m benchmarks.generate --count 10000 [--out DIR] [--workers N] [--device auto|cpu|gpu] [--split train] [--rgb]
    python -m benchmarks.generate check DIR --count 1000

The first generates into ``--out`` (a temporary folder by default) and prints the rate, what the time went to (summed over
processes), pass rates, bytes a scene, machine and versions. ``--warm`` first generates a few scenes, so that programs are
compiled (they are then in the cache on disk) and the rate is that of a long run. The second chooses records at random and
simulates and draws each again from its YAML alone: states, contacts, masks and flow must be equal to the last bit. It also
compares with ``refine simulate``, which draws with another program: there float32's last digit tells in rare pixels between
object and background, so an IoU of 0.9999 is asked, and flow within half of float16's last digit and 0.02 px (float32 in
the ray caster, where rays graze a surface). Exit status 1 where that is not so.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import platform
import sys
import tarfile
import tempfile
import time
from pathlib import Path

import numpy as np

from mjx_refine import GenerateOptions, InputError, Record, generate_scenes, parse_scenes, read_records
from mjx_refine.children import cores
from mjx_refine.compile_cache import enable_cache
from mjx_refine.generate import GenerateProgress, Summary, replayed

LEAST_IOU = 0.9999
"""With ``refine simulate``."""

NOISE = 0.02
"""Of flow by ``refine simulate``, beside half of float16's last digit [px]."""


def machine() -> str:
    """Processor, cores and versions."""
    import jax
    import mujoco

    model, cpuinfo = platform.machine(), Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    return (
        f"{model}, {os.cpu_count()} cores; Python {platform.python_version()}, numpy {np.__version__}, "
        f"mujoco {mujoco.__version__}, jax {jax.__version__}"
    )


class Watch(GenerateProgress):
    """Remembers when shards were done."""

    def __init__(self):
        self.done: list[tuple[float, int]] = []

    def update(self, records: int, total: int, tally) -> None:
        """Another shard."""
        self.done.append((time.perf_counter(), records))

    def steady(self, workers: int) -> float | None:
        """Scenes a second after every process has started up and written a shard; None: too few shards to tell."""
        if len(self.done) < 4 * workers:
            return None
        (start, before), (end, after) = self.done[workers - 1], self.done[-1]
        return (after - before) / (end - start)


def report(summary: Summary) -> None:
    """The table of a run."""
    tally = summary.tally
    print(
        f"{summary.made} scenes in {summary.seconds:.1f} s: {summary.rate:.1f} scenes/s, pictures on {summary.device}"
    )
    total = sum(tally.seconds.values())
    parts = ", ".join(
        f"{name} {seconds / summary.made * 1e3:.1f} ms ({seconds / total:.0%})"
        for name, seconds in sorted(tally.seconds.items(), key=lambda part: -part[1])
    )
    print(f"time a scene, summed over processes: {total / summary.made * 1e3:.1f} ms: {parts}")
    print(f"processor time a scene: {tally.processor / summary.made * 1e3:.1f} ms")
    print(f"{tally.proposals} scenes proposed; of those that reached a filter, passed:")
    for name, told in tally.rates().items():
        print(f"  {name:<10} {told['passed']:>8} of {told['seen']:>8}  {told['rate']:.1%}")
    print(f"{summary.bytes / tally.records / 1e3:.1f} kB a scene on disk, {summary.bytes / 1e9:.2f} GB in all")
    numbers: dict[int, int] = {}
    for kind, count in tally.kinds.items():
        numbers[len(kind.split())] = numbers.get(len(kind.split()), 0) + count
    print("objects: " + ", ".join(f"{n}: {count}" for n, count in sorted(numbers.items())))


def rate(arguments: argparse.Namespace) -> int:
    """Generates and reports."""
    options = GenerateOptions(
        seed=arguments.seed, split=arguments.split, objects=arguments.objects, rgb=arguments.rgb,
        per_shard=arguments.per_shard,
    )  # fmt: skip
    workers = arguments.workers or cores()
    how, watch = {"workers": workers, "device": arguments.device}, Watch()
    with tempfile.TemporaryDirectory() as folder:
        if arguments.warm:
            generate_scenes(arguments.warm, Path(folder) / "warm", options, **how)
        out = arguments.out or Path(folder) / "out"
        summary = generate_scenes(arguments.count, out, options, progress=watch, **how)
        print(f"{machine()}; {workers} processes")
        report(summary)
        steady = watch.steady(workers)
        if steady is not None:
            print(f"once all processes had started and written a shard: {steady:.1f} scenes/s")
    return 0


@dataclasses.dataclass(frozen=True)
class Compared:
    """A record and its text simulated again.

    Attributes:
      motion: whether states and contacts are equal.
      iou: of masks, where both label a pixel alike.
      flow: whether the flow of the same masks is equal.
      other_iou: with ``refine simulate``.
      pixels: that differ there.
      error: largest flow error there beyond rounding [px].
    """

    motion: bool
    iou: float
    flow: bool
    other_iou: float
    pixels: int
    error: float

    @property
    def sound(self) -> bool:
        """Whether all is as it must be."""
        own = self.motion and self.iou == 1 and self.flow
        return own and self.other_iou >= LEAST_IOU and self.error <= NOISE


def compared(record: Record) -> Compared:
    """Simulates the record's text again."""
    from mjx_refine.simulate import simulate

    scene = parse_scenes(record.text, record.key)[0]
    motion, pictures = replayed(scene)
    again = dataclasses.replace(record, pictures=pictures, motion=motion)
    other = simulate(scene)
    if other.masks is None:
        raise RuntimeError("a simulation has masks")
    same = (record.masks == other.masks) & (record.masks > 0)
    rounding = 0.5 * np.spacing(np.abs(record.flow)).astype(np.float64)
    off = np.abs(record.flow.astype(np.float64) - other.flow) - rounding
    return Compared(
        motion=all(
            np.array_equal(getattr(a, name), getattr(b, name))
            for a, b in ((motion, record.motion), (motion.contacts, record.motion.contacts))
            for name in (field.name for field in dataclasses.fields(a) if field.name != "contacts")
        ),
        iou=iou(again.masks, record.masks),
        flow=np.array_equal(again.flow, record.flow),
        other_iou=iou(other.masks, record.masks),
        pixels=int((other.masks != record.masks).sum()),
        error=float(off[same[:-1]].max(initial=0.0)),
    )


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Pixels that both label with the same object over those that either labels."""
    either = (a > 0) | (b > 0)
    return float(((a == b) & either).sum() / max(either.sum(), 1))


def keys_of(path: Path) -> list[str]:
    """Of the records of a shard, in order."""
    with tarfile.open(path, "r:") as archive:
        return list(dict.fromkeys(name.partition(".")[0] for name in archive.getnames()))


def check(arguments: argparse.Namespace) -> int:
    """Re-simulates records drawn at random."""
    enable_cache()
    there = [(path, key) for path in sorted(arguments.folder.glob("*.tar")) for key in keys_of(path)]
    total = len(there)
    count = min(arguments.count, total)
    chosen: dict[Path, set[str]] = {}
    for number in sorted(np.random.default_rng(arguments.seed).choice(total, count, replace=False).tolist()):
        chosen.setdefault(there[number][0], set()).add(there[number][1])
    began, told = time.perf_counter(), []
    for record in (record for path, keys in chosen.items() for record in read_records(path, keys=keys)):
        told.append(compared(record))
        if not told[-1].sound:
            print(f"record {record.key}: {told[-1]}")
    sound = sum(one.sound for one in told)
    print(machine())
    print(
        f"{count} of {total} records simulated and drawn again from their YAML in {time.perf_counter() - began:.0f} s:\n"
        f"  states and contacts equal in {sum(one.motion for one in told)}, masks IoU {min(one.iou for one in told):.8f} at "
        f"least, equal in {sum(one.iou == 1 for one in told)}; flow equal in {sum(one.flow for one in told)}\n"
        f"  by `refine simulate`: masks IoU {min(one.other_iou for one in told):.8f} at least, equal in "
        f"{sum(one.pixels == 0 for one in told)}, {sum(one.pixels for one in told)} pixels differ in all; flow beyond "
        f"rounding {max(one.error for one in told):.2g} px at most\n{sound} of {count} as required"
    )
    return 0 if sound == count else 1


def main() -> int:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    if "check" in sys.argv[1:2]:
        parser.add_argument("what", choices=("check",))
        parser.add_argument("folder", type=Path)
        parser.add_argument("--count", type=int, default=1000)
        parser.add_argument("--seed", type=int, default=0, help="of the choice")
        work = check
    else:
        parser.add_argument("--count", type=int, default=1000)
        parser.add_argument("--out", type=Path)
        parser.add_argument("--seed", type=int, default=0)
        parser.add_argument("--split", default="train")
        parser.add_argument("--objects", type=int)
        parser.add_argument("--rgb", action="store_true")
        parser.add_argument("--per-shard", type=int, default=100)
        parser.add_argument("--workers", type=int)
        parser.add_argument("--device", default="auto")
        parser.add_argument("--warm", type=int, default=0, help="scenes to generate before the clock starts")
        work = rate
    arguments = parser.parse_args()
    try:
        return work(arguments)
    except InputError as error:
        print(f"benchmarks.generate: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    raise SystemExit(main())
