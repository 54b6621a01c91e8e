"""Errors of motions and trajectories, and calibration of their covariances.

Truth is `camera_from_model(k)`: the pose (4, 4) of the object's model in the camera at frame k. Motions are compared in
the source camera, translations at the object's centroid: displacements of the object due to a rotation error about the
camera are included.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from modeler import se3
from modeler.types import Array, PoseGaussian

LEVELS = (0.5, 0.9, 0.95)
"""Nominal probabilities of the regions whose coverage is reported."""


def true_motion(camera_from_model: Mapping[int, Array], target: int, source: int) -> Array:
    """Return the true target_from_source (4, 4).

    Args:
        camera_from_model: (4, 4) by frame number.
        target: frame number.
        source: frame number.
    """
    return camera_from_model[target] @ se3.inverse(camera_from_model[source])


def rotation_error_deg(estimate: Array, truth: Array) -> float:
    """Return the angle in degrees between two motions or poses (4, 4)."""
    return float(np.degrees(se3.rotation_angle(se3.inverse(truth) @ estimate)))


def translation_error_m(estimate: Array, truth: Array, centroid_m: Array) -> float:
    """Return the distance in m between the object's centroid under two motions (4, 4).

    Args:
        estimate: target_from_source.
        truth: target_from_source.
        centroid_m: (3,) of the object, in the source camera.
    """
    ends = [se3.transform(motion, np.asarray(centroid_m)[None])[0] for motion in (estimate, truth)]
    return float(np.linalg.norm(ends[0] - ends[1]))


def nees(estimate: PoseGaussian, truth: Array, components: slice = slice(0, 6)) -> float:
    """Return the normalised estimation error squared ξᵀ Σ⁻¹ ξ with truth = mean · Exp(ξ).

    For calibrated estimates it is χ² distributed with as many degrees of freedom as components.

    Args:
        estimate: mean and covariance.
        truth: (4, 4).
        components: of ξ; `slice(0, 3)` is the rotation alone, whatever the translation, `slice(3, 6)` the translation.
    """
    xi = se3.log(se3.inverse(estimate.mean) @ truth)[components]
    return float(xi @ np.linalg.solve(estimate.covariance[components, components], xi))


def about_point(estimate: PoseGaussian, point_m: Array) -> PoseGaussian:
    """Return a motion's Gaussian in source coordinates shifted to a point, along the camera's axes.

    Its ξ then turns about that point and moves it, so that rotation and translation hardly mix at the object's
    centroid; `truth @ se3.translation(point_m)` is the truth to compare with. The NEES of all six stays the same.

    Args:
        estimate: target_from_source.
        point_m: (3,) in the source camera.
    """
    point_m = np.asarray(point_m, dtype=np.float64)
    return PoseGaussian(estimate.mean @ se3.translation(point_m), se3.covariance_about(estimate.covariance, point_m))


def coverage(nees_values: Iterable[float], degrees: int = 6, levels: Iterable[float] = LEVELS) -> dict[float, float]:
    """Return by nominal probability the share (0..1) of truths that lay inside the region of that probability.

    Args:
        nees_values: one per estimate.
        degrees: of freedom: components of each.
        levels: nominal probabilities.
    """
    values = np.fromiter(nees_values, dtype=np.float64)
    nominal = tuple(levels)
    radii = 2.0 * gammaincinv(0.5 * degrees, nominal)  # quantiles of χ²; importing `scipy.stats` takes 0.4 s
    shares = [float(np.mean(values <= radius)) if len(values) else float("nan") for radius in radii]
    return dict(zip(nominal, shares, strict=True))


@dataclass(frozen=True, eq=False)
class TrajectoryErrors:
    """Errors of object_from_camera against the truth, both relative to the first frame."""

    rotation_deg: Mapping[int, float]
    """By frame number; the first frame's is zero."""
    translation_m: Mapping[int, float]
    """By frame number: position error of the object's centroid in that frame."""

    @property
    def max_rotation_deg(self) -> float:
        """Return the largest rotation error."""
        return max(self.rotation_deg.values())

    @property
    def max_translation_m(self) -> float:
        """Return the largest translation error."""
        return max(self.translation_m.values())


def trajectory_errors(
    trajectory: Mapping[int, Array], camera_from_model: Mapping[int, Array], centroid_m: Array
) -> TrajectoryErrors:
    """Compare a trajectory with the truth, aligned at its first frame.

    Args:
        trajectory: object_from_camera (4, 4) by frame number; the lowest is the first.
        camera_from_model: (4, 4) by frame number, of those frames at least.
        centroid_m: (3,) of the object, in the camera of the first frame.

    Raises:
        ValueError: if the trajectory is empty.
    """
    if not trajectory:
        raise ValueError("an empty trajectory has no errors; check that a frame was accepted")
    first = min(trajectory)
    rotation_deg, translation_m = {}, {}
    for frame in sorted(trajectory):
        estimate = se3.inverse(trajectory[first]) @ trajectory[frame]
        truth = true_motion(camera_from_model, first, frame)
        seen_m = se3.transform(se3.inverse(truth), np.asarray(centroid_m)[None])[0]
        rotation_deg[frame] = rotation_error_deg(estimate, truth)
        translation_m[frame] = translation_error_m(estimate, truth, seen_m)
    return TrajectoryErrors(rotation_deg, translation_m)


def align_to_model(trajectory: Mapping[int, Array], camera_from_model: Mapping[int, Array]) -> Array:
    """Return model_from_object (4, 4) that aligns a trajectory with the true model, as the mean over its frames.

    So an error of the first frame is not an error of all others.

    Args:
        trajectory: object_from_camera (4, 4) by frame number.
        camera_from_model: (4, 4) by frame number.

    Raises:
        ValueError: if no frame has both.
    """
    frames = [frame for frame in sorted(trajectory) if frame in camera_from_model]
    if not frames:
        raise ValueError("no frame of the trajectory has a true pose; compare frames of the same sequence")
    relative = [se3.inverse(trajectory[frame] @ camera_from_model[frame]) for frame in frames]
    return se3.mean(np.stack(relative), np.ones(len(relative)))[0]
