"""Pictures as text that a page holds within itself."""

from __future__ import annotations

import base64
import io

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image


def jpeg(image: UInt8[np.ndarray, "height width 3"], quality: int = 86) -> str:
    """A data URI of an RGB photograph."""
    # Not by Pillow, whose buffer is too small for pictures that are mostly noise.
    how = {
        cv2.IMWRITE_JPEG_QUALITY: quality,
        cv2.IMWRITE_JPEG_OPTIMIZE: 1,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR: cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    }
    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [n for pair in how.items() for n in pair])
    return data_uri("image/jpeg", data.tobytes())


def png(image: UInt8[np.ndarray, "height width 3"]) -> str:
    """A data URI of an RGB drawing, without loss."""
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "PNG", optimize=True)
    return data_uri("image/png", stream.getvalue())


def data_uri(kind: str, data: bytes) -> str:
    """``data`` of MIME type ``kind`` as a URI."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
