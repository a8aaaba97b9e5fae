"""The same jobs on a Ray cluster of this machine, one of whose workers is killed."""

import csv
import importlib.util
import json
import os
import subprocess
import sys

import pytest
from many_clips import TINY, job_of, tiny_clip

from mjx_refine.errors import InputError
from mjx_refine.many import refine_many
from mjx_refine.many.ray import _needs
from mjx_refine.many.work import work
from mjx_refine.search import Options

PROGRAM = """
import json, os, signal, sys
from pathlib import Path
from many_clips import TINY, job_of
from mjx_refine.many import ManyProgress, refine_many

clips, out = Path(sys.argv[1]), Path(sys.argv[2])


def processes(title):
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and (entry / "cmdline").read_bytes().rstrip(b"\\0 ").decode() == title:
                yield int(entry.name)
        except OSError:
            continue


class Killer(ManyProgress):
    killed = []

    def update(self, finished, total, part, running):
        if not self.killed and "a" in running and (out / "a/checkpoint.npz").exists():
            for process in processes("ray::a"):
                os.kill(process, signal.SIGKILL)
                self.killed.append(process)


many = refine_many([job_of(clips / name) for name in "abc"], TINY, out=out, engine="ray", workers=2, progress=Killer())
print(json.dumps([Killer.killed, [[o.name, o.status, o.reason] for o in many.outcomes], many.status]))
"""


@pytest.mark.slow
def test_a_killed_worker_costs_no_clip(tmp_path):
    pytest.importorskip("ray")
    for name, shift in (("a", 0.0), ("b", 0.2), ("c", -0.2)):
        tiny_clip(tmp_path / "clips" / name, shift)
    out = tmp_path / "out"
    path = os.pathsep.join(os.path.abspath(entry or ".") for entry in sys.path)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path / "clips"), str(out)], capture_output=True, text=True, timeout=400,
        env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    killed, outcomes, status = json.loads(done.stdout.splitlines()[-1])
    assert len(killed) == 1
    assert outcomes == [["a", "done", ""], ["b", "done", ""], ["c", "done", ""]]
    assert status == 0
    with open(out / "summary.csv") as stream:
        assert [row["name"] for row in csv.DictReader(stream)] == ["a", "b", "c"]
    with open(out / "a/history.csv") as stream:
        steps = [(row["phase"], row["iteration"]) for row in csv.DictReader(stream)]
    assert len(set(steps)) == len(steps)
    # As if nobody had been killed, and as without Ray.
    assert work(job_of(tmp_path / "clips/a"), tmp_path / "alone", TINY).status == "done"
    assert (out / "a/refined.yaml").read_bytes() == (tmp_path / "alone/a/refined.yaml").read_bytes()


def test_without_ray_it_is_told_what_to_install(tmp_path, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *a: None if name == "ray" else find(name, *a))
    with pytest.raises(InputError, match=r"ray is not installed; pip install 'mjx-refine\[ray\]'"):
        refine_many([job_of(tiny_clip(tmp_path / "a"))], TINY, out=tmp_path / "out", engine="ray")


def test_a_task_takes_a_core_and_a_gpu_where_there_is_one():
    assert _needs(Options(), {"CPU": 8.0}) == {"num_cpus": 1}
    assert _needs(Options(), {"CPU": 8.0, "GPU": 2.0}) == {"num_cpus": 1, "num_gpus": 1}
    assert _needs(Options(backend="mujoco"), {"CPU": 8.0, "GPU": 2.0}) == {"num_cpus": 1}
