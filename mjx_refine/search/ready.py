"""What goes between a run and a population search that happens elsewhere, and what comes back."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mjx_refine.scene import Shape
from mjx_refine.search.options import Options
from mjx_refine.space import Space
from mjx_refine.view.grid import SampledClip


@dataclasses.dataclass(frozen=True)
class Searched:
    """How the population search ended: why, which backend on which device, in how many seconds."""

    reason: str
    backend: str
    device: str
    seconds: float


@dataclasses.dataclass(frozen=True)
class Ready:
    """What the population search of one clip needs, without its files.

    Attributes:
      shapes, fps: of the scene and the clip.
      samples: the clip as the search compares it.
      options: of the run.
      space, mean, covariance, landed: see ``PopulationSearch``.
      checkpoint: file that the search goes on from and adds to.
    """

    shapes: tuple[Shape, ...]
    fps: float
    samples: SampledClip
    options: Options
    space: Space
    mean: Float[np.ndarray, "dimension"]
    covariance: Float[np.ndarray, "dimension dimension"]
    landed: bool
    checkpoint: Path

    @property
    def kind(self) -> tuple:
        """Clips of one kind can be searched in one batch."""
        return self.shapes, self.fps, self.samples.kind
