"""``report.html`` of a diagnosis: one page that holds all it shows."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from mjx_refine.diagnosis.result import CHANNELS, UNKNOWN, Diagnosis
from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.report import encode, plots, tables
from mjx_refine.report.contours import Overlay, colour, fitted, pale
from mjx_refine.report.diagnosis_plots import CHANNEL_COLOURS, Rows, gap_bars, misfit_map, top_of
from mjx_refine.report.diagnosis_replay import replay
from mjx_refine.report.diagnosis_tables import candidate_rows, clip_rows, gap_tiles, percent, width
from mjx_refine.report.page import duration
from mjx_refine.search.result import Replay

_HERE = Path(__file__).parent
FRAMES = 6
_FRAME_SIDE, _LEAST_SIDE = 640, 480  # px


def diagnosis_page(
    diagnosis: Diagnosis, observation: Observation | None = None, call: Mapping[str, Any] | None = None
) -> str:
    """The page as HTML text; it loads nothing and runs nothing.

    Args:
      diagnosis: what was found.
      observation: the clip; None where poses were measured instead: no pictures then.
      call: what was asked for; ``init``, ``video``, ``seed``, ``without`` are shown.
    """
    environment = _environment()
    changed = bool(diagnosis.added)
    label = "with " + " and ".join(diagnosis.added) if changed else ""
    map_panels = [Rows("base model, refitted", diagnosis.map_before)]
    if changed:
        map_panels.append(Rows(label, diagnosis.map_after))
    maps = [panel.misfit for panel in map_panels]
    present = {int(k) for k in np.unique(diagnosis.channels[(diagnosis.map_before > 1) | (diagnosis.map_after > 1)])}
    return environment.get_template("diagnosis.html").render(
        style=house_style(),
        source=_source(observation, call),
        verdict=diagnosis.verdict,
        unknown=diagnosis.verdict.effects == UNKNOWN,
        groups=diagnosis.verdict.indistinguishable,
        gap=diagnosis.gap,
        tiles=gap_tiles(diagnosis.gap, changed),
        bars=gap_bars(diagnosis.gap, label),
        map=misfit_map(diagnosis.base.names, map_panels, diagnosis.channels),
        channels=[(name, CHANNEL_COLOURS[name]) for k, name in enumerate(CHANNELS) if k in present],
        top=top_of(*maps),
        unseen=any(np.isnan(m).any() for m in maps),
        places=diagnosis.places,
        residual=diagnosis.residual,
        remaining=diagnosis.remaining,
        candidates=candidate_rows(diagnosis),
        clips=clip_rows(diagnosis),
        notes=diagnosis.notes,
        run=_run(diagnosis, call),
        changed=changed,
        objects=_objects(diagnosis),
        **_pictures(diagnosis, observation, changed),
    )


def house_style() -> Markup:
    """The style sheet of the refinement's report, so that both pages look of one house."""
    source = (_HERE / "template.html").read_text(encoding="utf-8")
    found = re.search(r"<style>(.*?)</style>", source, re.DOTALL)
    if found is None:
        raise ValueError("template.html has no <style>; expected one to share")
    return Markup(found[1])


def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_HERE),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(number=tables.number, fixed=tables.fixed, percent=percent, width=width)
    return environment


def _source(observation: Observation | None, call: Mapping[str, Any] | None) -> str:
    if observation is not None:
        video = (call or {}).get("video") or ()
        return f"{len(video)} clips" if len(video) > 1 else Path(observation.source).name
    poses = (call or {}).get("poses", "measured poses")
    return f"{len(poses)} recordings" if isinstance(poses, list | tuple) else Path(str(poses)).name


def _run(diagnosis: Diagnosis, call: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    rows = []
    for name in ("init", "sample", "video", "poses", "seed"):
        value = (call or {}).get(name)
        if value is not None and value != []:
            rows.append((name, ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)))
    if (call or {}).get("without"):
        rows.append(("withheld effects", ", ".join((call or {})["without"])))
    return [*rows, ("rollouts", str(diagnosis.rollouts)), ("time", duration(diagnosis.seconds))]


@dataclasses.dataclass(frozen=True)
class ObjectKey:
    """One object's outlines' colours (CSS)."""

    name: str
    seen: str
    simulated: str


def _objects(diagnosis: Diagnosis) -> list[ObjectKey]:
    def css(shade: tuple[int, int, int]) -> str:
        return "rgb({},{},{})".format(*shade)

    return [ObjectKey(name, css(pale(k)), css(colour(k))) for k, name in enumerate(diagnosis.base.names)]


@dataclasses.dataclass(frozen=True)
class FramePair:
    """One frame with the base model's outlines and the diagnosed scene's, as data URIs; ``after`` empty if they agree."""

    index: int
    time: float
    before: str
    after: str
    iou_before: float
    iou_after: float
    worst: bool


def _pictures(diagnosis: Diagnosis, observation: Observation | None, changed: bool) -> dict[str, Any]:
    """What the template needs of the two scenes' pictures; nothing where there is no clip or they cannot be simulated."""
    nothing: dict[str, Any] = {"frames": [], "plots": [], "lost": None, "filmed": True, "failed": ""}
    if observation is None:
        return {**nothing, "plots": _pose_plots(diagnosis, changed)}
    try:
        before = replay(diagnosis.base, observation, diagnosis.matching)
        after = replay(diagnosis.scene, observation, diagnosis.matching) if changed else before
    except InputError as error:
        return {**nothing, "failed": str(error)}
    curves = []
    if changed:
        pair = before.scores.frame_iou[0], after.scores.frame_iou[0]
        curves.append(("IoU over time", Markup(plots.iou_plot(*pair, observation.fps))))
        flows = before.scores.frame_epe[0], after.scores.frame_epe[0]
        curves.append(("End-point error over time", Markup(plots.epe_plot(*flows, observation.fps))))
    return {
        "frames": _frames(diagnosis, observation, before, after if changed else None),
        "plots": curves,
        "lost": _diverges(before, after),
        "filmed": observation.frames is not None,
        "failed": "",
    }


def _pose_plots(diagnosis: Diagnosis, changed: bool) -> list[tuple[str, Markup]]:
    """Errors of measured poses over time, one plot an object and kind of error."""
    told = diagnosis.pose_errors
    if told is None:
        return []
    curves = []
    for n, name in enumerate(diagnosis.base.names):
        for before, after, factor, words in (
            (told.position, told.position_after, 1e3, "position error [mm]"),
            (told.rotation, told.rotation_after, np.degrees(1.0), "rotation error [degrees]"),
        ):
            if np.isfinite(before[:, n]).any():
                second = factor * after[:, n] if changed else None
                svg = plots.error_plot(told.time, factor * before[:, n], second, words)
                curves.append((f"{name}: {words.split(' [')[0]}", Markup(svg)))
    return curves


def _diverges(*replays: Replay) -> int | None:
    """The first frame in which a simulation diverges, or None."""
    bad = np.array([~np.isfinite(one.poses).all((1, 2)) for one in replays]).any(0)
    return int(bad.argmax()) if bad.any() else None


def shown_frames(misfit: np.ndarray, length: int) -> tuple[list[int], int | None]:
    """Frames to show, evenly spaced with that of the largest misfit among them, and which that is (None: no misfit).

    Args:
      misfit: (objects, frames), NaN where not seen.
      length: frames of the clip.
    """
    picks = np.unique(np.linspace(0, length - 1, FRAMES).round().astype(int)).tolist()
    finite = np.where(np.isfinite(misfit), misfit, 0.0).max(0, initial=0.0)[:length]
    if not len(finite) or finite.max() <= 1:
        return picks, None
    worst = int(finite.argmax())
    if worst not in picks:
        inner = picks[1:-1] or picks
        picks[picks.index(min(inner, key=lambda t: abs(t - worst)))] = worst
    return sorted(picks), worst


def _frames(diagnosis: Diagnosis, observation: Observation, before: Replay, after: Replay | None) -> list[FramePair]:
    size = fitted(observation.size, min(_FRAME_SIDE, max(_LEAST_SIDE, max(observation.size))))
    draw_before = Overlay(observation, before, diagnosis.matching, size)
    draw_after = None if after is None else Overlay(observation, after, diagnosis.matching, size)
    picks, worst = shown_frames(diagnosis.map_before, observation.length)
    return [
        FramePair(
            index=t,
            time=t / observation.fps,
            before=encode.jpeg(draw_before(t)),
            after="" if draw_after is None else encode.jpeg(draw_after(t)),
            iou_before=float(before.scores.frame_iou[0, t]),
            iou_after=float((after or before).scores.frame_iou[0, t]),
            worst=t == worst,
        )
        for t in picks
    ]
