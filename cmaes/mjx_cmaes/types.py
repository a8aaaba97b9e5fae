"""Shapes of arrays that several files name."""

from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float

Vector: TypeAlias = Float[np.ndarray, " dimension"]
Matrix: TypeAlias = Float[np.ndarray, "dimension dimension"]
Points: TypeAlias = Float[np.ndarray, "population dimension"]
Costs: TypeAlias = Float[np.ndarray, " population"]
Weights: TypeAlias = Float[np.ndarray, " population"]
Flags: TypeAlias = Bool[np.ndarray, " population"]
