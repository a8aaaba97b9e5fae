"""What ``refine observe`` does: observes a clip, writes the file and tells about it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from mjx_refine.errors import InputError
from mjx_refine.observe.clip import ObserveResult, observe_clip
from mjx_refine.observe.preview import write_result


def observe_command(
    path: str | os.PathLike, out: str | os.PathLike, *, echo: Callable[[str], object] = print, **options: object
) -> ObserveResult:
    """Observes a clip and writes ``out`` (npz) with a preview ``<out>.preview.png`` beside it.

    Args:
      path: the video.
      out: the observation file to write; ``.npz``.
      echo: prints a line.
      **options: as for ``observe_clip``.

    Raises:
      InputError: bad input, or ``out`` cannot be written. Nothing is written then.
    """
    out = Path(out)
    if out.is_dir() or not out.parent.is_dir():
        raise InputError(f"--out {out}: expected a file name in an existing directory, for example flows.npz")
    result = observe_clip(path, **options)  # type: ignore[arg-type]
    picture = write_result(result, out)
    report = result.report
    width, height = result.observation.size
    echo(f"{out}: {report.frames} frames of {width}x{height} at {report.fps:g} fps, {len(report.objects)} object(s)")
    for entry in report.objects:
        echo(
            f"  object {entry.mask_id}: frames {entry.first}-{entry.last}, {entry.area:.0f} px, "
            f"travels {entry.travelled:.0f} px, flow noise {entry.flow_noise:.2f} px"
        )
    echo(f"  flow noise of the background {report.flow_noise:.3f} px; {100 * report.unmeasured:.1f} % not measured")
    for sentence in report.warnings:
        echo(f"  note: {sentence}")
    echo(f"{picture}: look at it before you refine")
    return result
