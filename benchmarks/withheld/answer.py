"""Has the exam answered: one `refine diagnose` a clip. It sees the clips' folder and nothing else of the exam."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from mjx_refine.files import write_text

REFINE = (sys.executable, "-c", "from mjx_refine.cli.main import main; main()")


def clips(exam: Path) -> list[Path]:
    """The clips' folders, in order."""
    return sorted(path for path in (exam / "clips").iterdir() if path.is_dir())


def call(clip: Path, out: Path, refine: Sequence[str] = REFINE, alone: bool = False) -> list[str]:
    """The command line that diagnoses a clip, or all of its set-up."""
    names = (clip / "without.txt").read_text().split()
    files = ["--init", str(clip / "init.yaml"), "--video", str(clip / "flows.npz")]
    for more in [] if alone else sorted(clip.glob("flows_*.npz")):
        files += [
            "--init",
            str(clip / more.name.replace("flows", "init").replace(".npz", ".yaml")),
            "--video",
            str(more),
        ]
    files += ["--out", str(out)]
    return [*refine, "diagnose", *files, "--seed", "0", *(word for name in names for word in ("--without", name))]


def answered(folder: Path) -> bool:
    """Whether a clip's answer stands."""
    try:
        ran = json.loads((folder / "answer.json").read_text())["status"] == 0
    except (OSError, ValueError, KeyError):
        return False
    return ran and (folder / "diagnosis.json").exists()


def answer_clip(clip: Path, out: Path, refine: Sequence[str] = REFINE, alone: bool = False) -> dict[str, Any]:
    """Diagnoses a clip in a process of its own; writes `answer.json`: exit status, seconds, peak memory."""
    out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with (out / "log.txt").open("wb") as log:
        process = subprocess.Popen(call(clip, out, refine, alone), stdout=log, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    result = {
        "clip": clip.name,
        "status": process.returncode,
        "seconds": round(time.perf_counter() - start, 2),
        "peak_mb": round(usage.ru_maxrss / 1024, 1),
    }
    write_text(out / "answer.json", json.dumps(result) + "\n")
    return result


def answer(
    exam: Path, out: Path, jobs: int = 1, refine: Sequence[str] = REFINE, alone: bool = False
) -> Iterator[dict[str, Any]]:
    """Answers every clip that has no standing answer yet; yields each result as it comes."""
    missing = [clip for clip in clips(exam) if not answered(out / clip.name)]
    with ThreadPoolExecutor(jobs) as pool:
        for done in as_completed([pool.submit(answer_clip, clip, out / clip.name, refine, alone) for clip in missing]):
            yield done.result()
