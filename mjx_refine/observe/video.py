"""Reading a clip: which frames are kept, and which others help to learn the background."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mjx_refine.errors import InputError

# FFmpeg prints lines of its own about a bad file; it asks for this once, when OpenCV first opens a video.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

# The background model looks at so many pixels at most (frames x height x width): it bounds time and memory.
_CONTEXT_PIXELS = 25_000_000
_MOST_CONTEXT = 120
_FEWEST_CONTEXT = 48
_MOST_PIXELS = 1_500_000_000


@dataclass(frozen=True)
class Clip:
    """The kept frames of a clip.

    Attributes:
      frames: RGB, shape (T, H, W, 3).
      fps: frames per second of the kept frames (capture rate / stride).
      indices: each kept frame's number in the file, shape (T,).
      file_frames: how many frames the file has.
      context: further frames of the file around the kept ones, evenly spread, for the background, shape (K, H, W, 3).
      native_size: (width, height) of the file's pictures.
    """

    frames: UInt8[np.ndarray, "frames height width 3"]
    fps: float
    indices: Int[np.ndarray, " frames"]
    file_frames: int
    context: UInt8[np.ndarray, "context height width 3"]
    native_size: tuple[int, int]


def parse_size(size: str | tuple[int, int] | None) -> tuple[int, int] | None:
    """Reads ``WxH`` (or a pair) as (width, height).

    Raises:
      InputError: it is no size, or one side is below 16 or above 8192 pixels.
    """
    if size is None:
        return None
    expectation = f"--size {size}: expected WIDTHxHEIGHT in pixels, 16 to 8192 each, for example 320x240"
    parts = size.lower().split("x") if isinstance(size, str) else list(size)
    if len(parts) != 2:
        raise InputError(expectation)
    try:
        width, height = (int(part) for part in parts)
    except (TypeError, ValueError) as error:
        raise InputError(expectation) from error
    if not (16 <= width <= 8192 and 16 <= height <= 8192):
        raise InputError(expectation)
    return width, height


def _check(path: Path, fps: float | None, start: float, end: float | None, stride: int) -> None:
    if not path.exists():
        raise InputError(f"{path}: no such file; name a video file")
    if path.is_dir():
        raise InputError(f"{path}: is a directory; name a video file")
    if fps is not None and not (math.isfinite(fps) and fps > 0):
        raise InputError(f"--fps {fps}: expected a positive number, the rate at which the clip was captured")
    if not (math.isfinite(start) and start >= 0):
        raise InputError(f"--start {start}: expected seconds of file time, 0 or more")
    if end is not None and not (math.isfinite(end) and end > start):
        raise InputError(f"--end {end}: expected seconds of file time after --start {start}")
    if isinstance(stride, bool) or int(stride) != stride or stride < 1:
        raise InputError(f"--stride {stride}: expected a whole number of 1 or more")


def _decode(capture: cv2.VideoCapture, size: tuple[int, int] | None) -> Iterator[np.ndarray]:
    while True:
        read, frame = capture.read()
        if not read or frame is None:
            return
        if size is not None and (frame.shape[1], frame.shape[0]) != size:
            shrinks = size[0] * size[1] <= frame.shape[0] * frame.shape[1]
            frame = cv2.resize(frame, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
        yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)


def _is_context(index: int, every: int, first: int, last: float, reach: float) -> bool:
    return index % every == 0 and first - reach <= index <= last + reach


def _open(path: Path) -> cv2.VideoCapture:
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(0)  # OpenCV's own lines about a bad file would come before ours
    try:
        capture = cv2.VideoCapture(os.fspath(path))
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not capture.isOpened():
        raise InputError(f"{path}: OpenCV cannot read it as a video; expected mp4, mov, avi or the like; convert it")
    return capture


def _native(capture: cv2.VideoCapture) -> tuple[int, int]:
    return round(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), round(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))


def _pick(count: int, file_fps: float, start: float, end: float | None, stride: int) -> tuple[int, float]:
    """First frame and the (exclusive) end of the kept ones, in file frames."""
    first = math.ceil(start * file_fps - 1e-6)
    last = math.inf if end is None else end * file_fps - 1e-6
    if count and math.isinf(last):
        last = float(count)
    return first, last


def read_clip(
    path: str | os.PathLike,
    *,
    fps: float | None = None,
    start: float = 0.0,
    end: float | None = None,
    stride: int = 1,
    size: str | tuple[int, int] | None = None,
) -> Clip:
    """Reads the kept frames of a video, and some around them for the background.

    Args:
      path: the video file.
      fps: true capture rate, frames per second; None takes the file's. A slow-motion clip plays slower than it was
        captured, so its file says less than the truth.
      start: first moment kept, seconds of FILE time (what a player shows), whatever ``fps`` says.
      end: last moment, exclusive, seconds of FILE time; None is the end of the file.
      stride: keeps every so many-th frame; the kept frames' rate is ``fps / stride``.
      size: output size ``WxH``; None keeps the file's.

    Raises:
      InputError: the file cannot be read, or an argument is out of range.
    """
    path = Path(path)
    _check(path, fps, start, end, stride)
    target = parse_size(size)
    capture = _open(path)
    try:
        native = _native(capture)
        file_fps = capture.get(cv2.CAP_PROP_FPS)
        if not (math.isfinite(file_fps) and file_fps > 0):
            raise InputError(f"{path}: the file states no frame rate; convert it to a file with a constant rate")
        counted = max(0, round(capture.get(cv2.CAP_PROP_FRAME_COUNT)))
        first, last = _pick(counted, file_fps, start, end, stride)
        return _collect(path, capture, target, native, (first, last, stride), fps or file_fps, file_fps, counted)
    finally:
        capture.release()


def _collect(
    path: Path,
    capture: cv2.VideoCapture,
    target: tuple[int, int] | None,
    native: tuple[int, int],
    pick: tuple[int, float, int],
    fps: float,
    file_fps: float,
    counted: int,
) -> Clip:
    first, last, stride = pick
    width, height = target or native
    end = min(last, counted) if counted else last
    reach = max(5.0 * file_fps, (end - first)) if math.isfinite(end) else math.inf
    wanted = int(np.clip(_CONTEXT_PIXELS // max(1, width * height), _FEWEST_CONTEXT, _MOST_CONTEXT))
    span = min(counted, end + reach) - max(0, first - reach) if counted and math.isfinite(end) else 4 * wanted
    every = max(1, math.ceil(span / wanted))
    if math.isfinite(end) and (end - first) / stride * width * height * 3 > _MOST_PIXELS:
        raise InputError(
            f"{path}: {math.ceil((end - first) / stride)} frames of {width}x{height} are too many to hold; "
            "narrow --start/--end, or raise --stride, or give a smaller --size"
        )
    kept, indices, context, index, whole = [], [], [], -1, True
    for index, frame in enumerate(_decode(capture, target)):
        if first <= index < last and (index - first) % stride == 0:
            kept.append(frame)
            indices.append(index)
        if _is_context(index, every, first, end, reach):
            context.append(frame)
        if index > end + reach:
            whole = False
            break
    count = index + 1
    if count == 0:
        raise InputError(f"{path}: not one frame can be decoded; expected a video; convert it")
    if len(kept) < 2:
        raise InputError(
            f"{path}: {len(kept)} frame(s) kept of {count} (file time {count / file_fps:.3f} s); expected 2 or more; "
            "widen --start/--end (seconds of file time) or lower --stride"
        )
    if kept[0].shape[0] < 16 or kept[0].shape[1] < 16:
        raise InputError(f"{path}: pictures of {width}x{height}; expected 16x16 or more; give --size")
    thin = max(1, math.ceil(len(context) / (2 * wanted)))
    frames = np.stack(kept)
    return Clip(
        frames=frames,
        fps=fps / stride,
        indices=np.array(indices),
        file_frames=count if whole else max(count, counted),
        context=np.stack(context[::thin] or kept),
        native_size=native,
    )


def read_masks(directory: str | os.PathLike, clip: Clip) -> Int[np.ndarray, "frames height width"]:
    """Reads one PNG a frame: palette or grey pictures hold ids, RGB ones a colour an object (black is background).

    Files are sorted by name (numbers in names count as numbers). There must be one for each kept frame, or one for
    each frame of the file.

    Raises:
      InputError: no directory, no PNG, a wrong count, or an unreadable picture.
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise InputError(f"{directory}: no such directory; --masks names a directory with one PNG a frame")
    files = sorted((f for f in directory.iterdir() if f.suffix.lower() == ".png"), key=_natural)
    if not files:
        raise InputError(f"{directory}: holds no .png; --masks expects one PNG a frame")
    kept = len(clip.frames)
    if len(files) != kept:
        if len(files) != clip.file_frames:
            raise InputError(
                f"{directory}: {len(files)} PNGs; expected {kept} (one a kept frame) "
                f"or {clip.file_frames} (one a frame of the file); export them again or change --stride/--start/--end"
            )
        files = [files[i] for i in clip.indices]
    pictures = [_read_ids(f) for f in files]
    codes = np.unique(np.concatenate([np.unique(p) for p in pictures]))
    codes = codes[codes != 0]
    if codes.size == 0:
        raise InputError(f"{directory}: every mask is empty; expected at least one object")
    if codes.size > 64:
        raise InputError(
            f"{directory}: {codes.size} ids; expected at most 64 objects; save masks without blending or JPEG compression"
        )
    height, width = clip.frames.shape[1:3]
    if codes.max() <= 255 and all(p.dtype == np.uint8 for p in pictures):
        table = {int(c): int(c) for c in codes}  # ids of grey and palette pictures stay as they are
    else:
        table = {int(c): i + 1 for i, c in enumerate(codes)}
    masks = np.zeros((kept, height, width), np.int32)
    for t, picture in enumerate(pictures):
        for code, number in table.items():
            masks[t][_fit(picture == code, width, height)] = number
    return masks


def _natural(path: Path) -> tuple[int, str]:
    digits = "".join(c if c.isdigit() else " " for c in path.stem).split()
    return (int(digits[-1]) if digits else -1, path.name)


def _fit(region: Bool[np.ndarray, "h w"], width: int, height: int) -> Bool[np.ndarray, "height width"]:
    if region.shape == (height, width):
        return region
    covered: Float[np.ndarray, "height width"] = cv2.resize(
        region.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA
    )
    return covered >= 0.5


def _read_ids(path: Path) -> np.ndarray:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as picture:
            if picture.mode in ("P", "L", "1"):
                values = np.asarray(picture)
                return values.astype(np.uint8)
            if picture.mode.startswith("I"):
                return np.asarray(picture).astype(np.int64)
            rgb = np.asarray(picture.convert("RGB")).astype(np.int64)
    except (OSError, UnidentifiedImageError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as a PNG ({error}); export it again") from error
    return (rgb[..., 0] << 16) | (rgb[..., 1] << 8) | rgb[..., 2]
