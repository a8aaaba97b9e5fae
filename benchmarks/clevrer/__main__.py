"""`python -m benchmarks.clevrer`: one-second clips from CLEVRER's videos.

    python -m benchmarks.clevrer --videos video_validation --proposals derender_proposals \
        --annotations annotation_validation --out clips [--numbers 10000-10099]

Files are found in the folders and their subfolders by the number in their names. Then, for each clip:

    refine guess clips/10000_000/flows.npz --out clips/10000_000/best32.yaml
    refine --init clips/10000_000/best32.yaml --video clips/10000_000/flows.npz --out refined/10000_000
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import click

from benchmarks.commands import exit_status
from mjx_refine.errors import InputError

_PATH = click.Path(path_type=Path)


def numbered(root: Path, suffix: str, option: str) -> dict[int, Path]:
    """Files of a folder and its subfolders (or one file) by the last number in their names.

    Raises:
      InputError: there are none, or two have one number.
    """
    files = [root] if root.is_file() else sorted(root.rglob(f"*{suffix}")) if root.is_dir() else []
    found: dict[int, Path] = {}
    for file in files:
        digits = re.findall(r"\d+", file.stem)
        if not digits or len(digits[-1]) > 9:
            continue
        number = int(digits[-1])
        if number in found:
            raise InputError(f"{option} {root}: {found[number]} and {file} have one number; expected one file of each")
        found[number] = file
    if not found:
        raise InputError(f"{option} {root}: no {suffix} with a number in its name; expected such as video_10000.mp4")
    return found


def wanted_numbers(text: str | None, known: set[int]) -> list[int]:
    """Numbers of a list such as ``10000-10099,10200`` that are there; all, where there is none.

    Raises:
      InputError: the text is no such list, or none of its numbers is there.
    """
    if text is None:
        return sorted(known)
    chosen: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,9})(?:\s*-\s*(\d{1,9}))?\s*", part)
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise InputError(f"--numbers {text}: expected such as 10000-10099,10200; correct it")
        low, high = int(match[1]), int(match[2] or match[1])
        chosen |= {n for n in known if low <= n <= high}
    if not chosen:
        raise InputError(f"--numbers {text}: no such video; there are {min(known)} to {max(known)}; choose of these")
    return sorted(chosen)


@click.command(help=__doc__)
@click.option("--videos", type=_PATH, required=True, help="Folder of video_NNNNN.mp4, or one of them.")
@click.option("--proposals", type=_PATH, required=True, help="Folder of proposal_NNNNN.json or sim_NNNNN.json.")
@click.option("--annotations", type=_PATH, help="Folder of annotation_NNNNN.json; the test videos have none.")
@click.option("--out", type=_PATH, required=True, help="Folder for the clips; those that are there are left alone.")
@click.option("--numbers", help="Which videos, such as 10000-10099,10200; by default all.")
@click.option("--seconds", type=click.FloatRange(0.05, 60), default=1.0, show_default=True, help="A clip's length.")
@click.option("--fps", type=click.FloatRange(0.1, 1000), help="Frames a second; by default the file's.")
@click.option(
    "--least-pixels", type=click.IntRange(0), default=8000, show_default=True, help="Of 30 frames of 480x320."
)
def main(videos, proposals, annotations, out, numbers, seconds, fps, least_pixels) -> None:
    """Cuts videos into clips."""
    from benchmarks.clevrer import cut_video, load_annotation, load_proposals
    from mjx_refine.files import writable_directory

    writable_directory(out)
    films, masks = numbered(videos, ".mp4", "--videos"), numbered(proposals, ".json", "--proposals")
    told = None if annotations is None else numbered(annotations, ".json", "--annotations")
    chosen = wanted_numbers(numbers, set(films))
    for number in chosen:
        for option, there in (("--proposals", masks), ("--annotations", told)):
            if there is not None and number not in there:
                raise InputError(f"{option}: none for {films[number]}; expected a .json with {number:05d}; add it")
    clips = 0
    for number in chosen:
        annotation = None if told is None else load_annotation(told[number])
        cuts = cut_video(
            films[number],
            load_proposals(masks[number]),
            annotation,
            out,
            number=number,
            seconds=seconds,
            fps=fps,
            least_pixels=least_pixels,
        )
        for cut in cuts:
            shapes = ", ".join(shape for *_, shape in cut.kept) or "nothing"
            what = f"left out: {cut.fault}" if cut.fault else f"{shapes}; {len(cut.static)} static"
            click.echo(f"{cut.name}: {what}")
        clips += sum(cut.fault is None for cut in cuts)
    click.echo(f"{clips} clips of {len(chosen)} videos in {out}")


def run(arguments: list[str] | None = None) -> int:
    """The command; its exit status: 0 done, 2 wrong input, with one line on standard error."""
    return exit_status(main, "clevrer", arguments)


if __name__ == "__main__":
    sys.exit(run())
