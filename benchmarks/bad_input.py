"""`python -m benchmarks.bad_input`: every wrong input ends with status 2, one helpful line, and nothing left behind.

`--fuzz SECONDS` throws random texts and YAML at the scene reader, which may raise nothing but InputError.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import yaml
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

import mjx_refine.observe.video  # noqa: F401  before OpenCV opens a video: it quietens FFmpeg
from benchmarks.bad_calls import CALLS
from benchmarks.bad_cases import OBSERVATIONS, SCENES, Case, good_files, scene_text
from mjx_refine.cli.main import run
from mjx_refine.errors import InputError
from mjx_refine.scene import dump_scene, parse_scenes

CASES = [*SCENES, *OBSERVATIONS, *CALLS]
# What tells the reader what to do.
REMEDY = re.compile(
    r"expected|remove|correct|write|add|choose|see `|name a|rename|make it|lower|split|install|keep one|is not in the range"
    r"|is not one of|separate|run again|export it|--masks (names|expects)"
)


@dataclass(frozen=True)
class Outcome:
    """How a call ended: exit status, what it wrote to stderr, what it left in the folder, seconds, and what is wrong
    with that."""

    status: int
    said: str
    left: tuple[str, ...]
    seconds: float
    faults: tuple[str, ...]


@contextlib.contextmanager
def _stderr_to(file: Path) -> Iterator[None]:
    """Catches Python's stderr and the C libraries' as well."""
    sys.stderr.flush()
    saved, old = os.dup(2), sys.stderr
    with open(file, "w") as stream:
        os.dup2(stream.fileno(), 2)
        sys.stderr = stream
        try:
            yield
        finally:
            stream.flush()
            sys.stderr = old
            os.dup2(saved, 2)
            os.close(saved)


def listing(folder: Path) -> dict[str, tuple[int, int]]:
    """Every path under a folder with its size and time of change."""
    paths = [p for p in folder.rglob("*") if not p.is_dir() or p.is_symlink()]
    found = {str(p.relative_to(folder)): (p.lstat().st_size, p.lstat().st_mtime_ns) for p in paths}
    return found | {str(p.relative_to(folder)) + "/": (0, 0) for p in folder.rglob("*") if p.is_dir()}


def try_case(case: Case, folder: Path) -> Outcome:
    """Runs a case in this process, in an empty folder (created here) that is the working directory meanwhile."""
    folder.mkdir(parents=True)
    good_files(folder)
    arguments = case.make(folder)
    before, here, start = listing(folder), Path.cwd(), time.monotonic()
    with tempfile.TemporaryDirectory() as elsewhere:
        os.chdir(folder)
        try:
            with _stderr_to(Path(elsewhere) / "stderr"):
                status = run(arguments)
        finally:
            os.chdir(here)
        said = (Path(elsewhere) / "stderr").read_text()
    seconds = time.monotonic() - start
    after = listing(folder)
    left = tuple(sorted(p for p in before.keys() | after.keys() if before.get(p) != after.get(p)))
    return Outcome(status, said, left, seconds, tuple(_faults(case, status, said, left)))


def _faults(case: Case, status: int, said: str, left: tuple[str, ...]) -> list[str]:
    faults = [] if status == 2 else [f"status {status}"]
    if said.count("\n") != 1 or not said.endswith("\n") or not said.startswith("refine: "):
        faults.append("not one line")
    if len(said) > 1000:
        faults.append(f"{len(said)} characters")
    if any(not c.isprintable() for c in said.rstrip("\n")):
        faults.append("control characters")
    faults += [f"does not say {pattern!r}" for pattern in case.says if not re.search(pattern, said)]
    if not REMEDY.search(said):
        faults.append("no remedy")
    return faults + [f"touched {path}" for path in left]


WORDS = st.sampled_from(
    [
        "type",
        "name",
        "size",
        "radius",
        "height",
        "state",
        "physics",
        "position",
        "orientation",
        "linear_velocity",
        "friction",
        "mass",
        "damping",
        "fovy",
        "camera",
        "gravity",
        "effect",
        "target",
        "parameters",
        "box",
        "sphere",
        "cylinder",
        "drag",
        "box_0",
    ]
)
SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=8),
    st.binary(max_size=4),
    st.dates(),
    st.just(10**400),
    WORDS,
)
TREES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(SCALARS, inner, max_size=5),
    max_leaves=25,
)
PIECES = st.sampled_from(
    [
        *("- ", ": ", "\n", "\n  ", "[", "]", "{", "}", "&a ", "*a", "!!", "!!python/name:os.system", "<<: ", "---\n"),
        *("|\n", ">\n", "? ", "'", '"', "#", "%YAML 9.9\n", "@", "\0", "\x85", "\ud800", "\t", "\ufeff", "é"),
        *("<think>", "</think>", "<answer>", "</answer>", "```", "type", "box", "1e-3", "nan", ".inf", "-.5", "1:30"),
        *("0x" + "f" * 5000, "9" * 5000, "2001-99-99"),
    ]
)
LEAVES = [
    (0, "size"),
    (0, "name"),
    (0, "type"),
    (0, "state"),
    (0, "state", "position"),
    (0, "state", "orientation"),
    (0, "physics"),
    (0, "physics", "friction"),
    (0, "physics", "mass"),
    (1, "radius"),
    (2, "fovy"),
    (2, "position"),
    (3, "gravity"),
    (4, "parameters"),
    (4, "target"),
]


@st.composite
def mutated(draw: st.DrawFn) -> str:
    """A sound scene's text, cut, doubled and spoiled at a few places."""
    text = scene_text(extra=[{"type": "effect", "effect": "drag", "target": "box_0", "parameters": {"linear": 0.1}}])
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(text)))
        end = min(len(text), start + draw(st.integers(0, 30)))
        text = text[:start] + draw(PIECES | st.text(max_size=4) | st.just(text[start:end] * 2)) + text[end:]
    return text


@st.composite
def replaced(draw: st.DrawFn) -> str:
    """A sound scene with values replaced by anything that YAML can hold."""
    effect = {"type": "effect", "effect": "drag", "target": "box_0", "parameters": {"linear": 0.1}}
    entries: Any = yaml.safe_load(scene_text(extra=[effect]))
    for _ in range(draw(st.integers(1, 3))):
        *parents, last = draw(st.sampled_from(LEAVES))
        place = entries
        with contextlib.suppress(TypeError, KeyError, IndexError):
            for parent in parents:
                place = place[parent]
            place[last] = draw(TREES)
    return yaml.safe_dump(entries, sort_keys=False)


TEXTS = st.one_of(
    mutated(),
    replaced(),
    st.text(),
    st.lists(PIECES, max_size=30).map("".join),
    TREES.map(lambda tree: yaml.safe_dump(tree)),
)


def attempt(text: str) -> bool:
    """Reads a text; whether it holds a scene. What is read is written and read again as the same.

    Raises:
      AssertionError: it is not; anything else: the reader's fault.
    """
    try:
        samples = parse_scenes(text, "fuzz.yaml")
    except InputError as error:
        message = str(error)
        if "\n" in message or len(message) > 1000 or not message.startswith("fuzz.yaml"):
            raise AssertionError(f"no message for a user: {message[:300]!r}") from error
        return False
    for scene in samples.scenes:
        if parse_scenes(dump_scene(scene)).scenes != (scene,):
            raise AssertionError(f"not the same when read again: {scene}")
    return True


def fuzz(seconds: float, number: int = 0) -> tuple[int, int]:
    """Tries texts for some seconds from the first on; returns how many, and how many of them held a scene."""
    counts = [0, 0]
    end = math.inf
    while time.monotonic() < end:

        @seed(number)
        @settings(
            max_examples=300,
            database=None,
            deadline=None,
            phases=[Phase.generate, Phase.shrink],
            suppress_health_check=list(HealthCheck),
        )
        @given(TEXTS)
        def trial(text: str) -> None:
            nonlocal end
            # What makes texts reads its tables before the first, which takes seconds on a busy machine.
            end = min(end, time.monotonic() + seconds)
            if time.monotonic() < end:
                counts[1] += attempt(text)
                counts[0] += 1

        trial()
        number += 1
    return counts[0], counts[1]


@click.command()
@click.option(
    "--fuzz", "fuzz_seconds", type=float, default=0.0, help="Throw random texts at the scene reader so long [s]."
)
@click.option("--only", default="", help="Run the cases whose name holds this.")
def main(fuzz_seconds: float, only: str) -> None:
    """Runs every case, prints the table and the count."""
    failed, cases = 0, [case for case in CASES if only in case.name]
    with tempfile.TemporaryDirectory() as folder:
        for i, case in enumerate(cases):
            outcome = try_case(case, Path(folder) / str(i))
            failed += bool(outcome.faults)
            click.echo(f"{'FAULT' if outcome.faults else 'ok':5} {outcome.seconds:5.2f} s  {case.name}")
            click.echo(f"               {outcome.said.strip()[:400]}")
            for fault in outcome.faults:
                click.echo(f"      FAULT    {fault}")
    click.echo(
        f"{len(cases) - failed} of {len(cases)} wrong inputs end with status 2, one line, and nothing left behind"
    )
    if fuzz_seconds:
        start = time.monotonic()
        tried, scenes = fuzz(fuzz_seconds)
        click.echo(
            f"{tried} random texts in {time.monotonic() - start:.0f} s: {scenes} scenes that round-trip, "
            f"{tried - scenes} InputErrors, nothing else"
        )
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
