"""Pieces of a diagnosis in several processes: the same answer, whoever does them and whoever ends meanwhile."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from crew_pieces import Plain, ends, scaled, wrong
from own_clip import FLIGHT, SIZE

from mjx_refine.diagnosis import diagnose
from mjx_refine.diagnosis.crew import Crew, crew_of
from mjx_refine.diagnosis.store import Store
from mjx_refine.effects import catalogue
from mjx_refine.report.diagnosis_numbers import diagnosis_numbers
from mjx_refine.scene import Effect
from mjx_refine.simulate import simulate

ROWS = [(float(k),) for k in range(1, 13)]


def alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    # One that has ended and that nobody has asked for stays as a zombie.
    return "Z" not in Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]


def all_end(processes: list[int]) -> bool:
    began = time.monotonic()
    while any(alive(one) for one in processes) and time.monotonic() - began < 20:
        time.sleep(0.05)
    return not any(alive(one) for one in processes)


def begun(crew: Crew, clip: Plain) -> None:
    """Waits until the other processes do pieces."""
    while not any(elsewhere for _, elsewhere in crew.each(clip, scaled, ROWS)):
        pass


def test_results_are_in_order_and_what_is_settled_goes_along(tmp_path):
    with crew_of(2) as crew:
        clip, lines = Plain(), []
        begun(crew, clip)
        for settled in (1.0, 2.0):
            clip.settled, clip.store, clip.rollouts = settled, Store(tmp_path / f"{settled}"), 0.0
            found = crew.each(clip, scaled, ROWS, lines.append, [str(x) for (x,) in ROWS])
            assert [x for x, _ in found] == [settled * x for (x,) in ROWS]
            assert {elsewhere for _, elsewhere in found} == {False, True}
            assert len(list((tmp_path / f"{settled}").iterdir())) == clip.store.kept == len(ROWS)
            assert clip.rollouts == sum(x for (x,) in ROWS)
            assert crew.each(clip, scaled, ROWS) != []
            assert clip.store.recalled == clip.store.kept == len(ROWS)
        assert sorted(lines) == sorted(2 * [str(x) for (x,) in ROWS])


def test_alone_pieces_are_told_in_order():
    clip, lines = Plain(), []
    clip.settled = 2.0
    assert Crew().each(clip, scaled, ROWS, lines.append, [str(x) for (x,) in ROWS]) == [(2 * x, False) for (x,) in ROWS]
    assert lines == [str(x) for (x,) in ROWS]
    assert clip.rollouts == sum(x for (x,) in ROWS)


def test_what_an_ended_process_had_is_done_here():
    with crew_of(2) as crew:
        clip = Plain()
        clip.settled = 1.0
        begun(crew, clip)
        assert crew.each(clip, ends, ROWS) == [(x, False) for (x,) in ROWS]
        assert crew.each(clip, scaled, ROWS) == [(x, False) for (x,) in ROWS]


def test_a_piece_that_fails_fails_here_and_nobody_is_left():
    before = set(multiprocessing.active_children())
    with pytest.raises(ZeroDivisionError), crew_of(2) as crew:
        crew.each(Plain(), wrong, ROWS)
    assert set(multiprocessing.active_children()) <= before


def test_the_others_end_with_a_killed_parent(tmp_path):
    paths = os.pathsep.join(str(Path(one).absolute()) for one in sys.path if one)
    code = "import crew_pieces; crew_pieces.main()"
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], env={**os.environ, "PYTHONPATH": paths})
    began = time.monotonic()
    while len(list(tmp_path.iterdir())) < 3:
        assert process.poll() is None
        assert time.monotonic() - began < 60
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert all_end([int(one.name) for one in tmp_path.iterdir()])


def numbers(frames: int, left_in: tuple[str, ...], threads: int, store: Store | None = None) -> tuple[dict, list[str]]:
    drag = Effect("drag", "ball", (("quadratic", 0.15),))
    clip = simulate(dataclasses.replace(FLIGHT, effects=(drag,)), SIZE, frames)
    without, lines = tuple(name for name in catalogue() if name not in left_in), []
    found = diagnose(FLIGHT, clip, threads=threads, without=without, told=lines.append, store=store)
    return diagnosis_numbers(dataclasses.replace(found, seconds=0.0)), sorted(lines)


def test_the_answer_does_not_depend_on_how_many_processes_there_are(tmp_path):
    alone, store = numbers(9, ("drag",), 1), Store(tmp_path / "s")
    assert numbers(9, ("drag",), 3, store) == alone
    assert store.kept > 5


@pytest.mark.slow
@pytest.mark.parametrize("threads", [2, 4])
def test_nor_with_more_effects(threads):
    names = ("drag", "wind", "push", "hidden_obstacle", "mask_bias", "dropped_frames")
    assert numbers(16, names, threads) == numbers(16, names, 1)
