"""The likelihood of the points of one view, looked up in the other: the points, their noise, and their parameters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from modeler.kernels import planes, point_likelihood, point_to_plane
from modeler.kernels.point_likelihood import LikelihoodParameters, Projection
from modeler.significance import SIGMAS
from modeler.types import Array, Camera, RayImage
from modeler.views import Sensor

if TYPE_CHECKING:
    from modeler.registration.visibility.likelihood import VisibilityLikelihood

IntArray = npt.NDArray[np.int64]

OWN_RIM = 9  # column of `point_rows`: the weight in the view of the points
_SILHOUETTE_NOISE = 0.5  # error of a silhouette as a fraction of its pixels' lateral noise, which is independent
_RAMP = 0.25
"""Width of the ramps of f and g below and above the cosine from which on ranges are reliable; with 0.125 and 0.5, 11
pairs are off by 0.156° and 0.186° in the median, with 0.25 by 0.151°."""
_RELIABLE = Sensor.min_cosine
_COSINES = np.array([_RELIABLE - _RAMP, _RELIABLE, _RELIABLE, _RELIABLE + _RAMP], dtype=np.float32)  # see `Projection`
# Share of unmeasured pixels near the object above which a camera measures steep surface instead of filling holes, which
# replaces surface at cosines below 0.35 by what is behind it: measured up to 46 % of it in captures without one,
# 18 % with two or three in 1,000, 7 % with five, 2 % with more. With 0.005, models by time of flight were wrong.
_FILLED = 0.001
MISFIT = 0.5  # mean of r² / 2τ² if variances are right


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


@dataclass(frozen=True, eq=False)
class DirectedLikelihood:
    """One direction: p(points of one view | image of the other, pose)."""

    model: VisibilityLikelihood
    points: Array
    """(n, 10), see `point_rows`: position in m, unit normal, variance along the normal in m², column and row in px in
    its own view, and weight of errors near its silhouette."""
    image: RayImage
    """The view in which the points are looked up."""
    size_m: float
    """Size of the object, see `PairLikelihood`."""
    pattern: FixedPattern
    """Errors common to both views."""
    rim_m: float = 0.0
    """Standard deviation of depth errors near silhouettes in m (method, eq. 4.8)."""

    def classify(self, pose: Array, blur_m: float = 0.0) -> np.ndarray:
        """Return the class (n,) of each point under one pose (12,): `point_likelihood.classify`."""
        return point_likelihood.classify(pose, self.projection(1), self.parameters(blur_m))

    def residual_excess(self, pose: Array, blur_m: float) -> Array:
        """Return the sums (3, 3) for eq. 4.7 and 4.8 of the method over matches under a pose (12,)."""
        least_m = float(np.hypot(blur_m, self._min_blur_m))
        return point_likelihood.residual_excess(pose, self.projection(1), self.points[:, OWN_RIM], least_m)

    def misfits(self, pose: Array, blur_m: float) -> Array:
        """Return the misfit (k,) in nats of each match under one pose (12,) in distance and normals."""
        found = self.matches(pose, float(np.hypot(blur_m, self._min_blur_m)))
        found = found[found[:, point_to_plane.WEIGHT] > 0.0]
        variance = found[:, point_to_plane.FACING_WEIGHT] / found[:, point_to_plane.WEIGHT]
        agreement = np.sum(found[:, point_to_plane.OWN] * found[:, point_to_plane.OTHER], axis=1)
        squares = found[:, point_to_plane.RESIDUAL] ** 2 / variance + self.pattern.common(found)
        return 0.5 * squares + self.model.normal_cost * (1.0 - agreement)

    def matches(self, pose: Array, blur_m: float) -> Array:
        """Return the match of each point under one pose (12,): `point_to_plane.matches`."""
        return point_to_plane.matches(pose, self.projection(1), blur_m)

    def projection(self, stride: int) -> Projection:
        """Return every `stride`-th point and the other view's cells for kernels."""
        if stride not in self._projections:
            columns = np.ascontiguousarray(self._columns[:, ::stride])
            self._projections[stride] = Projection(
                columns, self._cells, self._camera, _COSINES, self.pattern.packed(), np.float32(self.rim_m**2)
            )
        return self._projections[stride]

    def parameters(self, blur_m: float, typical_misfit: float = MISFIT) -> LikelihoodParameters:
        """Return the parameters of the kernel for surfaces with a blur, see the method, eq. 4.2 to 4.5."""
        if (blur_m, typical_misfit) not in self._parameters:
            self._parameters[blur_m, typical_misfit] = self._parameters_of(blur_m, typical_misfit)
        return self._parameters[blur_m, typical_misfit]

    def _parameters_of(self, blur_m: float, typical_misfit: float) -> LikelihoodParameters:
        fx = self.image.frame.camera.fx
        lateral_px = max(self.image.sigma_wh * fx, 1.0)
        unmeasured, most = 1.0 - self.image.measured_share, self.model.max_point_cost
        missing = max(self.model.hidden_share, unmeasured) if self.model.holes else 1.0
        steep = most * min(unmeasured / _FILLED, 1.0)
        return LikelihoodParameters(
            blur_m=np.float32(np.hypot(blur_m, self._min_blur_m)),
            silhouette_px=np.float32(_SILHOUETTE_NOISE * lateral_px + blur_m * fx / self._distance_m),
            clearance_m=np.float32(SIGMAS * self.image.sigma_r_m),
            max_point_cost=np.float32(most),
            max_steep_cost=np.float32(steep),
            normal_cost=np.float32(self.model.normal_cost),
            unmeasured_gain=np.float32(np.log(missing)),
            typical_misfit=np.float32(typical_misfit),
            support=self._support(blur_m),
            table=_match_table(self.model.hidden_share),
        )

    @cached_property
    def _projections(self) -> dict[int, Projection]:
        """Cached projections by stride."""
        return {}

    @cached_property
    def _parameters(self) -> dict[tuple[float, float], LikelihoodParameters]:
        """Cached parameters: a mode is sampled with the same in every round."""
        return {}

    @cached_property
    def _columns(self) -> np.ndarray:
        columns = np.ascontiguousarray(self.points.T[:OWN_RIM], dtype=np.float32)
        columns[point_likelihood.VARIANCE_M2] += self.rim_m**2 * self.points[:, OWN_RIM] ** 2
        return columns

    @cached_property
    def _cells(self) -> np.ndarray:
        cells = self.image.layers["cells"]
        return cells.reshape(-1, cells.shape[-1])

    @cached_property
    def _camera(self) -> np.ndarray:
        camera = self.image.frame.camera
        return np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height], dtype=np.float32)

    @cached_property
    def _min_blur_m(self) -> float:
        """Least noise of matching surfaces."""
        detail_m = self.model.surface_detail * self.size_m
        return float(np.hypot(detail_m, self.model.surface_noise * self.image.sigma_r_m))

    def _support(self, blur_m: float) -> np.ndarray:
        """Return the support plane for the kernel, for surfaces with a blur (method, eq. 4.5)."""
        plane = self.image.plane
        if plane is None:
            return np.zeros(5, dtype=np.float32)
        sigma_m = np.linalg.norm([plane.sigma_offset_m, plane.sigma_tilt_rad * self.size_m, blur_m, self._min_blur_m])
        return np.array([*plane.normal, plane.offset_m, 1.0 / sigma_m], dtype=np.float32)

    @cached_property
    def _distance_m(self) -> float:
        return max(float(np.median(self.points[:, 2])), 1e-3)


@cache
def _match_table(hidden_share: float) -> np.ndarray:
    """Return `match_table`, the same array for all pairs, so that a GPU holds it once."""
    return point_likelihood.match_table(hidden_share)
