"""The points of one view, and the image of the other in which they are looked up."""

from dataclasses import dataclass

import numpy as np

from modeler.kernels import matching
from modeler.kernels import visibility as kernel
from modeler.types import Array, RayImage

FACING = (0.1, 0.35)  # cosines at which a point begins to face a camera and fully does


@dataclass(frozen=True, eq=False)
class Lookup:
    """One direction of the comparison of two views: p(points of one | image of the other, pose)."""

    points: Array
    """(n, 7) position in m, unit normal, variance along the normal in m²."""
    image: RayImage
    """The view in which the points are looked up."""
    surface_m: float
    """Least error of a smoothed surface in m."""
    hidden_share: float
    """Share of points that face the camera and are hidden by another part of the object."""
    worst: float
    """Most that one point may cost (nats)."""
    bend: float
    """Cost (nats) of normals at right angles."""
    measured_share: float
    """Share of pixels around the surface that carry a measurement."""

    def log_likelihoods(self, poses: Array, blur_m: float, *, stride: int, typical: float) -> Array:
        """Return log-likelihood and number of explained points (m, 2) of poses (m, 12) over every `stride`-th point.

        Typical is what a good match loses to its misfit (nats), see `misfits`.
        """
        columns, table = self._columns(stride), kernel.match_table(self.hidden_share)
        model = self._model(blur_m, typical)
        return kernel.log_likelihoods(poses, columns, self._cells, self._intrinsics, model, table)

    def verdicts(self, pose: Array) -> np.ndarray:
        """Return the verdict (n,) of `kernels.visibility` on each point under one pose (12,)."""
        return kernel.classify(pose, self._columns(), self._cells, self._intrinsics, self._model(0.0))

    def matched_residuals(self, pose: Array, blur_m: float) -> Array:
        """Return squared distances (k,) in m² of matching points beyond their own variance, under one pose (12,)."""
        return kernel.matched_residuals(pose, self._columns(), self._cells, self._intrinsics, self._model(blur_m))

    def misfits(self, pose: Array, blur_m: float) -> Array:
        """Return what each match under one pose (12,) loses to distance and normals (nats), (k,)."""
        surface_m = float(np.hypot(blur_m, self.surface_m))
        found = self.matches(pose, surface_m)
        found = found[found[:, matching.WEIGHT] > 0.0]
        variance = found[:, matching.FACING] / found[:, matching.WEIGHT]
        agreement = np.sum(found[:, matching.OWN] * found[:, matching.OTHER], axis=1)
        return 0.5 * found[:, matching.RESIDUAL] ** 2 / variance + self.bend * (1.0 - agreement)

    def matches(self, pose: Array, surface_m: float) -> Array:
        """Return what each point finds under one pose (12,): `kernels.matching.matches`."""
        return matching.matches(pose, self._columns(), self._cells, self._intrinsics, np.array(FACING), surface_m)

    def normal_equations(self, poses: Array, centres_m: Array, surface_m: float, *, stride: int = 1) -> Array:
        """Return the normal equations (m, 27) of matching points under poses (m, 12) about centres (m, 3)."""
        columns, facing = self._columns(stride), np.array(FACING)
        return matching.normal_equations(poses, centres_m, columns, self._cells, self._intrinsics, facing, surface_m)

    def _columns(self, stride: int = 1) -> Array:
        return np.ascontiguousarray(self.points[::stride].T)

    @property
    def _cells(self) -> np.ndarray:
        cells = self.image.layers["cells"]
        return cells.reshape(-1, cells.shape[-1])

    @property
    def _intrinsics(self) -> Array:
        camera = self.image.frame.camera
        return np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height])

    def _model(self, blur_m: float, typical: float = 0.5) -> Array:
        """Return the parameters (10,) of the kernel."""
        camera = self.image.frame.camera
        lateral_px = max(self.image.sigma_wh * camera.fx, 1.0)
        blur_px = blur_m * camera.fx / max(float(np.median(self.points[:, 2])), 1e-3)
        return np.array(
            [
                np.hypot(blur_m, self.surface_m),
                lateral_px + blur_px,
                1.25 * lateral_px,
                3.0 * self.image.sigma_r_m,
                *FACING,
                self.worst,
                self.bend,
                np.log(max(self.hidden_share, 1.0 - self.measured_share)),
                typical,
            ]
        )
