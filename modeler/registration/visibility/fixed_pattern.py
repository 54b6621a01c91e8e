"""Fixed-pattern noise: errors that a pixel repeats from frame to frame (method.md, eq. 27).

What belongs to the camera stays in place while the object turns, as shading does in colours. Two views then agree best
where nothing has moved, and smooth bodies of revolution seem not to have turned, with much certainty.
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
    """What the errors of two views have in common."""

    share: float = 0.0
    """Share χ of their variance that both have at the same pixel."""
    area_px: float = 1.0
    """Integral of their autocorrelation over the image in px, smoothing included."""

    @classmethod
    def between(cls, source: RayImage, target: RayImage) -> FixedPattern:
        """Return what two views of one camera have in common."""
        share = np.sqrt(source.pattern_share * target.pattern_share)
        return cls(float(share), 0.5 * (source.error_area_px + target.error_area_px))

    @property
    def per_square_px(self) -> float:
        """1/R², R the shift in px from which on nothing is in common."""
        return float(np.pi / (3.0 * self.area_px))

    def packed(self) -> np.ndarray:
        """Return share and 1/R² (2,), as kernels take them."""
        return np.array([self.share, self.per_square_px], dtype=np.float32)

    def common(self, matches: Array) -> Array:
        """Return which share (n,) of the variance of matches (n, 14) both views have in common."""
        return self.share * self._alike(matches[:, point_to_plane.SHIFT]) ** 2

    def derivatives(self, matches: Array, camera: Camera) -> tuple[Array, Array]:
        """Return first and second derivatives of what is counted for the pattern by the positions of matches.

        Args:
            matches: (n, 14) of `point_to_plane.matches`; each counts by f.
            camera: in which they were looked up.

        Returns:
            (n, 3) in 1/m and (n, 3, 3) in 1/m². That pixels move by the square of small motions, too, is left out.
        """
        position, shifts = matches[:, point_to_plane.POSITION], matches[:, point_to_plane.SHIFT]
        focal, depth_m = np.array([camera.fx, camera.fy]), position[:, 2:]
        by_position = np.zeros((len(matches), 2, 3))
        by_position[:, [0, 1], [0, 1]] = focal / depth_m
        by_position[:, :, 2] = -focal * position[:, :2] / depth_m**2
        alike, per_square_px = self._alike(shifts), self.per_square_px
        level = 2.0 * self.share * matches[:, point_to_plane.FACING_WEIGHT] * per_square_px
        slopes = -(level * alike)[:, None] * shifts
        along = 2.0 * per_square_px * (alike > 0.0)[:, None, None] * shifts[:, :, None] * shifts[:, None, :]
        curvatures = level[:, None, None] * (along - alike[:, None, None] * np.eye(2))
        turned = by_position.swapaxes(1, 2)
        return (turned @ slopes[:, :, None])[:, :, 0], turned @ curvatures @ by_position

    def _alike(self, shifts_px: Array) -> Array:
        return np.maximum(1.0 - self.per_square_px * np.sum(shifts_px**2, axis=1), 0.0)
