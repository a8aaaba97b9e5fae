"""The kernel of a scene kind, compiled by Warp."""

# pyright: reportInvalidTypeForm=false

from __future__ import annotations

import functools
from importlib import resources
from typing import Any

import warp as wp

from mjx_refine.sim.model import SUBSTEPS
from mjx_refine.sim.parallel import ALIGNED, SQUARE

PARTS = ("world", "simple", "convex", "solver", "rollout")

NEWTON, LINE = 8, 6
"""Newton's iterations a step, and slopes that a line search looks at, at most."""

TOLERANCE = 1e-6
"""Newton's decrement, over the bodies' mean inertia, at which a step ends [m^2/s^4]."""

MOST = 32
"""Contacts that a candidate can have at once; more are left out."""

LANES = 32

CONVEX = {"CYLINDERS": 7, "CYLINDER_AND_BOX": 10, "BOXES": 11}
"""Kinds of pairs that all lanes work on together, by the names that the source has for their presence."""


def _source(bodies: int, spots: int, kinds: frozenset[int]) -> str:
    """The kernel's C++, the body of a function: its structures are local to it."""
    numbers = {
        "BODIES": bodies,
        "DOFS": 6 * bodies,
        "PAIRS": bodies * (bodies + 1) // 2,
        "SPOTS": spots,
        "CONTACTS": min(spots, MOST),
        "SUBSTEPS": SUBSTEPS,
        "NEWTON": NEWTON,
        "LINE": LINE,
        "TOLERANCE": f"{TOLERANCE:.9e}f",
        "ALIGNED": f"{ALIGNED:.9f}f",
        "SQUARE": f"{SQUARE:.9f}f",
        **{name: int(kind in kinds) for name, kind in CONVEX.items()},
    }
    defined = "\n".join(f"#define {name} {value}" for name, value in numbers.items())
    parts = "\n".join(resources.files("mjx_refine.sim.fused").joinpath(f"{part}.h").read_text() for part in PARTS)
    undefined = "\n".join(f"#undef {name}" for name in (*numbers, "LANES", "SYNC", "EACH", "SAMPLED"))
    return f"""
{defined}
#if defined(__CUDA_ARCH__)
#define LANES {LANES}
#define SYNC __syncwarp()
#else
#define LANES 1
#define SYNC
#endif
#define EACH(i, n) for (int i = lane; i < (n); i += LANES)
#define SAMPLED(index, n, value) {{ \\
    float low = 1e30f; \\
    EACH(i, n) {{ \\
        float f = value; \\
        if (f < low) {{ low = f; index = i; }} \\
    }} \\
    least_of_all(low, index); \\
}}
struct Engine {{
{parts}
}};
#if defined(__CUDA_ARCH__)
__shared__ float memory[(sizeof(Engine::Room) + 3) / 4];
Engine::Room& room = *reinterpret_cast<Engine::Room*>(memory);
#else
Engine::Room room;
#endif
Engine engine{{room, thread % LANES}};
int candidate = thread / LANES;
engine.run(packed.data + candidate * width, plan.data, poses.data + candidate * frames * 7 * BODIES, frames, dt);
{undefined}
"""


@functools.cache
def kernel(bodies: int, spots: int, kinds: frozenset[int]) -> Any:
    """The kernel for so many bodies, points where their pairs may touch, and kinds of ``CONVEX`` among the pairs.

    Its inputs: the packed candidates (flat) and how many numbers each has, the plan of pairs, frames, time step [s], and the
    poses that it writes (flat). It is launched with a warp a candidate on a GPU, and one thread a candidate on a CPU.
    """

    @wp.func_native(_source(bodies, spots, kinds))
    def simulate(
        thread: int,
        packed: wp.array(dtype=float),
        width: int,
        plan: wp.array(dtype=int),
        frames: int,
        dt: float,
        poses: wp.array(dtype=float),
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options={"fast_math": True})
    def rollout(
        packed: wp.array(dtype=float),
        width: int,
        plan: wp.array(dtype=int),
        frames: int,
        dt: float,
        poses: wp.array(dtype=float),
    ):
        simulate(wp.tid(), packed, width, plan, frames, dt, poses)

    return rollout
