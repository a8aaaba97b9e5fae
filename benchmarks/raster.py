"""Masks and flow of the ray caster against MuJoCo's own rays, MuJoCo's renderer and moving points in float64.

    python -m benchmarks.raster [--scenes 40] [--seed 0] [--size 480x320] [--json raster.json]

Scenes are random: one to four objects that overlap in view, poses of all kinds, some objects partly below the floor,
partly outside the picture, elongated or near, random cameras. Masks: a ray through every pixel's centre, cast by
``mj_multiRay``; IoU is that of labelled pixels, pooled over scenes, and that of the worst scene. Flow: the points that
MuJoCo's rays hit move with their body to the next pose and are projected again, in float64 numpy. Required: pooled IoU
at least 0.999 and flow within 0.02 px at the 99.9th percentile.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import jax
import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_refine.batch import SceneBatch, batch_from_scenes
from mjx_refine.scene import SHAPES, Body, Camera, Scene, Shape
from mjx_refine.sim.model import apply_fields, build_spec, model_fields
from mjx_refine.view.picture import draw

IOU_REQUIRED = 0.999
FLOW_REQUIRED = 0.02
"""99.9th percentile of the flow's error [px]."""

Counts = tuple[int, int]
"""Pixels that both masks label alike, and pixels that either labels."""


@dataclasses.dataclass(frozen=True)
class Compared:
    """One scene.

    Attributes:
      shapes: its objects.
      counts: (intersection, union) of every object [px].
      flow_errors: length of the flow's error at every pixel that both give to the same object [px].
    """

    shapes: tuple[Shape, ...]
    counts: tuple[Counts, ...]
    flow_errors: Float[np.ndarray, "pixels"]

    @property
    def iou(self) -> float:
        """Over all labelled pixels of the scene; NaN where nothing is seen."""
        return pooled(self.counts)


def pooled(counts: list[Counts] | tuple[Counts, ...]) -> float:
    """IoU of summed counts, NaN where they are empty."""
    both, either = np.sum(counts, axis=0) if len(counts) else (0, 0)
    return float(both / either) if either else float("nan")


# Scenes ---------------------------------------------------------------------------------------------------------------


def random_camera(generator: np.random.Generator) -> Camera:
    """Half a metre to five metres above the floor, looking between straight down and the horizon."""
    return Camera(
        position=(*generator.uniform(-1, 1, 2).tolist(), float(generator.uniform(0.5, 5.0))),
        orientation=float(generator.uniform(0, 90)),
        fovy=float(generator.uniform(20, 90)),
    )


def rotation(quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """MuJoCo's own matrix of a quaternion w x y z."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, np.float64))
    return matrix.reshape(3, 3)


def camera_axes(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """Columns: the camera's x (right), y (up) and z (backwards) in the world."""
    angle = np.deg2rad(camera.orientation)
    return rotation(np.array([np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0]))


def random_body(shape: Shape, index: int, camera: Camera, aspect: float, generator: np.random.Generator) -> Body:
    """A body somewhere along a ray of the view or a little beside it, near to far, any orientation, one in four below."""
    half = np.tan(np.deg2rad(camera.fovy) / 2) * generator.uniform(-1.2, 1.2, 2)
    direction = camera_axes(camera) @ np.array([half[0] * aspect, half[1], -1])
    # Most stand above the floor, which is opaque.
    farthest = min(6.0, camera.position[2] / max(-direction[2], 1e-9))
    distance = generator.uniform(0.2, 1.0) * farthest
    position = np.array(camera.position) + distance * direction
    # A quarter is long or flat, and sizes go with distance so that the near ones do not hide everything.
    ratio = generator.uniform(4, 20) if generator.random() < 0.25 else 1.0
    extents = distance * generator.uniform(0.02, 0.2, 3) * np.array([1.0, 1.0, ratio])[generator.permutation(3)]
    if generator.random() < 0.25:
        position[2] = generator.uniform(-0.5, 0.5) * extents.max()
    turn = generator.standard_normal(4)
    count = {"sphere": 1, "cylinder": 2, "box": 3}[shape]
    return Body(
        shape=shape,
        name=f"{shape}_{index}",
        size=tuple(np.minimum(extents[:count], 0.5 * distance).tolist()),
        position=tuple(position.tolist()),
        orientation=tuple((turn / np.linalg.norm(turn)).tolist()),
    )


def holds_camera(scene: Scene) -> bool:
    """Whether the camera is inside an object, or nearly: no view shows that one."""
    for body in scene.objects:
        extent = {"sphere": body.size * 3, "cylinder": (body.size[0], body.size[0], body.size[-1] / 2)}
        local = rotation(np.array(body.orientation)).T @ (np.array(scene.camera.position) - body.position)
        if (np.abs(local) < np.array(extent.get(body.shape, body.size)) + 0.02).all():
            return True
    return False


def random_scene(shapes: tuple[Shape, ...], generator: np.random.Generator, aspect: float = 1.5) -> Scene:
    """A scene of these shapes that does not enclose its camera; ``aspect`` is the picture's width over its height."""
    while True:
        camera = random_camera(generator)
        bodies = (random_body(shape, i, camera, aspect, generator) for i, shape in enumerate(shapes))
        scene = Scene(tuple(bodies), camera)
        if not holds_camera(scene):
            return scene


def random_scenes(count: int, seed: int, aspect: float = 1.5) -> Iterator[Scene]:
    """``count`` scenes for each shape: a body of that shape and none to three others."""
    generator = np.random.default_rng(seed)
    for shape in SHAPES:
        for _ in range(count):
            others = [SHAPES[i] for i in generator.integers(0, len(SHAPES), generator.integers(0, 4))]
            yield random_scene((shape, *others), generator, aspect)


def moved_poses(batch: SceneBatch, generator: np.random.Generator) -> Float[np.ndarray, "2 objects 7"]:
    """The scene's poses and, as the next frame's, poses some centimetres and up to half a radian away."""
    first = np.concatenate([batch.position[0], batch.quaternion[0]], -1)
    second = first.copy()
    second[:, :3] += generator.uniform(-0.1, 0.1, (len(first), 3))
    for row in second:
        mujoco.mju_quatIntegrate(row[3:], generator.uniform(-0.3, 0.3, 3), 1.0)
    return np.stack([first, second])


# MuJoCo's pictures ----------------------------------------------------------------------------------------------------


def mujoco_scene(batch: SceneBatch, pose: Float[np.ndarray, "objects 7"], spec: mujoco.MjSpec | None = None):
    """(model, data) with the bodies at ``pose``; nothing is simulated."""
    model = (spec or build_spec(batch.shapes, 30.0)).compile()
    apply_fields(model, model_fields(batch), 0)
    data = mujoco.MjData(model)
    data.qpos[:] = pose.reshape(-1)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    return model, data


def pixel_rays(camera: Camera, size: tuple[int, int]) -> Float[np.ndarray, "pixels 3"]:
    """Unit directions through the pixels' centres, row by row, in the world."""
    width, height = size
    focal = (height / 2) / np.tan(np.deg2rad(camera.fovy) / 2)
    y, x = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    local = np.stack([(x - width / 2) / focal, (height / 2 - y) / focal, -np.ones_like(x)], -1).reshape(-1, 3)
    rays = local @ camera_axes(camera).T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def cast_by_mujoco(
    model: mujoco.MjModel, data: mujoco.MjData, camera: Camera, size: tuple[int, int]
) -> tuple[Int[np.ndarray, "height width"], Float[np.ndarray, "pixels 3"]]:
    """Ids (0 floor or nothing, k + 1 object k) and the points that the rays hit [m]."""
    rays = pixel_rays(camera, size)
    geom, distance = np.full(len(rays), -1, np.int32), np.zeros(len(rays))
    origin = np.array(camera.position)
    mujoco.mj_multiRay(
        model, data, origin, rays.reshape(-1), np.ones(6, np.uint8), True, -1, geom, distance, None, len(rays), 1e10
    )
    return np.maximum(geom, 0).reshape(size[::-1]), origin + distance[:, None] * rays


def renderer_problem() -> str | None:
    """Why MuJoCo's renderer cannot be used here, or None."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    try:
        with mujoco.Renderer(model, 8, 8) as renderer:
            renderer.update_scene(mujoco.MjData(model))
            renderer.render()
    except Exception as error:
        # Whatever a missing driver raises: import errors, attribute errors of a library that is None, GL errors.
        return f"{type(error).__name__} with MUJOCO_GL={os.environ['MUJOCO_GL']}"
    return None


def render_by_mujoco(
    scene: Scene, batch: SceneBatch, pose: np.ndarray, size: tuple[int, int]
) -> Int[np.ndarray, "height width"]:
    """Ids by MuJoCo's OpenGL segmentation."""
    spec = build_spec(batch.shapes, 30.0)
    angle = np.deg2rad(scene.camera.orientation) / 2
    spec.worldbody.add_camera(
        name="view", pos=scene.camera.position, fovy=scene.camera.fovy, quat=[np.cos(angle), np.sin(angle), 0, 0]
    )
    spec.visual.global_.offwidth, spec.visual.global_.offheight = size
    # Its spheres and cylinders are polyhedra; the default of 28 sides would be what is measured.
    spec.visual.quality.numslices, spec.visual.quality.numstacks = 360, 180
    spec.visual.map.znear, spec.visual.map.zfar = 1e-3, 1e3
    model, data = mujoco_scene(batch, pose, spec)
    model.stat.extent = 1.0
    with mujoco.Renderer(model, size[1], size[0]) as renderer:
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, "view")
        picture = renderer.render()
    geoms = picture[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)
    return np.where(geoms, np.maximum(picture[..., 0], 0), 0)


# Comparison -----------------------------------------------------------------------------------------------------------


def expected_flow(
    ids: Int[np.ndarray, "height width"],
    points: Float[np.ndarray, "pixels 3"],
    poses: Float[np.ndarray, "2 objects 7"],
    camera: Camera,
) -> tuple[Float[np.ndarray, "height width 2"], Bool[np.ndarray, "height width"]]:
    """Flow [px] of the points seen, zero on the background; and where the next frame still shows them in front.

    Points that come within 5 cm of the camera's plane are left out: their pictures are at infinity.
    """
    height, width = ids.shape
    focal = (height / 2) / np.tan(np.deg2rad(camera.fovy) / 2)
    y, x = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    flow, valid = np.zeros((height * width, 2)), np.ones(height * width, bool)
    for k in range(poses.shape[1]):
        pixels = np.nonzero(ids.reshape(-1) == k + 1)[0]
        before, after = (rotation(poses[t, k, 3:]) for t in (0, 1))
        local = (points[pixels] - poses[0, k, :3]) @ before
        seen = (local @ after.T + poses[1, k, :3] - np.array(camera.position)) @ camera_axes(camera)
        depth = np.maximum(-seen[:, 2], 1e-9)
        flow[pixels, 0] = focal * seen[:, 0] / depth + width / 2 - x.reshape(-1)[pixels]
        flow[pixels, 1] = height / 2 - focal * seen[:, 1] / depth - y.reshape(-1)[pixels]
        valid[pixels] = -seen[:, 2] > 0.05
    return flow.reshape(height, width, 2), valid.reshape(height, width)


def counts_of(ours: np.ndarray, theirs: np.ndarray, objects: int) -> tuple[Counts, ...]:
    """(intersection, union) of every object's pixels."""
    labels = range(1, objects + 1)
    return tuple(
        (int(np.count_nonzero((ours == k) & (theirs == k))), int(np.count_nonzero((ours == k) | (theirs == k))))
        for k in labels
    )


def compare(scene: Scene, size: tuple[int, int], generator: np.random.Generator, rendered: bool = False) -> Compared:
    """One scene, drawn by us and by MuJoCo's rays (``rendered``: by MuJoCo's renderer, without flow)."""
    batch = batch_from_scenes([scene])
    poses = moved_poses(batch, generator)
    masks, flow = draw(poses, batch, size)
    if rendered:
        theirs = render_by_mujoco(scene, batch, poses[0], size)
        return Compared(scene.shapes, counts_of(masks[0], theirs, len(scene.objects)), np.zeros(0))
    theirs, points = cast_by_mujoco(*mujoco_scene(batch, poses[0]), scene.camera, size)
    expected, valid = expected_flow(theirs, points, poses, scene.camera)
    same = (masks[0] == theirs) & valid
    errors = np.linalg.norm(flow[0] - expected, axis=-1)
    return Compared(scene.shapes, counts_of(masks[0], theirs, len(scene.objects)), errors[same & (theirs > 0)])


def machine() -> str:
    """Processor, system and versions."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    return (
        f"{model}, {os.cpu_count()} cores, {platform.system()}; Python {platform.python_version()}, "
        f"mujoco {mujoco.__version__}, jax {jax.__version__} on {jax.devices()[0].device_kind}"
    )


def table(name: str, compared: list[Compared], with_flow: bool) -> bool:
    """Prints one comparison; returns whether it meets what is required."""
    print(f"\n{name}; worst and median of those with 100 pixels and more")
    print(f"{'shape':<10} {'objects':>7} {'pixels':>10} {'median IoU':>11} {'worst':>8} {'pooled':>9}")
    for shape in SHAPES:
        counts = [
            c for one in compared for s, c in zip(one.shapes, one.counts, strict=True) if s == shape and c[1] > 99
        ]
        each = [both / either for both, either in counts]
        pixels = sum(either for _, either in counts)
        print(
            f"{shape:<10} {len(each):>7} {pixels:>10} {np.median(each):>11.6f} {min(each):>8.5f} {pooled(counts):>9.6f}"
        )
    scenes = [one.iou for one in compared if sum(c[1] for c in one.counts) > 99]
    everything = [c for one in compared for c in one.counts]
    total = pooled(everything)
    print(
        f"{'scenes':<10} {len(scenes):>7} {sum(c[1] for c in everything):>10} {np.median(scenes):>11.6f} "
        f"{min(scenes):>8.5f} {total:>9.6f}   required: pooled >= {IOU_REQUIRED}"
    )
    if not with_flow:
        return total >= IOU_REQUIRED
    errors = np.concatenate([one.flow_errors for one in compared])
    median, high, most = np.percentile(errors, [50, 99.9, 100])
    print(
        f"flow error: median {median:.2g} px, 99.9th percentile {high:.2g} px, largest {most:.2g} px of {len(errors)} "
        f"pixels   required: 99.9th percentile <= {FLOW_REQUIRED}"
    )
    return total >= IOU_REQUIRED and high <= FLOW_REQUIRED


def main() -> int:
    """Prints the tables; exit status 1 where a requirement is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=40, help="for each shape")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", default="480x320")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    width, height = map(int, arguments.size.split("x"))
    generator = np.random.default_rng(arguments.seed + 1)
    scenes = list(random_scenes(arguments.scenes, arguments.seed, width / height))
    print(f"{machine()}\n{len(scenes)} scenes, {width}x{height}, seed {arguments.seed}")
    compared = [compare(scene, (width, height), generator) for scene in scenes]
    passed = table("against MuJoCo's rays", compared, True)
    problem = renderer_problem()
    if problem:
        print(f"\nagainst MuJoCo's renderer: not measured, it does not work here ({problem})")
    else:
        rendered = [compare(scene, (width, height), generator, rendered=True) for scene in scenes]
        passed &= table("against MuJoCo's renderer (spheres and cylinders of 360 sides)", rendered, False)
    if arguments.json:
        rows = [{"shapes": c.shapes, "counts": c.counts, "iou": c.iou} for c in compared]
        arguments.json.write_text(json.dumps(rows, indent=1))
    print(f"\n{'all requirements met' if passed else 'REQUIREMENT MISSED'}")
    return 0 if passed else 1


if __name__ == "__main__":
    raise SystemExit(main())
