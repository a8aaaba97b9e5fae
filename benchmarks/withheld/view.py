"""A camera that may turn, travel, roll, distort, read out row by row, and lose or repeat frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.clips import rotation
from benchmarks.clips.camera import Camera
from benchmarks.withheld.effect import Effect, named
from benchmarks.withheld.track import Track

FPS = 30.0
X, Y, Z = np.eye(3)
Image = Float[np.ndarray, "*n 2"]


@dataclass(frozen=True)
class View:
    """What each frame is taken with.

    Fields:
      width, height, focal: pixels. k1: of the lens, focal lengths. readout: of the whole picture, s.
      origin: (frames, 3) m. turn: camera to world (it looks along -z, y is up), (frames, 3, 3).
      times: moment shown in the middle of each frame, (frames,) s.
    """

    width: int
    height: int
    focal: float
    k1: float
    readout: float
    origin: Float[np.ndarray, "frames 3"]
    turn: Float[np.ndarray, "frames 3 3"]
    times: Float[np.ndarray, "frames"]

    @property
    def middle(self) -> Float[np.ndarray, "2"]:
        """The principal point."""
        return np.array([self.width / 2, self.height / 2])

    def project(self, points: Float[np.ndarray, "*n 3"], frame: int) -> Image:
        """World points [m] to image coordinates of a frame, pixels."""
        local = (points - self.origin[frame]) @ self.turn[frame]
        plain = local[..., :2] / -local[..., 2:] * [1.0, -1.0]
        return self.middle + self.focal * plain * (1 + self.k1 * (plain**2).sum(-1, keepdims=True))

    def rays(self, image: Image) -> Float[np.ndarray, "*n 3"]:
        """Directions in the camera's frame, of depth 1, through image coordinates (the lens undone by Newton)."""
        bent = (image - self.middle) / self.focal
        far = np.linalg.norm(bent, axis=-1, keepdims=True)
        r = far.copy()
        for _ in range(12 if self.k1 else 0):
            r = r - (r * (1 + self.k1 * r * r) - far) / (1 + 3 * self.k1 * r * r)
        plain = bent * np.divide(r, far, out=np.ones_like(r), where=far > 1e-12) * [1.0, -1.0]
        return np.concatenate([plain, -np.ones_like(far)], -1)

    def row_time(self, y: Float[np.ndarray, "*n"], frame: int) -> Float[np.ndarray, "*n"]:
        """When the image row at height y (pixels) of a frame is exposed, s."""
        return self.times[frame] + self.readout * (np.asarray(y, float) / self.height - 0.5)

    def show(self, track: Track, index: int, points: Float[np.ndarray, "n 3"], frame: int) -> Image:
        """Where points of an object's body (m, in its frame) show in a frame, each at its own row's moment."""
        y = np.full(len(points), self.height / 2)
        image = np.zeros((len(points), 2))
        for _ in range(4 if self.readout else 1):
            place, turn, scale = track.at(self.row_time(y, frame), index)
            world = place + np.einsum("nij,nj->ni", turn, points * scale[:, None])
            image = self.project(world, frame)
            y = np.clip(image[:, 1], -self.height, 2 * self.height)
        return image


def shown_times(effects: tuple[Effect, ...], frames: int, fps: float = FPS) -> Float[np.ndarray, "frames"]:
    """The moment each frame shows, s; frames that were dropped or doubled shift it."""
    index = np.arange(frames, dtype=float)
    lost = named(effects, "dropped_frames")
    if lost is not None:
        first, count = lost.parameters["frame"], lost.parameters["count"]
        after = index >= first
        index[after] = np.maximum(index[after] + count, first - 1 if count < 0 else 0)
    return index / fps


def view_of(camera: Camera, effects: tuple[Effect, ...], frames: int, fps: float = FPS) -> View:
    """The camera of a scene, with every effect of the camera and of timing among `effects`."""
    times = shown_times(effects, frames, fps)
    turn = np.repeat(camera.rotation[None], frames, 0)
    origin = np.repeat(np.array(camera.position, float)[None], frames, 0)
    motion, shake, roll = (named(effects, name) for name in ("camera_motion", "camera_shake", "camera_roll"))
    if motion is not None:
        values = motion.parameters
        turn = turn @ _steered(values["pan"] * times, values["tilt"] * times)
        origin = origin + times[:, None] * [values["x"], values["y"], values["z"]]
    if shake is not None:
        turn = turn @ _steered(np.array(shake.parameters["yaw"]), np.array(shake.parameters["pitch"]))
    if roll is not None:
        # Counter-clockwise as seen from behind the camera, which is where its +z points.
        turn = turn @ rotation.matrix(rotation.about(Z, np.radians(roll.parameters["angle"])))
    lens, rolling = named(effects, "lens_distortion"), named(effects, "rolling_shutter")
    return View(
        camera.width,
        camera.height,
        camera.focal,
        lens.parameters["k1"] if lens else 0.0,
        rolling.parameters["readout"] if rolling else 0.0,
        origin,
        turn,
        times,
    )


def _steered(right: Float[np.ndarray, "frames"], up: Float[np.ndarray, "frames"]) -> Float[np.ndarray, "frames 3 3"]:
    """Turns to the right about the camera's vertical axis and then up about its horizontal one, degrees."""
    return np.stack(
        [
            rotation.matrix(rotation.about(Y, -np.radians(a))) @ rotation.matrix(rotation.about(X, np.radians(b)))
            for a, b in zip(right, up, strict=True)
        ]
    )
