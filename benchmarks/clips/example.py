"""`python -m benchmarks.clips.example`: the small clip of a box and a cylinder that ships in `examples/clip/`."""

from __future__ import annotations

from pathlib import Path

import click
import cv2
import numpy as np

from benchmarks.clips import bounce
from benchmarks.clips.clip import Clip, make_clip
from benchmarks.clips.samples import SampleSet, rough_samples
from benchmarks.clips.scenes import Entry
from benchmarks.clips.writing import samples_text
from mjx_refine.files import write_atomic, write_text

SIZE = (240, 160)
SEED = 12
SHADE = 10


def scene() -> list[Entry]:
    """A box slides into a standing cylinder."""
    return [
        {
            "type": "box",
            "name": "box_0",
            "size": [0.30, 0.22, 0.18],
            "state": {
                "position": [-1.35, 0.7, 0.18],
                "orientation": [float(np.cos(0.15)), 0.0, 0.0, float(np.sin(0.15))],
                "linear_velocity": [4.0, 1.0, 0.0],
                "angular_velocity": [0.0, 0.0, 0.4],
            },
            "physics": {"friction": [0.2, 0.002], "mass": 1.4, "damping": bounce.damping(0.2)},
        },
        {
            "type": "cylinder",
            "name": "cylinder_1",
            "radius": 0.24,
            "height": 0.5,
            "state": {
                "position": [-0.15, 1.0, 0.25],
                "orientation": [1.0, 0.0, 0.0, 0.0],
                "linear_velocity": [0.0, 0.0, 0.0],
                "angular_velocity": [0.0, 0.0, 0.0],
            },
            "physics": {"friction": [0.2, 0.002], "mass": 0.7, "damping": bounce.damping(0.3)},
        },
        {"type": "camera", "fovy": 42.0, "orientation": 45.0, "position": [0.0, -2.0, 3.3]},
        {"type": "gravity", "gravity": [0.0, 0.0, -9.81]},
    ]


def make_example() -> tuple[Clip, SampleSet]:
    """The example's clip and samples."""
    clip = make_clip(SEED, "collision", 2, size=SIZE, scene=scene())
    return clip, rough_samples(clip.truth, clip.masks, SEED, stride=2)


@click.command()
@click.option("--out", type=click.Path(path_type=Path), default=Path("examples/clip"), show_default=True)
def main(out: Path) -> None:
    """Writes `flows.npz` and `best32.yaml`."""
    cv2.setNumThreads(1)
    clip, guesses = make_example()
    # A sixteenth of a pixel is finer than DIS measures, and compresses well.
    flow = (np.round(clip.flow.astype(np.float32) * 16) / 16).astype(np.float16)
    # The pictures are only to be looked at; fewer shades make the file half as large.
    frames = (clip.frames // SHADE * SHADE + SHADE // 2).clip(0, 255).astype(np.uint8)
    arrays = {"flow": flow, "masks": clip.masks, "fps": np.float64(clip.fps), "frames": frames}
    out.mkdir(parents=True, exist_ok=True)
    path = write_atomic(out / "flows.npz", lambda stream: np.savez_compressed(stream, **arrays))
    write_text(out / "best32.yaml", samples_text(guesses.scenes, tagged=True))
    click.echo(
        f"{path}: {path.stat().st_size / 1e6:.2f} MB; "
        f"samples' IoU {guesses.iou.mean():.3f} mean, {guesses.iou.max():.3f} best"
    )


if __name__ == "__main__":
    main()
