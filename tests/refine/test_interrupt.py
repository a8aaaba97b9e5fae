"""Killed and resumed, or run twice: the same result; nothing half-written, nothing left over."""

import json
import os
import zipfile

import numpy as np
import pytest

from benchmarks.bad_cases import scene_text
from benchmarks.interrupt import Call, check_file, check_folder, interrupt
from mjx_refine.cli.main import run
from mjx_refine.errors import InputError
from mjx_refine.files import remove_stale_parts, writable_file, write_atomic, write_text

BROKEN = (ValueError, OSError, EOFError, zipfile.BadZipFile)
TINY = ["--population", "8", "--iterations", "6", "--seed", "3", "--refits", "2"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A tiny clip and a sample a little off."""
    folder = tmp_path_factory.mktemp("tiny")
    (folder / "truth.yaml").write_text(scene_text())
    moved = {"0.state.position": [0.03, 0.52, 0.2], "1.state.position": [0.75, 0.5, 0.2]}
    (folder / "init.yaml").write_text(
        scene_text(moved) + "---\n" + scene_text({**moved, "0.state.linear_velocity": [0.7, 0, 0]})
    )
    clip = [
        "simulate",
        str(folder / "truth.yaml"),
        "--out",
        str(folder / "clip.npz"),
        "--size",
        "96x64",
        "--frames",
        "8",
    ]
    assert run(clip) == 0
    return folder


def refined(folder, out, *arguments):
    status = run(
        ["--init", f"{folder}/init.yaml", "--video", f"{folder}/clip.npz", "--out", str(out), *TINY, *arguments]
    )
    assert status == 0
    check_folder(out)
    return (out / "refined.yaml").read_bytes()


def test_the_same_seed_gives_the_same_bytes(folder, tmp_path):
    first = refined(folder, tmp_path / "a")
    assert refined(folder, tmp_path / "b") == first
    a, b = (json.loads((tmp_path / name / "result.json").read_text()) for name in "ab")
    assert {**a, "seconds": 0} == {**b, "seconds": 0}


def test_resuming_a_finished_run_changes_nothing_and_cleans_up(folder, tmp_path):
    first = refined(folder, tmp_path / "out")
    stale = tmp_path / "out" / ".refined.yaml.0123abcd.part"
    stale.write_text("- type: b")
    mine = tmp_path / "out" / ".mine.part"
    mine.write_text("mine")
    assert (
        run(
            [
                "--init",
                f"{folder}/init.yaml",
                "--video",
                f"{folder}/clip.npz",
                "--out",
                str(tmp_path / "out"),
                *TINY,
                "--resume",
            ]
        )
        == 0
    )
    assert (tmp_path / "out" / "refined.yaml").read_bytes() == first
    assert not stale.exists()
    assert mine.read_text() == "mine"


@pytest.mark.slow
def test_killed_and_resumed_gives_the_same(folder, tmp_path):
    call = Call(folder / "init.yaml", folder / "clip.npz", 8, 6)
    report = interrupt(call, tmp_path, kills=2, seed=1)
    assert report.kills == 2


def test_what_a_link_leads_to_is_replaced_and_what_is_no_file_is_not(tmp_path):
    target = write_text(tmp_path / "target.txt", "old")
    (tmp_path / "link").symlink_to(target)
    write_text(tmp_path / "link", "new")
    assert target.read_text() == "new"
    assert (tmp_path / "link").is_symlink()
    os.mkfifo(tmp_path / "pipe")
    for write in (lambda path: write_text(path, "new"), writable_file):
        with pytest.raises(InputError, match=r"pipe: is no plain file; expected .*; choose another name"):
            write(tmp_path / "pipe")
    assert (tmp_path / "pipe").is_fifo()


def test_a_write_that_fails_leaves_the_old_file_alone(tmp_path):
    path = write_text(tmp_path / "a.txt", "old")

    def fail(stream):
        stream.write(b"half")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_atomic(path, fail)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_stale_parts_are_removed_and_nothing_else(tmp_path):
    names = [
        ".a.npz.00ff00ff.part",
        ".a.part",
        "a.00ff00ff.part",
        ".a.npz.00FF00FF.part",
        ".a.00ff00ff.part.txt",
        "a.npz",
    ]
    for name in names:
        (tmp_path / name).write_text("x")
    (tmp_path / ".d.00ff00ff.part").mkdir()
    remove_stale_parts(tmp_path)
    assert sorted(os.listdir(tmp_path)) == sorted([*names[1:], ".d.00ff00ff.part"])
    remove_stale_parts(tmp_path / "none")


def test_writing_leaves_names_that_the_cleaning_knows(tmp_path):
    seen = []
    write_atomic(tmp_path / "a.npz", lambda stream: seen.extend(os.listdir(tmp_path)))
    assert len(seen) == 1
    (tmp_path / seen[0]).write_text("a killed process's")
    remove_stale_parts(tmp_path)
    assert os.listdir(tmp_path) == ["a.npz"]


def test_a_place_that_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        write_text(tmp_path / "none" / "a.txt", "text")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.npz", b"PK"),
        ("a.json", b'{"a": '),
        ("a.yaml", b"- type: box\n"),
        ("a.csv", b"a,b\n1"),
        ("a.html", b"<html>"),
        ("a.gif", b"GIF89a"),
        ("a.tmp", b""),
    ],
)
def test_the_check_finds_half_written_files(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BROKEN):
        check_file(tmp_path / name)


def test_the_check_finds_a_truncated_checkpoint(tmp_path):
    np.savez(tmp_path / "checkpoint.npz", a=np.arange(1000))
    check_file(tmp_path / "checkpoint.npz")
    os.truncate(tmp_path / "checkpoint.npz", 4000)
    with pytest.raises(BROKEN):
        check_file(tmp_path / "checkpoint.npz")
