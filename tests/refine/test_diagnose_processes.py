"""Diagnoses by several processes: the same answer, whoever does the pieces; who dies is replaced; none is left over."""

import dataclasses
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from own_clip import FLIGHT, SIZE

from mjx_refine.diagnosis import diagnose
from mjx_refine.diagnosis.fits.crew import Crew, crew_of
from mjx_refine.diagnosis.fits.store import Borrowed, Store
from mjx_refine.effects import catalogue
from mjx_refine.report.diagnosis_numbers import diagnosis_numbers
from mjx_refine.scene import Effect
from mjx_refine.simulate import simulate

PATHS = [str(Path(one).absolute()) for one in sys.path if one]


class Toy:
    """Stands in for a clip."""

    facts = "toy"

    def __init__(self):
        self.rollouts, self.store, self.settled, self.crew = 0.0, Store(), 1.0, Crew()

    def state(self) -> str:
        return str(self.settled)

    def again(self):
        return made

    def warm(self) -> None:
        pass


def made(threads: int) -> Toy:
    return Toy()


def halved(clip: Toy, number: float) -> float:
    clip.rollouts += 0.1 * number
    clip.store.keep(f"{number:g}", {"z": np.array([number])})
    return clip.settled * number / 2


def where(clip: Toy, seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()


def deadly(clip: Toy, number: int) -> int:
    if multiprocessing.parent_process() is not None:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def wrong(clip: Toy, number: int) -> int:
    raise ZeroDivisionError(number)


def test_a_crew_does_what_one_does(tmp_path):
    rows = [(float(k),) for k in range(9)]
    clip, alone, told = Toy(), Toy(), []
    clip.rollouts = alone.rollouts = 0.7
    clip.store, alone.store = Store(tmp_path / "a"), Store(tmp_path / "b")
    with crew_of(3) as crew:
        crew.warm(clip)
        for number in (1.0, 3.0):
            clip.settled = alone.settled = number
            found = crew.each(clip, halved, rows, told.append, [str(k) for k in range(9)])
            assert found == alone.crew.each(alone, halved, rows) == [number * k / 2 for k in range(9)]
        assert clip.rollouts == alone.rollouts
        assert sorted(told) == sorted(2 * [str(k) for k in range(9)])
        assert len(set(crew.each(clip, where, [(0.3,)] * 6))) > 1
        with pytest.raises(ZeroDivisionError):
            crew.each(clip, wrong, [(k,) for k in range(4)])
        assert crew.each(clip, deadly, [(k,) for k in range(7)]) == list(range(7))
        assert crew.each(clip, halved, rows) == found
    assert {p.name for p in (tmp_path / "a").iterdir()} == {p.name for p in (tmp_path / "b").iterdir()}
    assert not multiprocessing.active_children()


def test_fits_of_another_process_are_read_and_handed_over(tmp_path):
    Store(tmp_path).keep("x", {"z": np.arange(3.0)})
    part = tmp_path / ".fit_y.npz.0123abcd.part"
    part.touch()
    borrowed = Borrowed(tmp_path)
    borrowed.keep("y", {"z": np.ones(2)})
    assert (borrowed.recall("x") or {})["z"].tolist() == [0.0, 1.0, 2.0]
    assert borrowed.recall("y") is None
    assert [key for key, _ in borrowed.made] == ["y"]
    assert part.exists()  # which another process may be writing


SCRIPT = """
import os, sys, time
from mjx_refine.diagnosis.fits.crew import crew_of
from test_diagnose_processes import Toy, where

print("begun", flush=True)
with crew_of(2) as crew:
    pids = set()
    while len(pids) < 2:
        pids |= set(crew.each(Toy(), where, [(0.2,)] * 3))
    print(*pids - {os.getpid()}, flush=True)
    crew.each(Toy(), where, [(60.0,)] * 2)
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_nobody_outlives_an_unguarded_script(how, tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(PATHS)}
    call = [sys.executable, "script.py"]
    with subprocess.Popen(
        call, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"begun\n"
        others = [int(word) for word in process.stdout.readline().split()]
        assert others
        time.sleep(0.3)
        process.send_signal(how)
        process.wait(20)
        began = time.monotonic()
        while any(Path(f"/proc/{pid}").exists() for pid in others):
            assert time.monotonic() - began < 10
            time.sleep(0.05)
        assert process.stdout.read() == b""  # nobody ran the script again


LOOKED = {2: {"drag"}, 4: {"drag", "push", "slope", "camera_roll", "hidden_obstacle"}}
"""Effects that so many processes look at."""


@pytest.mark.parametrize("several", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_the_answer_does_not_depend_on_the_number_of_processes(several, tmp_path):
    drag = Effect("drag", "ball", (("quadratic", 0.15),))
    clip = simulate(dataclasses.replace(FLIGHT, effects=(drag,)), SIZE, 9 if several == 2 else 14)
    without = tuple(name for name in catalogue() if name not in LOOKED[several])
    store = Store(tmp_path / "s")
    one = diagnose(FLIGHT, clip, threads=1, without=without)
    more = diagnose(FLIGHT, clip, threads=several, without=without, store=store)
    assert store.kept > 5
    again = Store(tmp_path / "s")
    resumed = diagnose(FLIGHT, clip, threads=1, without=without, store=again)
    assert again.kept == 0
    numbers = [diagnosis_numbers(dataclasses.replace(d, seconds=0.0)) for d in (one, more, resumed)]
    assert numbers[0] == numbers[1] == numbers[2]
    assert np.array_equal(one.map_after, more.map_after)
