"""Motions of an object that stays on its support plane, as surely as the plane is known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modeler import se3
from modeler.priors.directions import across_axis
from modeler.priors.general import centroid_offset
from modeler.types import Array, InputError, Plane, RayImage

WOBBLE_DEG, WOBBLE_M = 0.2, 0.0007
"""How far a table is from plane, or a turntable from true, in one motion of what stands on it: standard deviations."""


@dataclass(frozen=True, eq=False)
class OnPlane:
    """Coordinates of motions beside a plane: turn and shift in it, and a Gaussian tilt and lift out of it."""

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
        """Return motions (n, 4, 4) of turns (n,) and shifts (n, 2) of the centroid, tilted and lifted at random."""
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
        """Return turns (n,) in rad, shifts (n, 2) in m of motions (n, 4, 4), and the log density (n,) of the rest."""
        rotation, normal = target_from_source[:, :3, :3], self.normal
        tilted = np.einsum("nij,j->ni", rotation, normal)
        upright = np.einsum("ni,i->n", tilted, normal)
        aside = tilted - upright[:, None] * normal
        tilt_rad = np.arctan2(np.sqrt(np.einsum("ni,ni->n", aside, aside)), upright)
        # What is left of the rotation once the tilt is undone turns about the normal.
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
        """Height of the source's centroid above the target's: it stays when the object moves on the plane."""
        return float((self.source_centroid_m - self.target_centroid_m) @ self.normal)


def on_plane(
    source: RayImage, target: RayImage, *, turn_rad: float, shift_m: float, sigma_tilt_rad: float, sigma_lift_m: float
) -> OnPlane:
    """Return the coordinates of motions on the plane that two views show.

    Args:
        source: view with the object before the motion.
        target: view with the object after it.
        turn_rad: largest turn to expect.
        shift_m: largest shift to expect.
        sigma_tilt_rad: standard deviation of the rotation out of the plane, on top of the plane's own uncertainty.
        sigma_lift_m: standard deviation of the motion along the normal, on top of the plane's own uncertainty.

    Raises:
        InputError: where neither view shows a support plane.
    """
    plane = support(source, target)
    if plane is None:
        raise no_plane(source, target)
    # A normal that is off by δ tilts a turn by θ about it by 2 sin(θ/2) δ, and lifts a shift by shift · δ.
    tilt_rad = 2.0 * np.sin(min(turn_rad, np.pi) / 2.0) * plane.sigma_tilt_rad
    return OnPlane(
        source.centroid_m,
        target.centroid_m,
        plane.normal,
        float(np.hypot(sigma_tilt_rad, tilt_rad)),
        float(np.hypot(sigma_lift_m, shift_m * plane.sigma_tilt_rad)),
    )


def no_plane(source: RayImage, target: RayImage) -> InputError:
    """Return the error that says that neither view shows a support plane."""
    return InputError(
        f"frames {source.index} and {target.index} show no support plane for the prior to go by; "
        "use --prior general or let the camera see more of the table"
    )


def support(source: RayImage, target: RayImage) -> Plane | None:
    """Return the support plane that two views show, their mean where both do; None where neither does."""
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
