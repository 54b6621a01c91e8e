"""The likelihood of the points of one view, looked up in the other."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING

import numpy as np

from modeler.kernels import point_likelihood, point_to_plane
from modeler.kernels.point_likelihood import LikelihoodParameters, Projection
from modeler.registration.visibility.points import OWN_RIM, FixedPattern
from modeler.significance import SIGMAS
from modeler.types import Array, RayImage
from modeler.views import Sensor

if TYPE_CHECKING:
    from modeler.registration.visibility.likelihood import VisibilityLikelihood

_SILHOUETTE_NOISE = 0.5  # error of a silhouette as a fraction of its pixels' lateral noise, which is independent
_RAMP = 0.25  # width of the ramps of f and g below and above the cosine from which on ranges are reliable
_RELIABLE = Sensor.min_cosine
_COSINES = np.array([_RELIABLE - _RAMP, _RELIABLE, _RELIABLE, _RELIABLE + _RAMP], dtype=np.float32)  # see `Projection`
# Share of unmeasured pixels near the object above which a camera measures steep surface instead of filling holes, which
# replaces surface at cosines below 0.35 by what is behind it: measured up to 46 % of it in captures without one,
# 18 % with two or three in 1,000, 7 % with five, 2 % with more. With 0.005, models by time of flight were wrong.
_FILLED = 0.001
MISFIT = 0.5  # mean of r² / 2τ² if variances are right


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
