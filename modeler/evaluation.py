"""Errors of motions, trajectories and surfaces against ground truth, and calibration of covariances.

Truth is `camera_from_model(k)`: the pose (4, 4) of the object's model in the camera at frame k. Motions are compared in
the source camera, translations at the object's centroid: displacements of the object due to a rotation error about the
camera are included.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import gammaincinv

from modeler import se3
from modeler.fusion.paint import SurfacePoints
from modeler.system.pictures import raycaster, tensor
from modeler.types import Array, BoolArray, Frame, PoseGaussian, areas_m2

LEVELS = (0.5, 0.9, 0.95)  # nominal probabilities of the regions whose coverage is reported


def true_motion(camera_from_model: Mapping[int, Array], target: int, source: int) -> Array:
    """Return the true target_from_source (4, 4)."""
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
    """Compare a trajectory with the truth, aligned at its first frame; ValueError if the trajectory is empty.

    Args:
        trajectory: object_from_camera (4, 4) by frame number; the lowest is the first.
        camera_from_model: (4, 4) by frame number, of those frames at least.
        centroid_m: (3,) of the object, in the camera of the first frame.
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


SAMPLES = 50_000  # points drawn on a surface: less than 1 % of its size apart
_REACHED = 1.0 - 1e-5  # share of the way to a point after which nothing hides it but itself


@dataclass(frozen=True, eq=False)
class SurfaceErrors:
    """Distances between a reconstructed and a true surface."""

    to_truth_m: Array
    """(n,) from points spread evenly over the reconstruction to the true surface."""
    to_reconstruction_m: Array
    """(m,) from points spread evenly over the true surface to the reconstruction."""

    @property
    def accuracy_m(self) -> float:
        """Mean distance from the reconstruction to the truth."""
        return float(np.mean(self.to_truth_m))

    @property
    def completeness_m(self) -> float:
        """Mean distance from the truth to the reconstruction."""
        return float(np.mean(self.to_reconstruction_m))

    def accurate(self, threshold_m: float) -> float:
        """Return the share (0..1) of the reconstruction within a distance of the truth (precision)."""
        return float(np.mean(self.to_truth_m <= threshold_m))

    def complete(self, threshold_m: float) -> float:
        """Return the share (0..1) of the truth within a distance of the reconstruction (recall)."""
        return float(np.mean(self.to_reconstruction_m <= threshold_m))

    def f_score(self, threshold_m: float) -> float:
        """Return the harmonic mean of both shares."""
        accurate, complete = self.accurate(threshold_m), self.complete(threshold_m)
        total = accurate + complete
        return 2.0 * accurate * complete / total if total > 0.0 else 0.0

    def over(self, chosen: BoolArray) -> SurfaceErrors:
        """Return the errors where nothing but some of the true surface's points (m,) has to be there."""
        return replace(self, to_reconstruction_m=self.to_reconstruction_m[chosen])


@dataclass(frozen=True, eq=False)
class TrueSurface:
    """A true surface."""

    vertices_m: Array
    """(v, 3) in the model frame."""
    triangles: npt.NDArray[np.int64]
    """(t, 3) vertex numbers."""
    points_m: Array
    """(m, 3) spread evenly over it."""

    @staticmethod
    def of(
        vertices_m: Array, triangles: npt.NDArray[np.int64], rng: np.random.Generator, count: int = SAMPLES
    ) -> TrueSurface:
        """Return a mesh with points on it; ValueError if the mesh has no area."""
        return TrueSurface(vertices_m, triangles, sample_surface(vertices_m, triangles, count, rng))

    def seen(self, frames: Iterable[tuple[Frame, Array]]) -> BoolArray:
        """Return which of the points (m,) at least one frame measured: in sight, at an object pixel with depth.

        Args:
            frames: with their true camera_from_model (4, 4). A frame without a mask shows nothing but the object.
        """
        scene = raycaster(self.vertices_m, self.triangles)
        seen = np.zeros(len(self.points_m), dtype=bool)
        for frame, camera_from_model in frames:
            camera, measured = frame.camera, np.isfinite(frame.depth_m)
            measured = measured if frame.mask is None else measured & frame.mask
            x, y, z = se3.transform(camera_from_model, self.points_m).T
            safe = np.where(z > 0.0, z, 1.0)
            columns = np.rint(camera.fx * x / safe + camera.cx).astype(np.int64)
            rows = np.rint(camera.fy * y / safe + camera.cy).astype(np.int64)
            inside = (z > 0.0) & (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
            candidates = np.flatnonzero(inside & ~seen)
            candidates = candidates[measured[rows[candidates], columns[candidates]]]
            centre_m = se3.inverse(camera_from_model)[:3, 3]
            directions = self.points_m[candidates] - centre_m
            rays = np.concatenate([np.broadcast_to(centre_m, directions.shape), directions], axis=1)
            reached = scene.cast_rays(tensor(rays))["t_hit"].numpy()
            seen[candidates[reached > _REACHED]] = True
        return seen


def surface_errors(
    vertices_m: Array, triangles: npt.NDArray[np.int64], truth: TrueSurface, rng: np.random.Generator
) -> SurfaceErrors:
    """Compare a mesh with the true surface, both in the model frame; ValueError if the mesh has no area.

    Distances are from points drawn evenly by area to the nearest place on the other's triangles.

    Args:
        vertices_m: (v, 3).
        triangles: (t, 3) vertex numbers.
        truth: the true surface.
        rng: draws the points on the mesh.
    """

    def far_m(points_m: Array, vertices_m: Array, triangles: npt.NDArray[np.int64]) -> Array:
        return raycaster(vertices_m, triangles).compute_distance(tensor(points_m)).numpy().astype(np.float64)

    points_m = sample_surface(vertices_m, triangles, len(truth.points_m), rng)
    return SurfaceErrors(
        to_truth_m=far_m(points_m, truth.vertices_m, truth.triangles),
        to_reconstruction_m=far_m(truth.points_m, vertices_m, triangles),
    )


def sample_surface(vertices_m: Array, triangles: npt.NDArray[np.int64], count: int, rng: np.random.Generator) -> Array:
    """Return points (count, 3) drawn evenly over the area of a mesh; ValueError if the mesh has no area.

    Args:
        vertices_m: (v, 3).
        triangles: (t, 3) vertex numbers.
        count: number of points.
        rng: source of randomness.
    """
    if not areas_m2(vertices_m, triangles).sum() > 0.0:
        raise ValueError("a mesh without area has no surface to sample")
    return SurfacePoints.draw(vertices_m, triangles, count, rng).of(vertices_m)
