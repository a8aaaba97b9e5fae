"""What an effect is: named parameters, where it acts, and how; one subclass a file.

An effect acts in one or more places, each a method that a kind may override. All work on whole batches in plain numpy:
``values`` is (batch, parameters) in the order of ``parameters_of``, and what they return is broadcast over the batch.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float

from mjx_refine import rotations
from mjx_refine.batch import SceneBatch
from mjx_refine.errors import InputError
from mjx_refine.scene import Shape

Channel = Literal["motion", "rotation", "shape", "camera", "timing", "perception"]


@dataclasses.dataclass(frozen=True)
class Start:
    """A point from which an effect's fit may begin.

    Attributes:
      values: the parameters there.
      columns: (index, step) of the parameters that a linear look ahead varies; none: the values themselves are the change.
      width: prior standard deviations where they are not the kind's.
      fixed: indices of parameters that stay as they are.
      places: how many such starts share the effect's prior probability.
      pivot: an outline (points, 2) [m] along which fits turn what is turned (``EffectKind.from_pivot``), or None.
    """

    values: np.ndarray
    columns: tuple[tuple[int, float], ...] = ()
    width: np.ndarray | None = None
    fixed: tuple[int, ...] = ()
    places: int = 1
    pivot: np.ndarray | None = None


@dataclasses.dataclass(frozen=True)
class FitView:
    """What the base model's fit tells those who look for a start.

    Attributes:
      batch: the fitted scene, one row.
      poses: in every frame.
      velocity: of the centres [m/s].
      spin: world frame [rad/s].
      on_floor: whether the body touches the floor.
      background: measured flow beside the objects [px/frame].
      hidden: rectangles (left, top, right, bottom) [px] where objects should be seen and never are.
      image: (width, height) [px].
      fps: frames a second.
    """

    batch: SceneBatch
    poses: Float[np.ndarray, "frames objects 7"]
    velocity: Float[np.ndarray, "frames objects 3"]
    spin: Float[np.ndarray, "frames objects 3"]
    on_floor: np.ndarray
    background: Float[np.ndarray, "intervals places 2"]
    hidden: tuple[tuple[float, float, float, float], ...]
    image: tuple[int, int]
    fps: float

    @property
    def frames(self) -> int:
        return len(self.poses)

    def mass(self, target: int) -> float:
        """Of the target, or the mean over the objects [kg]."""
        return float(self.batch.mass[0, target] if target >= 0 else self.batch.mass[0].mean())


@dataclasses.dataclass(frozen=True)
class EffectParameter:
    """One number of an effect, or one list of numbers.

    Attributes:
      name: as the scene file has it.
      unit: of its value.
      width: prior standard deviation around ``centre``.
      low: lower bound.
      high: upper bound.
      centre: value at which the effect does nothing, or the middle of the prior.
      default: used where a scene file leaves it out; None: it must be given.
      length: 0 for one number; for a list the number of entries, -1: one a frame.
      whole: whether only whole numbers mean something.
    """

    name: str
    unit: str
    width: float
    low: float = -np.inf
    high: float = np.inf
    centre: float = 0.0
    default: float | None = 0.0
    length: int = 0
    whole: bool = False


@dataclasses.dataclass(frozen=True)
class Motion:
    """The moving bodies of a batch at one instant, world frame.

    Attributes:
      time: since the first frame [s].
      step: how long the loads act [s].
      position: centres [m].
      quaternion: w x y z, body to world.
      velocity: of the centres [m/s].
      turning: angular velocity in the bodies' own axes [rad/s].
      batch: sizes, masses, friction.
      lasting: what effects have worked out and will ask for again at any instant of the rollout.
      known: the same at this instant.
    """

    time: float
    step: float
    position: Float[np.ndarray, "batch objects 3"]
    quaternion: Float[np.ndarray, "batch objects 4"]
    velocity: Float[np.ndarray, "batch objects 3"]
    turning: Float[np.ndarray, "batch objects 3"]
    batch: SceneBatch
    lasting: dict[Hashable, Any] = dataclasses.field(default_factory=dict, repr=False, compare=False)
    known: dict[Hashable, Any] = dataclasses.field(default_factory=dict, repr=False, compare=False)

    @property
    def axes(self) -> Float[np.ndarray, "batch objects 3 3"]:
        """Body to world."""
        if "axes" not in self.known:
            self.known["axes"] = rotations.matrix(self.quaternion)
        return self.known["axes"]

    @property
    def spin(self) -> Float[np.ndarray, "batch objects 3"]:
        """Angular velocity [rad/s]."""
        if "spin" not in self.known:
            self.known["spin"] = rotations.turned(self.axes, self.turning)
        return self.known["spin"]

    def spin_of(self, target: int) -> Float[np.ndarray, "batch 3"]:
        """Angular velocity of one body [rad/s]."""
        return rotations.rotate(self.quaternion[:, target], self.turning[:, target])


Loads = tuple[Float[np.ndarray, "batch objects 3"], Float[np.ndarray, "batch objects 3"]]
"""Forces [N] and torques [N m] about the bodies' centres, world frame."""


@dataclasses.dataclass(frozen=True)
class OutlineView:
    """The silhouettes of a batch as the base model has them, for effects that change what is seen of them.

    Attributes:
      reach: support functions in D directions of the image [px].
      contact: where the outline touches the tangent in each direction, (x, y) [px].
      rate: change of ``reach`` [px/frame].
      normals: the directions.
      facing: unit normal of the tangent plane through the camera, in the body's frame.
      scale: pixels that one metre along that normal moves the tangent [px/m].
      focal: focal length [px].
      image: (width, height) [px].
      fps: frames a second.
      shapes: of the objects.
      size: MuJoCo's ``geom_size`` [m].
    """

    reach: Float[np.ndarray, "batch frames objects directions"]
    contact: Float[np.ndarray, "batch frames objects directions 2"]
    rate: Float[np.ndarray, "batch frames objects directions"]
    normals: Float[np.ndarray, "directions 2"]
    facing: Float[np.ndarray, "batch frames objects directions 3"]
    scale: Float[np.ndarray, "batch frames objects directions"]
    focal: Float[np.ndarray, "batch"]
    image: tuple[int, int]
    fps: float
    shapes: tuple[Shape, ...]
    size: Float[np.ndarray, "batch objects 3"]


class EffectKind:
    """A kind of effect; stateless.

    Attributes:
      name: in scene files.
      sentence: what it is, for reports; ``{target}`` stands for the object's name.
      experiment: what to film to tell it from others.
      targeted: whether it acts on one object.
      channel: what of the pictures it changes.
      physical: whether it acts in the rollout (otherwise in how the rollout is seen).
      couples: whether what it does to one object depends on how another moves.
      strikes: whether it acts as impacts with something unseen, whose impulse nobody knows well.
      drawn: whether it changes outlines (``outline``) or the picture (``warp``).
      imitated: whether ordinary parameters can imitate much of it, so that its fit begins with much of it as well.
      steady: whether it acts all along, so that a clip's first frames already show it.
      parameters: its numbers.
    """

    name: ClassVar[str]
    sentence: ClassVar[str]
    experiment: ClassVar[str] = "Film the same motion again with more frames."
    targeted: ClassVar[bool] = False
    channel: ClassVar[Channel] = "motion"
    physical: ClassVar[bool] = False
    couples: ClassVar[bool] = False
    strikes: ClassVar[bool] = False
    drawn: ClassVar[bool] = False
    imitated: ClassVar[bool] = False
    steady: ClassVar[bool] = False
    parameters: ClassVar[tuple[EffectParameter, ...]]

    # --- in the rollout -------------------------------------------------------------------------------------------
    def loads(self, motion: Motion, target: int, values: np.ndarray) -> Loads | None:
        """Forces and torques at one instant."""
        return None

    def floor_friction(self, motion: Motion, target: int, values: np.ndarray) -> np.ndarray | None:
        """Sliding friction of every object with the floor, (batch, objects); NaN where it stays as it is."""
        return None

    def idle(self, motion: Motion, target: int, values: np.ndarray) -> float:
        """For how long loads and floor friction stay as they are at this instant, surely [s]; 0: nobody knows."""
        return 0.0

    def centre_of_mass(self, batch: SceneBatch, target: int, values: np.ndarray) -> np.ndarray | None:
        """Centres of mass in the bodies' frames [m], (batch, objects, 3)."""
        return None

    def floor(self, values: np.ndarray) -> np.ndarray | None:
        """The floor's rotation, floor to world, (batch, 3, 3)."""
        return None

    # --- in how it is seen ----------------------------------------------------------------------------------------
    def frame_times(self, frames: int, values: np.ndarray) -> np.ndarray | None:
        """Which simulated frame is shown as frame 0, 1, ..., (batch, frames), whole numbers."""
        return None

    @property
    def retimes(self) -> bool:
        """Whether it changes which simulated frame is shown when."""
        return type(self).frame_times is not EffectKind.frame_times

    def camera(self, frames: int, fps: float, values: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """The camera's turn in its own axes (right, up, back), (batch, frames, 3, 3), and its travel [m]."""
        return None

    def directions(self, values: np.ndarray) -> int:
        """In how many directions what it does to outlines must be told; 0: few do."""
        return 0

    def outline(self, view: OutlineView, target: int, values: np.ndarray) -> np.ndarray | None:
        """What is added to the support functions [px], broadcast to (batch, frames, objects, directions)."""
        told = self.moved(view, target, values)
        return None if told is None else (told * view.normals).sum(-1)

    def moved(self, view: OutlineView, target: int, values: np.ndarray) -> np.ndarray | None:
        """How far points of outlines go (batch, frames, objects, directions, 2) [px], from which ``outline`` follows; None where
        it widens outlines instead."""
        return None

    def hidden(self, outline: np.ndarray, values: np.ndarray) -> np.ndarray | None:
        """The part of convex polygons (batch, frames, objects, corners, 2) [px] that is not seen, as polygons, or None."""
        return None

    def overdrawn(self, values: np.ndarray) -> np.ndarray | None:
        """How far masks show what lies beside the objects, (batch,) [px], or None."""
        return None

    def warp(self, points: np.ndarray, focal: np.ndarray, image: tuple[int, int], values: np.ndarray):
        """How far points of the undistorted picture (batch, ..., 2) [px] are moved [px], or None."""
        return None

    # --- fitting --------------------------------------------------------------------------------------------------
    def starts(self, view: FitView, target: int) -> list[Start]:
        """Where to begin; by default where the effect does nothing, looking ahead along every parameter."""
        return [self.still(view, target)]

    def window(self, view: FitView, target: int, values: np.ndarray) -> tuple[int, int] | None:
        """First and last frame in which it acts; None: wherever the target moves."""
        return None

    def struck(self, view: FitView, values: np.ndarray) -> int:
        """Index of the object that an effect without a target acts on most, or -1."""
        return 0 if len(view.batch.shapes) == 1 and self.channel not in ("camera", "timing") else -1

    def widths(self, view: FitView, target: int) -> np.ndarray:
        """Prior standard deviations for this scene."""
        return np.array([p.width for p in self.spread(view.frames)])

    def to_pivot(self, values: np.ndarray, pivot: np.ndarray) -> np.ndarray:
        """Coordinates, as many as ``values`` (batch, parameters), in which fits along an outline are straight."""
        return values

    def from_pivot(self, coordinates: np.ndarray, pivot: np.ndarray) -> np.ndarray:
        """The inverse of ``to_pivot``."""
        return coordinates

    def still(self, view: FitView, target: int) -> Start:
        """The start at which the effect does nothing."""
        width = self.widths(view, target)
        centre = np.array([p.centre for p in self.spread(view.frames)])
        return Start(centre, tuple((k, 0.3 * float(w)) for k, w in enumerate(width)), width)

    def length(self, frames: int) -> int:
        """How many numbers ``values`` holds for a clip of ``frames`` frames."""
        return sum(1 if p.length == 0 else (frames if p.length < 0 else p.length) for p in self.parameters)

    def spread(self, frames: int) -> tuple[EffectParameter, ...]:
        """One entry for each number in ``values``."""
        return tuple(
            p for p in self.parameters for _ in range(1 if p.length == 0 else (frames if p.length < 0 else p.length))
        )

    def pack(self, given: Mapping[str, float | str | Sequence[float]], frames: int, place: str) -> np.ndarray:
        """``values`` (parameters,) from the mapping that a scene holds.

        Raises:
          InputError: an unknown or missing name, or a value out of bounds; ``place`` is named.
        """
        names = [p.name for p in self.parameters]
        for name in given:
            if name not in names:
                raise InputError(
                    f"{place}: unknown parameter {name!r}; expected {', '.join(names)}; remove or rename it"
                )
        rows: list[np.ndarray] = []
        for p in self.parameters:
            value = given.get(p.name, p.default)
            if value is None:
                raise InputError(f"{place}.{p.name} is missing; it has no safe default; add it ({p.unit})")
            rows.append(_checked(p, value, frames, f"{place}.{p.name}"))
        return np.concatenate(rows) if rows else np.zeros(0)

    def unpack(self, values: np.ndarray, frames: int) -> dict[str, float | tuple[float, ...]]:
        """The mapping of a scene from ``values`` (parameters,)."""
        result: dict[str, float | tuple[float, ...]] = {}
        start = 0
        for p in self.parameters:
            if p.length == 0:
                number = float(values[start])
                result[p.name] = float(round(number)) if p.whole else number
                start += 1
            else:
                count = frames if p.length < 0 else p.length
                result[p.name] = tuple(float(v) for v in values[start : start + count])
                start += count
        return result


def _checked(p: EffectParameter, value: float | str | Sequence[float], frames: int, place: str) -> np.ndarray:
    low, high = (f"{v:g}" for v in (p.low, p.high))
    if p.length == 0:
        if isinstance(value, str) or isinstance(value, Sequence):
            raise InputError(f"{place} = {value!r}; expected one number [{p.unit}]; correct it")
        row = np.array([float(value)])
    else:
        if isinstance(value, int | float) and float(value) == 0.0:
            value = ()
        if isinstance(value, str) or not isinstance(value, Sequence):
            raise InputError(f"{place} = {value!r}; expected a list of numbers [{p.unit}]; correct it")
        count = frames if p.length < 0 else p.length
        if p.length > 0 and len(value) not in (0, count):
            raise InputError(f"{place}: {len(value)} numbers; expected {count}; correct it")
        # A series may be shorter or longer than the clip that is made from it: its last number goes on.
        row = np.array([float(v) for v in value] or [0.0])
        row = row[:count] if len(row) >= count else np.concatenate([row, np.repeat(row[-1:], count - len(row))])
    if not np.isfinite(row).all() or (row < p.low).any() or (row > p.high).any():
        raise InputError(f"{place} = {value!r}; expected {low} <= value <= {high} [{p.unit}]; correct it")
    if p.whole and (row != np.round(row)).any():
        raise InputError(f"{place} = {value!r}; expected a whole number; correct it")
    return row


def of_target(batch: SceneBatch, target: int, vector: np.ndarray) -> np.ndarray:
    """(batch, objects, 3) that is ``vector`` (batch, 3) for the target and zero for the others."""
    result = np.zeros((*batch.mass.shape, 3))
    result[:, target] = vector
    return result
