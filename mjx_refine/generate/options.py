"""What to generate: the split, the seed, and what a record holds."""

from __future__ import annotations

import dataclasses
import itertools

from mjx_refine.errors import InputError
from mjx_refine.scene import SHAPES, Shape

SIZE = (480, 320)
"""(width, height) of the pictures [px]."""

FRAMES = 30
FPS = 30.0

MOST_OBJECTS = 12
"""In one scene: with more hardly any passes the filters."""

LEAST_PIXELS = 8000
"""Of an object in all frames of a clip together, at 480x320."""

HELD_OUT: tuple[tuple[Shape, ...], ...] = (
    ("sphere", "sphere", "sphere", "box"),
    ("sphere", "sphere", "cylinder", "cylinder"),
    ("sphere", "box", "box", "cylinder"),
    ("box", "cylinder", "cylinder", "cylinder"),
)
"""Combinations of four objects that the training split never has; all their parts of three it does have."""

SPLITS = ("train", "compositional", "five", "six")
"""Training scenes; scenes of the combinations held out; scenes of five and of six objects. The position is part of the
seed, so that new ones go to the end."""

_EXACTLY = {"five": 5, "six": 6}


@dataclasses.dataclass(frozen=True)
class GenerateOptions:
    """Everything that decides on the bytes of record k.

    Attributes:
      seed: of everything random.
      split: one of ``SPLITS``.
      objects: the most objects of a training scene; None: four.
      rgb: also draw pictures with MuJoCo's renderer, and measure flow from them.
      per_shard: records in one shard.

    Raises:
      InputError: a value is out of range.
    """

    seed: int = 0
    split: str = "train"
    objects: int | None = None
    rgb: bool = False
    per_shard: int = 100

    def __post_init__(self):
        if self.split not in SPLITS:
            raise InputError(f"split {self.split!r}; expected one of {', '.join(SPLITS)}")
        if not 0 <= self.seed < 2**32:
            raise InputError(f"seed {self.seed}; expected 0 <= seed < 2^32")
        if self.objects is not None and self.split != "train":
            raise InputError(f"objects {self.objects} with split {self.split}, which fixes their number; leave one out")
        if self.objects is not None and not 1 <= self.objects <= MOST_OBJECTS:
            raise InputError(f"objects {self.objects}; expected 1 <= objects <= {MOST_OBJECTS}")
        if not 1 <= self.per_shard <= 10**6:
            raise InputError(f"{self.per_shard} records a shard; expected 1 to 1000000")

    @property
    def combinations(self) -> tuple[tuple[Shape, ...], ...] | None:
        """The object-type combinations to choose from; None: any with the numbers that ``counts`` allows."""
        return HELD_OUT if self.split == "compositional" else None

    @property
    def counts(self) -> tuple[int, int]:
        """The fewest and the most objects."""
        exactly = _EXACTLY.get(self.split)
        return (exactly, exactly) if exactly else (1, self.objects or 4)


def combinations(count: int) -> list[tuple[Shape, ...]]:
    """All object-type combinations of ``count`` objects, in the order of ``SHAPES``."""
    return list(itertools.combinations_with_replacement(SHAPES, count))
