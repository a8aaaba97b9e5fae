"""States as plain arrays, for `np.savez` and back without pickles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

import numpy as np

from mjx_cmaes.settings import Settings, require
from mjx_cmaes.state import State

VERSION = 1
_ARRAYS = {
    "mean": ("n",),
    "scale": ("n",),
    "covariance": ("n", "n"),
    "basis": ("n", "n"),
    "axes": ("n",),
    "path_sigma": ("n",),
    "path_full": ("n",),
    "path_diagonal": ("n",),
    "asked": (None, "n"),
    "best_x": ("n",),
    "recent": ("history",),
    "initial_covariance": ("n", "n"),
}
_REALS = ("sigma", "path_full_weight", "path_diagonal_weight", "best_cost")


def save_state(state: State) -> dict[str, np.ndarray]:
    """The state as arrays (float64 and int64), one a field, beside `version`; a search goes on from it bit for bit."""
    arrays: dict[str, np.ndarray] = {"version": np.asarray(VERSION, dtype=np.int64)}
    for field in fields(State):
        value = getattr(state, field.name)
        real = field.name in _ARRAYS or field.name in _REALS
        arrays[field.name] = np.array(value, dtype=np.float64 if real else np.int64)
    return arrays


def load_state(settings: Settings, arrays: Mapping[str, np.ndarray]) -> State:
    """The state that `save_state` wrote (a dict or an open npz file).

    Raises ValueError where a field is missing, unknown to this version, or does not fit `settings`.
    """
    require("version" in arrays and int(arrays["version"]) == VERSION, "version", arrays.get("version"), f"{VERSION}")
    values: dict = {}
    sizes = {"n": settings.dimension, "history": settings.history_length}
    for field in fields(State):
        name = field.name
        require(name in arrays, name, None, "a field of the saved state")
        array = np.asarray(arrays[name])
        if name in _ARRAYS:
            shape = tuple(sizes.get(axis, array.shape[0] if array.ndim else 0) for axis in _ARRAYS[name])  # type: ignore
            require(array.shape == shape, f"{name}.shape", array.shape, f"{shape}")
            values[name] = np.array(array, dtype=np.float64)
        else:
            require(array.shape == (), f"{name}.shape", array.shape, "()")
            values[name] = float(array) if name in _REALS else int(array)
    return State(**values)
