"""Colour from a camera beside the depth camera, brought to the depth camera's pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from modeler import se3
from modeler.types import Array, Camera
from sequences.lens import Lens

HIDDEN = 0.02
"""What lies farther than this share behind something in the colour camera's view is hidden from it."""

BORROW_M = 0.02
"""What the colour camera does not see takes the colour of what it sees at most so far away."""
THIN = 3
"""One in so many points may lend its colour."""


@final
@dataclass(frozen=True, eq=False)
class Alignment:
    """Two cameras that are fixed to each other."""

    depth: Camera
    """The depth camera, its distortion taken out."""
    colour: Lens
    """The colour camera."""
    colour_from_depth: Array
    """(4, 4) in m."""

    def aligned(self, depth_m: npt.NDArray[np.float32], picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return the colour (h, w, 3) of each depth pixel; black where there is no depth.

        What the colour camera does not see takes the colour of the nearest surface that it sees, if that is near.

        Args:
            depth_m: (h, w) of the depth camera, NaN where nothing was measured.
            picture: (h', w', 3) as the colour camera took it.
        """
        rays = self.depth.rays()
        rows, columns = np.nonzero(np.isfinite(depth_m) & (depth_m > 0.0))
        z = depth_m[rows, columns].astype(np.float64)
        points = np.stack([rays[0][rows, columns] * z, rays[1][rows, columns] * z, z], axis=1)
        there = se3.transform(self.colour_from_depth, points)
        ahead = there[:, 2] > 1e-6
        rows, columns, there = rows[ahead], columns[ahead], there[ahead]
        w, h = self.colour.bent(there[:, 0] / there[:, 2], there[:, 1] / there[:, 2])
        camera = self.colour.camera
        u, v = np.rint(w * camera.fx + camera.cx), np.rint(h * camera.fy + camera.cy)
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        columns_there, rows_there = np.where(inside, u, 0).astype(np.intp), np.where(inside, v, 0).astype(np.intp)
        seen = inside.copy()
        seen[inside] = self._unhidden(columns_there[inside], rows_there[inside], there[inside, 2])
        found = np.zeros((len(rows), 3), np.uint8)
        found[seen] = picture[rows_there[seen], columns_there[seen]]
        found[~seen] = _borrowed(there, seen, found)
        result = np.zeros((*depth_m.shape, 3), np.uint8)
        result[rows, columns] = found
        return result

    def _unhidden(self, u: npt.NDArray[np.intp], v: npt.NDArray[np.intp], z: Array) -> npt.NDArray[np.bool_]:
        """Return which points have nothing nearer in their cell, which is as large as a depth pixel or two."""
        cell = int(np.ceil(2.0 * max(1.0, self.colour.camera.fx / self.depth.fx)))
        nearest = np.full((self.colour.camera.height // cell + 1, self.colour.camera.width // cell + 1), np.inf)
        np.minimum.at(nearest, (v // cell, u // cell), z)
        return z <= nearest[v // cell, u // cell] * (1.0 + HIDDEN)


def _borrowed(points_m: Array, seen: npt.NDArray[np.bool_], colours: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return for points (n, 3) that are not seen the colour (m, 3) of the nearest that is; black where none is near."""
    lenders = np.flatnonzero(seen)[::THIN]
    if not lenders.size or seen.all():
        return np.zeros((np.count_nonzero(~seen), 3), np.uint8)
    found = KDTree(points_m[lenders]).query(points_m[~seen], distance_upper_bound=BORROW_M)
    distance_m, places = np.asarray(found[0]), np.asarray(found[1])
    near = np.isfinite(distance_m)
    borrowed = np.zeros((len(places), 3), np.uint8)
    borrowed[near] = colours[lenders[places[near]]]
    return borrowed
