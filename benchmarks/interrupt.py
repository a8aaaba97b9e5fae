"""`python -m benchmarks.interrupt`: kills `refine` at random moments and resumes it; the result must be the same, byte for
byte, as of a run that nobody interrupted, and no file that it leaves may be half-written."""

from __future__ import annotations

import csv
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from PIL import Image

from mjx_refine.scene import load_scene

ROOT = Path(__file__).parent.parent
PROGRAM = "from mjx_refine.cli import main; main()"


@dataclass(frozen=True)
class Call:
    """Arguments of a refinement."""

    init: Path
    video: Path
    population: int
    iterations: int
    seed: int = 0

    def start(self, out: Path, resume: bool) -> subprocess.Popen:
        """Starts `refine` in a process of its own."""
        arguments = ["--init", self.init, "--video", self.video, "--out", out, "--population", self.population]
        arguments += ["--iterations", self.iterations, "--seed", self.seed, *(["--resume"] if resume else [])]
        path = os.pathsep.join(os.path.abspath(entry or ".") for entry in sys.path)
        return subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *map(str, arguments)],
            env={**os.environ, "PYTHONPATH": path},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )


def finish(process: subprocess.Popen) -> None:
    """Waits for the end of a run.

    Raises:
      RuntimeError: it failed.
    """
    _, said = process.communicate()
    if process.returncode != 0:
        raise RuntimeError(f"refine ended with status {process.returncode}: {said[-2000:]}")


def check_file(path: Path) -> None:
    """Reads a file of a result to its end.

    Raises:
      Exception: of any kind: it is not whole.
    """
    if path.suffix == ".npz":
        # numpy leaves a truncated file open that it opened itself.
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as archive:
            for key in archive.files:
                archive[key]
    elif path.suffix == ".json":
        json.loads(path.read_text())
    elif path.suffix == ".yaml":
        load_scene(path)
    elif path.suffix == ".csv":
        text = path.read_text()
        rows = list(csv.reader(text.splitlines()))
        if not text.endswith("\n") or len({len(row) for row in rows}) != 1:
            raise ValueError(f"{path}: rows of different lengths")
    elif path.suffix == ".html":
        if not path.read_text().rstrip().endswith("</html>"):
            raise ValueError(f"{path}: no end")
    elif path.suffix == ".gif":
        with Image.open(path) as picture:
            for frame in range(picture.n_frames):  # type: ignore[attr-defined]
                picture.seek(frame)
                picture.load()
    else:
        raise ValueError(f"{path}: a file that nobody expects")


def check_folder(folder: Path) -> tuple[int, int]:
    """Reads every file in a folder; returns how many are whole and how many are temporary ones of a killed process."""
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    left = [path for path in paths if path.name.startswith(".") and path.suffix == ".part"]
    for path in paths:
        if path not in left:
            check_file(path)
    return len(paths) - len(left), len(left)


def numbers(folder: Path) -> dict:
    """What `result.json` says, times aside."""
    result = json.loads((folder / "result.json").read_text())
    result.pop("seconds")
    return result


@dataclass
class Report:
    """What happened: kills, of them those that left temporary files, rounds, files read after kills, seconds."""

    kills: int = 0
    parts: int = 0
    rounds: int = 0
    files: int = 0
    seconds: float = 0.0


def interrupt(call: Call, folder: Path, kills: int, seed: int = 0, echo=click.echo) -> Report:
    """Kills runs at ``kills`` random moments, resumes each, and compares with an uninterrupted run.

    Raises:
      RuntimeError: a run failed, or its result differs.
      Exception: a file was not whole.
    """
    report, dice, began = Report(), random.Random(seed), time.monotonic()
    start = time.monotonic()
    finish(call.start(folder / "whole", False))
    span = time.monotonic() - start
    check_folder(folder / "whole")
    expected = (folder / "whole" / "refined.yaml").read_bytes()
    echo(f"uninterrupted: {span:.1f} s")
    while report.kills < kills:
        report.rounds += 1
        out, resume = folder / f"round{report.rounds}", False
        while report.kills < kills:
            # Not before Python has started, which would test nothing.
            moment = dice.uniform(0.1 * span, span)
            start, process = time.monotonic(), call.start(out, resume)
            try:
                process.wait(moment)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
                report.kills += 1
                whole, left = check_folder(out)
                report.files, report.parts = report.files + whole, report.parts + (left > 0)
                echo(
                    f"kill {report.kills} after {moment:.1f} s (round {report.rounds}): {whole} files whole, {left} temporary"
                )
                resume = True
            else:
                # Faster than before: later moments are drawn from what a run takes now.
                span = span if resume else min(span, time.monotonic() - start)
                break
        else:
            process = call.start(out, resume)
        finish(process)
        check_folder(out)
        if left_over := [path.name for path in out.iterdir() if path.suffix == ".part"]:
            raise RuntimeError(f"round {report.rounds}: temporary files are left: {left_over}")
        if (out / "refined.yaml").read_bytes() != expected or numbers(out) != numbers(folder / "whole"):
            raise RuntimeError(f"round {report.rounds}: another result than without interruption")
        echo(f"round {report.rounds}: refined.yaml is the same, byte for byte")
    report.seconds = time.monotonic() - began
    return report


@click.command()
@click.option("--kills", default=10, show_default=True)
@click.option("--seed", default=0, show_default=True, help="Of the moments.")
@click.option("--population", default=32, show_default=True)
@click.option("--iterations", default=12, show_default=True)
def main(kills: int, seed: int, population: int, iterations: int) -> None:
    """Kills and resumes `refine` on the example clip."""
    example = ROOT / "examples" / "clip"
    call = Call(example / "best32.yaml", example / "flows.npz", population, iterations)
    with tempfile.TemporaryDirectory() as folder:
        report = interrupt(call, Path(folder), kills, seed)
    click.echo(
        f"{report.kills} kills in {report.rounds} runs, {report.seconds:.0f} s: every result the same as uninterrupted, "
        f"{report.files} files read after kills, all whole; temporary files after {report.parts} kills, removed by the next run"
    )


if __name__ == "__main__":
    main()
