"""What to refine: one job a clip, from Python, from pairs of files, or from ``jobs.yaml``."""

from __future__ import annotations

import dataclasses
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjx_refine.errors import InputError
from mjx_refine.scene import fields
from mjx_refine.scene.plain import load_plain, read_text
from mjx_refine.search import Options

SUMMARY = "summary.csv"
MAX_JOBS = 100_000
MAX_NAME = 100
OVERRIDES = (
    "seed",
    "population",
    "iterations",
    "optimizer",
    "solver",
    "derivatives",
    "resolution",
    "starts",
    "refits",
)
"""Options that a job may set for itself; the backend and the threads belong to the whole."""

_KEYS = ("name", "init", "video", *OVERRIDES)


@dataclasses.dataclass(frozen=True)
class Job:
    """One clip and its samples.

    Attributes:
      init: file of the samples (YAML).
      video: file of the observation (npz).
      name: of the job's folder; by default the video's name, or its folder's where the video is called ``flows.npz``.
      overrides: fields of ``Options`` that hold for this job alone, see ``OVERRIDES``.

    Raises:
      InputError: the name is none for a folder, or an override is wrong.
    """

    init: Path
    video: Path
    name: str = ""
    overrides: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "init", Path(self.init))
        object.__setattr__(self, "video", Path(self.video))
        object.__setattr__(self, "name", _name(self.name or _name_of(self.video), f"job of {self.video}: name"))
        fields.mapping(self.overrides, f"job {self.name}: overrides", OVERRIDES)
        self.options(Options())

    def options(self, common: Options) -> Options:
        """``common`` with this job's overrides.

        Raises:
          InputError: an override is wrong.
        """
        try:
            return dataclasses.replace(common, **self.overrides)
        except InputError as error:
            raise InputError(f"job {self.name}: {error}") from error
        except TypeError as error:
            raise InputError(f"job {self.name}: overrides = {fields.show(dict(self.overrides))}; {error}") from error


def load_jobs(path: str | os.PathLike) -> list[Job]:
    """Reads ``jobs.yaml``: a list of mappings with ``init``, ``video``, optionally ``name`` and overrides.

    Paths are relative to the file's folder.

    Raises:
      InputError: the file cannot be read, a key is unknown or missing, a value is wrong, two jobs have one name.
    """
    path = Path(path)
    entries = load_plain(read_text(path, "a list of jobs in YAML"), str(path), "it")
    if isinstance(entries, str | bytes | Mapping) or not isinstance(entries, Sequence) or not entries:
        raise InputError(
            f"{path}: got {fields.show(entries)}; expected a list of jobs, each with `init` and `video`; "
            "begin each with `- init: ...`"
        )
    if len(entries) > MAX_JOBS:
        raise InputError(f"{path}: {len(entries)} jobs; expected at most {MAX_JOBS}; split the file")
    jobs = [_job(entry, path, f"{path}: job {i}") for i, entry in enumerate(entries)]
    check_names(jobs, str(path))
    return jobs


def jobs_of_pairs(inits: Sequence[str | os.PathLike], videos: Sequence[str | os.PathLike]) -> list[Job]:
    """A job for each of ``inits`` with its ``videos``, named after the video.

    Raises:
      InputError: not as many of each, or two get the same name.
    """
    if len(inits) != len(videos):
        raise InputError(f"{len(inits)} scenes and {len(videos)} clips; expected as many of each, in the same order")
    jobs = [Job(Path(init), Path(video)) for init, video in zip(inits, videos, strict=True)]
    check_names(jobs, "--video")
    return jobs


def check_names(jobs: Sequence[Job], place: str) -> None:
    """Refuses two jobs that would write in one folder.

    Raises:
      InputError: there are such.
    """
    for name, count in Counter(job.name for job in jobs).items():
        if count > 1:
            raise InputError(
                f"{place}: {count} jobs have the name {name!r}; names must differ, since each is a folder; "
                "give each a `name` in a jobs file"
            )


def _job(entry: object, path: Path, where: str) -> Job:
    entry = fields.mapping(entry, where, _KEYS)
    files = {}
    for key in ("init", "video"):
        value = fields.required(entry, key, where)
        files[key] = path.parent / fields.text(value, f"{where}.{key}")
    name = entry.get("name")
    name = _name(_name_of(files["video"]) if name is None else name, f"{where}.name")
    overrides = {key: entry[key] for key in OVERRIDES if entry.get(key) is not None}
    if "resolution" in overrides:
        overrides["resolution"] = _resolution(overrides["resolution"], f"{where}.resolution")
    try:
        return Job(files["init"], files["video"], name, overrides)
    except InputError as error:
        raise InputError(f"{where}: {str(error).removeprefix(f'job {name}: ')}") from error


def _name_of(video: Path) -> str:
    return video.absolute().parent.name if video.stem == "flows" else video.stem


def _name(value: object, place: str) -> str:
    """A name that can be a folder's."""
    name = fields.text(value, place)
    if len(name) > MAX_NAME or re.search(r'[/\\:*?"<>|]', name) or name.startswith(".") or name == SUMMARY:
        raise InputError(
            f"{place} = {fields.show(value)}; expected a folder's name of at most {MAX_NAME} characters, "
            f'without / \\ : * ? " < > |, not {SUMMARY}, not beginning with a dot; rename it'
        )
    return name


def _resolution(value: object, place: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,4})[xX](\d{1,4})", value.strip()) if isinstance(value, str) else None
    if match is None:
        raise InputError(f"{place} = {fields.show(value)}; expected WIDTHxHEIGHT in pixels, such as 160x107")
    return int(match[1]), int(match[2])
