"""The reader of CLEVRER's files, on files made here in that format."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from benchmarks.clevrer import rle
from benchmarks.clevrer.__main__ import run
from benchmarks.clevrer.annotation import Meeting, Thing, load_annotation
from benchmarks.clevrer.proposals import load_proposals, track
from benchmarks.clevrer.writing import write_annotation, write_proposals, write_video
from mjx_refine import load_observation
from mjx_refine.errors import InputError

FRAMES, FPS, HEIGHT, WIDTH = 55, 25.0, 96, 160
THINGS = (
    Thing(0, "cube", "red", "rubber"),
    Thing(3, "sphere", "blue", "metal"),
    Thing(1, "cylinder", "gray", "rubber"),
)
SPEED = (1.5, -0.5)  # px a frame, of the cube


def pictures():
    """Frames, masks and true places: a cube that slides, a sphere that rests, a cylinder that starts in the second half."""
    rng = np.random.default_rng(0)
    ground = rng.integers(90, 110, (HEIGHT, WIDTH, 1)).repeat(3, 2).astype(np.uint8)
    texture = rng.integers(-40, 40, (400, 400, 1))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    frames, masks, centres = [], [], []
    for t in range(FRAMES):
        late = max(0, t - 26)
        spots = ((30 + SPEED[0] * t, 70 + SPEED[1] * t), (120, 20), (60 + 2 * late, 20))
        picture, mask = ground.copy(), np.zeros((HEIGHT, WIDTH), int)
        for i, ((x, y), colour) in enumerate(zip(spots, ((200, 60, 60), (60, 60, 200), (120, 120, 120)), strict=True)):
            inside = (abs(columns + 0.5 - x) <= 10) & (abs(rows + 0.5 - y) <= 10)
            mask[inside] = i + 1
            local = np.clip(rows - round(y) + 20 + 60 * i, 0, 399), np.clip(columns - round(x) + 20, 0, 399)
            shade = np.array(colour) + texture[local[0] // 3 * 3, local[1] // 3 * 3]
            picture[inside] = np.clip(shade, 0, 255)[inside]
        frames.append(picture)
        masks.append(mask)
        centres.append([(x / 40, -y / 40, 0.2) for x, y in spots])
    return np.stack(frames), np.stack(masks), np.array(centres)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = tmp_path_factory.mktemp("clevrer")
    frames, masks, places = pictures()
    for name in ("videos/video_00000-01000", "proposals", "annotations/annotation_00000-01000"):
        (root / name).mkdir(parents=True)
    write_video(root / "videos/video_00000-01000/video_00007.mp4", frames, FPS)
    write_proposals(root / "proposals/proposal_00007.json", 7, THINGS, masks)
    velocity = np.gradient(places, axis=0) * FPS
    motion = {
        "location": places,
        "orientation": np.zeros_like(places),
        "velocity": velocity,
        "angular_velocity": np.zeros_like(places),
    }
    write_annotation(
        root / "annotations/annotation_00000-01000/annotation_00007.json",
        7,
        THINGS,
        motion,
        np.ones((FRAMES, 3), bool),
        [Meeting((3, 1), 30, (0.0, 0.0, 0.2))],
    )
    return root


def arguments(root, out, *more):
    return [
        "--videos",
        f"{root}/videos",
        "--proposals",
        f"{root}/proposals",
        "--out",
        f"{out}",
        "--least-pixels",
        "100",
        *more,
    ]


def test_runs_agree_with_coco():
    """Texts written by pycocotools 2.0."""
    mask = np.zeros((7, 9), bool)
    mask[2:5, 3:7], mask[6, 0], mask[0, 8] = True, True, True
    assert rle.encode(mask) == {"size": [7, 9], "counts": "61`02D000005NM"}
    assert (rle.decode((7, 9), "61`02D000005NM") == mask).all()
    disc = np.hypot(*np.mgrid[-160:160, -240:240]) < 40
    text = (
        "hnn1a0[98I6K4L4L4M2N2M4M2N2N2N2N2N2O0O2N2N2O0O2O0O2O0O2O000O2O00000O2O00000000000000000000000000000001N1000001N"
        "10001N101N101N101N2N2N101N2N2N2N2N2N3L3N2N3L4L4L5J7H\\[n1"
    )
    assert (rle.decode((320, 480), text) == disc).all()
    assert rle.encode(disc)["counts"] == text


@given(hnp.arrays(bool, st.tuples(st.integers(1, 40), st.integers(1, 40))))
@settings(max_examples=60, deadline=None)
def test_runs_round_trip(mask):
    code = rle.encode(mask)
    assert (rle.decode(mask.shape, code["counts"]) == mask).all()
    assert (rle.decode(mask.shape, rle.text_to_runs(code["counts"])) == mask).all()


@pytest.mark.parametrize(
    ("counts", "says"), [("~", "none of the code"), ("P", "ends within"), ("1", "runs sum to 1"), ([-1, 7], "sum to 6")]
)
def test_wrong_runs_are_refused(counts, says):
    with pytest.raises(ValueError, match=says):
        rle.decode((2, 3), counts)


def test_clips_have_what_moves(dataset, tmp_path, capsys):
    assert run(arguments(dataset, tmp_path / "out", "--annotations", f"{dataset}/annotations")) == 0
    assert capsys.readouterr().out.splitlines() == [
        "00007_000: cube; 2 static",
        "00007_025: cube, cylinder; 1 static",
        f"2 clips of 1 videos in {tmp_path / 'out'}",
    ]
    _, masks, _ = pictures()
    for first, ids in ((0, [1]), (25, [1, 3])):
        seen = load_observation(tmp_path / f"out/00007_{first:03d}/flows.npz")
        expected = np.where(np.isin(masks[first : first + 25], ids), masks[first : first + 25], 0)
        assert (seen.masks == expected).all()
        assert (seen.length, seen.size, seen.fps) == (25, (WIDTH, HEIGHT), FPS)
        flow = seen.flow[seen.masks[:-1] == 1]
        assert np.abs(np.nanmean(flow, 0) - SPEED).max() < 0.15
        assert np.isfinite(flow).mean() > 0.9
    told = json.loads((tmp_path / "out/00007_025/annotation.json").read_text())
    assert [(o["object_id"], o["mask_id"], o["shape"]) for o in told["objects"]] == [(0, 1, "cube"), (1, 3, "cylinder")]
    assert told["collisions"] == [{"object_ids": [3, 1], "frame": 5, "location": [0.0, 0.0, 0.2]}]
    _, _, places = pictures()
    assert np.allclose(told["objects"][0]["location"], places[25:50, 0], atol=1e-4)


def test_without_annotation_masks_tell(dataset, tmp_path, capsys):
    """No annotation, as for the test videos: looks are those found often; what is static is told by centroids."""
    assert run(arguments(dataset, tmp_path / "out")) == 0
    assert "00007_000: cube; 2 static" in capsys.readouterr().out
    told = json.loads((tmp_path / "out/00007_000/annotation.json").read_text())
    assert [o["shape"] for o in told["objects"]] == ["cube"]
    assert "location" not in told["objects"][0]


def test_finished_clips_are_left_alone(dataset, tmp_path):
    assert run(arguments(dataset, tmp_path / "out")) == 0
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()}
    assert run(arguments(dataset, tmp_path / "out")) == 0
    assert before == {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()}
    assert not [p for p in before if p.name not in ("flows.npz", "annotation.json")]


def test_small_objects_leave_a_window_out(dataset, tmp_path, capsys):
    assert run([*arguments(dataset, tmp_path / "out")[:-1], "1000000"]) == 0
    assert "left out: an object shows" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


def rewritten(dataset, tmp_path, change):
    """The proposals with a change."""
    data = json.loads((dataset / "proposals/proposal_00007.json").read_text())
    change(data)
    path = tmp_path / "proposal_00007.json"
    path.write_text(json.dumps(data))
    return path


def test_finds_are_matched(dataset, tmp_path):
    """A find with wrong attributes is taken by place, the worse of two alike is dropped, strays are dropped."""

    def change(data):
        objects = data["frames"][3]["objects"]
        objects[0]["color"] = "brown"
        stray = copy.deepcopy(objects[1])
        stray["color"] = "purple"
        worse = {**copy.deepcopy(objects[1]), "score": 0.5, "mask": rle.encode(np.ones((HEIGHT, WIDTH), bool))}
        objects += [stray, worse]

    found = load_proposals(rewritten(dataset, tmp_path, change))
    looks = [thing.look for thing in THINGS]
    assert (track(found, looks, 0, 6) == pictures()[1][:6]).all()
    assert found.looks()[:3] == sorted(looks)


def test_the_truth_of_processed_proposals_is_read(dataset, tmp_path):
    def change(data):
        data["ground_truth"] = {
            "objects": [{"id": t.number, "shape": t.shape, "color": t.color, "material": t.material} for t in THINGS],
            "collisions": [],
        }

    assert load_proposals(rewritten(dataset, tmp_path, change)).things == THINGS


def _set(path, value):
    def change(data):
        *way, last = path
        for key in way:
            data = data[key]
        if value is None:
            del data[last]
        else:
            data[last] = value

    return change


FIRST = ["frames", 0, "objects", 0]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_set(["frames"], None), "the key 'frames' is missing"),
        (_set(["frames"], []), "frames is empty"),
        (_set(["frames", 2], 5), "expected an object"),
        (_set(["frames", 2, "frame_index"], 1), "is there twice"),
        (_set(["frames", 54, "frame_index"], 60), "frame 54 is missing"),
        (_set([*FIRST, "mask", "counts"], "~~"), "none of the code"),
        (_set([*FIRST, "mask", "counts"], "1"), "runs sum to"),
        (_set([*FIRST, "mask", "counts"], {}), "expected COCO's text"),
        (_set([*FIRST, "mask", "size"], [96]), "expected 2 finite numbers"),
        (_set([*FIRST, "mask", "size"], [1e9, 1e9]), "8 to 8192 px"),
        (_set([*FIRST, "shape"], 3), "expected text"),
        (_set([*FIRST, "score"], "x"), "expected a number"),
        (lambda data: data["frames"].pop(), "54 frames; expected 55"),
    ],
)
def test_wrong_proposals(dataset, tmp_path, capsys, change, says):
    path = rewritten(dataset, tmp_path, change)
    assert run(["--videos", f"{dataset}/videos", "--proposals", f"{path}", "--out", f"{tmp_path}/out"]) == 2
    refused(capsys, tmp_path / "out", says)


def refused(capsys, out, says):
    said = capsys.readouterr().err
    assert says in said
    assert said.startswith("clevrer: ")
    assert said.count("\n") == 1
    assert not out.exists()


OBJECT = ["motion_trajectory", 3, "objects", 1]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_set(["object_property"], []), "0 objects"),
        (_set(["object_property", 0, "shape"], "cone"), "expected one of sphere, cylinder, cube"),
        (_set(["object_property", 1, "object_id"], 0), "two objects have one number"),
        (_set(["motion_trajectory"], None), "the key 'motion_trajectory' is missing"),
        (_set(["motion_trajectory", 3, "frame_id"], 4), "frames in order"),
        (_set([*OBJECT, "location"], [0, float("nan"), 0]), "expected 3 finite numbers"),
        (_set([*OBJECT, "velocity"], [0, 0]), "expected 3 finite numbers"),
        (_set([*OBJECT, "object_id"], 0), "is told twice"),
        (_set([*OBJECT, "object_id"], 9), "is none of object_property's"),
        (lambda data: data["motion_trajectory"][3]["objects"].pop(), "lacks object 1"),
        (lambda data: data["motion_trajectory"].pop(), "54 frames; expected 55"),
        (_set(["collision", 0, "object_ids"], [0, []]), "expected two of object_property's"),
        (_set(["collision", 0, "frame_id"], 55), "expected a whole number, 0 to 54"),
    ],
)
def test_wrong_annotations(dataset, tmp_path, capsys, change, says):
    data = json.loads((dataset / "annotations/annotation_00000-01000/annotation_00007.json").read_text())
    change(data)
    path = tmp_path / "annotation_00007.json"
    path.write_text(json.dumps(data))
    assert run(arguments(dataset, tmp_path / "out", "--annotations", f"{path}")) == 2
    refused(capsys, tmp_path / "out", says)


@pytest.mark.parametrize(
    ("text", "says"), [("", "no JSON"), ("[1]", "holds a list"), ("{", "no JSON"), ("[" * 100000, "no JSON")]
)
def test_files_that_are_no_annotation(tmp_path, text, says):
    path = tmp_path / "annotation_00001.json"
    path.write_text(text)
    with pytest.raises(InputError, match=says):
        load_annotation(path)


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--videos", "nowhere"], "no .mp4 with a number"),
        (["--numbers", "8"], "no such video"),
        (["--numbers", "7-"], "expected such as"),
        (["--seconds", "9"], "change --seconds"),
        (["--fps", "0"], "--fps"),
        (["--annotations", "nowhere"], "no .json with a number"),
    ],
)
def test_wrong_calls(dataset, tmp_path, capsys, more, says):
    assert run(arguments(dataset, tmp_path / "out", *more)) == 2
    refused(capsys, tmp_path / "out", says)


def test_a_video_that_is_none(dataset, tmp_path, capsys):
    path = tmp_path / "video_00007.mp4"
    path.write_bytes(b"none")
    assert run(["--videos", f"{path}", "--proposals", f"{dataset}/proposals", "--out", f"{tmp_path}/out"]) == 2
    refused(capsys, tmp_path / "out", "cannot read it as a video")
