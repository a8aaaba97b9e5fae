"""Where a refinement's time goes, how many clips an hour, and a peer: medians and quartiles.

    MUJOCO_GL=egl python -m benchmarks.speed [--budget 128x100] [--size 480x320] [--frames 30] [--kinds sphere,...]
        [--generations N] [--peer-evaluations 4] [--clips 1,4,16] [--clip-budget 128x100] [--workers N] [--json speed.json]
        [--together 1,4,16,64] [--populations 32,128,512,2048] [--objects 1,2,4,6] [--sizes 120x80,480x320,1280x720]
        [--frame-counts 15,30,60] [--single 3] [--second] [--gpu-peers b,c] [--roofline]

Physics, pictures and search are parts of the population search's generations; compilation is what its first costs more,
with JAX's cache on disk switched off. ``--generations`` runs fewer than the budget; the whole budget's time is then
called extrapolated. The peer is pycma with `mujoco.rollout` on two threads and MuJoCo's renderer for segmentation, by
evaluation, beside ours with the last of ``--backends``; its time for the budget is always extrapolated.
``--clips`` runs `refine_many` on clips of our own, whole refinements (landing, search, intervals, report) at
``--clip-budget``, kinds in turn, programs cached by a clip of each kind before; ``--clip-optimizer``, ``--clip-backend`` and
``--clip-refits`` say how. ``--together`` times generations of so many clips in lock-step with the last of ``--backends``,
``--single`` whole refinements one by one, ``--gpu-peers`` MJX-Warp's own renderer (b) and plain MJX (c).
Nothing is left out for a load of others: the load is printed.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path
from unittest import mock

os.environ.setdefault("MUJOCO_GL", "egl")
# Linear algebra is small here. To be set before numpy loads.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from benchmarks.raster import machine, renderer_problem
from benchmarks.speed_parts import Clip, generations, peer, update_times
from benchmarks.speed_scenes import KINDS, make_clip, timed
from benchmarks.speed_tables import (
    frames_table,
    gpu_peers_table,
    pictures_table,
    population_table,
    roofline_table,
    second_process_table,
    single_table,
    together_table,
)
from mjx_refine import Job, Options, refine_many
from mjx_refine.children import cores
from mjx_refine.files import write_text

PACKAGES = ("mujoco", "mujoco-mjx", "jax", "numpy", "cma")
WIDTH = 160


def parts_table(arguments: argparse.Namespace) -> dict:
    """Prints a row a scene kind, and returns the numbers."""
    population, iterations = arguments.budget
    count = min(arguments.generations or iterations, iterations)
    print(
        f"\nA generation of {population}, {arguments.frames} frames of {_x(arguments.size)}, ms: median [quartiles] of {count}"
    )
    print("| kind | parameters | backend | compile s (XLA; programs) | physics | pictures 160 wide | pictures full | search |"
          f" whole | {iterations} generations s |")  # fmt: skip
    print("| --- " * 10 + "|")
    rows = {}
    for kind in arguments.kinds:
        clip = Clip(kind, arguments.size, arguments.frames)
        for backend in arguments.backends:
            p = generations(clip, backend, population, count, WIDTH)
            compiled = p.first - p.whole.median
            all_ = sum(p.whole.seconds) if count == iterations else p.whole.median * iterations
            label = f"{all_:.1f}" + ("" if count == iterations else " (extrapolated)")
            print(f"| {kind} | {p.dimension} | {backend} | {compiled:.1f} ({p.compiled:.1f}; {p.programs}) | {p.physics} "
                  f"| {p.pictures} | {p.full} | {p.search} | {p.whole} | {label} |", flush=True)  # fmt: skip
            rows[f"{kind}, {backend}"] = {"compile": compiled, "whole": p.whole.median, "budget": all_}
    return rows


def peer_table(arguments: argparse.Namespace, ours: dict) -> None:
    """Prints the peer's row a scene kind."""
    population, iterations = arguments.budget
    if problem := renderer_problem():
        print(f"\npeer: MuJoCo's renderer cannot be used here ({problem})")
        return
    print(
        f"\nPeer, ms an evaluation: median [quartiles]; pictures of {arguments.peer_evaluations} candidates in 3 generations"
    )
    print(
        f"| kind | physics | pictures, masks only | search | an evaluation | ours ({arguments.backends[-1]}) "
        "| budget, h (extrapolated) |"
    )
    print("| --- " * 7 + "|")
    for kind in arguments.kinds:
        p = peer(Clip(kind, arguments.size, arguments.frames), population, arguments.peer_evaluations)
        mine = ours.get(f"{kind}, {arguments.backends[-1]}")
        told = "" if mine is None else f"{1e3 * mine['whole'] / population:.2f}"
        hours = p.evaluation * population * iterations / 3600
        print(
            f"| {kind} | {p.physics} | {p.pictures} | {p.search} | {1e3 * p.evaluation:.1f} | {told} | {hours:.2f} |",
            flush=True,
        )


def clips_table(arguments: argparse.Namespace) -> None:
    """Prints a row for each number of clips through ``refine_many``."""
    population, iterations = arguments.clip_budget
    options = Options(
        population=population,
        iterations=iterations,
        optimizer=arguments.clip_optimizer,
        backend=arguments.clip_backend,
        refits=arguments.clip_refits,
    )
    names = list(arguments.kinds)
    with tempfile.TemporaryDirectory() as temporary:
        folder, most = Path(temporary), max(arguments.clips)
        wanted = [(folder / f"clip_{i:02d}", names[i % len(names)], i + 1, arguments.size, arguments.frames)
                  for i in range(most)]  # fmt: skip
        # The GPU serves few processes at once.
        on_cpus = mock.patch.dict(os.environ, JAX_PLATFORMS="cpu")
        with on_cpus, multiprocessing.get_context("spawn").Pool(min(most, cores())) as pool:
            clips = pool.starmap(make_clip, wanted, chunksize=1)
        jobs = [Job(clip / "best32.yaml", clip / "flows.npz") for clip in clips]
        os.environ["MJX_REFINE_CACHE"] = str(folder / "cache")
        seconds = timed(
            lambda: refine_many(jobs[: len(names)], options, out=folder / "warm", workers=arguments.workers)
        )
        print(
            f"\nrefine_many, {population} x {iterations}; a clip of each kind, nothing cached before: {seconds:.1f} s"
        )
        print(
            "| clips | s in all | s a clip | clips an hour | done | refinements' own s, median | IoU before, after (means) |"
        )
        print("| --- " * 7 + "|")
        for count in arguments.clips:
            out = folder / f"out_{count}"
            found = []
            seconds = timed(lambda c=count, o=out, f=found: f.append(
                refine_many(jobs[:c], options, out=o, workers=arguments.workers)))  # fmt: skip
            done = [o for o in found[0].outcomes if o.ok]
            own = sorted(o.seconds for o in done)[len(done) // 2]
            before, after = (sum(getattr(o, f"iou_{w}") for o in done) / len(done) for w in ("before", "after"))
            print(f"| {count} | {seconds:.1f} | {seconds / count:.1f} | {3600 * count / seconds:.0f} | {len(done)}/{count} "
                  f"| {own:.1f} | {before:.3f}, {after:.3f} |", flush=True)  # fmt: skip


def device_tables(arguments: argparse.Namespace) -> None:
    """Prints the tables that were asked for."""
    population, count, size = arguments.budget[0], min(arguments.generations or 5, 5), arguments.size
    backend = arguments.backends[-1] or "auto"
    if arguments.second:
        os.environ["MJX_REFINE_CACHE"] = tempfile.gettempdir() + "/mjx-refine-speed"
        second_process_table(arguments.kinds, [backend], size)
    if arguments.single:
        os.environ["MJX_REFINE_CACHE"] = tempfile.gettempdir() + "/mjx-refine-speed"
        single_table(arguments.kinds, arguments.single, size)
    if arguments.frame_counts:
        frames_table(arguments.kinds[-1], backend, arguments.frame_counts, population, count, size)
    if arguments.together:
        together_table(arguments.kinds, backend, arguments.together, population, count, size)
    if arguments.populations:
        population_table(arguments.kinds[-1], backend, arguments.populations, count, size)
    if arguments.objects:
        pictures_table(arguments.objects, arguments.sizes, population, count)
    if arguments.roofline:
        roofline_table(arguments.kinds, population, count)
    if arguments.gpu_peers:
        gpu_peers_table(arguments.gpu_peers, arguments.kinds, population, count, size)


def _x(pair: tuple[int, int]) -> str:
    return f"{pair[0]}x{pair[1]}"


def _pair(text: str) -> tuple[int, int]:
    first, second = text.split("x")
    return int(first), int(second)


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--budget", type=_pair, default=(128, 100), help="candidates x generations")
    parser.add_argument("--generations", type=int, help="measure only so many of the budget's")
    parser.add_argument("--size", type=_pair, default=(480, 320))
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--kinds", type=lambda text: text.split(","), default=list(KINDS))
    parser.add_argument("--backends", type=lambda text: text.split(","), default=["mujoco"])
    parser.add_argument("--peer-evaluations", type=int, default=4, help="a generation; 0: no peer")
    parser.add_argument("--clips", type=lambda text: [int(n) for n in text.split(",") if n], default=[1, 4, 16])
    parser.add_argument("--clip-budget", type=_pair, default=(128, 100))
    parser.add_argument("--clip-optimizer", default="hybrid")
    parser.add_argument("--clip-backend", default="auto")
    parser.add_argument("--clip-refits", type=int, default=6)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--single", type=int, default=0, help="clips after the first of each kind")
    for name in ("--together", "--populations", "--objects", "--frame-counts"):
        parser.add_argument(name, type=lambda text: [int(n) for n in text.split(",")], default=[])
    parser.add_argument(
        "--sizes", type=lambda text: [_pair(p) for p in text.split(",")], default=[(120, 80), (480, 320)]
    )
    parser.add_argument("--second", action="store_true")
    parser.add_argument("--gpu-peers", type=lambda text: text.split(","), default=[])
    parser.add_argument("--roofline", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    os.environ["MJX_REFINE_CACHE"] = "off"
    print(f"{machine()}; load {os.getloadavg()[0]:.1f} of others at the start")
    print("; ".join(f"{name} {version(name)}" for name in PACKAGES) + f"; {platform.platform()}")
    print(f"`python -m benchmarks.speed {' '.join(sys.argv[1:])}`")
    update = update_times(84, 128, 30)
    print(f"\nCMA-ES update (ask and tell), 84 dimensions, population 128, ms: {update}")
    rows = parts_table(arguments) if arguments.backends != [""] else {}
    if arguments.peer_evaluations:
        peer_table(arguments, rows)
    device_tables(arguments)
    if arguments.clips:
        clips_table(arguments)
    print(f"\nload at the end {os.getloadavg()[0]:.1f}")
    if arguments.json:
        write_text(
            arguments.json,
            json.dumps({"machine": machine(), "update_ms": 1e3 * update.median, "parts": rows}, indent=1),
        )


if __name__ == "__main__":
    main()
