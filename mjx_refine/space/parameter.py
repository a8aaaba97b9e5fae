"""One continuous parameter: its name, unit, bounds and scale."""

from __future__ import annotations

import dataclasses
import math

import numpy as np


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A coordinate of the search, linear or logarithmic between its bounds.

    Attributes:
      name: ``box_0.friction.sliding``, ``camera.pitch``, ...
      unit: of its value.
      field: which intermediate array of the decoder it fills.
      index: (object, component) in that array; object is -1 for camera, gravity and effects.
      start: value in the starting scene.
      low: lower bound.
      high: upper bound.
      width: prior standard deviation of the transformed value.
      offset: None for a linear scale; otherwise the coordinate is log(value + offset).
    """

    name: str
    unit: str
    field: str
    index: tuple[int, int]
    start: float
    low: float
    high: float
    width: float
    offset: float | None = None

    def __post_init__(self):
        numbers = (self.start, self.low, self.high, self.width)
        if not all(math.isfinite(v) for v in numbers) or not self.low <= self.start <= self.high:
            raise ValueError(f"{self.name}: start {self.start} outside of its bounds [{self.low}, {self.high}]")
        if not self.low < self.high or self.width <= 0:
            raise ValueError(
                f"{self.name}: bounds [{self.low}, {self.high}], width {self.width}; expected low < high, > 0"
            )
        if self.offset is not None and self.low + self.offset <= 0:
            raise ValueError(f"{self.name}: log({self.low} + {self.offset}) does not exist; raise low or offset")

    def _transform(self, value: float) -> float:
        return value if self.offset is None else math.log(value + self.offset)

    @property
    def transformed_low(self) -> float:
        """The lower bound on the transformed scale."""
        return self._transform(self.low)

    @property
    def span(self) -> float:
        """Distance of the bounds on the transformed scale."""
        return self._transform(self.high) - self._transform(self.low)

    @property
    def sigma(self) -> float:
        """Prior standard deviation in the unit box."""
        return self.width / self.span

    def to_unit(self, value: float) -> float:
        """Where ``value`` lies between the bounds, in [0, 1]."""
        return min(max((self._transform(value) - self._transform(self.low)) / self.span, 0.0), 1.0)

    def from_unit(self, u: np.ndarray) -> np.ndarray:
        """Values at ``u`` in [0, 1]."""
        transformed = self._transform(self.low) + u * self.span
        value = transformed if self.offset is None else np.exp(transformed) - self.offset
        return np.clip(value, self.low, self.high)

    def put(self, arrays: dict[str, np.ndarray], rows: slice, values: np.ndarray | float) -> None:
        """Writes ``values`` where ``field`` and ``index`` say, in so many rows."""
        i, k = self.index
        arrays[self.field][(rows, k) if i < 0 else (rows, i, k)] = values
