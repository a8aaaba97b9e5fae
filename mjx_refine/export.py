"""A scene as MuJoCo XML that stands alone: every number in full, nothing of this package needed to run it."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from mjx_refine import files, rotations
from mjx_refine.batch import BatchEffect, SceneBatch
from mjx_refine.effects import acting, batch_with_effects
from mjx_refine.effects.hidden_obstacle import damping_of, gaps, pressed_by, stiffness_of
from mjx_refine.effects.wind import felt_shadow
from mjx_refine.errors import InputError
from mjx_refine.scene import Camera, Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.model import SUBSTEPS, contact_pairs, initial_state, model_fields

KEYFRAME = "start"
"""Name of the keyframe that holds the first frame's positions and velocities."""

EXPORTED = ("slope", "offset_com", "camera_roll", "hidden_obstacle", "wind", "drag")
"""Effects that MuJoCo's XML can hold, the last in part."""

LOOKED_AHEAD, HIT = 10.0, 64
"""For how long an exported obstacle's first hit is looked for [s], and steps in which it is over."""

_RESERVED = ("floor", "world")
_COLOURS = ("0.95 0.75 0.1", "0.1 0.65 0.9", "0.95 0.35 0.6", "0.35 0.8 0.35", "0.95 0.5 0.15", "0.6 0.45 0.95")

_COMMENT = f"""
  Made from a scene configuration; {SUBSTEPS} time steps are one frame of the clip.
  A viewer starts at the initial poses (qpos0) but at rest: only the keyframe "{KEYFRAME}" has the initial velocities.
  In the viewer press "Load key" (key 0); in Python call mujoco.mj_resetDataKeyframe(model, data, 0) before mj_step.
  The contact pairs, not the geoms' own contype and conaffinity, say what touches what.
"""


def export_xml(scene: Scene, fps: float = 30.0) -> str:
    """MJCF text that MuJoCo steps as ``MujocoSimulator`` does, to rounding.

    The compiler's ``dof_M0`` at a turned ``qpos0`` differs from the simulator's in the last bit. Where a cylinder meets a
    box or a cylinder, MuJoCo's iterative collider (tolerance 1e-6) can make 1e-5 m of that; elsewhere it stays below 1e-9.

    Bodies lie at their initial poses (``qpos0``); the keyframe ``start`` adds the initial velocities. The fixed camera
    ``camera`` is the scene's, and the viewer's free camera starts there too.

    Of the effects MuJoCo's own elements hold ``slope``, ``offset_com``, ``camera_roll``, ``wind`` without slowness and
    a linear ``drag`` exactly, and ``hidden_obstacle`` as a plane: what else pushes a body while it touches that plane is held
    off too, a body that starts far behind it is thrown out, and slow slip is stopped where the effect lets it creep.

    Args:
      scene: with no other effects.
      fps: frames a second; the time step is 1 / (8 fps) [s].

    Raises:
      InputError: an effect is wrong or cannot be held, or ``fps`` is no sensible rate.
    """
    if not 0.1 <= fps <= 1e5:
        raise InputError(f"fps = {fps!r}; expected 0.1 <= fps <= 100000 frames a second; correct it")
    names = _element_names(scene.names)
    batch = batch_with_effects([scene])
    _check_effects(batch)
    centre = acting.centre_of_mass(batch)
    fields = model_fields(batch)
    root = ElementTree.Element("mujoco", model="scene")
    root.append(ElementTree.Comment(_COMMENT))
    option = {"integrator": "Euler", "solver": "Newton", "cone": "elliptic"}
    _add(root, "option", timestep=repr(1.0 / (fps * SUBSTEPS)), gravity=_numbers(fields.gravity[0]), **option)
    _looks(root, scene)
    world = _add(root, "worldbody")
    _surroundings(world, scene.camera, batch)
    for i, (name, body) in enumerate(zip(names, scene.objects, strict=True)):
        place = {"pos": _numbers(body.position), "quat": _numbers(body.orientation)}
        element = _add(world, "body", name=name, **place)
        _add(element, "freejoint", name=name)
        inertia = {"mass": repr(float(fields.body_mass[0, i])), "diaginertia": _numbers(fields.body_inertia[0, i])}
        _add(element, "inertial", pos="0 0 0" if centre is None else _numbers(centre[0, i]), **inertia)
        used = {"sphere": 1, "cylinder": 2, "box": 3}[body.shape]
        shape = {"type": body.shape, "size": _numbers(fields.geom_size[0, i, :used])}
        colour = f"{_COLOURS[i % len(_COLOURS)]} 1"
        _add(element, "geom", name=name, **shape, rgba=colour, contype="0", conaffinity="0")
    contact = _add(root, "contact")
    for k, (first, second) in enumerate(contact_pairs(len(names))):
        numbers = {
            "friction": fields.pair_friction[0, k],
            "solref": fields.pair_solref[0, k],
            "solreffriction": fields.pair_solreffriction[0, k],
        }
        one = "floor" if first < 0 else names[first]
        texts = {key: _numbers(value) for key, value in numbers.items()}
        _add(contact, "pair", geom1=one, geom2=names[second], condim="6", **texts)
    _obstacles(world, contact, batch, names, fps)
    _forces(root, batch, names)
    qpos, qvel = initial_state(batch)
    keys = _add(root, "keyframe")
    _add(keys, "key", name=KEYFRAME, qpos=_numbers(qpos[0]), qvel=_numbers(qvel[0]))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def save_export(path: str | os.PathLike, scene: Scene, fps: float = 30.0) -> Path:
    """Writes ``export_xml`` to ``path``, whole or not at all.

    Raises:
      InputError: as ``export_xml``, or the place cannot be written.
    """
    return files.write_text(path, export_xml(scene, fps))


def _add(parent: ElementTree.Element, tag: str, /, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(parent, tag, attributes)


def _numbers(values) -> str:
    """Numbers with all their digits; MuJoCo's own writer may round."""
    return " ".join(repr(float(value)) for value in values)


def _element_names(names: tuple[str, ...]) -> list[str]:
    """Names that XML can hold and MuJoCo takes: printable, distinct, none of its own."""
    result: list[str] = []
    for name in names:
        plain = "".join(c if c.isprintable() else "_" for c in name).strip() or "object"
        while plain in result or plain in _RESERVED:
            plain += "_"
        result.append(plain)
    return result


def _looks(root: ElementTree.Element, scene: Scene) -> None:
    """Light, floor pattern, and a free camera that starts where the scene's camera stands."""
    pitch = math.radians(scene.camera.orientation)
    eye, forward = np.array(scene.camera.position), np.array([0.0, math.sin(pitch), -math.cos(pitch)])
    middle = np.mean([body.position for body in scene.objects], axis=0)
    distance = max(float(forward @ (middle - eye)), 0.5)
    # mjv_defaultFreeCamera: 1.5 extents from the centre.
    _add(root, "statistic", center=_numbers(eye + distance * forward), extent=repr(distance / 1.5))
    visual = _add(root, "visual")
    view = {"fovy": repr(scene.camera.fovy), "azimuth": "90", "elevation": repr(scene.camera.orientation - 90.0)}
    _add(visual, "global", **view, offwidth="1280", offheight="960")
    _add(visual, "headlight", ambient="0.35 0.35 0.35", diffuse="0.3 0.3 0.3", specular="0 0 0")
    asset = _add(root, "asset")
    sky = {"type": "skybox", "builtin": "gradient", "rgb1": "0.75 0.8 0.85", "rgb2": "0.3 0.35 0.4"}
    _add(asset, "texture", name="sky", **sky, width="256", height="256")
    check = {"type": "2d", "builtin": "checker", "rgb1": "0.62 0.62 0.6", "rgb2": "0.54 0.54 0.52"}
    _add(asset, "texture", name="floor", **check, width="256", height="256")
    cover = {"texture": "floor", "texrepeat": "2 2", "texuniform": "true", "reflectance": "0.05"}
    _add(asset, "material", name="floor", **cover)


def _surroundings(world: ElementTree.Element, camera: Camera, batch: SceneBatch) -> None:
    """Light, floor and the scene's camera, the last two turned as effects turn them."""
    _add(world, "light", pos="-1 -2 6", dir="0.15 0.3 -1", directional="true", diffuse="0.6 0.6 0.6")
    floor = {"type": "plane", "size": "0 0 0.05", "material": "floor", "contype": "0", "conaffinity": "0"}
    tilt = acting.floor_rotation(batch)
    if tilt is not None:
        floor["quat"] = _numbers(acting.quaternion_of(tilt[0]))
    _add(world, "geom", name="floor", **floor)
    half = math.radians(camera.orientation) / 2
    turn = np.array([math.cos(half), math.sin(half), 0.0, 0.0])
    for roll in _of(batch, "camera_roll"):
        turn = rotations.multiply(turn, rotations.exponential(np.array([0.0, 0.0, math.radians(roll[0])])))
    place = {"pos": _numbers(camera.position), "quat": _numbers(turn), "fovy": repr(camera.fovy)}
    _add(world, "camera", name="camera", mode="fixed", **place)


def _of(batch: SceneBatch, name: str) -> list[np.ndarray]:
    """The parameters of every effect of a kind."""
    return [effect.values[0] for effect in batch.effects if effect.name == name]


def _check_effects(batch: SceneBatch) -> None:
    for effect in batch.effects:
        remedy = "remove the entry, or use `refine simulate`, which has it"
        if effect.name not in EXPORTED:
            held = ", ".join(EXPORTED)
            raise InputError(f"effect {effect.name}: MuJoCo's XML cannot hold it (it can: {held}); {remedy}")
        if effect.name == "drag":
            linear, quadratic = effect.values[0]
            # Above that ``Drag`` keeps a step of time from reversing the body.
            if quadratic != 0 or linear > 100.0 * batch.mass[0, effect.target]:
                raise InputError(
                    f"effect drag: MuJoCo's XML holds only its linear part, up to 100 1/s times the mass; {remedy}"
                )
        if effect.name == "wind" and effect.values[0, 2] != 0:
            raise InputError(
                f"effect wind: slowness = {effect.values[0, 2]:g}; MuJoCo's XML holds only a wind that presses the same at all "
                f"speeds (slowness 0); {remedy}"
            )


def _obstacles(
    world: ElementTree.Element, contact: ElementTree.Element, batch: SceneBatch, names: list[str], fps: float
) -> None:
    """Walls that one object feels."""
    for effect in batch.effects:
        if effect.name != "hidden_obstacle":
            continue
        angle, distance, _ = effect.values[0]
        name = "obstacle"
        while name in names or world.find(f"geom[@name='{name}']") is not None:
            name += "_"
        turn = math.radians(angle)
        normal = np.array([math.cos(turn), math.sin(turn), 0.0])
        half = math.sqrt(0.5)
        shift, damping = _as_simulated(batch, effect, fps)
        place = {
            "pos": _numbers(normal * (distance + shift)),
            "quat": _numbers((half, -half * math.sin(turn), half * math.cos(turn), 0.0)),
        }
        look = {"size": "1 1 0.05", "rgba": "0.8 0.3 0.3 0.2", "contype": "0", "conaffinity": "0"}
        _add(world, "geom", name=name, type="plane", **place, **look)
        # The largest impedance that MuJoCo takes: the contact's acceleration is that of the damped spring.
        step = 1.0 / (fps * SUBSTEPS)
        solref = _numbers((-stiffness_of(step), -damping))
        spring = {"solref": solref, "solimp": "0.9999 0.9999 0.001 0.5 2"}
        sliding = float(batch.friction[0, effect.target, 0])
        rub = {"friction": _numbers((sliding, sliding, 0.0, 0.0, 0.0)), "solreffriction": _numbers((-1.0, -1.0 / step))}
        _add(contact, "pair", geom1=name, geom2=names[effect.target], condim="3", **spring, **rub)


def _as_simulated(batch: SceneBatch, effect: BatchEffect, fps: float) -> tuple[float, float]:
    """By how much MuJoCo's plane must stand farther from the origin, and its contact's damping, for the target's first hit to
    return what the simulator's returns [m, 1/s].

    MuJoCo begins to push in the first step that finds the target in the plane: where within a step that is reached makes a
    difference of up to 0.1 of the speed, which the simulator's effect does not know.
    """
    step, frames = 1.0 / (fps * SUBSTEPS), math.ceil(LOOKED_AHEAD * fps)
    alone = dataclasses.replace(batch, effects=tuple(e for e in batch.effects if e is not effect))
    poses = MujocoSimulator(batch.shapes, fps, 1).rollout(alone, frames)[0]
    gap = gaps(alone, poses, effect.target, effect.values[0])
    hits = np.flatnonzero((gap[1:] <= 0) & (gap[:-1] > 0))
    before = int(hits[0]) if len(hits) else 0
    # Where nothing is hit, any hit will do.
    away, speed = (gap[before], (gap[before] - gap[before + 1]) * fps) if len(hits) else (2.3 * step, 1.0)
    wanted = damping_of(effect.values[0, 2], step)
    speed_of, place_of = _after_hit(
        -away, speed, step, lambda d, v: np.where(d > -v * step, pressed_by(d, v, wanted, step), 0.0)
    )
    damping, shift = np.meshgrid(np.linspace(0.0, 0.9 / step, 181), np.linspace(-1.0, 1.0, 81) * speed * step)
    told = _after_hit(
        -away + shift,
        np.full(shift.shape, speed),
        step,
        lambda d, v: np.where(d > 0, np.maximum(stiffness_of(step) * d + damping * v, 0.0), 0.0),
    )
    # Half a second later.
    off = (told[1] - shift - place_of + 0.5 * (told[0] - speed_of)) ** 2 + (told[1] - shift - place_of) ** 2
    best = int(np.argmin(off))
    return float(shift.flat[best]), float(damping.flat[best])


def _after_hit(
    depth, speed, step: float, pressed: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Speed into a wall, and how deep in it, once something has come to it and gone."""
    depth, speed = np.asarray(depth, np.float64), np.asarray(speed, np.float64)
    for _ in range(HIT):
        speed = speed - step * pressed(depth, speed)
        depth = depth + step * speed
    return speed, depth


def _forces(root: ElementTree.Element, batch: SceneBatch, names: list[str]) -> None:
    """Wind and linear drag as motors of the free joints: constant, and proportional to the velocity."""
    rows: list[tuple[str, int, str]] = []
    for values in _of(batch, "wind"):
        for i, name in enumerate(names):
            rows += [(name, k, _numbers((values[k] * felt_shadow(batch)[0, i], 0.0, 0.0))) for k in range(2)]
    for effect in batch.effects:
        if effect.name == "drag":
            rows += [(names[effect.target], k, _numbers((0.0, 0.0, -effect.values[0, 0]))) for k in range(3)]
    if rows:
        motors = _add(root, "actuator")
        for name, k, bias in rows:
            gear = _numbers(np.eye(6)[k])
            _add(motors, "general", joint=name, gear=gear, gainprm="0", biastype="affine", biasprm=bias)
