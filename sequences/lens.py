"""Lens distortion, and the alignment of colour with depth."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from modeler import se3
from modeler.types import Array, Camera, InputError

Pixel = TypeVar("Pixel", np.bool_, np.uint8, np.uint16, np.float32)


@dataclass(frozen=True)
class Lens:
    """A camera with radial and tangential distortion, with the coefficients of ROS, OpenCV and the Kinect.

    Depth must not be mixed from several pixels, and undistorting by the nearest one takes a dozen lines; a library of
    lenses, such as OpenCV with its 50 MB, would save none of the rest here.
    """

    camera: Camera
    """Intrinsics, of the distorted and the undistorted image alike."""
    coefficients: tuple[float, ...]
    """k1 k2 p1 p2 k3 (`plumb_bob`), and k4 k5 k6 for `rational_polynomial`; k1 k2 k3 k4 of a fisheye."""
    fisheye: bool = False
    """Whether the coefficients are of the angle from the optical axis (Kannala and Brandt 2006; ROS `equidistant`)."""

    @property
    def is_distorted(self) -> bool:
        """Whether any coefficient is not zero."""
        return self.fisheye or any(abs(value) > 1e-9 for value in self.coefficients)

    def distort(self, w: Array, h: Array) -> tuple[Array, Array]:
        """Return where rays (w, h) = (x/z, y/z) of any shape appear as rays of a camera without distortion."""
        if self.fisheye:
            k1, k2, k3, k4 = (*self.coefficients, *([0.0] * 4))[:4]
            radius = np.hypot(w, h)
            angle = np.arctan(radius)
            square = angle**2
            bent = angle * (1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
            scale = np.divide(bent, radius, out=np.ones_like(radius), where=radius > 1e-12)
            return w * scale, h * scale
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.coefficients, *([0.0] * 8))[:8]
        square = w**2 + h**2
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        radial = radial / (1.0 + square * (k4 + square * (k5 + square * k6)))
        return (
            w * radial + 2.0 * p1 * w * h + p2 * (square + 2.0 * w**2),
            h * radial + p1 * (square + 2.0 * h**2) + 2.0 * p2 * w * h,
        )

    def undistort(self, image: npt.NDArray[Pixel], outside: float = 0.0) -> npt.NDArray[Pixel]:
        """Undistort an image (h, w) or (h, w, c): each pixel is the nearest distorted one.

        Depth must not be mixed from several pixels, so nothing is.

        Args:
            image: as the camera took it.
            outside: value of pixels that the camera did not see.
        """
        if not self.is_distorted:
            return image
        rows, columns, inside = self._sources
        result = image[rows, columns]
        result[~inside] = outside
        return result

    @cached_property
    def _sources(self) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], npt.NDArray[np.bool_]]:
        camera = self.camera
        w, h = self.distort(*camera.rays())
        columns, rows = np.rint(w * camera.fx + camera.cx), np.rint(h * camera.fy + camera.cy)
        inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
        return np.where(inside, rows, 0).astype(np.intp), np.where(inside, columns, 0).astype(np.intp), inside


_BROWN = ("plumb_bob", "rational_polynomial", "brown_conrady", "modified_brown_conrady", "inverse_brown_conrady",
          "radtan", "radial_tangential", "opencv", "pinhole", "perspective", "none", "")  # fmt: skip
"""RealSense's library projects by one formula in its three models of Brown and Conrady, to 0.02 px."""
_FISHEYE = ("equidistant", "fisheye", "opencv_fisheye", "kannala_brandt", "kannala_brandt4", "equi")


def lens_of_model(camera: Camera, distortion: Sequence[float], model: str, where: str) -> Lens:
    """Return the lens that a file describes."""
    values, name = coefficients(distortion), re.sub(r"[\s-]+", "_", model.strip().lower())
    if name in _FISHEYE and len(values) <= 4:
        return Lens(camera, values, fisheye=True)
    found = Lens(camera, values)
    # Thin prisms and tilted sensors are not modelled.
    if found.is_distorted and (name not in _BROWN or len(values) > 8):
        raise InputError(
            f"{where}: its distortion model {model!r} with {len(values)} coefficients is not known; "
            "use rectified images."
        )
    return found


def coefficients(values: Sequence[float]) -> tuple[float, ...]:
    """Return coefficients as numbers, without zeros at the end."""
    numbers = [float(value) for value in values]
    while numbers and numbers[-1] == 0.0:
        numbers.pop()
    return tuple(numbers)


STRIDE = 3  # stride over the visible points in that search


@dataclass(frozen=True, eq=False)
class Alignment:
    """Two cameras that are fixed to each other."""

    depth: Camera
    """The depth camera, its distortion taken out."""
    colour: Lens
    """The colour camera."""
    colour_from_depth: Array
    """(4, 4) in m."""

    def align(self, depth_m: npt.NDArray[np.float32], image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return the colour (h, w, 3) of each depth pixel; black where there is no depth.

        Surface that the colour camera does not see takes the colour of the nearest visible surface, if that is near.

        Args:
            depth_m: (h, w) of the depth camera, NaN where nothing was measured.
            image: (h', w', 3) as the colour camera took it.
        """
        rays = self.depth.rays()
        rows, columns = np.nonzero(np.isfinite(depth_m) & (depth_m > 0.0))
        z = depth_m[rows, columns].astype(np.float64)
        points = np.stack([rays[0][rows, columns] * z, rays[1][rows, columns] * z, z], axis=1)
        there = se3.transform(self.colour_from_depth, points)
        ahead = there[:, 2] > 1e-6
        rows, columns, there = rows[ahead], columns[ahead], there[ahead]
        w, h = self.colour.distort(there[:, 0] / there[:, 2], there[:, 1] / there[:, 2])
        camera = self.colour.camera
        u, v = np.rint(w * camera.fx + camera.cx), np.rint(h * camera.fy + camera.cy)
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        columns_there, rows_there = np.where(inside, u, 0).astype(np.intp), np.where(inside, v, 0).astype(np.intp)
        seen = inside.copy()
        seen[inside] = self._visible(columns_there[inside], rows_there[inside], there[inside, 2])
        found = np.zeros((len(rows), 3), np.uint8)
        found[seen] = image[rows_there[seen], columns_there[seen]]
        found[~seen] = _nearest_colours(there, seen, found)
        result = np.zeros((*depth_m.shape, 3), np.uint8)
        result[rows, columns] = found
        return result

    def _visible(self, u: npt.NDArray[np.intp], v: npt.NDArray[np.intp], z: Array) -> npt.NDArray[np.bool_]:
        """Return which points have nothing nearer in their cell, which is as large as a depth pixel or two."""
        cell = int(np.ceil(2.0 * max(1.0, self.colour.camera.fx / self.depth.fx)))
        nearest = np.full((self.colour.camera.height // cell + 1, self.colour.camera.width // cell + 1), np.inf)
        np.minimum.at(nearest, (v // cell, u // cell), z)
        return z <= nearest[v // cell, u // cell] * (1.0 + 0.02)


def _nearest_colours(
    points_m: Array, seen: npt.NDArray[np.bool_], colours: npt.NDArray[np.uint8]
) -> npt.NDArray[np.uint8]:
    """Return for points (n, 3) that are not seen the colour (m, 3) of the nearest that is; black where none is near."""
    lenders = np.flatnonzero(seen)[::STRIDE]
    if not lenders.size or seen.all():
        return np.zeros((np.count_nonzero(~seen), 3), np.uint8)
    found = KDTree(points_m[lenders]).query(points_m[~seen], distance_upper_bound=0.02)  # m
    distance_m, places = np.asarray(found[0]), np.asarray(found[1])
    near = np.isfinite(distance_m)
    borrowed = np.zeros((len(places), 3), np.uint8)
    borrowed[near] = colours[lenders[places[near]]]
    return borrowed
