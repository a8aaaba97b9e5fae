"""What was seen: optical flow, instance masks and their rate, from and to ``flows.npz``."""

from __future__ import annotations

import dataclasses
import functools
import lzma
import os
import warnings
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from mjx_refine import files
from mjx_refine.errors import InputError

_KEYS = ("flow", "masks", "fps", "frames", "flow_sigma")
MAX_ELEMENTS = 2 * 10**9
MAX_FLOW = 1e5
_READERS = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
_DAMAGED = (OSError, ValueError, EOFError, KeyError, TypeError, SyntaxError, RuntimeError, MemoryError, OverflowError)
_DAMAGED += (zipfile.BadZipFile, zlib.error, lzma.LZMAError)


@dataclasses.dataclass(frozen=True)
class Observation:
    """An observed clip.

    Attributes:
      flow: optical flow from frame t to t + 1 [px/frame], x right, y down; NaN where it was not measured.
      masks: instance ids, 0 is the background; None where the clip has none.
      fps: frames a second.
      frames: RGB pictures, only for display.
      flow_sigma: standard deviation of the flow's noise [px], one number or one a pixel.
      source: where it came from, for messages.
    """

    flow: Float[np.ndarray, "intervals height width 2"]
    masks: Int[np.ndarray, "frames height width"] | None
    fps: float
    frames: UInt8[np.ndarray, "frames height width 3"] | None = None
    flow_sigma: float | Float[np.ndarray, "intervals height width"] | None = None
    source: str = "<observation>"

    @property
    def length(self) -> int:
        """The number of frames T; the flow has T - 1 intervals."""
        return self.flow.shape[0] + 1

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self.flow.shape[2], self.flow.shape[1]

    def mask_ids(self) -> list[int]:
        """The instance ids that occur, ascending."""
        return list(self._mask_ids)

    @functools.cached_property
    def _mask_ids(self) -> tuple[int, ...]:
        return () if self.masks is None else tuple(int(i) for i in np.unique(self.masks) if i != 0)


def load_observation(path: str | os.PathLike) -> Observation:
    """Reads ``flows.npz``.

    Raises:
      InputError: the file is missing, no npz, holds pickles, or its arrays do not fit together.
    """
    path = Path(path)
    check_sizes(path)
    arrays = read_arrays(path, _KEYS, ("flow", "fps"))
    return make_observation(source=str(path), **arrays)


def read_arrays(path: Path, known: Sequence[str], needed: Sequence[str]) -> dict[str, np.ndarray]:
    """The arrays of an npz.

    Raises:
      InputError: it is no npz, holds pickles or an unknown key, or lacks one that is needed.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            _check_keys(path, archive.files, known, needed)
            return {key: archive[key] for key in archive.files}
    except InputError:
        raise
    except _DAMAGED as error:
        pickled = "allow_pickle" in str(error) or "Object arrays" in str(error)
        reason = "it holds pickled objects" if pickled else str(error)[:200]
        raise InputError(f"{path}: cannot be read as npz ({reason}); write it again with numpy.savez") from error


def _check_keys(path: Path, keys: list[str], known: Sequence[str], needed: Sequence[str]) -> None:
    for key in keys:
        if key not in known:
            raise InputError(f"{path}: unknown key {key[:60]!r}; expected {', '.join(known)}; remove or rename it")
    for key in needed:
        if key not in keys:
            raise InputError(f"{path}: the key {key!r} is missing; found {', '.join(keys)[:200] or 'nothing'}; add it")


def check_sizes(path: Path) -> None:
    """Refuses headers that promise more than memory holds, before anything is read."""
    try:
        if path.is_dir():
            raise InputError(
                f"{path}: is a directory; expected an observation (npz with flow, masks, fps); name the file in it"
            )
        if not path.is_file():
            raise InputError(
                f"{path}: no such file; expected an observation (npz with flow, masks, fps); check the name"
            )
        with zipfile.ZipFile(path) as archive:
            need = sum(_declared_bytes(path, archive, info) for info in archive.infolist())
    except InputError:
        raise
    except _DAMAGED as error:
        raise InputError(
            f"{path}: not a readable npz of plain arrays ({str(error)[:200]}); write it with numpy.savez"
        ) from error
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if 2 * need > memory:  # the flow is copied once, to float32
        raise InputError(
            f"{path}: its arrays take {need / 2**30:.1f} GiB of memory, twice that while they are checked, and this "
            f"machine has {memory / 2**30:.1f} GiB; write fewer or smaller frames"
        )


def _declared_bytes(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> int:
    """Bytes that one array takes in memory, if its header agrees with the zip's."""
    with archive.open(info) as stream, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy's on headers of Python 2; a wrong one raises
        version = np.lib.format.read_magic(stream)
        shape, _, dtype = _READERS[version[0]](stream)
    if any(n < 0 for n in shape):
        raise InputError(f"{path}: {info.filename} has shape {shape}; the file is damaged; write it again")
    count = int(np.prod([int(n) for n in shape], dtype=object)) if shape else 1
    size = count * dtype.itemsize
    if count > MAX_ELEMENTS or (size > info.file_size and not dtype.hasobject):
        raise InputError(
            f"{path}: {info.filename} declares {count} numbers, the file holds {info.file_size} bytes "
            f"(at most {MAX_ELEMENTS} numbers are read); the file is damaged or too large; write it again"
        )
    return size


def make_observation(
    flow: np.ndarray,
    fps: float | np.ndarray,
    masks: np.ndarray | None = None,
    frames: np.ndarray | None = None,
    flow_sigma: float | np.ndarray | None = None,
    source: str = "<observation>",
) -> Observation:
    """Checks arrays against one another and makes an observation of them.

    Raises:
      InputError: a shape, type or value is wrong; the message names the array.
    """
    flow = np.asarray(flow)
    if flow.dtype.kind != "f":
        raise InputError(
            f"{source}: flow has dtype {flow.dtype}; expected float16, float32 or float64; convert it with astype"
        )
    if flow.ndim != 4 or flow.shape[3] != 2:
        raise InputError(f"{source}: flow has shape {flow.shape}; expected (T-1, H, W, 2); add or move axes")
    if min(flow.shape) < 1:
        raise InputError(
            f"{source}: flow has shape {flow.shape}; expected at least two frames (one interval) of pixels; give a longer clip"
        )
    intervals, height, width = flow.shape[:3]
    if min(height, width) < 8:
        raise InputError(f"{source}: frames of {width}x{height}; expected at least 8x8 pixels; give larger pictures")
    if np.isinf(flow).any():
        raise InputError(
            f"{source}: flow holds infinities; expected finite numbers; write NaN where it was not measured"
        )
    if flow.dtype.itemsize > 2 and (np.abs(flow) > MAX_FLOW).any():  # float16 ends below
        raise InputError(
            f"{source}: flow holds displacements of {np.nanmax(np.abs(flow)):.3g} px/frame; expected at most {MAX_FLOW:g}; "
            "write NaN where it was not measured"
        )
    if masks is None and not np.isfinite(flow).any():
        raise InputError(
            f"{source}: flow is NaN everywhere and there are no masks; expected numbers somewhere; measure it again"
        )
    return Observation(
        flow=flow.astype(np.float32),
        masks=None if masks is None else _masks(np.asarray(masks), (intervals + 1, height, width), source),
        fps=_fps(fps, source),
        frames=None if frames is None else _frames(np.asarray(frames), (intervals + 1, height, width, 3), source),
        flow_sigma=None if flow_sigma is None else _sigma(np.asarray(flow_sigma), flow.shape[:3], source),
        source=source,
    )


def _fps(fps: float | np.ndarray, source: str) -> float:
    array = np.asarray(fps)
    if array.size != 1 or array.dtype.kind not in "fiu":
        raise InputError(
            f"{source}: fps has shape {array.shape} and dtype {array.dtype}; expected one number; give frames a second"
        )
    value = float(array.reshape(()))
    if not 0.1 <= value <= 1e5:
        raise InputError(f"{source}: fps = {value:g}; expected 0.1 <= fps <= 100000 frames a second; correct it")
    return value


def _masks(masks: np.ndarray, shape: tuple[int, ...], source: str) -> np.ndarray:
    if masks.dtype.kind not in "iub":
        raise InputError(
            f"{source}: masks have dtype {masks.dtype}; expected integer ids (0 = background); convert them with astype(int)"
        )
    if masks.shape != shape:
        raise InputError(
            f"{source}: masks have shape {masks.shape}; expected {shape} (one frame more than the flow); cut the longer one"
        )
    if masks.dtype.kind != "b" and (masks.min() < 0 or masks.max() > 2**30):
        raise InputError(
            f"{source}: mask ids lie in [{masks.min()}, {masks.max()}]; expected 0 <= id <= 2^30; number the objects anew"
        )
    if not masks.any():
        raise InputError(
            f"{source}: masks are empty in every frame; expected at least one object; see `refine observe`"
        )
    if len(np.unique(masks)) > 65:
        raise InputError(
            f"{source}: masks hold {len(np.unique(masks)) - 1} ids; expected at most 64 objects; set the others to 0"
        )
    return masks.astype(np.int32)


def _frames(frames: np.ndarray, shape: tuple[int, ...], source: str) -> np.ndarray:
    if frames.dtype != np.uint8 or frames.shape != shape:
        raise InputError(
            f"{source}: frames are {frames.dtype} {frames.shape}; expected uint8 {shape}; convert or cut them, or leave them out"
        )
    return frames


def _sigma(sigma: np.ndarray, shape: tuple[int, ...], source: str) -> float | np.ndarray:
    if sigma.dtype.kind not in "fiu" or sigma.shape not in ((), shape):
        raise InputError(
            f"{source}: flow_sigma is {sigma.dtype} {sigma.shape}; expected one number or shape {shape}; give one number"
        )
    if not (sigma[np.isfinite(sigma)] >= 0).all() or not np.isfinite(sigma).any():
        raise InputError(
            f"{source}: flow_sigma holds negative or no finite numbers; expected pixels >= 0; write NaN where it is not known"
        )
    if (sigma[np.isfinite(sigma)].astype(np.float64) > MAX_FLOW).any():
        raise InputError(
            f"{source}: flow_sigma holds {sigma[np.isfinite(sigma)].max():.3g}; expected at most {MAX_FLOW:g}; "
            "write NaN where it is not known"
        )
    return float(sigma) if sigma.ndim == 0 else sigma.astype(np.float32)


def save_observation(path: str | os.PathLike, observation: Observation) -> Path:
    """Writes ``flows.npz`` (flow as float16 where that loses less than 0.02 px), whole or not at all."""
    flow = observation.flow
    small = np.nanmax(np.abs(flow), initial=0.0) < 40.0
    arrays: dict[str, Any] = {
        "flow": flow.astype(np.float16 if small else np.float32),
        "fps": np.float64(observation.fps),
    }
    if observation.masks is not None:
        arrays["masks"] = observation.masks.astype(np.uint8 if observation.masks.max() < 256 else np.int32)
    if observation.frames is not None:
        arrays["frames"] = observation.frames
    if observation.flow_sigma is not None:
        arrays["flow_sigma"] = np.asarray(observation.flow_sigma, np.float32)
    return files.write_atomic(path, lambda stream: np.savez_compressed(stream, **arrays))
