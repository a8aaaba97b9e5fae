"""A folder of predictions against a folder of truths: Best@1 and Best@K of every clip, and their means."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from mjx_refine.errors import InputError
from mjx_refine.evaluate.samples import METRICS, Judged, best_of, judge_samples
from mjx_refine.observation import Observation, load_observation
from mjx_refine.scene import Problem, Samples, Scene, load_scene, load_scenes
from mjx_refine.simulate import simulate

_HEADS = (
    "objects",
    "IoU",
    "first",
    "EPE px",
    "first",
    "position m",
    "velocity m/s",
    "damping 1/s",
    "sliding",
    "rolling m",
)


@dataclasses.dataclass(frozen=True)
class Row:
    """The best of a clip's first ``best_at`` samples."""

    clip: str
    best_at: int
    samples: int
    judged: Judged


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """The best samples of every clip, for every K.

    Attributes:
      rows: by K, then by clip.
      unread: (clip, why) of samples that could not be read.
    """

    rows: tuple[Row, ...]
    unread: tuple[tuple[str, str], ...]

    def means(self) -> dict[int, dict[str, float]]:
        """For every K the mean of each metric over the clips where it is a number; NaN where there are none."""
        found: dict[int, dict[str, float]] = {}
        for count in dict.fromkeys(row.best_at for row in self.rows):
            judged = [row.judged for row in self.rows if row.best_at == count]
            found[count] = {name: _mean([getattr(one, name) for one in judged]) for name in METRICS}
        return found

    def table(self) -> str:
        """The means as lines of text."""
        lines = [f"{'':8}" + "".join(f"{head:>13}" for head in _HEADS)]
        for count, means in self.means().items():
            lines.append(f"Best@{count:<3}" + "".join(f"{_text(means[name], 3):>13}" for name in METRICS))
        return "\n".join(lines) + "\n"

    def csv(self) -> str:
        """Every clip's row, then the means as clip ``mean``; empty where there is no number."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["clip", "best_at", "samples", "index", *METRICS])
        for row in self.rows:
            values = [_text(getattr(row.judged, name), 6, "") for name in METRICS]
            writer.writerow([row.clip, row.best_at, row.samples, row.judged.index, *values])
        for count, means in self.means().items():
            writer.writerow(["mean", count, "", "", *(_text(means[name], 6, "") for name in METRICS)])
        return stream.getvalue()


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return float(np.mean(known)) if known else math.nan


def _text(value: float, digits: int, none: str = "-") -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else none


def evaluate_folder(
    predictions: Path,
    truths: Path,
    best: Sequence[int] = (1, 32),
    size: tuple[int, int] = (480, 320),
    frames: int = 30,
    fps: float = 30.0,
    progress: Callable[[str], None] = lambda clip: None,
) -> Evaluation:
    """Judges the samples in ``predictions/NAME.yaml`` (or ``.yml``, ``.txt``) by ``truths/NAME.yaml``.

    Their clip is ``truths/NAME.npz`` where that is, else the simulation of the truth.

    Args:
      predictions: a folder with a file of samples for every truth, the model's first answer first.
      truths: a folder of scenes, with or without their clips.
      best: of how many of the first samples the best is taken, each K at least 1.
      size: (width, height) of simulated clips [px].
      frames: of simulated clips.
      fps: of simulated clips.
      progress: told every clip's name.

    Raises:
      InputError: a folder or file is missing, a truth is wrong, or an effect of a sample is.
    """
    pairs = _files(predictions, truths)
    judged: dict[str, list[Judged]] = {}
    unread: list[tuple[str, str]] = []
    for name, (told, true) in pairs.items():
        progress(name)
        truth = load_scene(true)
        samples = _samples(told)
        unread += [(name, problem.reason) for problem in samples.problems]
        if not samples.scenes:
            judged[name] = [Judged(problem.index) for problem in samples.problems]
            continue
        judged[name] = judge_samples(samples, truth, _clip(true, truth, size, frames, fps))
    rows = [Row(name, count, len(all_), best_of(all_, count)) for count in best for name, all_ in judged.items()]
    return Evaluation(tuple(rows), tuple(unread))


def _files(predictions: Path, truths: Path) -> dict[str, tuple[Path, Path]]:
    """By name, the file of samples and that of the truth."""
    for folder in (predictions, truths):
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder; expected one with a scene file for every clip; name another")
    told = {p.stem: p for p in sorted(predictions.iterdir()) if p.suffix in (".yaml", ".yml", ".txt")}
    true = {p.stem: p for p in sorted(truths.iterdir()) if p.suffix in (".yaml", ".yml")}
    if not true:
        raise InputError(f"{truths}: no .yaml file in it; expected a true scene for every clip; name another folder")
    for name in true.keys() ^ told.keys():
        lacking, there = (predictions, true[name]) if name in true else (truths, told[name])
        raise InputError(
            f"{lacking}: there is no {name}.yaml, as for {there}; expected one for each clip; add it or remove that"
        )
    return {name: (told[name], true[name]) for name in true}


def _samples(path: Path) -> Samples:
    """The samples of a file; one in which none can be read is one wrong answer, not a wrong call."""
    try:
        return load_scenes(path)
    except InputError as error:
        return Samples(str(path), (), (), (Problem(0, str(error)),))


def _clip(path: Path, truth: Scene, size: tuple[int, int], frames: int, fps: float) -> Observation:
    filmed = path.with_suffix(".npz")
    if filmed.exists():
        return load_observation(filmed)
    try:
        return simulate(truth, size, frames, fps)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
