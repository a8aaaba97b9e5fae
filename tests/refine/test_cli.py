"""The command line: what the commands do when all is right, and how the exit status tells how it went."""

import json
import shutil
import sys

import click
import mujoco
import numpy as np
import pytest

from benchmarks.bad_cases import scene_text
from mjx_refine.cli import commands
from mjx_refine.cli.main import run
from mjx_refine.cli.types import FiniteFloat, Size
from mjx_refine.observation import load_observation
from mjx_refine.scene import load_scene, load_scenes


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_text(scene_text())
    return path


@pytest.fixture
def clip(scene, tmp_path):
    assert run(["simulate", str(scene), "--out", str(tmp_path / "clip.npz"), "--size", "96x64", "--frames", "8"]) == 0
    return tmp_path / "clip.npz"


@pytest.mark.parametrize("command", [[], *([name] for name in sorted(commands.app.commands))])
def test_help(command, capsys):
    assert run([*command, "--help"]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"Usage: {' '.join(['refine', *command])}")


def test_every_command_of_the_contract_is_there():
    assert {"simulate", "observe", "guess", "export", "evaluate"} <= set(commands.app.commands)
    names = {name for parameter in commands.app.params for name in parameter.opts}
    wanted = [
        "init",
        "video",
        "out",
        "seed",
        "population",
        "iterations",
        "optimizer",
        "backend",
        "resolution",
        "resume",
    ]
    assert {f"--{name}" for name in wanted} <= names


def test_version(monkeypatch, capsys):
    monkeypatch.setattr("importlib.metadata.version", {"mjx-refine": "1.2.3"}.__getitem__)
    assert run(["--version"]) == 0
    assert "1.2.3" in capsys.readouterr().out


def test_simulate_writes_what_was_asked_for(scene, tmp_path, capsys):
    path = tmp_path / "clip.npz"
    assert run(["simulate", str(scene), "--out", str(path), "--size", "96x64", "--frames", "8"]) == 0
    observation = load_observation(path)
    assert observation.size == (96, 64)
    assert observation.length == 8
    assert observation.fps == 30.0
    assert observation.mask_ids() == [1, 2]
    assert "8 frames of 96x64 at 30 fps" in capsys.readouterr().out


def test_simulate_is_deterministic(scene, clip, tmp_path):
    again = tmp_path / "again.npz"
    assert run(["simulate", str(scene), "--out", str(again), "--size", "96x64", "--frames", "8"]) == 0
    first, second = load_observation(clip), load_observation(again)
    assert np.array_equal(first.flow, second.flow)
    assert np.array_equal(first.masks, second.masks)


def test_evaluate_finds_the_truth_perfect(scene, clip, capsys):
    capsys.readouterr()
    assert run(["evaluate", "--scene", str(scene), "--video", str(clip), "--truth", str(scene)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["iou"] == pytest.approx(1.0, abs=1e-6)
    assert report["epe"] == pytest.approx(0.0, abs=2e-3)  # the file holds float16
    assert [entry["mask_id"] for entry in report["objects"]] == [1, 2]
    assert all(value == 0 for value in report["truth"].values())


def test_evaluate_finds_a_wrong_scene_worse(clip, tmp_path, capsys):
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(scene_text({"1.state.position": [0.6, 0.7, 0.2]}))
    capsys.readouterr()
    assert run(["evaluate", "--scene", str(wrong), "--video", str(clip), "--truth", str(tmp_path / "scene.yaml")]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["iou"] < 0.9
    assert report["truth"]["position_m"] == pytest.approx(np.hypot(0.2, 0.2) / 2, abs=1e-6)


def test_export_writes_a_model_that_mujoco_loads(scene, tmp_path):
    out = tmp_path / "scene.xml"
    assert run(["export", str(scene), "--out", str(out), "--fps", "60"]) == 0
    model = mujoco.MjModel.from_xml_path(str(out))
    assert model.opt.timestep == pytest.approx(1 / 480)
    assert model.nkey == 1


def test_guess_writes_samples(clip, tmp_path):
    out = tmp_path / "best.yaml"
    assert run(["guess", str(clip), "--out", str(out), "--samples", "3"]) == 0
    assert len(load_scenes(out)) == 3


def test_export_and_simulate_leave_the_scene_alone(scene):
    before = load_scene(scene)
    assert scene.read_text() == scene_text()
    assert load_scene(scene) == before


def test_options_before_a_command_are_refused(capsys):
    assert run(["--init", "a.yaml", "simulate", "b.yaml", "--out", "c.npz"]) == 2
    assert "after the command" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "status", "says"),
    [
        (KeyboardInterrupt(), 1, "--resume"),
        (click.Abort(), 1, "--resume"),
        (MemoryError(), 1, "--resolution"),
        (ZeroDivisionError("odd"), 1, "report it"),
    ],
)
def test_other_ends(error, status, says, monkeypatch, capsys):
    def fail(*_arguments, **_options):
        raise error

    monkeypatch.setattr(commands, "_refine", fail)
    assert run(["--init", "a", "--video", "b"]) == status
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert says in last


def test_control_characters_do_not_reach_the_terminal(capsys):
    assert run(["simulate", "a\x1b[31m\nb.yaml", "--out", "new.npz"]) == 2
    err = capsys.readouterr().err
    assert "\x1b" not in err
    assert err.count("\n") == 1


def test_help_answers_without_the_heavy_packages():
    import subprocess

    code = "import sys; from mjx_refine.cli.main import run; run(['--help']); sys.exit('mujoco.mjx' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60).returncode == 0


@pytest.mark.parametrize(("text", "size"), [("480x320", (480, 320)), (" 8X8192 ", (8, 8192))])
def test_sizes(text, size):
    assert Size().convert(text, None, None) == size


@pytest.mark.parametrize(
    "text", ["", "480", "480x", "x320", "480x320x3", "-480x320", "4.8x3", "7x8", "9000x8", "٤٨٠x٣٢٠x"]
)
def test_wrong_sizes(text):
    with pytest.raises(click.BadParameter, match="480x320"):
        Size().convert(text, None, None)


@pytest.mark.parametrize("text", ["nan", "inf", "0", "-1", "ten", "1e6"])
def test_wrong_rates(text):
    with pytest.raises(click.BadParameter):
        FiniteFloat(0.1, 1e5).convert(text, None, None)


def test_a_left_out_sample_is_told(tmp_path, capsys, monkeypatch):
    """A broken sample among sound ones: a line on stderr with its index, and the run goes on."""
    (tmp_path / "s.yaml").write_text(scene_text() + "---\n- {type: cone}\n---\n" + scene_text())
    shutil.copy("examples/clip/flows.npz", tmp_path / "v.npz")
    reached = []
    monkeypatch.setattr("mjx_refine.search.refine", lambda samples, *a, **k: reached.append(samples) or _stop())
    assert (
        run(["--init", str(tmp_path / "s.yaml"), "--video", str(tmp_path / "v.npz"), "--out", str(tmp_path / "o")]) == 1
    )
    assert reached[0].indices == (0, 2)
    assert "sample 1: entry 0.type = 'cone'" in capsys.readouterr().err


def _stop():
    raise KeyboardInterrupt
