"""An effect that was put into a clip, in the words of the key."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Effect:
    """One effect at work.

    Fields:
      name: of the catalogue, or of one of the strange ones. target: index of the object, None where it has none.
      parameters: as the scene format names them (SI units, degrees).
      hidden: what the making needs beyond them (a post's radius, a solid's form); never asked for.
    """

    name: str
    target: int | None
    parameters: dict[str, Any]
    hidden: dict[str, Any] = field(default_factory=dict)


def named(effects: tuple[Effect, ...], name: str) -> Effect | None:
    """The first effect of that name, or None."""
    return next((e for e in effects if e.name == name), None)
