"""Pictures as text that a page holds within itself."""

from __future__ import annotations

import base64
import io

import numpy as np
from jaxtyping import UInt8
from PIL import Image


def jpeg(image: UInt8[np.ndarray, "height width 3"], quality: int = 86) -> str:
    """A data URI of an RGB photograph."""
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "JPEG", quality=quality, subsampling=0, optimize=True)
    return data_uri("image/jpeg", stream.getvalue())


def png(image: UInt8[np.ndarray, "height width 3"]) -> str:
    """A data URI of an RGB drawing, without loss."""
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "PNG", optimize=True)
    return data_uri("image/png", stream.getvalue())


def data_uri(kind: str, data: bytes) -> str:
    """``data`` of MIME type ``kind`` as a URI."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
