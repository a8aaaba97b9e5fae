"""The files of a diagnosis, from results made up by hand on a clip that our own simulator made."""

from __future__ import annotations

import dataclasses
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from markupsafe import Markup

from mjx_refine.diagnosis.result import CHANNELS, Diagnosis, Gap, Place, Ranked, Value, Verdict
from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.report.diagnosis_files import NAMES, write_diagnosis
from mjx_refine.report.diagnosis_numbers import diagnosis_numbers
from mjx_refine.report.diagnosis_page import diagnosis_page, shown_frames
from mjx_refine.report.diagnosis_plots import CHANNEL_COLOURS, Rows, gap_bars, misfit_map, strength
from mjx_refine.report.diagnosis_replay import replay
from mjx_refine.report.diagnosis_tables import percent, width
from mjx_refine.scene import Body, Camera, Effect, Scene, load_scene
from mjx_refine.simulate import simulate

FRAMES, SIZE = 8, (96, 64)
HOSTILE = "<script>alert('x')</script>"
VOID = {"meta", "img", "br", "link", "input", "hr"}
PUSH = Effect("push", "ball", (("time", 0.1), ("x", 0.0), ("y", 0.0), ("z", 1.2)))


def base(name: str = "box") -> Scene:
    box = Body("box", name, (0.2, 0.15, 0.1), (-0.4, 0.6, 0.1), linear_velocity=(1.0, 0.0, 0.0))
    ball = Body("sphere", "ball", (0.15,), (0.4, 0.6, 0.15))
    return Scene((box, ball), Camera((0.0, -2.0, 3.0), 45.0))


def diagnosed(name: str = "box") -> Scene:
    return dataclasses.replace(base(name), effects=(PUSH,))


def made_up(name: str = "box") -> Diagnosis:
    before = np.array([[1.0] * FRAMES, [0.5, 1.0, 2.0, np.nan, 8.0, 40.0, 12.0, 3.0]])
    channels = np.zeros((2, FRAMES), int)
    channels[1, 6] = CHANNELS.index("rotation")
    channels[1, 0] = -1
    return Diagnosis(
        verdict=Verdict(
            ("push",), 0.9312345, (("push", "hidden_obstacle"),), "Something pushes ball.", "Film it from two sides."
        ),
        gap=Gap("mean square misfit", "frames 6-7", 12.3456789, 1.5, 1.0, 0.9559, 0.9, np.nan, 0.6, 0.97, 1.25, np.inf),
        where=(
            Place(None, (0, 7), "whole", "camera", 0.03),
            Place("ball", (3, 6), "flight", "motion", 0.9),
        ),
        candidates=(
            Ranked(
                "push",
                "ball",
                0.93,
                41.23456,
                {"z": Value(1.2000049, 1.1, 1.3, "N s"), "time": Value(0.1, -np.inf, np.nan, "s")},
                1.5,
                0.96,
                f"{name} says: pushed",
            ),
            Ranked("wind", None, 0.001, -np.inf, {}, np.nan, np.nan, "air moves"),
            Ranked("push", name, 0.0005, -3.0, {f"v[{i}]": Value(i, 0, 9, "m^2") for i in range(30)}, 12.0, 0.0, ""),
        ),
        residual="It jumps.",
        remaining="Nothing.",
        base=base(name),
        scene=diagnosed(name),
        matching=(-1, 2),
        map_before=before,
        map_after=np.minimum(before, 1.5),
        channels=channels,
        signs={"lead": 12.5},
        notes=("<b>noted</b>",),
        seconds=83.25,
        rollouts=4096,
    )


def nothing_found() -> Diagnosis:
    return dataclasses.replace(
        made_up(),
        verdict=Verdict((), 0.8, (), "Nothing is missing.", ""),
        scene=base(),
        where=(),
        candidates=(),
        map_before=np.ones((2, FRAMES)),
        map_after=np.ones((2, FRAMES)),
    )


@pytest.fixture(scope="module")
def clip() -> Observation:
    seen = simulate(diagnosed(), SIZE, FRAMES)
    return dataclasses.replace(seen, source="folder/clip <1>.npz")


@pytest.fixture(scope="module")
def written(tmp_path_factory, clip):
    folder = tmp_path_factory.mktemp("result") / "new" / "folder"
    call = {"init": ["a.yaml"], "video": ["b.npz"], "seed": 3, "without": ["drag"], "digest": "0" * 64}
    return write_diagnosis(folder, made_up(HOSTILE), clip, call)


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


def test_all_files_are_there_and_nothing_else(written):
    assert [path.name for path in written] == list(NAMES)
    assert sorted(path.name for path in written[0].parent.iterdir()) == sorted(NAMES)


def test_the_yaml_is_the_diagnosed_scene(written):
    assert load_scene(written[0]) == diagnosed(HOSTILE)


def strict(text: str) -> dict:
    def refuse(constant: str):
        raise AssertionError(constant)

    return json.loads(text, parse_constant=refuse)


def test_json_has_the_contracts_keys_and_no_nan(written):
    numbers = strict(written[2].read_text())
    assert numbers["format"] == 1
    assert numbers["verdict"] == {
        "effects": ["push"],
        "probability": 0.9312,
        "indistinguishable": [["push", "hidden_obstacle"]],
        "sentence": "Something pushes ball.",
        "experiment": "Film it from two sides.",
    }
    assert numbers["gap"] == {
        "metric": "mean square misfit",
        "held_out": "frames 6-7",
        "before": 12.3457,
        "after": 1.5,
        "noise_floor": 1.0,
        "closed": 0.9559,
        "iou_before": 0.6,
        "iou_after": 0.97,
        "epe_before": 1.25,
        "epe_after": None,
        "closed_interval": [0.9, None],
    }
    assert numbers["where"] == [
        {"object": "ball", "frames": [3, 6], "phase": "flight", "channel": "motion", "share": 0.9},
        {"object": None, "frames": [0, 7], "phase": "whole", "channel": "camera", "share": 0.03},
    ]
    first, second, _ = numbers["candidates"]
    assert {"effect", "target", "probability", "evidence", "parameters", "gap_after", "closed"} <= set(first)
    assert first["parameters"] == {
        "z": {"value": 1.2, "low": 1.1, "high": 1.3, "unit": "N s"},
        "time": {"value": 0.1, "low": None, "high": None, "unit": "s"},
    }
    assert (first["evidence"], first["closed"], first["target"]) == (41.23, 0.96, "ball")
    assert (second["evidence"], second["gap_after"], second["closed"], second["target"]) == (None, None, None, None)
    assert numbers["residual"] == {"description": "It jumps.", "remaining": "Nothing."}
    assert (numbers["seconds"], numbers["rollouts"], numbers["notes"]) == (83.25, 4096, ["<b>noted</b>"])
    assert numbers["objects"] == [{"name": HOSTILE, "mask_id": None}, {"name": "ball", "mask_id": 2}]
    assert numbers["map"]["before"][1] == [0.5, 1.0, 2.0, None, 8.0, 40.0, 12.0, 3.0]
    assert numbers["map"]["channels"][1] == [None, *["motion"] * 5, "rotation", "motion"]
    assert numbers["call"]["without"] == ["drag"]


def test_json_round_trips(written):
    numbers = diagnosis_numbers(made_up(HOSTILE), strict(written[2].read_text())["call"])
    assert strict(written[2].read_text()) == numbers


def test_nothing_missing_is_an_empty_list():
    numbers = diagnosis_numbers(nothing_found())
    assert numbers["verdict"]["effects"] == []
    assert numbers["where"] == numbers["candidates"] == []


def test_the_page_nests_and_loads_nothing(written):
    text = written[1].read_text()
    page = Page(text)
    assert "http:" not in text
    assert "https:" not in text
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    assert not [key for key, _ in page.attributes if key.startswith("on")]
    sources = [value for key, value in page.attributes if key in ("src", "href", "xlink:href")]
    assert sources
    assert all(value.startswith(("data:image/", "#")) for value in sources)
    assert not re.search(r"url\((?!#)|@import", text)
    assert page.tags.count("svg") == 4  # gap, map, two curves
    # Six frames, with the base model's outlines and with the diagnosed scene's.
    assert page.tags.count("img") == 12


def test_hostile_names_are_text(written):
    page = Page(written[1].read_text())
    assert f"{HOSTILE} says: pushed" in page.text
    assert "<b>noted</b>" in page.text
    assert "clip <1>.npz" in page.text


def test_the_page_says_what_a_reader_must_know(written):
    text = Page(written[1].read_text()).text
    for words in (
        "Something pushes ball.",
        "93 % the probability that this answer is right",
        "What to film next: Film it from two sides.",
        "This clip cannot tell push, hidden_obstacle apart.",
        "Gap closed 96 %",
        "before 12.3, noise floor 1",
        "0.970 before 0.600",
        "base model, refitted",
        "with push",
        "ball 3–6 flight motion 90 %",
        "the whole view 0–7 whole camera 3 %",
        "z 1.2 (1.1 … 1.3) N s",
        "time 0.1 s",
        "v[0] 0 (0 … 9) m²",
        "and 22 more in diagnosis.json",
        "frame 5, 0.17 s",
        "It jumps.",
        "withheld effects drag",
        "The clip has no frames",
        "rollouts 4096",
    ):
        assert words in text
    assert "diverges" not in text
    assert text.count("largest misfit") == 1


def test_where_the_verdict_is_right_the_outlines_agree(clip):
    one = made_up()
    before, after = replay(one.base, clip, (1, 2)), replay(one.scene, clip, (1, 2))
    assert float(after.scores.iou[0]) == pytest.approx(1.0, abs=1e-6)
    assert float(after.scores.epe[0]) == pytest.approx(0.0, abs=1e-5)
    assert float(before.scores.frame_iou[0, -1]) < 0.95


def test_effects_on_the_picture_are_drawn():
    fat = dataclasses.replace(base(), effects=(Effect("mask_bias", None, (("width", 3.0),)),))
    seen = simulate(fat, SIZE, FRAMES)
    assert float(replay(fat, seen, (1, 2)).scores.iou[0]) == pytest.approx(1.0, abs=1e-6)
    assert float(replay(base(), seen, (1, 2)).scores.iou[0]) < 0.9


def test_a_page_where_nothing_is_missing(clip):
    page = Page(diagnosis_page(nothing_found(), clip))
    assert "nothing is missing" in page.text
    assert "Nowhere by more than the noise." in page.text
    assert "No effect promised anything." in page.text
    assert "Below: the diagnosed scene" not in page.text
    assert "What to film next" not in page.text
    assert page.tags.count("img") == 6


def test_an_unknown_effect_is_marked():
    one = nothing_found()
    unknown = dataclasses.replace(one, verdict=dataclasses.replace(one.verdict, effects=("unknown",)))
    assert '<div class="verdict open">' in diagnosis_page(unknown)
    assert '<div class="verdict open">' not in diagnosis_page(one)
    assert "with unknown" not in diagnosis_page(unknown)


def test_a_page_without_a_clip():
    page = Page(diagnosis_page(made_up(), None, {"poses": "measured.npz"}))
    assert page.text.startswith("Diagnosis: measured.npz")
    assert "img" not in page.tags


def test_a_clip_with_pictures_and_one_without_masks(clip):
    pictures = np.full((FRAMES, SIZE[1], SIZE[0], 3), 90, np.uint8)
    assert "The clip has no frames" not in diagnosis_page(made_up(), dataclasses.replace(clip, frames=pictures))
    assert Page(diagnosis_page(made_up(), dataclasses.replace(clip, masks=None))).tags.count("img") == 12


def test_a_diverging_scene_is_told(clip):
    box, ball = base().objects
    fast = dataclasses.replace(ball, linear_velocity=(1e5, 0.0, 0.0))
    wild = dataclasses.replace(made_up(), scene=dataclasses.replace(diagnosed(), objects=(box, fast)))
    # 1e4 m away after 0.1 s.
    assert "A simulation diverges at frame 4." in Page(diagnosis_page(wild, clip)).text


def test_a_scene_that_cannot_be_simulated_is_told(clip):
    odd = dataclasses.replace(base(), effects=(Effect("push", "ball", (("weight", 1.0),)),))
    page = Page(diagnosis_page(dataclasses.replace(made_up(), scene=odd), clip))
    assert "No pictures: effect push: unknown parameter 'weight'" in page.text
    assert "img" not in page.tags


def test_the_same_diagnosis_makes_the_same_bytes(clip):
    assert diagnosis_page(made_up(), clip) == diagnosis_page(made_up(), clip)


def cells(svg: Markup) -> dict[tuple[str, int], tuple[str, float]]:
    """(object, frame) -> (fill, opacity), by the cells' tooltips."""
    pattern = r'fill="(#\w+)" fill-opacity="([\d.]+)"><title>(\w+), frame (\d+):'
    return {(name, int(t)): (shade, float(o)) for shade, o, name, t in re.findall(pattern, svg)}


def test_the_map_shows_strength_and_channel():
    one = made_up()
    drawn = cells(misfit_map(("box", "ball"), [Rows("before", one.map_before)], one.channels))
    assert drawn["box", 3] == (CHANNEL_COLOURS["motion"], 0.0)
    assert ("ball", 3) not in drawn  # not seen
    assert drawn["ball", 6][0] == CHANNEL_COLOURS["rotation"]
    order = sorted((t for name, t in drawn if name == "ball"), key=lambda t: drawn["ball", t][1])
    assert order[-5:] == [2, 7, 4, 6, 5]
    assert drawn["ball", 5][1] == 1.0


def test_both_panels_of_the_map_share_one_scale():
    one = made_up()
    panels = [Rows("before", one.map_before), Rows("after", 0.5 * one.map_before)]
    found = re.findall(
        r'fill-opacity="([\d.]+)"><title>ball, frame 5:', misfit_map(("box", "ball"), panels, one.channels)
    )
    assert [float(value) for value in found] == pytest.approx([1.0, 0.06 + 0.94 * np.log(20) / np.log(40)], abs=1e-3)


@pytest.mark.parametrize(("misfit", "opacity"), [(0.0, 0.0), (1.0, 0.0), (np.nan, 0.0), (10.0, 0.53), (100.0, 1.0)])
def test_strength_is_logarithmic(misfit, opacity):
    assert strength(misfit, 100.0) == pytest.approx(opacity)


def test_a_long_clip_has_a_lean_map():
    wide = np.full((5, 1000), 3.0)
    svg = misfit_map(tuple("abcde"), [Rows("before", wide)], np.zeros((5, 1000), int))
    assert "<title>" not in svg
    assert svg.count("<rect") == 5005


def test_bars_are_in_proportion_and_unknown_ones_are_left_out():
    gap = made_up().gap
    widths = [float(v) for v in re.findall(r'<rect[^>]* width="([\d.]+)" height="22"', gap_bars(gap, "with push"))]
    assert widths[1] / widths[0] == pytest.approx(gap.after / gap.before, rel=1e-2)
    assert len(re.findall("<rect", gap_bars(gap, ""))) == 1
    assert gap_bars(dataclasses.replace(gap, before=np.nan), "with push") == ""
    assert "noise floor" not in gap_bars(dataclasses.replace(gap, noise_floor=np.nan), "with push")


@pytest.mark.parametrize(
    ("value", "text", "css"),
    [
        (0.87, "87 %", "87.0%"),
        (0.9999, "> 99 %", "100.0%"),
        (1.0, "100 %", "100.0%"),
        (0.001, "< 1 %", "0.1%"),
        (0.0, "0 %", "0.0%"),
        (-0.2, "−20 %", "0.0%"),
        (np.nan, "–", "0%"),
    ],
)
def test_shares_for_people(value, text, css):
    assert percent(value) == text
    assert width(value) == css


def test_the_frame_of_the_largest_misfit_is_shown():
    misfit = np.ones((2, 30))
    assert shown_frames(misfit, 30) == ([0, 6, 12, 17, 23, 29], None)
    misfit[1, 15] = 9.0
    misfit[0, 3] = np.nan
    assert shown_frames(misfit, 30) == ([0, 6, 12, 15, 23, 29], 15)
    assert shown_frames(misfit[:, 15:17], 2) == ([0, 1], 0)


def test_a_place_that_cannot_be_written(tmp_path, clip):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file"):
        write_diagnosis(tmp_path / "file" / "out", made_up(), clip)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_an_older_diagnosis_does_not_outlive_its_page(tmp_path, clip, monkeypatch):
    """Stopped in the middle, the folder holds no diagnosis.json that belongs to another page."""
    write_diagnosis(tmp_path, nothing_found())

    def stop(path, _text):
        if path.name == "report.html":
            raise KeyboardInterrupt
        return path

    monkeypatch.setattr("mjx_refine.files.write_text", stop)
    with pytest.raises(KeyboardInterrupt):
        write_diagnosis(tmp_path, made_up())
    assert not (tmp_path / "diagnosis.json").exists()
