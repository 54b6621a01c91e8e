"""Surface points of a view for the likelihood, their layout, and their noise near silhouettes and by pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from modeler.kernels import planes, point_to_plane
from modeler.types import Array, Camera, RayImage

IntArray = npt.NDArray[np.int64]

OWN_RIM = 9  # column of `point_rows`: the weight in the view of the points


def spread_points(view: RayImage, count: int, rng: np.random.Generator) -> IntArray:
    """Return the indices of `count` surface points, or of all if fewer, evenly spread over the image.

    They are taken along a space-filling curve, so that every stride through them is again evenly spread and results
    depend little on the choice of points.
    """
    total = len(view.points_m)
    stride = max(total / count, 1.0)
    picks = np.arange(min(count, total)) * stride + rng.random() * stride
    return view.along_curve[np.minimum(picks.astype(np.int64), total - 1)]


def points_of(view: RayImage, chosen: IntArray) -> Array:
    """Return the `point_rows` of a view's surface points with these indices."""
    variances_m2 = np.asarray(view.layers["variance_m2"][chosen], dtype=np.float64)
    rows, columns = view.pixels[chosen].T
    rims = np.asarray(view.layers["cells"][rows, columns, planes.RIM], dtype=np.float64)
    return point_rows(view.points_m[chosen], view.normals[chosen], variances_m2, view.frame.camera, rims)


def point_rows(
    points_m: Array, normals: Array, variances_m2: Array, camera: Camera, rims: Array | None = None
) -> Array:
    """Return points (n, 10) for a `DirectedLikelihood`.

    Args:
        points_m: (n, 3) in the frame of the view that shows them.
        normals: (n, 3) unit normals.
        variances_m2: (n,) along the normals.
        camera: of that view.
        rims: (n,) weights of errors near the silhouette; 0 if not given.
    """
    pixels = points_m[:, :2] / points_m[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    rims = np.zeros(len(points_m)) if rims is None else rims
    return np.hstack([points_m, normals, variances_m2[:, None], pixels, rims[:, None]])


def by_motion(arms: Array, slopes: Array) -> Array:
    """Return derivatives (n, 6) by ξ from derivatives (n, 3) by the positions (n, 3) of points about the centre."""
    (x, y, z), (a, b, c) = arms.T, slopes.T
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c], axis=1)


_SIGNIFICANT = 2.0  # standard errors above which errors near silhouettes are part of the model


def significant_variances(sums: Array, independent: float) -> tuple[float, float]:
    """Return b² and the variance near silhouettes in m²; 0 for the latter within two of its standard errors.

    Both are those of matching surface, from squared residuals (method, eq. 4.7 and 4.8).

    Args:
        sums: (3, 3), see `point_likelihood.residual_excess`.
        independent: number of independent squares among those of the matches.
    """
    (aa, ab, a), (_, bb, b), (_, _, square) = sums.tolist()
    surface_m2, rim_m2 = nonnegative_solution(aa, ab, bb, a, b)
    determinant = max(aa * bb - ab * ab, 1e-9 * aa * bb)
    scatter = max(square - surface_m2 * a - rim_m2 * b, 0.0) / aa  # aa is about the number of matches
    if rim_m2**2 * determinant > _SIGNIFICANT**2 * scatter * aa * max(aa / independent, 1.0):
        return surface_m2, rim_m2
    return max(a, 0.0) / aa, 0.0


def nonnegative_solution(aa: float, ab: float, bb: float, a: float, b: float) -> tuple[float, float]:
    """Return x, y ≥ 0 of least squares, from the normal equations aa x + ab y = a and ab x + bb y = b."""
    determinant = aa * bb - ab * ab
    if determinant > 1e-9 * aa * bb:
        x, y = (bb * a - ab * b) / determinant, (aa * b - ab * a) / determinant
        if x >= 0.0 and y >= 0.0:
            return x, y
    x, y = max(a, 0.0) / aa, max(b, 0.0) / max(bb, 1e-300)  # one of them is 0: that which explains less
    return (x, 0.0) if a * x >= b * y else (0.0, y)


@dataclass(frozen=True)
class FixedPattern:
    """Fixed-pattern noise: errors that a pixel repeats from frame to frame, common to two views (method, eq. 4.9).

    Errors of the camera stay in place while the object turns, as shading does in colours. Two views then agree best at
    zero motion: a smooth body of revolution would be estimated not to have turned, with a small covariance.
    """

    share: float = 0.0
    """Fraction χ of the variance that is common to both at the same pixel."""
    area_px: float = RayImage.error_area_px
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
