"""The report's curves as SVG that stands in a page and takes its text colour."""

from __future__ import annotations

import io
import re
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from mjx_refine.search.progress import Step

BEFORE, AFTER = "#d97706", "#2f7fd6"
"""Colours of the sample as given and of the refined scene: told apart by everyone, on white and on black."""

_INK = "#010203"
"""Stands for the page's own text colour."""

_SIZE = (5.2, 2.9)  # inches
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "report",
    "font.family": "sans-serif",
    "font.size": 9.5,
    "axes.edgecolor": _INK,
    "axes.labelcolor": _INK,
    "text.color": _INK,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "grid.color": _INK,
    "grid.alpha": 0.13,
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "lines.linewidth": 2.0,
}


def iou_plot(before: Float[np.ndarray, "frames"], after: Float[np.ndarray, "frames"], fps: float) -> str:
    """IoU of every frame over time [s]."""
    with matplotlib.rc_context(_STYLE):
        figure, axes = _axes("time [s]", "foreground IoU")
        for values, shade, label in ((before, BEFORE, "before"), (after, AFTER, "after")):
            axes.plot(np.arange(len(values)) / fps, values, color=shade, label=label)
        axes.set_ylim(0, 1.02)
        return _svg(figure, axes)


def epe_plot(before: Float[np.ndarray, "intervals"], after: Float[np.ndarray, "intervals"], fps: float) -> str:
    """End-point error [px] of every interval over the time of its middle [s]."""
    with matplotlib.rc_context(_STYLE):
        figure, axes = _axes("time [s]", "end-point error [px]")
        for values, shade, label in ((before, BEFORE, "before"), (after, AFTER, "after")):
            axes.plot((np.arange(len(values)) + 0.5) / fps, values, color=shade, label=label)
        axes.set_ylim(bottom=0)
        return _svg(figure, axes)


def error_plot(
    time: Float[np.ndarray, "times"],
    before: Float[np.ndarray, "times"],
    after: Float[np.ndarray, "times"] | None,
    words: str,
) -> str:
    """Errors of measured poses over time [s]; ``words``: of the axis; ``after`` None: there is one scene alone."""
    with matplotlib.rc_context(_STYLE):
        figure, axes = _axes("time [s]", words)
        axes.plot(time, before, color=BEFORE, label="base model")
        if after is not None:
            axes.plot(time, after, color=AFTER, label="diagnosed scene")
        axes.set_ylim(bottom=0)
        return _svg(figure, axes)


def convergence_plot(history: tuple[Step, ...], start: float) -> str:
    """Fitness at the search's resolution against rollouts; ``start`` is the best sample's."""
    with matplotlib.rc_context(_STYLE):
        figure, axes = _axes("rollouts of the clip", "fitness")
        landing = [step for step in history if step.phase == "land"]
        search = [step for step in history if step.phase != "land"]
        if np.isfinite(start):
            axes.axhline(start, color=BEFORE, linestyle=(0, (4, 3)), linewidth=1.3, label="best sample")
        values = [step.fitness for step in landing]
        if landing:
            dots = {"marker": "o", "markersize": 3.2, "linestyle": "none", "alpha": 0.75}
            axes.plot([s.evaluations for s in landing], values, color="#7c8794", label="least squares", **dots)
        if search:
            axes.plot(
                [s.evaluations for s in search], [s.fitness for s in search], color=AFTER, label="population search"
            )
        every = [v for v in [*values, *(s.fitness for s in search), start] if np.isfinite(v)]
        if every:
            # One wild step must not flatten the rest.
            low, high = max(min(every), np.quantile(every, 0.25) - 1.0), max(every)
            margin = 0.08 * max(high - low, 0.02)
            axes.set_ylim(low - margin, high + margin)
        axes.set_xlim(left=0)
        return _svg(figure, axes)


def _axes(across: str, up: str):
    figure = Figure(figsize=_SIZE, layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.subplots()
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    return figure, axes


def _svg(figure: Figure, axes) -> str:
    """The figure as an ``<svg>`` element without prolog, metadata or names of other places."""
    if axes.get_legend_handles_labels()[1]:
        axes.legend(ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0), borderaxespad=0.2, handlelength=1.6)
    stream = io.StringIO()
    figure.savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\s+xmlns(:\w+)?="[^"]*"', "", text)
    text = re.sub(
        r'(<svg[^>]*?)\swidth="[^"]*"', r"\1", re.sub(r'(<svg[^>]*?)\sheight="[^"]*"', r"\1", text, count=1), count=1
    )
    text = text.replace("xlink:href", "href").replace(_INK, "currentColor")
    return text.replace("<svg", '<svg role="img"', 1)
