"""As how many independent numbers the measurements of a clip count."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.fit import ClipFit
from mjx_refine.diagnosis.seen.measure import Parts


def counts_of(clip: ClipFit) -> Float[np.ndarray, "residuals"]:
    """As how many independent numbers each residual counts; zero where nothing was measured."""
    parts, fresh = clip.measured.parts, clip.measured.freshness[..., None]
    seen = Parts(*(np.isfinite(part).astype(float) for part in parts))
    seen = seen._replace(reach=seen.reach * fresh, moments=seen.moments * fresh)
    weighed = Parts(*(count * part for count, part in zip(clip.counts.of(parts), seen, strict=True)))
    weight = getattr(clip, "weight", 1.0)
    return weight * np.concatenate([part.ravel() for part in weighed])
