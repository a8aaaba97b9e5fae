"""Symmetric matrices of several clips' least squares: a shared block, one of each clip, and what couples them.

Clips touch one another only through the shared coordinates, so that each is eliminated by itself (Schur complement): work
and memory grow linearly with clips.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclasses.dataclass(frozen=True)
class Arrow:
    """[[shared, cross...], [cross', own...]], coordinates as in ``JointHypothesis``.

    Attributes:
      shared: the set-up's block.
      cross: (shared, own) of each clip.
      own: each clip's block.
    """

    shared: Float[np.ndarray, "shared shared"]
    cross: tuple[Float[np.ndarray, "shared own"], ...]
    own: tuple[Float[np.ndarray, "own own"], ...]

    @classmethod
    def of(
        cls,
        parts: list[Float[np.ndarray, "part part"]],
        masks: tuple[Bool[np.ndarray, "part"], ...],
        diagonal: Float[np.ndarray, "dimension"],
    ) -> Arrow:
        """The sum of the clips' matrices, in their own coordinates, and a diagonal matrix."""
        count = int(masks[0].sum())
        shared = np.diag(diagonal[:count]).astype(float)
        cross, own, first = [], [], count
        for part, mask in zip(parts, masks, strict=True):
            shared += part[np.ix_(mask, mask)]
            cross.append(part[np.ix_(mask, ~mask)])
            size = int((~mask).sum())
            own.append(part[np.ix_(~mask, ~mask)] + np.diag(diagonal[first : first + size]))
            first += size
        return cls(shared, tuple(cross), tuple(own))

    @property
    def diagonal(self) -> Float[np.ndarray, "dimension"]:
        return np.concatenate([np.diag(self.shared), *(np.diag(block) for block in self.own)])

    def plus(self, diagonal: Float[np.ndarray, "dimension"]) -> Arrow:
        """With a diagonal matrix added."""
        pieces = np.split(diagonal, self._ends)
        own = tuple(block + np.diag(d) for block, d in zip(self.own, pieces[1:], strict=True))
        return Arrow(self.shared + np.diag(pieces[0]), self.cross, own)

    def only(self, free: Bool[np.ndarray, "dimension"]) -> Arrow:
        """With rows and columns of what is not free those of the unit matrix."""
        first, *rest = np.split(free, self._ends)

        def cut(block: np.ndarray, rows: np.ndarray) -> np.ndarray:
            return np.where(np.outer(rows, rows), block, 0.0) + np.diag(~rows)

        cross = tuple(np.where(np.outer(first, part), c, 0.0) for c, part in zip(self.cross, rest, strict=True))
        return Arrow(
            cut(self.shared, first), cross, tuple(cut(block, part) for block, part in zip(self.own, rest, strict=True))
        )

    @property
    def _ends(self) -> Int[np.ndarray, "clips"]:
        return np.cumsum([len(self.shared), *(len(block) for block in self.own)])[:-1]

    @property
    def schur(self) -> Float[np.ndarray, "shared shared"]:
        """The shared block once every clip's own coordinates are eliminated."""
        result = self.shared.copy()
        for c, block in zip(self.cross, self.own, strict=True):
            if len(block):
                result -= c @ np.linalg.solve(block, c.T)
        return result

    def solve(self, right: Float[np.ndarray, "dimension columns"]) -> Float[np.ndarray, "dimension columns"]:
        """The solution of a linear system; ``right`` may have several columns."""
        first, *rest = np.split(right, self._ends)
        eased = [
            np.linalg.solve(block, part) if len(block) else part for block, part in zip(self.own, rest, strict=True)
        ]
        reduced = first - sum(c @ part for c, part in zip(self.cross, eased, strict=True))
        shared = np.linalg.solve(self.schur, reduced)
        own = [
            part - np.linalg.solve(block, c.T @ shared) if len(block) else part
            for part, c, block in zip(eased, self.cross, self.own, strict=True)
        ]
        return np.concatenate([shared, *own])

    @property
    def logdet(self) -> float:
        """Logarithm of the determinant."""
        blocks = [self.schur, *self.own]
        return float(sum(np.linalg.slogdet(block)[1] for block in blocks if len(block)))
