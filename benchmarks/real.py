"""Real clips without a language model: observe, guess, refine; prints IoU and writes the reports to look at.

    python -m benchmarks.real VIDEOS [--out real] [--only greenball,...] [--iterations 100]

VIDEOS is a folder with the recordings (PhysTrack samples at 240 frames a second and a bouncing ball at 30).
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from benchmarks.quality import machine
from mjx_refine import Options, refine, save_observation, save_scenes
from mjx_refine.guess import guess_scenes
from mjx_refine.observe import observe_clip
from mjx_refine.report import write_result
from mjx_refine.scene import Samples

CLIPS = {
    "carom_big_collision": {"fps": 240, "start": 0.125, "end": 0.575, "stride": 4},
    "carom_rotation": {"fps": 240, "start": 0.125, "end": 0.625, "stride": 4},
    "greenball_small_960x540": {"start": 0.434, "end": 2.169, "stride": 1, "size": "480x270"},
    "greenball_small_960x540, first second": {"start": 0.434, "end": 1.434, "stride": 1, "size": "480x270"},
    "rolling_cylinder": {"fps": 240, "start": 0.3584, "end": 1.325, "stride": 8},
    "projectile_45deg_2.687mps": {"fps": 240, "start": 0.121, "end": 0.55, "stride": 3},
    "sliding_R1": {"fps": 240, "start": 0.3334, "end": 1.375, "stride": 8},
}
"""What of each file is used (its name is what stands before a comma); start and end are seconds of the file's time."""


def run(name: str, video: Path, selection: dict, out: Path, options: Options) -> str:
    """One clip from file to report; returns a row of the table."""
    began = time.monotonic()
    observation = observe_clip(video, **selection).observation
    out.mkdir(parents=True, exist_ok=True)
    save_observation(out / "flows.npz", observation)
    scenes = guess_scenes(observation, 32, options.seed)
    save_scenes(out / "best32.yaml", scenes)
    samples = Samples(f"{video.stem}: guess", tuple(scenes), tuple(range(len(scenes))))
    result = refine(samples, observation, options)
    write_result(out, result, observation)
    before, after = result.init.scores, result.refined.scores
    return (
        f"| {name} | {observation.length} | {before.iou[0]:.3f} | {after.iou[0]:.3f} | "
        f"{after.first_frame_iou[0]:.3f} | {after.epe[0]:.3f} | {' '.join(result.scene.shapes)} | "
        f"{time.monotonic() - began:.0f} |"
    )


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("videos", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/real"))
    parser.add_argument("--only", default="")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    options = Options(seed=arguments.seed, iterations=arguments.iterations)
    print(f"{machine()}; budget {options.budget}\n")
    print("| clip | frames | guess IoU | refined IoU | first frame | EPE px | shapes | seconds |")
    print("| --- " * 8 + "|", flush=True)
    for name, selection in CLIPS.items():
        if any(word in name for word in arguments.only.split(",")):
            video = arguments.videos / f"{name.split(',')[0]}.mp4"
            print(
                run(name, video, selection, arguments.out / name.replace(", ", "-").replace(" ", "-"), options),
                flush=True,
            )


if __name__ == "__main__":
    main()
