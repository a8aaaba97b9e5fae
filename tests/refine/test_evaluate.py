"""Evaluation of a folder of predictions, against a second implementation in plain numpy."""

import csv
import itertools
import math

import numpy as np
import pytest

from benchmarks.bad_cases import scene_text
from mjx_refine.cli.main import run
from mjx_refine.evaluate import METRICS, Judged, best_of, evaluate_folder, paired
from mjx_refine.observation import save_observation
from mjx_refine.scene import Scene, parse_scenes
from mjx_refine.simulate import simulate

SIZE, FRAMES = (96, 64), 6
OPTIONS = ["--size", "96x64", "--frames", "6"]


def box(**changes) -> str:
    return scene_text({f"0.{k.replace('__', '.')}": v for k, v in changes.items()})


TRUTHS = {"a": box(), "b": box(state__position=[-0.8, 0.2, 0.2], physics__damping=-30)}
EXTRA = {"type": "sphere", "name": "more", "radius": 0.15, "state": {"position": [-0.9, 0.9, 0.15]}}
RENAMED = """
- {type: sphere, name: first, radius: 0.21, state: {position: [0.75, 0.55, 0.21]}, physics: {friction: [0.7, 0.02]}}
- {type: box, name: last, size: [0.3, 0.2, 0.2], state: {position: [0.1, 0.4, 0.25], linear_velocity: [1.5, 0, 0]}}
- {type: camera, orientation: 45, position: [0, -2, 3.5]}
"""
PREDICTIONS = {
    "a": [scene_text(extra=[EXTRA]), box(state__position=[0.1, 0.5, 0.2]), "- {type: cone}\n", RENAMED],
    "b": [
        "I see a box.\n",
        box(state__linear_velocity=[0.5, 0.1, 0]),
        box(state__position=[-0.7, 0.2, 0.3]),
        TRUTHS["b"],
    ],
}


@pytest.fixture
def folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("told", "true"):
        (tmp_path / name).mkdir()
    for name, text in TRUTHS.items():
        (tmp_path / "true" / f"{name}.yaml").write_text(text)
        (tmp_path / "told" / f"{name}.yaml").write_text("---\n".join(PREDICTIONS[name]))
    # One clip is given, the other simulated. Flow that was not measured does not count.
    observation = simulate(parse_scenes(TRUTHS["a"])[0], SIZE, FRAMES)
    observation.flow[:, :5] = np.nan
    save_observation(tmp_path / "true" / "a.npz", observation)
    return tmp_path


def plain(text: str, truth: Scene, observation) -> dict[str, float]:
    """One sample's metrics, by loops."""
    nan = math.nan
    found = dict.fromkeys(METRICS, nan) | {"composition": 0.0, "iou": 0.0, "first_frame_iou": 0.0}
    try:
        scene = parse_scenes(text)[0]
    except ValueError:
        return found
    seen = simulate(scene, SIZE, FRAMES)
    ious = []
    for ours, theirs in zip(seen.masks > 0, observation.masks > 0, strict=True):
        ious.append((ours & theirs).sum() / (ours | theirs).sum())
    errors = [np.hypot(*np.moveaxis(seen.flow[t] - observation.flow[t], -1, 0)) for t in range(FRAMES - 1)]
    found |= {"iou": float(np.mean(ious)), "first_frame_iou": ious[0], "first_frame_epe": float(np.nanmean(errors[0]))}
    found["epe"] = float(np.nanmean(errors))
    if sorted(scene.shapes) != sorted(truth.shapes):
        return found
    found["composition"] = 1.0
    pairings = [
        list(zip(order, truth.objects, strict=True))
        for order in itertools.permutations(scene.objects)
        if all(a.shape == b.shape for a, b in zip(order, truth.objects, strict=True))
    ]
    pairs = min(pairings, key=lambda pairs: sum(math.dist(a.position, b.position) for a, b in pairs))
    parts = {"position": [], "velocity": [], "damping": [], "sliding_friction": [], "rolling_friction": []}
    for a, b in pairs:
        parts["position"] += [abs(p - q) for p, q in zip(a.position, b.position, strict=True)]
        parts["velocity"] += [abs(p - q) for p, q in zip(a.linear_velocity, b.linear_velocity, strict=True)]
        parts["damping"].append(abs(a.damping - b.damping))
        parts["sliding_friction"].append(abs(a.friction[0] - b.friction[0]))
        parts["rolling_friction"].append(abs(a.friction[1] - b.friction[1]))
    return found | {name: sum(values) / len(values) for name, values in parts.items()}


def test_it_agrees_with_a_plain_implementation(folders):
    evaluation = evaluate_folder(folders / "told", folders / "true", (1, 2, 4, 9), SIZE, FRAMES)
    from mjx_refine.observation import load_observation

    clips = {
        "a": load_observation(folders / "true" / "a.npz"),
        "b": simulate(parse_scenes(TRUTHS["b"])[0], SIZE, FRAMES),
    }
    means: dict[int, dict[str, list[float]]] = {k: {name: [] for name in METRICS} for k in (1, 2, 4, 9)}
    for name, texts in PREDICTIONS.items():
        judged = [plain(text, parse_scenes(TRUTHS[name])[0], clips[name]) for text in texts]
        for count in (1, 2, 4, 9):
            ranked = [one["iou"] - one["epe"] if math.isfinite(one["epe"]) else -math.inf for one in judged[:count]]
            expected = judged[int(np.argmax(ranked))]
            (row,) = (row for row in evaluation.rows if (row.clip, row.best_at) == (name, count))
            assert row.judged.index == int(np.argmax(ranked))
            assert row.samples == 4
            for metric in METRICS:
                got = getattr(row.judged, metric)
                assert got == pytest.approx(
                    expected[metric], abs=2e-3 if "epe" in metric or "iou" in metric else 1e-9, nan_ok=True
                )
                means[count][metric].append(expected[metric])
    for count, values in evaluation.means().items():
        for metric, value in values.items():
            numbers = [v for v in means[count][metric] if math.isfinite(v)]
            assert value == pytest.approx(np.mean(numbers) if numbers else math.nan, abs=2e-3, nan_ok=True)
    best = evaluation.means()[4]
    assert best["iou"] > evaluation.means()[1]["iou"]
    assert [clip for clip, _ in evaluation.unread] == ["a", "b"]


def test_objects_are_paired_by_shape_and_place():
    truth, renamed = parse_scenes(TRUTHS["a"])[0], parse_scenes(RENAMED)[0]
    assert sorted((a.name, b.name) for a, b in paired(renamed, truth)) == [("first", "sphere_0"), ("last", "box_0")]
    two = parse_scenes(scene_text(extra=[EXTRA]))[0]
    assert paired(two, truth) is None
    swapped = Scene((two.objects[0], two.objects[2], two.objects[1]), two.camera)
    assert all(a.name == b.name for a, b in paired(swapped, two))


def test_ties_go_to_the_first_and_unread_samples_to_nobody():
    judged = [Judged(0), Judged(1, iou=0.2, epe=0.1), Judged(2, iou=0.2, epe=0.1), Judged(3, iou=0.9, epe=0.9)]
    assert [best_of(judged, count).index for count in (1, 2, 3, 4)] == [0, 1, 1, 1]


def test_the_command_prints_a_table_and_writes_csv(folders, capsys):
    assert (
        run(["evaluate", "--predictions", "told", "--truths", "true", "--out", "t.csv", "--best", "1,4", *OPTIONS]) == 0
    )
    captured = capsys.readouterr()
    assert captured.out.splitlines()[1].startswith("Best@1")
    assert "2 clips; t.csv" in captured.out
    assert captured.err.count("counted as wrong") == 2
    with open("t.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["clip"], row["best_at"]) for row in rows] == [
        ("a", "1"), ("b", "1"), ("a", "4"), ("b", "4"), ("mean", "1"), ("mean", "4"),
    ]  # fmt: skip
    evaluation = evaluate_folder(folders / "told", folders / "true", (4,), SIZE, FRAMES)
    assert float(rows[-1]["iou"]) == pytest.approx(evaluation.means()[4]["iou"], abs=1e-6)
    assert rows[0]["position"] == ""  # of the first sample of "a" the composition is wrong
    assert float(rows[3]["epe"]) < 0.01
    assert float(rows[3]["composition"]) == 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--predictions", "told"], "--truths"),
        (["--truths", "true"], "--predictions"),
        (["--scene", "true/a.yaml"], "--video"),
        (["--scene", "true/a.yaml", "--video", "true/a.npz", "--out", "t.csv"], "leave it out"),
        (["--predictions", "told", "--truths", "true", "--scene", "a"], "leave it out"),
        (["--predictions", "none", "--truths", "true"], "none: no such folder"),
        (["--predictions", "told", "--truths", "."], "no .yaml file"),
        (["--predictions", "true", "--truths", "odd"], "odd"),
        (["--predictions", "told", "--truths", "true", "--best", "0"], "1,32"),
        (["--predictions", "told", "--truths", "true", "--best", "1,,2"], "1,32"),
        (["--predictions", "told", "--truths", "true", "--out", "none/t.csv"], "none"),
    ],
)
def test_bad_calls(arguments, says, folders, capsys):
    (folders / "odd").mkdir()
    (folders / "odd" / "z.yaml").write_text(TRUTHS["a"])
    before = sorted(folders.rglob("*"))
    assert run(["evaluate", *arguments, *OPTIONS]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert says in captured.err
    assert captured.out == ""
    assert sorted(folders.rglob("*")) == before


def test_a_missing_prediction_and_a_wrong_truth_are_told(folders, capsys):
    (folders / "told" / "b.yaml").rename(folders / "c.yaml")
    assert run(["evaluate", "--predictions", "told", "--truths", "true", *OPTIONS]) == 2
    assert "told: there is no b.yaml" in capsys.readouterr().err
    (folders / "c.yaml").rename(folders / "told" / "b.yaml")
    (folders / "true" / "b.yaml").write_text("- {type: cone}")
    assert run(["evaluate", "--predictions", "told", "--truths", "true", *OPTIONS]) == 2
    assert "b.yaml: entry 0.type = 'cone'" in capsys.readouterr().err
