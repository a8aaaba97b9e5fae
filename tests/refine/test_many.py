"""Many clips: the same files as one by one; what fails stops no other; killed and resumed gives the same bytes."""

import csv
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from many_clips import TINY, TINY_CALL, job_of, tiny_clip

from mjx_refine.children import ONE_THREAD
from mjx_refine.cli.main import run
from mjx_refine.many import Job, ManyProgress, refine_many
from mjx_refine.many.work import work

FILES = ["checkpoint.npz", "history.csv", "overlay.gif", "refined.yaml", "report.html", "result.json"]


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("clips")
    return [tiny_clip(folder / name, shift) for name, shift in (("a", 0.0), ("b", 0.2))]


@pytest.fixture(scope="module")
def whole(clips, tmp_path_factory):
    """Both clips refined, with two jobs among them that cannot be: (folder, what ``refine_many`` returned)."""
    out = tmp_path_factory.mktemp("whole")
    (out / "damaged.npz").write_bytes(b"PK\3\4")
    (out / "scene.yaml").write_text("- {type: cone}")
    jobs = [job_of(clips[0]), Job(clips[0] / "best32.yaml", out / "damaged.npz"), job_of(clips[1])]
    (out / "taken").write_text("mine")
    jobs += [Job(out / "scene.yaml", clips[0] / "flows.npz", "cone")]
    jobs += [Job(clips[0] / "best32.yaml", clips[0] / "flows.npz", "taken")]
    return out, jobs, refine_many(jobs, TINY, out=out, workers=2)


def test_each_clip_is_refined_as_if_it_were_alone(whole, clips, tmp_path):
    out, _, _ = whole
    alone = tmp_path / "alone"
    pair = ["--init", str(clips[1] / "best32.yaml"), "--video", str(clips[1] / "flows.npz")]
    # With one thread, as each of several has: the order of sums, so the last digits, depends on their number.
    process = call(*pair, "--out", str(alone), *TINY_CALL, environment=ONE_THREAD)
    assert process.communicate(timeout=300)[1] == ""
    assert sorted(os.listdir(alone)) == FILES
    for name in ("a", "b"):
        assert sorted(os.listdir(out / name)) == FILES
    for name in ("refined.yaml", "overlay.gif"):
        assert (out / "b" / name).read_bytes() == (alone / name).read_bytes()
    assert (out / "a/refined.yaml").read_bytes() != (alone / "refined.yaml").read_bytes()


def test_what_cannot_be_refined_stops_no_other(whole):
    out, _, many = whole
    assert [(outcome.name, outcome.status) for outcome in many.outcomes] == [
        ("a", "done"),
        ("damaged", "bad input"),
        ("b", "done"),
        ("cone", "bad input"),
        ("taken", "bad input"),
    ]
    assert "damaged.npz: not a readable npz" in many.outcomes[1].reason
    assert "entry 0.type = 'cone'" in many.outcomes[3].reason
    assert "taken: " in many.outcomes[4].reason
    assert (out / "taken").read_text() == "mine"
    assert many.status == 1
    assert not (out / "cone").exists()
    with open(out / "summary.csv") as stream:
        rows = {row["name"]: row for row in csv.DictReader(stream)}
    assert list(rows) == ["a", "damaged", "b", "cone", "taken"]
    assert float(rows["b"]["iou_after"]) > float(rows["b"]["iou_before"]) > 0.3
    assert float(rows["b"]["fitness_after"]) == pytest.approx(
        float(rows["b"]["iou_after"]) - float(rows["b"]["epe_after"]), abs=0.3
    )
    assert rows["cone"]["iou_after"] == ""


def test_finished_clips_are_skipped_and_changed_ones_begin_anew(whole, clips):
    out, _, _ = whole
    before = {path: path.stat().st_mtime_ns for path in out.glob("[ab]/*")}
    outcomes = [work(job, out, TINY) for job in (job_of(clips[0]), job_of(clips[1], seed=4))]
    assert [outcome.status for outcome in outcomes] == ["skipped", "done"]
    assert "begun anew" in outcomes[1].reason
    assert outcomes[0].iou_after is not None
    after = {path: path.stat().st_mtime_ns for path in out.glob("[ab]/*")}
    assert {path.parent.name for path in before if before[path] != after[path]} == {"b"}


class Killer(ManyProgress):
    """Kills the worker of the first job that has a checkpoint."""

    def __init__(self, out: Path):
        self.out, self.victim = out, ""

    def update(self, finished, total, part, running):
        if not self.victim and running and (self.out / running[0] / "checkpoint.npz").exists():
            self.victim = running[0]
            (process,) = multiprocessing.active_children()
            os.kill(process.pid, signal.SIGKILL)


def test_a_worker_that_is_killed_costs_its_clip_alone(clips, tmp_path):
    killer = Killer(tmp_path)
    many = refine_many([job_of(clips[0]), job_of(clips[1])], TINY, out=tmp_path, workers=1, progress=killer)
    assert killer.victim == "a"
    assert [(outcome.name, outcome.status) for outcome in many.outcomes] == [("a", "failed"), ("b", "done")]
    assert "killed by SIGKILL" in many.outcomes[0].reason
    assert many.status == 1
    assert multiprocessing.active_children() == []
    # What it leaves can be gone on with.
    assert (tmp_path / "a/checkpoint.npz").exists()
    assert not (tmp_path / "a/result.json").exists()


def call(*arguments: str, environment: dict[str, str] | None = None) -> subprocess.Popen:
    path = os.pathsep.join(os.path.abspath(entry or ".") for entry in sys.path)
    program = [sys.executable, "-c", "from mjx_refine.cli import main; main()", *arguments]
    return subprocess.Popen(
        program,
        env={**os.environ, "PYTHONPATH": path, **(environment or {})},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_whole_that_is_killed_goes_on_to_the_same_bytes(clips, tmp_path, whole):
    (tmp_path / "jobs.yaml").write_text(
        "".join(f"- {{init: {clip}/best32.yaml, video: {clip}/flows.npz}}\n" for clip in clips[:1])
    )
    out = tmp_path / "out"
    arguments = ["--jobs", str(tmp_path / "jobs.yaml"), "--out", str(out), "--workers", "2", *TINY_CALL]
    first = call(*arguments)
    while not (out / "a/checkpoint.npz").exists() and first.poll() is None:
        time.sleep(0.05)
    first.kill()
    first.communicate()
    assert not (out / "a/result.json").exists()
    time.sleep(1.0)  # its workers end with it
    stamps = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    time.sleep(1.0)
    assert stamps == {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    second = call(*arguments, "--resume")
    said, errors = second.communicate(timeout=300)
    assert (second.returncode, errors) == (0, "")
    assert "1 done" in said
    assert said.splitlines()[1].split()[:2] == ["a", "done"]
    assert sorted(os.listdir(out / "a")) == FILES
    assert (out / "a/refined.yaml").read_bytes() == (whole[0] / "a/refined.yaml").read_bytes()


def test_the_command_ends_with_1_where_a_clip_failed_and_2_where_all_were_bad(whole, clips, tmp_path, capsys):
    out = whole[0]
    good, bad = str(clips[0] / "best32.yaml"), str(tmp_path / "none.yaml")
    pair = ["--init", good, "--video", str(clips[0] / "flows.npz")]
    broken = ["--init", bad, "--video", str(clips[1] / "flows.npz")]
    assert run([*pair, *broken, "--out", str(out), *TINY_CALL, "--workers", "1", "--resume"]) == 1
    shown = capsys.readouterr()
    assert shown.err == ""
    assert "none.yaml: cannot be read" in shown.out
    assert "1 skipped, 1 bad input" in shown.out
    assert run([*broken, "--init", bad, "--video", str(tmp_path / "x.npz"), "--out", str(tmp_path / "o")]) == 2
    shown = capsys.readouterr()
    assert shown.err.count("\n") == 1
    assert "none.yaml: cannot be read" in shown.err
    assert "and 1 more" in shown.err


@pytest.mark.slow
def test_a_script_without_a_guard_is_told_so(clips, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from mjx_refine import Job, refine_many\n"
        f"refine_many([Job({str(clips[0] / 'best32.yaml')!r}, {str(clips[0] / 'flows.npz')!r})], out={str(tmp_path)!r})\n"
    )
    path = os.pathsep.join(os.path.abspath(entry or ".") for entry in sys.path)
    done = subprocess.run(
        [sys.executable, script], env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 1
    assert "__main__" in done.stderr.splitlines()[-1]
