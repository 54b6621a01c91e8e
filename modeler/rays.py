"""From a segmented frame to the image that registration uses: smoothed surface points, local planes, silhouette."""

from dataclasses import dataclass

import numpy as np

from modeler.kernels import planes
from modeler.types import Frame, Plane, RayImage


@dataclass(frozen=True)
class Sensor:
    """Noise of the depth camera in ray coordinates (paper, section II), and how its images are smoothed."""

    sigma_wh: float = 0.002
    """Lateral noise in (w, h); the paper's value for the first Kinect."""
    sigma_r_m: float = 0.002
    """Noise along the ray in m, for a surface that faces the camera."""
    smoothing: float = 0.28
    """Radius of the ball in which planes are fitted, as a share of the geometric mean of noise and object's extent.

    Smoothing over a ball of radius r displaces a surface whose radius of curvature is about the extent by r² / extent,
    away from the camera, so that the image of a turning object lags behind it. With this radius the displacement is the
    same share of the noise, whatever the noise (method.md, eq. 1).
    """
    min_neighbours: float = 25.0
    """The ball grows until it holds about this many pixels of a surface that faces the camera."""
    correlation_px: float = 0.5
    """Correlation length of the sensor's noise in px, added to the ball's radius: depth cameras compare windows."""
    min_cosine: float = 0.35
    """Least cosine between normal and viewing ray: surface seen at a flatter angle gives no points."""
    max_silhouette_px: float = 60.0
    """Distance from the silhouette at which its transform is cut off."""

    def ray_image(self, frame: Frame, plane: Plane | None = None) -> RayImage:
        """Make a segmented frame ready for registration; without object pixels it has no points.

        Args:
            frame: with its mask; without one, every measured pixel is the object's.
            plane: the support plane, where one is seen.
        """
        camera = frame.camera
        depth_m = np.ascontiguousarray(frame.depth_m, dtype=np.float32)
        mask = (depth_m > 0) & (depth_m < np.inf)  # not NaN either
        if frame.mask is not None:
            mask &= frame.mask
        # Object pixels without depth still occlude: the silhouette is that of the whole mask.
        outline = mask if frame.mask is None else frame.mask
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        rows, columns = _places(mask)
        ball, sigma_inverse, sharing = self._smoothing(frame, rows, columns)
        cells = planes.local_planes(
            depth_m,
            mask,
            planes.silhouette_distance(outline, self.max_silhouette_px),
            intrinsics,
            ball,
            sigma_inverse,
        )
        points_m, normals, pixels, variance_m2 = planes.frontal_points(cells, mask, intrinsics, self.min_cosine)
        return RayImage(
            frame=frame,
            plane=plane,
            sigma_wh=self.sigma_wh,
            sigma_r_m=self.sigma_r_m,
            points_m=points_m,
            normals=normals,
            pixels=pixels,
            layers={"cells": cells, "variance_m2": variance_m2},
            sharing=sharing,
        )

    def _smoothing(
        self, frame: Frame, rows: np.ndarray, columns: np.ndarray
    ) -> tuple[tuple[float, int, int], float, float]:
        """Return how the object at given pixels is smoothed (method.md, eq. 1 and 2).

        Returns:
            Radius of the ball in m, in px at the nearest point, and the stride between its pixels; the least standard
            deviation of inverse depth (1/m); and the number of points that share the noise of a pixel.
        """
        if rows.size == 0:  # nothing to smooth
            return (0.0, 1, 1), 0.0, 1.0
        depth_m = frame.depth_m[rows, columns]
        nearest_m, middle_m = (float(value) for value in np.percentile(depth_m, [2, 50]))
        metres_per_px = middle_m / frame.camera.fx
        extent_m = metres_per_px * float(np.hypot(np.ptp(rows), np.ptp(columns)))
        density = rows.size / max(float(frame.mask.sum()) if frame.mask is not None else rows.size, 1.0)
        sparse_px = np.sqrt(self.min_neighbours / (np.pi * max(density, 0.01)))
        # method.md, eq. 1
        radius_m = max(self.smoothing * np.sqrt(self.sigma_r_m * extent_m), sparse_px * metres_per_px)
        reach_px = int(np.clip(np.ceil(radius_m * frame.camera.fx / nearest_m), 2, 16))
        # A stride of 2 px is enough where a wide window holds many pixels.
        enough = np.pi * reach_px**2 * density > 8.0 * self.min_neighbours
        ball = (radius_m, reach_px, 2 if reach_px > 4 and enough else 1)
        sharing = max(density * np.pi * (radius_m / metres_per_px + self.correlation_px) ** 2, 1.0)
        # A tenth of the sensor's noise: neighbouring pixels err alike, so that residuals understate it.
        return ball, 0.1 * self.sigma_r_m / middle_m**2, float(sharing)


def _places(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns (n,) of the pixels that a mask (h, w) holds."""
    top, bottom, left, right = planes.bounds(mask)
    rows, columns = np.nonzero(mask[top:bottom, left:right])
    return rows + top, columns + left
