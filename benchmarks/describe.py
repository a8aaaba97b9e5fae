"""`python -m benchmarks.describe --count 1000`: random scenes described, read back, and held against their simulation.

Prints how many sentences were read and how many statements were false (none should be). With ``--mutants`` every
description is also falsified in one place, and the falsehoods that nobody noticed are counted.
"""

from __future__ import annotations

import argparse
import platform
import re
import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from benchmarks.clips.scenes import KINDS, draw_scene
from mjx_refine.describe import Description, Fault, describe, faults, parse_sentences, record
from mjx_refine.describe.classes import DIRECTIONS, PACES, PLACES
from mjx_refine.describe.describe import written
from mjx_refine.describe.parse import parse_description
from mjx_refine.errors import InputError
from mjx_refine.scene import Scene, scene_from_entries

GROUPS = (*PLACES.values(), tuple(word for word, _ in PACES), DIRECTIONS)
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?![\w.]*\d)")
_NAME = re.compile(r"[a-z]+_\d+")


@dataclass
class Tally:
    """What was counted: scenes, sentences, kinds of statements, faults, mutants, and mutants that nobody noticed."""

    scenes: int = 0
    sentences: int = 0
    kinds: Counter = field(default_factory=Counter)
    faults: list[tuple[int, Fault]] = field(default_factory=list)
    mutants: int = 0
    unnoticed: list[tuple[int, str]] = field(default_factory=list)
    refused: int = 0


def random_scene(seed: int, most: int = 4) -> Scene:
    """A scene of one to ``most`` objects in one of six kinds of motion."""
    rng = np.random.default_rng(seed)
    kind = str(rng.choice(KINDS))
    objects = int(rng.integers(2 if kind == "collision" else 1, most + 1))
    return scene_from_entries(draw_scene(rng, kind, objects))


def run(count: int, seed: int, size: tuple[int, int], mutants: int, most: int = 4) -> Tally:
    """Describes ``count`` scenes and checks each description against a simulation of its own answer."""
    tally = Tally()
    for number in range(seed, seed + count):
        try:
            description = describe(random_scene(number, most), size=size, seed=number)
        except InputError:
            tally.refused += 1
            continue
        parsed, scene = parse_description(description.text)
        if parsed.statements != description.statements:
            tally.faults.append((number, Fault("the whole", "what was read is not what was told")))
        tally.scenes += 1
        tally.sentences += len(parsed.sentences)
        tally.kinds.update(type(told).__name__ for told in parsed.statements)
        tally.faults += [(number, fault) for fault in faults(parsed, record(scene, size=size))]
        rng = np.random.default_rng(number)
        for _ in range(mutants):
            mutant = falsified(description, rng)
            tally.mutants += 1
            if not faults(parse_sentences(mutant), description.record):
                tally.unnoticed.append((number, mutant))
    return tally


def falsified(description: Description, rng: np.random.Generator) -> str:
    """One statement of a description, with one number (by 0.03, or by 1) or one class of it changed."""
    while True:
        statement = description.statements[rng.integers(len(description.statements))]
        sentence = written([statement], rng)
        changes = [m for m in _NUMBER.finditer(sentence)]
        words = [(group, word) for group in GROUPS for word in group if re.search(rf"\b{re.escape(word)}\b", sentence)]
        if words and (not changes or rng.random() < 0.5):
            group, word = max(words, key=lambda pair: len(pair[1]))
            other = str(rng.choice([one for one in group if one != word]))
            return sentence.replace(word, other, 1)
        if changes:
            match = changes[rng.integers(len(changes))]
            more = float(rng.choice([-1, 1])) * (0.03 if "." in match[0] else 1)
            number = f"{float(match[0]) + more:.{2 if '.' in match[0] else 0}f}"
            return sentence[: match.start()] + number + sentence[match.end() :]


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000, help="scenes")
    parser.add_argument("--seed", type=int, default=0, help="of the first scene")
    parser.add_argument("--size", default="240x160", help="of the pictures in which objects are seen or not")
    parser.add_argument("--mutants", type=int, default=0, help="falsified sentences a scene")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    began = time.perf_counter()
    tally = run(options.count, options.seed, (width, height), options.mutants)
    for number, fault in tally.faults[:20]:
        print(f"scene {number}: {fault.said!r}: {fault.reason}")
    for number, mutant in tally.unnoticed[:20]:
        print(f"scene {number}: not noticed: {mutant!r}")
    print(", ".join(f"{kind} {n}" for kind, n in tally.kinds.most_common()))
    print(
        f"{tally.scenes} scenes ({tally.refused} could not be simulated), {tally.sentences} sentences read, "
        f"{len(tally.faults)} false; {tally.mutants} mutants, {len(tally.unnoticed)} not noticed; "
        f"{time.perf_counter() - began:.0f} s; {platform.machine()}"
    )


if __name__ == "__main__":
    main()
