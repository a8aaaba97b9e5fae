"""The state of a run on disk: written whole after every step, read back bit for bit."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from mjx_refine import files
from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.scene import Samples
from mjx_refine.search.options import Options

VERSION = 1


def digest(*parts: object) -> str:
    """A fingerprint of a run's input: arrays by their bytes, everything else by its text."""
    state = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            state.update(f"{part.dtype}{part.shape}".encode())
            state.update(np.ascontiguousarray(part).tobytes())
        else:
            state.update(repr(part).encode())
        state.update(b"\0")
    return state.hexdigest()


def input_digest(samples: Samples, observation: Observation, options: Options) -> str:
    """A fingerprint of what decides a run's result; neither threads nor pictures that are only shown belong to it."""
    chosen = dataclasses.asdict(dataclasses.replace(options, threads=None))
    masks = observation.masks if observation.masks is not None else "no masks"
    return digest(observation.flow, observation.fps, samples.scenes, chosen, masks)


def save_checkpoint(path: Path, values: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Writes ``values`` (as JSON) and ``arrays``, whole or not at all."""
    text = np.frombuffer(json.dumps({"version": VERSION, **values}).encode(), np.uint8)
    content = {**arrays, "__values__": text}
    files.write_atomic(path, lambda stream: np.savez(stream, **content))  # type: ignore[arg-type]


def damaged(path: Path, error: Exception) -> InputError:
    """What to say of a checkpoint that cannot be used."""
    return InputError(f"{path}: not a readable checkpoint ({error}); run again without --resume")


def load_checkpoint(path: Path, expected: str) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
    """Reads a checkpoint back; None where there is none yet.

    Raises:
      InputError: it is damaged, or belongs to another input or other options.
    """
    if not path.exists():
        return None
    try:
        # Opened here: numpy leaves a damaged file open.
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
        values = dict(json.loads(arrays.pop("__values__").tobytes()))
    except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        raise damaged(path, error) from error
    if values.get("version") != VERSION or values.get("digest") != expected:
        raise InputError(
            f"{path}: made for another input or other options; expected those of this call; "
            "repeat the first call's arguments, or run without --resume"
        )
    return values, arrays
