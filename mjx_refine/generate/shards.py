"""Shards: plain tar files as WebDataset streams them, each with a JSON file of what is in it and how it came about.

WebDataset and not Zarr, because a record is read as a whole, once, in order: a tar is one sequential read from disk, HTTP or
object storage, PyTorch and JAX loaders stream it as it is, ``tar`` lists it, and Python's own ``tarfile`` writes it. Zarr's
strength, chunks at random places of large arrays, is of no use for records of different lengths, texts among them.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Container, Iterable, Iterator
from pathlib import Path

import mujoco

from mjx_refine import files
from mjx_refine.errors import InputError
from mjx_refine.generate.make import FILTERS, Tally
from mjx_refine.generate.options import SPLITS, GenerateOptions
from mjx_refine.generate.record import Record, from_members, save_record

FORMAT = 1


def shard_name(split: str, number: int) -> str:
    """Without its ending."""
    return f"{split}-{number:06d}"


def written_options(options: GenerateOptions) -> dict:
    """What must agree between the shards of one folder and split."""
    return {
        "seed": options.seed,
        "split": options.split,
        "objects": options.objects,
        "rgb": options.rgb,
        "per_shard": options.per_shard,
        "mujoco": mujoco.__version__,
    }


def write_shard(
    out: Path, number: int, options: GenerateOptions, records: Iterable[tuple[str, dict[str, bytes]]], tally: Tally
) -> int:
    """Writes one shard and what is known of it, each whole or not at all; returns the shard's bytes.

    Args:
      out: folder.
      number: of the shard.
      options: of the records.
      records: key and members of each; taken one by one.
      tally: counts the records while they are taken.
    """
    path = out / f"{shard_name(options.split, number)}.tar"

    def write(stream) -> None:
        with tarfile.open(fileobj=stream, mode="w", format=tarfile.USTAR_FORMAT) as archive:
            for key, contents in records:
                for name, content in contents.items():
                    info = tarfile.TarInfo(f"{key}.{name}")
                    info.size = len(content)
                    archive.addfile(info, io.BytesIO(content))

    files.write_atomic(path, write)
    told = {
        "format": FORMAT,
        "options": written_options(options),
        "first": number * options.per_shard,
        "records": tally.records,
        "proposals": tally.proposals,
        "rejected": {name: tally.rejected[name] for name in FILTERS},
        "kinds": dict(sorted(tally.kinds.items())),
        "bytes": path.stat().st_size,
    }
    files.write_text(path.with_suffix(".json"), json.dumps(told, indent=1) + "\n")
    return told["bytes"]


def read_told(path: Path) -> dict:
    """What ``write_shard`` wrote about a shard.

    Raises:
      InputError: it cannot be read.
    """
    try:
        told = json.loads(path.read_text())
        tally_of(told)
        return told
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: not what `refine generate` writes about a shard ({type(error).__name__}); remove it or name another --out"
        ) from error


def tally_of(told: dict) -> Tally:
    """The counts of a shard that was written before."""
    tally = Tally(records=int(told["records"]), proposals=int(told["proposals"]))
    tally.rejected.update({name: int(told["rejected"][name]) for name in FILTERS})
    tally.kinds.update({str(name): int(n) for name, n in told["kinds"].items()})
    return tally


def finished(out: Path, options: GenerateOptions, resume: bool) -> dict[int, dict]:
    """The shards of the split that stand in ``out`` whole, by number, with what is told of them.

    Raises:
      InputError: there are some and ``resume`` is not set, or they are of other options.
    """
    found: dict[int, dict] = {}
    shards = sorted(out.glob(f"{options.split}-*.tar")) if out.is_dir() else []
    if shards and not resume:
        raise InputError(
            f"{out}: holds shards ({shards[0].name}) already; go on with --resume, remove them or name another --out"
        )
    wanted = written_options(options)
    for path in shards:
        if not path.with_suffix(".json").exists():
            continue  # killed between the two files; it is written again
        told = read_told(path.with_suffix(".json"))
        given = told.get("options") or {}
        for name, value in wanted.items():
            if given.get(name) != value:
                raise InputError(
                    f"{path}: made with {name} {given.get(name)}, this call has {value}; repeat that call's options or "
                    "name another --out"
                )
        if told["bytes"] == path.stat().st_size:
            found[told["first"] // options.per_shard] = told
    return found


def read_records(source: str | Path, split: str | None = None, keys: Container[str] | None = None) -> Iterator[Record]:
    """The records of a shard, or of all shards in a folder, in order, one at a time.

    Args:
      source: a ``.tar`` file or a folder.
      split: of a folder, only this one.
      keys: only the records with these; what others hold is not read.

    Raises:
      InputError: there are none, or one is damaged.
    """
    source = Path(source)
    if split is not None and split not in SPLITS:
        raise InputError(f"split {split!r}; expected one of {', '.join(SPLITS)}")
    if source.is_dir():
        paths = sorted(source.glob(f"{split or '*'}-*.tar"))
        if not paths:
            raise InputError(f"{source}: no shards ({split or 'SPLIT'}-NUMBER.tar) in it; see `refine generate`")
    elif source.is_file():
        paths = [source]
    else:
        raise InputError(f"{source}: no such file or folder; expected a shard or a folder of shards")
    return (record for path in paths for record in _records_of(path, keys))


def _records_of(path: Path, keys: Container[str] | None) -> Iterator[Record]:
    key, contents = None, {}
    try:
        with tarfile.open(path, "r:") as archive:
            for info in archive:
                this, _, name = info.name.partition(".")
                if keys is not None and this not in keys:
                    continue
                if this != key and key is not None:
                    yield from_members(key, contents, str(path))
                    contents = {}
                key = this
                member = archive.extractfile(info)
                contents[name] = member.read() if member is not None else b""
    except (tarfile.TarError, OSError, EOFError) as error:
        raise InputError(f"{path}: cannot be read as a tar file ({error}); generate it again") from error
    if key is not None:
        yield from_members(key, contents, str(path))


def unpack(source: str | Path, out: str | Path) -> int:
    """Writes each record of a shard or folder as ``KEY.yaml`` and ``KEY.npz`` (a scene and an observation, which all
    commands take); returns how many.

    Raises:
      InputError: nothing to read, or ``out`` cannot be written.
    """
    records = read_records(source)
    out = files.writable_directory(out)
    count = 0
    for record in records:
        if count == 0:
            make_folder(out)
        # A key comes from a file that anyone may have made.
        if not record.key.isdigit():
            raise InputError(f"{source}: a record's key is {record.key[:40]!r}; expected digits; generate it again")
        save_record(out, record)
        count += 1
    return count


def make_folder(out: Path) -> None:
    """Makes ``out`` and the folders above it.

    Raises:
      InputError: it cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made ({error.strerror}); name another --out") from error
