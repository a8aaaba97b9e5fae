"""The files that a diagnosis leaves in its folder."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mjx_refine import files
from mjx_refine.diagnosis.result import Diagnosis
from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.report.diagnosis_numbers import diagnosis_json
from mjx_refine.report.diagnosis_page import diagnosis_page
from mjx_refine.scene import dump_scene

NAMES = ("diagnosed.yaml", "report.html", "diagnosis.json")


def write_diagnosis(
    folder: str | os.PathLike,
    diagnosis: Diagnosis,
    observation: Observation | None = None,
    call: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Writes ``diagnosed.yaml``, ``report.html`` and ``diagnosis.json``.

    Each appears whole or not at all; ``diagnosis.json`` comes last (an older one goes first), so that where it is the
    others are, and belong to it.

    Args:
      folder: made if it is not there.
      diagnosis: what was found.
      observation: the clip, for pictures; the first of several.
      call: what was asked for, see ``diagnosis_numbers``.

    Returns:
      the files' paths, in that order.

    Raises:
      InputError: the folder cannot be written.
    """
    folder = files.writable_directory(folder, NAMES)
    texts = (dump_scene(diagnosis.scene), diagnosis_page(diagnosis, observation, call), diagnosis_json(diagnosis, call))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / NAMES[-1]).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror or error}); choose another place") from error
    return [files.write_text(folder / name, text) for name, text in zip(NAMES, texts, strict=True)]
