"""Random scenes whose derivatives must be numbers, many at a time in one program."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np

from mjx_refine.gradients.differentiator import CHUNK, compiler_options, look, pull, push
from mjx_refine.gradients.tangents import tangents
from mjx_refine.gradients.views import flow_view, outline_view
from mjx_refine.scene import Body, Camera, Scene
from mjx_refine.sim.mjx import MjxSimulator
from mjx_refine.space import Space
from mjx_refine.space.layout import lowest_extent

FPS = 30.0
FRAMES = 3
IMAGE = (320, 240)
BLOCK = 20
KINDS = (
    ("sphere",),
    ("box",),
    ("cylinder",),
    ("sphere", "sphere"),
    ("box", "cylinder"),
    ("sphere", "box", "cylinder"),
)
STATES = ("air", "touching", "resting", "sunk", "out of view", "touching another", "exact")


def random_body(generator: np.random.Generator, shape: str, index: int, state: str, beside: list[Body]) -> Body:
    """A body in one of ``STATES``; "exact" has round numbers, where coordinates and axes coincide."""
    exact = state == "exact"
    scale = 0.2 if exact else float(np.exp(generator.uniform(-3, 0)))
    sides = np.full(3, 1.0) if exact else np.exp(generator.uniform(-0.5, 0.5, 3))
    size = {"sphere": scale * sides[:1], "box": scale * sides, "cylinder": scale * sides[:2] * [1, 2]}[shape]
    turn = np.array([1.0, 0, 0, 0]) if exact or state == "resting" else generator.normal(size=4)
    turn = turn / np.linalg.norm(turn)
    geom = np.array([size[0], size[-1] / 2, 0.0]) if shape == "cylinder" else np.pad(size, (0, 3 - len(size)))
    low = float(lowest_extent(shape, geom[None], turn[None])[0])
    place = generator.normal(size=2) * (40.0 if state == "out of view" else 1.0)
    if exact:
        place = np.array([0.4 * index, 0.0])
    if state == "touching another" and beside:
        other = beside[-1]
        place = np.array(other.position[:2])
        place[1] += np.max(geom) + np.max(other.size)
    gap = {"air": float(generator.uniform(0, 2)), "sunk": -0.05 * low}.get(state, 0.0)
    speed = np.zeros((2, 3)) if state == "resting" or exact else generator.normal(size=(2, 3)) * [[2.0], [6.0]]
    friction = (0.5, 0.01) if exact else (float(generator.uniform(0, 2)), float(generator.uniform(0, 0.1)))
    return Body(
        shape,
        f"{shape}_{index}",
        tuple(size.tolist()),
        (*place.tolist(), low + gap),
        tuple(turn.tolist()),
        tuple(speed[0].tolist()),
        tuple(speed[1].tolist()),
        friction=friction,
        mass=1.0 if exact else float(np.exp(generator.normal())),
        damping=-4.0 if exact else float(-generator.uniform(0, 100)),
    )


def random_scene(generator: np.random.Generator, shapes: tuple[str, ...]) -> Scene:
    """Objects in random states under a random camera."""
    bodies: list[Body] = []
    for index, shape in enumerate(shapes):
        bodies.append(random_body(generator, shape, index, str(generator.choice(STATES)), bodies))
    camera = Camera((0.0, -3.0, float(generator.uniform(0.5, 4))), float(generator.uniform(30, 90)))
    return Scene(tuple(bodies), camera)


def _tangent_rays(reach) -> jax.Array:
    """Pixels where outlines end: the corners of each silhouette's box and the middles of its sides, (T, N, 8, 2)."""
    right, down, left, up = (reach[..., 4 * k] for k in range(4))
    left, up = -left, -up
    middle = (0.5 * (left + right), 0.5 * (up + down))
    xs = (right, middle[0], left, middle[0], right, right, left, left)
    ys = (middle[1], down, middle[1], up, up, down, up, down)
    return jnp.stack([jnp.stack(xs, -1), jnp.stack(ys, -1)], -1)


def _programs(simulator: MjxSimulator, reverse: bool):
    outlines, flow = (view(simulator.shapes, IMAGE, *more) for view, more in ((outline_view, (16,)), (flow_view, ())))

    def forward(inputs, moves):
        # Few tangents at a time, which XLA is quicker with.
        few = jax.tree.map(lambda a: a.reshape(-1, CHUNK, *a.shape[1:]), moves)
        poses, slopes = jax.lax.map(lambda some: push(simulator, FRAMES, inputs, some), few)
        poses, slopes = poses[0], slopes.reshape(-1, *slopes.shape[2:])
        state, along = ((a, i.size, i.camera_position, i.camera_pitch, i.camera_fovy) for a, i in
                        ((poses, inputs), (slopes, moves)))  # fmt: skip
        reach, d_reach = look(outlines, state, along, ())
        _, d_flow = look(flow, state, along, (_tangent_rays(reach),))
        return poses, slopes, d_reach, d_flow

    def backward(inputs):
        def loss(*arrays):
            reach = outlines(*arrays)
            seen = flow(*arrays, jax.lax.stop_gradient(_tangent_rays(reach)))
            return (reach**2).mean() + (seen**2).mean()

        return pull(simulator, FRAMES, loss, inputs, ())[1]

    options = compiler_options()
    both = jax.jit(lambda i, m: jax.lax.map(lambda pair: forward(*pair), (i, m)), compiler_options=options)
    return [both, jax.jit(lambda i: jax.lax.map(backward, i), compiler_options=options)] if reverse else [both]


def hunt(count: int, reverse: bool, seed: int = 0) -> int:
    """Prints, for every scene kind, how many scenes have a derivative that is not a number; returns how many in all."""
    generator = np.random.default_rng(seed)
    share = -(-count // (len(KINDS) * BLOCK)) * BLOCK
    print(f"{'kind':24}{'scenes':>8}{'parameters':>12}{'not finite':>12}{'in reverse':>12}{'s':>8}", flush=True)
    total = 0
    for shapes in KINDS:
        start = time.perf_counter()
        simulator = MjxSimulator(shapes, FPS)
        programs = _programs(simulator, reverse)
        bad, dimension = [0, 0], 0
        for _ in range(share // BLOCK):
            rows = [_row(generator, shapes) for _ in range(BLOCK)]
            dimension = max(row[1].qpos.shape[0] for row in rows)
            inputs, moves = jax.tree.map(lambda *a: jnp.asarray(np.stack(a)), *rows)
            for k, program in enumerate(programs):
                found = program(inputs, moves) if k == 0 else program(inputs)
                finite = np.ones(BLOCK, bool)
                for leaf in jax.tree.leaves(found):
                    finite &= np.isfinite(np.asarray(leaf)).reshape(BLOCK, -1).all(1)
                bad[k] += int((~finite).sum())
        spent = time.perf_counter() - start
        said = f"{bad[1]:12d}" if reverse else f"{'-':>12}"
        print(f"{'+'.join(shapes):24}{share:8d}{dimension:12d}{bad[0]:12d}{said}{spent:8.0f}", flush=True)
        total += sum(bad)
    return total


def _row(generator: np.random.Generator, shapes: tuple[str, ...]):
    """Inputs and tangents of one scene, tangents of zero added up to a number that does not depend on the scene."""
    space = Space.around(random_scene(generator, shapes))
    # Half of the scenes at a start, which may lie at bounds, half somewhere near.
    point = space.start
    if generator.random() < 0.5:
        point = np.clip(point + 0.5 * space.sigma * generator.standard_normal(space.dimension), 0.0, 1.0)
    inputs, moves = tangents(space, point)
    most = -(-(4 + 22 * len(shapes)) // CHUNK) * CHUNK
    return inputs, jax.tree.map(lambda a: np.concatenate([a, np.zeros((most - len(a), *a.shape[1:]))]), moves)
