"""Measured poses: time, positions and orientations of one or several objects, from ``poses.npz``."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mjx_refine import rotations
from mjx_refine.errors import InputError
from mjx_refine.observation import check_sizes, read_arrays

_KEYS = ("time", "pos", "quat", "names", "sigma_pos", "sigma_rot")
_NEEDED = ("time", "pos", "quat")
FARTHEST = 1e4
"""Largest coordinate [m], as in scene files."""

LONGEST = 1e6
"""Largest time [s]."""

UNIT = 0.1
"""How far a quaternion's norm may be from one."""

SIGMAS = {"sigma_pos": (1e-7, 10.0, "m"), "sigma_rot": (1e-6, 3.0, "rad")}
"""Bounds of the stated noise, and its unit."""


@dataclasses.dataclass(frozen=True)
class Poses:
    """Measured poses of N objects at T times.

    Attributes:
      time: ascending [s]; need not be even.
      position: centres, world frame with z up [m]; NaN where not measured.
      quaternion: unit, w x y z, body to world; NaN where not measured.
      names: of the objects; empty where there is one and the file does not say.
      sigma_pos: standard deviation of a coordinate's noise [m]; None: not stated.
      sigma_rot: ditto of a rotation about one axis [rad].
      source: where they came from, for messages.
    """

    time: Float[np.ndarray, "times"]
    position: Float[np.ndarray, "objects times 3"]
    quaternion: Float[np.ndarray, "objects times 4"]
    names: tuple[str, ...] = ()
    sigma_pos: float | None = None
    sigma_rot: float | None = None
    source: str = "<poses>"


def load_poses(path: str | os.PathLike) -> Poses:
    """Reads ``poses.npz``.

    Raises:
      InputError: the file is missing, no npz, holds pickles, or its arrays do not fit together.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected measured poses (npz with {', '.join(_NEEDED)}); name another")
    check_sizes(path)
    return make_poses(source=str(path), **read_arrays(path, _KEYS, _NEEDED))


def make_poses(
    time: np.ndarray,
    pos: np.ndarray,
    quat: np.ndarray,
    names: np.ndarray | Sequence[str] | None = None,
    sigma_pos: float | np.ndarray | None = None,
    sigma_rot: float | np.ndarray | None = None,
    source: str = "<poses>",
) -> Poses:
    """Checks arrays against one another and makes poses of them.

    Args:
      time: (T,) [s].
      pos: (T, 3), or (N, T, 3) with ``names`` [m]; NaN where not measured.
      quat: (T, 4) or (N, T, 4), w x y z, body to world; NaN where not measured.
      names: (N,).
      sigma_pos: one number [m].
      sigma_rot: one number [rad].
      source: for messages.

    Raises:
      InputError: a shape, type or value is wrong; the message names the array.
    """
    at = _time(np.asarray(time), source)
    place = _array(np.asarray(pos), "pos", 3, len(at), source)
    turn = _array(np.asarray(quat), "quat", 4, len(at), source)
    if place.shape[0] != turn.shape[0]:
        raise InputError(f"{source}: pos has {place.shape[0]} objects, quat {turn.shape[0]}; expected as many of each")
    if (np.abs(place) > FARTHEST).any():
        raise InputError(
            f"{source}: pos reaches {np.nanmax(np.abs(place)):g} m; expected at most {FARTHEST:g}; write metres"
        )
    if not np.isfinite(place).any() and not np.isfinite(turn).any():
        raise InputError(f"{source}: pos and quat are NaN everywhere; expected numbers somewhere; measure again")
    return Poses(
        at,
        place,
        _units(turn, source),
        _names(names, place.shape[0], np.ndim(pos) == 3, source),
        _sigma(sigma_pos, "sigma_pos", source),
        _sigma(sigma_rot, "sigma_rot", source),
        source,
    )


def _numbers(array: np.ndarray, key: str, source: str) -> np.ndarray:
    if array.dtype.kind not in "fiu":
        raise InputError(f"{source}: {key} has dtype {array.dtype}; expected numbers; write it as float64")
    array = array.astype(np.float64)
    if np.isinf(array).any():
        raise InputError(f"{source}: {key} holds infinities; expected finite numbers; write NaN where not measured")
    return array


def _time(time: np.ndarray, source: str) -> np.ndarray:
    time = _numbers(time, "time", source)
    if time.ndim != 1 or len(time) < 2:
        raise InputError(f"{source}: time has shape {time.shape}; expected (T,) with T >= 2; write one time a sample")
    if np.isnan(time).any() or np.abs(time).max() > LONGEST:
        bad = int(np.argmax(np.isnan(time) | (np.abs(time) > LONGEST)))
        raise InputError(
            f"{source}: time[{bad}] = {time[bad]:g}; expected seconds within {LONGEST:g}; leave out samples without time"
        )
    step = np.diff(time)
    if (step <= 0).any():
        bad = int(np.argmax(step <= 0)) + 1
        raise InputError(
            f"{source}: time[{bad}] = {time[bad]:g} after {time[bad - 1]:g}; expected ascending times; "
            "sort the samples and leave out doubled ones"
        )
    return time


def _array(array: np.ndarray, key: str, width: int, count: int, source: str) -> np.ndarray:
    array = _numbers(array, key, source)
    if array.ndim not in (2, 3) or array.shape[-2:] != (count, width) or array.shape[0] == 0:
        raise InputError(
            f"{source}: {key} has shape {array.shape}; expected ({count}, {width}) for one object or "
            f"(N, {count}, {width}) with names, one row a time"
        )
    return array if array.ndim == 3 else array[None]


def _units(quat: np.ndarray, source: str) -> np.ndarray:
    norm = np.linalg.norm(quat, axis=-1)
    off = np.abs(norm - 1.0) > UNIT
    if off.any():
        n, t = (int(k) for k in np.argwhere(off)[0])
        raise InputError(
            f"{source}: quat of object {n} at sample {t} has norm {norm[n, t]:g}; expected a unit quaternion w x y z; "
            "write NaN where not measured"
        )
    quat = quat / norm[..., None]
    return quat + 0.0 * quat.sum(-1, keepdims=True)  # one NaN makes the whole quaternion unknown


def _names(names, count: int, several: bool, source: str) -> tuple[str, ...]:
    if names is None:
        if several:
            raise InputError(f"{source}: names are missing; expected {count} names of the scene's objects; add them")
        return ()
    array = np.asarray(names)
    array = array[None] if array.ndim == 0 else array
    if array.dtype.kind not in "US" or array.shape != (count,):
        raise InputError(
            f"{source}: names are {array.dtype} {array.shape}; expected {count} texts; write one name an object"
        )
    try:
        told = tuple(n.decode() if isinstance(n, bytes) else str(n) for n in array.tolist())
    except UnicodeDecodeError as error:
        raise InputError(f"{source}: names are no UTF-8 ({error}); expected texts; write them as str") from error
    if len(set(told)) != count:
        raise InputError(f"{source}: names = {', '.join(told)[:200]}; expected each once; rename one")
    return told


def _sigma(value: float | np.ndarray | None, key: str, source: str) -> float | None:
    if value is None:
        return None
    low, high, unit = SIGMAS[key]
    array = np.asarray(value)
    if array.dtype.kind not in "fiu" or array.size != 1:
        raise InputError(f"{source}: {key} is {array.dtype} {array.shape}; expected one number [{unit}]; correct it")
    number = float(array.reshape(()))
    if not low <= number <= high:
        raise InputError(f"{source}: {key} = {number:g}; expected {low:g} <= {key} <= {high:g} {unit}; correct it")
    return number


# --- noise and motion -------------------------------------------------------------------------------------------------

LEAST_POS, LEAST_ROT = 1e-4, 1e-3
"""Noise that is assumed at least where it is not stated [m], [rad]: no tracker is better, however smooth its output."""


def noise_of(poses: Poses) -> tuple[Float[np.ndarray, "objects 3"], Float[np.ndarray, "objects"]]:
    """Standard deviations of positions by axis [m] and of rotations [rad]: as stated, else from third differences in time.

    Third differences (divided ones where times are uneven) do not see steady accelerations.
    """
    weights = third_differences(poses.time)
    turn = small_turns(poses.quaternion)
    place = np.array([[_spread(weights, row[:, k]) for k in range(3)] for row in poses.position])
    rot = np.array([_spread(weights, row) for row in turn])
    if poses.sigma_pos is not None:
        place = np.full_like(place, poses.sigma_pos)
    if poses.sigma_rot is not None:
        rot = np.full_like(rot, poses.sigma_rot)
    return np.maximum(place, LEAST_POS * (poses.sigma_pos is None)), np.maximum(
        rot, LEAST_ROT * (poses.sigma_rot is None)
    )


def third_differences(time: Float[np.ndarray, "times"]) -> Float[np.ndarray, "windows 4"]:
    """Weights of four neighbouring samples that cancel every quadratic in time, of unit norm."""
    rows = []
    for k in range(len(time) - 3):
        t = time[k : k + 4] - time[k]
        w = np.array([1.0 / np.prod([t[i] - t[j] for j in range(4) if j != i]) for i in range(4)])
        rows.append(w / np.linalg.norm(w))
    return np.array(rows).reshape(-1, 4)


def _spread(weights: np.ndarray, series: np.ndarray) -> float:
    if not len(weights):
        return 0.0
    windows = np.stack([series[k : k + len(weights)] for k in range(4)], 1)
    third = np.abs(np.einsum("kw,kw...->k...", weights, windows))
    third = third[np.isfinite(third)]
    return 1.4826 * float(np.median(third)) if third.size else 0.0


def small_turns(quaternion: Float[np.ndarray, "objects times 4"]) -> Float[np.ndarray, "objects times 3"]:
    """Rotation vectors, in the body's frame, summed from sample to sample [rad]."""
    step = rotation_vector(rotations.multiply(rotations.conjugate(quaternion[:, :-1]), quaternion[:, 1:]))
    return np.concatenate([np.zeros_like(step[:, :1]), np.cumsum(step, 1)], 1)


def rotation_vector(q: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3"]:
    """The inverse of ``rotations.exponential``, with angles up to pi [rad]; NaN for NaN."""
    q = q * np.where(q[..., :1] < 0, -1.0, 1.0)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 2.0)
