"""A scene in PyBullet: its motion, its pictures and its instance masks."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pybullet
from jaxtyping import Bool, Float, Int, UInt8

from benchmarks.clips import bounce, rotation, surfaces
from benchmarks.clips.camera import Camera

SUBSTEPS = 8
Entry = dict[str, Any]


@dataclass(frozen=True)
class Motion:
    """Poses at the start of every frame.

    Fields:
      position: (frames, objects, 3), m. quaternion: (frames, objects, 4), w x y z, body to world.
      touched: whether two objects met, (objects, objects).
      gap: least distance between two objects at the start, m; infinite where there is one object.
    """

    position: Float[np.ndarray, "frames objects 3"]
    quaternion: Float[np.ndarray, "frames objects 4"]
    touched: Bool[np.ndarray, "objects objects"]
    gap: float


def bodies(entries: list[Entry]) -> list[Entry]:
    """The objects among a scene's entries, in their order."""
    return [e for e in entries if e["type"] in ("box", "cylinder", "sphere")]


class World:
    """A scene built in a PyBullet client of its own. Use `open_world`."""

    def __init__(self, entries: list[Entry], client: int, folder: Path | None, rng: np.random.Generator):
        self.entries, self.client = entries, client
        self._p = pybullet
        self.objects = bodies(entries)
        self._floor = self._build_floor(folder, rng)
        self.ids = [self._build_body(entry, folder, rng) for entry in self.objects]

    def _build_floor(self, folder: Path | None, rng: np.random.Generator) -> int:
        p, c = self._p, self.client
        ground = p.createMultiBody(0, p.createCollisionShape(p.GEOM_PLANE, physicsClientId=c), physicsClientId=c)
        # Bullet multiplies two bodies' numbers: with ones here the object's own numbers hold.
        p.changeDynamics(
            ground,
            -1,
            lateralFriction=1,
            rollingFriction=0,
            spinningFriction=0,
            restitution=1,
            contactProcessingThreshold=0,
            physicsClientId=c,
        )
        p.changeVisualShape(ground, -1, rgbaColor=[0, 0, 0, 0], physicsClientId=c)
        if folder is None:
            return ground
        grey = rng.uniform(95, 150)
        picture = surfaces.texture(
            rng, 2048, (grey, grey + rng.uniform(-15, 15), grey + rng.uniform(-15, 15)), 0, 512, rng.uniform(14, 22)
        )
        shape = p.createVisualShape(p.GEOM_MESH, fileName=str(surfaces.floor(folder / "floor.obj")), physicsClientId=c)
        sheet = p.createMultiBody(0, -1, shape, physicsClientId=c)
        self._paint(sheet, picture, folder / "floor.png")
        return sheet

    def _build_body(self, entry: Entry, folder: Path | None, rng: np.random.Generator) -> int:
        p, c = self._p, self.client
        kind, state, physics = entry["type"], entry["state"], entry["physics"]
        if kind == "sphere":
            scale = [entry["radius"]] * 3
            shape = p.createCollisionShape(p.GEOM_SPHERE, radius=entry["radius"], physicsClientId=c)
        elif kind == "box":
            scale = list(entry["size"])
            shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=scale, physicsClientId=c)
        else:
            scale = [entry["radius"], entry["radius"], entry["height"] / 2]
            shape = p.createCollisionShape(
                p.GEOM_CYLINDER, radius=entry["radius"], height=entry["height"], physicsClientId=c
            )
        visual = -1
        if folder is not None:
            mesh = {"sphere": surfaces.sphere, "box": surfaces.box, "cylinder": surfaces.cylinder}[kind]
            path = folder / f"{kind}.obj"
            visual = p.createVisualShape(
                p.GEOM_MESH, fileName=str(path if path.exists() else mesh(path)), meshScale=scale, physicsClientId=c
            )
        q = np.asarray(state["orientation"], float)
        body = p.createMultiBody(
            entry["physics"]["mass"], shape, visual, state["position"], np.roll(q, -1).tolist(), physicsClientId=c
        )
        spin = rotation.matrix(q) @ np.asarray(state["angular_velocity"], float)
        p.resetBaseVelocity(body, state["linear_velocity"], spin.tolist(), physicsClientId=c)
        p.changeDynamics(
            body,
            -1,
            lateralFriction=physics["friction"][0],
            rollingFriction=physics["friction"][1],
            spinningFriction=0.005,
            restitution=bounce.restitution(physics["damping"]),
            contactProcessingThreshold=0,  # otherwise Bullet brakes a body just before it touches, and it rebounds by chance
            linearDamping=0,
            angularDamping=0,
            activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=c,
        )
        if folder is not None:
            tint = rng.uniform(60, 200, 3)
            checker = int(rng.choice([0, 8, 12]))
            picture = surfaces.texture(rng, 512, (tint[0], tint[1], tint[2]), checker, 64, rng.uniform(20, 32))
            self._paint(body, picture, folder / f"{entry['name']}.png")
        return body

    def _paint(self, body: int, picture: UInt8[np.ndarray, "n n 3"], path: Path) -> None:
        cv2.imwrite(str(path), picture)
        texture = self._p.loadTexture(str(path), physicsClientId=self.client)
        self._p.changeVisualShape(
            body, -1, textureUniqueId=texture, rgbaColor=[1, 1, 1, 1], physicsClientId=self.client
        )

    def simulate(self, frames: int, fps: float) -> Motion:
        """Runs the scene once from its start; frame 0 is the initial state."""
        p, c = self._p, self.client
        gravity = next(e for e in self.entries if e["type"] == "gravity")["gravity"]
        p.setGravity(*gravity, physicsClientId=c)
        p.setPhysicsEngineParameter(
            fixedTimeStep=1 / (SUBSTEPS * fps),
            numSolverIterations=100,
            restitutionVelocityThreshold=0.1,
            deterministicOverlappingPairs=1,
            physicsClientId=c,
        )
        count = len(self.ids)
        gap = float("inf")
        for i in range(count):
            for j in range(i):
                near = p.getClosestPoints(self.ids[i], self.ids[j], 0.5, physicsClientId=c)
                gap = min([gap, *(point[8] for point in near)])
        position, quaternion = np.zeros((frames, count, 3)), np.zeros((frames, count, 4))
        touched = np.zeros((count, count), bool)
        index = {body: i for i, body in enumerate(self.ids)}
        for frame in range(frames):
            for i, body in enumerate(self.ids):
                place, turn = p.getBasePositionAndOrientation(body, physicsClientId=c)
                position[frame, i], quaternion[frame, i] = place, np.roll(turn, 1)
            for _ in range(SUBSTEPS):
                p.stepSimulation(physicsClientId=c)
                for point in p.getContactPoints(physicsClientId=c):
                    if point[1] in index and point[2] in index and point[9] > 0:
                        touched[index[point[1]], index[point[2]]] = touched[index[point[2]], index[point[1]]] = True
        return Motion(position, quaternion, touched, gap)

    def _pose(self, motion: Motion, frame: int) -> None:
        for i, body in enumerate(self.ids):
            self._p.resetBasePositionAndOrientation(
                body, motion.position[frame, i], np.roll(motion.quaternion[frame, i], -1), physicsClientId=self.client
            )

    def masks(self, motion: Motion, camera: Camera, frames: list[int]) -> Int[np.ndarray, "frames height width"]:
        """Which object each pixel's centre shows: 0 background, i + 1 object i."""
        lookup = np.zeros(max(self.ids) + 2, np.int32)
        lookup[self.ids] = np.arange(1, len(self.ids) + 1)
        out = np.zeros((len(frames), camera.height, camera.width), np.int32)
        for row, frame in enumerate(frames):
            self._pose(motion, frame)
            seen = self._shoot(camera, shadow=0)[4]
            ids = np.asarray(seen, np.int64).reshape(camera.height, camera.width)
            out[row] = lookup[np.where(ids < 0, len(lookup) - 1, ids)]
        return out

    def pictures(
        self, motion: Motion, camera: Camera, light: dict[str, Any], supersample: int
    ) -> UInt8[np.ndarray, "frames height width 3"]:
        """RGB of all frames, drawn `supersample` times finer and averaged."""
        big = Camera(
            camera.position, camera.pitch, camera.fovy, camera.width * supersample, camera.height * supersample
        )
        out = np.zeros((len(motion.position), camera.height, camera.width, 3), np.uint8)
        for frame in range(len(out)):
            self._pose(motion, frame)
            rgba = np.asarray(self._shoot(big, shadow=1, **light)[2], np.uint8).reshape(big.height, big.width, 4)
            rgb = np.ascontiguousarray(rgba[..., :3])
            out[frame] = cv2.resize(rgb, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        return out

    def _shoot(self, camera: Camera, **options: Any) -> tuple:
        return self._p.getCameraImage(
            camera.width,
            camera.height,
            camera.view_matrix(),
            camera.projection_matrix(),
            renderer=self._p.ER_TINY_RENDERER,
            physicsClientId=self.client,
            **options,
        )


@contextlib.contextmanager
def open_world(entries: list[Entry], seed: int, *, painted: bool = True) -> Iterator[World]:
    """Builds a scene in a new PyBullet client and closes it afterwards.

    Args:
      entries: scene entries. seed: of the textures. painted: without it there are no meshes to draw, only bodies.
    """
    client = pybullet.connect(pybullet.DIRECT)
    try:
        with tempfile.TemporaryDirectory() as folder:
            yield World(entries, client, Path(folder) if painted else None, np.random.default_rng(seed))
    finally:
        pybullet.disconnect(client)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Bullet prints from C; this sends its standard output nowhere for a while."""
    saved, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
        os.close(nowhere)
