"""Rigid motions and their uncertainty: the definition of the conventions.

A pose is a 4×4 matrix named `target_from_source`: it maps homogeneous points in `source` to points in `target`, in
metres, and composes by cancelling neighbours. A tangent vector is ξ = (rotation in rad, translation in m), the order of
GTSAM's `Pose3`, applied from the right: `pose @ exp(ξ)`. Every 6×6 covariance is of that ξ. Functions broadcast over
leading axes.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from modeler.kernels import lie_group

Array = npt.NDArray[np.float64]

Y_UP: Final = np.diag([1.0, -1.0, -1.0])
"""Turns x right, y down, z forward into x right, y up, z back, as OpenGL and glTF have it, and back."""


def hat(vector: Array) -> Array:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    vector = np.asarray(vector, dtype=np.float64)
    matrix = np.zeros((*vector.shape[:-1], 3, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -vector[..., 2], vector[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = vector[..., 2], -vector[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -vector[..., 1], vector[..., 0]
    return matrix


def exp(xi: Array) -> Array:
    """Return the motions (..., 4, 4) of tangent vectors ξ (..., 6)."""
    xi = np.ascontiguousarray(xi, dtype=np.float64)
    return lie_group.exponentials(xi.reshape(-1, 6)).reshape(*xi.shape[:-1], 4, 4)


def log(pose: Array) -> Array:
    """Return the tangent vectors ξ (..., 6) of motions (..., 4, 4), with rotation angles in [0, π]."""
    pose = np.ascontiguousarray(pose, dtype=np.float64)
    return lie_group.logarithms(pose.reshape(-1, 4, 4)).reshape(*pose.shape[:-2], 6)


def is_rigid(matrix: Array, *, tolerance: float, farthest_m: float = 1e6) -> bool:
    """Return whether a matrix (4, 4) of whatever numbers, NaN among them, is a rigid motion.

    Args:
        matrix: as somebody wrote it.
        tolerance: how far the rotation may be from orthonormal, in each product of two rows.
        farthest_m: no motion leads so far along any axis.
    """
    rotation, shift_m = matrix[:3, :3], matrix[:3, 3]
    if not ((np.abs(rotation) < 2.0).all() and (np.abs(shift_m) < farthest_m).all()):  # not so of NaN
        return False
    orthonormal = np.abs(rotation @ rotation.T - np.eye(3)).max() < tolerance and np.linalg.det(rotation) > 0.0
    return bool(orthonormal and (matrix[3] == (0.0, 0.0, 0.0, 1.0)).all())


def inverse(pose: Array) -> Array:
    """Return the inverse motions (..., 4, 4)."""
    pose = np.asarray(pose, dtype=np.float64)
    result = np.zeros_like(pose)
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -(rotation @ pose[..., :3, 3, None])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def moved(pose: Array, xi: Array, about_m: Array) -> Array:
    """Return motions (..., 4, 4) after ξ (..., 6) about a point (3,) of what they move: pose · C · exp(ξ) · C⁻¹.

    C is the shift to the point: about an object's centre, rotation and translation are least correlated.
    """
    poses, steps = np.ascontiguousarray(pose, dtype=np.float64), np.ascontiguousarray(xi, dtype=np.float64)
    if poses.shape[:-2] != steps.shape[:-1]:
        shape = np.broadcast_shapes(poses.shape[:-2], steps.shape[:-1])
        poses, steps = np.broadcast_to(poses, (*shape, 4, 4)).copy(), np.broadcast_to(steps, (*shape, 6)).copy()
    point_m = np.asarray(about_m, dtype=np.float64)
    return lie_group.retract_all(poses.reshape(-1, 4, 4), steps.reshape(-1, 6), point_m).reshape(poses.shape)


def difference(first: Array, second: Array, about_m: Array) -> Array:
    """Return the ξ (..., 6) by which `moved` takes motions (..., 4, 4) to others, about a point (3,)."""
    one, other = rows(first), rows(second)
    if one.shape != other.shape:
        shape = np.broadcast_shapes(one.shape, other.shape)
        one, other = np.broadcast_to(one, shape).copy(), np.broadcast_to(other, shape).copy()
    found = lie_group.differences(one.reshape(-1, 12), other.reshape(-1, 12), np.asarray(about_m, dtype=np.float64))
    return found.reshape(*one.shape[:-1], 6)


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
    return rigid(np.eye(3), offset_m)


def rigid(rotation: Array, offset_m: Array) -> Array:
    """Return the motion (4, 4) that rotates by a matrix (3, 3), then shifts by `offset_m` (3,)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, offset_m
    return pose


def rotation_angle(pose: Array) -> Array:
    """Return the rotation angles (...) in rad of motions (..., 4, 4)."""
    return np.sqrt(np.sum(log(pose)[..., :3] ** 2, axis=-1))


def inverse_covariance(pose: Array, covariance: Array) -> Array:
    """Return the covariances (..., 6, 6) of `inverse(pose)` where `pose` (..., 4, 4) has `covariance` (..., 6, 6)."""
    return _carried(covariance, adjoint(pose))


def composed_covariance(covariance_ab: Array, pose_bc: Array, covariance_bc: Array) -> Array:
    """Return the first-order covariances (..., 6, 6) of `pose_ab @ pose_bc` for independent errors."""
    return _carried(covariance_ab, adjoint(inverse(pose_bc))) + covariance_bc


def covariance_about(covariance: Array, point_m: Array) -> Array:
    """Return the covariance (..., 6, 6) of η in `pose @ exp(ξ) = moved(pose, η, point_m)` where ξ has `covariance`.

    About an object's centre, rotation and translation are least correlated, and the translation is that of the
    centre. With `-point_m` it leads back: from about a point to about the origin.

    Args:
        covariance: (..., 6, 6) of ξ, which turns about the origin of what the pose moves.
        point_m: (3,) of what the pose moves.
    """
    about = _carried(covariance, adjoint(translation(-np.asarray(point_m, dtype=np.float64))))
    return 0.5 * (about + np.swapaxes(about, -1, -2))  # rounding alone would leave it a little askew


def _carried(covariance: Array, matrix: Array) -> Array:
    """Return the covariances (..., 6, 6) of M ξ for matrices M (..., 6, 6)."""
    return matrix @ covariance @ np.swapaxes(matrix, -1, -2)


def _orthonormal(pose: Array) -> Array:
    """Return a motion (4, 4) whose rotation is orthonormal to rounding, by a Newton step of its polar decomposition.

    Inverses that transpose turn an error e of a rotation into products off by 2 e: from prediction to mean to
    prediction, rounding errors would double at every frame.
    """
    made = pose.copy()
    made[:3, :3] = 0.5 * pose[:3, :3] @ (3.0 * np.eye(3) - pose[:3, :3].T @ pose[:3, :3])
    return made


def mean(
    poses: Array, weights: Array, *, about_m: Array | None = None, start: Array | None = None, iterations: int = 20
) -> tuple[Array, Array]:
    """Return the intrinsic mean (4, 4) of weighted motions, and the covariance (6, 6) of their ξ from it.

    Args:
        poses: (n, 4, 4).
        weights: (n,), non-negative, any positive sum.
        about_m: (3,) point about which ξ turns, see `moved`; the origin without it.
        start: (4, 4) where the iteration begins; the heaviest motion without it.
        iterations: largest number of fixed-point steps.
    """
    weights = np.asarray(weights, dtype=np.float64) / np.sum(weights)
    point_m = np.zeros(3) if about_m is None else np.asarray(about_m, dtype=np.float64)
    begin = _orthonormal(poses[int(np.argmax(weights))] if start is None else start)
    centre, covariance = lie_group.mean(rows(poses), weights, rows(begin), point_m, iterations, 1e-11)
    return matrices(centre[None])[0], covariance


def rows(poses: Array) -> Array:
    """Return the upper three rows (..., 12) of motions (..., 4, 4), as kernels take them."""
    return np.ascontiguousarray(poses[..., :3, :], dtype=np.float64).reshape(*poses.shape[:-2], 12)


def matrices(poses: Array) -> Array:
    """Return motions (n, 4, 4) of their upper three rows (n, 12)."""
    full = np.zeros((len(poses), 4, 4))
    full[:, :3] = poses.reshape(-1, 3, 4)
    full[:, 3, 3] = 1.0
    return full
