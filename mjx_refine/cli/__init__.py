"""The command line ``refine``."""

from mjx_refine.cli.main import main

__all__ = ["main"]
