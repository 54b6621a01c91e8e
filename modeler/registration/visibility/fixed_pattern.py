"""Fixed-pattern noise: errors that a pixel repeats from frame to frame (method, eq. 4.9).

Errors of the camera stay in place while the object turns, as shading does in colours. Two views then agree best at zero
motion: a smooth body of revolution would be estimated not to have turned, with a small covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from modeler.kernels import point_to_plane
from modeler.types import Array, Camera, RayImage


@final
@dataclass(frozen=True)
class FixedPattern:
    """Range errors common to two views."""

    share: float = 0.0
    """Fraction χ of the variance that is common to both at the same pixel."""
    area_px: float = 1.0
    """Integral of the errors' autocorrelation over the image in px², smoothing included."""

    @classmethod
    def between(cls, source: RayImage, target: RayImage) -> FixedPattern:
        """Return the common errors of two views of one camera."""
        share = np.sqrt(source.pattern_share * target.pattern_share)
        return cls(float(share), 0.5 * (source.error_area_px + target.error_area_px))

    @property
    def per_square_px(self) -> float:
        """1/R², R the shift in px beyond which errors are independent."""
        return float(np.pi / (3.0 * self.area_px))

    def packed(self) -> np.ndarray:
        """Return χ and 1/R² (2,) for kernels."""
        return np.array([self.share, self.per_square_px], dtype=np.float32)

    def common(self, matches: Array) -> Array:
        """Return c (n,), the fraction of the variance of matches (n, 15) that is common to both views."""
        return self.share * self._correlation(matches[:, point_to_plane.SHIFT]) ** 2

    def derivatives(self, matches: Array, camera: Camera) -> tuple[Array, Array]:
        """Return first and second derivatives of f c / 2 (eq. 4.9) by the positions of matches.

        Args:
            matches: (n, 15) of `point_to_plane.matches`.
            camera: in which they were looked up.

        Returns:
            (n, 3) in 1/m and (n, 3, 3) in 1/m², with the projection linearised.
        """
        position, shifts = matches[:, point_to_plane.POSITION], matches[:, point_to_plane.SHIFT]
        focal, depth_m = np.array([camera.fx, camera.fy]), position[:, 2:]
        by_position = np.zeros((len(matches), 2, 3))
        by_position[:, [0, 1], [0, 1]] = focal / depth_m
        by_position[:, :, 2] = -focal * position[:, :2] / depth_m**2
        correlation, per_square_px = self._correlation(shifts), self.per_square_px
        level = 2.0 * self.share * matches[:, point_to_plane.FACING_WEIGHT] * per_square_px
        slopes = -(level * correlation)[:, None] * shifts
        along = 2.0 * per_square_px * (correlation > 0.0)[:, None, None] * shifts[:, :, None] * shifts[:, None, :]
        curvatures = level[:, None, None] * (along - correlation[:, None, None] * np.eye(2))
        turned = by_position.swapaxes(1, 2)
        return (turned @ slopes[:, :, None])[:, :, 0], turned @ curvatures @ by_position

    def _correlation(self, shifts_px: Array) -> Array:
        return np.maximum(1.0 - self.per_square_px * np.sum(shifts_px**2, axis=1), 0.0)
