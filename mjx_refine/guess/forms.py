"""Which primitives an object's outline may be, seen from some direction."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from mjx_refine.guess.lift import Form, Lens, fit_forms, sphere_form
from mjx_refine.guess.tracks import Track

TINY = 9.0
"""Diameter [px] below which an outline does not tell a disc from a square."""

ROUND = 0.72
"""Narrowest over widest: above it, an outline may be a disc (a fast ball's is drawn out by its motion)."""


def form_options(track: Track, lens: Lens, *, airborne: bool) -> list[Form]:
    """Primitives that fit the outline near the first frame, likeliest first."""
    sight = lens.rays(track.centre[track.pieces[0].frames[0]])
    sight = sight / np.linalg.norm(sight)
    pitch = np.degrees(lens.pitch)
    priced: list[tuple[float, Form]] = []
    tiny = track.diameter < TINY
    if tiny or track.roundness > ROUND:
        misfit = float(track.widths.std() / track.widths.mean())
        priced.append((0.3 * misfit if tiny else misfit, sphere_form(track.area)))
    # A body of more freedom must fit better to be preferred.
    # Seen from above, a puck is as plain a disc as a ball.
    for shape, price in (("upright", 0.0 if pitch < 30 else 0.03), ("lying", 0.05), ("box", 0.05)):
        # A disc in the air is a ball: a can would show another outline as it turns.
        if shape != "box" and (tiny or (airborne and track.roundness > 0.8)):
            continue
        if shape == "lying" and pitch < 60 and track.roundness > 0.85:
            continue
        form = fit_forms(lens, sight, track.widths, shape, turned=airborne and shape == "box")[0]
        if shape == "upright" and pitch < 30 and track.roundness > ROUND:
            # Its height cannot be seen from above.
            radius = sphere_form(track.area).size[0]
            form = dataclasses.replace(form, size=(radius, 0.7 * radius))
        priced.append((price + form.misfit + (0.1 if tiny or airborne else 0.0), form))
    return [form for _, form in sorted(priced, key=lambda item: item[0])]


def form_sets(options: list[list[Form]], most: int) -> list[tuple[Form, ...]]:
    """At most ``most`` choices of one form an object: all likeliest, all of one kind, then one object at a time."""
    base = tuple(o[0] for o in options)
    kinds = {kind(f): None for o in options for f in o}
    alike = []
    for k in kinds:
        forms = [f for o in options for f in [g for g in o if kind(g) == k][:1]]
        if len(forms) == len(options):
            alike.append((sum(o.index(f) for o, f in zip(options, forms, strict=True)), _same_size(forms)))
    alike = [forms for _, forms in sorted(alike, key=lambda item: item[0])]
    single = []
    for rank, i in itertools.product((1, 2), range(len(options))):
        if rank < len(options[i]):
            single.append((*base[:i], options[i][rank], *base[i + 1 :]))
    result: dict[tuple, tuple[Form, ...]] = {}
    # Objects of one clip are often alike.
    for forms in [*alike[:2], base, *single, *alike[2:]]:
        result.setdefault(tuple((kind(f), f.size, f.quaternion) for f in forms), forms)
    return list(result.values())[:most]


def _same_size(forms: list[Form]) -> tuple[Form, ...]:
    """Objects of one kind and about one size are taken to be equal: then so are their masses."""
    sizes = np.array([f.size for f in forms])
    if len(forms) == 1 or (sizes.max(0) > 1.2 * sizes.min(0)).any():
        return tuple(forms)
    mean = tuple(float(v) for v in sizes.mean(0))
    return tuple(dataclasses.replace(f, size=mean) for f in forms)


def kind(form: Form) -> str:
    """Its shape, and for cylinders whether it stands or lies."""
    if form.shape != "cylinder":
        return form.shape
    return "upright" if form.quaternion == (1.0, 0.0, 0.0, 0.0) else "lying"
