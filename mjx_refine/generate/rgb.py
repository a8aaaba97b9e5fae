"""RGB frames by MuJoCo's renderer in random looks, and the flow that OpenCV measures from them."""

from __future__ import annotations

import os

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from mjx_refine.batch import batch_from_scenes
from mjx_refine.errors import InputError
from mjx_refine.generate.options import SIZE, SPLITS, GenerateOptions
from mjx_refine.generate.record import Record, Seen, from_jpeg, jpeg
from mjx_refine.scene import Scene
from mjx_refine.sim.model import apply_fields, build_spec, model_fields

_STREAM = 2**32
"""Part of the looks' seed, away from all attempts."""

_FINEST = 1 / 32
"""Measured flow and its noise are rounded to this [px], the least noise that is ever stated."""

_EXTENT = 5.0
"""Half the width of what directional lights throw shadows in [m]."""

_TEXTURE = 256
"""Pixels along a texture's edge."""

_BUILTIN = mujoco.mjtBuiltin
_KIND = mujoco.mjtTexture


def check_renderer() -> None:
    """Draws one small picture in this process.

    Raises:
      InputError: MuJoCo's renderer does not work here.
    """
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    try:
        with mujoco.Renderer(model, 8, 8) as renderer:
            renderer.update_scene(mujoco.MjData(model))
            renderer.render()
    except Exception as error:  # whatever a missing driver raises
        chosen = os.environ.get("MUJOCO_GL", "unset")
        raise InputError(
            f"--rgb: MuJoCo cannot draw pictures here ({type(error).__name__} with MUJOCO_GL={chosen}); install libegl1 "
            "and set MUJOCO_GL=egl, or libosmesa6 and MUJOCO_GL=osmesa, or leave --rgb out"
        ) from error


def film(record: Record, options: GenerateOptions, index: int) -> Seen:
    """Draws the record in a random look and measures the flow.

    The frames are those that the JPEG gives, so that the flow is that of the frames that a reader sees.
    """
    from mjx_refine.observe.flow import measure_flow

    generator = np.random.default_rng((options.seed, SPLITS.index(options.split), index, _STREAM))
    frames = from_jpeg(jpeg(rendered(record.scene, record.motion.qpos, generator)))
    field = measure_flow(frames, record.masks.astype(np.int32))
    flow, sigma = (np.round(array / _FINEST) * _FINEST for array in (field.flow, field.sigma))
    return Seen(frames, flow.astype(np.float16), np.maximum(sigma, _FINEST).astype(np.float16))


def rendered(
    scene: Scene, qpos: Float[np.ndarray, "frames objects 7"], generator: np.random.Generator
) -> UInt8[np.ndarray, "frames height width 3"]:
    """Frames of the scene in a look that ``generator`` draws."""
    batch = batch_from_scenes([scene])
    spec = build_spec(batch.shapes, 30.0)
    _add_camera(spec, scene)
    _dress(spec, scene, generator)
    model = spec.compile()
    apply_fields(model, model_fields(batch), 0)
    model.stat.extent = _EXTENT
    data = mujoco.MjData(model)
    frames = np.empty((len(qpos), SIZE[1], SIZE[0], 3), np.uint8)
    with mujoco.Renderer(model, SIZE[1], SIZE[0]) as renderer:
        for frame, poses in zip(frames, qpos, strict=True):
            data.qpos[:] = poses.reshape(-1)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, "view")
            renderer.render(out=frame)
    return frames


def _add_camera(spec: mujoco.MjSpec, scene: Scene) -> None:
    half = np.deg2rad(scene.camera.orientation) / 2
    quaternion = [np.cos(half), np.sin(half), 0.0, 0.0]
    spec.worldbody.add_camera(name="view", pos=scene.camera.position, fovy=scene.camera.fovy, quat=quaternion)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = SIZE
    spec.visual.quality.numslices, spec.visual.quality.numstacks = 64, 32
    spec.visual.quality.shadowsize = 4096
    spec.visual.map.znear, spec.visual.map.zfar = 0.02 / _EXTENT, 60.0 / _EXTENT


def _dress(spec: mujoco.MjSpec, scene: Scene, generator: np.random.Generator) -> None:
    """Lights, background, floor and the objects' surfaces."""
    sky = _colours(generator)
    spec.add_texture(
        name="sky", type=_KIND.mjTEXTURE_SKYBOX, builtin=_BUILTIN.mjBUILTIN_GRADIENT, rgb1=sky[0], rgb2=sky[1],
        width=_TEXTURE, height=6 * _TEXTURE,
    )  # fmt: skip
    _lights(spec, scene, generator)
    _surface(spec, "floor", _KIND.mjTEXTURE_2D, generator, float(generator.uniform(0.5, 4.0)))
    spec.geom("floor").material = "floor"
    for number, name in enumerate(f"object_{k}" for k in range(len(scene.objects))):
        _surface(spec, name, _KIND.mjTEXTURE_CUBE, generator, float(generator.uniform(1.0, 4.0)), number)
        spec.geom(name).material = name


def _colours(generator: np.random.Generator) -> Float[np.ndarray, "2 3"]:
    """Two colours that differ."""
    while True:
        pair = generator.uniform(0.05, 1.0, (2, 3))
        if np.abs(pair[0] - pair[1]).sum() > 0.5:
            return pair


def _surface(spec, name: str, kind, generator: np.random.Generator, repeat: float, number: int = 0) -> None:
    """A material called ``name`` with a checker or gradient texture and random gloss."""
    builtin = (_BUILTIN.mjBUILTIN_CHECKER, _BUILTIN.mjBUILTIN_GRADIENT)[generator.integers(2)]
    first, second = _colours(generator)
    marked = generator.random() < 0.7
    spec.add_texture(
        name=name, type=kind, builtin=builtin, rgb1=first, rgb2=second, width=_TEXTURE,
        height=_TEXTURE * (6 if kind == _KIND.mjTEXTURE_CUBE else 1), markrgb=generator.uniform(0, 1, 3),
        mark=mujoco.mjtMark.mjMARK_RANDOM if marked else mujoco.mjtMark.mjMARK_NONE, random=0.01,
    )  # fmt: skip
    textures = [""] * mujoco.mjtTextureRole.mjNTEXROLE.value
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB.value] = name
    flat = kind == _KIND.mjTEXTURE_2D
    spec.add_material(
        name=name, textures=textures, texuniform=flat, texrepeat=[repeat, repeat] if flat else [1, 1],
        specular=float(generator.uniform(0, 0.8)), shininess=float(generator.uniform(0, 0.8)),
        reflectance=float(generator.uniform(0, 0.15)) if flat else 0.0,
    )  # fmt: skip


def _lights(spec: mujoco.MjSpec, scene: Scene, generator: np.random.Generator) -> None:
    """One to three lamps above the scene, of which the first throws shadows, and some light from everywhere."""
    ambient = float(generator.uniform(0.15, 0.4))
    spec.visual.headlight.ambient = [ambient] * 3
    spec.visual.headlight.diffuse = [float(generator.uniform(0.0, 0.3))] * 3
    spec.visual.headlight.specular = [0.0] * 3
    middle = np.mean([body.position for body in scene.objects], 0) * [1, 1, 0]
    count = int(generator.integers(1, 4))
    for number in range(count):
        place = middle + generator.uniform([-2, -2, 4], [2, 2, 7])
        strength = generator.uniform(0.4, 0.9, 1) * generator.uniform(0.8, 1.0, 3) / count**0.5
        spec.worldbody.add_light(
            pos=place, dir=middle - place, castshadow=number == 0, diffuse=strength, specular=0.4 * strength,
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL if generator.random() < 0.5 else mujoco.mjtLightType.mjLIGHT_SPOT,
            cutoff=float(generator.uniform(45, 80)), exponent=float(generator.uniform(0, 5)),
        )  # fmt: skip
