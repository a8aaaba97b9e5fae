"""Diagnosis of recorded poses: cube tosses (ContactNets) and ball drops (de Silva et al.); prints the README's tables.

    python -m benchmarks.real_poses tosses FOLDER [--count 10] [--out runs/tosses]
    python -m benchmarks.real_poses drops FOLDER [--count 11] [--out runs/drops]
    python -m benchmarks.real_poses tosses|drops FOLDER --together     # of one set-up: half are fitted, half judged

FOLDER holds ``toss_NNN.npz`` (Pfrommer, Halm, Posa, CoRL 2020, arXiv:2009.11193; BSD-3-Clause) or ``ball_drops.csv`` and
``balls.txt`` (de Silva et al., Front. Artif. Intell. 3:25, 2020; MIT). Nothing of them is kept here.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import math
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.quality import machine
from mjx_refine.diagnosis import Diagnosis, Poses, diagnose_poses, make_poses
from mjx_refine.report.diagnosis_files import write_diagnosis
from mjx_refine.scene import Body, Camera, Scene

CAMERA = Camera((0.0, -3.0, 1.5), 65.0)
"""A scene has one; poses do not see it."""

EDGE, CUBE_MASS = 0.1048, 0.37
"""Published cube [m], [kg]."""

SIGMA_POS, SIGMA_ROT = 1e-3, 0.01
"""Noise stated for the tosses [m], [rad]. Their third differences say 0.02 mm, because the published poses are smoothed; but
at rest the cube's centre lies 1.4 mm below half of the published edge."""

RHO, DRAG_COEFFICIENT = 1.2, 0.5
"""Air [kg/m^3], and a smooth sphere's coefficient, for what drag should be."""

OUNCE = 0.028349523  # kg
RELEASED, ABOVE = 1.0, 1.0
"""What of a drop is used: from so far below the first height on, since the first frames show the release, and to so far
above the last height [m]."""

KEYS = {
    "Baseball": "baseball",
    "Blue Basketball": "bluebasketball",
    "Green Basketball": "greenbasketball",
    "Volleyball": "volleyball",
    "Bowling Ball": "bowlingball",
    "Golf Ball": "golfball",
    "Tennis Ball": "tennisball",
    "Whiffle Ball 1": "wiffleball1",
    "Whiffle Ball 2": "wiffleball2",
    "Yellow Whiffle Ball": "yellowWiffle",
    "Orange Whiffle Ball": "orangeWiffle",
}
"""Names in the heights' file and in the balls' file."""

GUESSED = {"volleyball": (9.5, 66.0)}
"""Weight [oz] and circumference [cm] that the file does not give: a regulation volleyball's."""


# --- cube tosses ------------------------------------------------------------------------------------------------------


def toss(path: Path) -> Poses:
    """One recorded toss."""
    with np.load(path, allow_pickle=False) as file:
        return make_poses(
            file["time"], file["pos"], file["quat"], source=path.name, sigma_pos=SIGMA_POS, sigma_rot=SIGMA_ROT
        )


def cube() -> Scene:
    """The published cube; friction and contact are first guesses, which the base model's fit moves."""
    half = EDGE / 2
    body = Body(
        "box", "cube", (half, half, half), (0.0, 0.0, 0.2), mass=CUBE_MASS, friction=(0.2, 0.005), damping=-60.0
    )
    return Scene((body,), CAMERA, (0.0, 0.0, -9.81))


def tosses(folder: Path, count: int | None, out: Path, seed: int) -> None:
    """Prints a row a toss."""
    print(
        "| toss | verdict | first candidate | lead | gap before | after | closed | mm before | after | ° before | after "
        "| plain fit, mm | ° | s |"
    )
    print("| --- " * 14 + "|", flush=True)
    found = []
    for path in sorted(folder.glob("toss_*.npz"))[:count]:
        told = diagnose_poses(cube(), toss(path), seed=seed)
        write_diagnosis(out / path.stem, told, None, {"poses": path.name, "seed": seed})
        found.append(told)
        plain = told.pose_errors.plain if told.pose_errors else (math.nan, math.nan)
        left = f"{1e3 * plain[0]:.1f} | {math.degrees(plain[1]):.2f}"
        print(f"| {path.stem[5:]} | {_common(told)} | {left} | {told.seconds:.0f} |", flush=True)
    gaps = np.array([[d.gap.before, d.gap.after, d.gap.closed] for d in found])
    middle = np.median(gaps, 0)
    print(f"\nmedians: gap {middle[0]:.2f} -> {middle[1]:.2f} noise widths, closed {middle[2]:.2f}")


def _common(told: Diagnosis) -> str:
    gap, first = told.gap, told.candidates[0] if told.candidates else None
    named = " + ".join(told.verdict.effects) or "none"
    best = "– | –" if first is None else f"{first.effect} | {first.evidence:.0f}"
    return (
        f"{named} {told.verdict.probability:.2f} | {best} | {gap.before:.2f} | {gap.after:.2f} | {gap.closed:.2f} | "
        f"{1e3 * gap.position_before:.1f} | {1e3 * gap.position_after:.1f} | {math.degrees(gap.rotation_before):.2f} | "
        f"{math.degrees(gap.rotation_after):.2f}"
    )


def tosses_together(folder: Path, count: int | None, out: Path, seed: int, stiffness: float) -> None:
    """Prints candidates and a row a toss of one diagnosis of all."""
    recordings = [toss(path) for path in sorted(folder.glob("toss_*.npz"))[:count]]
    scene = cube()
    damping = scene.objects[0].damping * math.sqrt(stiffness / scene.objects[0].stiffness)
    hard = dataclasses.replace(scene.objects[0], stiffness=stiffness, damping=damping)
    told = diagnose_poses(dataclasses.replace(scene, objects=(hard,)), recordings, seed=seed, told=shown)
    write_diagnosis(out / "tosses", told, None, {"poses": [one.source for one in recordings], "seed": seed})
    summary(told)
    scene = told.base.objects[0]
    print(f"\nbase model: half edges {scene.size} m, friction {scene.friction}, damping {scene.damping} 1/s\n")
    print("| toss | role | error before | after | floor | gain | mm before | after | ° before | after |")
    print("| --- " * 10 + "|")
    for one in told.clips:
        print(
            f"| {one.source[5:8]} | {'fitted' if one.fitted else 'judged'} | {one.before:.2f} | {one.after:.2f} | "
            f"{one.noise_floor:.2f} | {one.gain:.1f} | {1e3 * one.position_before:.1f} | {1e3 * one.position_after:.1f} | "
            f"{math.degrees(one.rotation_before):.2f} | {math.degrees(one.rotation_after):.2f} |"
        )


def shown(line: str) -> None:
    """A step and the time at which it began."""
    print(f"{time.strftime('%H:%M:%S')} {line}", file=sys.stderr, flush=True)


def summary(told: Diagnosis) -> None:
    """The verdict, the gap and the candidates."""
    gap = told.gap
    print(f"verdict {' + '.join(told.verdict.effects) or 'none'} {told.verdict.probability:.2f}; {told.seconds:.0f} s, "
          f"{told.rollouts} rollouts\n"
          f"held out: {gap.before:.2f} -> {gap.after:.2f} noise widths (floor {gap.noise_floor:.2f}), closed {gap.closed:.2f} "
          f"({gap.closed_low:.2f} to {gap.closed_high:.2f}); {1e3 * gap.position_before:.1f} -> "
          f"{1e3 * gap.position_after:.1f} mm, {math.degrees(gap.rotation_before):.2f} -> "
          f"{math.degrees(gap.rotation_after):.2f} degrees\n")  # fmt: skip
    print("\n".join(f"- {note}" for note in (*told.notes, told.residual)))
    print("\n| candidate | evidence on the fitted | held-out error after | closed | parameters |")
    print("| --- " * 5 + "|")
    for one in told.candidates:
        values = ", ".join(
            f"{k} {v.value:.3g} ({v.low:.3g} to {v.high:.3g}) {v.unit}" for k, v in one.parameters.items()
        )
        print(f"| {one.effect} | {one.evidence:.0f} | {one.gap_after:.2f} | {one.closed:.2f} | {values} |")


# --- ball drops -------------------------------------------------------------------------------------------------------


def balls(folder: Path) -> dict[str, tuple[float, float]]:
    """Mass [kg] and radius [m] by the name in the balls' file."""
    result = {}
    for line in (folder / "balls.txt").read_text().splitlines()[1:]:
        name, weight, around = line.split()
        ounces, centimetres = GUESSED[name] if "?" in weight else (float(weight), float(around))
        result[name] = (ounces * OUNCE, centimetres / 100 / (2 * math.pi))
    return result


def heights(folder: Path) -> dict[tuple[str, str], np.ndarray]:
    """Time [s] and height [m] by ball and drop."""
    rows: dict[tuple[str, str], list[tuple[float, float]]] = {}
    with open(folder / "ball_drops.csv", newline="") as stream:
        for row in csv.DictReader(stream):
            rows.setdefault((row["ball"], row["drop"]), []).append((float(row["time_s"]), float(row["height_m"])))
    return {key: np.array(value) for key, value in rows.items()}


def falling(track: np.ndarray, name: str) -> Poses:
    """The falling part of a drop as poses: nothing but the height was measured."""
    time, height = track.T
    used = (height < height[0] - RELEASED) & (height > height[-1] + ABOVE)
    position = np.full((used.sum(), 3), np.nan)
    position[:, 2] = height[used]
    return make_poses(time[used], position, np.full((used.sum(), 4), np.nan), source=name)


def drops(folder: Path, count: int | None, out: Path, seed: int) -> None:
    """Prints a row a drop, each ball's first before its second."""
    sizes = balls(folder)
    print(
        "| ball, drop | kg | m | verdict | drag's lead | best other | its lead | gap before | with drag | closed by it | "
        "deceleration at 20 m/s, m/s² | reference | s |"
    )
    print("| --- " * 13 + "|", flush=True)
    pairs = []
    for (ball, drop), track in sorted(heights(folder).items(), key=lambda item: item[0][1])[:count]:
        mass, radius = sizes[KEYS[ball]]
        body = Body("sphere", "ball", (radius,), (0.0, 0.0, 40.0), mass=mass)
        told = diagnose_poses(Scene((body,), CAMERA, (0.0, 0.0, -9.81)), falling(track, f"{ball} {drop}"), seed=seed)
        write_diagnosis(out / f"{KEYS[ball]}-{drop}", told, None, {"poses": f"{ball}, drop {drop}", "seed": seed})
        reference = 0.5 * RHO * DRAG_COEFFICIENT * math.pi * radius**2 * 400 / mass
        fitted, row = _of_drag(told, mass)
        if math.isfinite(fitted):
            pairs.append((reference, fitted))
        print(
            f"| {ball}, {drop} | {mass:.3f} | {radius:.3f} | {' + '.join(told.verdict.effects) or 'none'} "
            f"{told.verdict.probability:.2f} | {row} | {reference:.2f} | {told.seconds:.0f} |",
            flush=True,
        )
    order = np.argsort(np.argsort(np.array(pairs), 0), 0).T
    print(
        f"\nrank correlation of fitted and reference deceleration: {np.corrcoef(*order)[0, 1]:.2f} ({len(pairs)} drops)"
    )


def drops_together(folder: Path, count: int | None, out: Path, seed: int) -> None:
    """Prints a row a ball: one drop is fitted, the other foretold from its first part on."""
    sizes = balls(folder)
    print(
        "| ball | verdict | drag's lead | best other | its lead | error foretold of the other drop | with drag | closed by it | "
        "deceleration at 20 m/s, m/s² | reference | m before | after | s |"
    )
    print("| --- " * 13 + "|", flush=True)
    tracks = heights(folder)
    for ball in sorted({ball for ball, _ in tracks})[:count]:
        mass, radius = sizes[KEYS[ball]]
        body = Body("sphere", "ball", (radius,), (0.0, 0.0, 40.0), mass=mass)
        several = [falling(track, f"{ball} {drop}") for (name, drop), track in sorted(tracks.items()) if name == ball]
        told = diagnose_poses(Scene((body,), CAMERA, (0.0, 0.0, -9.81)), several, seed=seed)
        write_diagnosis(out / KEYS[ball], told, None, {"poses": [one.source for one in several], "seed": seed})
        reference = 0.5 * RHO * DRAG_COEFFICIENT * math.pi * radius**2 * 400 / mass
        print(
            f"| {ball} | {' + '.join(told.verdict.effects) or 'none'} {told.verdict.probability:.2f} | "
            f"{_of_drag(told, mass)[1]} | {reference:.2f} | {told.gap.position_before:.2f} | {told.gap.position_after:.2f} | "
            f"{told.seconds:.0f} |",
            flush=True,
        )


def _of_drag(told: Diagnosis, mass: float, speed: float = 20.0) -> tuple[float, str]:
    """What drag, if it was fitted at all, does at ``speed`` [m/s^2], and cells of the table."""
    drag = next((c for c in told.candidates if c.effect == "drag"), None)
    others = sorted((c for c in told.candidates if c.effect != "drag"), key=lambda c: -c.evidence)
    rival = f"{others[0].effect} | {others[0].evidence:.0f}" if others else "– | –"
    if drag is None:
        return math.nan, f"– | {rival} | {told.gap.before:.2f} | – | – | –"
    k = drag.parameters
    value = (k["linear"].value * speed + k["quadratic"].value * speed**2) / mass
    return value, (
        f"{drag.evidence:.0f} | {rival} | {told.gap.before:.2f} | {drag.gap_after:.2f} | {drag.closed:.2f} | {value:.2f}"
    )


def main() -> None:
    """Runs one of the two."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("tosses", "drops"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, help="so many recordings; all by default")
    parser.add_argument("--out", type=Path, default=Path("runs/real_poses"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--together", action="store_true", help="all tosses, or all drops of a ball, in one diagnosis")
    parser.add_argument("--stiffness", type=float, default=5000.0, help="of contacts, 1/s^2, with --together tosses")
    arguments = parser.parse_args()
    print(f"{machine()}\n")
    call = (arguments.folder, arguments.count, arguments.out, arguments.seed)
    if arguments.together and arguments.what == "tosses":
        tosses_together(*call, arguments.stiffness)
    elif arguments.together:
        drops_together(*call)
    else:
        (tosses if arguments.what == "tosses" else drops)(*call)


if __name__ == "__main__":
    main()
