"""Which primitives an object's outline may be, seen from some direction."""

from __future__ import annotations

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
    for shape, price in (("upright", 0.03), ("lying", 0.05), ("box", 0.05)):
        if tiny and shape != "box":
            continue
        if shape == "lying" and pitch < 60 and track.roundness > 0.85:
            continue
        form = fit_forms(lens, sight, track.widths, shape, turned=airborne and shape == "box")[0]
        priced.append((price + form.misfit + (0.1 if tiny else 0.0), form))
    return [form for _, form in sorted(priced, key=lambda item: item[0])]


def form_sets(options: list[list[Form]], most: int) -> list[tuple[Form, ...]]:
    """At most ``most`` choices of one form an object: all likeliest, all second, then one object at a time."""
    sets = [tuple(o[min(rank, len(o) - 1)] for o in options) for rank in range(max(map(len, options)))]
    base = sets[0]
    single = []
    for rank, i in itertools.product((1, 2), range(len(options))):
        if rank < len(options[i]):
            single.append((*base[:i], options[i][rank], *base[i + 1 :]))
    result: dict[tuple, tuple[Form, ...]] = {}
    for forms in [*sets[:2], *single, *sets[2:]]:
        key = tuple((f.shape, tuple(round(float(v), 3) for v in f.size), f.quaternion) for f in forms)
        result.setdefault(key, forms)
    return list(result.values())[:most]
