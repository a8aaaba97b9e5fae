"""Parameters of the effects in a scene: single numbers that it gives are refined like its own, series and counts stay."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from mjx_refine.batch import BatchEffect
from mjx_refine.effects import batch_with_effects, kind_of
from mjx_refine.effects.kind import EffectParameter
from mjx_refine.scene import Scene
from mjx_refine.space.layout import linear
from mjx_refine.space.parameter import Parameter

FIELD = "effect "
"""Begins the name of the array of an effect's numbers, which its position in the scene ends."""

TRUST, FAR = 0.2, 3.0
"""Width of the prior around an effect's numbers in a scene, and how far bounds lie at least, in widths of its kind: a diagnosis,
or a person, put them there."""


def _numbers(effect: BatchEffect) -> Iterator[tuple[int, EffectParameter]]:
    """Each parameter of an effect with the column of its first number."""
    rows = kind_of(effect.name).parameters
    series = sum(p.length < 0 for p in rows)
    frames = (effect.values.shape[1] - sum(max(p.length, 1) for p in rows if p.length >= 0)) // max(series, 1)
    column = 0
    for p in rows:
        yield column, p
        column += frames if p.length < 0 else max(p.length, 1)


def effect_parameters(scene: Scene) -> tuple[list[Parameter], list[tuple[str, str]]]:
    """(parameters, (name, reason) of what stays), with the priors of their kinds around the values in the scene.

    Raises:
      InputError: an effect is wrong.
    """
    parameters: list[Parameter] = []
    fixed: list[tuple[str, str]] = []
    effects = batch_with_effects([scene]).effects if scene.effects else ()
    for k, effect in enumerate(effects):
        whose = f"{scene.names[effect.target]}." if effect.target >= 0 else ""
        # Two pushes on one object are two.
        before = sum((e.name, e.target) == (effect.name, effect.target) for e in effects[:k])
        label = f"{whose}{effect.name}{before + 1 if before else ''}"
        for column, p in _numbers(effect):
            name, value = f"{label}.{p.name}", float(effect.values[0, column])
            if p.length != 0:
                fixed.append((name, "a series; a diagnosis fits it"))
            elif p.whole:
                fixed.append((name, "only whole numbers mean something"))
            elif p.name not in dict(scene.effects[k].parameters) or not np.isfinite(value):
                fixed.append((name, "it is not given"))
            else:
                bounds = min(p.low, value), max(p.high, value)
                parameters.append(
                    linear(name, p.unit, f"{FIELD}{k}", (-1, column), value, TRUST * p.width, *bounds, FAR * p.width)
                )
    return parameters, fixed


def with_numbers(scene: Scene, effects: tuple[BatchEffect, ...]) -> Scene:
    """The scene with the single numbers of its effects as the first candidate has them."""
    entries = []
    for entry, effect in zip(scene.effects, effects, strict=True):
        given = dict(entry.parameters)
        for column, p in _numbers(effect):
            value = float(effect.values[0, column])
            if p.length == 0 and not p.whole and np.isfinite(value) and value != given.get(p.name, p.default):
                given[p.name] = value
        entries.append(dataclasses.replace(entry, parameters=tuple(given.items())))
    return dataclasses.replace(scene, effects=tuple(entries))
