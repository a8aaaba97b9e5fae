"""The MuJoCo model of a scene kind, and which of its fields a candidate changes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_refine.batch import SceneBatch, uniform_inertia
from mjx_refine.scene import Shape

SUBSTEPS = 8
"""Physics steps a frame, at every frame rate."""

TORSION = 0.005
"""Torsional friction of every contact [m]."""

_IDLE = ("EQUALITY", "FRICTIONLOSS", "LIMIT", "SPRING", "DAMPER", "ACTUATION", "CLAMPCTRL", "SENSOR", "EULERDAMP")
IDLE = sum(int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")) for name in _IDLE)
"""Parts of the engine that find nothing to do in free bodies on a floor: turned off, a step is the same and cheaper."""

_GEOM: dict[Shape, mujoco.mjtGeom] = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}


_SHAPE: dict[int, Shape] = {int(kind): shape for shape, kind in _GEOM.items()}

_HALF = {"sphere": [0, 0, 0], "cylinder": [0, 0, 1], "box": [0, 1, 2]}
"""Which of a geom's sizes are its half extents."""


@dataclasses.dataclass(frozen=True)
class ModelFields:
    """The fields of ``mjModel`` that depend on a candidate, for B candidates, N objects and P contact pairs.

    Geoms and bodies are the N objects' alone (index 0 of the model, the floor and the world, stays as it is).
    """

    geom_size: Float[np.ndarray, "batch objects 3"]
    geom_rbound: Float[np.ndarray, "batch objects"]
    body_mass: Float[np.ndarray, "batch objects"]
    body_inertia: Float[np.ndarray, "batch objects 3"]
    body_invweight0: Float[np.ndarray, "batch objects 2"]
    pair_friction: Float[np.ndarray, "batch pairs 5"]
    pair_solref: Float[np.ndarray, "batch pairs 2"]
    pair_solreffriction: Float[np.ndarray, "batch pairs 2"]
    gravity: Float[np.ndarray, "batch 3"]


def contact_pairs(count: int) -> list[tuple[int, int]]:
    """(first, second) objects of every contact pair; -1 is the floor. Floor pairs come first."""
    floor = [(-1, i) for i in range(count)]
    return floor + [(i, j) for i in range(count) for j in range(i + 1, count)]


def build_spec(
    shapes: tuple[Shape, ...], fps: float, names: tuple[str, ...] | None = None, off_centre: bool = False
) -> mujoco.MjSpec:
    """A spec with the floor, one free body of unit mass for each shape, and explicit contact pairs.

    ``off_centre``: with centres of mass beside the bodies' centres, since the compiler leaves out of a model's mass matrix
    what is zero where they coincide.
    """
    names = names or tuple(f"object_{i}" for i in range(len(shapes)))
    spec = mujoco.MjSpec()
    spec.option.timestep = 1.0 / (fps * SUBSTEPS)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    free = {"contype": 0, "conaffinity": 0}
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], **free)
    for name, shape in zip(names, shapes, strict=True):
        body = spec.worldbody.add_body(name=name, explicitinertial=True, mass=1.0, inertia=[1.0, 1.0, 1.0])
        if off_centre:
            body.ipos = [0.01, 0.01, 0.01]
        body.add_freejoint(name=name)
        body.add_geom(name=name, type=_GEOM[shape], size=[0.1, 0.1, 0.1], **free)
    for first, second in contact_pairs(len(shapes)):
        geoms = ["floor" if i < 0 else names[i] for i in (first, second)]
        spec.add_pair(geomname1=geoms[0], geomname2=geoms[1], condim=6)
    return spec


def model_fields(batch: SceneBatch) -> ModelFields:
    """The model's fields for every candidate, in closed form (a free body's ``invweight0`` is (1/m, mean 1/I))."""
    inertia = uniform_inertia(batch)
    radius, half = batch.size[..., 0], batch.size[..., 1]
    rbound = np.stack(
        [
            {
                "sphere": radius[:, i],
                "cylinder": np.hypot(radius[:, i], half[:, i]),
                "box": np.linalg.norm(batch.size[:, i], axis=-1),
            }[shape]
            for i, shape in enumerate(batch.shapes)
        ],
        axis=1,
    )
    pairs = contact_pairs(len(batch.shapes))
    first = np.array([second if first < 0 else first for first, second in pairs])
    second = np.array([second for _, second in pairs])
    sliding, rolling = np.moveaxis(np.maximum(batch.friction[:, first], batch.friction[:, second]), -1, 0)
    stiffness = np.maximum(batch.stiffness[:, first], batch.stiffness[:, second])
    damping = np.minimum(batch.damping[:, first], batch.damping[:, second])
    grip = np.maximum(batch.grip[:, first], batch.grip[:, second])
    torsion = np.full_like(sliding, TORSION)
    return ModelFields(
        geom_size=batch.size,
        geom_rbound=rbound,
        body_mass=batch.mass,
        body_inertia=inertia,
        body_invweight0=np.stack([1 / batch.mass, (1 / inertia).mean(-1)], -1),
        pair_friction=np.stack([sliding, sliding, torsion, rolling, rolling], -1),
        pair_solref=np.stack([-stiffness, damping], -1),
        pair_solreffriction=np.stack([-stiffness, -grip], -1),
        gravity=batch.gravity,
    )


ABOVE_FLOOR = ("geom_size", "geom_rbound", "geom_aabb", "body_mass", "body_inertia", "body_invweight0", "body_ipos")
"""Names of ``field_arrays`` whose rows are the objects' alone: row 0 of the model's, the floor's or world's, stays."""


def field_arrays(
    shapes: Sequence[Shape],
    fields: ModelFields,
    centre_of_mass: Float[np.ndarray, "batch objects 3"] | None = None,
) -> dict[str, np.ndarray]:
    """What candidates write into the model's arrays, by the arrays' names, with a leading batch axis.

    ``centre_of_mass`` is in the bodies' frames [m]; the moments of inertia about it stay those of the uniform body.
    """
    mass, weight = fields.body_mass, fields.body_invweight0
    half = half_extents(shapes, fields.geom_size)
    arrays = {
        "geom_size": fields.geom_size,
        "geom_rbound": fields.geom_rbound,
        "geom_aabb": np.concatenate([np.zeros_like(half), half], -1),
        "body_mass": mass,
        "body_subtreemass": np.concatenate([mass.sum(1, keepdims=True), mass], 1),
        "body_inertia": fields.body_inertia,
        "body_invweight0": weight,
        "dof_invweight0": np.repeat(weight, 3, axis=-1).reshape(len(weight), -1),
        "dof_M0": np.concatenate([np.repeat(mass[..., None], 3, -1), fields.body_inertia], -1).reshape(len(mass), -1),
        "pair_friction": fields.pair_friction,
        "pair_solref": fields.pair_solref,
        "pair_solreffriction": fields.pair_solreffriction,
    }
    # Of a model that ``build_spec`` made off centre.
    return arrays if centre_of_mass is None else arrays | {"body_ipos": centre_of_mass}


class Edited:
    """A model that is edited in place, candidate by candidate, as the compiler would have made it.

    Args:
      model: of the scene kind.
      names: of the arrays to be edited.
    """

    def __init__(self, model: mujoco.MjModel, names: Iterable[str]):
        self.model = model
        self._views = [getattr(model, name)[1:] if name in ABOVE_FLOOR else getattr(model, name) for name in names]

    def write(self, arrays: Iterable[np.ndarray], mean_inertia: float, gravity: Float[np.ndarray, "3"]) -> None:
        """Writes one candidate's ``arrays``, in the order of the names."""
        for view, values in zip(self._views, arrays, strict=True):
            view[...] = values
        self.model.stat.meaninertia = mean_inertia
        self.model.opt.gravity[:] = gravity


def apply_fields(
    model: mujoco.MjModel, fields: ModelFields, row: int, centre_of_mass: Float[np.ndarray, "objects 3"] | None = None
) -> None:
    """Writes candidate ``row`` into ``model`` in place; ``centre_of_mass`` as in ``field_arrays``."""
    one = ModelFields(**{f.name: getattr(fields, f.name)[row : row + 1] for f in dataclasses.fields(fields)})
    centre = None if centre_of_mass is None else centre_of_mass[None]
    arrays = field_arrays([_SHAPE[int(kind)] for kind in model.geom_type[1:]], one, centre)
    only = [array[0] for array in arrays.values()]
    Edited(model, arrays).write(only, float(arrays["dof_M0"].mean()), fields.gravity[row])


def half_extents(
    shapes: Sequence[Shape], size: Float[np.ndarray, "*batch objects 3"]
) -> Float[np.ndarray, "*batch objects 3"]:
    """Of the box about each body, along its own axes [m]."""
    return np.stack([size[..., i, _HALF[shape]] for i, shape in enumerate(shapes)], -2)


def initial_state(batch: SceneBatch) -> tuple[np.ndarray, np.ndarray]:
    """``qpos`` (B, 7N) and ``qvel`` (B, 6N) of the first frame."""
    qpos = np.concatenate([batch.position, batch.quaternion], -1).reshape(len(batch), -1)
    qvel = np.concatenate([batch.linear_velocity, batch.angular_velocity], -1).reshape(len(batch), -1)
    return qpos, qvel
