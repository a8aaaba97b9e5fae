"""One benchmark clip: a scene, its pictures, its masks and its measured flow."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float16, Int, UInt8

from benchmarks.clips import bullet, rotation
from benchmarks.clips.bullet import Motion
from benchmarks.clips.camera import Camera
from benchmarks.clips.scenes import Entry, draw_scene

STAYS = 0.5


@dataclass(frozen=True)
class Clip:
    """A clip as an observation, with what is known about it.

    Fields:
      truth: scene entries that were simulated (two engines never agree in full on contacts).
      kind: kind of motion. seed: what made it. fps: frames a second.
      frames: RGB, (frames, height, width, 3). masks: instance ids, (frames, height, width), 0 = background.
      flow: measured by DIS between consecutive pictures, (frames - 1, height, width, 2), pixels, x right, y down.
      mask_ids: the mask's id of each object, in the scene's order.
      position, quaternion: true poses at each frame, (frames, objects, 3) m and (frames, objects, 4) w x y z.
    """

    truth: list[Entry]
    kind: str
    seed: int
    fps: float
    frames: UInt8[np.ndarray, "frames height width 3"]
    masks: UInt8[np.ndarray, "frames height width"]
    flow: Float16[np.ndarray, "steps height width 2"]
    mask_ids: tuple[int, ...]
    position: Float[np.ndarray, "frames objects 3"]
    quaternion: Float[np.ndarray, "frames objects 4"]


def make_clip(
    seed: int,
    kind: str,
    objects: int,
    *,
    frames: int = 30,
    size: tuple[int, int] = (480, 320),
    fps: float = 30.0,
    supersample: int = 2,
    attempts: int = 400,
    scene: list[Entry] | None = None,
) -> Clip:
    """Draws scenes until one passes the filters, and films it.

    Args:
      seed: the same seed gives the same clip. kind: one of `scenes.KINDS`. objects: 1 to 4.
      frames, size (width, height), fps: of the film. supersample: pictures are drawn this many times finer.
      attempts: scenes tried before giving up. scene: film this scene instead of drawing any; filters still hold.

    Raises:
      ValueError: unknown kind or number of objects; or no scene passed (the message counts the reasons).
    """
    rng = np.random.default_rng([seed, objects, *kind.encode()])
    reasons: dict[str, int] = {}
    for _ in range(attempts if scene is None else 1):
        entries = draw_scene(rng, kind, objects, size) if scene is None else scene
        camera = Camera.of(entries, *size)
        with bullet.quiet(), bullet.open_world(entries, seed, painted=False) as world:
            motion = world.simulate(frames, fps)
        reason = motion_fault(entries, kind, motion, camera)
        if reason is None:
            with bullet.quiet(), bullet.open_world(entries, seed) as world:
                masks = world.masks(motion, camera, list(range(frames)))
                reason = mask_fault(masks, len(world.ids), frames)
                if reason is None:
                    pictures = world.pictures(motion, camera, _light(rng), supersample)
                    return _clip(entries, kind, seed, fps, motion, masks, pictures, rng)
        reasons[reason] = reasons.get(reason, 0) + 1
    raise ValueError(f"no clip for seed {seed}, {kind}, {objects} objects in {attempts} attempts: {reasons}")


def _clip(
    entries: list[Entry],
    kind: str,
    seed: int,
    fps: float,
    motion: Motion,
    masks: Int[np.ndarray, "frames height width"],
    pictures: UInt8[np.ndarray, "frames height width 3"],
    rng: np.random.Generator,
) -> Clip:
    count = motion.position.shape[1]
    ids = rng.permutation(count) + 1  # a file's ids need not follow the scene's order
    lookup = np.concatenate([[0], ids]).astype(np.uint8)
    names = tuple(int(i) for i in ids)
    flow = measured_flow(pictures)
    return Clip(entries, kind, seed, fps, pictures, lookup[masks], flow, names, motion.position, motion.quaternion)


def _light(rng: np.random.Generator) -> dict[str, Any]:
    turn = rng.uniform(-np.pi, np.pi)
    return {
        "lightDirection": [3 * np.cos(turn), 3 * np.sin(turn), 6.0],
        "lightDistance": 10.0,
        "lightAmbientCoeff": 0.55,
        "lightDiffuseCoeff": 0.45,
        "lightSpecularCoeff": 0.03,
    }


def measured_flow(pictures: UInt8[np.ndarray, "frames height width 3"]) -> Float16[np.ndarray, "steps height width 2"]:
    """Optical flow from each picture to the next by OpenCV's DIS (Kroeger et al., ECCV 2016), medium preset."""
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grey = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures]
    return np.stack([dis.calc(a, b, None) for a, b in itertools.pairwise(grey)]).astype(np.float16)  # type: ignore[call-overload]


def motion_fault(entries: list[Entry], kind: str, motion: Motion, camera: Camera) -> str | None:
    """Why the motion alone disqualifies a scene, or None."""
    objects = bullet.bodies(entries)
    lowest = [
        motion.position[0, i, 2] - rotation.half_height(e, motion.quaternion[0, i]) for i, e in enumerate(objects)
    ]
    if motion.gap < 0.02 or min(lowest) < -0.002:
        return "overlap at the start"
    if not np.isfinite(motion.position).all() or motion.position[..., 2].min() < 0.05:
        return "unstable"
    image = camera.project(motion.position)
    if image[..., 2].min() < 0.8:
        return "too close to the camera"
    radius = np.array([rotation.bounding_radius(e) for e in objects])
    moved = np.linalg.norm(np.diff(image[..., :2], axis=0), axis=-1).mean(0)
    spun = np.abs(np.diff(motion.quaternion, axis=0)).sum(-1).mean(0) * radius * camera.focal / image[0, :, 2]
    if max(moved.max(), spun[0]) < 2.5 * camera.height / 320:
        return "hardly moves"
    return None if _shows(kind, objects, motion) else f"shows no {kind}"


def _shows(kind: str, objects: list[Entry], motion: Motion) -> bool:
    """Whether the first object does what the kind says."""
    place, turn = motion.position[:, 0], motion.quaternion[:, 0]
    lift = np.array([z - rotation.half_height(objects[0], q) for z, q in zip(place[:, 2], turn, strict=True)])
    travelled = float(np.linalg.norm(place[-1, :2] - place[0, :2]))
    if kind == "flight":
        return float((lift > 0.02).mean()) > 0.4
    if kind == "bounce":
        touch = int(np.argmin(lift))
        return 2 < touch < len(lift) - 6 and float(lift[touch:].max()) > 0.06
    if kind == "topple":
        up = rotation.matrix(turn)[:, :, 2]
        return float(np.degrees(np.arccos(np.clip(up[-1] @ up[0], -1, 1)))) > 50
    if kind == "collision":
        return bool(motion.touched[0, 1])
    return travelled > 0.4 and float(lift.max()) < 0.15


def mask_fault(masks: Int[np.ndarray, "frames height width"], count: int, frames: int) -> str | None:
    """Why the masks disqualify a clip, or None.

    As the paper's filters: each object shows 8,000 pixels in total at 480x320 and 30 frames (in proportion at other
    sizes), all show in the first frame, and never is more than one out of view (with a single object, none). And the
    first frame's silhouette, held still, must not explain the clip: its mean IoU with the others stays under STAYS.
    """
    area = np.stack([(masks == i + 1).sum((1, 2)) for i in range(count)], 1)
    share = masks[0].size / (480 * 320)
    if (area.sum(0) < 8000 * share * frames / 30).any():
        return "too few pixels"
    if (area[0] < 150 * share).any():
        return "hidden at the start"
    if ((area == 0).sum(1) > min(1, count - 1)).any():
        return "out of view"
    shown = masks > 0
    stays = (shown & shown[0]).sum((1, 2)) / (shown | shown[0]).sum((1, 2))
    if stays.mean() > STAYS:
        return "too much stays where it is"
    return None
