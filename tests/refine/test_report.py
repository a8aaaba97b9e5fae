"""The files of a refinement, from a result made up by hand."""

from __future__ import annotations

import base64
import csv
import dataclasses
import io
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from mjx_fitness import Scores
from PIL import Image

from mjx_refine.errors import InputError
from mjx_refine.observation import Observation, make_observation
from mjx_refine.report import encode, warnings, write_result
from mjx_refine.report.contours import Overlay, colour, pale
from mjx_refine.report.flow_picture import error_picture, flow_picture, largest_flow
from mjx_refine.report.numbers import plain
from mjx_refine.report.page import report_page
from mjx_refine.report.tables import number, parameter_groups
from mjx_refine.scene import Body, Camera, Problem, Scene, load_scene
from mjx_refine.search.derivatives import Derivatives
from mjx_refine.search.intervals import FreeDirection, Intervals
from mjx_refine.search.options import Options
from mjx_refine.search.progress import Step
from mjx_refine.search.result import ParameterRow, RefineResult, Replay

FRAMES, HEIGHT, WIDTH = 5, 24, 32
HOSTILE = "<script>alert('x')</script>"
NAMES = ["refined.yaml", "history.csv", "overlay.gif", "report.html", "result.json"]
VOID = {"meta", "img", "br", "link", "input", "hr"}


def masks(shift: int) -> np.ndarray:
    drawn = np.zeros((FRAMES, HEIGHT, WIDTH), np.int32)
    for t in range(FRAMES):
        drawn[t, 6:14, 3 + t + shift : 12 + t + shift] = 1
        drawn[t, 15:21, 20:27] = 2
    return drawn


def flow(speed: float) -> np.ndarray:
    field = np.zeros((FRAMES - 1, HEIGHT, WIDTH, 2), np.float32)
    field[..., 0] = speed * (masks(0)[:-1] == 1)
    return field


def scores(iou: float) -> Scores:
    one = np.array([iou])
    frames, epe = np.full((1, FRAMES), iou), np.full((1, FRAMES - 1), 0.4)
    frames[0, -1] = epe[0, 0] = np.nan
    return Scores(frames, epe, np.array([[iou, np.nan]]), one, one, 1 - one, 1 - one, 1 - one, 2 * one - 1)


def replay(name: str, shift: int, iou: float) -> Replay:
    objects = (Body("box", name, (0.2, 0.2, 0.2), (0.0, 0.0, 0.2)), Body("sphere", "ball", (0.1,), (0.5, 0.0, 0.1)))
    scene = Scene(objects, Camera((0.0, -2.0, 3.0), 45.0))
    poses = np.tile([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0], (FRAMES, 2, 1))
    return Replay(scene, poses, masks(shift), flow(1.2), scores(iou))


def made_up(name: str = HOSTILE, iou: float = 0.9) -> RefineResult:
    rows = (
        ParameterRow(f"{name}.size.x", "m", 0.2, 0.25, 0.24, 0.27, True),
        ParameterRow("ball.damping", "1/s", 4.0, 4.0, 1.5, 9.0, False, "one prior width changes nothing"),
        ParameterRow("camera.pitch", "rad", 0.5, 0.75, None, None, True),
    )
    steps = tuple(
        Step(phase, i, 10 * (i + 1), 100, 0.5 * i, fitness, 0.5, 0.3, 0.1)
        for i, (phase, fitness) in enumerate([("land", -40.0), ("land", 0.3), ("search", 0.8)])
    )
    return RefineResult(
        options=Options(),
        init=replay(name, 3, 0.4),
        init_index=7,
        refined=replay(name, 1, iou),
        start_index=2,
        moved=0.012,
        matching=(1, -1),
        parameters=rows,
        known=Intervals(
            point=np.full(3, 0.5),
            cost=1.0,
            standard_error=np.full(3, 0.1),
            covariance=0.01 * np.eye(3),
            low=np.full(3, 0.4),
            high=np.full(3, 0.6),
            determined=np.array([True, False, True]),
            on_bound=np.zeros(3, bool),
            free=(FreeDirection(0.8, ((f"{name}.size.x", 0.71), ("camera.pitch", -0.7))),),
            edge=np.array([0.3, 0.4]),
            motion=np.array([0.2, 0.5]),
            misfit=np.ones(2),
            evaluations=123,
        ),
        fixed=((f"{name}.mass", "only ratios of masses act"),),
        history=steps,
        evaluations=30,
        reason="The budget of rollouts is spent.",
        backend="mujoco",
        device="cpu",
        seconds={"total": 12.5, "compile": 1.0, "search": 10.0},
        problems=(Problem(4, "radius = '<img src=x>'"),),
        derivatives=Derivatives("differences", f"wide differences agree; no derivative here in {name}.size.x", 5),
    )


def seen(frames: bool = True, with_masks: bool = True) -> Observation:
    measured = flow(1.0)
    measured[:, :3] = np.nan
    pictures = np.random.default_rng(0).integers(0, 255, (FRAMES, HEIGHT, WIDTH, 3), np.uint8) if frames else None
    return make_observation(measured, 30.0, masks(0) if with_masks else None, pictures, source="clips/<i>.npz")


class Page(HTMLParser):
    """Collects text, tags and attributes; fails where elements do not nest."""

    def __init__(self, text: str):
        super().__init__()
        self.open, self.tags, self.attributes, self.words = [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("result") / "new" / "folder"
    return write_result(folder, made_up(), seen())


def test_all_files_are_there_and_nothing_else(written):
    assert [path.name for path in written] == NAMES
    assert sorted(path.name for path in written[0].parent.iterdir()) == sorted(NAMES)


def test_the_yaml_is_the_refined_scene(written):
    assert load_scene(written[0]) == made_up().scene


def test_the_page_nests_and_loads_nothing(written):
    text = written[3].read_text()
    page = Page(text)
    assert "http://" not in text
    assert "https://" not in text
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    sources = [value for key, value in page.attributes if key in ("src", "href", "xlink:href")]
    assert sources
    assert all(value.startswith(("data:image/", "#")) for value in sources)
    assert not re.search(r"url\((?!#)|@import", text)
    assert page.tags.count("svg") == 3


def test_hostile_names_are_text(written):
    page = Page(written[3].read_text())
    assert HOSTILE in page.text
    assert "radius = '<img src=x>'" in page.text
    assert ("src", "x") not in page.attributes


def test_the_page_says_what_a_reader_must_know(written):
    text = Page(written[3].read_text()).text
    for words in (
        "rose from 0.400 to 0.900",
        "fell from 0.600 px to 0.100 px",
        "starting from sample 2, in 12.5 s on mujoco (cpu)",
        "No mask was left for ball",
        "moved apart, the farthest by 0.012 m",
        "1 of the samples could not be read",
        "Masks without an object: 2",
        "re-simulation by C MuJoCo",
        "0.5 (28.65°) 0.75 (42.97°) rad +0.25 (14.3°)",
        "one prior width changes nothing",
        "only ratios of masses act",
        "Differences of rollouts of this clip's simulation can be trusted where least squares ended: wide differences agree",
    ):
        assert words in text
    assert "poor" not in text


def test_a_poor_or_diverged_result_warns():
    result = made_up(iou=0.35)
    poses = result.refined.poses.copy()
    poses[3:] = np.nan
    text = Page(
        report_page(dataclasses.replace(result, refined=dataclasses.replace(result.refined, poses=poses)), seen())
    ).text
    assert "The result is poor: IoU 0.35" in text
    assert "diverges at frame 3" in text
    assert "No scene better than sample 7 was found" in text
    assert "The first frame fits worse than before" in text


@pytest.mark.parametrize(("frames", "with_masks"), [(False, True), (True, False), (False, False)])
def test_a_clip_without_frames_or_masks(tmp_path, frames, with_masks):
    observation = seen(frames, with_masks)
    paths = write_result(tmp_path, made_up("box"), observation)
    text = Page(paths[3].read_text()).text
    assert ("The clip has no frames" in text) is not frames
    assert ("The clip has no masks" in text) is not with_masks
    ids = [entry["mask_id"] for entry in json.loads(paths[4].read_text())["objects"]]
    assert ids == ([1, None] if with_masks else [None, None])


def test_json_has_the_contracts_keys_and_no_nan(written):
    def refuse(constant: str):
        raise AssertionError(constant)

    numbers = json.loads(written[4].read_text(), parse_constant=refuse)
    scored = {"iou", "first_frame_iou", "epe", "first_frame_epe", "fitness"}
    expected = {"format", "seed", "backend", "device", "seconds", "init", "refined", "evaluations", "objects"}
    assert expected <= set(numbers)
    assert (numbers["format"], numbers["evaluations"]) == (1, 30)
    assert scored | {"index"} <= set(numbers["init"])
    assert scored <= set(numbers["refined"])
    assert "index" not in numbers["refined"]
    assert numbers["init"]["index"] == 7
    assert numbers["refined"]["iou"] == 0.9
    assert numbers["objects"] == [
        {"name": HOSTILE, "mask_id": 1, "iou": 0.9},
        {"name": "ball", "mask_id": None, "iou": None},
    ]
    reason = f"wide differences agree; no derivative here in {HOSTILE}.size.x"
    assert numbers["derivatives"] == {"method": "differences", "reason": reason}
    assert numbers["undetermined"] == ["ball.damping"]
    assert numbers["problems"] == [{"index": 4, "reason": "radius = '<img src=x>'"}]


def test_history_is_a_row_a_step(written):
    rows = list(csv.DictReader(io.StringIO(written[1].read_text())))
    assert list(rows[0]) == [field.name for field in dataclasses.fields(Step)]
    assert [row["phase"] for row in rows] == ["land", "land", "search"]
    assert [float(row["fitness"]) for row in rows] == [-40.0, 0.3, 0.8]


def test_the_animation_has_every_frame_even_where_nothing_moves(tmp_path):
    still = make_observation(flow(0.0), 30.0, masks(0)[:1].repeat(FRAMES, 0))
    with Image.open(write_result(tmp_path, made_up(), still)[2]) as animation:
        assert animation.n_frames == FRAMES
        assert max(animation.size) == 480
        assert animation.info["loop"] == 0


def test_the_same_result_makes_the_same_bytes(written, tmp_path):
    again = write_result(tmp_path, made_up(), seen())
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in written]


@pytest.mark.parametrize("size", [(320, 240), (1280, 720)])
def test_outlines_lie_on_the_masks_edges(size):
    observation = seen(frames=False)
    image = Overlay(observation, made_up().refined, (1, -1), size)(0).astype(int)
    x_scale, y_scale = size[0] / WIDTH, size[1] / HEIGHT

    def columns(shade: tuple[int, int, int], row: float) -> np.ndarray:
        band = image[round((row - 1) * y_scale) : round((row + 1) * y_scale)]
        near = np.abs(band - np.array(shade)).max(-1) < 40
        return np.nonzero(near.any(0))[0] / x_scale

    observed, simulated = columns(pale(0), 10), columns(colour(0), 10)
    assert observed.min() == pytest.approx(3, abs=0.5)
    assert simulated.min() == pytest.approx(4, abs=0.5)
    assert simulated.max() == pytest.approx(13, abs=0.5)
    # The second object was matched to nothing: its mask is drawn in nobody's colour.
    assert columns(pale(-1), 18).size
    assert not columns(pale(1), 18).size


def test_unmeasured_flow_is_striped_and_measured_flow_is_not():
    field = np.zeros((HEIGHT, WIDTH, 2))
    field[:10, :, 0] = np.nan
    field[12:, :, 0] = 2.0
    picture = flow_picture(field, 2.0, (4 * WIDTH, 4 * HEIGHT))
    striped = picture[:38]
    assert (striped == striped[..., :1]).all()
    assert len(np.unique(striped)) == 2
    np.testing.assert_array_equal(picture[-1, 0], [255, 0, 0])
    np.testing.assert_array_equal(picture[44, 0], [255, 255, 255])
    heat = error_picture(np.where(np.isnan(field[..., 0]), np.nan, field[..., 0]), 2.0, (WIDTH, HEIGHT)).sum(-1)
    assert heat[-1, 0] > 3 * heat[10, 0]


def test_the_scale_of_flow_is_the_moving_objects():
    assert largest_flow(seen()) == pytest.approx(1.0)
    assert largest_flow(make_observation(flow(0.0) * np.nan, 30.0, masks(0))) > 0


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.69813, "0.6981"),
        (-3.0, "−3"),
        (1234.56, "1235"),
        (150.0, "150"),
        (1e-7, "1.00e−07"),
        (np.nan, "–"),
    ],
)
def test_numbers_for_people(value, text):
    assert number(value) == text


def test_parameters_belong_to_the_longest_name():
    result = made_up("ball.x")
    scene = result.scene
    names = [(owner, [row.name for row in rows]) for owner, rows in parameter_groups(result)]
    assert scene.names == ("ball.x", "ball")
    assert names == [("ball.x", ["size.x"]), ("ball", ["damping"]), ("camera and gravity", ["camera.pitch"])]


def test_plain_numbers():
    assert plain({"a": (np.float32(0.5), np.int64(2), np.array([np.inf, 1.0])), 3: True}) == {
        "a": [0.5, 2, [None, 1.0]],
        "3": True,
    }


def test_a_place_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file"):
        write_result(tmp_path / "file" / "out", made_up(), seen())


def test_pictures_of_noise_are_written():
    noise = np.random.default_rng(0).integers(0, 256, (320, 480, 3), np.uint8)
    head, data = encode.jpeg(noise).split(",")
    assert head == "data:image/jpeg;base64"
    with Image.open(io.BytesIO(base64.b64decode(data))) as image:
        assert (image.format, image.size) == ("JPEG", (480, 320))
        assert np.abs(np.asarray(image).astype(float) - noise).mean() < 20
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 255
    with Image.open(io.BytesIO(base64.b64decode(encode.jpeg(red).split(",")[1]))) as image:
        np.testing.assert_allclose(np.asarray(image), red, atol=3)


def test_what_was_not_measured_or_matched_is_warned_of(tmp_path):
    unmeasured = make_observation(np.full_like(flow(1.0), np.nan), 30.0, masks(0), source="clip.npz")
    said = "The clip's flow is measured nowhere", "No mask was left for ball", "Masks without an object: 2"
    found = warnings(made_up(), unmeasured)
    assert all(any(line.startswith(words) for line in found) for words in said)
    write_result(tmp_path, made_up(), unmeasured)
    assert json.loads((tmp_path / "result.json").read_text())["warnings"] == found
    assert not any(line.startswith(said[0]) for line in warnings(made_up(), seen()))
