"""Clips drawn here, whose masks, displacements and cameras are known, against what is observed in them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from mjx_refine.errors import InputError
from mjx_refine.observation import load_observation
from mjx_refine.observe import observe_clip, observe_command, preview

WIDTH, HEIGHT = 200, 150
Painter = Callable[[np.ndarray, int], np.ndarray]


def textured(seed: int, low: int = 70, high: int = 150, size: tuple[int, int] = (HEIGHT, WIDTH)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.uniform(0, 255, (*size, 3)).astype(np.float32), (0, 0), 2.5)
    noise = (noise - noise.min()) / (noise.max() - noise.min())
    return low + (high - low) * noise


def coverage(shape: str, centre: tuple[float, float], radius: float) -> np.ndarray:
    """Share of each pixel that the shape covers, 4x4 samples; a pixel's centre is at + 0.5."""
    n = 4
    at = (np.arange(n * WIDTH) + 0.5) / n, (np.arange(n * HEIGHT) + 0.5) / n
    x, y = np.meshgrid(at[0] - centre[0], at[1] - centre[1])
    inside = np.hypot(x, y) < radius if shape == "disc" else np.maximum(np.abs(x), np.abs(y)) < radius
    return inside.reshape(HEIGHT, n, WIDTH, n).mean((1, 3)).astype(np.float32)


def draw(ground: np.ndarray, shapes: list[tuple[np.ndarray, tuple[int, int, int]]]) -> np.ndarray:
    picture = ground.copy()
    for share, colour in shapes:
        picture = picture * (1 - share[..., None]) + share[..., None] * np.array(colour, np.float32)
    return picture


def write_clip(path: Path, pictures: list[np.ndarray], fps: float = 30.0, noise: float = 2.0) -> Path:
    rng = np.random.default_rng(0)
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, (width, height))
    assert writer.isOpened()
    for picture in pictures:
        noisy = np.clip(np.rint(picture + rng.normal(0, noise, picture.shape)), 0, 255).astype(np.uint8)
        writer.write(cv2.cvtColor(noisy, cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return np.count_nonzero(a & b) / max(1, np.count_nonzero(a | b))


def match(masks: np.ndarray, truth: np.ndarray) -> dict[int, tuple[int, float]]:
    """For each true object (leading axis) the id that overlaps it most over the clip, and the worst frame's IoU."""
    found = {}
    for k, object_truth in enumerate(truth):
        ids = [i for i in np.unique(masks) if i]
        assert ids
        best = max(ids, key=lambda i: np.count_nonzero((masks == i) & object_truth))
        frames = [t for t in range(len(masks)) if object_truth[t].any()]
        found[k] = (int(best), min(iou(masks[t] == best, object_truth[t]) for t in frames))
    return found


def line(start: tuple[float, float], step: tuple[float, float], frames: int) -> np.ndarray:
    return np.array(start) + np.arange(frames)[:, None] * np.array(step)


def clip_of(
    path: Path,
    bodies: list[tuple[str, np.ndarray, float, tuple[int, int, int]]],
    ground: np.ndarray,
    after: Painter = lambda picture, t: picture,
    before: Painter = lambda picture, t: picture,
) -> np.ndarray:
    """Writes a clip of bodies (shape, centres by frame, radius, colour; later ones in front); returns visible truth."""
    frames = len(bodies[0][1])
    truth = np.zeros((len(bodies), frames, HEIGHT, WIDTH), bool)
    pictures = []
    for t in range(frames):
        shares = [coverage(shape, tuple(centres[t]), radius) for shape, centres, radius, _ in bodies]
        picture = draw(before(ground, t), [(s, body[3]) for s, body in zip(shares, bodies, strict=True)])
        pictures.append(after(picture, t))
        for k, share in enumerate(shares):
            truth[k, t] = share > 0.5
            truth[:k, t] &= ~truth[k, t]
    write_clip(path, pictures)
    return truth


def test_two_discs_and_a_box_are_masked_tightly_with_stable_ids_and_their_flow(tmp_path):
    bodies = [
        ("disc", line((30, 40), (4, 0.5), 24), 13.0, (220, 60, 50)),
        ("box", line((170, 110), (-3.25, -0.25), 24), 11.0, (240, 240, 235)),
        ("disc", line((30, 125), (2, -1.5), 24), 9.0, (20, 40, 30)),
    ]
    truth = clip_of(tmp_path / "clip.avi", bodies, textured(1))
    result = observe_clip(tmp_path / "clip.avi")
    found = match(result.observation.masks, truth)
    assert len(result.report.objects) == 3
    assert len({i for i, _ in found.values()}) == 3
    assert all(score > 0.88 for _, score in found.values()), found
    assert not result.report.camera_moving
    for k, (number, _) in found.items():
        inside = (result.observation.masks[5] == number) & truth[k, 5]
        flow = np.nanmedian(result.observation.flow[5][inside], axis=0)
        step = bodies[k][1][6] - bodies[k][1][5]
        np.testing.assert_allclose(flow, step, atol=0.5)  # bodies without texture
    still = ~truth.any((0, 1))
    assert np.nanmedian(np.abs(result.observation.flow[:, still])) < 0.1


def test_small_fast_object_keeps_its_flow(tmp_path):
    bodies = [("disc", line((15, 40), (15, 4), 12), 5.0, (250, 250, 250))]
    truth = clip_of(tmp_path / "clip.avi", bodies, textured(2))
    result = observe_clip(tmp_path / "clip.avi")
    ((_, score),) = match(result.observation.masks, truth).values()
    assert score > 0.75
    flow = np.stack([np.nanmedian(result.observation.flow[t][truth[0, t]], axis=0) for t in range(11)])
    np.testing.assert_allclose(flow, np.tile([15, 4], (11, 1)), atol=0.6)


def test_flow_noise_covers_the_errors_on_a_turning_textured_disc(tmp_path):
    rng = np.random.default_rng(3)
    disc = cv2.GaussianBlur(rng.uniform(0, 255, (61, 61, 3)).astype(np.float32), (0, 0), 1.6)
    disc = np.clip((disc - 128) * 4 + 160, 0, 255)
    ground, pictures, turn, radius = textured(4, 60, 90), [], 0.12, 24
    centres = line((50, 60), (5, 1.5), 10)
    for t, centre in enumerate(centres):
        cos, sin = np.cos(turn * t), np.sin(turn * t)
        matrix = np.array([[cos, -sin], [sin, cos]])
        shift = centre - 0.5 - matrix @ [30, 30]
        sprite = cv2.warpAffine(disc, np.hstack([matrix, shift[:, None]]), (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
        share = coverage("disc", tuple(centre), radius)[..., None]
        pictures.append(ground * (1 - share) + share * sprite)
    observation = observe_clip(write_clip(tmp_path / "clip.avi", pictures)).observation
    errors, sigmas = [], []
    for t in range(9):
        ys, xs = np.nonzero(coverage("disc", tuple(centres[t]), radius - 4) > 0.9)
        offset = np.stack([xs, ys], axis=-1) + 0.5 - centres[t]
        cos, sin = np.cos(turn), np.sin(turn)
        truth = offset @ np.array([[cos, -sin], [sin, cos]]).T + centres[t + 1] - (offset + centres[t])
        errors.append(observation.flow[t][ys, xs] - truth)
        sigmas.append(observation.flow_sigma[t][ys, xs])
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    assert np.isfinite(error).mean() > 0.98
    assert np.nanmedian(np.abs(error)) < 0.25
    normal = np.nanmedian(np.abs(error)) / (0.6745 * np.median(sigma))
    assert 0.2 < normal < 2.5


def test_object_that_stops_stays_masked_and_one_that_rests_at_first_is_masked_from_the_start(tmp_path):
    frames = 30
    stops = line((25, 40), (8, 0), frames)
    stops[11:] = stops[11]
    starts = line((60, 110), (7, 0), frames)
    starts = np.concatenate([np.repeat(starts[:1], 17, axis=0), starts[: frames - 17]])
    bodies = [("disc", stops, 12.0, (230, 220, 40)), ("box", starts, 10.0, (40, 60, 220))]
    truth = clip_of(tmp_path / "clip.avi", bodies, textured(5))
    result = observe_clip(tmp_path / "clip.avi")
    found = match(result.observation.masks, truth)
    assert len(result.report.objects) == 2
    assert all(score > 0.85 for _, score in found.values()), found


def test_touching_discs_of_one_colour_are_split_and_keep_their_ids(tmp_path):
    frames, radius = 32, 12.0
    left, right = line((30, 70), (4, 0), frames), line((106, 74), (0, 0), frames)
    hit = int(np.argmin(np.abs(right[0, 0] - left[:, 0] - 2 * radius)))
    left[hit:] = left[hit]
    right[hit:] = right[hit] + np.arange(frames - hit)[:, None] * np.array([4.25, 0.25])
    bodies = [("disc", left, radius, (235, 235, 240)), ("disc", right, radius, (235, 235, 240))]
    truth = clip_of(tmp_path / "clip.avi", bodies, textured(6))
    found = match(observe_clip(tmp_path / "clip.avi").observation.masks, truth)
    assert found[0][0] != found[1][0]
    assert all(score > 0.82 for _, score in found.values()), found


def test_crossing_discs_of_two_colours_keep_their_ids(tmp_path):
    bodies = [
        ("disc", line((25, 60), (6, 0), 25), 13.0, (220, 50, 40)),
        ("disc", line((175, 76), (-6, 0), 25), 13.0, (40, 80, 230)),
    ]
    truth = clip_of(tmp_path / "clip.avi", bodies, textured(7))
    masks = observe_clip(tmp_path / "clip.avi").observation.masks
    found = match(masks, truth)
    assert found[0][0] != found[1][0]
    for k, (number, _) in found.items():
        scores = [iou(masks[t] == number, truth[k, t]) for t in range(25) if truth[k, t].any()]
        assert np.mean(scores) > 0.85
        assert min(scores) > 0.6


def test_flicker_and_a_cast_shadow_do_not_widen_the_masks(tmp_path):
    centres = line((40, 50), (4, 1), 24)

    def shade(ground: np.ndarray, t: int) -> np.ndarray:
        share = coverage("disc", (centres[t, 0] + 9, centres[t, 1] + 12), 13.0)
        soft = cv2.GaussianBlur(share, (0, 0), 2.5)[..., None]
        return ground * (1 - 0.4 * soft)

    truth = clip_of(
        tmp_path / "clip.avi",
        [("disc", centres, 13.0, (200, 50, 60))],
        textured(8, 110, 170),
        after=lambda picture, t: picture * (1 + 0.12 * np.sin(2.1 * t)),
        before=shade,
    )
    result = observe_clip(tmp_path / "clip.avi")
    ((_, score),) = match(result.observation.masks, truth).values()
    assert len(result.report.objects) == 1
    assert score > 0.83


def test_a_hand_at_the_border_and_a_clock_are_left_out_with_a_sentence(tmp_path):
    def extras(picture: np.ndarray, t: int) -> np.ndarray:
        picture = np.clip(picture, 0, 255).astype(np.uint8)
        picture[60 + t : 90 + t, : 18 + (t % 5)] = (200, 150, 120)
        cv2.putText(picture, f"{t * 37 % 100:02d}", (150, 140), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 2)
        return picture

    bodies = [("disc", line((60, 30), (4, 2), 24), 12.0, (60, 200, 80))]
    truth = clip_of(tmp_path / "clip.avi", bodies, textured(9), after=extras)
    result = observe_clip(tmp_path / "clip.avi")
    assert len(result.report.objects) == 1
    ((_, score),) = match(result.observation.masks, truth).values()
    assert score > 0.85
    assert any("left out" in w and "border" in w for w in result.report.warnings)


def test_moving_camera_is_reported_and_objects_are_still_found(tmp_path):
    wide = textured(10, 40, 200, (HEIGHT, WIDTH + 80))
    centres = line((60, 70), (4, 0), 20)
    pictures, truth = [], np.zeros((1, 20, HEIGHT, WIDTH), bool)
    for t in range(20):
        shift = 2.0 * t
        matrix = np.array([[1, 0, -shift], [0, 1, 0]], np.float32)
        ground = cv2.warpAffine(wide, matrix, (WIDTH, HEIGHT))
        share = coverage("disc", tuple(centres[t]), 14)
        truth[0, t] = share > 0.5
        pictures.append(draw(ground, [(share, (255, 30, 30))]))
    result = observe_clip(write_clip(tmp_path / "clip.avi", pictures))
    assert result.report.camera_moving
    assert any("camera moves" in w for w in result.report.warnings)
    assert abs(result.report.camera_drift - 38) < 2
    ((_, score),) = match(result.observation.masks, truth).values()
    assert score > 0.8
    still = ~truth[0, 3]
    np.testing.assert_allclose(np.nanmedian(result.observation.flow[3][still], axis=0), [-2, 0], atol=0.1)


def test_a_still_clip_is_refused_and_nothing_is_left_behind(tmp_path):
    write_clip(tmp_path / "clip.avi", [textured(11)] * 12)
    with pytest.raises(InputError, match="nothing moves"):
        observe_command(tmp_path / "clip.avi", tmp_path / "flows.npz", echo=lambda s: None)
    assert [p.name for p in tmp_path.iterdir()] == ["clip.avi"]


@pytest.fixture(scope="module")
def simple(tmp_path_factory) -> tuple[Path, np.ndarray]:
    path = tmp_path_factory.mktemp("observe") / "clip.avi"
    bodies = [("disc", line((30, 60), (3, 1), 24), 12.0, (230, 230, 230))]
    return path, clip_of(path, bodies, textured(12))


def test_command_writes_an_observation_and_a_picture(simple, tmp_path):
    lines: list[str] = []
    result = observe_command(
        simple[0], tmp_path / "flows.npz", echo=lines.append, fps=240, start=0.2, end=0.7, stride=3, size="100x75"
    )
    loaded = load_observation(tmp_path / "flows.npz")
    assert loaded.fps == 80
    assert loaded.size == (100, 75)
    assert loaded.length == 5  # frames 6, 9, 12, 15, 18 of 30 fps file time
    np.testing.assert_array_equal(loaded.masks, result.observation.masks)
    truth = simple[1][0, 6:21:3]
    small = np.stack([cv2.resize(m.astype(np.float32), (100, 75), interpolation=cv2.INTER_AREA) > 0.5 for m in truth])
    assert min(iou(a > 0, b) for a, b in zip(loaded.masks, small, strict=True)) > 0.8
    picture = cv2.imread(str(tmp_path / "flows.preview.png"))
    assert picture.shape == preview(result).shape
    assert any("1 object" in text for text in lines)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["flows.npz", "flows.preview.png"]


def save_masks(folder: Path, masks: np.ndarray, kind: str) -> Path:
    from PIL import Image

    folder.mkdir()
    colours = np.array([[0, 0, 0], [0, 180, 90], [200, 0, 0]], np.uint8)  # RGB ids follow the colours' order
    for t, mask in enumerate(masks):
        if kind == "palette":
            image = Image.fromarray(mask.astype(np.uint8))
            image.putpalette(colours.ravel().tolist())
        elif kind == "rgb":
            image = Image.fromarray(colours[mask])
        else:
            image = Image.fromarray(mask.astype(np.uint8))
        image.save(folder / f"{t}.png")  # 10.png comes after 9.png
    return folder


@pytest.mark.parametrize("kind", ["palette", "rgb", "grey"])
@pytest.mark.parametrize("which", ["kept", "file"])
def test_given_masks_are_used_as_they_are(simple, tmp_path, kind, which):
    path, truth = simple
    ids = truth[0].astype(np.int32)
    ids[:, 100:120, 100:120] = 2
    given = ids[::2] if which == "kept" else ids
    folder = save_masks(tmp_path / "masks", given, kind)
    result = observe_clip(path, stride=2, masks_dir=folder)
    np.testing.assert_array_equal(result.observation.masks, ids[::2])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fps": 0}, "--fps"),
        ({"fps": -30.0}, "--fps"),
        ({"fps": float("nan")}, "--fps"),
        ({"start": 0.5, "end": 0.5}, "--end"),
        ({"start": -1.0}, "--start"),
        ({"start": 100.0}, "frame"),
        ({"stride": 0}, "--stride"),
        ({"stride": 1000}, "frame"),
        ({"size": "100"}, "--size"),
        ({"size": "100x"}, "--size"),
        ({"size": "0x50"}, "--size"),
        ({"size": "axb"}, "--size"),
    ],
)
def test_bad_arguments_are_named(simple, tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        observe_command(simple[0], tmp_path / "flows.npz", **change)
    assert not list(tmp_path.iterdir())


def test_bad_files_are_named(simple, tmp_path):
    text = tmp_path / "text.mp4"
    text.write_text("no video")
    empty = tmp_path / "empty.mp4"
    empty.touch()
    for path in (text, empty, tmp_path / "missing.mp4", tmp_path):
        with pytest.raises(InputError, match=path.name):
            observe_clip(path)
    with pytest.raises(InputError, match="existing directory"):
        observe_command(simple[0], tmp_path / "no" / "flows.npz")


def test_bad_mask_directories_are_named(simple, tmp_path):
    path, truth = simple
    with pytest.raises(InputError, match="no such directory"):
        observe_clip(path, masks_dir=tmp_path / "missing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"no \.png"):
        observe_clip(path, masks_dir=tmp_path / "empty")
    save_masks(tmp_path / "few", truth[0, :5].astype(np.int32), "grey")
    with pytest.raises(InputError, match="5 PNGs; expected 24"):
        observe_clip(path, masks_dir=tmp_path / "few")
    save_masks(tmp_path / "blank", np.zeros_like(truth[0], np.int32), "grey")
    with pytest.raises(InputError, match="empty"):
        observe_clip(path, masks_dir=tmp_path / "blank")
    folder = save_masks(tmp_path / "broken", truth[0].astype(np.int32), "grey")
    (folder / "3.png").write_text("no picture")
    with pytest.raises(InputError, match=r"3\.png"):
        observe_clip(path, masks_dir=folder)


def test_same_clip_gives_the_same_observation(simple):
    first, second = (observe_clip(simple[0], end=0.4, size="100x75") for _ in range(2))
    np.testing.assert_array_equal(first.observation.masks, second.observation.masks)
    np.testing.assert_array_equal(first.observation.flow, second.observation.flow)
