"""What a refinement returns."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from mjx_fitness import Scores

from mjx_refine.scene import Problem as SampleProblem
from mjx_refine.scene import Scene
from mjx_refine.search.derivatives import Derivatives
from mjx_refine.search.intervals import Intervals
from mjx_refine.search.options import Options
from mjx_refine.search.progress import Step


@dataclasses.dataclass(frozen=True)
class ParameterRow:
    """One continuous parameter before and after.

    Attributes:
      name: as in ``Space``.
      unit: of both values.
      before: in the sample that was refined.
      after: in the refined scene.
      low, high: ends of the 90 % interval; None where none was made.
      determined: whether the clip, not the start, gives the value.
      note: why not, or empty.
    """

    name: str
    unit: str
    before: float
    after: float
    low: float | None
    high: float | None
    determined: bool
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Replay:
    """A scene simulated by C MuJoCo and drawn at full resolution, with its scores (a batch of one)."""

    scene: Scene
    poses: Float[np.ndarray, "frames objects 7"]
    masks: Int[np.ndarray, "frames height width"]
    flow: Float[np.ndarray, "intervals height width 2"]
    scores: Scores


@dataclasses.dataclass(frozen=True)
class RefineResult:
    """A refined scene and the proof.

    Attributes:
      options: what was asked for.
      init: the best sample as it was given, replayed.
      init_index: its index in the file.
      refined: the refined scene, replayed.
      start_index: index of the sample that the refined scene came from; not always the best one.
      moved: how far overlapping objects of that sample were pushed apart at the start [m].
      matching: for each object its mask's id, or -1.
      parameters: before and after.
      known: intervals, free directions and the noise that was estimated; None if no refits were made.
      fixed: (name, reason) of what no search could tell.
      history: a row a step.
      evaluations: rollouts spent, in units of the whole clip; what a GPU simulated ahead and nobody asked for is not counted.
      reason: why the search ended.
      backend, device: what searched; the scores are always C MuJoCo's.
      seconds: total, compile, search.
      problems: samples that could not be read.
      derivatives: which could be trusted where the landings ended; None where nobody looked.
      digest: of samples, clip and options: the same call has the same.
    """

    options: Options
    init: Replay
    init_index: int
    refined: Replay
    start_index: int
    moved: float
    matching: tuple[int, ...]
    parameters: tuple[ParameterRow, ...]
    known: Intervals | None
    fixed: tuple[tuple[str, str], ...]
    history: tuple[Step, ...]
    evaluations: int
    reason: str
    backend: str
    device: str
    seconds: dict[str, float]
    problems: tuple[SampleProblem, ...] = ()
    derivatives: Derivatives | None = None
    digest: str = ""

    @property
    def scene(self) -> Scene:
        """The refined scene."""
        return self.refined.scene
