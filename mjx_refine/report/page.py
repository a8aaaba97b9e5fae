"""``report.html``: one page that holds all it shows."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jinja2
import numpy as np
from markupsafe import Markup
from mjx_fitness import UNMATCHED

from mjx_refine.observation import Observation
from mjx_refine.report import encode, plots, tables
from mjx_refine.report.animation import overlay_gif
from mjx_refine.report.contours import Overlay, fitted
from mjx_refine.report.doubts import warnings
from mjx_refine.report.flow_picture import error_picture, flow_picture, heat_bar, largest_flow, wheel
from mjx_refine.search.result import RefineResult

FRAMES, INTERVALS = 6, 3
_FRAME_SIDE, _FLOW_SIDE = 640, 480  # px
_MOST_ANIMATION = 2_500_000  # bytes


def report_page(result: RefineResult, observation: Observation, animation: bytes | None = None) -> str:
    """The page as HTML text; it loads nothing and runs nothing.

    Args:
      result: what ``refine`` returned.
      observation: the clip that it was refined against.
      animation: ``overlay_gif`` of the two, if it is at hand.
    """
    here = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(
        loader=here, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["number"] = tables.number
    environment.filters["fixed"] = tables.fixed
    before, after = result.init.scores, result.refined.scores
    return environment.get_template("template.html").render(
        result=result,
        clip=observation,
        source=Path(observation.source).name,
        sentence=sentence(result),
        warnings=warnings(result, observation),
        notes=notes(result, observation),
        scores=_tiles(result),
        animation=encode.data_uri("image/gif", _small_enough(result, observation, animation)),
        objects=tables.object_rows(result, observation),
        frames=_frames(result, observation),
        flows=_flows(result, observation),
        largest=largest_flow(observation),
        wheel=encode.png(wheel(64)),
        heat=encode.png(heat_bar(128, 10)),
        plots=[
            ("IoU over time", Markup(plots.iou_plot(before.frame_iou[0], after.frame_iou[0], observation.fps))),
            (
                "End-point error over time",
                Markup(plots.epe_plot(before.frame_epe[0], after.frame_epe[0], observation.fps)),
            ),
            (
                "Convergence, at the search's resolution",
                Markup(plots.convergence_plot(result.history, float(before.fitness[0]))),
            ),
        ],
        groups=tables.parameter_groups(result),
        meanings=tables.meanings(result),
        free=result.known.free[:5] if result.known is not None else (),
        loose=[row for row in result.parameters if not row.determined],
        options=_options(result),
        trust=trust(result),
    )


def sentence(result: RefineResult) -> str:
    """What happened, in one sentence."""
    before, after = result.init.scores, result.refined.scores
    a, b = float(before.iou[0]), float(after.iou[0])
    e, f = float(before.epe[0]), float(after.epe[0])
    time = f"in {duration(result.seconds.get('total', 0.0))} on {result.backend} ({result.device})"
    if not float(after.fitness[0]) > float(before.fitness[0]):
        return f"No scene better than sample {result.init_index} was found (IoU {a:.3f}, end-point error {e:.3f} px), {time}."
    change = "rose" if b > a else "went"
    moved = "fell" if f < e else "went"
    return (
        f"The overlap with the clip (IoU) {change} from {a:.3f} to {b:.3f} and the flow's end-point error {moved} from "
        f"{e:.3f} px to {f:.3f} px, starting from sample {result.start_index}, {time}."
    )


def trust(result: RefineResult) -> str:
    """Which derivatives could be trusted, in one sentence; empty where nobody looked."""
    told = result.derivatives
    if told is None:
        return ""
    kind = {"autodiff": "Automatic derivatives", "differences": "Differences of rollouts"}.get(told.method)
    if kind is None:
        return f"No derivative of this clip's simulation can be trusted where least squares ended: {told.reason}."
    return f"{kind} of this clip's simulation can be trusted where least squares ended: {told.reason}."


def notes(result: RefineResult, observation: Observation) -> list[str]:
    """What a reader should know."""
    found = []
    if result.start_index != result.init_index:
        found.append(
            f"The refined scene came from sample {result.start_index}; “before” in scores and pictures is the best sample "
            f"as given, {result.init_index}; in the table of parameters it is sample {result.start_index}."
        )
    if result.moved > 0:
        found.append(
            f"Objects of sample {result.start_index} overlapped at the start and were moved apart, the farthest by "
            f"{result.moved:.3g} m."
        )
    if result.problems:
        listed = "; ".join(f"{problem.index}: {problem.reason}" for problem in result.problems)
        found.append(f"{len(result.problems)} of the samples could not be read ({listed}).")
    if observation.masks is None:
        found.append("The clip has no masks: the moving region of the flow stands for them.")
    return found


def duration(seconds: float) -> str:
    """Seconds for people."""
    if seconds < 99.5:
        return f"{seconds:.3g} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{seconds / 3600:.1f} h"


@dataclasses.dataclass(frozen=True)
class Tile:
    """One score before and after."""

    name: str
    before: str
    after: str
    unit: str
    better: bool


def _tiles(result: RefineResult) -> list[Tile]:
    before, after = result.init.scores, result.refined.scores
    tiles = []
    for name, field, unit, sign in (
        ("IoU", "iou", "", 1),
        ("IoU, first frame", "first_frame_iou", "", 1),
        ("End-point error", "epe", "px", -1),
        ("End-point error, first frame", "first_frame_epe", "px", -1),
        ("Fitness", "fitness", "", 1),
    ):
        a, b = float(getattr(before, field)[0]), float(getattr(after, field)[0])
        tiles.append(Tile(name, tables.fixed(a), tables.fixed(b), unit, sign * (b - a) >= 0))
    return tiles


def _small_enough(result: RefineResult, observation: Observation, animation: bytes | None) -> bytes:
    """The animation, smaller if it would make the page heavy."""
    data = animation or overlay_gif(observation, result.refined, result.matching)
    for side in (360, 240, 160):
        if len(data) <= _MOST_ANIMATION:
            break
        data = overlay_gif(observation, result.refined, result.matching, side)
    return data


@dataclasses.dataclass(frozen=True)
class FramePair:
    """One frame, before and after, as data URIs."""

    index: int
    time: float
    before: str
    after: str
    iou_before: float
    iou_after: float


def _frames(result: RefineResult, observation: Observation) -> list[FramePair]:
    size = fitted(observation.size, min(_FRAME_SIDE, max(_FLOW_SIDE, max(observation.size))))
    draw_before = Overlay(observation, result.init, _matching_of_init(result), size)
    draw_after = Overlay(observation, result.refined, result.matching, size)
    picks = np.unique(np.linspace(0, observation.length - 1, FRAMES).round().astype(int))
    return [
        FramePair(
            index=int(t),
            time=t / observation.fps,
            before=encode.jpeg(draw_before(t)),
            after=encode.jpeg(draw_after(t)),
            iou_before=float(result.init.scores.frame_iou[0, t]),
            iou_after=float(result.refined.scores.frame_iou[0, t]),
        )
        for t in picks
    ]


def _matching_of_init(result: RefineResult) -> tuple[int, ...]:
    """The matching that the best sample's outlines are coloured by; unknown where the refined scene came from another."""
    if result.init_index == result.start_index:
        return result.matching
    return (UNMATCHED,) * len(result.init.scene.objects)


@dataclasses.dataclass(frozen=True)
class FlowTriple:
    """One interval's flow: observed, simulated, and how far apart, as data URIs."""

    index: int
    observed: str
    simulated: str
    error: str
    epe: float


def _flows(result: RefineResult, observation: Observation) -> list[FlowTriple]:
    size = fitted(observation.size, _FLOW_SIDE)
    largest = largest_flow(observation)
    picks = np.unique(np.linspace(0, observation.length - 2, INTERVALS + 2).round().astype(int))
    picks = picks[1:-1] if len(picks) == INTERVALS + 2 else picks[:INTERVALS]
    triples = []
    for t in picks:
        seen, made = observation.flow[t], result.refined.flow[t]
        error = np.linalg.norm(made - seen, axis=-1)
        pictures = [flow_picture(seen, largest, size), flow_picture(made, largest, size)]
        pictures.append(error_picture(error, largest / 2, size))
        uris = [encode.jpeg(picture, 90) for picture in pictures]
        triples.append(FlowTriple(int(t), *uris, epe=float(result.refined.scores.frame_epe[0, t])))
    return triples


def _options(result: RefineResult) -> list[tuple[str, str]]:
    options = result.options
    weights = ", ".join(f"{k} {v:g}" for k, v in dataclasses.asdict(options.weights).items() if v)
    seconds = ", ".join(f"{name} {duration(value)}" for name, value in result.seconds.items())
    resolution = "about 160 wide" if options.resolution is None else "x".join(map(str, options.resolution))
    return [
        (
            "search",
            f"{options.optimizer}, {options.iterations} iterations of {options.population}, seed {options.seed}",
        ),
        ("backend", f"{result.backend} on {result.device}"),
        ("rollouts", f"{result.evaluations} of {options.budget}"),
        ("ended because", result.reason),
        ("time", seconds),
        ("fitness", weights or "none"),
        ("resolution of the search", resolution),
    ]
