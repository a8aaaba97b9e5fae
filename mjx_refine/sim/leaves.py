"""The fields of an MJX model that a candidate changes, as arrays that can be batched and differentiated."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_refine.batch import SceneBatch
from mjx_refine.effects import acting
from mjx_refine.scene import Shape
from mjx_refine.sim.mjx_import import mjx
from mjx_refine.sim.model import model_fields


class Leaves(NamedTuple):
    """``ModelFields`` of one candidate, N objects and P contact pairs (of a batch: with a leading axis)."""

    geom_size: Float[Array, "objects 3"]
    geom_rbound: Float[Array, "objects"]
    body_mass: Float[Array, "objects"]
    body_inertia: Float[Array, "objects 3"]
    body_invweight0: Float[Array, "objects 2"]
    pair_friction: Float[Array, "pairs 5"]
    pair_solref: Float[Array, "pairs 2"]
    pair_solreffriction: Float[Array, "pairs 2"]
    gravity: Float[Array, "3"]
    body_ipos: Float[Array, "objects 3"] | None = None
    """Centres of mass in the bodies' frames [m]; None: at the centres, and nothing is computed with them."""


def leaves_of(batch: SceneBatch) -> Leaves:
    """The leaves of every candidate, with a leading batch axis, in JAX's default precision."""
    fields = model_fields(batch)
    leaves = Leaves(*(jnp.asarray(getattr(fields, f.name)) for f in dataclasses.fields(fields)))
    centre = acting.centre_of_mass(batch) if batch.effects else None
    return leaves if centre is None else leaves._replace(body_ipos=jnp.asarray(centre))


def candidate_model(base: mjx.Model, leaves: Leaves, shapes: tuple[Shape, ...]) -> mjx.Model:
    """``base`` with one candidate's fields; index 0 of geoms and bodies (the floor, the world) stays as it is."""

    def keep_first(old: jax.Array, new: jax.Array) -> jax.Array:
        return jnp.concatenate([old[:1], new.astype(old.dtype)])

    mass = leaves.body_mass
    centre = {} if leaves.body_ipos is None else {"body_ipos": keep_first(base.body_ipos, leaves.body_ipos)}
    changed = base.tree_replace(
        {
            "geom_size": keep_first(base.geom_size, leaves.geom_size),
            "geom_rbound": keep_first(base.geom_rbound, leaves.geom_rbound),
            "geom_aabb": keep_first(base.geom_aabb, _boxes(base.geom_aabb[1:], leaves.geom_size, shapes)),
            "body_mass": keep_first(base.body_mass, mass),
            "body_subtreemass": jnp.concatenate([mass.sum(keepdims=True), mass]).astype(base.body_mass.dtype),
            "body_inertia": keep_first(base.body_inertia, leaves.body_inertia),
            "body_invweight0": keep_first(base.body_invweight0, leaves.body_invweight0),
            "dof_invweight0": jnp.repeat(leaves.body_invweight0, 3, axis=-1).reshape(-1),
            "pair_friction": leaves.pair_friction,
            "pair_solref": leaves.pair_solref,
            "pair_solreffriction": leaves.pair_solreffriction,
            "opt.gravity": leaves.gravity,
            **centre,
        }
    )
    return cast(mjx.Model, changed)


def _boxes(old: jax.Array, size: jax.Array, shapes: tuple[Shape, ...]) -> jax.Array:
    """Bounding boxes (centre, half extents) in the layout of ``old``: (N, 6) in MJX-JAX, (N, 2, 3) in MJX-Warp."""
    order = {"sphere": [0, 0, 0], "cylinder": [0, 0, 1], "box": [0, 1, 2]}
    half = jnp.stack([size[i, jnp.array(order[shape])] for i, shape in enumerate(shapes)])
    return jnp.concatenate([jnp.zeros_like(half), half], -1).reshape(old.shape)
