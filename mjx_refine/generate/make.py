"""Records by number: proposals pass the filters in turn until one passes all."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import time
from collections.abc import Iterator, Sequence

import numpy as np

from mjx_refine.batch import batch_from_scenes
from mjx_refine.errors import InputError
from mjx_refine.generate.options import LEAST_PIXELS, GenerateOptions
from mjx_refine.generate.physics import Motion, RecordingSimulator
from mjx_refine.generate.pictures import Clip, Pictures, draw_clips
from mjx_refine.generate.record import Record, members
from mjx_refine.generate.sample import Proposal, propose
from mjx_refine.generate.tiles import nearest
from mjx_refine.scene import Scene, Shape, dump_scene

FILTERS = ("overlap", "diverged", "camera", "outside", "pixels")
"""In the order in which they are asked: two objects overlap at the start by MuJoCo's collision detection; the simulation
diverges; an object comes within ``CLOSEST`` of the camera; more than one object is outside the view throughout; an object
has less than ``LEAST_PIXELS`` pixels in total."""

CLOSEST = 0.5
"""[m]"""

BLOCK = 128
"""Records, or proposals for them, that are worked on together."""

_MOST_ATTEMPTS = 5000


@dataclasses.dataclass
class Tally:
    """What was counted.

    Attributes:
      records: made.
      proposals: scenes proposed for them.
      rejected: by each filter.
      kinds: records by object types.
      seconds: of the parts of the work, by the clock.
      processor: seconds that processors worked for all of it.
    """

    records: int = 0
    proposals: int = 0
    rejected: collections.Counter = dataclasses.field(default_factory=collections.Counter)
    kinds: collections.Counter = dataclasses.field(default_factory=collections.Counter)
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    processor: float = 0.0

    def add(self, other: Tally) -> None:
        """Counts ``other`` too."""
        self.records += other.records
        self.proposals += other.proposals
        self.processor += other.processor
        self.rejected.update(other.rejected)
        self.kinds.update(other.kinds)
        for part, seconds in other.seconds.items():
            self.spent(part, seconds)

    def spent(self, part: str, seconds: float) -> None:
        """Adds to the time that ``part`` took."""
        self.seconds[part] = self.seconds.get(part, 0.0) + seconds

    def rates(self) -> dict[str, dict[str, float]]:
        """How many proposals each filter was asked about, and the share that passed it."""
        told, left = {}, self.proposals
        for name in FILTERS:
            passed = left - self.rejected[name]
            told[name] = {"seen": left, "passed": passed, "rate": passed / left if left else 1.0}
            left = passed
        return told

    @contextlib.contextmanager
    def timing(self, part: str) -> Iterator[None]:
        """Adds the time that the block takes to ``part``."""
        began = time.perf_counter()
        yield
        self.spent(part, time.perf_counter() - began)


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A proposal on its way through the filters; ``rejected`` names the one that it did not pass."""

    proposal: Proposal
    rejected: str | None = None
    motion: Motion | None = None
    clip: Clip | None = None
    pictures: Pictures | None = None


class Maker:
    """Makes records; what is compiled or built for one is kept for the others.

    Args:
      options: of all records.
    """

    def __init__(self, options: GenerateOptions):
        self.options = options
        self._simulators: dict[tuple[Shape, ...], RecordingSimulator] = {}

    def records(self, indices: Sequence[int], tally: Tally) -> Iterator[tuple[str, dict[str, bytes]]]:
        """(key, members) of every record, in order; a record depends on its number and the options alone.

        Raises:
          InputError: no scene passes the filters.
        """
        for begin in range(0, len(indices), BLOCK):
            block = indices[begin : begin + BLOCK]
            found = self._found(block, tally)
            for index in block:
                candidate = found.pop(index)
                record = self._record(index, candidate, tally)
                with tally.timing("packing"):
                    told = members(record)
                yield record.key, told

    def _found(self, indices: Sequence[int], tally: Tally) -> dict[int, Candidate]:
        """For each number the first of its proposals that passes."""
        found: dict[int, Candidate] = {}
        attempts = dict.fromkeys(indices, 0)
        while attempts:
            # The last records are tried for twice at once, since a round has costs of its own.
            ahead = 2 if len(attempts) <= 2 else 1
            with tally.timing("sampling"):
                asked = [(i, propose(self.options, i, a + k)) for i, a in attempts.items() for k in range(ahead)]
            judged = self._judged([proposal for _, proposal in asked], tally)
            for (index, _), candidate in zip(asked, judged, strict=True):
                if index in found:
                    continue
                tally.proposals += 1
                if candidate.rejected is None:
                    found[index] = candidate
                else:
                    tally.rejected[candidate.rejected] += 1
            attempts = {i: a + ahead for i, a in attempts.items() if i not in found}
            if any(a >= _MOST_ATTEMPTS for a in attempts.values()):
                raise InputError(
                    f"record {min(attempts)}: none of {_MOST_ATTEMPTS} scenes passes the filters; choose fewer objects"
                )
        return found

    def _judged(self, proposals: list[Proposal], tally: Tally) -> list[Candidate]:
        with tally.timing("physics"):
            candidates = self._simulated(proposals)
        with tally.timing("pictures"):
            left = [k for k, candidate in enumerate(candidates) if candidate.rejected is None]
            drawn = draw_clips([clip for k in left if (clip := candidates[k].clip) is not None])
            for k, pictures in zip(left, drawn, strict=True):
                small = pictures.pixels.min() < LEAST_PIXELS
                candidates[k] = dataclasses.replace(
                    candidates[k], pictures=pictures, rejected="pixels" if small else None
                )
        return candidates

    def _simulated(self, proposals: list[Proposal]) -> list[Candidate]:
        """All filters but the last; scenes of one kind together."""
        kinds: dict[tuple[Shape, ...], list[int]] = {}
        for k, proposal in enumerate(proposals):
            kinds.setdefault(proposal.scene.shapes, []).append(k)
        candidates = [Candidate(proposal, "overlap") for proposal in proposals]
        for shapes, places in kinds.items():
            if shapes not in self._simulators:
                self._simulators[shapes] = RecordingSimulator(shapes)
            simulator = self._simulators[shapes]
            batch = batch_from_scenes([proposals[k].scene for k in places])
            apart = np.nonzero(simulator.overlap(batch) <= 0)[0]
            if not len(apart):
                continue
            batch = batch[apart]
            for row, motion in enumerate(simulator.record(batch)):
                proposal = proposals[places[apart[row]]]
                clip = Clip(motion.qpos, batch, row)
                reason = _rejected(motion, clip)
                candidates[places[apart[row]]] = Candidate(proposal, reason, motion, None if reason else clip)
        return candidates

    def _record(self, index: int, candidate: Candidate, tally: Tally) -> Record:
        pictures, motion, scene = candidate.pictures, candidate.motion, candidate.proposal.scene
        if pictures is None or motion is None:
            raise RuntimeError(f"record {index} has no pictures")
        tally.records += 1
        tally.kinds[" ".join(scene.shapes)] += 1
        with tally.timing("packing"):
            text = dump_scene(candidate.proposal.written)
        record = Record(f"{index:08d}", text, pictures, motion)
        if not self.options.rgb:
            return record
        from mjx_refine.generate.rgb import film

        with tally.timing("rgb"):
            return dataclasses.replace(record, seen=film(record, self.options, index))


def _rejected(motion: Motion, clip: Clip) -> str | None:
    """The first filter between overlap and pixels that a motion does not pass, or a bound on pixels that is too low."""
    if not motion.finite:
        return "diverged"
    if nearest(motion.qpos, clip.batch, clip.row) < CLOSEST:
        return "camera"
    if np.count_nonzero(~clip.bounds.seen) > 1:
        return "outside"
    return "pixels" if clip.bounds.pixels.sum(1).min() < LEAST_PIXELS else None


def replayed(scene: Scene) -> tuple[Motion, Pictures]:
    """Simulates and draws a record's scene again; on one kind of machine nothing differs from the record."""
    batch = batch_from_scenes([scene])
    motion = RecordingSimulator(scene.shapes).record(batch)[0]
    return motion, next(draw_clips([Clip(motion.qpos, batch, 0)]))
