"""Draws ``examples/refined.png``: outlines over the example clip, the best sample above, the refined scene below.

python examples/make_picture.py out/example     # a folder that `refine` wrote from examples/clip
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from mjx_refine import Options, load_observation, load_scene, load_scenes
from mjx_refine.report.contours import Overlay
from mjx_refine.scene import Samples
from mjx_refine.search.problem import Problem
from mjx_refine.search.refine import replay

HERE = Path(__file__).parent
FRAMES = (0, 9, 19, 29)
SIZE = (360, 240)


def main() -> None:
    """Writes the picture."""
    observation = load_observation(HERE / "clip" / "flows.npz")
    samples = load_scenes(HERE / "clip" / "best32.yaml")
    refined = load_scene(Path(sys.argv[1]) / "refined.yaml")
    rows = []
    for scenes in (samples, Samples("refined", (refined,), (0,))):
        problem = Problem(scenes, observation, Options())
        start = problem.starts[0]
        shown = replay(start.given, observation, problem, start.matching)
        overlay = Overlay(observation, shown, start.matching, SIZE)
        rows.append(np.concatenate([overlay(t) for t in FRAMES], axis=1))
    Image.fromarray(np.concatenate(rows, axis=0)).save(HERE / "refined.png", optimize=True)


if __name__ == "__main__":
    main()
