"""The paper's tables, against the same figures computed plainly here."""

from __future__ import annotations

import csv
import json
import math

import numpy as np
import pytest

from benchmarks.bad_cases import scene_text
from benchmarks.paper_tables import HEADS, SCORES, collect, load_refinements, means, run
from mjx_refine.observation import save_observation
from mjx_refine.scene import parse_scenes
from mjx_refine.simulate import simulate

SIZE, FRAMES = (96, 64), 6
BALL = {"type": "sphere", "name": "more", "radius": 0.15, "state": {"position": [-0.9, 0.9, 0.15]}}


def cells(line):
    return [cell.strip() for cell in line.strip().split("|")[1:-1]]


def table_of(text):
    """Rows of a Markdown table, by their first cell."""
    lines = [cells(line) for line in text.splitlines() if line.startswith("|")]
    return {line[0]: line[1:] for line in lines[2:]}, lines[0]


@pytest.fixture
def refined(tmp_path):
    """Three refinements: one better, one whose first frame is worse, one without an end-point error before."""
    rng = np.random.default_rng(3)
    told = {}
    for name in ("a", "b", "c"):
        before, after = (dict(zip(SCORES, rng.uniform(0.1, 0.9, 4).round(6).tolist(), strict=True)) for _ in range(2))
        before["first_frame_iou"], after["first_frame_iou"] = (0.8, 0.7) if name == "b" else (0.5, 0.6)
        before["iou"] = 0.05
        if name == "c":
            before["epe"] = None
        told[name] = {"init": before, "refined": after, "seconds": {"total": 10.0 * len(told)}}
        folder = tmp_path / "out" / name
        folder.mkdir(parents=True)
        (folder / "result.json").write_text(json.dumps(told[name]))
    return tmp_path / "out", told


def test_refinements_beside_the_paper(refined, capsys):
    out, told = refined
    assert run(["refinement", str(out)]) == 0
    text = capsys.readouterr().out
    rows, heads = table_of(text)
    assert heads == ["", "clips", "IoU", "first frame", "EPE px", "first frame", "s a clip"]
    assert rows["paper: best of 32 samples"] == ["", "0.380", "0.760", "5.170", "–", ""]
    assert rows["paper: with CMA-ES"] == ["", "0.660", "0.620", "0.110", "–", ""]
    for label, part, seconds in (("out: best sample", "init", ""), ("out: refined", "refined", "10")):
        values = [[one[part][key] for one in told.values() if one[part][key] is not None] for key in SCORES]
        assert rows[label] == ["3", *(f"{sum(v) / len(v):.3f}" for v in values), seconds]
    assert "out: IoU lower than the sample's in 0 of 3 clips" in text
    assert "out: first frame's IoU lower than the sample's in 1 of 3 clips" in text
    worst = min(told, key=lambda name: told[name]["refined"]["iou"])
    assert f"out: least IoU {told[worst]['refined']['iou']:.3f} ({worst})" in text
    before = means([one.before for one in load_refinements(out)])
    assert before["epe"] == pytest.approx((told["a"]["init"]["epe"] + told["b"]["init"]["epe"]) / 2)


def plain(text, truth, observation):
    """A sample's figures by plain numpy; its objects are in the truth's order."""
    scene = parse_scenes(text)[0]
    seen = simulate(scene, SIZE, FRAMES)
    found = dict.fromkeys(HEADS, math.nan)
    overlap = (seen.masks > 0) & (observation.masks > 0)
    either = (seen.masks > 0) | (observation.masks > 0)
    iou = overlap.sum((1, 2)) / either.sum((1, 2))
    error = np.sqrt(((seen.flow - observation.flow) ** 2).sum(-1))
    found |= {"iou": iou.mean(), "first_frame_iou": iou[0], "epe": error.mean(), "first_frame_epe": error[0].mean()}
    found["composition"] = float(sorted(scene.shapes) == sorted(truth.shapes))
    if found["composition"]:
        pairs = list(zip(scene.objects, truth.objects, strict=True))

        def mean(value):
            return np.mean([np.abs(np.array(value(a)) - np.array(value(b))) for a, b in pairs])

        found |= {
            "position": mean(lambda body: body.position),
            "velocity": mean(lambda body: body.linear_velocity),
            "damping": mean(lambda body: body.damping),
            "sliding_friction": mean(lambda body: body.friction[0]),
            "rolling_friction": mean(lambda body: body.friction[1]),
        }
    return found


def changed(**changes):
    return scene_text({f"0.{key.replace('__', '.')}": value for key, value in changes.items()})


TRUTHS = {"one": changed(), "two": changed(physics__damping=-30, state__position=[-0.6, 0.3, 0.2])}
SAMPLES = {
    "one": [scene_text(extra=[BALL]), changed(state__position=[0.1, 0.45, 0.2], physics__friction=[0.9, 0.02])],
    "two": [changed(state__linear_velocity=[0.4, 0.1, 0]), TRUTHS["two"], changed(physics__damping=-10)],
}


@pytest.fixture
def sets(tmp_path):
    """The same truths as flat files and as clip folders, and samples."""
    for name, text in TRUTHS.items():
        seen = simulate(parse_scenes(text)[0], SIZE, FRAMES)
        flat, nested = (
            (tmp_path / "flat", f"{name}.yaml", f"{name}.npz"),
            (tmp_path / "set" / name, "truth.yaml", "flows.npz"),
        )
        for place, scene, clip in (flat, nested):
            place.mkdir(parents=True, exist_ok=True)
            (place / scene).write_text(text)
            save_observation(place / clip, seen)
        (tmp_path / "set" / name / "guess.yaml").write_text("---\n".join(SAMPLES[name]))
        (tmp_path / "told").mkdir(exist_ok=True)
        (tmp_path / "told" / f"{name}.yaml").write_text("---\n".join(SAMPLES[name]))
        (tmp_path / "out" / name).mkdir(parents=True)
        (tmp_path / "out" / name / "refined.yaml").write_text(SAMPLES[name][-1])
    return tmp_path


def expected(count):
    """Means over the clips of the best of the first `count` samples."""
    chosen = []
    for name, text in TRUTHS.items():
        truth = parse_scenes(text)[0]
        judged = [plain(sample, truth, simulate(truth, SIZE, FRAMES)) for sample in SAMPLES[name][:count]]
        chosen.append(max(judged, key=lambda one: one["iou"] - one["epe"]))
    return {key: np.nanmean([one[key] for one in chosen]) for key in HEADS}


def test_evaluation_agrees_with_plain_numpy(sets, capsys):
    call = ["evaluation", f"{sets}/set", "--best", "1,3", "--csv", f"{sets}/table.csv"]
    told = ["--predictions", f"guess={sets}/set/*/guess.yaml", "--predictions", f"refined={sets}/out"]
    assert run([*call, *told]) == 0
    rows, heads = table_of(capsys.readouterr().out)
    assert heads == ["", "clips", *HEADS.values()]
    assert list(rows) == ["guess, Best@1", "guess, Best@3", "refined"]
    for count in (1, 3):
        got = [float(cell) for cell in rows[f"guess, Best@{count}"]]
        assert got[0] == 2
        assert np.allclose(got[1:], list(expected(count).values()), atol=2e-3)
    assert expected(3)["iou"] > expected(1)["iou"] + 0.1
    assert rows["guess, Best@1"][1] == "0.500"
    lines = list(csv.DictReader((sets / "table.csv").read_text().splitlines()))
    assert [(line["predictor"], line["clip"], line["best_at"]) for line in lines[:3]] == [
        ("guess", "one", "1"),
        ("guess", "two", "1"),
        ("guess", "one", "3"),
    ]
    assert lines[0]["position"] == ""  # wrong objects


def test_flat_folders_say_the_same(sets, capsys):
    for truths, told in (("set", "set/*/guess.yaml"), ("flat", "told")):
        assert run(["evaluation", f"{sets}/{truths}", "--best", "1,3", "--predictions", f"guess={sets}/{told}"]) == 0
    first, second = capsys.readouterr().out.split("|  | clips")[1:]
    assert first == second


def test_what_cannot_be_read_counts_as_wrong(sets, capsys):
    (sets / "told" / "one.yaml").write_text("- {type: cone}\n")
    assert run(["evaluation", f"{sets}/flat", "--best", "1", "--predictions", f"x={sets}/told"]) == 0
    printed = capsys.readouterr()
    assert "x: one: counted as wrong" in printed.err
    rows, _ = table_of(printed.out)
    assert float(rows["x, Best@1"][2]) == pytest.approx(plain(SAMPLES["two"][0], *_two())["iou"] / 2, abs=2e-3)


def _two():
    truth = parse_scenes(TRUTHS["two"])[0]
    return truth, simulate(truth, SIZE, FRAMES)


def test_scene_files_are_found(sets):
    assert {path.name for path in collect(sets / "out").values()} == {"refined.yaml"}
    assert collect(sets / "told").keys() == TRUTHS.keys()


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (["refinement", "nowhere"], "no NAME/result.json"),
        (["refinement", "broken"], "refine that clip again"),
        (["refinement"], "Missing argument"),
        (["evaluation", "nowhere", "--predictions", "a=told"], "no such folder"),
        (["evaluation", "flat", "--predictions", "told"], "expected LABEL=FOLDER"),
        (["evaluation", "flat", "--predictions", "a=told", "--predictions", "a=told"], "each label once"),
        (["evaluation", "flat", "--predictions", "a=set/*/none.yaml"], "no */none.yaml"),
        (["evaluation", "flat", "--predictions", "a=other"], "no truth of that name"),
        (["evaluation", "flat", "--predictions", "a=told", "--best", "0"], "whole numbers from 1"),
        (["evaluation", "flat", "--predictions", "a=told", "--csv", "no/table.csv"], "there is no directory"),
        (["evaluation", "bare", "--predictions", "a=told"], "not there yet"),
    ],
)
def test_wrong_calls(sets, monkeypatch, capsys, call, says):
    monkeypatch.chdir(sets)
    for name, text in (("broken/a/result.json", "{}"), ("other/x.yaml", ""), ("bare/one/truth.yaml", TRUTHS["one"])):
        path = sets / name
        path.parent.mkdir(parents=True)
        path.write_text(text)
    before = sorted(sets.rglob("*"))
    assert run(call) == 2
    said = capsys.readouterr()
    assert says in said.err
    assert said.err.startswith("paper_tables: ")
    assert said.err.count("\n") == 1
    assert said.out == ""
    assert sorted(sets.rglob("*")) == before
