"""Jobs as they are written, and the order in which they are worked through."""

import os
from pathlib import Path

import pytest
from many_clips import job_of, tiny_clip

from mjx_refine.children import ONE_THREAD, inherited
from mjx_refine.cli.main import run
from mjx_refine.cli.many import told
from mjx_refine.errors import InputError
from mjx_refine.many import Job, jobs_of_pairs, load_jobs
from mjx_refine.many.groups import Waiting, kind_of_job
from mjx_refine.many.outcome import Outcome, result_of
from mjx_refine.many.pool import default_workers
from mjx_refine.many.run import Many
from mjx_refine.many.work import cleared, work
from mjx_refine.scene import load_scenes
from mjx_refine.search import Options

JOBS = """\
- {init: a/best32.yaml, video: a/flows.npz}
- {init: a/best32.yaml, video: /data/throw.npz, seed: 7, iterations: 12, resolution: 96x64}
- {name: third, init: /data/c.yaml, video: c.npz, optimizer: cmaes}
"""

WRITTEN = ("000_1", "0x10", "007", "1e3", "no", "2026-01-05", "17")
"""Words that YAML would take for something else."""


def jobs_file(folder: Path, text: str) -> Path:
    path = folder / "jobs.yaml"
    path.write_text(text)
    return path


def test_a_jobs_file(tmp_path):
    first, second, third = load_jobs(jobs_file(tmp_path, JOBS))
    assert first == Job(tmp_path / "a/best32.yaml", tmp_path / "a/flows.npz", "a")
    assert second.name == "throw"
    assert second.video == Path("/data/throw.npz")
    assert second.options(Options(population=9)) == Options(population=9, seed=7, iterations=12, resolution=(96, 64))
    assert third.name == "third"
    assert third.init == Path("/data/c.yaml")
    assert third.options(Options()).optimizer == "cmaes"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "expected a list of jobs"),
        ("{init: a, video: b}", "expected a list of jobs"),
        ("- a", "job 0 = 'a'; expected a mapping"),
        ("- {init: a.yaml}", r"job 0\.video is missing"),
        ("- {init: a, video: b.npz}\n- {init: a, video: c.npz, sed: 3}", "job 1: unknown key 'sed'; expected one of name"),
        ("- {init: a, video: b.npz, backend: mjx}", "unknown key 'backend'"),
        ("- {init: a, video: b.npz, seed: 1.5}", "job 0: seed = 1.5; expected a whole number"),
        ("- {init: a, video: b.npz, iterations: 0}", "job 0: iterations = 0; expected"),
        ("- {init: a, video: b.npz, optimizer: best}", "job 0: optimizer = 'best'; expected one of"),
        ("- {init: a, video: b.npz, resolution: big}", "resolution = 'big'; expected WIDTHxHEIGHT"),
        ("- {init: a, video: b.npz, resolution: 4x4}", "resolution = .*8 x 8"),
        ("- {init: a, video: x/b.npz}\n- {init: a, video: y/b.npz}", "2 jobs have the name 'b'"),
        ("- {init: a, video: b.npz, name: ../b}", "job 0.name = '../b'; expected a folder's name"),
        ("- {init: a, video: b.npz, name: .b}", "expected a folder's name"),
        ("- {init: a, video: b.npz, name: summary.csv}", "expected a folder's name"),
        ("- {init: a, video: b.npz, init: c}", "the key 'init' stands twice"),
        ("- !!python/object/apply:os.system [id]", "not safe YAML"),
        ("- {init: [1], video: b.npz}", r"job 0\.init = \[1\]"),
    ],
)  # fmt: skip
def test_wrong_jobs_are_told(text, says, tmp_path):
    path = jobs_file(tmp_path, text)
    with pytest.raises(InputError, match=says) as told:
        load_jobs(path)
    assert str(told.value).startswith(str(path))


@pytest.mark.parametrize("word", WRITTEN)
def test_names_are_read_as_they_are_written(word, tmp_path):
    text = f"- {{name: '{word}', init: a, video: b.npz}}\n- {{name: c{word}, init: '{word}', video: b.npz}}"
    quoted = load_jobs(jobs_file(tmp_path, text))
    assert load_jobs(jobs_file(tmp_path, text.replace("'", ""))) == quoted
    assert quoted[0].name == quoted[1].init.name == word


def test_jobs_from_python_are_checked():
    with pytest.raises(InputError, match="job b: seed = -1"):
        Job("a.yaml", "b.npz", overrides={"seed": -1})
    with pytest.raises(InputError, match="unknown key 'threads'"):
        Job("a.yaml", "b.npz", overrides={"threads": 4})
    with pytest.raises(InputError, match="2 scenes and 1 clips"):
        jobs_of_pairs(["a", "b"], ["c"])


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--jobs", "j.yaml", "--init", "a"], "leave one out"),
        (["--init", "a", "--init", "b", "--video", "c"], "2 --init and 1 --video"),
        (["--video", "c"], "Missing option '--init'"),
        (["--jobs", "j.yaml", "guess", "c"], "after the command"),
        (["--jobs", "none.yaml"], "none.yaml: cannot be read"),
        (["--init", "a", "--init", "b", "--video", "c.npz", "--video", "d/c.npz"], "2 jobs have the name 'c'"),
    ],
)
def test_wrong_calls(arguments, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(arguments) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_kinds_are_told_from_shapes_and_size(tmp_path):
    job = job_of(tiny_clip(tmp_path / "a"))
    samples = load_scenes(job.init)
    kind = kind_of_job(samples, job.video)
    assert kind == kind_of_job(load_scenes(tiny_clip(tmp_path / "b", 0.2) / "best32.yaml"), tmp_path / "b/flows.npz")
    example = load_scenes("examples/clip/best32.yaml")
    assert kind != kind_of_job(samples, Path("examples/clip/flows.npz"))
    assert kind != kind_of_job(example, job.video)
    (tmp_path / "broken.npz").write_bytes(b"PK")
    assert kind_of_job(samples, tmp_path / "broken.npz")[1] is None


def test_a_worker_keeps_to_its_kind_then_takes_one_that_nobody_works_on():
    def job(name: str) -> Job:
        return Job("a.yaml", "b.npz", name)

    waiting = Waiting([(job("x1"), "x"), (job("y1"), "y"), (job("y2"), "y"), (job("z1"), "z"), (job("x2"), "x")])
    assert len(waiting) == 5
    taken = [waiting.take(None, [])]  # the first of the most numerous
    taken.append(waiting.take(None, ["x"]))  # y is more numerous than z
    taken.append(waiting.take("x", ["x", "y"]))
    taken.append(waiting.take("x", ["x", "y"]))
    waiting.put_back(*taken[-1])
    taken[-1] = waiting.take("x", ["y"])
    taken.append(waiting.take("z", ["y", "z"]))
    assert [(job.name, kind) for job, kind in taken] == [
        ("x1", "x"),
        ("y1", "y"),
        ("x2", "x"),
        ("z1", "z"),
        ("y2", "y"),
    ]
    assert len(waiting) == 0


def test_what_goes_wrong_in_a_job_is_its_outcome(tmp_path, monkeypatch):
    job = job_of(tiny_clip(tmp_path / "a"))
    for error, status, says in (
        (ZeroDivisionError("odd"), "failed", "ZeroDivisionError: odd (test_many_jobs.py, line "),
        (MemoryError(), "failed", "out of memory"),
        (InputError("bad thing"), "bad input", "bad thing"),
    ):

        def fail(*_arguments, error=error, **_options):
            raise error

        monkeypatch.setattr("mjx_refine.many.work.refine", fail)
        outcome = work(job, tmp_path, Options())
        assert (outcome.name, outcome.status) == ("a", status)
        assert says in outcome.reason


def test_a_damaged_result_is_none(tmp_path):
    (tmp_path / "result.json").write_text('{"digest": ')
    assert result_of(tmp_path) is None
    (tmp_path / "result.json").write_text("[]")
    assert result_of(tmp_path) is None
    (tmp_path / "refined.yaml").write_text("mine")
    cleared(tmp_path)
    cleared(tmp_path / "none")
    assert [path.name for path in tmp_path.iterdir()] == ["refined.yaml"]


@pytest.mark.parametrize(
    ("statuses", "status"),
    [
        (["done", "skipped"], 0),
        (["done", "bad input"], 1),
        (["failed", "bad input"], 1),
        (["bad input", "bad input"], 2),
        (["failed"], 1),
    ],
)
def test_the_exit_status_of_the_whole(statuses, status):
    assert Many(Path("out"), tuple(Outcome(str(i), s) for i, s in enumerate(statuses))).status == status


def test_a_child_s_environment_is_ours_again_after(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    with inherited(ONE_THREAD):
        assert os.environ["OMP_NUM_THREADS"] == "7"  # what the user has set stays
        assert "intra_op_parallelism_threads=1" in os.environ["XLA_FLAGS"]
    assert "XLA_FLAGS" not in os.environ
    assert os.environ["OMP_NUM_THREADS"] == "7"


@pytest.mark.parametrize(("backend", "count"), [("mujoco", len(os.sched_getaffinity(0))), ("mjx", 1), ("warp", 1)])
def test_how_many_workers(backend, count):
    assert default_workers(Options(backend=backend)) == count


def test_how_many_workers_where_warp_is_installed(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: object())
    assert default_workers(Options()) is None  # only a worker may ask for a GPU: it would keep its memory
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert default_workers(Options()) == len(os.sched_getaffinity(0))


def test_the_live_line():
    assert told(3, 16, 0.25, ("a", "b"), 60.0) == "3/16 clips, 0:01:00, about 0:03:00 left; at work: a, b"
    assert told(0, 2, 0.0, (), 7300.0) == "0/2 clips, 2:01:40, time left unknown; at work: nothing yet"
