"""From a video file to an observation: flow, instance masks, and what to know about them."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mjx_refine.errors import InputError
from mjx_refine.observation import Observation, make_observation
from mjx_refine.observe.camera import CameraMotion, measure_camera
from mjx_refine.observe.flow import FlowField, measure_flow
from mjx_refine.observe.segment import segment
from mjx_refine.observe.spikes import cut_spikes
from mjx_refine.observe.video import Clip, read_clip, read_masks

_MANY_FRAMES = 300
_FEW_FRAMES = 6


@dataclass(frozen=True)
class ObjectReport:
    """One object: its mask id, in how many frames it is seen, first and last of them, median area [px], greatest
    distance of its centroid from its first place [px], median noise of its flow [px]."""

    mask_id: int
    frames: int
    first: int
    last: int
    area: float
    travelled: float
    flow_noise: float


@dataclass(frozen=True)
class ObserveReport:
    """What was found in a clip.

    Attributes:
      warnings: sentences for the user.
      objects: the objects, by mask id.
      camera_moving: whether the background moves.
      camera_drift: greatest displacement of the picture's corners, px.
      flow_noise: standard deviation of the flow where nothing moves, px.
      unmeasured: share of the flow that is NaN.
      frames: kept frames.
      fps: kept frames per second.
    """

    warnings: tuple[str, ...]
    objects: tuple[ObjectReport, ...]
    camera_moving: bool
    camera_drift: float
    flow_noise: float
    unmeasured: float
    frames: int
    fps: float


@dataclass(frozen=True)
class ObserveResult:
    """An observation and the report on it."""

    observation: Observation
    report: ObserveReport


def observe_clip(
    path: str | os.PathLike,
    *,
    fps: float | None = None,
    start: float = 0.0,
    end: float | None = None,
    stride: int = 1,
    size: str | tuple[int, int] | None = None,
    masks_dir: str | os.PathLike | None = None,
    progress: Callable[[float, str], object] | None = None,
) -> ObserveResult:
    """Measures flow and instance masks of a real clip.

    Args:
      path: the video file.
      fps: true capture rate, frames per second; None takes the file's. Give it for slow motion.
      start, end: what to keep, seconds of FILE time (what a player shows), whatever ``fps`` says; end is exclusive.
      stride: keeps every so many-th frame; the observation's rate is ``fps / stride``.
      size: output size, ``WxH``; None keeps the file's.
      masks_dir: directory with one PNG of instance ids for each kept frame, or for each frame of the file; None
        finds the moving objects here.
      progress: called with the share done (0..1) and the name of the step.

    Raises:
      InputError: the file or an argument is wrong, or nothing moves in the clip.
    """
    tell = progress or (lambda share, step: None)
    tell(0.0, "reading")
    clip = read_clip(path, fps=fps, start=start, end=end, stride=stride, size=size)
    given = None if masks_dir is None else read_masks(masks_dir, clip)
    tell(0.1, "camera")
    camera = measure_camera(clip.frames)
    warnings = [*_clip_warnings(clip), *_camera_warnings(camera)]
    if given is None:
        found = segment(clip, camera, lambda share: tell(0.15 + 0.55 * share, "objects"))
        masks = found.masks
        warnings += found.warnings
        if not masks.any():
            raise InputError(
                f"{path}: nothing moves that could be told from the background in the {len(clip.frames)} kept frames"
                f"{' (' + '; '.join(found.warnings) + ')' if found.warnings else ''}; "
                "choose other --start/--end, a higher --stride, or give --masks"
            )
        masks, cut = cut_spikes(masks, clip.frames)
        if cut:
            warnings.append(f"in {cut} frames a reflection or shadow touched an object and was cut off its mask")
    else:
        masks = given
    tell(0.7, "flow")
    field = measure_flow(clip.frames, masks)
    tell(1.0, "done")
    objects = _objects(masks, field)
    warnings += _object_warnings(masks, objects)
    observation = make_observation(field.flow, clip.fps, masks, clip.frames, field.sigma, source=os.fspath(path))
    report = ObserveReport(
        tuple(warnings),
        objects,
        camera.moving,
        camera.drift,
        field.background_sigma,
        float(np.isnan(field.flow[..., 0]).mean()),
        len(clip.frames),
        clip.fps,
    )
    return ObserveResult(observation, report)


def _clip_warnings(clip: Clip) -> list[str]:
    count, height, width = clip.frames.shape[:3]
    said = []
    if count > _MANY_FRAMES:
        said.append(
            f"{count} frames are many: a refinement takes 20 to 60; narrow --start/--end or keep every "
            f"{int(np.ceil(count / 50))}th with --stride"
        )
    if count < _FEW_FRAMES:
        said.append(f"only {count} frames are kept; 20 to 60 tell more; widen --start/--end or lower --stride")
    native = clip.native_size[0] / max(1, clip.native_size[1])
    if abs(np.log((width / height) / native)) > 0.02:
        said.append(
            f"the size {width}x{height} changes the picture's proportions ({clip.native_size[0]}x{clip.native_size[1]}); "
            "a camera model with square pixels will not fit"
        )
    changes = np.abs(np.diff(clip.frames[:, ::4, ::4].astype(np.int16), axis=0)).max(axis=(1, 2, 3))
    doubled = int(np.count_nonzero(changes <= 1))
    if 0 < doubled < 0.9 * len(changes):
        said.append(
            f"{doubled} kept frame{'s repeat' if doubled > 1 else ' repeats'} the one before: the file may be padded to a "
            "higher rate than it was captured at; check --fps and --stride"
        )
    return said


def _camera_warnings(camera: CameraMotion) -> list[str]:
    if camera.moving:
        return [
            f"the camera moves: the background drifts by up to {camera.drift:.1f} px; masks come from a mosaic of the "
            "background and are less certain, and a still camera will not replay this clip"
        ]
    return []


def _objects(masks: Int[np.ndarray, "frames height width"], field: FlowField) -> tuple[ObjectReport, ...]:
    reports = []
    for number in np.unique(masks[masks > 0]):
        areas = (masks == number).sum((1, 2))
        seen = np.nonzero(areas)[0]
        centres = np.stack([_centre(masks[t] == number) for t in seen])
        noise = field.sigma[masks[:-1] == number]
        reports.append(
            ObjectReport(
                int(number),
                len(seen),
                int(seen[0]),
                int(seen[-1]),
                float(np.median(areas[seen])),
                float(np.hypot(*(centres - centres[0]).T).max()),
                float(np.median(noise)) if noise.size else float("nan"),
            )
        )
    return tuple(reports)


def _centre(region: np.ndarray) -> Float[np.ndarray, " 2"]:
    rows, cols = np.nonzero(region)
    return np.array([cols.mean() + 0.5, rows.mean() + 0.5])


def _object_warnings(masks: Int[np.ndarray, "frames height width"], objects: tuple[ObjectReport, ...]) -> list[str]:
    said = []
    for entry in objects:
        region = masks == entry.mask_id
        border = region[:, [0, -1]].any((1, 2)) | region[:, :, [0, -1]].any((1, 2))
        if border.any():
            frames = np.nonzero(border)[0]
            said.append(
                f"object {entry.mask_id} touches the picture's border in {len(frames)} frame"
                f"{'s' if len(frames) > 1 else ''} (first {frames[0]}): its outline is cut there"
            )
        missing = entry.last - entry.first + 1 - entry.frames
        if missing:
            said.append(f"object {entry.mask_id} is lost in {missing} frames between {entry.first} and {entry.last}")
        if entry.area < 60:
            said.append(
                f"object {entry.mask_id} covers only {entry.area:.0f} px: its outline is uncertain by a fifth or so"
            )
        seen = np.nonzero(region.any((1, 2)))[0]
        centres = np.stack([_centre(region[t]) for t in seen])
        steps = np.hypot(*np.diff(centres, axis=0).T)
        if len(steps) and np.quantile(steps, 0.9) > 2 * np.sqrt(entry.area):
            said.append(
                f"object {entry.mask_id} moves by up to {steps.max():.0f} px a frame, more than twice its size: "
                "a lower --stride gives safer flow"
            )
        if entry.travelled < 1.5:
            said.append(f"object {entry.mask_id} does not move in the kept frames")
    return said
