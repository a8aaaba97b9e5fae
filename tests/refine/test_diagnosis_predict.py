"""What a diagnosis predicts of masks and flow, against pictures of our own simulator that are drawn pixel by pixel."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from effect_scenes import effect

from mjx_refine.diagnosis.seen.measure import measure
from mjx_refine.diagnosis.seen.predict import Predictor
from mjx_refine.effects import batch_with_effects
from mjx_refine.scene import Body, Camera, Effect, Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.simulate import simulate

FRAMES, SIZE = 10, (480, 320)
SIZES = {"box": (0.3, 0.2, 0.15), "sphere": (0.25,), "cylinder": (0.2, 0.3)}


def errors(shape: str, *effects: Effect) -> tuple[np.ndarray, np.ndarray]:
    """Of centroids and equivalent radii [px], and of flow [px/frame]."""
    turning = (0.0, 0.9239, 0.3827, 0.0)
    body = Body(shape, "body", SIZES[shape], (-0.95, 0.4, 0.8), turning, (2.2, 0.6, 1.8), (1.0, 2.0, 1.5))
    scene = Scene((body,), Camera((0.0, -2.0, 2.5), 50.0), effects=effects)
    seen = simulate(scene, SIZE, FRAMES)
    # What is drawn is the surfaces' own flow.
    measured, batch = dataclasses.replace(measure(seen, (0,)), drawn=False), batch_with_effects([scene])
    told = Predictor.of(measured, (shape,), SIZE, seen.fps)(
        MujocoSimulator((shape,), seen.fps, 1).rollout(batch, FRAMES), batch
    )
    return measured.moments[:, 0] - told.moments[0, :, 0], measured.flow[:, 0] - told.flow[0, :, 0]


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize(
    "one",
    [
        None,
        effect("lens_distortion", k1=0.12),
        effect("lens_distortion", k1=-0.1),
        effect("rolling_shutter", readout=0.025),
        effect("camera_roll", angle=4.0),
        effect("shape", "body", rounding=0.05),
        effect("shape", "body", taper=0.15),
        effect("occluder", left=200.0, top=0.0, right=240.0, bottom=320.0),
    ],
)
def test_moments_and_flow_are_those_of_the_picture(shape, one):
    if shape == "sphere" and one is not None and one.effect == "shape":
        pytest.skip("a ball has no edges")
    moments, flow = errors(shape, *(() if one is None else (one,)))
    assert np.isfinite(moments).all(1).sum() >= FRAMES - 3
    typical = np.nanmedian(np.abs(moments), 0)
    # Points of an outline are late as if they went as its middle does.
    turns = one is not None and one.effect == "rolling_shutter"
    assert (typical < (0.1 if turns else 0.06)).all(), typical
    # Where something hides all but a sliver, little is known.
    assert np.nanquantile(np.abs(moments), 0.9) < 0.2
    if one is None or one.effect != "occluder":
        assert np.sqrt(np.nanmean(flow**2)) < 0.08


def test_a_lens_and_a_shutter_together():
    moments, flow = errors("box", effect("lens_distortion", k1=0.1), effect("rolling_shutter", readout=0.02))
    assert np.nanquantile(np.abs(moments), 0.9) < 0.2
    assert np.sqrt(np.nanmean(flow**2)) < 0.08


def test_without_effects_one_row_of_points_serves_all():
    moments, flow = errors("sphere")
    more = errors("sphere", effect("lens_distortion", k1=0.0))
    np.testing.assert_allclose(moments, more[0], atol=1e-3)
    np.testing.assert_allclose(flow, more[1], atol=1e-3)


@pytest.mark.parametrize("one", [None, effect("lens_distortion", k1=0.12), effect("camera_roll", angle=4.0)])
def test_of_what_hides_and_of_what_is_hidden_moments_are_those_of_the_picture(one):
    turning, velocity = (0.0, 0.9239, 0.3827, 0.0), (0.3, 0.1, 1.8)
    near = Body("sphere", "near", (0.2,), (-0.25, 0.1, 1.1), turning, velocity, (0.0, 0.0, 0.0))
    far = Body("box", "far", (0.3, 0.25, 0.2), (0.0, 0.8, 0.6), turning, (0.1, 0.1, 1.8), (1.0, 2.0, 1.5))
    scene = Scene((near, far), Camera((0.0, -2.0, 2.5), 50.0), effects=() if one is None else (one,))
    seen = simulate(scene, SIZE, FRAMES)
    measured, batch = measure(seen, (0, 1)), batch_with_effects([scene])
    poses = MujocoSimulator(scene.shapes, seen.fps, 1).rollout(batch, FRAMES)
    told = Predictor.of(measured, scene.shapes, SIZE, seen.fps)(poses, batch)
    assert measured.planes is not None
    assert np.isfinite(measured.planes[:, 1]).all(-1).sum() >= FRAMES - 2
    assert np.isnan(measured.planes[:, 0]).all()
    off = np.abs(measured.moments - told.moments[0])
    assert np.isfinite(off[:, 0]).all()
    assert (np.nanmedian(off, 0) < 0.06).all(), np.nanmedian(off, 0)
    # What is told of the whole is something else.
    assert np.nanmedian(np.abs(measured.moments - told.whole[0])[:, 1, :2].max(-1)) > 1.0
