"""Commands that end as `refine` does."""

from __future__ import annotations

import click

from mjx_refine.errors import InputError


def exit_status(command: click.Command, name: str, arguments: list[str] | None = None) -> int:
    """Runs ``python -m benchmarks.NAME``; its exit status: 2 for wrong input, with one line on standard error, else what the
    command returns, or 0."""
    try:
        status = command(arguments, prog_name=f"python -m benchmarks.{name}", standalone_mode=False)
        return status if isinstance(status, int) else 0
    except (InputError, click.ClickException) as wrong:
        said = wrong.format_message() if isinstance(wrong, click.ClickException) else str(wrong)
        click.echo(f"{name}: " + " ".join(said.split()), err=True)
        return 2
