"""A hypothesis about several clips of one set-up: shared objects, effects and camera, and a start of its own for each.

The joint vector z holds the shared coordinates first, then every clip's own ones. Each clip keeps an ordinary
``Hypothesis``, so that all that works on one clip works on each; ``JointHypothesis.index`` says which coordinates are whose.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_refine.batch import geom_size
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, Term
from mjx_refine.scene import Body, Camera, Scene
from mjx_refine.space import Space
from mjx_refine.space.layout import lowest_extent

SHARED = (
    "size",
    "mass",
    "friction",
    "resistance",
    "gravity",
    "camera_position",
    "camera_pitch",
    "camera_fovy",
)
"""Fields of parameters that a set-up has once; all others are a clip's own."""


@dataclasses.dataclass(frozen=True)
class JointHypothesis:
    """One hypothesis a clip, with the same terms and the same shared parameters.

    Attributes:
      parts: of the clips, in order.
    """

    parts: tuple[Hypothesis, ...]

    @property
    def terms(self) -> tuple[Term, ...]:
        return self.parts[0].terms

    @property
    def space(self) -> Space:
        """The first clip's; of the others only the starts differ."""
        return self.parts[0].space

    @functools.cached_property
    def masks(self) -> tuple[Bool[np.ndarray, "part"], ...]:
        """Which coordinates of each part are shared."""
        return tuple(shared_of(part) for part in self.parts)

    @property
    def count(self) -> int:
        """How many coordinates are shared."""
        return int(self.masks[0].sum())

    @property
    def dimension(self) -> int:
        return self.count + sum(int((~mask).sum()) for mask in self.masks)

    @functools.cached_property
    def index(self) -> tuple[Int[np.ndarray, "part"], ...]:
        """For each part, which joint coordinate each of its own is."""
        result, first = [], self.count
        for mask in self.masks:
            index = np.empty(len(mask), int)
            own = int((~mask).sum())
            index[mask] = np.arange(self.count)
            index[~mask] = first + np.arange(own)
            first += own
            result.append(index)
        return tuple(result)

    def split(self, z: Float[np.ndarray, "*batch dimension"]) -> list[Float[np.ndarray, "*batch part"]]:
        """Each part's coordinates."""
        return [z[..., index] for index in self.index]

    def joined(
        self, parts: list[Float[np.ndarray, "part"]], shared: Float[np.ndarray, "shared"] | None = None
    ) -> Float[np.ndarray, "dimension"]:
        """The joint vector from the parts' own coordinates; shared ones are ``shared``, or the parts' medians."""
        z = np.empty(self.dimension)
        for part, index in zip(parts, self.index, strict=True):
            z[index] = part
        told = [part[mask] for part, mask in zip(parts, self.masks, strict=True)]
        z[: self.count] = np.median(told, 0) if shared is None else shared
        return z

    @functools.cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of z."""
        low, high = np.empty(self.dimension), np.empty(self.dimension)
        for part, index in zip(self.parts, self.index, strict=True):
            low[index], high[index] = part.bounds
        return low, high

    @functools.cached_property
    def ordinary(self) -> Bool[np.ndarray, "dimension"]:
        """Which coordinates are the base model's."""
        return np.isfinite(self.tails)

    @functools.cached_property
    def tails(self) -> Float[np.ndarray, "dimension"]:
        """Each coordinate's tail, see ``Hypothesis.tails``."""
        result = np.empty(self.dimension)
        for part, index in zip(self.parts, self.index, strict=True):
            result[index] = part.tails
        return result

    @functools.cached_property
    def loose(self) -> Bool[np.ndarray, "dimension"]:
        """Which coordinates no prior holds, see ``Hypothesis.loose``."""
        result = np.empty(self.dimension, bool)
        for part, index in zip(self.parts, self.index, strict=True):
            result[index] = part.loose
        return result

    def values(self, z: Float[np.ndarray, "batch dimension"], k: int) -> Float[np.ndarray, "batch parameters"]:
        """The numbers of term ``k``."""
        return self.parts[0].values(z[:, self.index[0]], k)

    def added(self, extra: Term) -> JointHypothesis:
        """The hypothesis with one more effect."""
        return JointHypothesis(tuple(part.added(extra) for part in self.parts))

    def grown(self, z: Float[np.ndarray, "dimension"], last: Float[np.ndarray, "free"]) -> np.ndarray:
        """Coordinates of this hypothesis from those of the one without its last term, and that term's."""
        at = self.count - len(last)
        return np.concatenate([z[:at], last, z[at:]])

    def without_terms(self, z: Float[np.ndarray, "dimension"]) -> Float[np.ndarray, "ordinary"]:
        """The base model's coordinates."""
        return z[self.ordinary]


def shared_of(part: Hypothesis) -> Bool[np.ndarray, "part"]:
    """Which coordinates of one clip's hypothesis belong to the set-up."""
    base = [p.field in SHARED for p in part.space.parameters]
    return np.array(base + [True] * (part.dimension - len(base)), bool)


def with_frozen_setup(part: Hypothesis, z: Float[np.ndarray, "part"]) -> Hypothesis:
    """One clip's hypothesis whose shared parameters and effects stay where ``z`` has them: only its start is free."""
    mask = shared_of(part)
    count = part.space.dimension
    unit = np.clip(part.space.start + z[:count] * part.space.sigma, 0.0, 1.0)
    space = part.space.freeze(mask[:count], unit, "it is the set-up's")
    held = []
    for k, t in enumerate(part.terms):
        held.append(dataclasses.replace(t, centre=part.values(z[None], k)[0], free=np.zeros(len(t.free), bool)))
    return Hypothesis(space, tuple(held))


def common_scenes(scenes: list[Scene]) -> list[Scene]:
    """The scenes with one set-up: medians of what they say of shared things, and each with its own start.

    Where objects stand is theirs; a body that stood on the floor stands on it again, because starts are counted as
    clearance above the floor. Scenes must be of one kind (names, shapes).
    """
    bodies = []
    for several in zip(*(scene.objects for scene in scenes), strict=True):
        shared = {
            name: tuple(np.median([getattr(b, name) for b in several], 0).tolist()) for name in ("size", "friction")
        }
        alone = {
            name: float(np.median([getattr(b, name) for b in several])) for name in ("mass", "damping", "stiffness")
        }
        bodies.append({**shared, **alone})
    cameras = [scene.camera for scene in scenes]
    camera = Camera(
        tuple(np.median([c.position for c in cameras], 0).tolist()),
        float(np.median([c.orientation for c in cameras])),
        float(np.median([c.fovy for c in cameras])),
    )
    gravity = tuple(np.median([scene.gravity for scene in scenes], 0).tolist())
    result = []
    for scene in scenes:
        objects = tuple(_resized(b, changes) for b, changes in zip(scene.objects, bodies, strict=True))
        result.append(dataclasses.replace(scene, objects=objects, camera=camera, gravity=gravity))
    return result


def _resized(body: Body, changes: dict) -> Body:
    """The body with other sizes, as far above the floor as it was."""
    new = dataclasses.replace(body, **changes)
    turn = np.array(body.orientation)
    extents = [float(lowest_extent(b.shape, np.array(geom_size(b)), turn)) for b in (body, new)]
    x, y, z = body.position
    return dataclasses.replace(new, position=(x, y, z + extents[1] - extents[0]))
