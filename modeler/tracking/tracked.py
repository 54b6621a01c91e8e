"""What a tracker says of an object in one frame, and errors of poses that do not average out over points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np

from modeler import se3
from modeler.fusion.symmetries import Symmetries
from modeler.tracking.rendering import ModelRenderer
from modeler.types import Array, Mode, PoseGaussian, RayImage

Presence = Literal["found", "followed", "unsure", "not there", "too few points"]

USABLE_M: Final = 0.005
"""Largest standard deviation of the object's place with which a pose is of use; that of a rotation is `WRONG_RAD`."""


DOUBT: Final = 0.02
"""Probability of another object or place up to which an answer counts: 98 % of them are right."""


@dataclass(frozen=True, eq=False)
class Tracked:
    """The object in one frame."""

    frame: int
    """Number of the frame."""
    time_s: float
    """Time of the frame."""
    outcome: Presence
    """`found` without knowledge of the frames before, `followed` from these, or neither.

    It is `unsure` if other objects may match as well: too little is seen, another place matches, or the images leave a
    rotation open that is no symmetry of the model.
    """
    pose: PoseGaussian | None = None
    """camera_from_model, its covariance with the errors of model and camera; None where the object is not there."""
    modes: tuple[Mode, ...] = ()
    """The separate modes of camera_from_model, heaviest first; empty for a single one."""
    overlap: float = 0.0
    """Share (0..1) of the surface that frame and model should both show, at the pose, that both do show."""
    usable: bool = False
    """Whether there is one mode, but for the model's symmetries, with an sd of at most `WRONG_RAD` and `USABLE_M`.

    Both are given the camera, whose focal length and depth scale move all poses alike."""
    reason: str = ""
    """Why the object is not there, or the pose not usable."""
    seconds: float = 0.0
    """Wall time in s."""
    view: RayImage | None = field(default=None, repr=False)
    """The frame, or the part of it around a followed object, prepared for registration."""


PATCHES: Final = 8.0
"""Number of patches of the surface that a view shows in which errors of a fused model are alike.

Measured: with it, NEES/6 of models built of six rendered shapes of the tuning half is 0.2 to 1.6, its mean 0.9.
"""


def of_the_model(seen: RayImage, pose: PoseGaussian, renderer: ModelRenderer) -> Array:
    """Return the covariance (6, 6) of ξ in camera_from_model · Exp(ξ) due to the model's errors.

    Point-to-plane distances have rows a = (p × n, n), with mean B of a aᵀ. If distances err by σ, alike within each of
    K patches, a solution from surface alone, of covariance C, is moved with the covariance (σ² / K) B⁻¹ = (σ² / K) s C.
    In the direction that surface determines best, it has nearly all information: 1 / s is the largest eigenvalue of
    C B. Places of colours and outlines on the model err as its surface does, so that their information counts alike
    (method, eq. 15.2).

    Args:
        seen: the object in the frame.
        pose: camera_from_model, and the covariance C of ξ if the model is exact.
        renderer: of the model.
    """
    if not len(seen.points_m):
        return np.zeros((6, 6))
    model_from_camera = se3.inverse(pose.mean)
    arms = se3.transform(model_from_camera, seen.points_m) - renderer.centre_m
    normals = seen.normals @ model_from_camera[:3, :3].T
    rows = np.concatenate([np.cross(arms, normals), normals], axis=1)
    surface = rows.T @ rows / len(rows)
    about = se3.covariance_about(pose.covariance, renderer.centre_m)
    root = np.linalg.cholesky(about)
    scaled = about / np.linalg.eigvalsh(root.T @ surface @ root)[-1]
    return se3.covariance_about(renderer.sigma_m**2 / PATCHES * scaled, -renderer.centre_m)


def of_the_camera(camera_from_model: Array, centre_m: Array, sigma_focal: float, depth_scale_sigma: float) -> Array:
    """Return the covariance (6, 6) of ξ due to focal length and depth scale, both common to all points.

    A longer focal length moves the object towards the optical axis, by its distance from it; a scale of depth moves it
    along its ray (method, eq. 15.3).

    Args:
        camera_from_model: (4, 4).
        centre_m: (3,) middle of the model.
        sigma_focal: standard deviation of the logarithm of the focal length.
        depth_scale_sigma: that of the depth scale.
    """
    place_m = se3.transform(camera_from_model, centre_m[None])[0]
    covariance = np.zeros((6, 6))
    for sigma, moved_m in ((sigma_focal, place_m * (-1.0, -1.0, 0.0)), (depth_scale_sigma, place_m)):
        shift = camera_from_model[:3, :3].T @ moved_m
        covariance[3:, 3:] += sigma**2 * np.outer(shift, shift)
    return covariance


def free_directions(symmetries: Symmetries, *, coloured: bool) -> Array:
    """Return the covariance (6, 6) of ξ of the rotations that the model's symmetries leave open.

    Args:
        symmetries: of the model.
        coloured: whether colours are seen, which may resolve those of the shape.
    """
    found = symmetries.with_colour if coloured and symmetries.with_colour is not None else symmetries
    covariance = np.zeros((6, 6))
    for axis in found.continuous:
        covariance += np.pi**2 / 3.0 * np.outer(axis.turn, axis.turn)
    return covariance


def likeliest(placed: Sequence[tuple[float, Tracked]], renderer: ModelRenderer) -> Tracked:
    """Return the likeliest of some places or poses of one object in a frame, in doubt if others are about as likely.

    Args:
        placed: with the log odds (nats) of each.
        renderer: of the model.
    """
    most, best = max(placed, key=lambda one: one[0])
    for odds, other in placed:
        if other is best or odds < most + np.log(DOUBT):
            continue
        assert best.pose is not None
        assert other.pose is not None
        if not holds(best, se3.transform(other.pose.mean, renderer.centre_m[None])[0], renderer):
            return replace(best, outcome="unsure", usable=False, reason="several places explain the image")
        if not same(best.pose, other.pose):
            best = replace(best, usable=False, reason="several poses explain the image")
    return best


def holds(found: Tracked, place_m: Array, renderer: ModelRenderer) -> bool:
    """Return whether a place (3,) is where an object was found."""
    assert found.pose is not None
    centre_m = se3.transform(found.pose.mean, renderer.centre_m[None])[0]
    return float(np.linalg.norm(place_m - centre_m)) < renderer.radius_m


def of_motion(motion: PoseGaussian, rendered: Array) -> PoseGaussian:
    """Return camera_from_model, from the motion from the frame to the model rendered in a pose (4, 4)."""
    back = motion.inverse()  # inv(M) Exp(η) T = inv(M) T Exp(Ad(T⁻¹) η)
    moved = se3.adjoint(se3.inverse(rendered))
    return PoseGaussian(back.mean @ rendered, moved @ back.covariance @ moved.T, moved @ back.by_focal)


def same(one: PoseGaussian, other: PoseGaussian) -> bool:
    """Return whether two poses are within two standard deviations of each other, or of a degree."""
    xi = se3.log(se3.inverse(one.mean) @ other.mean)
    spread = 0.5 * (one.covariance + other.covariance)
    return bool(xi @ np.linalg.solve(spread, xi) < 4.0 or np.linalg.norm(xi[:3]) < np.radians(1.0))
