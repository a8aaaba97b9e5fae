"""Outlines that are not a primitive's: low harmonics, worn edges, tapered sides."""

from __future__ import annotations

import numpy as np
import pytest
from effect_scenes import effect
from test_effects_views import HEIGHT, afloat, pictures

from mjx_refine.effects.shape import worn


def test_a_shape_reaches_as_far_as_its_polynomials_say():
    # The fourth polynomial is x^2 - y^2 of the normal: longer in x, shorter in y by as much.
    bulge = [0.0] * 21
    bulge[3] = 0.1
    size = (480, 320)
    plain, masks = (
        pictures(afloat("sphere", (0.5,)), *e, size=size)[0][0] for e in ((), (effect("shape", "thing", bulge=bulge),))
    )
    scale = size[1] / 2 / np.tan(np.deg2rad(22.5)) / HEIGHT
    for axis, sign in ((0, 1), (1, -1)):
        extents = [int((m > 0).any(axis).sum()) for m in (plain, masks)]
        # The tangent plane through the camera leans by the angle of the outline: cos^2 of it.
        lean = 1 - (0.5 / HEIGHT) ** 2
        assert extents[1] - extents[0] == pytest.approx(sign * 2 * 0.1 * lean * scale, abs=1.6)


def test_a_shape_turns_with_its_body():
    bulge = [0.0] * 21
    bulge[3] = 0.1
    turn = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    entry = effect("shape", "thing", bulge=bulge)
    one, other = (
        pictures(afloat("sphere", (0.5,), orientation=q), entry, size=(160, 160))[0][0]
        for q in ((1.0, 0.0, 0.0, 0.0), turn)
    )
    assert (one != np.rot90(other)).mean() < 0.002


@pytest.mark.parametrize("shape", ["box", "cylinder"])
def test_worn_and_tapered_solids_reach_as_far_as_their_points(shape):
    size, radius, taper = np.array([[0.5, 0.4 if shape == "box" else 0.7, 0.7 if shape == "box" else 0.0]]), 0.1, 0.3
    half = size[0, 2] if shape == "box" else size[0, 1]
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(1, 1, 200, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    # Corners (or rims) of the solid that a ball of this radius rolls around, and the ball.
    turn = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn)], -1)
    square = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    ends = []
    for sign in (1, -1):
        across = square * (size[0, :2] - radius) if shape == "box" else ring * (size[0, 0] - radius)
        ends.append(np.c_[across, np.full(len(across), sign * (half - radius))])
    worn_points = np.concatenate(ends)
    zero = np.zeros((1, 1, 1))

    def reach(points):
        return (normal[0, 0] @ points.T).max(-1)

    sharp = np.concatenate(
        [
            np.c_[
                square * size[0, :2] if shape == "box" else ring * size[0, 0], np.full(4 if shape == "box" else 720, z)
            ]
            for z in (half, -half)
        ]
    )
    told = worn(shape, size, normal, zero + radius, zero)[0, 0]
    np.testing.assert_allclose(reach(sharp) + told, reach(worn_points) + radius, atol=1e-4)
    narrow = sharp * np.where(sharp[:, 2:] > 0, [1 - taper, 1 - taper, 1], [1 + taper, 1 + taper, 1])
    told = worn(shape, size, normal, zero, zero + taper)[0, 0]
    np.testing.assert_allclose(reach(sharp) + told, reach(narrow), atol=1e-4)


def test_a_sphere_has_no_edges():
    normal = np.array([[[[0.0, 0.6, 0.8]]]])
    assert not worn(
        "sphere", np.array([[0.3, 0.0, 0.0]]), normal, np.full((1, 1, 1), 0.1), np.full((1, 1, 1), 0.2)
    ).any()
