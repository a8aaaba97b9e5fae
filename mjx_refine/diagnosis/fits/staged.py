"""Least squares over ever more of a clip: what happens after a contact is fitted once what happens before it is.

From a given scene bodies meet at the wrong moment and place, and where they go afterwards says nothing of how to mend that.
(The same is done to land a refined scene, `search/landing.py`; cf. multiple shooting, Bock and Plitt 1984.)
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis

STAGES, ITERATIONS, LAST = 7, 3, 8
"""Parts of the clip, each longer than the one before, before it is fitted as a whole; iterations of each, and of the whole."""


def staged(clip: ClipFit, hypothesis: Hypothesis, z: Float[np.ndarray, "dimension"]) -> Fit:
    """The fit of ``hypothesis`` that begins at ``z`` with the first frames alone."""
    frames = np.arange(clip.frames)
    for stage in range(1, STAGES + 1):
        keep = frames < 1 + np.ceil((clip.frames - 1) * stage / (STAGES + 1))
        z = clip.fit(hypothesis, z, ITERATIONS, keep, thorough=False, passing=True).z
    return clip.fit(hypothesis, z, LAST, thorough=False)
