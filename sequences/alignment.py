"""Colour from a camera beside the depth camera, brought to the depth camera's pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.types import Array, Camera
from sequences.lens import Lens

HIDDEN = 0.02
"""What lies farther than this share behind something in the colour camera's view is hidden from it."""


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
        """Return the colour (h, w, 3) of each depth pixel; black where there is no depth or no view of it.

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
        rows, columns, z = rows[inside], columns[inside], there[inside, 2]
        u, v = u[inside].astype(np.intp), v[inside].astype(np.intp)
        seen = self._unhidden(u, v, z)
        result = np.zeros((*depth_m.shape, 3), np.uint8)
        result[rows[seen], columns[seen]] = picture[v[seen], u[seen]]
        return result

    def _unhidden(self, u: npt.NDArray[np.intp], v: npt.NDArray[np.intp], z: Array) -> npt.NDArray[np.bool_]:
        """Return which points have nothing nearer in their cell, which is as large as a depth pixel or two."""
        cell = int(np.ceil(2.0 * max(1.0, self.colour.camera.fx / self.depth.fx)))
        nearest = np.full((self.colour.camera.height // cell + 1, self.colour.camera.width // cell + 1), np.inf)
        np.minimum.at(nearest, (v // cell, u // cell), z)
        return z <= nearest[v // cell, u // cell] * (1.0 + HIDDEN)
