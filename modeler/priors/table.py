"""The table prior: the object turns about its support plane's normal and shifts in the plane (paper, section IV)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from modeler import se3
from modeler.priors.general import AnyMotion, GeneralPrior, centroid_offset, offset_limit_m, relaxed_rotation_deg
from modeler.priors.mixtures import across_axis
from modeler.types import AbstractPoseDensity, AbstractPrior, Array, InputError, Plane, RayImage, checked
from modeler.types.base import check_parameters

WOBBLE_DEG, WOBBLE_M = 0.2, 0.0007
"""Standard deviations of the deviation of tables from planes, and of turntables from pure rotation, in one step. Halved
or doubled, log densities of motions on a table change by 0.8 nats at most."""


@dataclass(frozen=True, eq=False)
class OnPlane:
    """Coordinates of motions on a plane: turn and shift in the plane, and a Gaussian tilt and lift out of it."""

    source_centroid_m: Array
    """(3,)."""
    target_centroid_m: Array
    """(3,)."""
    normal: Array
    """(3,) unit."""
    sigma_tilt_rad: float
    """Standard deviation of the rotation out of the plane, about each direction in it."""
    sigma_lift_m: float
    """Standard deviation of the motion along the normal."""

    @cached_property
    def axes(self) -> Array:
        """Two unit vectors that span the plane, and its normal (3, 3), right-handed."""
        return np.vstack([across_axis(self.normal), self.normal])

    def motions(self, turn_rad: Array, shift_m: Array, rng: np.random.Generator) -> Array:
        """Return poses (n, 4, 4) of turns (n,) and shifts (n, 2) of the centroid, with random tilt and lift."""
        count, axes = len(turn_rad), self.axes
        tilt = rng.normal(0.0, self.sigma_tilt_rad, (count, 2)) @ axes[:2]
        zero = np.zeros((count, 3))
        turn = turn_rad[:, None] * self.normal
        tilted = se3.exp(np.concatenate([tilt, zero], axis=1))
        motion = se3.moved(tilted, np.concatenate([turn, zero], axis=1), np.zeros(3))
        lift_m = rng.normal(self._lift_m, self.sigma_lift_m, (count, 1))
        offset_m = np.concatenate([shift_m, lift_m], axis=1) @ axes
        motion[:, :3, 3] = self.target_centroid_m + offset_m - motion[:, :3, :3] @ self.source_centroid_m
        return motion

    def coordinates(self, target_from_source: Array) -> tuple[Array, Array, Array]:
        """Return turns (n,) in rad, shifts (n, 2) in m and log densities (n,) of tilt and lift, of poses (n, 4, 4)."""
        rotation, normal = target_from_source[:, :3, :3], self.normal
        tilted = np.einsum("nij,j->ni", rotation, normal)
        upright = np.einsum("ni,i->n", tilted, normal)
        lateral = tilted - upright[:, None] * normal
        tilt_rad = np.arctan2(np.sqrt(np.einsum("ni,ni->n", lateral, lateral)), upright)
        # The rotation without its tilt is a turn about the normal.
        twist = np.einsum("nij,ij->n", rotation, se3.hat(normal))
        turn_rad = np.arctan2(twist, np.einsum("nii->n", rotation) - upright)
        offset_m = centroid_offset(target_from_source, self.source_centroid_m, self.target_centroid_m) @ self.axes.T
        out_of_plane = (
            -0.5 * (tilt_rad / self.sigma_tilt_rad) ** 2
            - 0.5 * ((offset_m[:, 2] - self._lift_m) / self.sigma_lift_m) ** 2
            - np.log((2.0 * np.pi) ** 1.5 * self.sigma_tilt_rad**2 * self.sigma_lift_m)
        )
        return turn_rad, offset_m[:, :2], out_of_plane

    @property
    def _lift_m(self) -> float:
        """Height of the source's centroid above the target's, which motion on the plane preserves."""
        return float((self.source_centroid_m - self.target_centroid_m) @ self.normal)


def on_plane(
    source: RayImage, target: RayImage, *, turn_rad: float, shift_m: float, sigma_tilt_rad: float, sigma_lift_m: float
) -> OnPlane:
    """Return the coordinates of motions on the support plane of two views.

    Args:
        source: view before the motion.
        target: view after it.
        turn_rad: largest expected turn.
        shift_m: largest expected shift.
        sigma_tilt_rad: standard deviation of the rotation out of the plane, on top of the plane's own uncertainty.
        sigma_lift_m: standard deviation of the motion along the normal, on top of the plane's own uncertainty.

    Raises:
        InputError: if neither view shows a support plane.
    """
    plane = support(source, target)
    if plane is None:
        raise no_plane(source, target)
    # An error δ of the normal tilts a turn by θ about it by 2 sin(θ/2) δ, and lifts a shift by shift · δ.
    tilt_rad = 2.0 * np.sin(min(turn_rad, np.pi) / 2.0) * plane.sigma_tilt_rad
    return OnPlane(
        source.centroid_m,
        target.centroid_m,
        plane.normal,
        float(np.hypot(sigma_tilt_rad, tilt_rad)),
        float(np.hypot(sigma_lift_m, shift_m * plane.sigma_tilt_rad)),
    )


def no_plane(source: RayImage, target: RayImage) -> InputError:
    """Return the error for two views without a support plane."""
    return InputError(
        f"frames {source.index} and {target.index} show no support plane, which the prior needs; "
        "use the general prior or let the camera see more of the table"
    )


def support(source: RayImage, target: RayImage) -> Plane | None:
    """Return the support plane of two views, the mean if both show it; None if neither does."""
    planes = [view.plane for view in (source, target) if view.plane is not None]
    if not planes:
        return None
    normal = np.sum([plane.normal for plane in planes], axis=0)
    return Plane(
        normal / np.linalg.norm(normal),
        float(np.mean([plane.offset_m for plane in planes])),
        float(np.mean([plane.sigma_tilt_rad for plane in planes])),
        float(np.mean([plane.sigma_offset_m for plane in planes])),
    )


@checked
@dataclass(frozen=True)
class TablePrior(AbstractPrior):
    """Motion in the support plane, with the plane's own uncertainty."""

    max_rotation_deg: float = GeneralPrior.max_rotation_deg
    """Largest rotation about the plane's normal between the two views."""
    max_shift_m: float | None = None
    """Largest distance, in the plane, between the target's centroid and the source's, transformed; None: 0.75 of the
    object's size."""
    sigma_tilt_deg: float = WOBBLE_DEG
    """Standard deviation of the rotation out of the plane, on top of the plane's own uncertainty."""
    sigma_height_m: float = WOBBLE_M
    """Standard deviation of the motion along the normal, on top of the plane's own uncertainty."""
    limits_assumed: bool = False
    """Whether the limits are defaults: if nothing within them matches, any motion on the table is possible."""
    steps: float = GeneralPrior.steps
    """Number of steps of a motion, at least 1: shifts add up."""

    def __post_init__(self) -> None:
        """Check the parameters."""
        check_parameters(self)

    def between(self, source: RayImage, target: RayImage) -> TableDensity:
        limit_rad = float(np.radians(self.max_rotation_deg))
        shift_m = offset_limit_m(self.max_shift_m, self.steps, source, target)
        plane = on_plane(
            source,
            target,
            turn_rad=limit_rad,
            shift_m=shift_m,
            sigma_tilt_rad=np.radians(self.sigma_tilt_deg),
            sigma_lift_m=self.sigma_height_m,
        )
        return TableDensity(plane, limit_rad, shift_m)

    def unlimited(self) -> AnyTurn | None:
        return AnyTurn(self.sigma_tilt_deg, self.sigma_height_m) if self.limits_assumed else None

    def relaxed(self, steps: float) -> TablePrior:
        """Return the prior with limits for several steps; the constraint to the plane is unchanged."""
        rotation_deg = relaxed_rotation_deg(self.max_rotation_deg, steps)
        return replace(self, max_rotation_deg=rotation_deg, steps=steps * self.steps)


@dataclass(frozen=True)
class AnyTurn(AbstractPrior):
    """Any turn on the table; the shift of the centroids is limited by the object's size."""

    sigma_tilt_deg: float = WOBBLE_DEG
    """Standard deviation of the rotation out of the plane, on top of the plane's own uncertainty."""
    sigma_height_m: float = WOBBLE_M
    """Standard deviation of the motion along the normal, on top of the plane's own uncertainty."""

    def __post_init__(self) -> None:
        """Check the parameters."""
        check_parameters(self)

    def between(self, source: RayImage, target: RayImage) -> TableDensity:
        shift_m = AnyMotion().reach_m(source, target)
        return TablePrior(180.0, shift_m, self.sigma_tilt_deg, self.sigma_height_m).between(source, target)


@dataclass(frozen=True, eq=False)
class TableDensity(AbstractPoseDensity):
    """Uniform turn and shift in a plane, Gaussian tilt and lift out of it."""

    plane: OnPlane
    """The support plane's coordinates."""
    max_rotation_rad: float
    """Largest turn from the middle, in either direction."""
    max_shift_m: float
    """Largest distance, in the plane, between the target's centroid and the source's, transformed."""
    middle_rad: float = 0.0
    """Central turn."""

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        turn_rad = self.middle_rad + rng.uniform(-self.max_rotation_rad, self.max_rotation_rad, count)
        return self.plane.motions(turn_rad, sample_disc(self.max_shift_m, count, rng), rng)

    def log_density(self, target_from_source: Array) -> Array:
        turn_rad, shift_m, out_of_plane = self.plane.coordinates(target_from_source)
        turn_rad = np.abs(np.remainder(turn_rad - self.middle_rad + np.pi, 2.0 * np.pi) - np.pi)
        inside = (turn_rad <= self.max_rotation_rad) & (np.sum(shift_m**2, axis=1) <= self.max_shift_m**2)
        uniform = -np.log(2.0 * self.max_rotation_rad * np.pi * self.max_shift_m**2)
        return np.where(inside, out_of_plane + uniform, -np.inf)


def sample_disc(radius_m: float, count: int, rng: np.random.Generator) -> Array:
    """Draw points (count, 2) uniformly over a disc about the origin."""
    distance_m = radius_m * np.sqrt(rng.random((count, 1)))
    bearing = rng.uniform(0.0, 2.0 * np.pi, count)
    return distance_m * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
