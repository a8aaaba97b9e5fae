"""What a fit shows to those who look for a start of an effect."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.slack import spins, touching
from mjx_refine.diagnosis.seen.cuts import cut_places
from mjx_refine.effects.kind import FitView
from mjx_refine.observation import Observation
from mjx_refine.view.picture import draw
from mjx_refine.view.tiles import foreground


def view_of(
    clip: ClipFit, fit: Fit, observation: Observation, masks_of: tuple[int, ...], hidden: bool = True
) -> FitView:
    """The fitted rollout, for those who look for a start; ``hidden``: with what should be seen and is not, which is drawn."""
    batch = fit.hypothesis.batch(fit.z[None])
    poses = np.nan_to_num(clip.poses(fit.hypothesis, fit.z[None])[0])
    fps = clip.simulator.fps
    velocity = np.gradient(poses[..., :3], axis=0) * fps if len(poses) > 1 else np.zeros_like(poses[..., :3])
    spin = spins(poses, fps)
    spin = np.concatenate([spin, spin[-1:]]) if len(spin) else np.zeros_like(velocity)
    on_floor = touching(batch, poses)
    plain = dataclasses.replace(batch, effects=())
    places = hidden_places(poses, plain, observation, masks_of) if hidden else ()
    if hidden and observation.masks is not None:
        places = (*cut_places(foreground(observation)), *places)
    return FitView(plain, poses, velocity, spin, on_floor, clip.measured.background, places, clip.image, fps)


def hidden_places(
    poses: Float[np.ndarray, "frames objects 7"], batch, observation: Observation, masks_of: tuple[int, ...]
) -> tuple[tuple[float, float, float, float], ...]:
    """Rectangles where objects should be seen by the base model and never are, the largest first."""
    if observation.masks is None:
        return ()
    drawn, _ = draw(poses, batch, observation.size)
    seen = foreground(observation) > 0
    known = np.isin(drawn, [n + 1 for n, i in enumerate(masks_of) if i >= 0])
    # An outline that is a pixel or two off is no occluder: what is missing must lie well inside of where an object is.
    missing = np.array([ndimage.binary_erosion(d, iterations=2) & ~s for d, s in zip(known, seen, strict=True)])
    place = missing.any(0) & ~seen.any(0)
    place = ndimage.binary_opening(place, iterations=1)
    labels = np.zeros(place.shape, np.int32)
    count = int(np.asarray(ndimage.label(ndimage.binary_dilation(place, iterations=2), output=labels)))
    boxes = []
    for k in range(count):
        rows, columns = np.nonzero((labels == k + 1) & place)
        if len(rows) < 30:
            continue
        left, right = np.quantile(columns, [0.02, 0.98])
        top, bottom = np.quantile(rows, [0.02, 0.98])
        boxes.append((len(rows), (float(left) - 2, float(top) - 2, float(right) + 3, float(bottom) + 3)))
    return tuple(box for _, box in sorted(boxes, reverse=True)[:3])
