"""Optical flow in the Middlebury ``.flo`` format, a file a frame (Baker et al. 2011, "A database and evaluation
methodology for optical flow"): the float 202021.25, width and height as 32-bit integers, then x and y of every pixel, row
by row, as 32-bit floats, all little-endian."""

from __future__ import annotations

import os
import secrets
import shutil
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mjx_refine.errors import InputError
from mjx_refine.files import writable_directory

MAGIC = np.float32(202021.25)
UNKNOWN = np.float32(1e10)
"""What stands for a flow that was not measured: the format knows no NaN; readers take above 1e9 for unknown."""


def flo_bytes(flow: Float[np.ndarray, "height width 2"]) -> bytes:
    """One frame's flow [px/frame] as the content of a ``.flo`` file; NaN becomes ``UNKNOWN``."""
    height, width = flow.shape[:2]
    known = np.isfinite(flow).all(-1, keepdims=True)
    pixels = np.where(known, flow, UNKNOWN).astype("<f4")
    return MAGIC.astype("<f4").tobytes() + np.array([width, height], "<i4").tobytes() + pixels.tobytes()


def checked_folder(path: str | os.PathLike) -> Path:
    """``path`` as a folder to write ``.flo`` files in: it is not there yet, or empty.

    Raises:
      InputError: it holds something, or cannot be written.
    """
    path = writable_directory(path)
    if path.is_dir() and any(path.iterdir()):
        raise InputError(
            f"{path}: is not empty; expected a new folder, so that no old flow stays among the new; name another"
        )
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no directory {path.parent}; make it or name another --flow")
    return path


def write_flo(path: str | os.PathLike, flow: Float[np.ndarray, "intervals height width 2"]) -> Path:
    """Writes ``flow_0000.flo`` (from frame 0 to 1), ``flow_0001.flo``, ... into a new folder, whole or not at all.

    Raises:
      InputError: the folder holds something, or cannot be written.
    """
    path = checked_folder(path)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        temporary.mkdir()
        for t, frame in enumerate(flow):
            (temporary / f"flow_{t:04d}.flo").write_bytes(flo_bytes(frame))
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose another place") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return path
