"""What the sampling methods share: from samples to a Gaussian, and the arrays that kernels take."""

import numpy as np

from modeler import se3
from modeler.types import Array, Outcome, PoseGaussian, Posterior, RayImage


def weighted_gaussian(poses: Array, weights: Array, centre_m: Array) -> PoseGaussian:
    """Return the mean and covariance of weighted motions (paper, E[f(T)] ≈ Σ w_l f(T_l)).

    The mean is taken of motions about the object's centre: about the camera, rotation and translation would be strongly
    coupled, and the mean of a wide posterior would leave the object.

    Args:
        poses: (n, 4, 4) target_from_source.
        weights: (n,), any positive sum.
        centre_m: (3,) point of the source.
    """
    centre = se3.translation(centre_m)
    mean, covariance = se3.mean(poses @ centre, weights)
    to_camera = se3.adjoint(centre)
    floor = np.diag(np.repeat([1e-6, 1e-7], 3) ** 2)  # keeps the covariance of a single sample positive definite
    covariance = to_camera @ (covariance + floor) @ to_camera.T
    return PoseGaussian(mean @ se3.translation(-centre_m), 0.5 * (covariance + covariance.T))


def failed(source: RayImage, target: RayImage, outcome: Outcome) -> Posterior:
    """Return the posterior of a registration that could not be made: nothing is known."""
    pose = PoseGaussian(np.eye(4), np.diag(np.repeat([np.pi, 10.0], 3) ** 2))
    return Posterior(source=source.index, target=target.index, pose=pose, outcome=outcome, overlap=0.0)


def rows(poses: Array) -> Array:
    """Return the upper three rows (n, 12) of motions (n, 4, 4), as kernels take them."""
    return np.ascontiguousarray(poses[:, :3].reshape(len(poses), 12))


def intrinsics(view: RayImage) -> Array:
    """Return fx, fy, cx, cy (4,) in px of a view's camera."""
    camera = view.frame.camera
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])
