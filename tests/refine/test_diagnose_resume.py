"""Diagnoses that are killed in the middle go on where they stood, with the same answer; nothing is left over."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from own_clip import FLIGHT, SIZE
from own_poses import GIVEN, acting, recorded

from mjx_refine.cli.diagnose import UNFINISHED, unfinished
from mjx_refine.cli.main import run
from mjx_refine.diagnosis import diagnose
from mjx_refine.diagnosis.fits.store import Store, fingerprint, versions
from mjx_refine.report.diagnosis_numbers import diagnosis_numbers
from mjx_refine.scene import Effect, save_scene
from mjx_refine.simulate import simulate

REFINE = [sys.executable, "-c", "from mjx_refine.cli.main import main; main()"]
LEFT_OUT = ("offset_com", "hidden_obstacle", "friction_patch", "magnus", "push", "slope")
PATHS = [str(Path(one).absolute()) for one in sys.path if one]
FILES = ["diagnosed.yaml", "diagnosis.json", "report.html"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_scene("scene.yaml", GIVEN)
    for k in range(2):
        one = recorded(acting("drag", quadratic=0.02), 60.0, 0.4 + 0.05 * k, k)
        np.savez(f"{k}.npz", time=one.time, pos=one.position[0], quat=one.quaternion[0])
    return tmp_path


def call(out: str, count: int) -> list[str]:
    words = ["diagnose", "--init", "scene.yaml", "--out", out, "--threads", "1"]
    for k in range(count):
        words += ["--poses", f"{k}.npz"]
    for name in LEFT_OUT:
        words += ["--without", name]
    return words


def fits(out: Path) -> list[Path]:
    return sorted(out.glob(f"{UNFINISHED}/*/fit_*.npz"))


def killed(arguments: list[str], out: Path, after: int) -> None:
    """Runs the command and kills it when so many fits are kept."""
    # Where the packages are found by relative paths, those of this process are right.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(PATHS)}
    process = subprocess.Popen([*REFINE, *arguments], stderr=subprocess.DEVNULL, env=environment)
    began = time.monotonic()
    while len(fits(out)) < after:
        assert process.poll() is None, "it ended before it could be killed"
        assert time.monotonic() - began < 120
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()


def numbers(out: Path) -> dict:
    return {**json.loads((out / "diagnosis.json").read_text()), "seconds": 0}


@pytest.mark.parametrize("count", [1, 2])
def test_killed_and_resumed_gives_the_same_answer(folder, count):
    assert run(call("whole", count)) == 0
    killed(call("out", count), folder / "out", 4)
    assert not (folder / "out/diagnosis.json").exists()
    stood = {path: path.stat().st_mtime_ns for path in fits(folder / "out")}
    written = []
    keep = Store.keep
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Store, "keep", lambda self, key, arrays: (written.append(key), keep(self, key, arrays)))
        assert run([*call("out", count), "--resume"]) == 0
    assert written
    assert not {path.stem.removeprefix("fit_") for path in stood} & set(written)  # no finished fit is made again
    assert numbers(folder / "out") == numbers(folder / "whole")
    assert (folder / "out/diagnosed.yaml").read_bytes() == (folder / "whole/diagnosed.yaml").read_bytes()
    assert sorted(path.name for path in (folder / "out").iterdir()) == FILES


def test_an_interrupt_says_how_to_go_on(folder, monkeypatch, capsys):
    keep, count = Store.keep, [0]

    def interrupted(self, key, arrays):
        keep(self, key, arrays)
        count[0] += 1
        if count[0] == 3:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Store, "keep", interrupted)
        assert run(call("out", 1)) == 1
    assert capsys.readouterr().err == "refine: interrupted; run the same call again with --resume: 3 fits are kept\n"
    assert len(fits(folder / "out")) == 3
    assert run(call("out", 1)) == 0  # without --resume it begins anew
    assert sorted(path.name for path in (folder / "out").iterdir()) == FILES


def test_fits_of_another_call_are_of_no_use(tmp_path):
    first = unfinished(tmp_path, "a", False)
    first.keep("x", {"z": np.arange(3.0)})
    assert unfinished(tmp_path, "a", True).recall("x") is not None
    assert unfinished(tmp_path, "b", True).recall("x") is None
    assert not fits(tmp_path)
    first.keep("x", {"z": np.arange(3.0)})
    assert unfinished(tmp_path, "a", False).recall("x") is None


def test_a_damaged_fit_is_made_again(tmp_path):
    store = Store(tmp_path / "s")
    store.keep("x", {"z": np.arange(3.0)})
    (path,) = (tmp_path / "s").iterdir()
    assert (store.recall("x") or {})["z"].tolist() == [0.0, 1.0, 2.0]
    path.write_bytes(path.read_bytes()[:40])
    assert store.recall("x") is None
    (tmp_path / "s/.fit_x.npz.0123abcd.part").write_text("half")
    Store(tmp_path / "s")
    assert sorted(p.name for p in (tmp_path / "s").iterdir()) == ["fit_x.npz"]
    (tmp_path / "mine").touch()
    store.clear()
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_fingerprints_tell_numbers_apart():
    z = np.arange(2000.0)
    other = z.copy()
    other[1000] += 1e-12
    told = [fingerprint(v) for v in (z, other, z[:, None], z.astype(np.float32), [z], ("a", 1), ("a1",), None)]
    assert len(set(told)) == len(told)
    assert fingerprint(z, "a") == fingerprint(z.copy(), "a")
    assert versions() == versions()


@pytest.mark.slow
def test_a_video_is_resumed_as_well(tmp_path):
    drag = Effect("drag", "ball", (("quadratic", 0.15),))
    clip = simulate(dataclasses.replace(FLIGHT, effects=(drag,)), SIZE, 16)
    without = (*LEFT_OUT, "shape", "occluder", "dropped_frames", "rolling_shutter", "lens_distortion", "camera_shake")
    whole = diagnose(FLIGHT, clip, threads=1, without=without)
    store = Store(tmp_path / "s")

    class Stop(Exception):
        pass

    def told(line: str) -> None:
        if line == "held-out frames":
            raise Stop

    with pytest.raises(Stop):
        diagnose(FLIGHT, clip, threads=1, without=without, store=store, told=told)
    assert store.kept > 3
    again = Store(tmp_path / "s")
    resumed = diagnose(FLIGHT, clip, threads=1, without=without, store=again)
    assert again.recalled > 3
    first, second = (diagnosis_numbers(dataclasses.replace(d, seconds=0.0)) for d in (whole, resumed))
    assert first == second
