"""What MuJoCo's convex collider takes for parallel.

Within 5.1 degrees a face and a face, or a face and an edge, touch in several points.
"""

from __future__ import annotations

import math

ALIGNED = math.cos(0.0889)
"""Cosine between two faces' normals from which they are parallel."""

SQUARE = math.sin(0.0889)
"""Cosine between a face's normal and an edge up to which they are parallel."""
