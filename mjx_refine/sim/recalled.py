"""Rollouts that are asked for again: kept for a while, since searches come back to where they were."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mjx_refine.batch import SceneBatch
from mjx_refine.effects.registry import acting_kind
from mjx_refine.sim.backends import Restarting

KEPT = 64 << 20
"""Bytes of poses that a process keeps; what was asked for longest ago goes first."""

_SEEN = {"camera_position", "camera_pitch", "camera_fovy"}


class Memory:
    """Poses by fingerprints of what they were asked for with, the latest of them.

    Args:
      most: bytes of poses that are kept.
    """

    def __init__(self, most: int = KEPT):
        self.most = most
        self._poses: OrderedDict[str, np.ndarray] = OrderedDict()
        self._bytes, self._lock = 0, threading.Lock()
        self._folder: Path | None = None

    def share(self, folder: Path | None) -> None:
        """From now on keeps poses in a folder as well, where others that share it find them; None: no more."""
        self._folder = folder

    def recall(self, key: str) -> np.ndarray | None:
        """What was kept under ``key``, here or by others, if it still is."""
        with self._lock:
            if key in self._poses:
                self._poses.move_to_end(key)
                return self._poses[key]
        if self._folder is None:
            return None
        try:
            return np.load(self._folder / f"{key}.npy", allow_pickle=False)
        except (OSError, ValueError, EOFError):
            return None

    def keep(self, key: str, poses: np.ndarray) -> None:
        """Keeps poses, which are not to be written to any more, and gives up the oldest where they are too many."""
        poses.flags.writeable = False
        if poses.nbytes > self.most:
            return
        with self._lock:
            if key in self._poses:
                return
            self._poses[key] = poses
            self._bytes += poses.nbytes
            gone = []
            while self._bytes > self.most:
                gone.append(self._poses.popitem(last=False))
                self._bytes -= gone[-1][1].nbytes
        folder = self._folder
        if folder is None:
            return
        try:
            for name, _ in gone:
                (folder / f"{name}.npy").unlink(missing_ok=True)
            part = folder / f"{key}.{os.getpid()}.part"
            with open(part, "wb") as stream:
                np.save(stream, poses)
            part.replace(folder / f"{key}.npy")
        except OSError:  # a full disk, or a folder that is gone: everyone for himself
            self._folder = None


PROCESS = Memory()
"""Of all simulators in this process."""


class Recalling:
    """A simulator that gives rollouts that it, or another like it, made lately again for a batch that moves in the same way.

    Least squares that go on where others ended, and effects that only change how a scene is seen, ask for the same rollouts
    as the fit before them.

    Args:
      simulator: that makes them; the same batch must always give the same poses, with any number of threads.
      memory: where they are kept; the process's own by default.
    """

    def __init__(self, simulator: Restarting, memory: Memory | None = None):
        self.simulator, self.memory = simulator, memory or PROCESS
        self.name, self.device = simulator.name, simulator.device
        self.shapes, self.fps = simulator.shapes, simulator.fps
        self.recalled = 0
        """Calls that were answered with poses that were there."""

    def rollout(self, batch: SceneBatch, frames: int) -> Float[np.ndarray, "batch frames objects 7"]:
        """As the simulator's; not to be written to."""
        if batch.restarts:
            return self.shot(batch, frames)[0]
        return self._remembered(batch, frames, self.simulator.rollout)

    def shot(self, batch: SceneBatch, frames: int) -> tuple[np.ndarray, np.ndarray]:
        """As the simulator's; not to be written to."""

        def made(moving: SceneBatch, frames: int) -> np.ndarray:
            return np.concatenate([part.reshape(len(moving), -1) for part in self.simulator.shot(moving, frames)], 1)

        found, count = self._remembered(batch, frames, made), len(batch.restarts)
        poses, arrived = np.split(found, [found.shape[1] - 13 * count], 1)
        return poses.reshape(len(batch), frames, -1, 7), arrived.reshape(len(batch), count, 13)

    def _remembered(self, batch: SceneBatch, frames: int, made: Callable[[SceneBatch, int], np.ndarray]) -> np.ndarray:
        """What was kept of a batch that moves in the same way, or what is made of it now."""
        acting = tuple(e for e in batch.effects if (kind := acting_kind(e.name)).physical or kind.retimes)
        moving = dataclasses.replace(batch, effects=acting)
        key = self._key(moving, frames)
        found = self.memory.recall(key)
        if found is not None:
            self.recalled += 1
            return found
        told = made(moving, frames)
        self.memory.keep(key, told)
        return told

    def _key(self, batch: SceneBatch, frames: int) -> str:
        """A fingerprint of all that a rollout depends on."""
        state = hashlib.blake2b(
            f"{self.name} {self.device} {self.fps!r} {frames} {len(batch)}".encode(), digest_size=16
        )
        for part in _parts(batch):
            state.update(part)
        return state.hexdigest()


def _parts(batch: SceneBatch) -> Iterator[bytes]:
    yield repr(batch.shapes).encode()
    for field in dataclasses.fields(batch):
        value = getattr(batch, field.name)
        if isinstance(value, np.ndarray) and field.name not in _SEEN:
            yield np.ascontiguousarray(value).tobytes()
    for effect in batch.effects:
        yield f"{effect.name} {effect.target} {effect.values.shape}".encode()
        yield np.ascontiguousarray(effect.values).tobytes()
    for one in batch.restarts:
        yield f"{one.frame} {one.target}".encode()
        yield np.ascontiguousarray(one.state).tobytes()
