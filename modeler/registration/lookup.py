"""The points of one view, and the image of the other in which they are looked up."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modeler.kernels import matching
from modeler.kernels import visibility as kernel
from modeler.kernels.projection import Projection
from modeler.types import Array, RayImage

_OUTLINE = 0.5
"""Error of a silhouette as a share of the lateral noise of its pixels, each of which errs by itself."""
_SPARED = 0.25
"""Beside it so much is no one's, likewise: points lie a pixel or more inside, since the rim has no plane."""
FACING = np.array([0.1, 0.35, 0.35, 0.6], dtype=np.float32)  # see `Projection`


@dataclass(frozen=True, eq=False)
class DirectedLikelihood:
    """One direction of the comparison of two views: p(points of one | image of the other, pose)."""

    points: Array
    """(n, 7) position in m, unit normal, variance along the normal in m²."""
    image: RayImage
    """The view in which the points are looked up."""
    surface_m: float
    """Least error of a smoothed surface in m."""
    hidden_share: float
    """Share of points that face the camera and are hidden by another part of the object."""
    max_point_cost: float
    """Most that one point may cost (nats)."""
    normal_cost: float
    """Cost (nats) of normals at right angles."""
    measured_share: float
    """Share of pixels around the surface that carry a measurement."""

    def verdicts(self, pose: Array) -> np.ndarray:
        """Return the verdict (n,) of `kernels.visibility` on each point under one pose (12,)."""
        return kernel.classify(pose, self.projection(), self.model(0.0))

    def excess(self, pose: Array, blur_m: float) -> tuple[float, int]:
        """Return the sum in m² of squared distances of matches beyond their variances under a pose (12,); how many."""
        return kernel.excess(pose, self.projection(), float(np.hypot(blur_m, self.surface_m)))

    def misfits(self, pose: Array, blur_m: float) -> Array:
        """Return what each match under one pose (12,) loses to distance and normals (nats), (k,)."""
        found = self.matches(pose, float(np.hypot(blur_m, self.surface_m)))
        found = found[found[:, matching.WEIGHT] > 0.0]
        variance = found[:, matching.FACING] / found[:, matching.WEIGHT]
        agreement = np.sum(found[:, matching.OWN] * found[:, matching.OTHER], axis=1)
        return 0.5 * found[:, matching.RESIDUAL] ** 2 / variance + self.normal_cost * (1.0 - agreement)

    def matches(self, pose: Array, surface_m: float) -> Array:
        """Return what each point finds under one pose (12,): `kernels.matching.matches`."""
        return matching.matches(pose, self.projection(), surface_m)

    def projection(self, stride: int = 1) -> Projection:
        """Return what every `stride`-th point meets, as kernels take it."""
        if stride not in self._sights:
            columns = np.ascontiguousarray(self._columns[:, ::stride])
            self._sights[stride] = Projection(columns, self._cells, self._camera, FACING)
        return self._sights[stride]

    def model(self, blur_m: float, typical_misfit: float = 0.5) -> kernel.LikelihoodParameters:
        """Return what the likelihood takes for granted where surfaces are blurred by so many m.

        Typical is what a good match loses to its misfit (nats), see `misfits`.
        """
        fx = self.image.frame.camera.fx
        lateral_px = max(self.image.sigma_wh * fx, 1.0)
        return kernel.LikelihoodParameters(
            blur_m=np.float32(np.hypot(blur_m, self.surface_m)),
            silhouette_px=np.float32(_OUTLINE * lateral_px + blur_m * fx / self._distance_m),
            dead_band_px=np.float32(_SPARED * lateral_px),
            clearance_m=np.float32(3.0 * self.image.sigma_r_m),
            max_point_cost=np.float32(self.max_point_cost),
            normal_cost=np.float32(self.normal_cost),
            unmeasured_gain=np.float32(np.log(max(self.hidden_share, 1.0 - self.measured_share))),
            typical_misfit=np.float32(typical_misfit),
            table=self._table,
        )

    @cached_property
    def _sights(self) -> dict[int, Projection]:
        """By stride: what was made once."""
        return {}

    @cached_property
    def _columns(self) -> np.ndarray:
        return np.ascontiguousarray(self.points.T, dtype=np.float32)

    @cached_property
    def _cells(self) -> np.ndarray:
        cells = self.image.layers["cells"]
        return cells.reshape(-1, cells.shape[-1])

    @cached_property
    def _camera(self) -> np.ndarray:
        camera = self.image.frame.camera
        return np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height], dtype=np.float32)

    @cached_property
    def _distance_m(self) -> float:
        return max(float(np.median(self.points[:, 2])), 1e-3)

    @cached_property
    def _table(self) -> np.ndarray:
        return kernel.match_table(self.hidden_share)
