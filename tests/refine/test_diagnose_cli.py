"""``refine diagnose`` from outside: good calls, bad calls, and what they leave behind; the diagnosis itself is made up."""

from __future__ import annotations

import dataclasses
import json
import os

import numpy as np
import pytest

from benchmarks.bad_cases import scene_text
from mjx_refine import diagnosis as package
from mjx_refine.cli.diagnose import best_sample
from mjx_refine.cli.main import run
from mjx_refine.diagnosis.result import NONE, UNKNOWN, ClipGap, Diagnosis, Gap, Place, Ranked, Value, Verdict
from mjx_refine.observation import load_observation, save_observation
from mjx_refine.report.diagnosis_words import in_words
from mjx_refine.scene import Effect, load_scene, load_scenes
from mjx_refine.simulate import simulate

FILES = ["diagnosed.yaml", "diagnosis.json", "report.html"]
FRAMES = 6


def answer(scene) -> Diagnosis:
    """A diagnosis of ``scene``: drag on its sphere."""
    shape = (len(scene.objects), FRAMES)
    drag = Effect("drag", "sphere_0", (("linear", 0.2),))
    return Diagnosis(
        Verdict(("drag",), 0.93, (), "sphere_0 is slowed by the air.", "Film it faster."),
        Gap("misfit", "frames 4-5", 4.0, 1.2, 1.0, 0.93, 0.8, 0.99, 0.7, 0.9, 1.0, 0.3),
        (Place("sphere_0", (1, 5), "flight", "motion", 0.8),),
        (Ranked("drag", "sphere_0", 0.93, 20.0, {"linear": Value(0.2, 0.1, 0.3, "N s/m")}, 1.2, 0.93, "drag"),),
        "It lags.",
        "Nothing.",
        scene,
        dataclasses.replace(scene, effects=(drag,)),
        (1, 2),
        np.full(shape, 3.0),
        np.ones(shape),
        np.zeros(shape, int),
        ("a note",),
        {"lead": 20.0},
        1.5,
        100,
    )


@pytest.fixture
def asked(monkeypatch):
    """Every call of the diagnosis: (scene or scenes, observation or observations, options)."""
    calls = []

    def diagnose(scene, observation, **options):
        calls.append((scene, observation, options))
        options["told"]("base model")
        return answer(scene)

    monkeypatch.setattr(package, "diagnose", diagnose, raising=False)
    monkeypatch.delattr(package, "diagnose_clips", raising=False)
    return calls


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "scene.yaml").write_text(scene_text())
    save_observation(tmp_path / "flows.npz", simulate(load_scene(tmp_path / "scene.yaml"), (96, 64), FRAMES))
    monkeypatch.chdir(tmp_path)
    return tmp_path


CALL = ["diagnose", "--init", "scene.yaml", "--video", "flows.npz", "--out", "out"]


def test_a_good_call(folder, asked, capsys):
    assert run([*CALL, "--seed", "7", "--without", "magnus", "--without", "wind", "--without", "magnus"]) == 0
    out, err = capsys.readouterr()
    assert out.splitlines() == [
        "sphere_0 is slowed by the air. (probability 0.93)",
        "  drag of sphere_0: linear 0.2 N s/m (0.1 … 0.3)",
        "  where: sphere_0, frames 1–5, flight, motion (80 % of the gap)",
        "  held-out gap: 4 → 1.2, 93 % closed (80 % … 99 %), noise alone 1; frames 4-5",
        "out/report.html",
    ]
    assert err == "refine: a note\n"
    ((scene, observation, options),) = asked
    assert scene == load_scene("scene.yaml")
    assert np.array_equal(observation.masks, load_observation("flows.npz").masks)
    assert (options["seed"], options["without"], options["threads"]) == (7, ("magnus", "wind"), None)
    assert sorted(path.name for path in (folder / "out").iterdir()) == FILES
    numbers = json.loads((folder / "out/diagnosis.json").read_text())
    assert numbers["verdict"]["effects"] == ["drag"]
    assert numbers["call"]["init"] == ["scene.yaml"]
    assert numbers["call"]["seed"] == 7
    assert numbers["call"]["without"] == ["magnus", "wind"]
    assert load_scene("out/diagnosed.yaml").effects[0].effect == "drag"
    assert sorted(path.name for path in folder.iterdir()) == ["flows.npz", "out", "scene.yaml"]


@pytest.mark.parametrize(
    ("effects", "lines"),
    [
        (
            UNKNOWN,
            [
                "Said. (probability 0.93)",
                "  where: the whole view, frames 0–3, whole, camera (90 % of the gap)",
                "  the gap: It lags.",
            ],
        ),
        (NONE, ["Said. (probability 0.93)"]),
    ],
)
def test_in_words_where_nothing_is_named(folder, effects, lines):
    scene = load_scene("scene.yaml")
    told = answer(scene)
    verdict = dataclasses.replace(told.verdict, effects=effects, sentence="Said.")
    where = (*told.where, Place(None, (0, 3), "whole", "camera", 0.9))
    said = in_words(dataclasses.replace(told, verdict=verdict, where=where, scene=scene))
    assert said == [*lines, "  held-out gap: 4, noise alone 1; frames 4-5"]


def test_in_words_a_place_is_of_its_clip(folder):
    told = answer(load_scene("scene.yaml"))
    where = tuple(dataclasses.replace(place, clip=1) for place in told.where)
    clips = (ClipGap("a.npz", True, 2.0, 1.0), ClipGap("b.npz", False, 2.0, 1.0))
    said = in_words(dataclasses.replace(told, where=where, clips=clips))
    assert said[2] == "  where: sphere_0, frames 1–5 of b.npz, flight, motion (80 % of the gap)"


def test_the_diagnosed_scene_can_be_simulated(folder, asked):
    assert run(CALL) == 0
    assert run(["simulate", "out/diagnosed.yaml", "--out", "again.npz", "--size", "96x64", "--frames", "6"]) == 0


def test_of_several_samples_the_best_is_taken(folder, asked, capsys):
    wrong = scene_text({"1.state.position": [0.2, 0.9, 0.2]})
    (folder / "best.yaml").write_text("---\n".join([wrong, "- {type: cone}\n", scene_text(), wrong]))
    assert run(["diagnose", "--init", "best.yaml", "--video", "flows.npz", "--out", "out"]) == 0
    err = capsys.readouterr().err
    assert "left out: " in err
    assert "best.yaml: sample 2 of 3 is taken" in err
    assert asked[0][0] == load_scene("scene.yaml")
    numbers = json.loads((folder / "out/diagnosis.json").read_text())
    assert numbers["call"]["sample"] == [2]
    assert "sample 2 of 3 is taken" in numbers["notes"][0]
    assert numbers["notes"][1] == "a note"


def test_a_single_scene_is_taken_as_it_is(folder):
    scene, index, note = best_sample(load_scenes("scene.yaml"), load_observation("flows.npz"))
    assert (scene, index, note) == (load_scene("scene.yaml"), 0, "")


def test_resume_does_nothing_where_all_is_done(folder, asked, capsys):
    assert run(CALL) == 0
    before = {path.name: path.stat().st_mtime_ns for path in (folder / "out").iterdir()}
    assert run([*CALL, "--resume", "--threads", "1"]) == 0
    assert "nothing to do" in capsys.readouterr().out
    assert {path.name: path.stat().st_mtime_ns for path in (folder / "out").iterdir()} == before
    assert len(asked) == 1


def test_resume_runs_where_something_is_missing(folder, asked):
    assert run([*CALL, "--resume"]) == 0
    (folder / "out/report.html").unlink()
    assert run([*CALL, "--resume"]) == 0
    assert len(asked) == 2
    assert (folder / "out/report.html").is_file()


@pytest.mark.parametrize("other", [["--seed", "1"], ["--without", "drag"], ["--init"]])
def test_resume_refuses_another_calls_diagnosis(folder, asked, capsys, other):
    assert run(CALL) == 0
    if other == ["--init"]:
        (folder / "scene.yaml").write_text(scene_text({"1.radius": 0.21}))
        other = []
    capsys.readouterr()
    assert run([*CALL, *other, "--resume"]) == 2
    assert "out/diagnosis.json: made for another input or other options" in one_line(capsys)
    assert len(asked) == 1
    assert run([*CALL, *other]) == 0


def test_resume_refuses_a_damaged_diagnosis(folder, asked, capsys):
    assert run(CALL) == 0
    (folder / "out/diagnosis.json").write_text("{")
    capsys.readouterr()
    assert run([*CALL, "--resume"]) == 2
    assert "not a readable diagnosis" in one_line(capsys)


def one_line(capsys) -> str:
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("refine: ")
    return err


BAD = {
    "unknown effect": ([*CALL, "--without", "gremlins"], r"--without = 'gremlins'; expected one of drag, magnus"),
    "no scene": (CALL[:1] + CALL[3:], "Missing option '--init'"),
    "no clip": (CALL[:3] + CALL[5:], "Missing option '--video'"),
    "no place": (CALL[:5], "Missing option '--out'"),
    "missing scene": (["diagnose", "--init", "gone.yaml", *CALL[3:]], "gone.yaml"),
    "missing clip": ([*CALL[:3], "--video", "gone.npz", *CALL[5:]], "gone.npz: no such file"),
    "missing poses": ([*CALL[:3], "--poses", "gone.npz", *CALL[5:]], "gone.npz: no such file"),
    "two scenes, one clip": ([*CALL, "--init", "scene.yaml"], "2 --init and 1 --video; expected as many of each"),
    "one scene, two clips": ([*CALL, "--video", "flows.npz"], "1 --init and 2 --video"),
    "clip and poses": ([*CALL, "--poses", "flows.npz"], "--poses and --video: expected one of them"),
    "two scenes and poses": (
        [*CALL[:3], "--init", "scene.yaml", "--poses", "flows.npz", "--out", "out"],
        "2 --init and 1 --poses; expected one of each",
    ),
    "two scenes and three poses": (
        [*CALL[:3], *("--poses", "p.npz") * 3, "--init", "scene.yaml", "--out", "out"],
        "2 --init and 3 --poses; expected one of each, in the same order, or one --init for all",
    ),
    "clips of the future": (
        [*CALL, "--init", "scene.yaml", "--video", "flows.npz"],
        "2 pairs of --init and --video: this version cannot diagnose that yet; diagnose each clip by itself",
    ),
    "a clip as poses": ([*CALL[:3], "--poses", "flows.npz", *CALL[5:]], "flows.npz: unknown key 'flow'"),
    "out is a file": ([*CALL[:-1], "scene.yaml"], "scene.yaml is no directory"),
    "out below a file": ([*CALL[:-1], "scene.yaml/out"], "scene.yaml is no directory"),
    "wrong seed": ([*CALL, "--seed", "-1"], "-1 is not in the range"),
    "wrong threads": ([*CALL, "--threads", "0"], "0 is not in the range"),
    "a scene as a clip": ([*CALL[:3], "--video", "scene.yaml", *CALL[5:]], "scene.yaml: not a readable npz"),
    "a clip as a scene": (["diagnose", "--init", "flows.npz", *CALL[3:]], "flows.npz"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_calls(name, folder, asked, capsys):
    arguments, says = BAD[name]
    assert run(arguments) == 2
    assert says in one_line(capsys)
    assert asked == []
    assert sorted(path.name for path in folder.iterdir()) == ["flows.npz", "scene.yaml"]


def test_a_folder_without_permission(folder, asked, capsys, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(os, "access", lambda _path, mode, **_options: not mode & os.W_OK)
        assert run(CALL) == 2
    assert "out: no permission to write in" in one_line(capsys)
    assert asked == []


def test_a_result_that_is_a_directory(folder, asked, capsys):
    (folder / "out/diagnosis.json").mkdir(parents=True)
    assert run(CALL) == 2
    assert "out/diagnosis.json: is a directory" in one_line(capsys)
    assert asked == []


@pytest.mark.parametrize(
    ("error", "status", "says"),
    [
        (KeyboardInterrupt(), 1, "refine: interrupted; run the same call again\n"),
        (ZeroDivisionError("odd"), 1, "report it"),
    ],
)
def test_other_ends_leave_nothing(folder, asked, monkeypatch, capsys, error, status, says):
    def fail(*_arguments, **_options):
        raise error

    monkeypatch.setattr(package, "diagnose", fail)
    assert run(CALL) == status
    assert says in capsys.readouterr().err
    assert not (folder / "out").exists()


def test_an_error_of_the_diagnosis_is_one_line(folder, asked, monkeypatch, capsys):
    from mjx_refine.errors import InputError

    def refuse(*_arguments, **_options):
        raise InputError("scene.yaml: nothing to compare; give a clip in which something moves")

    monkeypatch.setattr(package, "diagnose", refuse)
    assert run(CALL) == 2
    assert "nothing to compare" in one_line(capsys)
    assert not (folder / "out").exists()


def test_several_clips_reach_the_diagnosis_in_order(folder, asked, monkeypatch):
    (folder / "other.yaml").write_text(scene_text({"1.radius": 0.19}))
    reached = []

    def diagnose_clips(scenes, observations, **options):
        reached.append((scenes, observations, options))
        return answer(scenes[0])

    monkeypatch.setattr(package, "diagnose_clips", diagnose_clips, raising=False)
    assert run([*CALL, "--init", "other.yaml", "--video", "flows.npz", "--threads", "1"]) == 0
    ((scenes, observations, options),) = reached
    assert list(scenes) == [load_scene("scene.yaml"), load_scene("other.yaml")]
    assert len(observations) == 2
    assert options["threads"] == 1
    numbers = json.loads((folder / "out/diagnosis.json").read_text())
    assert numbers["notes"][0] == "The pictures are of the first of 2 clips."
    assert asked == []


def test_poses_reach_the_diagnosis(folder, asked, monkeypatch):
    np.savez(folder / "poses.npz", time=np.arange(3.0), pos=np.zeros((3, 3)), quat=np.tile([1.0, 0, 0, 0], (3, 1)))
    reached = []

    def diagnose_poses(scene, poses, **options):
        reached.append((scene, poses.source, options["seed"]))
        return answer(scene)

    monkeypatch.setattr(package, "diagnose_poses", diagnose_poses, raising=False)
    assert run([*CALL[:3], "--poses", "poses.npz", "--out", "out", "--seed", "5"]) == 0
    assert reached == [(load_scene("scene.yaml"), "poses.npz", 5)]
    assert "<img" not in (folder / "out/report.html").read_text()


def test_steps_are_told_on_a_terminal_alone(folder, asked, monkeypatch, capsys):
    shown = []

    class Terminal:
        def __init__(self):
            shown.append("start")

        def told(self, text):
            shown.append(text)

        def close(self):
            shown.append("end")

    monkeypatch.setattr("mjx_refine.cli.diagnose.TerminalSteps", Terminal)
    assert run(CALL) == 0
    assert shown == []
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    assert run(CALL) == 0
    assert shown == ["start", "base model", "report", "end"]


def test_the_terminals_line(monkeypatch):
    from mjx_refine.cli.diagnose import TerminalSteps

    steps = TerminalSteps()
    steps.told("drag [ball]")
    assert [(task.description, task.completed) for task in steps.bar.tasks] == [("drag [ball]", 1)]
    steps.close()
    assert not steps.bar.live.is_started
