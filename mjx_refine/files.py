"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

from mjx_refine.errors import InputError

_PART = re.compile(r"\..+\.[0-9a-f]{8}\.part", re.DOTALL)


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose another place") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_atomic(path: str | os.PathLike, write: Callable[[BinaryIO], object]) -> Path:
    """Writes a file through ``write(stream)``; the file at ``path`` is the old one or the whole new one, never a part.

    Raises:
      InputError: the place cannot be written.
    """
    with _replacing(replaceable(path)) as temporary, open(temporary, "wb") as stream:
        write(stream)
        stream.flush()
        os.fsync(stream.fileno())
    return Path(path)


def replaceable(path: str | os.PathLike) -> Path:
    """Where a file called ``path`` is to be written: what a link leads to.

    Raises:
      InputError: there is something else than a file, such as a device or a pipe.
    """
    path = Path(path)
    if path.is_symlink():
        path = Path(os.path.realpath(path))
    if os.path.lexists(path) and not path.is_file() and not path.is_dir():
        raise InputError(f"{path}: is no plain file; expected a file to replace, or nothing; choose another name")
    return path


def write_text(path: str | os.PathLike, text: str) -> Path:
    """Writes ``text`` as UTF-8, whole or not at all."""
    return write_atomic(path, lambda stream: stream.write(text.encode()))


def remove_stale_parts(folder: str | os.PathLike) -> None:
    """Removes temporary files that a killed process left in ``folder``; call it when no other process writes there."""
    folder = Path(folder)
    if not folder.is_dir():
        return
    for file in folder.iterdir():
        if _PART.fullmatch(file.name) and file.is_file():
            with contextlib.suppress(OSError):
                file.unlink()


def writable_directory(path: str | os.PathLike, names: Iterable[str] = ()) -> Path:
    """Checks, without making it, that ``path`` is or can become a directory to write files called ``names`` in.

    Raises:
      InputError: it cannot.
    """
    path = Path(path)
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError) as error:  # a name that is too long, or holds a NUL
        raise InputError(f"{path}: no name for a directory ({error}); name another --out") from error
    existing = path
    while not os.path.lexists(existing) and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise InputError(f"{path}: {existing} is no directory; expected one to write in; name another --out")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"{path}: no permission to write in {existing}; name another --out")
    for name in names:
        if (path / name).is_dir():
            raise InputError(
                f"{path / name}: is a directory; expected a file to replace; remove it or name another --out"
            )
    return path


def writable_file(path: str | os.PathLike) -> Path:
    """Checks, without making it, that ``path`` can become a file, so that long work does not end in vain.

    Raises:
      InputError: it cannot.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a directory; expected the name of a file to write; add a name to --out")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no directory {path.parent}; make it or name another --out")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(f"{path}: no permission to write in {path.parent}; name another --out")
    replaceable(path)
    return path
