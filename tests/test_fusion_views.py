"""Views as fusion takes them: what their pixels weigh, where they see space empty, how far they disagree."""

from dataclasses import replace

import numpy as np
import pytest
import tabletop
from tabletop import BRICK, POSES

from modeler import se3
from modeler.fusion import conditional_covariances
from modeler.fusion.depth_views import (
    Crop,
    Cropping,
    crop,
    depth_views,
    disagreement,
    free_of,
    pose_variances,
    posed_views,
    view_blocks,
)
from modeler.fusion.support import exposure_of
from modeler.types import Array, Edge, Outcome, PoseGaussian, Posterior, RayImage, Solution, Stated

WHOLE = slice(0, tabletop.CAMERA.height), slice(0, tabletop.CAMERA.width)
CORNERS_M = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])
CROPPING = Cropping(margin_px=2, min_cosine=0.15, edge_weight=0.1)


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
    return crop(view, WHOLE, CROPPING)


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


def test_colours_count_less_towards_silhouettes_and_steps_but_not_beside_holes_in_the_depth() -> None:
    view = stepped(0.1)
    depth_m = view.frame.depth_m.copy()
    depth_m[60:64, 80:84] = np.nan
    view = replace(view, frame=replace(view.frame, depth_m=depth_m, mask=view.frame.mask & np.isfinite(depth_m)))
    part = part_of(view)
    clear = np.where(part.index >= 0, part.clearance[part.index], np.nan)
    np.testing.assert_allclose(clear[80, 60:70], (np.arange(10) + 1.5).clip(max=10.0) / 10.0)
    assert clear[80, 99] == pytest.approx(0.05)
    assert (clear[58:66, [78, 85]] == 1.0).all()


def test_a_view_counts_as_little_as_noise_grows_with_distance() -> None:
    """By the square of z², as the noise of a triangulating camera grows."""
    ball = tabletop.Sphere(0.05)
    near = tabletop.turntable(1)[0]
    far = se3.translation(np.array([0.0, 0.0, tabletop.DISTANCE_M])) @ near
    pairs = [(tabletop.view(ball, pose, k), se3.inverse(pose)) for k, pose in enumerate((near, far))]
    seen = depth_views(pairs, CORNERS_M, CROPPING)
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
    seen = depth_views(pairs, CORNERS_M, CROPPING)
    one = seen.only(1)
    assert len(one.index) == len(one.free_m) == len(one.poses) == len(one.intrinsics) == len(one.planes) == 1
    shown = one.index[one.index >= 0]
    assert (seen.views[shown] == 1).all()
    np.testing.assert_array_equal(one.poses[0], seen.poses[1])


def disagreement_m(views, trajectory):
    pairs = posed_views(views, trajectory)
    found = disagreement(view_blocks(pairs, CORNERS_M, CROPPING), 0.02)
    return float("nan") if found is None else found[0]


def test_views_asked_in_batches_disagree_by_the_same(rng, monkeypatch):
    trajectory, noisy = tabletop.trajectory(POSES), tabletop.views(BRICK, POSES, rng)
    at_once = disagreement_m(noisy, trajectory)
    monkeypatch.setattr("modeler.fusion.depth_views.BATCH", 100 * len(POSES))
    assert disagreement_m(noisy, trajectory) == at_once


def test_views_disagree_by_their_noise_and_the_error_of_their_poses(rng):
    trajectory = tabletop.trajectory(POSES)
    exact, noisy = tabletop.views(BRICK, POSES), tabletop.views(BRICK, POSES, rng)
    assert disagreement_m(exact, trajectory) < 1e-4
    # Two pixels with 1 mm along the ray each: less by the cosine along the normal.
    assert 0.4e-3 < disagreement_m(noisy, trajectory) < np.sqrt(2.0) * 1e-3
    off = {k: se3.translation(rng.normal(0.0, 3e-3, 3)) @ pose for k, pose in trajectory.items()}
    assert 2e-3 < disagreement_m(exact, off) < 6e-3
    assert np.isnan(disagreement_m({0: exact[0]}, trajectory))  # nobody to disagree with


def test_conditional_covariances_do_not_know_of_drift(rng):
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-6

    def edge(target, source, *, accepted=True):
        pose = PoseGaussian(se3.exp(rng.normal(size=6)), covariance)
        return Edge(Posterior(source, target, pose, Outcome.CONVERGED, overlap=0.9), "odometry", accepted, Stated(""))

    edges = [edge(2, 5), edge(5, 6), edge(6, 9, accepted=False), edge(2, 6)]
    solution = Solution(trajectory={k: np.eye(4) for k in (2, 5, 6)}, outliers=(edges[3],))
    own = conditional_covariances(solution, edges)
    assert set(own) == {2, 5, 6}
    np.testing.assert_allclose(own[6], covariance)
    np.testing.assert_allclose(own[2], edges[0].posterior.pose.inverse().covariance)
    both = np.linalg.inv(covariance) + np.linalg.inv(edges[1].posterior.pose.inverse().covariance)
    np.testing.assert_allclose(own[5], np.linalg.inv(both))
    assert conditional_covariances(Solution(trajectory={0: np.eye(4)}), []) == {}


def test_sharp_views_have_more_say_in_colours_than_blurred_ones(rng):
    def textured(view: RayImage, spread: int) -> RayImage:
        levels = 120 + rng.integers(-spread, spread + 1, view.frame.depth_m.shape)
        return tabletop.recoloured(view, levels)

    views = {k: textured(view, 60 if k % 3 else 20) for k, view in tabletop.views(BRICK, POSES).items()}
    seen = view_blocks(posed_views(views, tabletop.trajectory(POSES)), CORNERS_M, CROPPING)
    say = exposure_of(seen, tau_m=0.005, near_m=0.003).gains[:, 3]
    sharp = np.arange(len(POSES)) % 3 > 0
    np.testing.assert_allclose(say[~sharp] / say[sharp].mean(), 20.0 / 60.0, rtol=0.15)
