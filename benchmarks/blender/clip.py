"""One Blender clip: drawn, simulated, filtered, filmed."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Int, UInt8

from benchmarks.blender.scenes import Drawn, draw_scene
from benchmarks.blender.studio import RATE, Studio
from benchmarks.clips import reference, rotation
from benchmarks.clips.camera import Camera
from benchmarks.clips.clip import mask_fault
from benchmarks.clips.samples import SampleSet, rough_samples

FPS = 30
FRAMES = 30
SIZE = (480, 320)
TOUCH = 0.004  # m; nearer bodies count as touching
LEAST_MOVED = 6.0  # px that every object must move in the picture
ATTEMPTS = 600


@dataclass(frozen=True)
class Film:
    """A clip and all that is known about it.

    Attributes:
      drawn: the scene. frames: RGB. masks: instance ids, 0 = background. mask_ids: of each object, in the scene's order.
      position, quaternion: true poses at each frame, m and w x y z.
      collisions: (object, object, seconds) of each meeting.
      guesses: rough samples in random order. blender: its version.
    """

    drawn: Drawn
    frames: UInt8[np.ndarray, "frames height width 3"]
    masks: UInt8[np.ndarray, "frames height width"]
    mask_ids: tuple[int, ...]
    position: Float[np.ndarray, "frames objects 3"]
    quaternion: Float[np.ndarray, "frames objects 4"]
    collisions: list[tuple[int, int, float]]
    guesses: SampleSet
    blender: str


def make_film(studio: Studio, seed: int, index: int, objects: int) -> Film:
    """Draws scenes until one passes the filters and has samples of the wanted quality, and films it.

    Args:
      studio: Blender. seed, index: the same give the same clip. objects: 1 to 4.

    Raises:
      ValueError: none passed (the message counts the reasons).
    """
    rng = np.random.default_rng([seed, index])
    reasons: dict[str, int] = {}
    for attempt in range(ATTEMPTS):
        drawn = draw_scene(rng, objects, SIZE)
        steps = studio.simulate(drawn.bodies(), -9.81, (FRAMES - 1) / FPS)
        meetings = collisions(drawn.objects, *steps)
        position, quaternion = (values[:: RATE // FPS][:FRAMES] for values in steps)
        reason = fault(drawn, position, quaternion, meetings)
        if reason is None:
            try:
                return _film(studio, rng, drawn, position, quaternion, meetings, 1000 * seed + index + attempt)
            except ValueError as error:
                reason = str(error)[:30]
        reasons[reason] = reasons.get(reason, 0) + 1
    raise ValueError(f"no clip for seed {seed}, index {index}, {objects} objects in {ATTEMPTS} attempts: {reasons}")


def _film(
    studio: Studio,
    rng: np.random.Generator,
    drawn: Drawn,
    position: np.ndarray,
    quaternion: np.ndarray,
    meetings: list[tuple[int, int, float]],
    seed: int,
) -> Film:
    guesses = rough_samples(drawn.entries, exact_masks(drawn, position, quaternion), seed, fps=FPS)
    camera = Camera.of(drawn.entries, *SIZE)
    frames, masks = studio.render(drawn.bodies(), camera, drawn.light, position, quaternion)
    ids = rng.permutation(len(drawn.objects)) + 1  # a file's ids need not follow the scene's order
    seen = np.concatenate([[0], ids]).astype(np.uint8)[masks]
    return Film(
        drawn, frames, seen, tuple(int(i) for i in ids), position, quaternion, meetings, guesses, studio.version
    )


def exact_masks(
    drawn: Drawn, position: Float[np.ndarray, "frames objects 3"], quaternion: Float[np.ndarray, "frames objects 4"]
) -> Int[np.ndarray, "frames height width"]:
    """Which object shows at each pixel's centre, by MuJoCo's rays: what Blender will draw, but for its meshes' facets."""
    poses = np.concatenate([position, quaternion], -1)
    return reference.id_images(drawn.entries, poses, SIZE, 1)


def fault(
    drawn: Drawn,
    position: Float[np.ndarray, "frames objects 3"],
    quaternion: Float[np.ndarray, "frames objects 4"],
    meetings: Sequence[tuple[int, int, float]],
) -> str | None:
    """Why a scene is not taken, or None: as in CLEVRER things meet; as in the paper's evaluation nothing is static."""
    if not np.isfinite(position).all() or position[..., 2].min() < 0.05:
        return "unstable"
    if any(time < 1.5 / FPS for *_, time in meetings):
        return "overlap at the start"
    if len(drawn.objects) > 1 and not meetings:
        return "nothing meets"
    image = Camera.of(drawn.entries, *SIZE).project(position)[..., :2]
    if np.linalg.norm(image - image[0], axis=-1).max(0).min() < LEAST_MOVED:
        return "something rests"
    return mask_fault(exact_masks(drawn, position, quaternion), len(drawn.objects), len(position))


def collisions(
    objects: list[dict[str, Any]],
    position: Float[np.ndarray, "steps objects 3"],
    quaternion: Float[np.ndarray, "steps objects 4"],
    rate: int = RATE,
) -> list[tuple[int, int, float]]:
    """(object, object, seconds) of each moment when two bodies come to touch; `rate` steps a second."""
    entries = [*objects, {"type": "gravity", "gravity": [0, 0, 0]}]
    model, data = reference.build(entries, FPS)
    reach = [rotation.bounding_radius(entry) for entry in objects]
    found = []
    for i, j in itertools.combinations(range(len(objects)), 2):
        apart = np.linalg.norm(position[:, i] - position[:, j], axis=-1) - reach[i] - reach[j]
        touching = False
        for step in range(len(position)):
            near = False
            if apart[step] < TOUCH:
                data.qpos[:] = np.concatenate([position[step], quaternion[step]], -1).ravel()
                mujoco.mj_kinematics(model, data)
                near = mujoco.mj_geomDistance(model, data, i + 1, j + 1, 1.0, None) < (2 * TOUCH if touching else TOUCH)
            if near and not touching:
                found.append((i, j, step / rate))
            touching = near
    return sorted(found, key=lambda meeting: meeting[2])
