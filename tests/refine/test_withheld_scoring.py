"""The withheld exam: answers never read the key, and the scorer's numbers by hand."""

from __future__ import annotations

import json
import sys

import pytest

pytest.importorskip("pybullet", reason="the exam needs the bench extra")

from benchmarks.withheld import answer, marks, score

OPENED: list[str] = []
WATCH: list[str] = []  # folders in which opened files are noted; a hook of Python's cannot be taken off again


def _note(event, args):
    if WATCH and event == "open" and any(folder in str(args[0]) for folder in WATCH):
        OPENED.append(str(args[0]))


sys.addaudithook(_note)


# ---- answering ------------------------------------------------------------------------------------------------------

FAKE = """
import json, pathlib, sys
words = sys.argv[1:]
out = pathlib.Path(words[words.index("--out") + 1])
(out / "words.json").write_text(json.dumps(words))
(out / "diagnosis.json").write_text("{}")
sys.exit(3 if "002" in str(out) else 0)
"""


def small_exam(folder, clips=3):
    for number in range(clips):
        clip = folder / "clips" / f"{number:03d}"
        clip.mkdir(parents=True)
        (clip / "without.txt").write_text("drag\n" if number == 1 else "")
    (folder / "key").mkdir()
    for number in range(clips):
        (folder / "key" / f"{number:03d}.json").write_text("{}")


def test_answers_go_on_where_they_stopped_and_never_read_the_key(tmp_path, monkeypatch):
    small_exam(tmp_path / "exam")
    script = tmp_path / "fake.py"
    script.write_text(FAKE)
    monkeypatch.setattr(sys.modules[__name__], "WATCH", [str(tmp_path)])
    OPENED.clear()
    results = list(answer.answer(tmp_path / "exam", tmp_path / "out", 2, (sys.executable, str(script))))
    assert OPENED
    assert not [name for name in OPENED if "key" in name]
    assert {r["clip"]: r["status"] for r in results} == {"000": 0, "001": 0, "002": 3}
    assert all(r["seconds"] > 0 and r["peak_mb"] > 1 for r in results)
    words = json.loads((tmp_path / "out/001/words.json").read_text())
    assert words[-4:] == ["--seed", "0", "--without", "drag"]
    assert words[0] == "diagnose"
    assert not any("key" in word for word in words)
    again = list(answer.answer(tmp_path / "exam", tmp_path / "out", 1, (sys.executable, str(script))))
    assert [r["clip"] for r in again] == ["002"]
    with pytest.raises(ValueError, match="1 of 3 clips have no answer yet: 002"):
        score.marks(tmp_path / "exam", tmp_path / "out")


# ---- scoring --------------------------------------------------------------------------------------------------------


def key_of(split, *effects, accepts=()):
    listed = [
        {"effect": n, "target": t, "parameters": p, "px": px, "acts": acts, "object": t, "speed": 2.0}
        for n, t, p, px, acts in effects
    ]
    return {"split": split, "effects": listed, "accepts": list(accepts), "flow": "exact", "kind": "flight"}


def said(*names, p=0.9, groups=(), candidates=(), where=(), closed=0.8):
    return {
        "verdict": {"effects": list(names), "probability": p, "indistinguishable": [list(g) for g in groups]},
        "gap": {"closed": closed},
        "where": list(where),
        "candidates": [
            {"effect": n, "parameters": {k: {"value": v} for k, v in values.items()}} for n, values in candidates
        ],
    }


DRAG = ("drag", "sphere_0", {"linear": 0.0, "quadratic": 0.1}, 10.0, [0, 29])
PUSH = ("push", "sphere_0", {"time": 0.4, "x": 3.0, "y": 4.0, "z": 0.0}, 30.0, [12, 13])
RAN = {"seconds": 20.0, "peak_mb": 300.0}


def judge(key, diagnosis):
    return marks.mark("000", key, diagnosis, RAN)


def test_marks_of_one_effect():
    key = key_of("one", DRAG)
    hit = judge(key, said("drag", candidates=[("drag", {"linear": 0.05, "quadratic": 0.1})]))
    assert (hit.right, hit.first, hit.near) == (True, True, True)
    assert hit.errors == {"drag: force at the clip's speed": pytest.approx(0.25)}
    second = judge(key, said("wind", candidates=[("wind", {}), ("drag", {})]))
    assert (second.right, second.first, second.near) == (False, False, True)
    assert second.errors == {}
    declared = judge(key, said("wind", groups=[("wind", "drag")], candidates=[("wind", {}), ("slope", {})]))
    assert (declared.first, declared.near) == (False, True)
    elsewhere = judge(key, said("wind", groups=[("slope", "drag")], candidates=[("wind", {}), ("slope", {})]))
    assert not elsewhere.near
    both = judge(key, said("drag", "push"))
    assert (both.right, both.first) == (False, True)
    assert not judge(key, said()).near


def test_marks_of_places_and_vectors():
    key = key_of("one", PUSH)
    found = [("push", {"time": 0.43, "x": 3.0, "y": 3.0, "z": 0.0})]
    where = [{"object": "sphere_0", "frames": [11, 16]}]
    m = judge(key, said("push", candidates=found, where=where))
    assert (m.object_right, m.frames_right, m.since_right) == (True, True, False)
    assert m.errors["push: impulse"] == pytest.approx(0.2)
    assert m.errors["push: time [s]"] == pytest.approx(0.03)
    late = judge(key, said("push", where=[{"object": "box_0", "frames": [12, 29]}]))
    assert (late.object_right, late.frames_right, late.since_right) == (False, False, True)
    assert judge(key, said("push")).frames_right is False
    assert judge(key_of("one", DRAG), said("drag")).object_right is None
    assert marks.overlap((0, 9), (5, 14)) == pytest.approx(5 / 15)
    assert marks.overlap((0, 3), (5, 9)) == 0


def test_marks_of_the_other_splits():
    two = key_of("two", DRAG, PUSH)
    assert judge(two, said("push", "drag")).right
    assert (judge(two, said("push")).right, judge(two, said("push")).first) == (False, True)
    assert judge(key_of("none"), said()).right
    assert not judge(key_of("none"), said("unknown")).right
    withheld = key_of("withheld", DRAG)
    assert judge(withheld, said("unknown")).right
    assert not judge(withheld, said("drag")).right
    strange = key_of("strange", ("growing_force", "sphere_0", {}, 20.0, [0, 29]), accepts=("wind",))
    assert judge(strange, said("unknown")).right
    assert judge(strange, said("wind")).right
    assert not judge(strange, said()).right


def test_calibration_error_by_hand():
    # In the last bin: three at 0.9, two right: |2 - 2.7| = 0.7. In the sixth: two at 0.5, none right: 1.0.
    assert score.calibration_error([0.9, 0.9, 0.9, 0.5, 0.5], [True, True, False, False, False]) == pytest.approx(
        1.7 / 5
    )
    assert score.calibration_error([1.0, 0.0], [True, False]) == 0


def test_report_by_hand(tmp_path):
    small_exam(tmp_path / "exam", 5)
    cases = [
        (key_of("one", DRAG), said("drag", candidates=[("drag", {"linear": 0.0, "quadratic": 0.11})])),
        (key_of("one", PUSH), said("drag", p=0.5, candidates=[("drag", {})])),
        (key_of("two", DRAG, PUSH), said("drag", "push", p=0.7, closed=0.6)),
        (key_of("none"), said("wind", p=0.6)),
        (key_of("withheld", DRAG), said("unknown", p=0.8)),
    ]
    for number, (key, diagnosis) in enumerate(cases):
        (tmp_path / f"exam/key/{number:03d}.json").write_text(json.dumps(key))
        folder = tmp_path / f"out/{number:03d}"
        folder.mkdir(parents=True)
        (folder / "diagnosis.json").write_text(json.dumps(diagnosis))
        (folder / "answer.json").write_text(json.dumps({"status": 0, "seconds": 10.0 * number, "peak_mb": 200}))
    text = score.report(score.marks(tmp_path / "exam", tmp_path / "out"))
    for line in (
        "| one effect: right name first | 1/2 (50 %) |",
        "| two effects: both names, no other | 1/1 (100 %) |",
        "| no effect: false alarms | 1/1 (100 %) |",
        "| withheld effect: unknown | 1/1 (100 %) |",
        "| strange effect: unknown, or another name that the key accepts | - |",
        "| gap closed where the verdict is right, median | 0.70 |",
        "| seconds a clip, median (worst) | 20 (40) |",
        "Expected calibration error 0.340.",  # (0.1 + 0.5 + 0.3 + 0.6 + 0.2) / 5
        "| 6-12 px | 1/1 (100 %) | 1/1 (100 %) |",
        "| 24-40 px | 0/1 (0 %) | 0/1 (0 %) |",
        "| drag: force at the clip's speed | 1 | 10 % |",
        "| push | 1 |  |  |",
    ):
        assert line in text
    assert "| 001 | push | 30.0 |  | drag | - |" in text  # missed
    assert "left by a refit" not in text
    lefts = {"000": [2.0], "001": [7.5], "002": [4.0, 3.5], "004": [1.0]}
    measured = {clip: {"effects": [{"px_left": px} for px in each]} for clip, each in lefts.items()}
    (tmp_path / "exam/left.json").write_text(json.dumps({"clips": measured}))
    more = score.report(score.marks(tmp_path / "exam", tmp_path / "out"))
    for line in (
        "| what the base model's refit leaves (4 of 4 clips measured) | result |",
        "| one effect, of those with >= 3 px left: first | 0/1 (0 %) |",
        "| one effect, of those with >= 3 px left: first two | 0/1 (0 %) |",
        "| two effects, both with >= 3 px left: both names, no other | 1/1 (100 %) |",
        "| withheld effect with >= 3 px left: unknown | - |",
        "| 1-3 px | 1/1 (100 %) | 1/1 (100 %) |",
        "| 6-12 px | 0/1 (0 %) | 0/1 (0 %) |",
        "| 12-40+ px | - | - |",
        "| 001 | push | 30.0 | 7.5 | drag | - |",
    ):
        assert line in more
    assert set(text.splitlines()) - set(more.splitlines()) == {"| 001 | push | 30.0 |  | drag | - |"}
    # What the key tells is taken where nothing was measured afterwards.
    (tmp_path / "exam/left.json").unlink()
    for clip, each in lefts.items():
        path = tmp_path / f"exam/key/{clip}.json"
        key = json.loads(path.read_text())
        for effect, px in zip(key["effects"], each, strict=True):
            effect["px_left"] = px
        path.write_text(json.dumps(key))
    assert score.report(score.marks(tmp_path / "exam", tmp_path / "out")) == more
    (tmp_path / "out/003/diagnosis.json").write_text('{"format": 1}')
    with pytest.raises(ValueError, match=r"003/diagnosis\.json: KeyError 'verdict'"):
        score.marks(tmp_path / "exam", tmp_path / "out")
