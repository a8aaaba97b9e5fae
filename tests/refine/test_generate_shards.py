"""Shards: the same bytes however the work is dealt out, resumed where it stopped; and wrong calls of `refine generate`."""

import json
import os
import tarfile

import numpy as np
import pytest

from mjx_refine import GenerateOptions, InputError, generate_scenes, load_observation, load_scene, read_records
from mjx_refine.cli.generate import SPLITS as CLI_SPLITS
from mjx_refine.cli.main import run
from mjx_refine.generate import SPLITS, unpack
from mjx_refine.generate.options import MOST_OBJECTS

OPTIONS = GenerateOptions(seed=7, per_shard=3)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Eight records in three shards, by one process."""
    out = tmp_path_factory.mktemp("whole")
    generate_scenes(8, out, OPTIONS, workers=0)
    return out


def contents(folder, pattern="*-*"):
    return {path.name: path.read_bytes() for path in sorted(folder.glob(pattern))}


def test_names_are_the_command_line_s():
    assert CLI_SPLITS == SPLITS


def test_shards_are_plain_tars_as_webdataset_has_them(whole):
    assert sorted(path.name for path in whole.iterdir()) == [
        *(f"train-{number:06d}.{end}" for number in range(3) for end in ("json", "tar")),
        "train.json",
    ]
    with tarfile.open(whole / "train-000002.tar") as archive:
        names = archive.getnames()
        assert {info.mtime for info in archive.getmembers()} == {0}
    assert names == [f"{key:08d}.{end}" for key in (6, 7) for end in ("yaml", "pictures.npz", "motion.npz")]


def test_bytes_do_not_depend_on_processes_and_machines(whole, tmp_path):
    first = generate_scenes(8, tmp_path / "a", OPTIONS, workers=2, shard=(1, 2))
    second = generate_scenes(8, tmp_path / "a", OPTIONS, workers=0, shard=(2, 2))
    assert (first.made, second.made) == (5, 3)
    assert contents(tmp_path / "a") == contents(whole)
    assert {path.name for path in (tmp_path / "a").glob("train.*")} == {"train.1of2.json", "train.2of2.json"}


def test_records_do_not_depend_on_the_size_of_shards(whole, tmp_path):
    generate_scenes(8, tmp_path, GenerateOptions(seed=7, per_shard=8), workers=0)
    for one, other in zip(read_records(tmp_path), read_records(whole), strict=True):
        assert (one.key, one.text) == (other.key, other.text)
        np.testing.assert_array_equal(one.pictures.flow, other.pictures.flow)


def test_records_of_some_keys(whole):
    everything = list(read_records(whole))
    for keys in (["00000001", "00000007"], [], ["no key"]):
        some = list(read_records(whole, keys=keys))
        assert [record.key for record in some] == [record.key for record in everything if record.key in keys]
        for record in some:
            np.testing.assert_array_equal(record.masks, everything[int(record.key)].masks)


def test_a_run_goes_on_where_it_stopped(whole, tmp_path):
    out = tmp_path / "data"
    generate_scenes(4, out, OPTIONS, workers=0)
    (out / "train-000000.json").unlink()  # killed between a shard's two files
    (out / ".train-000001.tar.0123abcd.part").write_bytes(b"killed")
    summary = generate_scenes(8, out, OPTIONS, workers=0, resume=True)
    assert (summary.made, summary.tally.records) == (8, 8)  # shard 1 held one record of three
    assert contents(out) == contents(whole)
    assert not list(out.glob(".*"))
    stamps = {path.name: path.stat().st_mtime_ns for path in out.glob("*-*")}
    again = generate_scenes(8, out, OPTIONS, workers=0, resume=True)
    assert again.made == 0
    assert again.tally.rates() == summary.tally.rates()
    assert {path.name: path.stat().st_mtime_ns for path in out.glob("*-*")} == stamps


def test_the_summary_adds_up(whole):
    told = json.loads((whole / "train.json").read_text())
    shards = [json.loads(path.read_text()) for path in sorted(whole.glob("train-*.json"))]
    assert told["records"] == sum(shard["records"] for shard in shards) == 8
    assert told["proposals"] == sum(shard["proposals"] for shard in shards)
    assert told["filters"]["pixels"]["passed"] == 8
    assert told["filters"]["overlap"]["seen"] == told["proposals"]
    assert told["bytes"] == sum((whole / f"train-{number:06d}.tar").stat().st_size for number in range(3))
    assert sum(told["kinds"].values()) == 8


def test_test_sets_stand_beside_training_scenes(whole, tmp_path):
    for split in ("compositional", "six"):
        generate_scenes(1, tmp_path, GenerateOptions(split=split), workers=0)
    assert [len(record.scene.objects) for record in read_records(tmp_path)] == [4, 6]
    assert [len(record.scene.objects) for record in read_records(tmp_path, "six")] == [6]


@pytest.mark.parametrize(
    "changed", [GenerateOptions(seed=8, per_shard=3), GenerateOptions(seed=7, per_shard=4)], ids=["seed", "size"]
)
def test_shards_of_other_options_are_left_alone(whole, changed):
    before = contents(whole)
    with pytest.raises(InputError, match=r"made with (seed 7|per_shard 3), this call has"):
        generate_scenes(8, whole, changed, workers=0, resume=True)
    with pytest.raises(InputError, match="--resume"):
        generate_scenes(8, whole, changed, workers=0)
    with pytest.raises(InputError, match="holds shards"):
        generate_scenes(8, whole, OPTIONS, workers=0, shard=(1, 2))
    assert contents(whole) == before


def test_what_is_no_shard_is_refused(tmp_path, whole):
    with pytest.raises(InputError, match="no shards"):
        read_records(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        read_records(tmp_path / "none")
    with pytest.raises(InputError, match="split 'test'"):
        read_records(whole, "test")
    (tmp_path / "a.tar").write_bytes(b"no tar" * 1000)
    with pytest.raises(InputError, match="cannot be read as a tar"):
        list(read_records(tmp_path / "a.tar"))
    data = (whole / "train-000000.tar").read_bytes()
    (tmp_path / "cut.tar").write_bytes(data[: len(data) // 2 + 7])
    with pytest.raises(InputError, match=r"cut\.tar"):
        list(read_records(tmp_path / "cut.tar"))
    (tmp_path / "train-000000.tar").write_bytes(data)
    (tmp_path / "train-000000.json").write_text("[]")
    with pytest.raises(InputError, match="not what `refine generate` writes"):
        generate_scenes(3, tmp_path, OPTIONS, workers=0, resume=True)


def test_keys_are_no_paths(tmp_path, whole):
    with tarfile.open(whole / "train-000000.tar") as old, tarfile.open(tmp_path / "evil.tar", "w") as new:
        for info in old.getmembers()[:3]:
            content = old.extractfile(info)
            info.name = info.name.replace("00000000", "../00000000")
            new.addfile(info, content)
    with pytest.raises(InputError):
        unpack(tmp_path / "evil.tar", tmp_path / "inner" / "out")
    assert not list(tmp_path.rglob("*.yaml"))


def test_the_command_writes_what_the_others_read(whole, tmp_path, capsys):
    out = tmp_path / "deep" / "data"
    call = ["generate", "--count", "2", "--out", str(out), "--seed", "7", "--per-shard", "3", "--workers", "1"]
    assert run(call) == 0
    line = capsys.readouterr().out
    assert line.startswith("2 scenes (2 new, ")
    assert line.count("\n") == 1
    assert run(call) == 2
    assert "--resume" in capsys.readouterr().err
    assert run([*call, "--resume"]) == 0
    assert run(["generate", "--unpack", str(out), "--out", str(tmp_path / "files")]) == 0
    assert sorted(path.name for path in (tmp_path / "files").iterdir()) == [
        f"{key:08d}.{end}" for key in (0, 1) for end in ("npz", "yaml")
    ]
    record = next(iter(read_records(whole)))
    assert load_scene(tmp_path / "files/00000000.yaml") == record.scene
    observation = load_observation(tmp_path / "files/00000000.npz")
    np.testing.assert_array_equal(observation.masks, record.masks)
    np.testing.assert_array_equal(observation.flow, record.flow.astype(np.float32))
    scores = ["evaluate", "--scene", str(tmp_path / "files/00000000.yaml")]
    assert run([*scores, "--video", str(tmp_path / "files/00000000.npz")]) == 0


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--count", "0"], "--count"),
        (["--count", "-5"], "--count"),
        (["--count", "many"], "--count"),
        ([], "--count"),
        (["--count", "2", "--split", "test"], "--split"),
        (["--count", "2", "--objects", "0"], "--objects"),
        (["--count", "2", "--objects", str(MOST_OBJECTS + 1)], "--objects"),
        (["--count", "2", "--objects", "3", "--split", "five"], "objects 3 with split five"),
        (["--count", "2", "--seed", "-1"], "--seed"),
        (["--count", "2", "--shard", "3/2"], "--shard"),
        (["--count", "2", "--shard", "0/2"], "--shard"),
        (["--count", "2", "--workers", "0"], "--workers"),
        (["--count", "2", "--per-shard", "0"], "--per-shard"),
        (["--count", "2", "--device", "tpu"], "--device"),
        (["--count", "2", "--unpack", "x.tar"], "--unpack beside --count"),
        (["--unpack", "missing.tar"], "missing.tar"),
    ],
)
def test_wrong_calls_are_one_line_and_leave_nothing(arguments, told, tmp_path, capsys):
    assert run(["generate", *arguments, "--out", str(tmp_path / "out")]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert told in captured.err
    assert not captured.out
    assert not list(tmp_path.iterdir())


def test_an_out_that_cannot_be_written(tmp_path, capsys):
    (tmp_path / "file").write_text("here")
    assert run(["generate", "--count", "2", "--out", str(tmp_path / "file")]) == 2
    assert run(["generate", "--count", "2", "--out", str(tmp_path / "file" / "below")]) == 2
    assert capsys.readouterr().err.count("\n") == 2
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("lacking", ["gpu", "renderer", "library"])
def test_what_the_machine_lacks_is_told(lacking, tmp_path, monkeypatch, capsys):
    # Processes apart ask JAX and MuJoCo, and so see this environment.
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    if lacking == "renderer":
        monkeypatch.setenv("MUJOCO_GL", "disable")
    elif lacking == "library":  # importing MuJoCo fails
        monkeypatch.setenv("MUJOCO_GL", "bogus")
    wanted = ["--device", "gpu"] if lacking == "gpu" else ["--rgb"]
    out = tmp_path / "deep" / "data"
    assert run(["generate", "--count", "2", "--out", str(out), "--workers", "1", *wanted]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert ("--device cpu" if lacking == "gpu" else "MUJOCO_GL=egl") in captured.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("count", [0, -1, 10**9])
def test_counts_from_python(count, tmp_path):
    with pytest.raises(InputError, match="count"):
        generate_scenes(count, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_an_interrupted_run_leaves_whole_shards_alone(tmp_path, monkeypatch):
    from mjx_refine.generate import workers

    written = []
    real = workers.write_shard

    def once(*arguments):
        if written:
            raise KeyboardInterrupt
        written.append(real(*arguments))
        return written[-1]

    monkeypatch.setattr(workers, "write_shard", once)
    with pytest.raises(KeyboardInterrupt):
        generate_scenes(8, tmp_path, OPTIONS, workers=0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["train-000000.json", "train-000000.tar"]
    assert os.path.getsize(tmp_path / "train-000000.tar") == written[0]
