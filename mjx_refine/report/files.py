"""The files that a refinement leaves in its folder."""

from __future__ import annotations

import csv
import dataclasses
import io
import os
from pathlib import Path

from mjx_refine import files
from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.report.animation import overlay_gif
from mjx_refine.report.numbers import result_json
from mjx_refine.report.page import report_page
from mjx_refine.scene import save_scene
from mjx_refine.search.progress import Step
from mjx_refine.search.result import RefineResult


def write_result(folder: str | os.PathLike, result: RefineResult, observation: Observation) -> list[Path]:
    """Writes ``refined.yaml``, ``history.csv``, ``overlay.gif``, ``report.html`` and ``result.json``.

    Each appears whole or not at all; ``result.json`` comes last, so that where it is the others are.

    Args:
      folder: made if it is not there.
      result: what ``refine`` returned.
      observation: the clip that it was refined against.

    Returns:
      the files' paths, in that order.

    Raises:
      InputError: the folder cannot be written.
    """
    folder = files.writable_directory(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror or error}); choose another place") from error
    animation = overlay_gif(observation, result.refined, result.matching)
    return [
        save_scene(folder / "refined.yaml", result.scene),
        files.write_text(folder / "history.csv", history_csv(result.history)),
        files.write_atomic(folder / "overlay.gif", lambda stream: stream.write(animation)),
        files.write_text(folder / "report.html", report_page(result, observation, animation)),
        files.write_text(folder / "result.json", result_json(result, observation)),
    ]


def history_csv(history: tuple[Step, ...]) -> str:
    """A row a step, with a header of ``Step``'s fields."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([field.name for field in dataclasses.fields(Step)])
    writer.writerows(dataclasses.astuple(step) for step in history)
    return stream.getvalue()
