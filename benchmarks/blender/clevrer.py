"""Videos of five seconds in CLEVRER's format: some objects rest, others come in from outside and hit them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from benchmarks.blender.clip import collisions
from benchmarks.blender.scenes import Drawn, aimed, entry_of, light_of, looks_of, places_of, shape_of
from benchmarks.blender.studio import Studio
from benchmarks.clevrer.annotation import Meeting, Thing
from benchmarks.clevrer.writing import write_annotation, write_proposals, write_video
from benchmarks.clips.camera import Camera

FPS, FRAMES, SIZE = 25, 128, (480, 320)
RATE = 250
WAY = 2.2  # m/s, of what comes in


def draw_video(rng: np.random.Generator) -> Drawn:
    """Three to five objects; the first two come in from the sides, one after the other."""
    camera = Camera((0.0, -2.0, 3.2), 50.0, 46.0, *SIZE)
    looks = looks_of(rng, int(rng.integers(3, 6)))
    restitution = [float(rng.uniform(0.2, 0.7)) for _ in looks]
    shapes = [shape_of(rng) for _ in looks]
    places = places_of(rng, camera, shapes)
    entries: list[dict[str, Any]] = []
    for i, (shape, place) in enumerate(zip(shapes, places, strict=True)):
        aim, start = aimed(rng, camera, places[2:], -1), place
        if i < 2:  # so far out that it comes in after a while; CLEVRER's friction is low too
            start = np.array([(-1) ** i * (4.5 + 1.5 * i), aim[1] + rng.uniform(-0.6, 0.6)])
        entry = entry_of(rng, shape, start, aim if i < 2 else None, looks[i], restitution[i], i)
        if i < 2:
            physics, state = entry["physics"], entry["state"]
            physics["friction"][0] = 0.5 if shape["type"] == "sphere" else float(rng.uniform(0.02, 0.06))
            scale = WAY / float(np.linalg.norm(state["linear_velocity"]))
            state["linear_velocity"] = [scale * v for v in state["linear_velocity"]]
            state["angular_velocity"] = [scale * v for v in state["angular_velocity"]]
        entries.append(entry)
    entries.append({"type": "camera", "fovy": 46.0, "orientation": 50.0, "position": list(camera.position)})
    entries.append({"type": "gravity", "gravity": [0.0, 0.0, -9.81]})
    return Drawn(entries, looks, restitution, light_of(rng))


def make_video(studio: Studio, seed: int, number: int, out: Path) -> str:
    """Makes one video with its annotation and proposals, unless it is there; returns a line on it."""
    folders = {name: out / name for name in ("videos", "annotations", "proposals")}
    last = folders["proposals"] / f"proposal_{number:05d}.json"
    if last.exists():
        return f"{last}: is there"
    drawn, position, quaternion, meetings = _watched(studio, np.random.default_rng([seed, number, 5]))
    camera, every = Camera.of(drawn.entries, *SIZE), RATE // FPS
    frames, masks = studio.render(drawn.bodies(), camera, drawn.light, position[::every], quaternion[::every])
    things = [
        Thing(i, "cube" if entry["type"] == "box" else entry["type"], look.colour, look.material)
        for i, (entry, look) in enumerate(zip(drawn.objects, drawn.looks, strict=True))
    ]
    image = camera.project(position[::every])
    inside = ((image[..., :2] >= 0) & (image[..., :2] < SIZE)).all(-1) & (image[..., 2] > 0)
    met = [
        Meeting((i, j), int(time * FPS), tuple(position[int(time * RATE), [i, j]].mean(0).tolist()))
        for i, j, time in meetings
    ]
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    write_video(folders["videos"] / f"video_{number:05d}.mp4", frames, FPS)
    annotated = folders["annotations"] / f"annotation_{number:05d}.json"
    write_annotation(annotated, number, things, motion(position, quaternion), inside, met)
    write_proposals(last, number, things, masks)
    return f"{last}: {len(things)} objects, {len(met)} collisions"


def _watched(studio: Studio, rng: np.random.Generator) -> tuple[Drawn, np.ndarray, np.ndarray, list]:
    """A scene in which something meets, with its motion and meetings."""
    for _ in range(100):
        drawn = draw_video(rng)
        position, quaternion = studio.simulate(drawn.bodies(), -9.81, (FRAMES - 1) / FPS, RATE)
        meetings = collisions(drawn.objects, position, quaternion, RATE)
        if meetings and meetings[0][2] > 0.2:
            return drawn, position, quaternion, meetings
    raise ValueError("in 100 scenes nothing met")


def motion(
    position: Float[np.ndarray, "steps objects 3"], quaternion: Float[np.ndarray, "steps objects 4"]
) -> dict[str, Float[np.ndarray, "frames objects 3"]]:
    """What the annotation tells: places, angles about x, y, z, velocities, angular velocities (world, a second)."""
    every = RATE // FPS
    turns = [Rotation.from_quat(np.roll(quaternion[:, i], -1, -1)) for i in range(quaternion.shape[1])]
    spins = [(turn[1:] * turn[:-1].inv()).as_rotvec() * RATE for turn in turns]
    spins = [np.concatenate([spin, spin[-1:]]) for spin in spins]
    return {
        "location": position[::every],
        "orientation": np.stack([turn.as_euler("xyz") for turn in turns], 1)[::every],
        "velocity": np.gradient(position, 1 / RATE, axis=0)[::every],
        "angular_velocity": np.stack(spins, 1)[::every],
    }
