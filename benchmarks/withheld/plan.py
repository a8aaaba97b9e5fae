"""Which clips an exam holds, in an order that tells nothing."""

from __future__ import annotations

import numpy as np

from benchmarks.withheld.exam import Order
from benchmarks.withheld.families import CATALOGUE, PAIRS, STRANGE
from benchmarks.withheld.several import LASTING

SPLITS = ("one", "two", "none", "withheld", "strange")


def orders(
    seed: int, counts: dict[str, int], only: tuple[str, ...] = (), clips: int = 1, left: float = 0.0
) -> list[Order]:
    """The clips of an exam, shuffled.

    Args:
      seed: the same seed gives the same exam. counts: clips of each split. only: effects of the catalogue to keep to
        (of pairs: those both of whose effects are among them, if there are any). clips: of each set-up; of several, only
        effects that last are drawn. left: what a refit of the scene without an effect must leave of it, px.

    Raises:
      ValueError: an unknown split or effect.
    """
    unknown = [name for name in only if name not in CATALOGUE] + [s for s in counts if s not in SPLITS]
    if unknown:
        raise ValueError(f"{unknown[0]!r}; expected one of {', '.join([*CATALOGUE, *SPLITS])}")
    rng = np.random.default_rng([seed, 20])
    names = list(only or (CATALOGUE if clips == 1 else LASTING))
    pairs = [p for p in PAIRS if set(p) <= set(names)] or list(PAIRS)
    pools = {
        "one": [(n,) for n in names],
        "two": pairs,
        "none": [()],
        "withheld": [(n,) for n in names],
        "strange": [(n,) for n in STRANGE],
    }
    found: list[tuple[str, tuple[str, ...], str]] = []
    for split in SPLITS:
        count, pool = counts.get(split, 0), pools[split]
        drawn: list[tuple[str, ...]] = []
        while len(drawn) < count:
            drawn += [pool[i] for i in rng.permutation(len(pool))]
        flows = rng.permutation(["exact", "dis"] * ((count + 1) // 2))[:count]
        found += [(split, tuple(e), str(f)) for e, f in zip(drawn[:count], flows, strict=True)]
    return [Order(*found[i], seed=(seed, int(i)), clips=clips, left=left) for i in rng.permutation(len(found))]
