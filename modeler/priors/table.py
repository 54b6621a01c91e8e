"""The object stays on its support: it turns about the plane's normal and shifts in the plane (paper, section IV)."""

from dataclasses import dataclass, replace

import numpy as np

from modeler import se3
from modeler.priors.general import centroid_offset, grown_limits
from modeler.types import AbstractMotion, AbstractPrior, Array, InputError, RayImage


@dataclass(frozen=True)
class TablePrior(AbstractPrior):
    """Motion in the support plane, as surely as the plane is known."""

    max_rotation_deg: float = 50.0
    """Largest rotation about the plane's normal between the two views."""
    max_shift_m: float = 0.05
    """Largest distance, in the plane, between the target's centroid and the source's, carried over."""
    sigma_tilt_deg: float = 0.2
    """Standard deviation of the rotation out of the plane, on top of the plane's own uncertainty."""
    sigma_height_m: float = 0.0007
    """Standard deviation of the motion along the normal, on top of the plane's own uncertainty."""

    def between(self, source: RayImage, target: RayImage) -> "TableMotion":
        """Return the density of target_from_source.

        Raises:
            InputError: where neither view shows a support plane.
        """
        planes = [view.plane for view in (source, target) if view.plane is not None]
        if not planes:
            raise InputError(
                f"frames {source.index} and {target.index} show no support plane for the table prior; "
                "use --prior general or let the camera see more of the table"
            )
        normal = np.sum([plane.normal for plane in planes], axis=0)
        normal /= np.linalg.norm(normal)
        plane_tilt_rad = float(np.mean([plane.sigma_tilt_rad for plane in planes]))
        limit_rad = np.deg2rad(self.max_rotation_deg)
        # A normal that is off by δ tilts a turn by θ about it by 2 sin(θ/2) δ, and lifts a shift by shift · δ.
        sigma_tilt_rad = np.hypot(
            np.deg2rad(self.sigma_tilt_deg), 2.0 * np.sin(min(limit_rad, np.pi) / 2) * plane_tilt_rad
        )
        sigma_height_m = np.hypot(self.sigma_height_m, self.max_shift_m * plane_tilt_rad)
        return TableMotion(
            source.centroid_m,
            target.centroid_m,
            normal=normal,
            max_rotation_rad=limit_rad,
            max_shift_m=self.max_shift_m,
            sigma_tilt_rad=float(sigma_tilt_rad),
            sigma_height_m=float(sigma_height_m),
        )

    def grown(self, steps: float) -> "TablePrior":
        """Return the prior whose limits hold for several steps; what ties the motion to the plane stays."""
        rotation_deg, shift_m = grown_limits(self.max_rotation_deg, self.max_shift_m, steps)
        return replace(self, max_rotation_deg=rotation_deg, max_shift_m=shift_m)


@dataclass(frozen=True, eq=False)
class TableMotion(AbstractMotion):
    """Uniform turn and shift in a plane, Gaussian tilt and lift out of it."""

    source_centroid_m: Array
    """(3,)."""
    target_centroid_m: Array
    """(3,)."""
    normal: Array
    """(3,) unit."""
    max_rotation_rad: float
    max_shift_m: float
    sigma_tilt_rad: float
    sigma_height_m: float
    evidence: bool = True

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw motions (count, 4, 4)."""
        in_plane = plane_basis(self.normal)
        turn = rng.uniform(-self.max_rotation_rad, self.max_rotation_rad, (count, 1)) * self.normal
        tilt = rng.normal(0.0, self.sigma_tilt_rad, (count, 2)) @ in_plane
        zero = np.zeros((count, 3))
        motion = se3.exp(np.concatenate([tilt, zero], axis=1)) @ se3.exp(np.concatenate([turn, zero], axis=1))
        radius_m = self.max_shift_m * np.sqrt(rng.random((count, 1)))
        bearing = rng.uniform(0.0, 2.0 * np.pi, count)
        shift = radius_m * np.stack([np.cos(bearing), np.sin(bearing)], axis=1) @ in_plane
        lift = rng.normal(self._lift_m, self.sigma_height_m, (count, 1)) * self.normal
        motion[:, :3, 3] = self.target_centroid_m + shift + lift - motion[:, :3, :3] @ self.source_centroid_m
        return motion

    def log_density(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of motions (n, 4, 4); -inf outside."""
        axes = np.vstack([plane_basis(self.normal), self.normal])
        rotation = axes @ target_from_source[:, :3, :3] @ axes.T
        tilt_rad = np.arctan2(np.hypot(rotation[:, 0, 2], rotation[:, 1, 2]), rotation[:, 2, 2])
        # What is left of the rotation once the tilt is undone turns about the normal.
        turn_rad = np.arctan2(rotation[:, 1, 0] - rotation[:, 0, 1], rotation[:, 0, 0] + rotation[:, 1, 1])
        offset_m = centroid_offset(target_from_source, self.source_centroid_m, self.target_centroid_m)
        height_m = offset_m @ self.normal
        inside = (np.abs(turn_rad) <= self.max_rotation_rad) & (
            np.sum(offset_m**2, axis=1) - height_m**2 <= self.max_shift_m**2
        )
        gaussian = (
            -0.5 * (tilt_rad / self.sigma_tilt_rad) ** 2
            - 0.5 * ((height_m - self._lift_m) / self.sigma_height_m) ** 2
            - np.log((2.0 * np.pi) ** 1.5 * self.sigma_tilt_rad**2 * self.sigma_height_m)
        )
        uniform = -np.log(2.0 * self.max_rotation_rad * np.pi * self.max_shift_m**2)
        return np.where(inside, gaussian + uniform, -np.inf)

    @property
    def _lift_m(self) -> float:
        """Height of the source's centroid above the target's: it stays when the object moves on the plane."""
        return float((self.source_centroid_m - self.target_centroid_m) @ self.normal)


def plane_basis(normal: Array) -> Array:
    """Return two unit vectors (2, 3) that span the plane of a unit normal (3,), right-handed with it."""
    first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    first = np.asarray(first / np.linalg.norm(first), dtype=np.float64)
    return np.array([first, np.cross(normal, first)], dtype=np.float64)
