"""JSON values, checked as they are taken out, with messages that name file and place."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from mjx_refine.errors import InputError

MOST_BYTES = 512 * 2**20


def load_json(path: Path, what: str) -> dict[str, Any]:
    """The object that a JSON file holds.

    Raises:
      InputError: there is no such file, or it holds something else.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path}: over {MOST_BYTES >> 20} MiB; expected {what}; name another file")
        value = json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected {what}; name another file") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: no JSON ({str(error)[:100]}); expected {what}; get the file again") from error
    if not isinstance(value, dict):
        raise InputError(f"{path}: holds a {type(value).__name__}; expected {what}; name another file")
    return value


def entry(value: Any, key: str, where: str) -> Any:
    """`value[key]` of a JSON object."""
    if not isinstance(value, dict):
        raise InputError(f"{where} = {_show(value)}; expected an object with {key!r}; get the file again")
    if key not in value:
        raise InputError(f"{where}: the key {key!r} is missing; found {_show(sorted(value))}; get the file again")
    return value[key]


def entries(value: Any, key: str, where: str) -> list[Any]:
    """`value[key]`, a list."""
    found = entry(value, key, where)
    if not isinstance(found, list):
        raise InputError(f"{where}.{key} = {_show(found)}; expected a list; get the file again")
    return found


def whole(value: Any, key: str, where: str, low: int = 0, high: int = 10**9) -> int:
    """`value[key]`, a whole number."""
    found = entry(value, key, where)
    if isinstance(found, bool) or not isinstance(found, int) or not low <= found <= high:
        raise InputError(f"{where}.{key} = {_show(found)}; expected a whole number, {low} to {high}; correct it")
    return found


def word(value: Any, key: str, where: str, known: tuple[str, ...] = ()) -> str:
    """`value[key]`, text; one of `known` if these are given."""
    found = entry(value, key, where)
    if not isinstance(found, str) or (known and found not in known):
        expected = f"one of {', '.join(known)}" if known else "text"
        raise InputError(f"{where}.{key} = {_show(found)}; expected {expected}; correct it")
    return found


def vector(value: Any, key: str, where: str, lengths: tuple[int, ...] = (3,)) -> list[float]:
    """`value[key]`, a list of finite numbers of one of the lengths."""
    found = entries(value, key, where)
    good = [isinstance(n, int | float) and not isinstance(n, bool) and math.isfinite(n) for n in found]
    if len(found) not in lengths or not all(good):
        expected = " or ".join(str(n) for n in lengths)
        raise InputError(f"{where}.{key} = {_show(found)}; expected {expected} finite numbers; correct it")
    return [float(n) for n in found]


def _show(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
