"""Scenes as arrays: a batch of candidates of one scene kind, the currency between space, simulation and views."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from mjx_refine.scene import Body, Camera, Scene, Shape

GRIP = 30.0
"""Of every scene's contacts [1/s] (minus the second number of ``solreffriction``): softer makes friction syrup, harder makes
sliding bodies hop."""


@dataclasses.dataclass(frozen=True)
class BatchEffect:
    """One effect of every candidate.

    Attributes:
      name: of its kind.
      target: index of the object that it acts on, or -1.
      values: its parameters, in the kind's order and units.
    """

    name: str
    target: int
    values: Float[np.ndarray, "batch parameters"]


@dataclasses.dataclass(frozen=True)
class Restart:
    """An object that goes on from a state of its own in every candidate, wherever its path has led it (multiple shooting).

    Attributes:
      frame: in which it has that state, > 0; of the frames that are shown.
      target: index of the object.
      state: position [m], quaternion w x y z, linear velocity (world frame) [m/s] and angular velocity (body frame) [rad/s].
    """

    frame: int
    target: int
    state: Float[np.ndarray, "batch 13"]


@dataclasses.dataclass(frozen=True)
class SceneBatch:
    """B candidates of one scene kind with N objects, float64.

    Attributes:
      shapes: the N primitives, the same for every candidate.
      size: MuJoCo's ``geom_size``: sphere (r, 0, 0), box half extents, cylinder (r, HALF height, 0) [m].
      mass: [kg].
      friction: (sliding [1], rolling [m]).
      damping: contact damping, <= 0 [1/s].
      stiffness: > 0 [1/s^2].
      grip: damping of friction, > 0 [1/s]: how soon a contact takes slip away where its friction is enough.
      position: centres at the first frame, world frame [m].
      quaternion: unit, w x y z, body to world.
      linear_velocity: world frame [m/s].
      angular_velocity: body frame [rad/s].
      gravity: [m/s^2].
      camera_position: [m].
      camera_pitch: rotation about the world's x axis, 0 looks straight down [rad].
      camera_fovy: vertical field of view [rad].
      effects: what the base model lacks, the same kinds for every candidate.
      restarts: of objects along the way, at the same frames for every candidate; C MuJoCo alone carries them.
    """

    shapes: tuple[Shape, ...]
    size: Float[np.ndarray, "batch objects 3"]
    mass: Float[np.ndarray, "batch objects"]
    friction: Float[np.ndarray, "batch objects 2"]
    damping: Float[np.ndarray, "batch objects"]
    stiffness: Float[np.ndarray, "batch objects"]
    grip: Float[np.ndarray, "batch objects"]
    position: Float[np.ndarray, "batch objects 3"]
    quaternion: Float[np.ndarray, "batch objects 4"]
    linear_velocity: Float[np.ndarray, "batch objects 3"]
    angular_velocity: Float[np.ndarray, "batch objects 3"]
    gravity: Float[np.ndarray, "batch 3"]
    camera_position: Float[np.ndarray, "batch 3"]
    camera_pitch: Float[np.ndarray, "batch"]
    camera_fovy: Float[np.ndarray, "batch"]
    effects: tuple[BatchEffect, ...] = ()
    restarts: tuple[Restart, ...] = ()

    def __len__(self) -> int:
        return len(self.mass)

    def __getitem__(self, rows: slice | np.ndarray) -> SceneBatch:
        """The candidates in ``rows``, as a batch."""
        return self.map(lambda array: array[rows])

    def map(self, function) -> SceneBatch:
        """Applies ``function`` to every array."""
        changed = {name: function(getattr(self, name)) for name in ARRAYS}
        effects = tuple(dataclasses.replace(e, values=function(e.values)) for e in self.effects)
        restarts = tuple(dataclasses.replace(r, state=function(r.state)) for r in self.restarts)
        return dataclasses.replace(self, effects=effects, restarts=restarts, **changed)


ARRAYS = tuple(f.name for f in dataclasses.fields(SceneBatch) if f.name not in ("shapes", "effects", "restarts"))
"""The fields that hold one row a candidate."""


def concatenate(batches: list[SceneBatch]) -> SceneBatch:
    """One batch of all candidates; shapes and kinds of effects must be equal.

    Raises:
      ValueError: no batch, or the scene kinds differ.
    """
    kinds = [
        (b.shapes, [(e.name, e.target) for e in b.effects], [(r.frame, r.target) for r in b.restarts]) for b in batches
    ]
    if not batches or any(kind != kinds[0] for kind in kinds):
        raise ValueError(f"scene kinds {kinds}; expected at least one, all with the same shapes, effects and restarts")
    arrays = {name: np.concatenate([getattr(batch, name) for batch in batches]) for name in ARRAYS}
    effects = tuple(
        dataclasses.replace(e, values=np.concatenate([b.effects[k].values for b in batches]))
        for k, e in enumerate(batches[0].effects)
    )
    restarts = tuple(
        dataclasses.replace(r, state=np.concatenate([b.restarts[k].state for b in batches]))
        for k, r in enumerate(batches[0].restarts)
    )
    return SceneBatch(batches[0].shapes, **arrays, effects=effects, restarts=restarts)


def geom_size(body: Body) -> tuple[float, float, float]:
    """MuJoCo's ``geom_size`` of a body [m]."""
    if body.shape == "sphere":
        return (body.size[0], 0.0, 0.0)
    if body.shape == "cylinder":
        return (body.size[0], body.size[1] / 2, 0.0)
    return (body.size[0], body.size[1], body.size[2])


def batch_from_scenes(scenes: list[Scene]) -> SceneBatch:
    """Scenes of one kind as a batch, without their effects (``effects.batch_with_effects`` has them).

    Raises:
      ValueError: no scene, or the scenes' kinds differ.
    """
    if not scenes or any(scene.shapes != scenes[0].shapes for scene in scenes):
        raise ValueError(f"scene kinds {[s.shapes for s in scenes]}; expected at least one, all with the same shapes")

    def rows(value) -> np.ndarray:
        return np.array([[value(body) for body in scene.objects] for scene in scenes], np.float64)

    return SceneBatch(
        shapes=scenes[0].shapes,
        size=rows(geom_size),
        mass=rows(lambda b: b.mass),
        friction=rows(lambda b: b.friction),
        damping=rows(lambda b: b.damping),
        stiffness=rows(lambda b: b.stiffness),
        grip=rows(lambda b: GRIP),
        position=rows(lambda b: b.position),
        quaternion=rows(lambda b: b.orientation),
        linear_velocity=rows(lambda b: b.linear_velocity),
        angular_velocity=rows(lambda b: b.angular_velocity),
        gravity=np.array([s.gravity for s in scenes], np.float64),
        camera_position=np.array([s.camera.position for s in scenes], np.float64),
        camera_pitch=np.deg2rad([s.camera.orientation for s in scenes]),
        camera_fovy=np.deg2rad([s.camera.fovy for s in scenes]),
    )


def scene_from_batch(batch: SceneBatch, row: int, like: Scene) -> Scene:
    """Candidate ``row`` as a scene with the names and effects of ``like``."""
    bodies = []
    for i, body in enumerate(like.objects):
        x, y, z = batch.size[row, i].tolist()
        size = {"sphere": (x,), "cylinder": (x, 2 * y), "box": (x, y, z)}[body.shape]
        bodies.append(
            dataclasses.replace(
                body,
                size=size,
                position=tuple(batch.position[row, i].tolist()),
                orientation=tuple(batch.quaternion[row, i].tolist()),
                linear_velocity=tuple(batch.linear_velocity[row, i].tolist()),
                angular_velocity=tuple(batch.angular_velocity[row, i].tolist()),
                friction=tuple(batch.friction[row, i].tolist()),
                mass=float(batch.mass[row, i]),
                damping=float(batch.damping[row, i]),
                stiffness=float(batch.stiffness[row, i]),
            )
        )
    camera = Camera(
        position=tuple(batch.camera_position[row].tolist()),
        orientation=float(np.rad2deg(batch.camera_pitch[row])),
        fovy=float(np.rad2deg(batch.camera_fovy[row])),
    )
    return dataclasses.replace(like, objects=tuple(bodies), camera=camera, gravity=tuple(batch.gravity[row].tolist()))


def uniform_inertia(batch: SceneBatch) -> Float[np.ndarray, "batch objects 3"]:
    """Principal moments of inertia of bodies of uniform density [kg m^2]."""
    columns = []
    for i, shape in enumerate(batch.shapes):
        x, y, z = np.moveaxis(batch.size[:, i], -1, 0)
        if shape == "sphere":
            unit = np.stack([0.4 * x**2] * 3, -1)
        elif shape == "cylinder":
            across = x**2 / 4 + (2 * y) ** 2 / 12
            unit = np.stack([across, across, x**2 / 2], -1)
        else:
            unit = np.stack([y**2 + z**2, x**2 + z**2, x**2 + y**2], -1) / 3
        columns.append(unit * batch.mass[:, i, None])
    return np.stack(columns, 1)
