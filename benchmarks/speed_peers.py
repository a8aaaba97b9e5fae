"""What a user would write on a GPU instead: MJX-Warp with its own renderer, and plain MJX with rays by matrix products."""

from __future__ import annotations

import dataclasses
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from benchmarks.speed_scenes import KINDS, Times, near, times
from mjx_refine.sim.mjx import MjxSimulator
from mjx_refine.sim.mjx_import import mjx
from mjx_refine.sim.model import apply_fields, build_spec, model_fields
from mjx_refine.sim.warp import WarpSimulator, contact_points
from mjx_refine.simulate import simulate
from mjx_refine.space import Space
from mjx_refine.view.frames import frames_of_batch
from mjx_refine.view.rays import HIT


@dataclasses.dataclass(frozen=True)
class GpuPeer:
    """Of a generation [s]."""

    physics: Times
    pictures: Times
    compiled: float
    note: str


def _batch(kind: str, population: int):
    space = Space.around(near(KINDS[kind], 1))
    steps = 0.3 * space.sigma * np.random.default_rng(0).normal(size=(population, space.dimension))
    return space.decode(np.clip(space.start + steps, 0, 1))


def warp_renderer(kind: str, population: int, count: int, size: tuple[int, int], frames: int = 30) -> GpuPeer:
    """MJX-Warp's physics and ``render_with_segmentation``: masks alone, one camera and one set of sizes for all worlds (the
    renderer's context holds them), and their IoU with the clip."""
    began = time.perf_counter()
    batch, shapes = _batch(kind, population), KINDS[kind].shapes
    simulator = WarpSimulator(shapes, 30.0)
    poses = jax.block_until_ready(simulator.launch(batch, frames)())
    spec = build_spec(shapes, 30.0)
    half = batch.camera_pitch[0] / 2
    spec.worldbody.add_camera(
        name="view",
        pos=batch.camera_position[0],
        quat=[np.cos(half), np.sin(half), 0, 0],
        fovy=np.rad2deg(batch.camera_fovy[0]),
    )
    spec.worldbody.add_light(pos=[0, 0, 5])
    model: mujoco.MjModel = spec.compile()
    apply_fields(model, model_fields(batch), 0, None)
    m = mjx.put_model(model, impl="warp")
    points = contact_points(shapes)
    empty = mjx.make_data(model, impl="warp", naconmax=population * points, njmax=6 * points)
    context = mjx.create_render_context(
        mjm=model, nworld=population, cam_res=size, use_textures=False, use_shadows=False,
        render_rgb=False, render_depth=False, render_seg=True,
    )  # fmt: skip
    key = context.pytree()
    masks = jnp.asarray(simulate(KINDS[kind], size=size, frames=frames).masks.reshape(frames, -1) > 0)

    # The camera stands still: its pose is computed once.
    first = jax.vmap(lambda q: mjx.forward(m, empty.replace(qpos=q)))(poses[:population, 0].reshape(population, -1))

    @jax.jit
    def placed(qpos: Float[Array, "worlds positions"]):
        return jax.vmap(lambda data, q: mjx.kinematics(m, data.replace(qpos=q)))(first, qpos)

    @jax.jit
    def overlap(data, seen: Float[Array, "pixels"]):
        segmented = mjx.render_with_segmentation(m, mjx.refit_bvh(m, data, key), key)[2]
        drawn = segmented[..., 0] > 0  # the floor is geom 0
        return (drawn & seen).sum(-1), (drawn | seen).sum(-1)

    def generation() -> float:
        total = 0.0
        for t in range(frames):
            both, either = overlap(placed(poses[:population, t].reshape(population, -1)), masks[t])
            total = total + both / jnp.maximum(either, 1)
        return float(jnp.max(total) / frames)  # type: ignore[arg-type]

    best = generation()
    compiled = time.perf_counter() - began
    physics = times(lambda: jax.block_until_ready(simulator.launch(batch, frames)()), count)
    return GpuPeer(physics, times(generation, count), compiled, f"best IoU {best:.3f}")


def plain_mjx(kind: str, population: int, count: int, size: tuple[int, int], frames: int = 30) -> GpuPeer:
    """MJX-JAX for one clip, then every pixel's ray turned into every object's frame by matrix products, frame by frame."""
    began = time.perf_counter()
    batch, shapes = _batch(kind, population), KINDS[kind].shapes
    simulator = MjxSimulator(shapes, 30.0)
    poses = jax.block_until_ready(simulator.launch(batch, frames)())
    observation = simulate(KINDS[kind], size=size, frames=frames)
    focal = (size[1] / 2) / np.tan(batch.camera_fovy[0] / 2)
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    rays = jnp.asarray(
        np.stack([(x - size[0] / 2) / focal, -(y - size[1] / 2) / focal, -np.ones_like(x)], -1).reshape(-1, 3),
        jnp.float32,
    )
    masks = jnp.asarray(observation.masks.reshape(frames, -1))
    flow = jnp.asarray(np.concatenate([observation.flow, observation.flow[-1:]]).reshape(frames, -1, 2), jnp.float32)

    @jax.jit
    def one(part, t):
        nearest, ids, moved = jnp.full((population, len(rays)), 1e9), 0, 0.0
        for k, shape in enumerate(shapes):
            d = jnp.einsum("bij,pj->bpi", part.ray[:, k], rays)
            o = jnp.broadcast_to(part.origin[:, None, k], d.shape)
            extent = jnp.broadcast_to(part.size[:, None, k], d.shape)
            hit = HIT[shape](*(tuple(jnp.moveaxis(a, -1, 0)) for a in (o, d, extent)))
            point = (
                jnp.einsum("bij,bpj->bpi", part.next_matrix[:, k], o + hit[..., None] * d)
                + part.next_offset[:, None, k]
            )
            projected = point[..., :2] / -jnp.minimum(point[..., 2:], -1e-6) - rays[:, :2]
            closer = hit < nearest
            nearest, ids = jnp.minimum(hit, nearest), jnp.where(closer, k + 1, ids)
            moved = jnp.where(closer[..., None], focal * projected * jnp.array([1.0, -1.0]), moved)
        both, either = ((ids > 0) & (masks[t] > 0)).sum(-1), ((ids > 0) | (masks[t] > 0)).sum(-1)
        return both / jnp.maximum(either, 1), jnp.linalg.norm(moved - flow[t], axis=-1).mean(-1)

    def generation() -> float:
        coefficients = frames_of_batch(poses[:population], batch, size[1])
        by_frame = jax.tree.map(lambda a: a.reshape(population, frames, *a.shape[1:]), coefficients)
        total = jnp.zeros(population)
        for t in range(frames):
            iou, error = one(jax.tree.map(lambda a, t=t: a[:, t], by_frame), t)
            total = total + iou - error
        return float(jnp.max(total) / frames)

    best = generation()
    compiled = time.perf_counter() - began
    physics = times(lambda: jax.block_until_ready(simulator.launch(batch, frames)()), count)
    return GpuPeer(physics, times(generation, count), compiled, f"best fitness {best:.3f}, one field of view for all")
