"""Command-line arguments that need a parser of their own."""

from __future__ import annotations

import re

import click


class Size(click.ParamType):
    """WIDTHxHEIGHT in pixels."""

    name = "WxH"

    def __init__(self, most: int = 8192):
        self.most = most

    def convert(self, value, param, ctx):
        """(width, height), or a usage error."""
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})", value.strip())
        if match:
            width, height = int(match[1]), int(match[2])
            if 8 <= width <= self.most and 8 <= height <= self.most:
                return width, height
        self.fail(f"{value!r}; expected WIDTHxHEIGHT, each from 8 to {self.most}, such as 480x320", param, ctx)


class FiniteFloat(click.FloatRange):
    """A number in a range; NaN is none."""

    def convert(self, value, param, ctx):
        """The number, or a usage error."""
        number = super().convert(value, param, ctx)
        if number != number:
            self.fail(f"{value!r}; expected a number", param, ctx)
        return number
