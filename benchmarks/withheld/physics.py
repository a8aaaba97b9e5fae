"""PyBullet with unmodelled forces: every effect that acts on motion, written for this engine."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pybullet
from jaxtyping import Float

from benchmarks.clips import bounce, rotation
from benchmarks.clips.bullet import Entry, bodies, quiet
from benchmarks.withheld import forces, solids
from benchmarks.withheld.effect import Effect, named
from benchmarks.withheld.track import RATE, Track, continuous

NO_LOSS = {"lateralFriction": 1, "rollingFriction": 0, "spinningFriction": 0, "restitution": 1}


@contextlib.contextmanager
def _client() -> Iterator[int]:
    with quiet():
        client = pybullet.connect(pybullet.DIRECT)
        try:
            yield client
        finally:
            pybullet.disconnect(client)


def slope_rotation(x: float, y: float) -> Float[np.ndarray, "3 3"]:
    """Turns the floor about world x by `x` degrees, then about world y by `y` degrees."""
    about_x = rotation.about(np.array([1.0, 0, 0]), np.radians(x))
    about_y = rotation.about(np.array([0.0, 1, 0]), np.radians(y))
    return rotation.matrix(rotation.product(about_y, about_x))


def inertia(entry: Entry) -> list[float]:
    """Principal moments of the uniform solid, kg m^2."""
    mass, half = entry["physics"]["mass"], solids.half_extents(entry)
    if entry["type"] == "sphere":
        return [0.4 * mass * half[0] ** 2] * 3
    if entry["type"] == "box":
        squares = half**2
        return [mass / 3 * float(squares.sum() - s) for s in squares]
    across = mass * (3 * half[0] ** 2 + 4 * half[2] ** 2) / 12
    return [across, across, mass * half[0] ** 2 / 2]


class _Stage:
    """One scene in one client, with its effects."""

    def __init__(self, client: int, entries: list[Entry], effects: tuple[Effect, ...]):
        self.client, self.effects, self.objects = client, effects, bodies(entries)
        self.gravity = np.array(next(e for e in entries if e["type"] == "gravity")["gravity"], float)
        slope = named(effects, "slope")
        self.tilt = slope_rotation(slope.parameters["x"], slope.parameters["y"]) if slope else np.eye(3)
        self.floor = self._static(pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client))
        self._turn(self.floor, np.zeros(3), self.tilt)
        self.centre = np.zeros((len(self.objects), 3))
        offset = named(effects, "offset_com")
        if offset is not None and offset.target is not None:
            self.centre[offset.target] = [offset.parameters[k] for k in "xyz"]
        self.ids = [self._body(entry, centre) for entry, centre in zip(self.objects, self.centre, strict=True)]
        self.wall = self._wall()
        self.touched = np.zeros((len(self.ids), len(self.ids)), bool)
        self.hit: tuple[float, float] | None = None
        pybullet.setGravity(*self.gravity, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=1 / RATE,
            numSolverIterations=100,
            restitutionVelocityThreshold=0.1,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )

    def _static(self, shape: int, **options: Any) -> int:
        # Bullet multiplies two bodies' numbers: with ones here the object's own numbers hold.
        body = pybullet.createMultiBody(0, shape, physicsClientId=self.client, **options)
        pybullet.changeDynamics(body, -1, contactProcessingThreshold=0, physicsClientId=self.client, **NO_LOSS)
        return body

    def _turn(self, body: int, place: np.ndarray, turn: np.ndarray) -> None:
        pybullet.resetBasePositionAndOrientation(body, place, quaternion(turn), physicsClientId=self.client)

    def _body(self, entry: Entry, centre: Float[np.ndarray, "3"]) -> int:
        p, c, physics, state = pybullet, self.client, entry["physics"], entry["state"]
        if entry["type"] == "sphere":
            shape = p.createCollisionShape(p.GEOM_SPHERE, radius=entry["radius"], physicsClientId=c)
        elif entry["type"] == "box":
            shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=entry["size"], physicsClientId=c)
        else:
            size = {"radius": entry["radius"], "height": entry["height"]}
            shape = p.createCollisionShape(p.GEOM_CYLINDER, physicsClientId=c, **size)
        body = p.createMultiBody(physics["mass"], shape, baseInertialFramePosition=centre.tolist(), physicsClientId=c)
        # On a slope everything starts as it would on the flat floor, turned with it.
        turn = self.tilt @ rotation.matrix(np.asarray(state["orientation"], float))
        spin = turn @ np.asarray(state["angular_velocity"], float)
        arm = turn @ centre
        self._turn(body, self.tilt @ np.asarray(state["position"], float) + arm, turn)
        velocity = self.tilt @ np.asarray(state["linear_velocity"], float) + np.cross(spin, arm)
        p.resetBaseVelocity(body, velocity.tolist(), spin.tolist(), physicsClientId=c)
        p.changeDynamics(
            body,
            -1,
            lateralFriction=physics["friction"][0],
            rollingFriction=physics["friction"][1],
            spinningFriction=0.005,
            restitution=bounce.restitution(physics["damping"]),
            contactProcessingThreshold=0,
            localInertiaDiagonal=inertia(entry),
            linearDamping=0,
            angularDamping=0,
            activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=c,
        )
        return body

    def _wall(self) -> int | None:
        """An invisible post or box that only the target can hit."""
        effect = named(self.effects, "hidden_obstacle")
        if effect is None or effect.target is None:
            return None
        p, c, how = pybullet, self.client, effect.hidden
        if how["form"] == "post":
            shape = p.createCollisionShape(p.GEOM_CYLINDER, radius=how["radius"], height=4.0, physicsClientId=c)
        else:
            half = [how["radius"], how["breadth"], 2.0]
            shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=c)
        wall = self._static(shape)
        turn = rotation.matrix(rotation.about(np.array([0.0, 0, 1]), how["turn"]))
        self._turn(wall, np.array([*how["place"], 1.9]), turn)
        for i, body in enumerate(self.ids):
            p.setCollisionFilterPair(wall, body, -1, -1, int(i == effect.target), physicsClientId=c)
        return wall

    def gap(self) -> float:
        """Least distance between two objects, m."""
        least = float("inf")
        for i, a in enumerate(self.ids):
            for b in self.ids[:i]:
                near = pybullet.getClosestPoints(a, b, 0.5, physicsClientId=self.client)
                least = min([least, *(point[8] for point in near)])
        return least

    def state(self, i: int) -> forces.State:
        """What the forces on object i depend on."""
        place, turn = pybullet.getBasePositionAndOrientation(self.ids[i], physicsClientId=self.client)
        velocity, spin = pybullet.getBaseVelocity(self.ids[i], physicsClientId=self.client)
        return forces.State(np.array(place), np.array([turn[3], *turn[:3]]), np.array(velocity), np.array(spin))

    def contacts(self, acting: np.ndarray) -> None:
        """Notes who met whom, and the hidden face."""
        index = {body: i for i, body in enumerate(self.ids)}
        for point in pybullet.getContactPoints(physicsClientId=self.client):
            a, b, force = point[1], point[2], point[9]
            if force <= 0:
                continue
            if a in index and b in index:
                self.touched[index[a], index[b]] = self.touched[index[b], index[a]] = True
            elif self.wall in (a, b):
                body = index[b if a == self.wall else a]
                acting[[e.name for e in self.effects].index("hidden_obstacle"), body] = True
                if self.hit is None:
                    self.hit = _face(point, wall_is_b=b == self.wall)

    def friction(self, i: int, state: forces.State) -> bool:
        """Sets the friction under object i; whether it is on a patch."""
        patch = named(self.effects, "friction_patch")
        if patch is None:
            return False
        offset = state.position[:2] - [patch.parameters["x"], patch.parameters["y"]]
        on = bool(np.hypot(*offset) < patch.parameters["radius"])
        value = patch.parameters["friction"] if on else self.objects[i]["physics"]["friction"][0]
        pybullet.changeDynamics(self.ids[i], -1, lateralFriction=value, physicsClientId=self.client)
        return on and bool(pybullet.getContactPoints(self.ids[i], self.floor, physicsClientId=self.client))


def _face(point: tuple, *, wall_is_b: bool) -> tuple[float, float]:
    """Angle [deg] and distance [m] of the vertical face that touches at a contact point."""
    normal = np.array(point[7][:2]) * (1 if wall_is_b else -1)  # Bullet's points from B to A
    normal /= np.linalg.norm(normal) + 1e-12
    place = np.array((point[6] if wall_is_b else point[5])[:2])
    return float(np.degrees(np.arctan2(normal[1], normal[0]))), float(normal @ place)


def quaternion(matrix: Float[np.ndarray, "3 3"]) -> list[float]:
    """x y z w of a rotation matrix (the largest component first, so that none is divided by zero)."""
    m = matrix
    squares = np.array([1 + m[0, 0] + m[1, 1] + m[2, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2],
                        1 - m[0, 0] + m[1, 1] - m[2, 2], 1 - m[0, 0] - m[1, 1] + m[2, 2]])  # fmt: skip
    a, b, c = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    d, e, f = m[1, 0] + m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2]
    rows = np.array([[squares[0], a, b, c], [a, squares[1], d, e], [b, d, squares[2], f], [c, e, f, squares[3]]])
    q = rows[int(squares.argmax())]
    return np.roll(q / np.linalg.norm(q), -1).tolist()


@contextlib.contextmanager
def engine() -> Iterator[Engine]:
    """`simulate` for many runs, each from a fresh start; what is printed meanwhile goes nowhere."""
    with _client() as client:
        yield Engine(client)


class Engine:
    """A client that is emptied before every run."""

    def __init__(self, client: int):
        self.client = client

    def run(self, entries: list[Entry], effects: tuple[Effect, ...], seconds: float) -> Track:
        """As `simulate`."""
        stage, steps = self._staged(entries, effects, seconds)
        count, gap = len(stage.ids), stage.gap()
        position, turn = np.zeros((steps, count, 3)), np.zeros((steps, count, 4))
        scale, speed = np.ones((steps, count)), np.zeros((steps, count))
        acting = np.zeros((len(effects), steps, count), bool)
        for step in range(steps):
            for i in range(count):
                state = _act(stage, i, step, scale, acting)
                position[step, i], turn[step, i] = state.position, state.quaternion
                speed[step, i] = np.linalg.norm(state.velocity)
            pybullet.stepSimulation(physicsClientId=self.client)
            stage.contacts(acting[:, step])
        for i, centre in enumerate(stage.centre):
            if centre.any():  # from the centre of mass to the geometric one
                position[:, i] -= rotation.matrix(turn[:, i]) @ centre
        return Track(position, continuous(turn), scale, speed, stage.touched, gap, acting, stage.hit)

    def poses(self, entries: list[Entry], seconds: float) -> Track:
        """The same motion without effects, quicker: speeds and contacts are left out (zeros, and no gap)."""
        stage, steps = self._staged(entries, (), seconds)
        count, client, step = len(stage.ids), self.client, pybullet.stepSimulation
        found = []
        for _ in range(steps):
            found += [pybullet.getBasePositionAndOrientation(body, physicsClientId=client) for body in stage.ids]
            step(physicsClientId=client)
        position = np.array([place for place, _ in found]).reshape(steps, count, 3)
        turn = np.roll(np.array([turn for _, turn in found]).reshape(steps, count, 4), 1, -1)
        none = np.zeros((steps, count))
        return Track(
            position, continuous(turn), none + 1, none, stage.touched, 0.0, np.zeros((0, steps, count), bool), None
        )

    def _staged(self, entries: list[Entry], effects: tuple[Effect, ...], seconds: float) -> tuple[_Stage, int]:
        pybullet.resetSimulation(physicsClientId=self.client)
        return _Stage(self.client, entries, effects), int(np.ceil(seconds * RATE)) + 2


def simulate(entries: list[Entry], effects: tuple[Effect, ...], seconds: float) -> Track:
    """Runs a scene with effects from its start, `seconds` long, RATE steps a second."""
    with engine() as opened:
        return opened.run(entries, effects, seconds)


def _act(stage: _Stage, i: int, step: int, scale: np.ndarray, acting: np.ndarray) -> forces.State:
    """Lets the effects act on object i in a step, and notes its size and who acted; its state."""
    effects, client, body, time = stage.effects, stage.client, stage.ids[i], step / RATE
    state = forces.jump(effects, i, time, stage.state(i), body, client)
    scale[step, i] = forces.size(effects, i, time)
    patch = stage.friction(i, state)
    for k, effect in enumerate(effects):
        force = forces.force(effect, i, stage.objects[i], time, state, stage.gravity)
        acting[k, step, i] = patch if effect.name == "friction_patch" else force is not None
        if force is not None:
            where = state.position.tolist()
            pybullet.applyExternalForce(body, -1, force.tolist(), where, pybullet.WORLD_FRAME, physicsClientId=client)
    return state
