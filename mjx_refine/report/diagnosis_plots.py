"""The diagnosis' drawings as SVG that stands in a page and takes its text colour."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float, Int
from markupsafe import Markup, escape

from mjx_refine.diagnosis.result import CHANNELS, Gap
from mjx_refine.report.plots import AFTER, BEFORE
from mjx_refine.report.tables import number

CHANNEL_COLOURS = {
    "motion": "#2f7fd6",
    "rotation": "#8b5cf6",
    "shape": "#d97706",
    "camera": "#0f9f90",
    "timing": "#db2777",
    "perception": "#6a9a1f",
}
"""Told apart on white and on black; the cells' tooltips say the channel as well."""

_UNKNOWN_COLOUR = "#7c8794"
_WIDTH, _LEFT, _RIGHT = 1000.0, 132.0, 6.0
_ROW, _SPACE, _TITLE, _AXIS = 25.0, 4.0, 24.0, 24.0
_MOST_TOOLTIPS = 3000
_LEAST_TOP = 10.0


@dataclasses.dataclass(frozen=True)
class Rows:
    """One panel of the map: a row an object.

    Attributes:
      title: stands above it.
      misfit: root mean square, in noise widths; NaN where the object was not seen.
    """

    title: str
    misfit: Float[np.ndarray, "objects frames"]


def top_of(*maps: Float[np.ndarray, "objects frames"]) -> float:
    """The misfit that gets full colour: the largest, at least 10 noise widths."""
    largest = [float(np.nanmax(m)) for m in maps if np.isfinite(m).any()]
    return max([_LEAST_TOP, *(value for value in largest if math.isfinite(value))])


def strength(misfit: float, top: float) -> float:
    """Opacity of a cell, logarithmic from one noise width to ``top``."""
    if not math.isfinite(misfit) or misfit <= 1:
        return 0.0
    return min(1.0, 0.06 + 0.94 * math.log(misfit) / math.log(top))


def misfit_map(names: tuple[str, ...], panels: list[Rows], channels: Int[np.ndarray, "objects frames"]) -> Markup:
    """Objects times frames, coloured by channel, as strong as the misfit; panels one above the other, on one scale.

    Args:
      names: of the objects.
      panels: what to draw.
      channels: index into ``CHANNELS`` of each cell, anything else where it has none.
    """
    frames = panels[0].misfit.shape[1]
    top = top_of(*(panel.misfit for panel in panels))
    tooltips = len(panels) * channels.size <= _MOST_TOOLTIPS
    height_of_panel = _TITLE + len(names) * (_ROW + _SPACE)
    height = len(panels) * (height_of_panel + 8) + _AXIS
    parts: list[Markup | str] = [
        Markup('<svg role="img" aria-label="Misfit of every object in every frame" viewBox="0 0 {:g} {:g}" '
               'font-size="13" fill="currentColor">').format(_WIDTH, height)
    ]  # fmt: skip
    y = 0.0
    for panel in panels:
        parts.append(_text(0, y + 16, panel.title, weight=600))
        for n, name in enumerate(names):
            row = y + _TITLE + n * (_ROW + _SPACE)
            parts.append(_text(_LEFT - 10, row + 0.68 * _ROW, _short(name), anchor="end"))
            parts += _cells(name, panel.misfit[n], channels[n], row, top, tooltips)
        y += height_of_panel + 8
    parts += _axis(frames, y - 4)
    return Markup("").join([*parts, Markup("</svg>")])


def _cells(name: str, misfit: np.ndarray, channels: np.ndarray, y: float, top: float, tooltips: bool) -> list[Markup]:
    width = (_WIDTH - _LEFT - _RIGHT) / len(misfit)
    space = min(1.0, 0.1 * width)
    back = Markup('<rect x="{:g}" y="{:g}" width="{:g}" height="{:g}" fill-opacity="0.05"/>')
    cells = [back.format(_LEFT, y, _WIDTH - _LEFT - _RIGHT, _ROW)]
    for t, value in enumerate(misfit):
        value = float(value)
        channel = CHANNELS[channels[t]] if 0 <= channels[t] < len(CHANNELS) else ""
        x = _LEFT + t * width
        if math.isnan(value):
            line = Markup('<path d="M{:.2f} {:.2f}l{:.2f} {:.2f}" stroke="currentColor" stroke-opacity="0.35"/>')
            cells.append(line.format(x + 0.2 * width, y + 0.8 * _ROW, 0.6 * width, -0.6 * _ROW))
            continue
        opacity = 1.0 if math.isinf(value) else strength(value, top)
        told = f"{name}, frame {t}: {number(value, 2)} noise widths" + (f", {channel}" if channel else "")
        title = Markup("<title>{}</title>").format(told) if tooltips else ""
        if not opacity and not title:
            continue
        cell = Markup(
            '<rect x="{:.2f}" y="{:g}" width="{:.2f}" height="{:g}" fill="{}" fill-opacity="{:.3f}">{}</rect>'
        )
        shade = CHANNEL_COLOURS.get(channel, _UNKNOWN_COLOUR)
        cells.append(cell.format(x + space / 2, y, width - space, _ROW, shade, opacity, title))
    return cells


def _axis(frames: int, y: float) -> list[Markup]:
    """Numbers of frames under the cells' middles."""
    width = (_WIDTH - _LEFT - _RIGHT) / frames
    step = next((s for s in (1, 2, 5, 10, 20, 50, 100, 200, 500) if s * width >= 34), 1000)
    ticks = [
        _text(_LEFT + (t + 0.5) * width, y + 12, str(t), anchor="middle", soft=True) for t in range(0, frames, step)
    ]
    return [_text(_LEFT - 10, y + 12, "frame", anchor="end", soft=True), *ticks]


def gap_bars(gap: Gap, label: str) -> Markup:
    """The gap of the base model and of the diagnosed scene as bars from zero, the noise floor as a line; empty if unknown.

    Args:
      gap: what to draw.
      label: of the second bar; empty: the diagnosed scene is the base model's.
    """
    bars = [(gap.before, "base model", BEFORE), *([(gap.after, label, AFTER)] if label else [])]
    values = [value for value, _, _ in bars]
    if not all(math.isfinite(v) for v in values) or max(values) <= 0:
        return Markup("")
    left, right, bar = 168.0, 62.0, 22.0
    foot = 6 + len(bars) * (bar + 8)
    scale = (_WIDTH / 2 - left - right) / max(*values, gap.noise_floor if math.isfinite(gap.noise_floor) else 0.0)
    parts: list[Markup] = [
        Markup('<svg role="img" aria-label="The gap before and after" viewBox="0 0 {:g} {:g}" font-size="13" '
               'fill="currentColor">').format(_WIDTH / 2, foot + 26)
    ]  # fmt: skip
    for k, (value, name, shade) in enumerate(bars):
        y = 4 + k * (bar + 8)
        parts.append(_text(left - 10, y + 0.7 * bar, _short(name, 21), anchor="end"))
        rect = Markup('<rect x="{:g}" y="{:g}" width="{:.2f}" height="{:g}" rx="3" fill="{}"/>')
        parts.append(rect.format(left, y, max(1.5, value * scale), bar, shade))
        parts.append(_text(left + max(1.5, value * scale) + 7, y + 0.7 * bar, number(value, 3)))
    if math.isfinite(gap.noise_floor):
        x = left + gap.noise_floor * scale
        line = Markup('<path d="M{:.2f} 0V{:g}" stroke="currentColor" stroke-width="1.5" stroke-dasharray="4 3"/>')
        parts.append(line.format(x, foot))
        parts.append(_text(x, foot + 16, f"noise floor {number(gap.noise_floor, 3)}", anchor="middle", soft=True))
    return Markup("").join([*parts, Markup("</svg>")])


def _short(name: str, most: int = 17) -> str:
    return name if len(name) <= most else name[: most - 1] + "…"


def _text(x: float, y: float, words: str, anchor: str = "start", weight: int = 400, soft: bool = False) -> Markup:
    faint = Markup(' fill-opacity="0.65"') if soft else Markup("")
    return Markup('<text x="{:.2f}" y="{:.2f}" text-anchor="{}" font-weight="{}"{}>{}</text>').format(
        x, y, anchor, weight, faint, escape(words)
    )
