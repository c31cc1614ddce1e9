"""PNG pictures of 8-bit values, grey or by a table of colours, and the tables."""

import base64
import io

import numpy as np
from numpy.typing import NDArray

_BLUE, _WHITE, _RED = (33, 86, 158), (247, 247, 245), (178, 34, 40)


def png_bytes(image: NDArray[np.uint8], colours: NDArray[np.uint8] | None = None) -> bytes:
    """A PNG of an image (rows, columns) uint8, row 0 at the top; colours (256, 3) uint8, None is grey."""
    from PIL import Image  # a tenth of a second, which most commands need not wait for

    picture = Image.fromarray(image)
    if colours is not None:
        picture.putpalette(colours.tobytes())
    stream = io.BytesIO()
    picture.save(stream, "PNG", compress_level=9)
    return stream.getvalue()


def data_uri(png: bytes) -> str:
    return f"data:image/png;base64,{base64_of(png)}"


def base64_of(content: bytes) -> str:
    """Bytes as text that a page holds."""
    return base64.b64encode(content).decode("ascii")


def bytes_of(image: NDArray[np.floating], low: float, high: float) -> NDArray[np.uint8]:
    """Values (any shape) as 0 to 255 from ``low`` to ``high``, clipped; what overflowed on its way here is 0."""
    span = high - low if high > low else 1.0
    share = np.nan_to_num((image.astype(np.float64) - low) / span)
    return np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8)


def top_row_first(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image (rows, columns) whose row 0 is the lowest, as a picture, whose row 0 is the top."""
    return np.ascontiguousarray(image[::-1])


def diverging() -> NDArray[np.uint8]:
    """Colours (256, 3) from blue over white, in the middle, to red: for differences."""
    at = np.linspace(-1, 1, 256)[:, None]
    ends = np.where(at < 0, np.array(_BLUE), np.array(_RED))
    # The root makes small differences visible, as a white page swallows them.
    mixed = np.array(_WHITE) + np.abs(at) ** 0.8 * (ends - np.array(_WHITE))
    return np.rint(mixed).astype(np.uint8)
