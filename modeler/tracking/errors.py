"""Errors of poses that do not average out over points: those of the model, of the camera, and open rotations."""

from __future__ import annotations

from typing import Final

import numpy as np

from modeler import se3
from modeler.fusion.symmetries import Symmetries
from modeler.tracking.rendering import ModelRenderer
from modeler.types import Array, RayImage

PATCHES: Final = 8.0
"""Number of patches of the surface that a view shows in which errors of a fused model are alike."""
_OPEN = 1e-3  # of the best determined direction's information: surface says nothing of less


def of_the_model(seen: RayImage, camera_from_model: Array, renderer: ModelRenderer) -> Array:
    """Return the covariance (6, 6) of ξ in camera_from_model · Exp(ξ) due to the model's errors.

    Least squares of point-to-plane distances have rows a = (p × n, n). If distances err by σ, alike within each of
    K patches, the covariance of the solution is σ² (Σ a aᵀ / N)⁻¹ / K (method, eq. 15.1). Directions that surface
    leaves open are left out.

    Args:
        seen: the model in the pose.
        camera_from_model: (4, 4).
        renderer: of the model.
    """
    if not len(seen.points_m):
        return np.zeros((6, 6))
    model_from_camera = se3.inverse(camera_from_model)
    arms = se3.transform(model_from_camera, seen.points_m) - renderer.centre_m
    normals = seen.normals @ model_from_camera[:3, :3].T
    scale = np.repeat([1.0 / renderer.radius_m, 1.0], 3)  # so that rotations compare with shifts
    rows = np.concatenate([np.cross(arms, normals), normals], axis=1) * scale
    values, axes = np.linalg.eigh(rows.T @ rows / len(rows))
    spread = np.where(values > _OPEN * values[-1], 1.0 / np.maximum(values, 1e-12), 0.0)
    about = renderer.sigma_m**2 / PATCHES * (axes * spread) @ axes.T * np.outer(scale, scale)
    return se3.covariance_about(about, -renderer.centre_m)


def of_the_camera(camera_from_model: Array, centre_m: Array, sigma_focal: float, depth_scale_sigma: float) -> Array:
    """Return the covariance (6, 6) of ξ due to focal length and depth scale, both common to all points.

    A longer focal length moves the object towards the optical axis, by its distance from it; a scale of depth moves it
    along its ray (method, eq. 15.2).

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
        turn = np.concatenate([axis.direction, np.cross(axis.point_m, axis.direction)])
        covariance += np.pi**2 / 3.0 * np.outer(turn, turn)
    return covariance
