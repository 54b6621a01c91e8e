"""Standard deviations of vertices hold what errors of views, poses and smoothing do to the surface."""

import numpy as np
import pytest
import tabletop
import trimesh
from tabletop import BALL, POSES

from modeler import se3
from modeler.fusion import Fuser
from modeler.fusion.meshing import flattened_m, normals_of
from modeler.types import ObjectModel, Solution
from modeler.verdict.spreads import widened


def test_smoothing_moves_a_ball_by_its_curvature() -> None:
    """By the variance of the kernel times the mean curvature."""
    ball = trimesh.creation.icosphere(5, 0.05)
    vertices_m, triangles = np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int64)
    for moment_m2 in (1e-6, 1e-5, 1e-4):  # the last is beyond the passes
        moved_m = flattened_m(vertices_m, triangles, vertices_m / 0.05, moment_m2)
        assert np.mean(moved_m) == pytest.approx(moment_m2 / 0.05, rel=0.05)  # triangles differ in size
        np.testing.assert_allclose(moved_m, moment_m2 / 0.05, rtol=0.25)


def test_smoothing_moves_what_is_near_an_edge() -> None:
    """Half a kernel beside it as well, where smoothed surface is flat again."""
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    for _ in range(5):
        box = box.subdivide()
    vertices_m, triangles = np.asarray(box.vertices), np.asarray(box.faces, dtype=np.int64)
    moved_m = flattened_m(vertices_m, triangles, normals_of(vertices_m, triangles), 1e-4)
    beside = np.sort(0.05 - np.abs(vertices_m), axis=1)  # distances from the planes of three faces
    near = np.isclose(beside[:, 0], 0.0) & (beside[:, 1] > 0.003) & (beside[:, 1] < 0.007)
    middle = np.isclose(beside[:, 0], 0.0) & (beside[:, 1] > 0.045)
    assert moved_m[near].min() > 1e-3
    assert moved_m[middle].max() < 1e-4


def test_smoothing_moves_no_plane() -> None:
    places = np.stack([*np.meshgrid(np.arange(20.0), np.arange(20.0)), np.zeros((20, 20))], axis=-1).reshape(-1, 3)
    first = (20 * np.arange(19)[:, None] + np.arange(19)).ravel()
    triangles = np.concatenate([first[:, None] + [0, 1, 21], first[:, None] + [0, 21, 20]])
    assert np.all(flattened_m(places, triangles, np.tile([0.0, 0.0, 1.0], (400, 1)), 9.0) == 0.0)


def test_errors_of_poses_move_vertices_by_their_views(rng: np.random.Generator) -> None:
    """Against the joint covariance of all poses."""
    trajectory = tabletop.trajectory(POSES)
    spread = rng.normal(size=(6 * len(POSES), 6 * len(POSES))) * 1e-3
    joint = (spread @ spread.T).reshape(len(POSES), 6, len(POSES), 6).swapaxes(1, 2)  # (i, j, 6, 6)

    def apart(target: int, source: int) -> np.ndarray:
        own = joint[target, target] + joint[source, source] - joint[target, source] - joint[source, target]
        turned = se3.adjoint(se3.inverse(trajectory[source]))
        return turned @ own @ turned.T

    vertices_m = rng.normal(size=(40, 3)) * 0.05
    normals = vertices_m / np.linalg.norm(vertices_m, axis=1, keepdims=True)
    empty = np.zeros((0, 3))
    sides = np.zeros((0, 3), np.int64)
    exact = ObjectModel(empty, empty, None, vertices_m, sides, normals, None, None, np.zeros(40))
    solution = Solution(trajectory, relative_covariance=apart, deforming_covariance=apart)
    found = widened(exact, solution).vertex_sigmas_m
    assert found is not None
    for vertex_m, normal, sigma_m in zip(vertices_m, normals, found, strict=True):
        rays = np.array([pose[:3, 3] - vertex_m for pose in trajectory.values()])
        cosines = rays @ normal / np.linalg.norm(rays, axis=1)
        shares = np.where(cosines >= Fuser.min_cosine, cosines, 0.0)
        row = np.concatenate([np.cross(vertex_m, normal), normal])
        moves = np.outer(shares / shares.sum() - 1.0 / len(POSES), row).ravel() if shares.any() else np.zeros(84)
        whole = joint.swapaxes(1, 2).reshape(6 * len(POSES), -1)
        np.testing.assert_allclose(sigma_m, np.sqrt(moves @ whole @ moves), rtol=1e-6, atol=1e-9)


def test_a_bent_turn_is_as_far_off_as_stated(rng: np.random.Generator) -> None:
    """Half of the views have moved as a whole: neighbours agree, and only the graph knows."""
    half, sigma_m, fuser = len(POSES) // 2, 1e-3, Fuser(voxel_m=0.004)
    spread = np.diag([0.0, 0.0, 0.0, *[2.0 * sigma_m**2] * 3])  # of shifts; a turn changes nothing about it

    def apart(target: int, source: int) -> np.ndarray:
        return spread if (target < half) != (source < half) else np.zeros((6, 6))

    squares, single = [], []
    for axis in np.eye(3):  # as far apart along each as the mean square of shifts drawn at random
        shifts_m = np.sqrt(1.5) * sigma_m * np.array([axis, -axis])
        bent = {
            frame: se3.translation(shifts_m[int(frame < half)]) @ pose
            for frame, pose in tabletop.trajectory(POSES).items()
        }
        model = fuser.fuse(tabletop.views(BALL, POSES, rng), bent)
        wide = widened(model, Solution(bent, relative_covariance=apart, deforming_covariance=apart))
        assert wide.vertex_sigmas_m is not None
        assert model.vertex_sigmas_m is not None
        off_m = BALL.distance(model.vertices_m)
        squares.append((off_m / wide.vertex_sigmas_m) ** 2)
        single.append((off_m / model.vertex_sigmas_m) ** 2)
    squares = np.concatenate(squares)
    assert 0.5 < squares.mean() < 1.3
    assert np.mean(squares < 1.96**2) > 0.93
    assert np.concatenate(single).mean() > 1.5 * squares.mean()
