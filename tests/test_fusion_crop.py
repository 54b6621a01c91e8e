"""One view cut to the object: what its pixels weigh, and up to where they see space empty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tabletop

from modeler import se3
from modeler.fusion.depth_views import Crop, crop, depth_views, free_of, pose_variances
from modeler.types import Array, RayImage

WHOLE = slice(0, tabletop.CAMERA.height), slice(0, tabletop.CAMERA.width)
CORNERS_M = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])


def stepped(step_m: float) -> RayImage:
    """A view of a wall that faces the camera and is `step_m` farther away in its right half."""
    shape = tabletop.CAMERA.height, tabletop.CAMERA.width
    depth_m = np.full(shape, 0.8, dtype=np.float32)
    depth_m[:, shape[1] // 2 :] += np.float32(step_m)
    blank = tabletop.view(tabletop.Sphere(0.05), tabletop.turntable(1)[0], 0).frame
    mask = np.zeros(shape, dtype=bool)
    mask[40:120, 60:140] = True
    frame = replace(blank, depth_m=depth_m, mask=mask)
    return tabletop.seen(frame, np.tile([0.0, 0.0, -1.0], (int(mask.sum()), 1)), 1e-4)


def part_of(view: RayImage) -> Crop:
    return crop(view, WHOLE, margin_px=2, min_cosine=0.15, edge_weight=0.1)


def weight_image(part: Crop) -> Array:
    return np.where(part.index >= 0, part.weights[part.index], np.nan)


@pytest.mark.parametrize(("step_m", "share"), [(0.0, 1.0), (0.01, 1.0), (0.1, 0.1)])
def test_pixels_beside_a_silhouette_or_a_step_in_depth_count_little(step_m: float, share: float) -> None:
    """A step that a steep surface could make is none."""
    weights = weight_image(part_of(stepped(step_m)))
    assert (weights[80, [60, 139]] < 0.11).all()
    assert (weights[[40, 119], 100] < 0.11).all()
    assert (weights[50:110, [62, 97, 102, 137]] > 0.9).all()
    np.testing.assert_allclose(weights[50:110, [99, 100]], share, rtol=0.1)


def test_a_view_counts_as_little_as_noise_grows_with_distance() -> None:
    """By the square of z², as the noise of a triangulating camera grows."""
    ball = tabletop.Sphere(0.05)
    near = tabletop.turntable(1)[0]
    far = se3.translation(np.array([0.0, 0.0, tabletop.DISTANCE_M])) @ near
    pairs = [(tabletop.view(ball, pose, k), se3.inverse(pose)) for k, pose in enumerate((near, far))]
    seen = depth_views(pairs, CORNERS_M, margin_px=2, min_cosine=0.15, edge_weight=0.1)
    most = [seen.weights[seen.views == number].max() for number in (0, 1)]
    assert most[1] / most[0] == pytest.approx((0.75 / 1.55) ** 4, rel=0.02)


def test_space_is_empty_as_far_as_all_around_see() -> None:
    depth_m = np.full((9, 9), 1.0, dtype=np.float32)
    depth_m[4, 4], depth_m[0, 0], depth_m[8, 8] = 0.5, np.nan, 0.0
    free_m = free_of(depth_m, 2)
    assert (free_m[2:7, 2:7] == 0.5).all()
    assert free_m[0, 0] == free_m[8, 8] == 0.0
    assert free_m[0, 1] == free_m[8, 7] == 1.0  # what is not measured forbids nothing


def test_a_pose_that_may_turn_moves_points_along_their_normals() -> None:
    """Against random motions of the pose itself."""
    rng = np.random.default_rng(0)
    view = tabletop.view(tabletop.Box((0.06, 0.045, 0.08)), tabletop.turntable(1)[0], 0)
    part = part_of(replace(view, sigma_r_m=0.001))
    factor = 1e-4 * rng.normal(size=(6, 6))
    moved = se3.exp(rng.normal(size=(4000, 6)) @ factor.T)
    some = np.arange(0, len(part.points_m), len(part.points_m) // 20)
    carried = part.points_m[some] @ np.swapaxes(moved[:, :3, :3], 1, 2) + moved[:, None, :3, 3]
    along_m = np.sum((carried - part.points_m[some]) * part.normals[some], axis=2)
    variances = pose_variances(part, factor @ factor.T, 0.001)[some]
    np.testing.assert_allclose(variances, np.var(along_m, axis=0) / 0.0005**2, rtol=0.12)
    assert not pose_variances(part, None, 0.001).any()


def test_one_view_of_a_stack_is_looked_up_alone() -> None:
    poses = tabletop.turntable(3)
    views = tabletop.views(tabletop.Sphere(0.05), poses)
    pairs = [(views[k], se3.inverse(pose)) for k, pose in enumerate(poses)]
    seen = depth_views(pairs, CORNERS_M, margin_px=2, min_cosine=0.15, edge_weight=0.1)
    one = seen.only(1)
    assert len(one.index) == len(one.free_m) == len(one.poses) == len(one.intrinsics) == len(one.planes) == 1
    shown = one.index[one.index >= 0]
    assert (seen.views[shown] == 1).all()
    np.testing.assert_array_equal(one.poses[0], seen.poses[1])
