"""Edits: exactly the lines asked for change, what is not understood is refused, and the motion differs as asked."""

import dataclasses
import json
import re

import cv2
import numpy as np
import pytest
from edit_cases import EDITS, REFUSED, TEXT
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from mjx_refine.cli.main import run
from mjx_refine.edit import FORMS, NotUnderstoodError, edit, flo_bytes, write_flo
from mjx_refine.edit.edit import nearest_forms, understood
from mjx_refine.edit.words import clauses
from mjx_refine.errors import InputError
from mjx_refine.observation import load_observation
from mjx_refine.scene import load_scene, parse_scenes
from mjx_refine.simulate import simulate


def body(text: str, name: str):
    scene = parse_scenes(text)[0]
    return scene.objects[scene.names.index(name)]


def changed(instruction: str, text: str = TEXT) -> str:
    return edit(text, instruction).after


def diff(before: str, instruction: str) -> str:
    return "".join(edit(before, instruction).diff(context=0).splitlines(keepends=True)[2:])


@pytest.mark.parametrize(("instruction", "lines"), EDITS, ids=[name for name, _ in EDITS])
def test_exactly_these_lines_change(instruction, lines):
    assert diff(TEXT, instruction) == lines


@pytest.mark.parametrize(("instruction", "says"), REFUSED, ids=[name for name, _ in REFUSED])
def test_what_cannot_be_done_is_refused(instruction, says):
    with pytest.raises(InputError, match=says) as caught:
        edit(TEXT, instruction)
    assert "\n" not in str(caught.value)
    assert re.search("expected|correct|move|rename|lower", str(caught.value))


def test_there_are_enough_cases():
    assert len({name for name, _ in EDITS}) >= 60
    unknown = [name for name, says in REFUSED if says == "not understood"]
    assert len(unknown) >= 20


def test_an_edit_of_nothing_changes_nothing():
    result = edit(TEXT, "set the mass of box_0 to 1.5 kg")
    assert result.after == TEXT
    assert result.diff() == ""


def test_every_form_that_is_offered_is_understood():
    """Each with an object, numbers and names in place of the capitals."""
    scene = parse_scenes(TEXT)[0]
    turning = {"linear_velocity": (1.0, 2.0, 4.0), "angular_velocity": (1.0, 2.0, 4.0)}
    objects = tuple(dataclasses.replace(body, **turning) for body in scene.objects)
    scene = dataclasses.replace(scene, objects=objects, gravity=(0.0, 0.0, -5.0))
    for form in FORMS:
        text = form.replace("OBJECT", "can").replace("[X, Y, Z]", "[3, 3, 3]").replace("NAME", "new_1")
        quantity = "speed" if "m/s" in form else "mass"
        text = text.replace("QUANTITY", quantity).replace("NUMBER", "-3" if "damping" in form else "3")
        step = understood(text, scene)
        assert step.scene != scene or step.removed or step.copied, form


@pytest.mark.parametrize(
    ("words", "form"),
    [
        ("reduce the wobble of @0 by 20%", "reduce the QUANTITY of OBJECT by NUMBER%"),
        ("tilt camera by 10 degrees upwards", "tilt the camera up by NUMBER degrees"),
        ("erase the gravity", "reverse gravity"),
    ],
)
def test_the_nearest_forms_are_near(words, form):
    assert form in nearest_forms(words)


def test_clauses():
    text = 'double the mass of "a and b", then stop it; move box_0 to [1, 2, 3] and sphere_0.\nturn off gravity. Zoom in by 2.5%'
    assert clauses(text, ("box_0", "sphere_0")) == [
        'double the mass of "a and b"', "stop it", "move box_0 to [1, 2, 3] and sphere_0", "turn off gravity",
        "Zoom in by 2.5%",
    ]  # fmt: skip


def test_carriage_returns_thoughts_and_fences_stay():
    text = (
        "<think>\r\nA box.\r\n</think>\r\n<answer>\r\n```yaml\r\n" + TEXT.replace("\n", "\r\n") + "```\r\n</answer>\r\n"
    )
    result = edit(
        text, "double the mass of sphere_0 and set the spin of box_0 to [0, 0, 1] and copy can and halve gravity"
    )
    assert result.after.replace("\r\n", "").count("\n") == 0
    assert result.after.count("\r") == result.after.count("\r\n")
    plain = changed("double the mass of sphere_0; set the spin of box_0 to [0, 0, 1]; copy can; halve gravity")
    assert (
        result.after.replace("\r\n", "\n")
        == "<think>\nA box.\n</think>\n<answer>\n```yaml\n" + plain + "```\n</answer>\n"
    )


def test_a_byte_order_mark_and_a_last_line_without_an_end_stay():
    text = "\ufeff" + TEXT.rstrip("\n")
    assert changed("halve gravity", text) == text + "\n- type: gravity\n  gravity: [0.0, 0.0, -4.905]"
    assert changed("remove can", text).startswith("\ufeff# A box")
    assert "No newline" in edit(text, "zoom in by 10%").diff()


def test_json_is_edited_in_its_own_style():
    text = (
        '[{"type": "sphere", "name": "a", "radius": 0.2, "state": {"position": [0, 0, 1]}}, '
        '{"type": "box", "name": "b", "size": [0.2, 0.2, 0.2], "state": {"position": [1, 0, 1]}},\n'
        ' {"type": "camera", "fovy": 45, "orientation": 45, "position": [0, -2, 3.5]}]\n'
    )
    assert changed('set the radius of "a" to 0.3', text) == text.replace('0.2, "state"', '0.3, "state"')
    assert changed('remove "a"', text) == text[0] + text[text.index('{"type": "box"') :]
    assert changed("copy the box as c at [3, 0, 1]", text) == text.replace(
        "[1, 0, 1]}},",
        '[1, 0, 1]}}, {"type": "box", "name": "c", "size": [0.2, 0.2, 0.2], "state": {"position": [3, 0, 1]}},',
    )
    json.loads(changed("turn off gravity and set the mass of the box to 3 and its spin to [0, 1, 0]", text))
    assert changed("turn off gravity", text) == text.replace(
        "3.5]}]", '3.5]}, {"type": "gravity", "gravity": [0.0, 0.0, 0.0]}]'
    )


@pytest.mark.parametrize(
    ("text", "instruction"),
    [
        (TEXT.replace("[0.4, 0.4, 0.7]", "&p [0.4, 0.4, 0.7]").replace("[0, -2, 3.5]", "*p"), "move sphere_0 0.5 m up"),
        (TEXT.replace("{mass: 2, friction: [0.6, 0.02]}", "&q {mass: 2}") + "- {type: sphere, name: s, radius: 0.1, "
         "state: {position: [3, 3, 1]}, physics: *q}\n", "double the mass of can"),
        (TEXT.replace("{mass: 2,", "{<<: {mass: 2},"), "double the mass of can"),
        (TEXT.replace("  name: can\n", ""), "remove box_0"),
    ],
)  # fmt: skip
def test_values_that_stand_in_two_places_are_refused(text, instruction):
    parse_scenes(text)
    with pytest.raises(InputError, match="write"):
        edit(text, instruction)


def test_small_and_large_numbers_can_be_read_again():
    assert body(changed("set the rolling friction of box_0 to 0.00001"), "box_0").friction == (0.4, 1e-5)
    assert "1.0e-05" in changed("set the rolling friction of box_0 to 0.00001")
    assert body(changed("set the stiffness of box_0 to 123456"), "box_0").stiffness == 123456


def flying() -> str:
    return TEXT.replace("{position: [0.4, 0.4, 0.7]}", "{position: [0.4, 0.4, 1.7], linear_velocity: [1.5, 0.5, 1.0]}")


def path(text: str, name: str, frames: int = 8) -> np.ndarray:
    """Centres of an object, (frames, 3) [m]."""
    from mjx_refine.batch import batch_from_scenes
    from mjx_refine.sim.c import MujocoSimulator

    scene = parse_scenes(text)[0]
    poses = MujocoSimulator(scene.shapes, 30.0, threads=1).rollout(batch_from_scenes([scene]), frames)[0]
    return poses[:, scene.names.index(name), :3]


def test_a_speed_reduced_by_80_percent_is_a_fifth():
    before, after = (np.diff(path(text, "sphere_0", 5), axis=0) for text in (
        flying(), changed("reduce the x-velocity of sphere_0 by 80%", flying())))  # fmt: skip
    np.testing.assert_allclose(after[:, 0], 0.2 * before[:, 0], rtol=1e-9)
    np.testing.assert_allclose(after[:, 1:], before[:, 1:], atol=1e-12)


def test_and_so_is_its_flow():
    # Across the view, at one depth, flow is proportional to velocity.
    level = changed("turn off gravity", flying().replace("[1.5, 0.5, 1.0]", "[1.5, 0, 0]"))
    scenes = [parse_scenes(text)[0] for text in (level, changed("reduce the x-velocity of sphere_0 by 80%", level))]
    flows = [simulate(scene, (240, 160), 3) for scene in scenes]
    speeds = [np.median(o.flow[0, ..., 0][o.masks[0] == 2]) for o in flows]
    assert speeds[1] / speeds[0] == pytest.approx(0.2, abs=1e-3)


def test_half_the_gravity_falls_half_as_far():
    drops = [np.diff(path(text, "sphere_0", 6)[:, 2])[-1] for text in (TEXT, changed("halve gravity"))]
    assert drops[1] / drops[0] == pytest.approx(0.5, rel=1e-6)


def test_a_frictionless_box_goes_farther_and_a_bouncier_ball_higher():
    slide = [path(text, "box_0", 12)[-1, 0] for text in (TEXT, changed("make the box frictionless"))]
    assert slide[1] > slide[0] + 0.1
    assert slide[1] == pytest.approx(-1.5 + 4.0 * 11 / 30, abs=0.02)
    soft = changed("set the damping of sphere_0 to -60; remove box_0")
    tops = [
        path(text, "sphere_0", 22)[12:, 2].max()
        for text in (soft, changed("increase the bounce of it by 900%".replace("it", "sphere_0"), soft))
    ]
    assert tops[1] > tops[0] + 0.1


def test_a_bigger_box_stays_on_the_floor_and_copies_show():
    text = changed("double the size of the can and copy it as can_2 1.5 m to the left, remove sphere_0 and box_0")
    assert path(text, "can", 10)[:, 2] == pytest.approx(0.5, abs=0.01)
    before, after = (simulate(parse_scenes(t)[0], (240, 160), 2).masks[0] for t in (TEXT, text))
    assert sorted(np.unique(after)) == [0, 1, 2]
    assert 2.5 < (after == 1).sum() / (before == 3).sum() < 6


def test_a_language_model_of_ones_own_may_do_it():
    asked = []

    def model(prompt: str) -> str:
        asked.append(prompt)
        return "<think>hm</think>\n<answer>\n" + TEXT.replace("mass: 1.5", "mass: 9.5") + "</answer>"

    text = "<think>So.</think>\n<answer>\n" + TEXT + "</answer>\n"
    result = edit(text, "make the box dance like a heavy one", model=model)
    assert result.after == text.replace("mass: 1.5", "mass: 9.5")
    assert "make the box dance like a heavy one" in asked[0]
    assert "radius: 0.15" in asked[0]
    assert body(result.after, "box_0").mass == 9.5


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        ("I cannot do that.", "the model's answer"),
        ("", "no scene"),
        (TEXT.replace("mass: 1.5", "mass: -1"), "mass = -1"),
        (TEXT + "---\n" + TEXT, "2 samples"),
        (TEXT.replace("[0.4, 0.4, 0.7]", "[0.4, 0.4, -0.7]"), "deep in the floor"),
        (None, "NoneType"),
    ],
)
def test_an_answer_that_is_no_scene_is_refused(answer, says):
    with pytest.raises(InputError, match=says):
        edit(TEXT, "stop the box", model=lambda prompt: answer)


def test_odd_names_are_named_in_quotation_marks():
    text = TEXT.replace("name: can", 'name: "left \\"can\\" and, x; @1"')
    name = 'left "can" and, x; @1'
    result = edit(text, 'double the mass of "left \\"can\\" and, x; @1" and copy it as "no: 1"')
    assert body(result.after, name).mass == 4.0
    assert body(result.after, "no: 1").mass == 4.0
    with pytest.raises(NotUnderstoodError):
        edit(text, "double the mass of @1")


def test_who_names_no_object_is_told_their_names():
    with pytest.raises(
        NotUnderstoodError,
        match=r"is not understood; expected such as .*; the scene's objects are box_0, sphere_0, can",
    ):
        edit(TEXT, "make cube_3 twice as heavy")


VOCABULARY = """
make set reduce double copy remove move launch spin turn zoom tilt raise lower scale reverse stop use the a as of to by at
about and ; , . its it box_0 can ball everything camera gravity mass speed x-velocity size radius height friction bounce
damping field view position left right up down z m m/s kg degrees moon twice heavy faster times factor 2 -3 0.5 80% 1e999
1e-320 nan 100% [1,2,3] [1e999,0,0] [1,2 @0 @9 'x NUMBER OBJECT éß ٣ "can" "a "\\q"
"""
WORDS = [*VOCABULARY.split(), "\n", "\x00", "\x000\x00"]


@settings(max_examples=400)
@given(st.one_of(
    st.lists(st.sampled_from(WORDS), min_size=1, max_size=12).map(" ".join),
    st.tuples(st.sampled_from([name for name, _ in EDITS]), st.sampled_from(WORDS), st.integers(0, 11)).map(
        lambda told: " ".join([w if k != told[2] else told[1] for k, w in enumerate(told[0].split())])),
))  # fmt: skip
def test_any_words_make_a_sound_scene_or_are_refused(instruction):
    try:
        result = edit(TEXT, instruction)
    except InputError:
        return
    assert parse_scenes(result.after)[0] == result.scene


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.yaml").write_text(TEXT)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("x")
    return tmp_path


SMALL = ["--size", "96x64", "--frames", "4"]


def test_the_command_prints_the_diff_and_writes_the_scene(folder, capsys):
    assert run(["edit", "scene.yaml", "reduce the x-velocity of box_0 by 80%", "--out", "new.yaml"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("--- scene.yaml\n+++ new.yaml\n@@")
    assert (folder / "new.yaml").read_text() == TEXT.replace("[4.0, -0.5", "[0.8, -0.5")
    assert (folder / "scene.yaml").read_text() == TEXT
    assert load_scene("new.yaml").objects[0].linear_velocity == (0.8, -0.5, 0.0)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["none.yaml", "stop can", "--out", "n.yaml"], "none.yaml"),
        (["scene.yaml", "make can sing", "--out", "n.yaml"], "not understood"),
        (["scene.yaml", "", "--out", "n.yaml"], "empty"),
        (["scene.yaml", "stop can"], "--out"),
        (["scene.yaml", "stop can", "--out", "none/n.yaml"], "none"),
        (["scene.yaml", "stop can", "--out", "n.yaml", "--preview", "a.bmp"], ".png or .gif"),
        (["scene.yaml", "stop can", "--out", "n.yaml", "--flow", "full"], "not empty"),
        (["scene.yaml", "stop can", "--out", "n.yaml", "--flow", "none/flo"], "none"),
        (["scene.yaml", "stop can", "--out", "n.npz", "--flow", "n.npz"], "two results"),
        (["scene.yaml", "set the mass of can to -1", "--out", "n.yaml"], "mass = -1"),
        (["scene.yaml", "set the velocity of can to [9000, 0, -9000] and set its stiffness to 9999999",
          "--out", "n.yaml", "--flow", "n.npz"], "diverges"),
    ],
)  # fmt: skip
def test_bad_calls_leave_nothing_behind(arguments, says, folder, capsys):
    assert run(["edit", *arguments, *SMALL]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert says in captured.err
    assert captured.out == ""
    assert sorted(p.name for p in folder.rglob("*")) == ["full", "mine", "scene.yaml"]


def test_the_forms_can_be_listed(capsys):
    assert run(["edit", "--forms"]) == 0
    assert capsys.readouterr().out.splitlines() == FORMS


def test_preview_and_flow(folder):
    call = [
        "edit",
        "scene.yaml",
        "remove sphere_0 and reduce the x-velocity of box_0 by 80%",
        "--out",
        "n.yaml",
        *SMALL,
    ]
    assert run([*call, "--preview", "p.png", "--flow", "n.npz"]) == 0
    assert run([*call, "--preview", "p.gif", "--flow", "flo"]) == 0
    observation = load_observation("n.npz")
    assert observation.mask_ids() == [1, 2]
    expected = simulate(load_scene("n.yaml"), (96, 64), 4)
    files = sorted((folder / "flo").iterdir())
    assert [file.name for file in files] == ["flow_0000.flo", "flow_0001.flo", "flow_0002.flo"]
    for t, file in enumerate(files):
        np.testing.assert_array_equal(cv2.readOpticalFlow(str(file)), expected.flow[t])
        np.testing.assert_allclose(observation.flow[t], expected.flow[t], atol=0.02)
    with Image.open("p.png") as picture:
        sheet = np.asarray(picture.convert("RGB")).astype(int)
    assert sheet.shape == (4 * 160, 4 * 240, 3)
    blue = [(np.abs(half - [0, 114, 178]).sum(-1) < 9).sum() for half in (sheet[:160], sheet[320:480])]
    assert blue[0] > 100  # the ball, before
    assert blue[1] == 0
    with Image.open("p.gif") as animation:
        assert animation.n_frames == 4
    assert not list(folder.glob(".*"))


def test_flo_files_are_those_of_opencv(tmp_path):
    flow = np.random.default_rng(0).normal(0, 20, (2, 5, 7, 2)).astype(np.float32)
    cv2.writeOpticalFlow(str(tmp_path / "cv.flo"), flow[0])
    assert flo_bytes(flow[0]) == (tmp_path / "cv.flo").read_bytes()
    (tmp_path / "there").mkdir()
    for name in ("new", "there"):
        write_flo(tmp_path / name, flow)
        assert [(tmp_path / name / f"flow_000{t}.flo").read_bytes() for t in range(2)] == [flo_bytes(f) for f in flow]
    with pytest.raises(InputError, match="not empty"):
        write_flo(tmp_path / "new", flow)
    flow[0, 1, 2, 0] = np.nan
    (tmp_path / "nan.flo").write_bytes(flo_bytes(flow[0]))
    read = cv2.readOpticalFlow(str(tmp_path / "nan.flo"))
    assert (read[1, 2] > 1e9).all()
    assert (read > 1e9).sum() == 2
