"""Wrong input and wrong calls: status 2, one line that helps, nothing left behind."""

import os
import subprocess
import sys
import time

import pytest
from hypothesis import strategies as st

from benchmarks.bad_cases import good_files, scene_text
from benchmarks.bad_input import CASES, Outcome, attempt, fuzz, listing, try_case
from mjx_refine.scene import fields


def test_the_cases_are_many_and_distinct():
    assert len(CASES) >= 40
    assert len({case.name for case in CASES}) == len(CASES)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name.replace(" ", "-"))
def test_wrong_input_is_told_in_one_line(case, tmp_path):
    outcome = try_case(case, tmp_path / "case")
    assert outcome.faults == (), outcome.said
    assert outcome.seconds < 60


def test_the_check_finds_faults(tmp_path):
    """A call that is right, and leaves a file behind, has every fault that the cases are checked for."""
    case = next(c for c in CASES if c.name == "call: simulate --out nowhere")
    right = type(case)(
        "right", lambda folder: ["simulate", "good.yaml", "--out", "new.npz", "--frames", "2"], ("made it",)
    )
    outcome = try_case(right, tmp_path / "case")
    assert isinstance(outcome, Outcome)
    assert outcome.faults == ("status 0", "not one line", "does not say 'made it'", "no remedy", "touched new.npz")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--init", "bad.yaml", "--video", "good.npz"], "- !!python/object/apply:os.system ['touch owned']\n"),
        (["simulate", "bad.yaml", "--out", "new.npz"], "[" * 100_000),
        (["evaluate", "--scene", "bad.yaml", "--video", "good.npz"], scene_text({"0.type": "cone"})),
        (["observe", "bad.yaml", "--out", "new.npz"], "no video"),
    ],
)
def test_the_program_itself(arguments, text, tmp_path):
    good_files(tmp_path)
    (tmp_path / "bad.yaml").write_text(text)
    before = listing(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", "from mjx_refine.cli import main; main()", *arguments],
        cwd=tmp_path, capture_output=True, text=True, timeout=120,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(os.path.abspath(p) for p in sys.path)},
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("refine: bad.yaml")
    assert done.stdout == ""
    assert listing(tmp_path) == before


def test_random_texts_raise_nothing_else():
    tried, scenes = fuzz(6.0)
    assert tried > 50
    assert 0 < scenes < tried


def test_the_fuzz_counts_its_seconds_from_the_first_text(monkeypatch):
    naps = iter([0.3])
    monkeypatch.setattr("benchmarks.bad_input.TEXTS", st.builds(lambda: (time.sleep(next(naps, 0.0)), scene_text())[1]))
    assert fuzz(0.2)[0] > 0


def test_the_fuzz_notices_a_scene_that_does_not_round_trip(monkeypatch):
    monkeypatch.setattr("benchmarks.bad_input.dump_scene", lambda scene: scene_text())
    assert attempt(scene_text())
    with pytest.raises(AssertionError, match="not the same"):
        attempt(scene_text({"1.radius": 0.3}))


@pytest.mark.parametrize("power", [5000, 4400])
def test_numbers_too_long_to_print_can_be_shown(power):
    assert len(fields.show(10**power)) < 80
    assert len(fields.show([-(10**power)])) < 80


def test_nested_aliases_can_be_shown():
    tree: list = [1] * 9
    for _ in range(30):
        tree = [tree] * 9
    assert len(fields.show(tree)) <= 60
