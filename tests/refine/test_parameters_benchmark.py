"""The benchmark of parameters: rows outlive a stopped run, and the table counts what they say."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.parameters import append, read, refine_all, table
from mjx_refine import Options


def _clip(name: str, noise: int, inside: list[int], determined: list[int]) -> list[dict]:
    base = {"clip": name, "noise": noise, "iou": 0.9, "epe": 0.1, "seconds": 3.0, "of": len(inside)}
    values = {"value": 1.1, "truth": 1.0, "before": 1.5, "low": 1.0, "high": 1.2, "standard_error": 0.1}
    names = [f"ball.velocity.{axis}" for axis in "xyz"]
    rows = zip(names, inside, determined, strict=False)
    return [{**base, **values, "name": n, "inside": i, "determined": d} for n, i, d in rows]


@pytest.fixture
def written(tmp_path: Path) -> Path:
    path = tmp_path / "parameters.csv"
    append(path, _clip("00_1_flight", 0, [1, 1, 0], [1, 1, 0]))
    append(path, _clip("01_2_slide", 1, [0, 1, 1], [1, 1, 1]))
    append(path, [{"clip": "02_1_roll", "noise": 0, "iou": 0.5, "epe": 1.0, "seconds": 1.0, "of": 0}])
    return path


def test_a_write_cut_off_counts_as_not_done(written: Path):
    whole = read([written])
    assert [row["clip"] for row in whole] == ["00_1_flight"] * 3 + ["01_2_slide"] * 3 + ["02_1_roll"]
    text = written.read_bytes()
    second = text.index(b"01_2_slide")
    for end in (second + 40, text.index(b"\n", second) + 1, text.index(b"02_1_roll") - 30):
        written.write_bytes(text[:end])
        assert {row["clip"] for row in read([written])} == {"00_1_flight"}


def test_clips_that_are_done_are_not_refined_again(written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    before = read([written])
    with open(written, "a") as stream:
        stream.write("03_1_roll,0,0.9")
    names = ["00_1_flight", "01_2_slide", "02_1_roll"]
    # There are no scenes: refining any of these would fail.
    assert refine_all(tmp_path / "none", tmp_path, names, 2, Options(threads=1)) == written
    assert "3 clips are done, 0 left" in capsys.readouterr().out
    after = read([written])
    assert [{k: v for k, v in row.items() if v == v} for row in after] == [
        {k: v for k, v in row.items() if v == v} for row in before
    ]
    assert "03_1_roll" not in written.read_text()


def test_the_table_counts_by_kind_and_noise(written: Path):
    lines = table(read([written])).splitlines()
    cells = {
        tuple(part.strip() for part in line.split("|")[1:3]): line.split("|")[3:-1] for line in lines if "|" in line
    }
    velocity = [cell.strip() for cell in cells["velocity", "noisy"]]
    assert velocity == ["3", "3", "0.5", "0.1", "0.1", "0.1", "0.67", "–", "0.67"]
    both = [cell.strip() for cell in cells["all", "both"]]
    assert both == ["6", "5", "–", "–", "–", "0.1", "0.80", "0.00", "0.67"]
    assert "3 clips; least IoU: 02_1_roll 0.500" in lines[-1]
