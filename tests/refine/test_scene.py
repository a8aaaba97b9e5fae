"""Scenes: every form of the contract is read, defaults, and load -> write -> load is the same."""

import dataclasses
import math

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.bad_cases import ENTRIES, scene_text
from mjx_refine.errors import InputError
from mjx_refine.scene import (
    Body,
    Camera,
    Effect,
    Scene,
    dump_scene,
    load_scene,
    load_scenes,
    parse_scenes,
    save_scene,
    save_scenes,
    scene_entries,
    scene_from_entries,
)

EXAMPLE = """
- type: box                # a comment
  name: box_0
  size: [1.0, 0.5, 0.4]
  state:
    position: [-0.5, 0.3, 0.4]
    orientation: [0.97, 0.0, 0.0, 0.23]
    linear_velocity: [4.3, 2.5, 0.0]
    angular_velocity: [0, 0, 0]
  physics:
    friction: [1.1, 0.3]
    mass: 1.0
    damping: -4
    stiffness: 6000
- type: cylinder
  name: cylinder_0
  radius: 0.3
  height: 0.5
  state: {position: [-0.5, 0.8, 0.3], orientation: [0.69, 0.69, 0.15, 0.15], linear_velocity: [-0.1, -0.5, 0.0],
    angular_velocity: [0, 0, 0]}
  physics: {friction: [0.5, 0.3], mass: 1.0, damping: -4}
- type: sphere
  name: sphere_0
  radius: 0.2
  state: {position: [0.4, 0.2, 0.2], orientation: [1, 0, 0, 0], linear_velocity: [0, 0, 0], angular_velocity: [0, 0, 0]}
  physics: {friction: [0.5, 0.01], mass: 1.0, damping: -4}
- type: camera
  fovy: 45
  orientation: 45
  position: [0, -2, 3.5]
- type: gravity
  gravity: [0, 0, -7.0]
- type: effect
  effect: drag
  target: sphere_0
  parameters: {quadratic: 0.05}
"""
TEXT = scene_text()
SCENE = parse_scenes(TEXT)[0]


def test_the_contract_s_example():
    scene = parse_scenes(EXAMPLE)[0]
    norm = math.hypot(0.97, 0.23)
    box, cylinder, sphere = scene.objects
    assert box == Body(
        "box", "box_0", (1.0, 0.5, 0.4), (-0.5, 0.3, 0.4), (0.97 / norm, 0.0, 0.0, 0.23 / norm), (4.3, 2.5, 0.0),
        (0.0, 0.0, 0.0), (1.1, 0.3), 1.0, -4.0, 6000.0,
    )  # fmt: skip
    assert cylinder.size == (0.3, 0.5)
    assert np.linalg.norm(cylinder.orientation) == pytest.approx(1, abs=1e-15)
    assert sphere.size == (0.2,)
    assert sphere.stiffness == 5000.0
    assert scene.camera == Camera((0.0, -2.0, 3.5), 45.0, 45.0)
    assert scene.gravity == (0.0, 0.0, -7.0)
    assert scene.effects == (Effect("drag", "sphere_0", (("quadratic", 0.05),)),)
    assert scene.shapes == ("box", "cylinder", "sphere")
    assert scene.names == ("box_0", "cylinder_0", "sphere_0")


FORMS = {
    "plain": TEXT,
    "document start": "---\n" + TEXT,
    "document start and end": "---\n" + TEXT + "...\n",
    "byte order mark": "\ufeff" + TEXT,
    "DOS line ends": TEXT.replace("\n", "\r\n"),
    "answer": f"<answer>\n{TEXT}</answer>",
    "think and answer": f"<think>The box\n- slides: <answer> no\n```\n---\n</think>\n<answer>\n{TEXT}\n</answer>\n",
    "prose around answer": f"Sure!\n<answer>{TEXT}</answer>\nGood luck: [",
    "unclosed answer": f"<think>so</think><answer>\n{TEXT}",
    "fence": f"Here it is:\n```yaml\n{TEXT}```\nThat is: all [",
    "fence without a language": f"```\n{TEXT}\n```",
    "unclosed fence": f"```yaml\n{TEXT}",
    "fence in answer": f"<think>x</think><answer>\n```yaml\n{TEXT}```\n</answer>",
    "comments": "# made by hand\n" + TEXT + "# end\n",
    "JSON": __import__("json").dumps(yaml.safe_load(TEXT)),
    "alias": TEXT.replace("- type: box", "- &b\n  type: box"),
}


@pytest.mark.parametrize("form", FORMS)
def test_one_sample_in_every_form(form, tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_bytes(FORMS[form].encode())
    samples = load_scenes(path)
    assert samples.scenes == (SCENE,)
    assert samples.indices == (0,)
    assert samples.problems == ()
    assert load_scene(path) == SCENE


MANY = {
    "documents": "---\n".join,
    "documents with start": lambda texts: "".join(f"---\n{t}" for t in texts),
    "answers": lambda texts: "\n".join(f"<answer>\n{t}</answer>" for t in texts),
    "thoughts and answers": lambda texts: "\n".join(f"<think>---\n</think><answer>{t}</answer>" for t in texts),
    "unclosed answers": lambda texts: "\n".join(f"<answer>\n{t}" for t in texts),
    "fences": lambda texts: "\nand\n".join(f"```yaml\n{t}```" for t in texts),
    "fences in answers": lambda texts: "".join(f"<answer>\n```\n{t}```\n</answer>" for t in texts),
}


@pytest.mark.parametrize("form", MANY)
def test_many_samples_some_broken(form):
    broken = ["- {type: cone}\n", "- type: [\n", "- !!python/name:os.system\n"]
    texts = [TEXT, broken[0], TEXT, broken[1], broken[2], scene_text({"1.radius": 0.4})]
    samples = parse_scenes(MANY[form](texts), "best.yaml")
    assert samples.indices == (0, 2, 5)
    assert len(samples) == 3
    assert samples[1] == SCENE
    assert samples[2].objects[1].size == (0.4,)
    assert [p.index for p in samples.problems] == [1, 3, 4]
    for problem, says in zip(samples.problems, ["'cone'", "not safe YAML", "python/name"], strict=True):
        assert problem.reason.startswith(f"best.yaml: sample {problem.index}")
        assert says in problem.reason


def test_an_empty_answer_keeps_its_index():
    samples = parse_scenes(f"<answer></answer><answer>{TEXT}</answer>")
    assert samples.indices == (1,)
    assert samples.problems[0].index == 0


def test_the_first_reason_is_told_where_nothing_can_be_read():
    with pytest.raises(InputError, match=r"^x: sample 0: .*'cone'.*1 more"):
        parse_scenes("- {type: cone}\n---\n- 5\n", "x")


def test_defaults():
    entries = [
        {"type": "sphere", "radius": 0.2, "state": {"position": [0, 0, 1]}},
        {"type": "box", "size": [1, 1, 1], "state": {"position": [3, 0, 1], "orientation": None}, "physics": None},
        {"type": "camera", "orientation": 45, "position": [0, -2, 3]},
    ]
    scene = scene_from_entries(entries)
    sphere, box = scene.objects
    assert sphere == Body("sphere", "sphere_0", (0.2,), (0.0, 0.0, 1.0))
    assert box.name == "box_1"
    assert dataclasses.astuple(box)[4:] == (
        (1.0, 0.0, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3, (0.5, 0.01), 1.0, -4.0, 5000.0,
    )  # fmt: skip
    assert scene.camera.fovy == 45.0
    assert scene.gravity == (0.0, 0.0, -9.81)
    assert scene.effects == ()


@pytest.mark.parametrize(
    "path", ["0.size", "0.state", "0.state.position", "1.radius", "2.position", "2.orientation", "3.gravity"]
)
def test_no_default_where_none_is_safe(path):
    from benchmarks.bad_cases import GONE

    with pytest.raises(InputError, match=rf"entry {path[0]}.*\.{path.split('.')[-1]} is missing; .*add it"):
        parse_scenes(scene_text({path: GONE}))


@pytest.mark.parametrize("text", ["1e-3", "1E-3", "+1e-3", "0.001", ".001", "1.e-3", "'1e-3'"])
def test_numbers_in_every_spelling(text):
    scene = parse_scenes(TEXT.replace("radius: 0.2", f"radius: {text}"))[0]
    assert scene.objects[1].size == (0.001,)


@pytest.mark.parametrize("text", ["1e", "e3", "0x", "1,5", "--1", "1e-3m", "½", "one"])
def test_what_is_no_number(text):
    with pytest.raises(InputError, match="radius"):
        parse_scenes(TEXT.replace("radius: 0.2", f"radius: {text}"))


@given(st.lists(st.floats(-1e3, 1e3), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_quaternions_are_normalised(quaternion):
    body = scene_from_entries(
        [{**ENTRIES[1], "state": {"position": [0, 0, 1], "orientation": quaternion}}, ENTRIES[2]]
    ).objects[0]
    assert np.linalg.norm(body.orientation) == pytest.approx(1, abs=1e-12)
    assert np.dot(body.orientation, quaternion) == pytest.approx(np.linalg.norm(quaternion), rel=1e-9)


def test_effects_are_read_and_written():
    effects = [
        {"type": "effect", "effect": "drag", "target": "box_0", "parameters": {"quadratic": "1e-3", "linear": 2}},
        {
            "type": "effect",
            "effect": "wind",
            "parameters": {"velocity": [1, 2.5, "1e-3"], "kind": "steady", "none": []},
        },
        {"type": "effect", "effect": "slope"},
    ]
    scene = parse_scenes(scene_text(extra=effects))[0]
    assert scene.effects == (
        Effect("drag", "box_0", (("quadratic", 0.001), ("linear", 2.0))),
        Effect("wind", None, (("velocity", (1.0, 2.5, 0.001)), ("kind", "steady"), ("none", ()))),
        Effect("slope"),
    )
    assert parse_scenes(dump_scene(scene))[0] == scene


@pytest.mark.parametrize(
    "name",
    ["1e-3", "null", "yes", "- a", "a: b", "#", "'", '"', "é 球", "</answer>", "```", "---", "</think>", "&a", "*a", "%", "="],
)  # fmt: skip
def test_odd_names_round_trip(name):
    scene = parse_scenes(scene_text({"0.name": name}))[0]
    assert scene.names == (name, "sphere_0")
    assert parse_scenes(dump_scene(scene)).scenes == (scene,)


@pytest.mark.parametrize("name", ["<answer>", "a<think>b</think>c"])
def test_names_that_would_be_taken_for_a_language_model_s_tags(name):
    with pytest.raises(InputError, match=r"name = .*expected a text without"):
        scene_from_entries([{**ENTRIES[1], "name": name}, ENTRIES[2]])


def numbers(low, high, **options):
    return st.floats(low, high, allow_nan=False, **options).map(lambda v: v + 0.0)


def vectors(length, low, high):
    return st.tuples(*[numbers(low, high)] * length)


NAMES = st.text(st.characters(codec="utf-8", categories=["L", "N", "P", "S"]), min_size=1, max_size=12).filter(
    lambda text: "<" not in text and "```" not in text and text.isprintable()
)


@st.composite
def bodies(draw, name):
    shape = draw(st.sampled_from(["sphere", "box", "cylinder"]))
    sizes = {"sphere": 1, "box": 3, "cylinder": 2}[shape]
    orientation = draw(st.sampled_from([[1, 0, 0, 0], [1, 2, 3, 4], [-0.3, 0.1, 0, 7]]))
    state = {"position": [0, 0, 0], "orientation": orientation}
    like = scene_from_entries([{**ENTRIES[1], "state": state}, ENTRIES[2]]).objects[0]
    return Body(
        shape,
        name,
        draw(vectors(sizes, 1e-4, 1e3)),
        draw(vectors(3, -1e4, 1e4)),
        like.orientation,
        draw(vectors(3, -1e4, 1e4)),
        draw(vectors(3, -1e4, 1e4)),
        draw(vectors(2, 0, 10)),
        draw(numbers(0, 1e6, exclude_min=True)),
        draw(numbers(-1e5, 0)),
        draw(numbers(0, 1e7, exclude_min=True)),
    )


@st.composite
def scenes(draw):
    names = draw(st.lists(NAMES, min_size=1, max_size=4, unique=True))
    values = numbers(-1e9, 1e9) | st.lists(numbers(-1e9, 1e9), max_size=4).map(tuple)
    effects = st.builds(
        Effect,
        st.sampled_from(["drag", "wind", "push"]),
        st.none() | st.sampled_from(names),
        st.dictionaries(NAMES, values, max_size=3).map(lambda d: tuple(d.items())),
    )
    return Scene(
        tuple(draw(bodies(name)) for name in names),
        Camera(draw(vectors(3, -1e4, 1e4)), draw(numbers(-360, 360)), draw(numbers(0.1, 175))),
        draw(vectors(3, -1e3, 1e3)),
        tuple(draw(st.lists(effects, max_size=3))),
    )


@given(scenes())
def test_load_write_load_is_the_same(scene):
    assert scene_from_entries(scene_entries(scene)) == scene
    text = dump_scene(scene)
    assert parse_scenes(text).scenes == (scene,)
    assert dump_scene(parse_scenes(text)[0]) == text


@given(st.lists(scenes(), min_size=2, max_size=3))
def test_samples_round_trip(tmp_path_factory, many):
    path = tmp_path_factory.mktemp("samples") / "many.yaml"
    save_scenes(path, many)
    assert load_scenes(path).scenes == tuple(many)


def test_a_file_round_trips(tmp_path):
    path = save_scene(tmp_path / "scene.yaml", SCENE)
    assert load_scene(path) == SCENE
    assert list(tmp_path.iterdir()) == [path]


def test_the_shipped_samples_are_read():
    samples = load_scenes("examples/clip/best32.yaml")
    assert len(samples) == 32
    assert samples.problems == ()


def test_nothing_is_executed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for tag in ("python/object/apply:os.system", "python/object/new:os.mkdir", "python/object/apply:os.mkdir"):
        with pytest.raises(InputError, match="not safe YAML"):
            parse_scenes(f"- !!{tag} [owned]\n")
    assert list(tmp_path.iterdir()) == []


def test_numpy_numbers_are_written_as_numbers():
    body = Body("sphere", "a", (np.float64(0.1),), (0.0, np.float64(0.2), 0.1), mass=np.float64(1.5))
    scene = Scene((body,), Camera((0.0, -2.0, 3.0), np.float64(45.0)))
    assert parse_scenes(dump_scene(scene))[0] == scene
