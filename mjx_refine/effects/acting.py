"""The effects of a batch at work: one place that asks every kind what it does."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_refine import rotations
from mjx_refine.batch import BatchEffect, SceneBatch, batch_from_scenes
from mjx_refine.effects.kind import EffectKind, OutlineView
from mjx_refine.effects.registry import acting_kind, kind_of
from mjx_refine.errors import InputError
from mjx_refine.scene import Effect, Scene


def batch_with_effects(scenes: list[Scene]) -> SceneBatch:
    """Scenes of one kind, with the same kinds of effects, as a batch.

    Raises:
      InputError: an effect is unknown, has a wrong parameter, or lacks its target.
      ValueError: no scene, or the scenes' kinds differ.
    """
    batch = batch_from_scenes(scenes)
    kinds = [[(e.effect, e.target) for e in scene.effects] for scene in scenes]
    if any(kind != kinds[0] for kind in kinds):
        raise ValueError(f"effects {kinds}; expected the same in every scene")
    effects = []
    for k, first in enumerate(scenes[0].effects):
        rows = [pack_effect(scene, scene.effects[k]) for scene in scenes]
        longest = max(map(len, rows))
        if any(len(row) != longest for row in rows):
            raise ValueError(f"effect {first.effect}: series of different lengths in one batch")
        effects.append(BatchEffect(first.effect, target_index(scenes[0], first), np.array(rows)))
    return dataclasses.replace(batch, effects=tuple(effects))


def target_index(scene: Scene, effect: Effect) -> int:
    """Index of the object that ``effect`` acts on, or -1.

    Raises:
      InputError: the kind needs a target and has none, or the other way round.
    """
    kind = kind_of(effect.effect, "entry effect.effect")
    if kind.targeted and effect.target is None:
        if len(scene.objects) == 1:
            return 0
        raise InputError(f"effect {kind.name}.target is missing; expected one of {', '.join(scene.names)}; add it")
    if effect.target is None:
        return -1
    return scene.names.index(effect.target)


def pack_effect(scene: Scene, effect: Effect) -> Float[np.ndarray, "parameters"]:
    """The effect's parameters in its kind's order; series are as long as the longest that the scene file gives.

    Raises:
      InputError: a name or value is wrong.
    """
    kind = kind_of(effect.effect, "entry effect.effect")
    given = dict(effect.parameters)
    series = [len(v) for v in given.values() if isinstance(v, tuple)]
    target_index(scene, effect)
    return kind.pack(given, max(series, default=1), f"effect {effect.effect}")


def effect_entry(kind: EffectKind, target: str | None, values: Float[np.ndarray, "parameters"], frames: int) -> Effect:
    """The scene entry of fitted values."""
    return Effect(kind.name, target, tuple(kind.unpack(values, frames).items()))


def acting_in(batch: SceneBatch) -> Iterator[tuple[EffectKind, BatchEffect]]:
    """The batch's effects, each with its kind."""
    for effect in batch.effects:
        yield acting_kind(effect.name), effect


def is_physical(batch: SceneBatch) -> bool:
    """Whether an effect of the batch acts in the rollout itself."""
    return any(kind.physical for kind, _ in acting_in(batch))


def centre_of_mass(batch: SceneBatch) -> Float[np.ndarray, "batch objects 3"] | None:
    """Centres of mass in the bodies' frames [m], or None where all are at the centres."""
    found = [kind.centre_of_mass(batch, effect.target, effect.values) for kind, effect in acting_in(batch)]
    told = [one for one in found if one is not None]
    return sum(told[1:], told[0]) if told else None


def floor_rotation(batch: SceneBatch) -> Float[np.ndarray, "batch 3 3"] | None:
    """Floor to world, or None where the floor is level."""
    result = None
    for kind, effect in acting_in(batch):
        turn = kind.floor(effect.values)
        if turn is not None:
            result = turn if result is None else turn @ result
    return result


def untimed(batch: SceneBatch) -> SceneBatch:
    """The batch without what changes which frame is shown when."""
    return dataclasses.replace(batch, effects=tuple(e for kind, e in acting_in(batch) if not kind.retimes))


def shown_frames(batch: SceneBatch, frames: int) -> Int[np.ndarray, "batch frames"] | None:
    """Which simulated frame is shown in each frame of the clip, or None where they are the same."""
    index = None
    for kind, effect in acting_in(batch):
        told = kind.frame_times(frames, effect.values)
        if told is not None:
            index = told if index is None else index + told - np.arange(frames)
    return None if index is None else np.clip(index, 0, 4 * frames + 100)


def turned_state(batch: SceneBatch, turn: Float[np.ndarray, "batch 3 3"]) -> SceneBatch:
    """The batch in axes turned by ``turn``: what was v is turn v."""
    quaternion = quaternion_of(turn)[:, None]

    def vector(v: np.ndarray) -> np.ndarray:
        return np.einsum("bij,b...j->b...i", turn, v)

    restarts = tuple(dataclasses.replace(r, state=turned_states(r.state[:, None], turn)[:, 0]) for r in batch.restarts)
    return dataclasses.replace(
        batch,
        position=vector(batch.position),
        quaternion=rotations.normalise(
            rotations.multiply(np.broadcast_to(quaternion, batch.quaternion.shape), batch.quaternion)
        ),
        linear_velocity=vector(batch.linear_velocity),
        gravity=vector(batch.gravity),
        restarts=restarts,
    )


def turned_states(
    states: Float[np.ndarray, "batch restarts 13"], turn: Float[np.ndarray, "batch 3 3"]
) -> Float[np.ndarray, "batch restarts 13"]:
    """States (``Restart.state``) in axes turned by ``turn``."""
    quaternion = np.broadcast_to(quaternion_of(turn)[:, None], (*states.shape[:2], 4))
    return np.concatenate(
        [
            np.einsum("bij,bkj->bki", turn, states[..., :3]),
            rotations.multiply(quaternion, states[..., 3:7]),
            np.einsum("bij,bkj->bki", turn, states[..., 7:10]),
            states[..., 10:],
        ],
        -1,
    )


def on_the_floor(batch: SceneBatch) -> SceneBatch:
    """The batch with its objects carried along by a tilted floor: what stood on z = 0 stands on the slope."""
    turn = floor_rotation(batch)
    return batch if turn is None else dataclasses.replace(turned_state(batch, turn), gravity=batch.gravity)


def quaternion_of(matrix: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 4"]:
    """Unit quaternions w x y z of rotations (Shepperd 1978: by the largest component)."""
    m = matrix
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    squares = np.stack([1 + trace] + [1 + 2 * m[..., i, i] - trace for i in range(3)], -1)
    largest = squares.argmax(-1)
    twice = {(i, j): m[..., i, j] + m[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2))}
    turn = {(i, j): m[..., i, j] - m[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))}
    rows = np.stack(
        [
            np.stack([squares[..., 0], turn[2, 1], turn[0, 2], turn[1, 0]], -1),
            np.stack([turn[2, 1], squares[..., 1], twice[0, 1], twice[0, 2]], -1),
            np.stack([turn[0, 2], twice[0, 1], squares[..., 2], twice[1, 2]], -1),
            np.stack([turn[1, 0], twice[0, 2], twice[1, 2], squares[..., 3]], -1),
        ],
        -2,
    )
    chosen = np.take_along_axis(rows, largest[..., None, None], -2)[..., 0, :]
    return chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)


def moves_camera(batch: SceneBatch) -> Bool[np.ndarray, ""]:
    """Whether an effect turns or moves the camera."""
    return any(type(kind).camera is not EffectKind.camera for kind, _ in acting_in(batch))  # type: ignore[return-value]


def camera_path(
    batch: SceneBatch, frames: int, fps: float
) -> tuple[Float[np.ndarray, "batch frames 3 3"], Float[np.ndarray, "batch frames 3"]]:
    """Camera to world in every frame, and its position [m]."""
    level = np.zeros_like(batch.camera_pitch)
    base = rotations.matrix(rotations.exponential(np.stack([batch.camera_pitch, level, level], -1)))[:, None]
    turn = np.broadcast_to(np.eye(3), (len(batch), frames, 3, 3))
    travel = np.zeros((len(batch), frames, 3))
    for kind, effect in acting_in(batch):
        told = kind.camera(frames, fps, effect.values)
        if told is not None:
            turn, travel = turn @ told[0], travel + told[1]
    return base @ turn, batch.camera_position[:, None] + travel


def apparent(
    poses: Float[np.ndarray, "batch frames objects 7"], batch: SceneBatch, fps: float
) -> Float[np.ndarray, "batch frames objects 7"]:
    """Poses that the camera of ``batch``, standing still, would see as the moving, rolled one sees ``poses``."""
    if not moves_camera(batch):
        return poses
    axes, place = camera_path(batch, poses.shape[1], fps)
    still, where = camera_path(dataclasses.replace(batch, effects=()), 1, fps)
    turn = still @ np.swapaxes(axes, -1, -2)
    moved = np.einsum("btij,btnj->btni", turn, poses[..., :3] - place[:, :, None]) + where[:, :, None]
    quaternion = quaternion_of(turn)[:, :, None]
    turned = rotations.multiply(np.broadcast_to(quaternion, poses[..., 3:].shape), poses[..., 3:])
    return np.concatenate([moved, turned], -1)


def changes_outlines(batch: SceneBatch) -> bool:
    """Whether an effect changes outlines."""
    return any(kind.drawn for kind, _ in acting_in(batch))


def directions_of_outlines(batch: SceneBatch) -> int:
    """In how many directions what effects do to outlines must be told; 0: few do."""
    return max((kind.directions(effect.values) for kind, effect in acting_in(batch)), default=0)


def outline_change(batch: SceneBatch, view: OutlineView) -> Float[np.ndarray, "batch frames objects directions"]:
    """What the effects add to the support functions [px]; NaN where nothing is seen any more."""
    total = np.zeros(view.reach.shape)
    for kind, effect in acting_in(batch):
        told = kind.outline(view, effect.target, effect.values)
        if told is not None:
            total = total + told
    return total


def outlines_moved(
    batch: SceneBatch, view: OutlineView
) -> Float[np.ndarray, "batch frames objects directions 2"] | None:
    """How far effects move points of outlines [px], or None where none does."""
    found = [kind.moved(view, effect.target, effect.values) for kind, effect in acting_in(batch)]
    told = [one for one in found if one is not None]
    return sum(told[1:], told[0]) if told else None


def overdrawn(batch: SceneBatch) -> Float[np.ndarray, "batch"] | None:
    """How far masks show what lies beside the objects [px], or None where no effect says so."""
    found = [kind.overdrawn(effect.values) for kind, effect in acting_in(batch)]
    told = [one for one in found if one is not None]
    return sum(told[1:], told[0]) if told else None


def hidden_polygons(
    batch: SceneBatch, outline: Float[np.ndarray, "batch frames objects corners 2"]
) -> Float[np.ndarray, "batch frames objects others 2"] | None:
    """The parts of convex polygons that an effect hides [px], or None where none does."""
    for kind, effect in acting_in(batch):
        told = kind.hidden(outline, effect.values)
        if told is not None:
            return told
    return None


def warps(batch: SceneBatch) -> bool:
    """Whether an effect moves points of the picture."""
    return any(type(kind).warp is not EffectKind.warp for kind, _ in acting_in(batch))


def warped(
    batch: SceneBatch,
    points: Float[np.ndarray, "batch *shape 2"],
    focal: Float[np.ndarray, "batch"],
    image: tuple[int, int],
) -> Float[np.ndarray, "batch *shape 2"]:
    """Where points of the undistorted picture are seen [px]."""
    for kind, effect in acting_in(batch):
        moved = kind.warp(points, focal, image, effect.values)
        if moved is not None:
            points = points + moved
    return points
