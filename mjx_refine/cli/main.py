"""Entry point: exit status 0 done, 2 the input or the call was wrong (one line on stderr), 1 anything else."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence

import click

from mjx_refine.errors import InputError


def run(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit status."""
    from mjx_refine.cli.commands import app

    try:
        status = app.main(
            args=None if arguments is None else list(arguments), prog_name="refine", standalone_mode=False
        )
        return status if isinstance(status, int) else 0
    except InputError as error:
        return _complain(str(error), 2)
    except click.UsageError as error:
        command = error.ctx.command_path if error.ctx else "refine"
        return _complain(f"{error.format_message()}; see `{command} --help`", 2)
    except click.ClickException as error:
        return _complain(error.format_message(), 2)
    except (KeyboardInterrupt, click.Abort):
        return _complain("interrupted; the same call with --resume goes on from the last checkpoint", 1)
    except MemoryError:
        return _complain("out of memory; choose a smaller --resolution, --size or --population", 1)
    except Exception:
        traceback.print_exc()
        return _complain("an unexpected error, shown above; please report it", 1)


def _complain(message: str, status: int) -> int:
    line = " ".join(message.split())
    # A file's name may hold control characters, which a terminal would obey.
    print("refine: " + "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line), file=sys.stderr)
    return status


def main() -> None:
    """``refine``."""
    sys.exit(run())
