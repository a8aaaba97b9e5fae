"""Scores of many candidates of many clips at once: every sample is drawn, compared and summed in one kernel.

On a GPU this beats tiles: nothing is decided on the host between poses and sums, and a device with bandwidth to spare draws
background faster than it could be told where there is none. Clips of one scene kind and size are scored together.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from mjx_fitness import UNMATCHED, Scores, Sums, Weights, scores_from_sums

from mjx_refine.batch import SceneBatch
from mjx_refine.observation import Observation
from mjx_refine.scene import Shape
from mjx_refine.view.frames import Frames, make_frames
from mjx_refine.view.rays import cast
from mjx_refine.view.tiles import foreground

CHUNKS = (128, 64, 32, 16)
"""Candidates of one clip in one kernel, at most; a clip's candidates are padded to a multiple."""

MOST = 1 << 27
"""Samples of all frames of a chunk, unless one candidate has more: of four objects XLA kept eight numbers for each sample at a
time, half a gigabyte each here."""

SPARE = 1.1
"""Padding may cost this factor; smaller chunks are taken where it costs more."""

ROOMY = 2.0
"""While clips leave, their room is kept up to this factor: what is compiled fits on."""

_USED: dict[tuple, set[tuple[int, int, int]]] = {}
"""Sizes of layouts (candidates in a chunk, chunks, rows of poses) that programs are compiled for, by what else they depend on."""

AWAY = (0.0, 0.0, -1e3, 1.0, 0.0, 0.0, 0.0)
"""The pose of what is not to be seen."""

FARTHEST = 1e4
"""Coordinate beyond which a candidate has diverged [m]."""


@dataclasses.dataclass(frozen=True)
class SampledClip:
    """One clip at the samples, C order; P samples a frame.

    Attributes:
      image: (width, height) of the full picture [px].
      resolution: (width, height) of the samples.
      x, y: image coordinates of the samples [px].
      ids: 0 the background, n + 1 what is matched to object n, the next one for what is matched to none.
      flow_x, flow_y: [px/frame]; NaN where not measured, and in the last frame.
      moving_only: whether only what moves counts as seen, for clips without masks.
    """

    image: tuple[int, int]
    resolution: tuple[int, int]
    x: Float[np.ndarray, "samples"]
    y: Float[np.ndarray, "samples"]
    ids: Int[np.ndarray, "frames samples"]
    flow_x: Float[np.ndarray, "frames samples"]
    flow_y: Float[np.ndarray, "frames samples"]
    moving_only: bool

    @property
    def kind(self) -> tuple:
        """Clips of one kind can be scored together."""
        return self.image, self.resolution, len(self.ids), self.moving_only


def sampled(
    observation: Observation, matching: Sequence[int], resolution: tuple[int, int] | None = None
) -> SampledClip:
    """A clip at ``resolution`` (width, height) samples, each a pixel of the full picture; by default all of them.

    ``matching`` gives for each object its mask's id, or ``UNMATCHED``.
    """
    wanted = resolution or observation.size
    columns, rows = (
        np.floor((np.arange(min(some, full)) + 0.5) * full / min(some, full)).astype(np.int64)
        for some, full in zip(wanted, observation.size, strict=True)
    )
    masks = foreground(observation)[:, rows][:, :, columns]
    ids = np.full(masks.shape, len(matching) + 1, np.int8) * (masks > 0)
    for n, i in enumerate(matching):
        if i != UNMATCHED:
            ids[masks == i] = n + 1
    if observation.masks is None:
        ids[-1] = 0
    flow = np.full((2, *ids.shape), np.nan, np.float32)
    flow[:, :-1] = np.moveaxis(observation.flow[:, rows][:, :, columns], -1, 0)
    length = len(ids)
    x, y = np.meshgrid(columns + 0.5, rows + 0.5)
    return SampledClip(
        image=observation.size,
        resolution=(len(columns), len(rows)),
        x=x.ravel().astype(np.float32),
        y=y.ravel().astype(np.float32),
        ids=ids.astype(np.int8).reshape(length, -1),
        flow_x=flow[0].reshape(length, -1),
        flow_y=flow[1].reshape(length, -1),
        moving_only=observation.masks is None,
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _Clips:
    """C clips on the device."""

    x: Float[Array, "samples"]
    y: Float[Array, "samples"]
    ids: Int[Array, "clips frames samples"]
    flow_x: Float[Array, "clips frames samples"]
    flow_y: Float[Array, "clips frames samples"]


class GridScorer:
    """Scores candidates of one scene kind, each against the clip that it belongs to.

    Args:
      shapes: the scene kind.
      clips: of one kind.
      weights: of each clip's fitness.

    Raises:
      ValueError: no clip, or clips that cannot be scored together.
    """

    def __init__(
        self, shapes: tuple[Shape, ...], clips: Sequence[SampledClip], weights: Sequence[Weights] | None = None
    ):
        if not clips or any(clip.kind != clips[0].kind for clip in clips):
            raise ValueError(f"clips {[clip.kind for clip in clips]}; expected at least one, all of one kind")
        self.shapes, first = shapes, clips[0]
        self.weights = tuple(weights or [Weights()] * len(clips))
        self.image, self.length, self.moving_only = first.image, len(first.ids), first.moving_only
        room = 1 << (len(clips) - 1).bit_length()  # few sizes are ever compiled
        kept = [*clips, *[first] * (room - len(clips))]
        self._clips = _Clips(
            x=jnp.asarray(first.x),
            y=jnp.asarray(first.y),
            **{name: jnp.asarray(np.stack([getattr(c, name) for c in kept])) for name in ("ids", "flow_x", "flow_y")},
        )
        self._layouts: dict[tuple[int, ...], _Layout] = {}
        self._used = _USED.setdefault((shapes, self.image, self.moving_only, self._clips.ids.shape), set())
        observed = [_observed(clip, len(shapes)) for clip in clips]
        self._observed = {name: np.stack([one[name] for one in observed]) for name in observed[0]}

    def __call__(self, poses: Float[np.ndarray, "batch frames objects 7"], batch: SceneBatch) -> Scores:
        """Scores against the first clip; a candidate whose poses are not finite has fitness -inf and IoU 0."""
        return self.score(poses, batch, [len(batch)])[0]

    def score(
        self, poses: Float[Array | np.ndarray, "rows frames objects 7"], batch: SceneBatch, counts: Sequence[int]
    ) -> list[Scores]:
        """Scores of every clip's candidates: ``compared``, then ``scored``."""
        return self.scored(self.compared(poses, batch, counts), counts)

    def compared(
        self, poses: Float[Array | np.ndarray, "rows frames objects 7"], batch: SceneBatch, counts: Sequence[int]
    ) -> Float[Array, "sums places frames"]:
        """The device's part, which goes on when this returns: sums over samples, for ``scored``.

        Args:
          poses: of the candidates of all clips, one clip after the other; there may be further rows.
          batch: the candidates, without further rows.
          counts: how many each clip has; one a clip.
        """
        layout = self._layout(tuple(counts), len(batch))
        room = max(len(poses), layout.rows)
        columns = (batch.size.reshape(len(batch), -1), batch.camera_position, batch.camera_pitch, batch.camera_fovy)
        seen_from = np.zeros((room, 3 * len(self.shapes) + 5), np.float32)
        seen_from[: len(batch)] = np.column_stack(columns)
        if len(poses) < room:
            poses = np.concatenate([poses, np.zeros((room - len(poses), *poses.shape[1:]), np.float32)])
        shown = jnp.asarray(poses, jnp.float32), seen_from
        static = (self.shapes, self.image, self.moving_only, layout.chunk)
        return _compared(*static, *shown, layout.row, layout.clip, self._clips)

    def scored(self, sums: Float[Array | np.ndarray, "sums places frames"], counts: Sequence[int]) -> list[Scores]:
        """Each clip's scores from what ``compared`` returned for these ``counts``."""
        layout = self._layout(tuple(counts), sum(counts))
        totals = np.asarray(sums)[:, layout.place].astype(np.float64)
        lost = totals[0, :, 0] < 0
        totals = np.where(lost[:, None], -1.0 - totals, totals)
        seen = {name: values[layout.owner] for name, values in self._observed.items()}
        scores = self._scores(_sums(totals, seen, len(self.shapes)), counts)
        return [_marked(one, gone) for one, gone in zip(scores, _split(lost, counts), strict=True)]

    def _scores(self, sums: Sums, counts: Sequence[int]) -> list[Scores]:
        """Scores by clip; at one go where all have the same weights."""
        if all(weights == self.weights[0] for weights in self.weights):
            return _by_clip(scores_from_sums(sums, self.weights[0]), counts)
        parts = _by_clip(sums, counts)
        return [scores_from_sums(one, weights) for one, weights in zip(parts, self.weights, strict=True)]

    def _layout(self, counts: tuple[int, ...], total: int) -> _Layout:
        if sum(counts) != total or len(counts) != len(self.weights):
            raise ValueError(f"counts add up to {sum(counts)}; expected the batch's {total}, and one a clip")
        if counts not in self._layouts:
            self._layouts.clear()
            self._layouts[counts] = _laid_out(counts, self._used, max(1, MOST // self._clips.ids[0].size))
        return self._layouts[counts]


@dataclasses.dataclass(frozen=True)
class _Layout:
    """Where candidates go: every clip padded to whole chunks, the chunks to few numbers of them.

    Attributes:
      rows: rows of the candidates that poses are padded to, if there are fewer.
      chunk: candidates in a chunk.
      row: of the candidate in each place.
      clip: of each chunk.
      place: of each candidate.
      owner: clip of each candidate.
    """

    rows: int
    chunk: int
    row: Int[Array, "places"]
    clip: Int[Array, "chunks"]
    place: Int[np.ndarray, "batch"]
    owner: Int[np.ndarray, "batch"]


def _laid_out(counts: tuple[int, ...], used: set[tuple[int, int, int]], most: int = CHUNKS[0]) -> _Layout:
    """A layout, of the sizes of one that was used before where it has room and not too much of it; adds to ``used``.

    ``most``: candidates that there is memory for in one chunk.
    """
    total = sum(counts)
    sizes = [chunk for chunk in CHUNKS if chunk <= most] or [1 << (most.bit_length() - 1)]

    def chunks_of(chunk: int) -> int:
        return sum(-(-count // chunk) for count in counts)

    before = [u for u in used if chunks_of(u[0]) <= u[1] and u[2] >= total and u[0] * u[1] <= ROOMY * max(total, 64)]
    if before:
        chunk, number, rows = min(before, key=lambda u: u[0] * u[1])
    else:
        chunk = next((c for c in sizes if chunks_of(c) * c <= SPARE * total), sizes[-1])
        number, rows = _few(chunks_of(chunk)), 16 * _few(-(-total // 16))
        used.add((chunk, number, rows))
    row, clip, place, first = np.zeros(chunk * number, np.int32), np.zeros(number, np.int32), [], 0
    taken = 0
    for k, count in enumerate(counts):
        own = -(-count // chunk)
        here = slice(taken * chunk, (taken + own) * chunk)
        row[here] = first + np.minimum(np.arange(own * chunk), max(count - 1, 0))
        clip[taken : taken + own] = k
        place.append(here.start + np.arange(count))
        first, taken = first + count, taken + own
    owner = np.repeat(np.arange(len(counts)), counts)
    return _Layout(rows, chunk, jnp.asarray(row), jnp.asarray(clip), np.concatenate(place), owner)


T = TypeVar("T", Sums, Scores)


def _by_clip(together: T, counts: Sequence[int]) -> list[T]:
    """Rows of each clip."""
    parts = {f.name: _split(getattr(together, f.name), counts) for f in dataclasses.fields(together)}
    return [type(together)(**{name: part[k] for name, part in parts.items()}) for k in range(len(counts))]


def _split(values: np.ndarray, counts: Sequence[int]) -> list[np.ndarray]:
    return np.split(values, np.cumsum(counts)[:-1])


def _marked(scores: Scores, lost: Bool[np.ndarray, "batch"]) -> Scores:
    """``scores`` with the worst fitness for the candidates that diverged."""
    fitness, iou = np.where(lost, -np.inf, scores.fitness), np.where(lost, 0.0, scores.iou)
    return dataclasses.replace(scores, fitness=fitness, iou=iou)


def _few(count: int) -> int:
    """The next of few numbers, at most an eighth more."""
    step = 1 << max(count.bit_length() - 4, 0)
    return -(-count // step) * step


def _observed(clip: SampledClip, objects: int) -> dict[str, np.ndarray]:
    valid = np.isfinite(clip.flow_x) & np.isfinite(clip.flow_y)
    seen = clip.ids > 0
    return {
        "foreground": seen.sum(1).astype(np.float64),
        "objects": np.stack([(clip.ids == n + 1).sum(1) for n in range(objects)], -1).astype(np.float64),
        "measured": valid.sum(1)[:-1].astype(np.float64),
        "object_measured": (valid & seen).sum(1)[:-1].astype(np.float64),
    }


def _sums(totals: Float[np.ndarray, "sums batch frames"], seen: dict[str, np.ndarray], objects: int) -> Sums:
    intersection, predicted, error, object_error = totals[:4]
    both, drawn = np.moveaxis(totals[4 : 4 + objects], 0, -1), np.moveaxis(totals[4 + objects :], 0, -1)
    return Sums(
        intersection=intersection,
        union=seen["foreground"] + predicted - intersection,
        object_intersection=both,
        object_union=seen["objects"] + drawn - both,
        error=error[:, :-1],
        measured=seen["measured"],
        object_error=object_error[:, :-1],
        object_measured=seen["object_measured"],
    )


@functools.partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _compared(
    shapes: tuple[Shape, ...],
    image: tuple[int, int],
    moving_only: bool,
    chunk: int,
    poses: Float[Array, "rows frames objects 7"],
    seen_from: Float[Array, "rows values"],
    row: Int[Array, "places"],
    clip: Int[Array, "chunks"],
    clips: _Clips,
) -> Float[Array, "sums places frames"]:
    """Sums; -1 minus them of a candidate that diverged. ``seen_from``: sizes, the camera's place, pitch, field of view."""
    poses, seen_from = poses[row], seen_from[row]
    places, length = poses.shape[:2]
    bad = ~jnp.isfinite(poses).all((1, 2, 3)) | (jnp.abs(poses[..., :3]) > FARTHEST).any((1, 2, 3))
    poses = jnp.where(bad[:, None, None, None], jnp.array(AWAY, jnp.float32), poses)
    size, position, pitch, fovy = jnp.split(seen_from, (3 * len(shapes), 3 * len(shapes) + 3, 3 * len(shapes) + 4), 1)
    size = size.reshape(places, len(shapes), 3)
    frames = make_frames(poses, size, position, pitch[:, 0], fovy[:, 0], image[1])
    chunked = jax.tree.map(lambda a: a.reshape(len(clip), chunk * length, *a.shape[1:]), frames)

    def one(part: tuple[Frames, Array]) -> Array:
        return _chunk_sums(shapes, image, moving_only, part[0], clips, part[1], length)

    totals = jax.lax.map(one, (chunked, clip))  # (chunks, sums, frames of a chunk)
    totals = jnp.moveaxis(totals, 1, 0).reshape(-1, places, length)
    return jnp.where(bad[:, None], -1.0 - totals, totals)


def _chunk_sums(shapes, image, moving_only, frames: Frames, clips: _Clips, clip: Array, length: int) -> Array:
    """(sums, frames of a chunk): intersection, predicted, error, the same on objects, each object's two."""
    samples, count = clips.x.shape[0], frames.height.shape[0] // length

    def seen_in(frame_major: Array) -> Array:
        one = jax.lax.dynamic_index_in_dim(frame_major, clip, keepdims=False)
        return jnp.broadcast_to(one, (count, length, samples)).reshape(count * length, samples)

    seen, seen_x, seen_y = seen_in(clips.ids), seen_in(clips.flow_x), seen_in(clips.flow_y)
    x, y = (jnp.broadcast_to(a, seen.shape) for a in (clips.x, clips.y))
    ids, flow_x, flow_y = cast(shapes, frames, x, y, (image[0] / 2, image[1] / 2))
    if moving_only:
        ids = jnp.where(flow_x * flow_x + flow_y * flow_y > 0.25, ids, 0)
    error = jnp.sqrt((flow_x - seen_x) ** 2 + (flow_y - seen_y) ** 2)
    error = jnp.where(jnp.isfinite(seen_x) & jnp.isfinite(seen_y), error, 0.0)
    columns = [
        jnp.where((ids > 0) & (seen > 0), 1.0, 0.0),
        jnp.where(ids > 0, 1.0, 0.0),
        error,
        jnp.where(seen > 0, error, 0.0),
        *[jnp.where((ids == n + 1) & (seen == n + 1), 1.0, 0.0) for n in range(len(shapes))],
        *[jnp.where(ids == n + 1, 1.0, 0.0) for n in range(len(shapes))],
    ]
    zero = [jnp.float32(0.0)] * len(columns)
    # One reduction with many operands: one pass over the samples, nothing of their size is written to memory.
    return jnp.stack(jax.lax.reduce(columns, zero, lambda a, b: [i + j for i, j in zip(a, b, strict=True)], [1]))
