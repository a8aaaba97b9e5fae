"""Wrong calls of the command line, and right calls on wrong places."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from benchmarks.bad_cases import GONE, Case, scene_text


def _refine(*arguments: str) -> list[str]:
    return ["--init", "good.yaml", "--video", "good.npz", "--out", "out", *arguments]


def _call(name: str, arguments: list[str], *says: str, before: Callable[[Path], object] | None = None) -> Case:
    def make(folder: Path) -> list[str]:
        if before is not None:
            before(folder)
        return arguments

    return Case(f"call: {name}", make, says)


def _loop(folder: Path) -> None:
    (folder / "loop").symlink_to("loop")


def _file(folder: Path) -> None:
    (folder / "taken").write_text("mine")


def _in_the_way(folder: Path) -> None:
    (folder / "out" / "result.json").mkdir(parents=True)


def _folder(folder: Path) -> None:
    (folder / "taken").mkdir()


def _checkpoint(content: bytes | dict) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        (folder / "out").mkdir()
        path = folder / "out" / "checkpoint.npz"
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            np.savez(path, __values__=np.frombuffer(json.dumps(content).encode(), np.uint8))

    return make


def _wild(folder: Path) -> None:
    wild = {
        "0.physics.stiffness": 1e7,
        "0.state.linear_velocity": [9e3, 0, -9e3],
        "0.state.angular_velocity": [9e3] * 3,
    }
    (folder / "wild.yaml").write_text(scene_text(wild))


def _effect(folder: Path) -> None:
    (folder / "effect.yaml").write_text(scene_text(extra=[{"type": "effect", "effect": "drag"}]))


def _several(folder: Path) -> None:
    (folder / "several.yaml").write_text("---\n".join([scene_text()] * 3))


def _other(folder: Path) -> None:
    (folder / "other.yaml").write_text(scene_text({"0": GONE}))


def _text(folder: Path) -> None:
    (folder / "clip.mp4").write_text("no video")


def clip(folder: Path) -> None:
    """A clip of eight frames of 64x48, a square that moves, as Motion JPEG."""
    writer = cv2.VideoWriter(str(folder / "clip.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30, (64, 48))
    for t in range(8):
        picture = np.full((48, 64, 3), 90, np.uint8)
        picture[20:32, 5 + 4 * t : 17 + 4 * t] = 220
        writer.write(picture)
    writer.release()


def _pngs(count: int, value: int = 1) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        clip(folder)
        (folder / "pngs").mkdir()
        for t in range(count):
            cv2.imwrite(str(folder / "pngs" / f"{t:03}.png"), np.full((48, 64), value, np.uint8))

    return make


def _broken_png(folder: Path) -> None:
    _pngs(8)(folder)
    (folder / "pngs" / "003.png").write_bytes(b"no picture")


_OBSERVE = ["observe", "clip.avi", "--out", "new.npz"]
CALLS = [
    _call("nothing", [], "--init", "--help"),
    _call("no --video", ["--init", "good.yaml"], "--video", "--help"),
    _call("unknown command", ["refyne"], "refyne", "--help"),
    _call("unknown option", _refine("--colour"), "--colour", "--help"),
    _call("--init missing", ["--init", "none.yaml", "--video", "good.npz"], r"none\.yaml", "expected"),
    _call("--init a directory", ["--init", ".", "--video", "good.npz"], "directory", "expected"),
    _call("--init in a symlink loop", ["--init", "loop", "--video", "good.npz"], "loop", "expected", before=_loop),
    _call("--video missing", ["--init", "good.yaml", "--video", "none.npz"], r"none\.npz", "expected"),
    _call("--video in a symlink loop", ["--init", "good.yaml", "--video", "loop"], "loop", "expected", before=_loop),
    _call("--init and --video exchanged", ["--init", "good.npz", "--video", "good.yaml"], r"good\.npz", "UTF-8"),
    _call("--out a file", [*_refine()[:4], "--out", "taken"], "taken", "name another", before=_file),
    _call("--out under a file", [*_refine()[:4], "--out", "taken/a/b"], "taken", "name another", before=_file),
    _call("--out a symlink loop", [*_refine()[:4], "--out", "loop"], "loop", "name another", before=_loop),
    _call("--out of a long name", [*_refine()[:4], "--out", "n" * 300], "nnn", "long"),
    _call("--out with a folder in a result's way", _refine(), r"out/result\.json", "name another", before=_in_the_way),
    _call("--seed -1", _refine("--seed", "-1"), "--seed", "0<=x"),
    _call("--seed pi", _refine("--seed", "pi"), "--seed", "'pi'"),
    _call("--population 1", _refine("--population", "1"), "--population", "4<=x"),
    _call("--iterations 0", _refine("--iterations", "0"), "--iterations", "1<=x"),
    _call("--resolution 5x5", _refine("--resolution", "5x5"), "--resolution", "480x320"),
    _call("--resolution big", _refine("--resolution", "big"), "--resolution", "480x320"),
    _call("--optimizer adam", _refine("--optimizer", "adam"), "adam", "hybrid"),
    _call("--backend cuda", _refine("--backend", "cuda"), "cuda", "warp"),
    _call("--backend warp without a GPU", _refine("--backend", "warp"), "warp", "use|choose|install"),
    _call("--resume of another input",
        _refine("--resume"), r"checkpoint\.npz", "without --resume", before=_checkpoint({"version": 1, "digest": "x"})),
    _call("--resume of a later version",
        _refine("--resume"), r"checkpoint\.npz", "without --resume", before=_checkpoint({"version": 999})),
    _call("--resume of garbage",
        _refine("--resume"), r"checkpoint\.npz", "without --resume", before=_checkpoint(b"PK garbage")),
    _call("--resume of an empty file", _refine("--resume"), r"checkpoint\.npz", "without --resume", before=_checkpoint(b"")),
    _call("simulate a directory", ["simulate", ".", "--out", "new.npz"], "directory", "expected"),
    _call("simulate several samples",
        ["simulate", "several.yaml", "--out", "new.npz"], "3 samples", "keep one", before=_several),
    _call("simulate an effect",
        ["simulate", "effect.yaml", "--out", "new.npz"], r"effect\.yaml", "target is missing", before=_effect),
    _call("simulate what diverges",
        ["simulate", "wild.yaml", "--out", "new.npz"], r"wild\.yaml", "diverges", "lower", before=_wild),
    _call("simulate --frames 1", ["simulate", "good.yaml", "--out", "new.npz", "--frames", "1"], "--frames", "2<=x"),
    _call("simulate --fps nan", ["simulate", "good.yaml", "--out", "new.npz", "--fps", "nan"], "--fps", "number|range"),
    _call("simulate --fps 0", ["simulate", "good.yaml", "--out", "new.npz", "--fps", "0"], "--fps", "0.1<=x"),
    _call("simulate --size 0x0", ["simulate", "good.yaml", "--out", "new.npz", "--size", "0x0"], "--size", "480x320"),
    _call("simulate too much",
        ["simulate", "good.yaml", "--out", "n.npz", "--size", "8192x8192", "--frames", "99"], r"good\.yaml", "smaller"),
    _call("simulate --out a directory", ["simulate", "good.yaml", "--out", "taken"], "taken", "directory", before=_folder),
    _call("simulate --out nowhere", ["simulate", "good.yaml", "--out", "none/a.npz"], "none", "make it"),
    _call("evaluate without --video", ["evaluate", "--scene", "good.yaml"], "--video", "--help"),
    _call("evaluate against another kind",
        ["evaluate", "--scene", "good.yaml", "--video", "good.npz", "--truth", "other.yaml"], r"other\.yaml", "like with like",
        before=_other),
    _call("evaluate an effect",
        ["evaluate", "--scene", "effect.yaml", "--video", "good.npz"], r"effect\.yaml", "target is missing", before=_effect),
    _call("guess from nothing", ["guess", "none.npz", "--out", "new.yaml"], r"none\.npz", "expected"),
    _call("guess 0 samples", ["guess", "good.npz", "--out", "new.yaml", "--samples", "0"], "--samples", "1<=x"),
    _call("export to nowhere", ["export", "good.yaml", "--out", "none/a.xml"], "none", "make it"),
    _call("export --fps inf", ["export", "good.yaml", "--out", "a.xml", "--fps", "inf"], "--fps", "range"),
    _call("observe a text", ["observe", "clip.mp4", "--out", "new.npz"], r"clip\.mp4", "convert", before=_text),
    _call("observe nothing", ["observe", "none.mp4", "--out", "new.npz"], r"none\.mp4", "name a video"),
    _call("observe a directory", ["observe", ".", "--out", "new.npz"], "directory", "name a video"),
    _call("observe --stride 0", [*_OBSERVE, "--stride", "0"], "--stride 0", "1 or more", before=clip),
    _call("observe --start after --end", [*_OBSERVE, "--start", "2", "--end", "1"], "--end 1", "after", before=clip),
    _call("observe --start past the end", [*_OBSERVE, "--start", "99"], r"clip\.avi", "widen", before=clip),
    _call("observe --fps nan", [*_OBSERVE, "--fps", "nan"], "--fps nan", "positive", before=clip),
    _call("observe --size 1x1", [*_OBSERVE, "--size", "1x1"], "--size", "480x320|320x240", before=clip),
    _call("observe --masks nowhere", [*_OBSERVE, "--masks", "none"], "none", "directory", before=clip),
    _call("observe --masks empty folder", [*_OBSERVE, "--masks", "pngs"], "pngs", "one PNG a frame", before=_pngs(0)),
    _call("observe --masks too few", [*_OBSERVE, "--masks", "pngs"], "5 PNGs", "expected 8", before=_pngs(5)),
    _call("observe --masks black", [*_OBSERVE, "--masks", "pngs"], "every mask is empty", before=_pngs(8, 0)),
    _call("observe --masks broken", [*_OBSERVE, "--masks", "pngs"], r"003\.png", "export it again", before=_broken_png),
    _call("observe --out a directory",
        ["observe", "clip.avi", "--out", "taken"], "taken", "file name", before=lambda f: (clip(f), _folder(f))),
]  # fmt: skip
