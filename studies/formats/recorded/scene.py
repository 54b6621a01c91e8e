"""What the recordings show."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def depth(number: int, width: int, height: int) -> npt.NDArray[np.uint16]:
    """Return raw depth (h, w): a slanted wall, a nearer box that moves on from image to image, a corner without any."""
    wall = 2800 + 4 * np.arange(width)[None, :] + 2 * np.arange(height)[:, None]
    raw = wall.astype(np.uint16)
    left = width // 4 + number * (width // 16)
    raw[height // 4 : height // 2, left : left + width // 4] = 2400 + 10 * number
    raw[: height // 8, : width // 8] = 0
    return raw


def colour(number: int, width: int, height: int) -> npt.NDArray[np.uint8]:
    """Return colour (h, w, 3): red grows to the right, green downwards, blue from image to image."""
    picture = np.zeros((height, width, 3), np.uint8)
    picture[..., 0] = np.linspace(20.0, 240.0, width)[None, :]
    picture[..., 1] = np.linspace(20.0, 240.0, height)[:, None]
    picture[..., 2] = 100 + 10 * number
    return picture
