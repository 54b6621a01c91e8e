"""Lens distortion, taken out of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar, final

import numpy as np
import numpy.typing as npt

from modeler.types import Array, Camera, InputError

Pixel = TypeVar("Pixel", np.uint8, np.uint16, np.float32)


@final
@dataclass(frozen=True)
class Lens:
    """A camera whose lens bends lines: radial and tangential coefficients as ROS, OpenCV and the Kinect have them."""

    camera: Camera
    """The camera, of the bent and of the straight picture alike."""
    coefficients: tuple[float, ...]
    """k1 k2 p1 p2 k3 (`plumb_bob`), and k4 k5 k6 for `rational_polynomial`."""

    @property
    def bends(self) -> bool:
        """Whether there is anything to take out."""
        return any(abs(value) > 1e-9 for value in self.coefficients)

    def bent(self, w: Array, h: Array) -> tuple[Array, Array]:
        """Return where rays (w, h) = (x/z, y/z) of any shape appear as rays of a camera without distortion."""
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.coefficients, *([0.0] * 8))[:8]
        square = w**2 + h**2
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        radial = radial / (1.0 + square * (k4 + square * (k5 + square * k6)))
        return (
            w * radial + 2.0 * p1 * w * h + p2 * (square + 2.0 * w**2),
            h * radial + p1 * (square + 2.0 * h**2) + 2.0 * p2 * w * h,
        )

    def straight(self, picture: npt.NDArray[Pixel], outside: float = 0.0) -> npt.NDArray[Pixel]:
        """Return a picture (h, w) or (h, w, c) without distortion: each pixel from the nearest bent one.

        Depth must not be mixed from several pixels, so nothing is.

        Args:
            picture: as the camera took it.
            outside: what pixels get that the camera did not see.
        """
        if not self.bends:
            return picture
        rows, columns, inside = self._sources
        result = picture[rows, columns]
        result[~inside] = outside
        return result

    @cached_property
    def _sources(self) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], npt.NDArray[np.bool_]]:
        camera = self.camera
        w, h = self.bent(*camera.rays())
        columns, rows = np.rint(w * camera.fx + camera.cx), np.rint(h * camera.fy + camera.cy)
        inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
        return np.where(inside, rows, 0).astype(np.intp), np.where(inside, columns, 0).astype(np.intp), inside


_NO_NAME = ("", "None")
_BROWN = ("plumb_bob", "rational_polynomial", "Brown Conrady", "Modified Brown Conrady", "Inverse Brown Conrady")
"""RealSense's library projects by one formula in all three models of that name, to 0.02 px."""


def known(camera: Camera, bend: Sequence[float], model: str, where: str) -> Lens:
    """Return the lens that a file describes.

    Args:
        camera: the camera.
        bend: coefficients in the model's order.
        model: what the file calls the model of distortion.
        where: the file, for messages.

    Raises:
        InputError: where the lens bends lines and the model is not known.
    """
    found = Lens(camera, coefficients(bend))
    if found.bends and model not in _NO_NAME + _BROWN:
        raise InputError(f"{where}: its distortion model {model!r} is not known; record the rectified topic.")
    return found


def coefficients(values: Sequence[float]) -> tuple[float, ...]:
    """Return coefficients as numbers, without zeros at the end."""
    numbers = [float(value) for value in values]
    while numbers and numbers[-1] == 0.0:
        numbers.pop()
    return tuple(numbers)
