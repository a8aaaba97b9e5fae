"""Jobs by scene kind, so that a process compiles a kind's programs once and then works through its clips."""

from __future__ import annotations

import zipfile
from collections import deque
from collections.abc import Collection, Hashable, Iterable
from pathlib import Path

import numpy as np

from mjx_refine.many.jobs import Job
from mjx_refine.scene import Samples
from mjx_refine.search.problem import kind_of_scene

_READERS = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}

Kind = Hashable
"""Jobs of one kind run the same programs: shapes, effects, frames, size of the pictures, masks or none."""


def kind_of_job(samples: Samples, video: Path) -> Kind:
    """The kind of a job; a clip that cannot be read is of a kind of its own, and whoever works on it says why."""
    return frozenset(kind_of_scene(scene) for scene in samples.scenes), _clip_kind(video)


def _clip_kind(video: Path) -> tuple | None:
    """(shape of the flow, whether there are masks), from the file's header alone."""
    try:
        with zipfile.ZipFile(video) as archive, archive.open("flow.npy") as stream:
            shape, _, _ = _READERS[np.lib.format.read_magic(stream)[0]](stream)
            return shape, "masks.npy" in archive.namelist()
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, RuntimeError):
        return None


class Waiting:
    """Jobs that wait for a worker, by kind.

    Args:
      jobs: with their kinds, in the order in which jobs of one kind are taken.
    """

    def __init__(self, jobs: Iterable[tuple[Job, Kind]]):
        self._kinds: dict[Kind, deque[Job]] = {}
        for job, kind in jobs:
            self._kinds.setdefault(kind, deque()).append(job)

    def __len__(self) -> int:
        return sum(len(jobs) for jobs in self._kinds.values())

    def take(self, last: Kind | None, busy: Collection[Kind]) -> tuple[Job, Kind]:
        """The next job for a worker, with its kind.

        Of the kind that the worker had last; else of one that nobody works on, the most numerous first, since the two
        would compile the same programs side by side; else of the kind with the most jobs left.
        """
        kinds = [kind for kind, jobs in self._kinds.items() if jobs]
        kind = max(kinds, key=lambda kind: (kind == last, kind not in busy, len(self._kinds[kind])))
        return self._kinds[kind].popleft(), kind

    def put_back(self, job: Job, kind: Kind) -> None:
        """Returns a job that nobody has begun."""
        self._kinds.setdefault(kind, deque()).appendleft(job)

    def __iter__(self):
        return (job for jobs in self._kinds.values() for job in jobs)
