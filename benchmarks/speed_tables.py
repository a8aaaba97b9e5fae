"""Tables of the speed benchmark that are about devices: scaling, GPU peers, a second process, the picture kernel's limits."""

from __future__ import annotations

import functools
import resource
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp

from benchmarks.speed_peers import plain_mjx, warp_renderer
from benchmarks.speed_scale import first_generation, pictures, together
from benchmarks.speed_scenes import KINDS, make_clip
from mjx_refine import load_observation, load_scenes, refine
from mjx_refine.view import grid
from mjx_refine.view.frames import Frames

GIB = 2**30

PEAK = "most memory so far: JAX's on the device, the process', GiB"


def _head(title: str, columns: list[str]) -> None:
    print(f"\n{title}\n| {' | '.join(columns)} |\n" + "| --- " * len(columns) + "|", flush=True)


def _peak() -> str:
    """What JAX's allocator and the process held at most since the process began."""
    told = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return f"{'–' if told is None else f'{told / GIB:.2f}'}; {own / GIB:.2f}"


def together_table(kinds: list[str], backend: str, clips: list[int], population: int, count: int, size) -> None:
    """Generations of several clips in lock-step."""
    _head(
        f"Clips in lock-step, {backend}, ms a generation of {population} a clip, parts waited for: median of {count}",
        ["kind", "clips", "propose", "physics", "pictures 160 wide", "learn", "whole", "a clip", PEAK],
    )
    for kind in kinds:
        for number in clips:
            g = together(kind, number, backend, population, count, size)
            print(f"| {kind} | {number} | {g.ask} | {g.physics} | {g.pictures} | {g.tell} | {g.whole} "
                  f"| {1e3 * g.whole.median / number:.1f} | {_peak()} |", flush=True)  # fmt: skip


def single_table(kinds: list[str], count: int, size) -> None:
    """Whole refinements of one clip each, as a user calls them: the first of its kind compiles what is not cached."""
    _head(
        "One clip, refine(...) with intervals, the default budget, s from call to result",
        ["kind", "first clip", "of it compilation", *(f"clip {k + 2}" for k in range(count)), "of the last, search",
         "IoU before, after (means of all but the first)", "on"],
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as temporary:
        for kind in kinds:
            folders = [make_clip(Path(temporary) / f"{kind} {k}".replace(" ", "_"), kind, k + 1, size, 30)
                       for k in range(count + 1)]  # fmt: skip
            results = [refine(load_scenes(f / "best32.yaml"), load_observation(f / "flows.npz")) for f in folders]
            later = results[1:] or results
            before, after = (sum(float(getattr(r, w).scores.iou[0]) for r in later) / len(later)
                             for w in ("init", "refined"))  # fmt: skip
            cells = [f"{r.seconds['total']:.1f}" for r in results[1:]]
            print(f"| {kind} | {results[0].seconds['total']:.1f} | {results[0].seconds['compile']:.1f} | {' | '.join(cells)} "
                  f"| {results[-1].seconds['search']:.1f} | {before:.3f}, {after:.3f} | {results[-1].device} |",
                  flush=True)  # fmt: skip


def frames_table(kind: str, backend: str, frames: list[int], population: int, count: int, size) -> None:
    """Generations of one clip by its length."""
    _head(
        f"One clip of {kind}, {backend}, ms a generation of {population}",
        ["frames", "physics", "pictures 160 wide", "whole"],
    )
    for number in frames:
        g = together(kind, 1, backend, population, count, size, number)
        print(f"| {number} | {g.physics} | {g.pictures} | {g.whole} |", flush=True)


def population_table(kind: str, backend: str, populations: list[int], count: int, size) -> None:
    """Generations of one clip by population."""
    _head(
        f"One clip of {kind}, {backend}, ms a generation", ["population", "physics", "pictures 160 wide", "whole", PEAK]
    )
    for population in populations:
        g = together(kind, 1, backend, population, count, size)
        print(f"| {population} | {g.physics} | {g.pictures} | {g.whole} | {_peak()} |", flush=True)


def pictures_table(objects: list[int], sizes: list[tuple[int, int]], population: int, count: int) -> None:
    """Pictures by size and by objects, every pixel compared."""
    _head(
        f"Pictures of {population} candidates, 30 frames, every pixel, ms",
        ["objects", *(f"{w}x{h}" for w, h in sizes), PEAK],
    )
    for number in objects:
        cells = [str(pictures(number, size, population, count)) for size in sizes]
        print(f"| {number} | {' | '.join(cells)} | {_peak()} |", flush=True)


def second_process_table(kinds: list[str], backends: list[str], size) -> None:
    """From a process's start to its first generation, its kind's programs on disk from a process before."""
    _head("Second process of a kind, s from its start to the end of its first generation", ["kind", *backends])
    with tempfile.TemporaryDirectory() as temporary:
        for kind in kinds:
            clip = make_clip(Path(temporary) / kind.replace(" ", "_"), kind, 1, size, 30)
            cells = [[first_generation(clip, backend) for _ in range(2)][1] for backend in backends]
            print(f"| {kind} | {' | '.join(f'{s:.1f}' for s in cells)} |", flush=True)


def gpu_peers_table(names: list[str], kinds: list[str], population: int, count: int, size) -> None:
    """The peers on a GPU, a generation each."""
    _head(
        f"Peers, a generation of {population} at {size[0]}x{size[1]}, ms",
        ["peer", "kind", "physics", "pictures", "compiled and first, s", "found"],
    )
    peers = {
        "b": ("MJX-Warp, render_with_segmentation; masks only", warp_renderer),
        "c": ("plain MJX, matrix-product rays", plain_mjx),
    }
    for name in names:
        label, run = peers[name]
        for kind in kinds:
            try:
                p = run(kind, population, count, size)
                print(f"| {label} | {kind} | {p.physics} | {p.pictures} | {p.compiled:.1f} | {p.note} |", flush=True)
            except Exception as error:  # a peer that cannot do it is told as it is
                print(f"| {label} | {kind} | | | | cannot: {' '.join(str(error).split())[:160]} |", flush=True)


def roofline_table(kinds: list[str], population: int, count: int) -> None:
    """The picture kernel: operations and bytes a sample as XLA counts them, and the rate between two sizes of picture."""
    _head(
        "Picture kernel: XLA's count a sample, and what a sample costs more from 240x160 to 480x320",
        ["kind", "flops", "bytes", "ps a sample", "Tflop/s", "GB/s"],
    )
    for kind in kinds:
        flops, bytes_ = _counted(kind)
        small, large = (pictures(len(KINDS[kind].shapes), size, population, count) for size in ((240, 160), (480, 320)))
        samples = population * 30 * (480 * 320 - 240 * 160)
        seconds = max(large.median - small.median, 1e-9) / samples
        print(f"| {kind} | {flops:.0f} | {bytes_:.0f} | {1e12 * seconds:.1f} | {flops / seconds / 1e12:.1f} "
              f"| {bytes_ / seconds / 1e9:.0f} |", flush=True)  # fmt: skip


def _counted(kind: str, candidates: int = 8, length: int = 30, samples: int = 160 * 107) -> tuple[float, float]:
    """(flops, bytes) a sample of the kernel, from XLA's cost analysis."""
    shapes = KINDS[kind].shapes
    rows, n = candidates * length, len(shapes)

    def numbers(*shape: int, dtype=jnp.float32) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, dtype)

    frames = Frames(
        ray=numbers(rows, n, 3, 3), origin=numbers(rows, n, 3), size=numbers(rows, n, 3), next_matrix=numbers(rows, n, 3, 3),
        next_offset=numbers(rows, n, 3), down=numbers(rows, 3), height=numbers(rows), focal=numbers(rows),
    )  # type: ignore[arg-type]  # fmt: skip
    clip = numbers(1, length, samples)
    clips = grid._Clips(numbers(samples), numbers(samples), numbers(1, length, samples, dtype=jnp.int8), clip, clip)  # type: ignore
    kernel = functools.partial(grid._chunk_sums, shapes, (480, 320), False, length=length)
    cost = jax.jit(kernel).lower(frames, clips, numbers(dtype=jnp.int32)).compile().cost_analysis()
    cost = cost[0] if isinstance(cost, list) else cost
    return cost["flops"] / (rows * samples), cost["bytes accessed"] / (rows * samples)
