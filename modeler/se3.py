"""Rigid motions and their uncertainty: the one home of the conventions.

A pose is a 4×4 matrix named `target_from_source`: it takes homogeneous points in `source` to points in `target`, in
metres, and composes by cancelling neighbours. A tangent vector is ξ = (rotation in rad, translation in m), the order of
GTSAM's `Pose3`, applied from the right: `pose @ exp(ξ)`. Every 6×6 covariance is of that ξ. Functions broadcast over
leading axes.
"""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]

_SMALL_ANGLE_RAD = 1e-4  # below it the series of the coefficients is exact to rounding


def hat(vector: Array) -> Array:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    vector = np.asarray(vector, dtype=np.float64)
    matrix = np.zeros((*vector.shape[:-1], 3, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -vector[..., 2], vector[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = vector[..., 2], -vector[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -vector[..., 1], vector[..., 0]
    return matrix


def _coefficients(angle_rad: Array) -> tuple[Array, Array, Array]:
    """Return sin(a)/a, (1 - cos a)/a², (a - sin a)/a³ with their limits at zero."""
    small = angle_rad < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, angle_rad)
    square = angle_rad**2
    half = np.sin(0.5 * safe) / safe  # 1 - cos a = 2 sin²(a/2), which does not cancel
    return (
        np.where(small, 1.0 - square / 6.0, np.sin(safe) / safe),
        np.where(small, 0.5 - square / 24.0, 2.0 * half**2),
        np.where(small, 1.0 / 6.0 - square / 120.0, (safe - np.sin(safe)) / safe**3),
    )


def exp(xi: Array) -> Array:
    """Return the motions (..., 4, 4) of tangent vectors ξ (..., 6)."""
    xi = np.asarray(xi, dtype=np.float64)
    omega, upsilon = xi[..., :3], xi[..., 3:]
    first, second, third = _coefficients(np.linalg.norm(omega, axis=-1))
    cross = hat(omega)
    square = cross @ cross
    pose = np.zeros((*xi.shape[:-1], 4, 4))
    pose[..., :3, :3] = np.eye(3) + first[..., None, None] * cross + second[..., None, None] * square
    left_jacobian = np.eye(3) + second[..., None, None] * cross + third[..., None, None] * square
    pose[..., :3, 3] = (left_jacobian @ upsilon[..., None])[..., 0]
    pose[..., 3, 3] = 1.0
    return pose


def log(pose: Array) -> Array:
    """Return the tangent vectors ξ (..., 6) of motions (..., 4, 4), with rotation angles in [0, π]."""
    pose = np.asarray(pose, dtype=np.float64)
    flat = pose.reshape(-1, 4, 4)
    omega = Rotation.from_matrix(flat[:, :3, :3]).as_rotvec()
    angle = np.linalg.norm(omega, axis=-1)
    first, second, _ = _coefficients(angle)
    safe = np.where(angle < _SMALL_ANGLE_RAD, 1.0, angle)
    # (1 - a sin(a) / (2 (1 - cos a))) / a², the last coefficient of the inverse left Jacobian.
    last = np.where(angle < _SMALL_ANGLE_RAD, 1.0 / 12.0, (1.0 - first / (2.0 * second)) / safe**2)
    cross = hat(omega)
    inverse_jacobian = np.eye(3) - 0.5 * cross + last[:, None, None] * (cross @ cross)
    upsilon = (inverse_jacobian @ flat[:, :3, 3, None])[..., 0]
    return np.concatenate([omega, upsilon], axis=-1).reshape(*pose.shape[:-2], 6)


def inverse(pose: Array) -> Array:
    """Return the inverse motions (..., 4, 4)."""
    pose = np.asarray(pose, dtype=np.float64)
    result = np.zeros_like(pose)
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -(rotation @ pose[..., :3, 3, None])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def adjoint(pose: Array) -> Array:
    """Return the matrices (..., 6, 6) with `pose @ exp(ξ) = exp(adjoint(pose) ξ) @ pose`."""
    pose = np.asarray(pose, dtype=np.float64)
    matrix = np.zeros((*pose.shape[:-2], 6, 6))
    rotation = pose[..., :3, :3]
    matrix[..., :3, :3] = rotation
    matrix[..., 3:, 3:] = rotation
    matrix[..., 3:, :3] = hat(pose[..., :3, 3]) @ rotation
    return matrix


def transform(pose: Array, points: Array) -> Array:
    """Carry points (n, 3) in m by one motion (4, 4)."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def translation(offset_m: Array) -> Array:
    """Return the motion (4, 4) that only shifts by `offset_m` (3,)."""
    pose = np.eye(4)
    pose[:3, 3] = offset_m
    return pose


def rotation_angle(pose: Array) -> Array:
    """Return the rotation angles (...) in rad of motions (..., 4, 4)."""
    return np.sqrt(np.sum(log(pose)[..., :3] ** 2, axis=-1))


def inverse_covariance(pose: Array, covariance: Array) -> Array:
    """Return the covariance (6, 6) of `inverse(pose)` where `pose` has `covariance`."""
    matrix = adjoint(pose)
    return matrix @ covariance @ matrix.T


def composed_covariance(covariance_ab: Array, pose_bc: Array, covariance_bc: Array) -> Array:
    """Return the first-order covariance (6, 6) of `pose_ab @ pose_bc` for independent errors."""
    matrix = adjoint(inverse(pose_bc))
    return matrix @ covariance_ab @ matrix.T + covariance_bc


def mean(poses: Array, weights: Array, start: Array | None = None, iterations: int = 20) -> tuple[Array, Array]:
    """Return the intrinsic mean (4, 4) of weighted motions and their covariance (6, 6) about it.

    Args:
        poses: (n, 4, 4).
        weights: (n,), non-negative, any positive sum.
        start: (4, 4) where the iteration begins; the heaviest motion without it.
        iterations: at most so many fixed-point steps.
    """
    weights = np.asarray(weights, dtype=np.float64) / np.sum(weights)
    centre = poses[int(np.argmax(weights))] if start is None else start
    for _ in range(iterations):
        step = weights @ log(inverse(centre) @ poses)
        centre = centre @ exp(step)
        if np.linalg.norm(step) < 1e-12:
            break
    xi = log(inverse(centre) @ poses)
    covariance = (weights[:, None] * xi).T @ xi
    return centre, 0.5 * (covariance + covariance.T)
