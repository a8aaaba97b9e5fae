"""Finished fits on disk, so that an interrupted diagnosis goes on where it stood.

A diagnosis takes the same steps every time. Each fit is kept under a fingerprint of all that it depends on; when the same
call runs again, fits that are there are read and the others made. So the answer is the same, whenever it was interrupted.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import shutil
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
import mujoco
import numpy as np

from mjx_refine.diagnosis.fits.fitted import Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.files import remove_stale_parts, write_atomic

Arrays = dict[str, np.ndarray]


@dataclasses.dataclass
class Store:
    """A folder of finished fits.

    Attributes:
      folder: made with the first fit; None: nothing is kept.
      kept: how many were written.
      recalled: how many were read instead of being made.
    """

    folder: Path | None = None
    kept: int = 0
    recalled: int = 0

    def __post_init__(self):
        if self.folder is not None:
            remove_stale_parts(self.folder)

    def recall(self, key: str) -> Arrays | None:
        """What was kept under ``key``, or None."""
        path = self._path(key)
        if path is None or not path.is_file():
            return None
        try:
            with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
                found = {name: file[name] for name in file.files}
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
            return None
        self.recalled += 1
        return found

    def keep(self, key: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Writes arrays, whole or not at all."""
        path = self._path(key)
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(path, lambda stream: np.savez(stream, **arrays))  # type: ignore[arg-type]
            self.kept += 1

    def clear(self) -> None:
        """Removes the folder, and the one that it is in where nothing else is: the diagnosis is done."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)
            with contextlib.suppress(OSError):
                self.folder.parent.rmdir()

    def _path(self, key: str) -> Path | None:
        return None if self.folder is None else self.folder / f"fit_{key}.npz"


@dataclasses.dataclass
class Borrowed(Store):
    """Another process's folder: fits are read in it, and those that are made are handed over.

    Attributes:
      made: (key, arrays) of each.
    """

    made: list[tuple[str, Arrays]] = dataclasses.field(default_factory=list)

    def __post_init__(self):
        """Leaves alone what others are writing."""

    def keep(self, key: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Puts arrays aside."""
        if self.folder is not None:
            self.made.append((key, dict(arrays)))


def versions() -> str:
    """A fingerprint of what makes fits: the package's own code and the engines under it."""
    root = Path(__file__).parent.parent
    code = [path.read_bytes() for path in sorted(root.rglob("*.py"))]
    return fingerprint(
        [hashlib.sha256(text).hexdigest() for text in code], mujoco.__version__, np.__version__, jax.__version__
    )


def fingerprint(*parts: object) -> str:
    """Of arrays, texts, numbers, hypotheses, and lists of them."""
    state = hashlib.sha256()
    for token in _tokens(parts):
        state.update(len(token).to_bytes(8, "little"))
        state.update(token)
    return state.hexdigest()[:40]


def _tokens(part: object) -> Iterable[bytes]:
    if isinstance(part, Fit):
        yield from _tokens((part.hypothesis, part.z, part.cost, part.jacobian))
    elif isinstance(part, np.ndarray):
        yield f"{part.dtype} {part.shape}".encode()
        yield np.ascontiguousarray(part).tobytes()
    elif isinstance(part, Hypothesis):
        yield repr(part.space).encode()
        yield from _tokens(part.slack)
        for n in part.nodes:
            yield from _tokens((n.target, n.frame, n.state, n.sigma))
        for t in part.terms:
            numbers = (t.centre, t.width, t.low, t.high, t.free, t.places, t.excused, t.pivot)
            yield from _tokens((t.name, t.target, *numbers))
    elif isinstance(told := getattr(part, "parts", None), tuple):
        # Of several clips.
        yield from _tokens((getattr(part, "z", None), told))
    elif isinstance(part, tuple | list):
        yield f"{len(part)}".encode()
        for one in part:
            yield from _tokens(one)
    else:
        yield repr(part).encode()


# --- fits -------------------------------------------------------------------------------------------------------------

_KEPT = ("z", "cost", "data", "jacobian", "residual", "evidence", "ended")
Method = TypeVar("Method", bound=Callable[..., Any])


def packed(fit: Fit, suffix: str) -> Arrays:
    """A fit's numbers, under names that end with ``suffix``."""
    return {name + suffix: np.asarray(getattr(fit, name)) for name in _KEPT}


def unpacked(hypothesis: Hypothesis, arrays: Arrays, suffix: str) -> Fit:
    """The fit again."""
    z, cost, data, jacobian, residual, evidence, ended = (arrays[name + suffix] for name in _KEPT)
    return Fit(hypothesis, z, float(cost), float(data), jacobian, residual, float(evidence), bool(ended))


def remembered(method: Method) -> Method:
    """Makes a method that fits a hypothesis, or goes on from a fit, look into the store of its object first.

    The object has ``store``, ``state()``, ``pack``, ``unpack``, ``counted()`` and ``count``, as ``ClipFit`` has.
    """

    @functools.wraps(method)
    def look(self, first, *args, **kwargs):
        if self.store.folder is None:
            return method(self, first, *args, **kwargs)
        key = fingerprint(method.__name__, self.state(), first, args, sorted(kwargs.items(), key=lambda kv: kv[0]))
        found = self.store.recall(key)
        if found is not None:
            self.count(found["rollouts"])
            return self.unpack(getattr(first, "hypothesis", first), found)
        before = self.counted()
        fit = method(self, first, *args, **kwargs)
        self.store.keep(key, {**self.pack(fit), "rollouts": self.counted() - before})
        return fit

    return look  # type: ignore[return-value]
