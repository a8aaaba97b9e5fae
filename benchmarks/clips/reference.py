"""The scene format's simulation and id images by C MuJoCo alone, to measure how good a guessed scene is.

Written from the format's words, apart from the refiner's own simulation and rasteriser, so that neither can flatter
the other. Pictures come from `mj_multiRay`: exact shapes, no tessellation.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from benchmarks.clips import rotation
from benchmarks.clips.camera import Camera

Entry = dict[str, Any]
SUBSTEPS = 8
OBJECT_GROUP = 1
UNSTABLE = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
SHAPES = ("box", "cylinder", "sphere")


def _geom(entry: Entry) -> str:
    if entry["type"] == "sphere":
        size = f"{entry['radius']}"
    elif entry["type"] == "box":
        size = " ".join(str(s) for s in entry["size"])
    else:
        size = f"{entry['radius']} {entry['height'] / 2}"
    return f'type="{entry["type"]}" size="{size}" mass="{entry["physics"]["mass"]}" group="{OBJECT_GROUP}"'


def _pair(a: str, b: str, *physics: dict[str, Any]) -> str:
    sliding = max(p["friction"][0] for p in physics)
    rolling = max(p["friction"][1] for p in physics)
    stiffness = max(p.get("stiffness", 5000) for p in physics)
    damping = min(p["damping"] for p in physics)
    return (
        f'<pair geom1="{a}" geom2="{b}" condim="6" friction="{sliding} {sliding} 0.005 {rolling} {rolling}" '
        f'solref="{-stiffness} {damping}" solreffriction="{-stiffness} -30"/>'
    )


def build(entries: list[Entry], fps: float) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The scene's model, and its data at the initial state; effects are not simulated."""
    objects = [e for e in entries if e["type"] in SHAPES]
    gravity = next(e for e in entries if e["type"] == "gravity")["gravity"]
    floor = [_pair("floor", f"g{i}", e["physics"]) for i, e in enumerate(objects)]
    between = [
        _pair(f"g{i}", f"g{j}", a["physics"], objects[j]["physics"])
        for i, a in enumerate(objects)
        for j in range(i + 1, len(objects))
    ]
    body = "".join(
        f'<body><freejoint/><geom name="g{i}" contype="0" conaffinity="0" {_geom(e)}/></body>'
        for i, e in enumerate(objects)
    )
    xml = f"""<mujoco><option timestep="{1 / (SUBSTEPS * fps)}" gravity="{gravity[0]} {gravity[1]} {gravity[2]}"
      integrator="Euler" solver="Newton" cone="elliptic"/>
      <worldbody><geom name="floor" type="plane" size="50 50 1" contype="0" conaffinity="0"/>{body}</worldbody>
      <contact>{"".join(floor + between)}</contact></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    for i, entry in enumerate(objects):
        state = entry["state"]
        q = np.asarray(state["orientation"], float)
        data.qpos[7 * i : 7 * i + 7] = [*state["position"], *(q / np.linalg.norm(q))]
        data.qvel[6 * i : 6 * i + 6] = [*state["linear_velocity"], *state["angular_velocity"]]
    return model, data


def simulate(entries: list[Entry], frames: int = 30, fps: float = 30.0) -> Float[np.ndarray, "frames objects 7"]:
    """Poses (x y z m, w x y z) at the start of every frame; NaN from where MuJoCo found the motion unstable."""
    model, data = build(entries, fps)
    out = np.zeros((frames, model.nq))
    for frame in range(frames):
        out[frame] = data.qpos
        if frame < frames - 1:
            mujoco.mj_step(model, data, SUBSTEPS)
            if any(data.warning[kind].number for kind in UNSTABLE):
                out[frame + 1 :] = np.nan
                break
    return out.reshape(frames, -1, 7)


def sampling_points(width: int, height: int, stride: int) -> Float[np.ndarray, "rows columns 2"]:
    """Image coordinates of the pixel centres that `masks[:, stride // 2 :: stride, stride // 2 :: stride]` keeps."""
    rows, columns = np.mgrid[stride // 2 : height : stride, stride // 2 : width : stride]
    return np.stack([columns + 0.5, rows + 0.5], -1)


def cast(
    entries: list[Entry], poses: Float[np.ndarray, "frames objects 7"], camera: Camera, stride: int
) -> tuple[Int[np.ndarray, "frames rows columns"], Float[np.ndarray, "frames rows columns"]]:
    """First hits of the rays through every `stride`-th pixel: object i as i + 1 (0: none), and distance, m."""
    model, data = build(entries, 30.0)
    rays = camera.rays(sampling_points(camera.width, camera.height, stride))
    radius = np.array([rotation.bounding_radius(e) for e in entries if e["type"] in SHAPES])
    origin = np.array(camera.position)
    group = np.zeros(6, np.uint8)
    group[OBJECT_GROUP] = 1
    ids = np.zeros((len(poses), *rays.shape[:2]), np.int32)
    distances = np.full(ids.shape, np.inf)
    for frame, pose in enumerate(poses):
        near = _may_hit(rays, pose[:, :3] - origin, radius)
        count = int(near.sum())
        if not count or not np.isfinite(pose).all():
            continue
        data.qpos[:] = pose.ravel()
        mujoco.mj_kinematics(model, data)
        geom, far = np.full(count, -1, np.int32), np.zeros(count)
        mujoco.mj_multiRay(
            model, data, origin, rays[near].ravel(), group, True, -1, geom, far, None, count, mujoco.mjMAXVAL
        )
        ids[frame][near] = np.where(geom < 0, 0, geom)  # geom 0 is the floor, so object i is geom i + 1
        distances[frame][near] = np.where(geom < 0, np.inf, far)
    return ids, distances


def id_images(
    entries: list[Entry], poses: Float[np.ndarray, "frames objects 7"], size: tuple[int, int], stride: int = 4
) -> Int[np.ndarray, "frames rows columns"]:
    """Which object shows at every `stride`-th pixel: 0 background, i + 1 object i.

    Args:
      entries: the scene; its camera looks. poses: of the objects, x y z m and w x y z; a frame with NaN shows none.
      size: the full picture's (width, height), pixels. stride: see `sampling_points`.
    """
    return cast(entries, poses, Camera.of(entries, *size), stride)[0]


def exact_flow(
    entries: list[Entry], poses: Float[np.ndarray, "frames objects 7"], size: tuple[int, int], stride: int = 1
) -> Float[np.ndarray, "steps rows columns 2"]:
    """Flow of the surface points seen at every `stride`-th pixel, full-size pixels a frame; 0 on the background."""
    camera = Camera.of(entries, *size)
    points = sampling_points(*size, stride)
    rays = camera.rays(points)
    ids, distances = cast(entries, poses, camera, stride)
    out = np.zeros((len(poses) - 1, *points.shape))
    for step in range(len(out)):
        for i in range(poses.shape[1]):
            here = ids[step] == i + 1
            hit = np.array(camera.position) + rays[here] * distances[step][here][:, None]
            now, then = poses[step, i], poses[step + 1, i]
            body = (hit - now[:3]) @ rotation.matrix(now[3:])
            moved = body @ rotation.matrix(then[3:]).T + then[:3]
            out[step][here] = camera.project(moved)[:, :2] - points[here]
    return out


def _may_hit(
    rays: Float[np.ndarray, "rows columns 3"],
    centre: Float[np.ndarray, "objects 3"],
    radius: Float[np.ndarray, "objects"],
) -> Bool[np.ndarray, "rows columns"]:
    """Whether a ray passes any bounding sphere (centres relative to the camera)."""
    distance = np.linalg.norm(centre, axis=-1)
    inside = distance <= radius
    limit = np.where(inside, -1.0, np.sqrt(np.maximum(1 - (radius / np.maximum(distance, 1e-9)) ** 2, 0)))
    cosine = rays @ (centre / np.maximum(distance, 1e-9)[:, None]).T
    return (cosine >= limit - 1e-9).any(-1)


def frame_iou(
    a: Int[np.ndarray, "frames rows columns"], b: Int[np.ndarray, "frames rows columns"]
) -> Float[np.ndarray, "frames"]:
    """Intersection over union of the foregrounds, frame by frame; 1 where both are empty."""
    a, b = a > 0, b > 0
    union = (a | b).sum((1, 2))
    return np.where(union > 0, (a & b).sum((1, 2)) / np.maximum(union, 1), 1.0)
