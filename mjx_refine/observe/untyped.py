"""Libraries whose type stubs are missing or wrong, seen as untyped: scipy.ndimage, and OpenCV calls that take None."""

from __future__ import annotations

from typing import Any

import cv2 as _cv2
import scipy.ndimage as _ndimage

ndimage: Any = _ndimage
opencv: Any = _cv2
