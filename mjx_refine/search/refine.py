"""``refine``: samples and a clip in, a scene that replays the clip out."""

from __future__ import annotations

import time
from pathlib import Path

import jax
import numpy as np

from mjx_refine.compile_cache import enable_cache
from mjx_refine.effects import batch_with_effects
from mjx_refine.errors import InputError
from mjx_refine.files import remove_stale_parts
from mjx_refine.linear_algebra import one_thread
from mjx_refine.observation import Observation
from mjx_refine.scene import Samples, Scene
from mjx_refine.search.intervals import Intervals
from mjx_refine.search.options import Options
from mjx_refine.search.problem import Problem
from mjx_refine.search.progress import Progress
from mjx_refine.search.result import ParameterRow, RefineResult, Replay
from mjx_refine.search.run import Found, Run
from mjx_refine.sim.devices import on_host
from mjx_refine.space import Space
from mjx_refine.view.effects import draw_effects, needs_pictures

CHECKPOINT = "checkpoint.npz"
UNDETERMINED = "one prior width changes the fitness by less than 0.002; kept at its start"

UNASKED = "no refits were made, which would tell"
_COMPILE = {"seconds": 0.0}


def _count_compilation(event: str, duration_secs: float, **_: str | int) -> None:
    if event.endswith("backend_compile_duration"):
        _COMPILE["seconds"] += duration_secs


jax.monitoring.register_event_duration_secs_listener(_count_compilation)


def refine(
    samples: Samples | Scene | list[Scene],
    observation: Observation,
    options: Options | None = None,
    *,
    progress: Progress | None = None,
    folder: str | Path | None = None,
    resume: bool = False,
    problem: Problem | None = None,
) -> RefineResult:
    """Refines the best of the samples until its simulation replays the clip.

    Args:
      samples: what ``load_scenes`` returned, or scenes.
      observation: what ``load_observation`` returned.
      options: budget, seed, backend, weights.
      progress: a display; silent by default.
      folder: where to keep a checkpoint; None keeps nothing.
      resume: go on from the checkpoint in ``folder``.
      problem: of the same samples, observation and options, where it was made before.

    Returns:
      the refined scene, its replay, scores before and after, parameters and history. Never worse than the best sample.

    Raises:
      InputError: the samples or the observation cannot be used, or the backend cannot run here.

    Source: CMA-ES on IoU - EPE from the best of 32 samples: Δynamics (CVPR 2026).
    """
    options = options or Options()
    if not isinstance(observation, Observation):
        told = type(observation).__name__
        raise InputError(f"observation: is a {told}; expected an Observation; read one with load_observation(path)")
    began, compiled = time.monotonic(), _COMPILE["seconds"]
    samples = _as_samples(samples)
    enable_cache()
    with on_host(), one_thread():
        problem = problem or Problem(samples, observation, options)
        checkpoint = None if folder is None else _made(Path(folder)) / CHECKPOINT
        run = Run(problem, progress or Progress(), checkpoint, resume)
        found = run()
        first = problem.starts[0]
        refined = replay(found.scene, observation, problem, found.start.matching)
        init = replay(first.given, observation, problem, first.matching)
    total = run.before + time.monotonic() - began
    return RefineResult(
        options=options,
        init=init,
        init_index=first.index,
        refined=refined,
        start_index=found.start.index,
        moved=found.start.moved,
        matching=found.start.matching,
        parameters=_rows(found),
        known=found.known,
        fixed=found.space.fixed,
        history=found.history,
        evaluations=found.evaluations,
        reason=found.reason,
        backend=found.backend,
        device=found.device,
        seconds={
            "total": round(total, 3),
            "compile": round(_COMPILE["seconds"] - compiled, 3),
            "search": round(found.searched, 3),
        },
        problems=samples.problems,
        derivatives=found.derivatives,
        digest=run.digest,
    )


def _made(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        remove_stale_parts(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); expected a folder to write in") from error
    return folder


def _as_samples(samples: Samples | Scene | list[Scene]) -> Samples:
    if isinstance(samples, Samples):
        return samples
    scenes = (samples,) if isinstance(samples, Scene) else tuple(samples)
    if not scenes:
        raise InputError("samples: an empty list; expected at least one scene")
    return Samples("<scenes>", scenes, tuple(range(len(scenes))))


def replay(scene: Scene, observation: Observation, problem: Problem, matching: tuple[int, ...]) -> Replay:
    """Simulates a scene in C MuJoCo, draws and scores it at full resolution."""
    batch = batch_with_effects([scene])
    poses = problem.reference(batch.shapes).rollout(batch, observation.length)
    masks, flow = draw_effects(np.nan_to_num(poses[0], nan=-1e3), batch, observation.size, observation.fps)
    scorer = problem.scorer(batch.shapes, matching, pictures=needs_pictures(batch))
    return Replay(scene, poses[0], masks, flow, scorer(poses, batch))


def _rows(found: Found) -> tuple[ParameterRow, ...]:
    before, after = Space.around(found.start.scene), found.space
    given = {p.name: p.start for p in before.parameters}
    values = dict(zip(after.names, found.values, strict=True))
    rows = []
    for j, p in enumerate(after.parameters):
        value, low, high = float(values[p.name]), None, None
        note = UNDETERMINED if p.name in found.undetermined else ""
        if found.known is not None:
            # The refits' interval, widened where the scene that scores best lies outside of it.
            low = min(float(p.from_unit(found.known.low[j])), value)
            high = max(float(p.from_unit(found.known.high[j])), value)
            note = note or _doubt(found.known, j)
        note = note or ("" if found.known is not None else UNASKED)
        rows.append(ParameterRow(p.name, p.unit, given[p.name], value, low, high, not note, note))
    return tuple(rows)


def _doubt(known: Intervals, j: int) -> str:
    """Why refits do not agree on parameter ``j``, or empty."""
    if known.on_bound[j]:
        return "on the edge of what is searched"
    if known.standard_error[j] > 0.95:
        return "the clip says nothing about it"
    if not known.determined[j]:
        return f"the clip narrows its prior to {known.standard_error[j]:.0%} only"
    return ""
