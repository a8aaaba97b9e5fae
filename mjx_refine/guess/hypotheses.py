"""Scenes that may lie behind the tracks: on the floor, on a tilted board, seen from the side, in free flight."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np

from mjx_refine import rotations
from mjx_refine.guess.forms import form_options, form_sets
from mjx_refine.guess.lift import Form, Lens, extent_below, fly, onto_plane
from mjx_refine.guess.motion import Motion, motions, restitution
from mjx_refine.guess.scaling import scaled
from mjx_refine.guess.tracks import Track
from mjx_refine.scene import Body, Scene

GRAVITY = 9.81
BODY_SIZE = 0.15
"""Radius [m] that objects get where nothing tells the scale."""

LOW_FRICTION = 0.2
"""Friction that a larger gravity brings a strong loss of speed down to."""

FOVY = 45.0


@dataclasses.dataclass(frozen=True)
class Hypothesis:
    """A scene and the family (mode, camera's pitch, shapes) it stands for."""

    scene: Scene
    family: tuple


@dataclasses.dataclass(frozen=True)
class Clip:
    """What all hypotheses share.

    Attributes:
      tracks: the objects.
      fps: frames a second.
      size: (width, height) [px].
    """

    tracks: tuple[Track, ...]
    fps: float
    size: tuple[int, int]

    @property
    def stiffness(self) -> float:
        """Contact stiffness as high as the time step bears, so that quick objects do not sink into one another [1/s^2]."""
        return float(min(0.35 * (8 * self.fps) ** 2, 60000.0))


@dataclasses.dataclass(frozen=True)
class Placed:
    """An object in a scene under construction, lengths in units of the scene's unknown scale.

    Attributes:
      form: its primitive.
      depth: of its centre in the first frame.
      position, velocity: in the first frame.
      spin: world frame [rad/s].
      friction: (sliding, rolling in units of the scale).
    """

    form: Form
    depth: float
    position: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray
    friction: tuple[float, float] = (0.3, 0.0)


def all_hypotheses(clip: Clip, most_kinds: int = 4) -> list[Hypothesis]:
    """Every hypothesis that the tracks allow."""
    result: list[Hypothesis] = []
    for pitch in (0.0, 20.0, 45.0, 60.0, 75.0):
        lens = Lens(math.radians(pitch), math.radians(FOVY), clip.size)
        result += _on_floor(clip, lens, most_kinds)
        if pitch == 0.0:
            result += _on_board(clip, lens, most_kinds)
    for pitch in (20.0, 30.0, 45.0, 60.0, 75.0, 90.0):
        lens = Lens(math.radians(pitch), math.radians(FOVY), clip.size)
        result += _in_flight(clip, lens, most_kinds)
    for pitch in (80.0, 90.0):
        lens = Lens(math.radians(pitch), math.radians(FOVY), clip.size)
        result += _from_side(clip, lens, most_kinds)
    return result


def _sets(clip: Clip, lens: Lens, airborne: bool, most: int) -> list[tuple[Form, ...]]:
    return form_sets([form_options(t, lens, airborne=airborne) for t in clip.tracks], most)


def _scale(lens: Lens, placed: list[Placed], size: float = BODY_SIZE) -> float:
    """Metres a unit of length that give objects the typical radius ``size``."""
    sizes = [float(np.mean(p.form.size)) * p.depth / lens.focal for p in placed]
    return size / float(np.exp(np.mean(np.log(sizes))))


def _turning(track: Track, lens: Lens, fps: float) -> np.ndarray:
    """The spin that the flow shows, about the camera's axis [rad/s], nought where it is weak."""
    rate = track.spin * fps
    # A few hundredths of a pixel at the rim are noise.
    if abs(track.spin) * track.diameter / 2 < 0.15:
        return np.zeros(3)
    return rate * lens.matrix[:, 2]


def _scene(
    clip: Clip,
    lens: Lens,
    placed: list[Placed],
    camera: np.ndarray,
    gravity: np.ndarray,
    scale: float,
    bounce: float,
) -> Scene:
    """The scene in metres."""
    stiffness = clip.stiffness
    logarithm = math.log(min(max(bounce, 0.02), 0.98))
    ratio = -logarithm / math.hypot(math.pi, logarithm)
    bodies = []
    first = _volume(placed[0], lens)
    for i, p in enumerate(placed):
        metres = p.depth / lens.focal * scale
        size = tuple(min(max(float(v) * metres, 1e-3), 100.0) for v in p.form.size)
        body_spin = rotations.rotate(rotations.conjugate(np.array(p.form.quaternion)), p.spin)
        lowest = extent_below(p.form) * metres
        position = p.position * scale
        position[2] = max(position[2], lowest)
        bodies.append(
            Body(
                shape=p.form.shape,
                name=f"{p.form.shape}_{i}",
                size=size,
                position=_vector(position),
                orientation=p.form.quaternion,
                linear_velocity=_vector(p.velocity * scale),
                angular_velocity=_vector(body_spin),
                friction=(min(p.friction[0], 3.0), min(p.friction[1] * scale, 0.5)),
                mass=float(min(max(_volume(p, lens) / first, 0.02), 50.0)),
                damping=-min(2 * ratio * math.sqrt(stiffness), 200.0),
                stiffness=stiffness,
            )
        )
    return Scene(tuple(bodies), lens.camera(camera * scale), _vector(gravity))


def _volume(p: Placed, lens: Lens) -> float:
    size = p.form.size
    volume = {"sphere": 4.19 * size[0] ** 3, "box": 8 * float(np.prod(size))}.get(p.form.shape)
    volume = 3.14 * size[0] ** 2 * size[-1] if volume is None else volume
    return volume * (p.depth / lens.focal) ** 3


def _vector(v: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(min(max(c, -500.0), 500.0)) for c in v)
    return (x, y, z)


def _lift_floor(clip: Clip, lens: Lens, track: Track, form: Form, below: float) -> tuple[Motion, float] | None:
    """(motion along a floor ``below`` the camera, depth in the first frame)."""
    frames = np.concatenate([piece.frames for piece in track.pieces])
    depth = below
    for _ in range(3):
        height = extent_below(form) * depth / lens.focal
        points = onto_plane(lens, track.centre[frames], below - min(height, 0.8 * below))
        if points is None:
            return None
        depth = float(points[0] @ -lens.matrix[:, 2])
    return motions(track, points, frames, clip.fps), depth


def _floor_objects(
    clip: Clip, lens: Lens, forms: tuple[Form, ...], below: float = 1.0
) -> list[tuple[Placed, Motion]] | None:
    result = []
    for track, form in zip(clip.tracks, forms, strict=True):
        lifted = _lift_floor(clip, lens, track, form, below)
        if lifted is None:
            return None
        motion, depth = lifted
        position = motion.position.copy()
        position[2] = extent_below(form) * depth / lens.focal
        velocity = np.array([*motion.velocity[:2], 0.0])
        result.append((Placed(form, depth, position, velocity, _turning(track, lens, clip.fps)), motion))
    return result


def _on_floor(clip: Clip, lens: Lens, most: int) -> list[Hypothesis]:
    """All objects slide or roll on the floor, slowed by friction."""
    result = []
    for forms in _sets(clip, lens, False, most):
        lifted = _floor_objects(clip, lens, forms)
        if lifted is None:
            continue
        scale = _scale(lens, [p for p, _ in lifted])
        camera = np.array([0.0, -math.tan(lens.pitch), 1.0])
        shift = np.array([camera[0], camera[1], 0.0])
        rolls = [False, True] if any(_can_roll(f) for f in forms) else [False]
        strongest = max(m.deceleration for _, m in lifted) * scale
        # Strong friction between objects throws them up; a larger gravity slows them as well with less of it.
        gravities = [GRAVITY, strongest / LOW_FRICTION] if strongest > 2 * LOW_FRICTION * GRAVITY else [GRAVITY]
        bounces = (0.95, 0.7) if len(forms) > 1 else (0.6,)
        for rolling, strength, bounce in itertools.product(rolls, gravities, bounces):
            moved = [(dataclasses.replace(p, position=p.position + shift), m) for p, m in lifted]
            placed = [_slowed(p, m, scale, strength, lens, rolling) for p, m in moved]
            scene = _scene(clip, lens, placed, camera, np.array([0.0, 0.0, -strength]), scale, bounce)
            mode = "rolling" if rolling else "sliding"
            result.append(Hypothesis(scene, (mode, round(math.degrees(lens.pitch)), scene.shapes)))
    return result


def _can_roll(form: Form) -> bool:
    if form.shape == "sphere":
        return True
    axis = rotations.matrix(np.array(form.quaternion))[:, 2]
    return form.shape == "cylinder" and abs(axis[2]) < 0.3


def _slowed(p: Placed, motion: Motion, scale: float, gravity: float, lens: Lens, rolling: bool) -> Placed:
    """With the friction that its loss of speed asks for under ``gravity`` [m/s^2]."""
    loss = max(motion.deceleration * scale / gravity, 0.0)
    if rolling and _can_roll(p.form):
        radius = p.form.size[0] * p.depth / lens.focal
        spin = np.array([-p.velocity[1], p.velocity[0], 0.0]) / radius
        if p.form.shape == "cylinder":
            axis = rotations.matrix(np.array(p.form.quaternion))[:, 2]
            spin = axis * (axis @ spin)
        return dataclasses.replace(p, spin=spin, friction=(max(0.5, 2 * loss), 1.4 * loss * radius))
    return dataclasses.replace(p, friction=(loss, 0.0))


def _on_board(clip: Clip, lens: Lens, most: int) -> list[Hypothesis]:
    """Motion in the picture's plane: gravity has a part along it, as on a tilted board that the camera faces."""
    result = []
    for forms in _sets(clip, lens, False, most):
        lifted = _floor_objects(clip, lens, forms)
        if lifted is None:
            continue
        weight = np.array([m.weight for _, m in lifted])
        if weight.sum() <= 0:
            continue
        pull = (np.array([m.acceleration for _, m in lifted]) * weight[:, None]).sum(0) / weight.sum()
        scale = _scale(lens, [p for p, _ in lifted])
        placed = [dataclasses.replace(p, friction=(0.0, 0.0)) for p, _ in lifted]
        strength = float(np.linalg.norm(pull[:2])) * scale
        press = max(math.sqrt(max(GRAVITY**2 - strength**2, 0.0)), 3.0)
        gravity = np.array([*(pull[:2] * scale), -press])
        scene = _scene(clip, lens, placed, np.array([0.0, 0.0, 1.0]), gravity, scale, 0.6)
        result.append(Hypothesis(scene, ("board", 0, scene.shapes)))
    return result


def _falls(track: Track) -> bool:
    """Whether the first piece bends downwards in the picture by more than its noise."""
    piece = track.pieces[0]
    span = float(piece.frames[-1] - piece.frames[0])
    sag = piece.acceleration[1] * span**2 / 8
    return len(piece.frames) >= 4 and sag > max(0.5, 0.5 * abs(piece.acceleration[0]) * span**2 / 8)


def _in_flight(clip: Clip, lens: Lens, most: int) -> list[Hypothesis]:
    """Objects whose track bends downwards fly; the others lie on the floor where the flights come down."""
    flying = [_falls(track) for track in clip.tracks]
    if not any(flying):
        return []
    result = []
    for forms in _sets(clip, lens, True, most):
        flights = [
            _flight(clip, lens, t, f) if up else None for t, f, up in zip(clip.tracks, forms, flying, strict=True)
        ]
        if not any(flights):
            continue
        floors = [f[1] for f in flights if f is not None]
        for drop in (0.0, 0.3):
            below = max(floors) + drop
            if below <= 0.05:
                continue
            scene = _landing_scene(clip, lens, forms, flights, below)
            if scene is not None:
                result += _rescaled(scene, ("flight", round(math.degrees(lens.pitch)), scene.shapes))
    return result


def _flight(clip: Clip, lens: Lens, track: Track, form: Form) -> tuple[Placed, float] | None:
    """(the object relative to the camera, how far below the camera the floor is at least)."""
    piece = track.pieces[0]
    seconds = piece.frames / clip.fps
    gravity = np.array([0.0, 0.0, -GRAVITY])
    trust = 0.5 if track.roundness > 0.8 and track.diameter > 8 else 0.05
    flight = fly(lens, track.centre[piece.frames], seconds, track.width[piece.frames], gravity, trust)
    if flight is None:
        return None
    depths = flight.at(seconds, gravity) @ -lens.matrix[:, 2]
    start = flight.at(0.0, gravity)
    first = float(depths[0])
    # The form's pixels were measured near the first frame of the piece.
    placed = Placed(form, first, start, flight.velocity, _turning(track, lens, clip.fps))
    last = (piece.frames[-1] + (0.5 if len(track.pieces) > 1 else 0.0)) / clip.fps
    times = np.linspace(0.0, last, 32)
    lowest = float(flight.at(times, gravity)[:, 2].min()) - extent_below(form) * first / lens.focal
    return placed, -lowest


def _landing_scene(clip: Clip, lens: Lens, forms, flights, below: float) -> Scene | None:
    placed = []
    for track, form, flight in zip(clip.tracks, forms, flights, strict=True):
        if flight is not None:
            p = flight[0]
            placed.append(dataclasses.replace(p, position=p.position + np.array([0.0, 0.0, below])))
            continue
        lifted = _lift_floor(clip, lens, track, form, below)
        if lifted is None:
            return None
        motion, depth = lifted
        position = motion.position.copy()
        position[2] = extent_below(form) * depth / lens.focal
        velocity = np.array([*motion.velocity[:2], 0.0])
        p = Placed(form, depth, position, velocity, _turning(track, lens, clip.fps))
        placed.append(_slowed(p, motion, 1.0, GRAVITY, lens, rolling=_can_roll(form)))
    middle = np.mean([p.position for p in placed], axis=0)
    shift = -np.array([middle[0], middle[1], 0.0])
    placed = [dataclasses.replace(p, position=p.position + shift) for p in placed]
    bounce = restitution(clip.tracks)
    camera = np.array([0.0, 0.0, below]) + shift
    return _scene(clip, lens, placed, camera, np.array([0.0, 0.0, -GRAVITY]), 1.0, bounce)


def _rescaled(scene: Scene, family: tuple) -> list[Hypothesis]:
    """The scene, and the same with objects of typical size where they differ much: lengths and gravity scale together."""
    radius = float(np.exp(np.mean([np.log(np.mean(b.size)) for b in scene.objects])))
    factor = BODY_SIZE / radius
    if 0.6 < factor < 1.7:
        return [Hypothesis(scene, family)]
    return [Hypothesis(scene, family), Hypothesis(scaled(scene, factor), family)]


def _from_side(clip: Clip, lens: Lens, most: int) -> list[Hypothesis]:
    """A level or nearly level camera; everything happens in one upright plane before it, at depth 1."""
    result = []
    for forms in _sets(clip, lens, True, most):
        lifted = []
        for track, form in zip(clip.tracks, forms, strict=True):
            frames = np.concatenate([piece.frames for piece in track.pieces])
            rays = lens.rays(track.centre[frames])
            lifted.append((track, form, frames, rays / rays[:, 1:2]))
        result += _side_scenes(clip, lens, lifted)
    return result


def _side_scenes(clip: Clip, lens: Lens, lifted) -> list[Hypothesis]:
    moves = [motions(track, points, frames, clip.fps) for track, _, frames, points in lifted]
    falling = [m.fall for m, (t, *_) in zip(moves, lifted, strict=True) if _falls(t)]
    pull = float(np.median(falling)) if falling else 0.0
    unit = 1.0 / lens.focal
    bottoms = [points[:, 2].min() - extent_below(form) * unit for _, form, _, points in lifted]
    bounced = any(len(track.pieces) > 1 for track, *_ in lifted)
    radius = float(np.mean([np.mean(form.size) for _, form, *_ in lifted])) * unit
    lowest = min(bottoms)
    margins = (0.0, 0.3 * radius, 0.7 * radius) if bounced or pull <= 0 else (0.02 + radius,)
    result = []
    for margin in margins:
        floor = lowest - margin
        placed = []
        for (track, form, _, _), motion in zip(lifted, moves, strict=True):
            velocity = motion.ballistic(pull) if pull > 0 else motion.velocity
            position = motion.origin(pull) if pull > 0 else motion.position
            velocity = np.array([velocity[0], 0.0, velocity[2] if pull > 0 else 0.0])
            centre = np.array([position[0], 0.0, position[2] - floor])
            placed.append(Placed(form, 1.0, centre, velocity, _turning(track, lens, clip.fps)))
        for factor, bounce in itertools.product((0.94, 1.0, 1.06), (0.85, 1.0, 1.12)) if bounced else [(1.0, 1.0)]:
            result += _side_variants(clip, lens, placed, moves, floor, pull * factor, bounce * restitution(clip.tracks))
    return result


def _side_variants(
    clip: Clip, lens: Lens, placed: list[Placed], moves: list[Motion], floor: float, pull: float, bounce: float
) -> list[Hypothesis]:
    """With gravity as it is, and with objects of typical size; only the latter where nothing falls."""
    typical = _scale(lens, placed)
    scales = [typical] if pull <= 0 else [GRAVITY / pull, typical]
    if pull > 0 and 0.6 < scales[0] / typical < 1.7:
        scales = scales[:1]
    result = []
    for scale in scales:
        if not 1e-2 < scale < 1e2:
            continue
        strength = pull * scale if pull > 0 else GRAVITY
        objects = placed
        if pull <= 0:
            objects = [_slowed(p, m, scale, GRAVITY, lens, True) for p, m in zip(placed, moves, strict=True)]
        gravity = np.array([0.0, 0.0, -min(strength, 900.0)])
        scene = _scene(clip, lens, objects, np.array([0.0, -1.0, -floor]), gravity, scale, bounce)
        result.append(Hypothesis(scene, ("side", round(math.degrees(lens.pitch)), scene.shapes)))
    return result
