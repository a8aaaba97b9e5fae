"""Tiny clips of our own simulator, with samples a little off, for tests that refine many."""

from __future__ import annotations

from pathlib import Path

from benchmarks.bad_cases import scene_text
from mjx_refine.many import Job
from mjx_refine.observation import save_observation
from mjx_refine.scene import load_scenes
from mjx_refine.search import Options
from mjx_refine.simulate import simulate

TINY = Options(population=8, iterations=5, seed=3, refits=1)
TINY_CALL = ["--population", "8", "--iterations", "5", "--seed", "3", "--refits", "1"]


def tiny_clip(folder: Path, shift: float = 0.0) -> Path:
    """A folder with ``flows.npz`` and ``best32.yaml``: a box and a sphere, 8 frames of 96x64."""
    folder.mkdir(parents=True)
    (folder / "truth.yaml").write_text(scene_text({"0.state.linear_velocity": [1 + shift, 0, 0]}))
    truth = load_scenes(folder / "truth.yaml")[0]
    save_observation(folder / "flows.npz", simulate(truth, size=(96, 64), frames=8, fps=30.0))
    off = {"0.state.position": [0.03, 0.52, 0.2], "1.state.position": [0.75, 0.5, 0.2]}
    slow = {**off, "0.state.linear_velocity": [0.7, 0, 0]}
    (folder / "best32.yaml").write_text(scene_text(off) + "---\n" + scene_text(slow))
    return folder


def job_of(folder: Path, **overrides) -> Job:
    """The job of a clip's folder."""
    return Job(folder / "best32.yaml", folder / "flows.npz", overrides=overrides)
