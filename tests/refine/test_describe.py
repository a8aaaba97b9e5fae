"""Descriptions: what they say is true of the simulation, and what is not true is noticed."""

import dataclasses
import re

import mujoco
import numpy as np
import pytest

from benchmarks.bad_cases import scene_text
from benchmarks.describe import falsified, random_scene, run
from mjx_refine.batch import batch_from_scenes
from mjx_refine.cli.main import run as cli
from mjx_refine.describe import check_description, describe, faults, parse_description, parse_sentences, record
from mjx_refine.describe import statements as s
from mjx_refine.describe.classes import BORDERS, direction_word, pace_word, place_word
from mjx_refine.describe.phrases import PHRASES, TEMPLATES
from mjx_refine.describe.tell import contact_spans
from mjx_refine.errors import InputError
from mjx_refine.export import export_xml
from mjx_refine.scene import Effect, dump_scene, load_scene, parse_scenes
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.simulate import simulate

SMALL = (96, 64)


@pytest.fixture(scope="module")
def scene():
    """A box that slides into a ball which falls."""
    text = scene_text({"0.state.position": [-1.0, 0.5, 0.2], "0.state.linear_velocity": [4.0, 0.0, 0.0],
                       "1.state.position": [0.4, 0.5, 0.6]})  # fmt: skip
    return parse_scenes(text)[0]


@pytest.fixture(scope="module")
def told(scene):
    return describe(scene, size=SMALL)


def test_thirty_random_scenes_hold_no_false_statement():
    tally = run(30, 5000, SMALL, mutants=4, most=2)  # each kind of scene compiles once
    assert tally.faults == []
    assert tally.unnoticed == []
    assert tally.scenes + tally.refused == 30
    assert tally.sentences > 500
    assert tally.mutants == 4 * tally.scenes


def test_the_record_is_the_reference_rollout(scene):
    seen = record(scene, frames=20, size=SMALL)
    reference = MujocoSimulator(scene.shapes, 30.0).rollout(batch_from_scenes([scene]), 20)[0]
    np.testing.assert_allclose(seen.poses, reference, atol=1e-9)
    masks = simulate(scene, SMALL, 20).masks
    counted = [[(masks[t] == k + 1).sum() for k in range(2)] for t in range(20)]
    assert seen.pixels.tolist() == counted


def test_contacts_and_speeds_are_those_of_the_exported_model(scene):
    seen = record(scene, size=SMALL)
    model = mujoco.MjModel.from_xml_string(export_xml(scene))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    names = ["floor", *scene.names]
    for k in range(60):
        mujoco.mj_forward(model, data)
        touching = {frozenset(names.index(model.geom(int(g)).name) for g in pair) for pair in data.contact.geom}
        said = {frozenset((a + 1, b + 1)) for (a, b), touch in zip(seen.pairs, seen.touching[k], strict=True) if touch}
        assert touching == said, k
        np.testing.assert_allclose(seen.velocity[k], data.qvel.reshape(2, 6)[:, :3], atol=1e-5)
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, model.body("box_0").id, velocity, 0)
        np.testing.assert_allclose(seen.spin[k, 0], velocity[:3], atol=1e-4)
        mujoco.mj_step(model, data)


def test_the_answer_is_the_scene_as_it_is_written(scene, told):
    answer = re.search(r"<answer>\n(.*)</answer>\n\Z", told.text, re.DOTALL)
    assert answer is not None
    assert answer[1] == dump_scene(scene)
    assert told.text.startswith("<think>\n")
    parsed, again = parse_description(told.text)
    assert again == scene
    assert parsed.statements == told.statements
    assert parsed.problems == ()


def test_what_happens_is_told(told):
    kinds = {type(statement) for statement in told.statements}
    assert {s.Seen, s.Placed, s.Moving, s.Still, s.Grounded, s.HitsFloor, s.Collide, s.Fastest} <= kinds
    collide = next(statement for statement in told.statements if isinstance(statement, s.Collide))
    gap = np.linalg.norm(told.record.position[:, 0, :2] - told.record.position[:, 1, :2], axis=-1)
    at = round(collide.times[0] / told.record.step)
    assert 0.3 < gap[at] < 0.6  # half a box's length and a ball's radius


def test_same_seed_same_words_and_another_seed_the_same_statements(scene, told):
    assert describe(scene, size=SMALL).text == told.text
    other = describe(scene, size=SMALL, seed=1)
    assert other.text != told.text
    assert other.statements == told.statements


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (r"collide at 0\.\d\d|hits sphere_0 at 0\.\d\d|At 0\.\d\d s box_0 and", "0.77"),  # a wrong time
        (r"moderately left|slightly left|near center", "far right"),  # a wrong class
        (r"fast to the right|to the right fast", None),
    ],
)
def test_a_changed_description_is_caught(told, before, after):
    match = re.search(before, told.text)
    assert match is not None
    if after is None:
        changed = match[0].replace("right", "left")
    elif after.startswith("0."):
        changed = re.sub(r"0\.\d\d", after, match[0])
    else:
        changed = after
    text = told.text[: match.start()] + changed + told.text[match.end() :]
    _, found = check_description(text)
    assert len(found) == 1
    assert check_description(told.text)[1] == ()


def test_a_wrong_object_is_caught(told):
    swap = {"box_0": "sphere_0", "sphere_0": "box_0"}
    for line in told.text.splitlines()[2:4]:
        swapped = re.sub(r"box_0|sphere_0", lambda match: swap[match[0]], line)
        found = faults(parse_sentences(swapped), told.record)
        assert len(found) >= 4
    (nobody,) = faults(parse_sentences("cat_9 is never in view."), told.record)
    assert "no cat_9" in nobody.reason


@pytest.mark.parametrize(
    ("sentence", "reason"),
    [
        ("box_0 never leaves the flour.", "no known form"),
        ("It never moves.", "before `it`"),
        ("There are 3 objects: box_0 (box) and sphere_0 (sphere).", "3 objects"),
        ("box_0 never moves", "full stop"),
        ('"box_0 never moves.', "full stop"),
        ("No two objects touch each other.", "touch"),
        ("box_0 and box_0 collide at 0.40 s.", "itself"),
        ("box_0 and sphere_0 touch from the start.", "not touch"),
        ("box_0 is never in view.", "shows in"),
        ("sphere_0 never touches the floor.", "touches"),
        ("sphere_0 never leaves the floor.", "contact"),
        ("sphere_0 is on the floor from 0.00 s to 0.97 s.", "contact"),
        ("sphere_0 never moves.", "moves at"),
        ("box_0 comes to rest at 0.10 s.", "rest"),
    ],
)
def test_false_and_unknown_sentences_are_caught(sentence, reason, told):
    (fault,) = faults(parse_sentences(sentence), told.record)
    assert reason in fault.reason


def test_it_is_the_object_of_the_sentence_before():
    parsed = parse_sentences(
        "box_0 never moves. It is never in view.\nsphere_0 never moves. It never leaves the floor."
    )
    assert parsed.statements == (
        s.RestsThroughout("box_0"), s.NeverSeen("box_0"), s.RestsThroughout("sphere_0"), s.GroundedThroughout("sphere_0"),
    )  # fmt: skip


@pytest.mark.parametrize("kind", PHRASES, ids=lambda kind: kind.__name__)
def test_every_paraphrase_can_be_read(kind, scene):
    examples = {
        "object": 'a "red" ball. It, </think>', "first": "box_0", "second": "it", "when": "end", "x": "near center",
        "y": "far to the back", "z": "near the floor", "pace": "fast", "direction": "to the left and back, rising",
        "times": (0.1, 0.25, 3.0), "spans": ((0.0, 0.5), (0.75, 1.0)), "objects": (("a", "box"), ("b.", "sphere")),
    }  # fmt: skip
    values = {}
    for field in dataclasses.fields(kind):
        number = {"int": 7, "float": 1.25}.get(str(field.type))
        values[field.name] = examples[field.name] if number is None else number
    statement = kind(**values)
    rng = np.random.default_rng(0)
    assert len(PHRASES[kind]) >= 2
    for template in TEMPLATES[kind] * 3:
        parsed = parse_sentences(template.write(statement, rng, False) + ".")
        assert parsed.problems == ()
        assert parsed.statements == (statement,)


def test_odd_names_are_told_and_read(scene):
    names = ('the "box". It never moves', "and </think> é")
    odd = dataclasses.replace(
        scene, objects=tuple(dataclasses.replace(b, name=n) for b, n in zip(scene.objects, names, strict=True))
    )
    parsed, found = check_description(describe(odd, frames=6, size=SMALL).text)
    assert parsed.problems == ()
    assert found == ()


def test_a_scene_that_cannot_be_read_back_is_refused(scene):
    odd = dataclasses.replace(
        scene, objects=(dataclasses.replace(scene.objects[0], name="</answer>"), scene.objects[1])
    )
    with pytest.raises(InputError, match="rename"):
        describe(odd, frames=2, size=SMALL)


@pytest.mark.parametrize(
    ("value", "x"),
    [(-2.001, "far left"), (-2.0, "moderately left"), (-1.25, "slightly left"), (-0.5, "slightly left"),
     (-0.499, "near center"), (0.499, "near center"), (0.5, "slightly right"), (1.25, "moderately right"),
     (1.999, "moderately right"), (2.0, "far right")],
)  # fmt: skip
def test_places(value, x):
    assert place_word("x", value) == x
    assert list(BORDERS) == sorted(BORDERS)


def test_paces_and_directions():
    assert [pace_word(v) for v in (0.05, 0.3, 2.4, 4.9, 50)] == [
        "very slowly", "slowly", "at a moderate pace", "fast", "very fast",
    ]  # fmt: skip
    cases = {(1, 0, 0): "to the right", (1, 1, 0): "to the right and back", (0, -1, 1): "to the front, rising",
             (0, 0.1, -1): "straight down", (-1, 0, -0.5): "to the left, falling"}  # fmt: skip
    assert {v: direction_word(np.array(v, float)) for v in cases} == cases


def test_spans_merge_chatter_and_reach_the_ends():
    touching = np.zeros(241, bool)
    touching[[3, 10, 21, 60, 61, 120, 121, 132, 144, 235]] = True
    spans = contact_spans(touching, 1 / 240)
    expected = ((0, 21), (60, 61), (120, 144), (235, 240))
    assert spans == tuple((a / 240, b / 240) for a, b in expected)


def test_effects_on_the_view_are_described_and_on_the_motion_refused(scene):
    hidden = Effect("occluder", None, (("left", 0.0), ("top", 0.0), ("right", 96.0), ("bottom", 64.0)))
    unseen = describe(dataclasses.replace(scene, effects=(hidden,)), frames=4, size=SMALL)
    assert {s.NeverSeen("box_0"), s.NeverSeen("sphere_0")} <= set(unseen.statements)
    drag = Effect("drag", "sphere_0", (("quadratic", 0.05),))
    with pytest.raises(InputError, match="remove"):
        describe(dataclasses.replace(scene, effects=(drag,)), frames=4, size=SMALL)


def test_the_command_writes_a_file_that_is_a_scene(scene, tmp_path, capsys):
    (tmp_path / "scene.yaml").write_text(dump_scene(scene))
    call = ["describe", str(tmp_path / "scene.yaml"), "--frames", "6", "--size", "96x64", "--seed", "4"]
    assert cli(call) == 0
    printed = capsys.readouterr().out
    assert cli([*call, "--out", str(tmp_path / "told.txt")]) == 0
    assert (tmp_path / "told.txt").read_text() == printed
    assert load_scene(tmp_path / "told.txt") == scene


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["none.yaml"], "none.yaml"),
        (["wild.yaml"], "wild.yaml: the simulation diverges"),
        (["good.yaml", "--frames", "1"], "--frames"),
        (["good.yaml", "--size", "2x2"], "--size"),
        (["good.yaml", "--fps", "nan"], "--fps"),
        (["good.yaml", "--seed", "-1"], "--seed"),
        (["good.yaml", "--out", "none/told.txt"], "none"),
        (["good.yaml", "--size", "8192x8192", "--frames", "99"], "good.yaml: 99 frames"),
    ],
)
def test_bad_calls(arguments, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good.yaml").write_text(scene_text())
    wild = {"0.physics.stiffness": 1e7, "0.state.linear_velocity": [9e3, 0, -9e3]}
    (tmp_path / "wild.yaml").write_text(scene_text(wild))
    assert cli(["describe", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert says in captured.err
    assert captured.out == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["good.yaml", "wild.yaml"]


def test_falsified_sentences_differ(told):
    rng = np.random.default_rng(0)
    for _ in range(50):
        parsed = parse_sentences(falsified(told, rng))
        assert parsed.problems or parsed.statements[0] not in told.statements
    assert random_scene(3) == random_scene(3)
