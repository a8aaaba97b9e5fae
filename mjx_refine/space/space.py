"""The parameter space of a scene: named physical quantities on one side, the unit box on the other."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from mjx_refine.batch import SceneBatch, batch_from_scenes, scene_from_batch
from mjx_refine.scene import Scene
from mjx_refine.space.effects import effect_parameters, with_numbers
from mjx_refine.space.floor import levelled
from mjx_refine.space.layout import body_parameters, lowest_extent, world_parameters
from mjx_refine.space.origin import Origin
from mjx_refine.space.parameter import Parameter


@dataclasses.dataclass(frozen=True)
class Space:
    """All free parameters around a starting scene.

    Attributes:
      scene: the start; whatever is no parameter stays as it is there. Where an effect tilts the floor, as it would stand
        on a level one.
      parameters: the coordinates of the unit box, in order.
      fixed: (name, reason) of what does not vary.
      held: former parameters and their values, which need not be those of the scene.
    """

    scene: Scene
    parameters: tuple[Parameter, ...]
    fixed: tuple[tuple[str, str], ...] = ()
    held: tuple[tuple[Parameter, float], ...] = ()

    @classmethod
    def around(cls, scene: Scene) -> Space:
        """The space of everything that a clip could tell about ``scene``.

        Fixed from the outset: the mass of a lone object and, of several, that of the first (only ratios act), a sphere's
        orientation and a cylinder's turn about its axis (they cannot be seen), contact stiffness (bounce is damping's).
        """
        scene = levelled(scene)
        batch = batch_from_scenes([scene])
        parameters: list[Parameter] = []
        fixed: list[tuple[str, str]] = []
        for i, body in enumerate(scene.objects):
            extent = lowest_extent(body.shape, batch.size[0, i], batch.quaternion[0, i])
            gap = max(float(batch.position[0, i, 2] - extent), 0.0)
            parameters += body_parameters(i, body, gap, lone=i == 0)
            fixed += _fixed_of_body(body.name, body.shape, i, len(scene.objects))
        parameters += world_parameters(scene)
        acting, still = effect_parameters(scene)
        parameters, fixed = parameters + acting, fixed + still
        return cls(scene, tuple(parameters), tuple(fixed))

    @property
    def dimension(self) -> int:
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @property
    def start(self) -> Float[np.ndarray, "dimension"]:
        """The starting scene in the unit box."""
        return np.array([p.to_unit(p.start) for p in self.parameters])

    @property
    def sigma(self) -> Float[np.ndarray, "dimension"]:
        """Prior standard deviations in the unit box."""
        return np.array([p.sigma for p in self.parameters])

    def freeze(self, held: Bool[np.ndarray, "dimension"], at: Float[np.ndarray, "dimension"], reason: str) -> Space:
        """The space without the ``held`` coordinates, which keep their values ``at``; the others mean what they meant.

        Raises:
          ValueError: ``held`` or ``at`` has the wrong shape, or ``at`` lies outside of the box.
        """
        if held.shape != (self.dimension,):
            raise ValueError(f"held has shape {held.shape}; expected ({self.dimension},)")
        values = self.values(at)
        rows = list(zip(self.parameters, values.tolist(), held, strict=True))
        return dataclasses.replace(
            self,
            parameters=tuple(p for p, _, h in rows if not h),
            fixed=(*self.fixed, *((p.name, reason) for p, _, h in rows if h)),
            held=(*self.held, *((p, value) for p, value, h in rows if h)),
        )

    def values(self, u: Float[np.ndarray, "dimension"]) -> Float[np.ndarray, "dimension"]:
        """Physical values at one point of the unit box."""
        u = self.checked(np.asarray(u, np.float64)[None])[0]
        return np.array([p.from_unit(v) for p, v in zip(self.parameters, u, strict=True)])

    def scene_at(self, u: Float[np.ndarray, "dimension"]) -> Scene:
        """The scene at one point of the unit box."""
        batch = self.decode(np.asarray(u)[None])
        return with_numbers(scene_from_batch(batch, 0, self.scene), batch.effects)

    def checked(self, u: Float[np.ndarray, "batch dimension"]) -> Float[np.ndarray, "batch dimension"]:
        """Points of the unit box, rounding errors at its sides cut off.

        Raises:
          ValueError: wrong shape, not finite, or outside of the box.
        """
        if u.ndim != 2 or u.shape[1] != self.dimension:
            raise ValueError(f"points have shape {u.shape}; expected (batch, {self.dimension})")
        if not np.isfinite(u).all() or u.min(initial=0.0) < -1e-9 or u.max(initial=1.0) > 1 + 1e-9:
            raise ValueError(f"points lie in [{u.min()}, {u.max()}]; expected finite numbers in the unit box")
        return np.clip(u, 0.0, 1.0)

    def decode(self, u: Float[np.ndarray, "batch dimension"]) -> SceneBatch:
        """The candidates at points of the unit box.

        Raises:
          ValueError: wrong shape, not finite, or outside of the box.
        """
        return decode_together([self], [u])

    def _from_unit(self, u: Float[np.ndarray, "batch dimension"]) -> Float[np.ndarray, "batch dimension"]:
        """Every parameter's ``from_unit``, all at once."""
        low, span, offset, least, most = self._scales
        values = low + u * span
        logarithmic = np.isfinite(offset)
        values[:, logarithmic] = np.exp(values[:, logarithmic]) - offset[logarithmic]
        return np.clip(values, least, most)

    @functools.cached_property
    def _scales(self) -> Float[np.ndarray, "5 dimension"]:
        """Low end and span on the transformed scale, offset (NaN where linear), bounds."""
        offsets = [np.nan if p.offset is None else p.offset for p in self.parameters]
        rows = [(p.transformed_low, p.span, o, p.low, p.high) for p, o in zip(self.parameters, offsets, strict=True)]
        return np.array(rows, np.float64).reshape(-1, 5).T

    @functools.cached_property
    def _origin(self) -> Origin:
        """The scene as a batch of one, what is held in place."""
        origin = Origin.of(self.scene)
        for parameter, value in self.held:
            parameter.put(origin.raw, slice(None), value)
        return origin


def decode_together(spaces: Sequence[Space], points: Sequence[Float[np.ndarray, "_ dimension"]]) -> SceneBatch:
    """The candidates at points of several unit boxes, one space after the other: one pass over all of them.

    Args:
      spaces: of scenes with the same shapes and effects.
      points: of each, as ``Space.decode`` takes them.

    Raises:
      ValueError: wrong shape, not finite, or outside of the box; or the scenes' kinds differ.
    """
    checked = [space.checked(np.asarray(u, np.float64)) for space, u in zip(spaces, points, strict=True)]
    counts = [len(u) for u in checked]
    origin = Origin.rows([space._origin for space in spaces], np.repeat(np.arange(len(spaces)), counts))
    last = np.cumsum(counts)
    for space, u, end in zip(spaces, checked, last, strict=True):
        rows = slice(end - len(u), end)
        for parameter, values in zip(space.parameters, space._from_unit(u).T, strict=True):
            parameter.put(origin.raw, rows, values)
    return origin.assembled()


def _fixed_of_body(name: str, shape: str, i: int, count: int) -> list[tuple[str, str]]:
    fixed = [(f"{name}.stiffness", "bounce is fitted by damping")]
    if i == 0:
        reason = "nothing else in the scene to compare it with" if count == 1 else "only ratios of masses act"
        fixed.append((f"{name}.mass", reason))
    if shape == "sphere":
        fixed.append((f"{name}.orientation", "a sphere's outline does not show it"))
    if shape == "cylinder":
        fixed.append((f"{name}.turn", "a cylinder's outline does not show its turn about the axis"))
    return fixed
