"""The model while frames still come: what is added, taken back and carried along."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import tabletop

from modeler import se3
from modeler.fusion import Fuser, IncrementalTsdf
from modeler.kernels import tsdf as kernels
from modeler.types import Array, RayImage

BALL = tabletop.Sphere(0.06)
POSES = tabletop.turntable(8)
FUSER = Fuser(voxel_m=0.002)


@pytest.fixture(scope="module")
def views() -> Mapping[int, RayImage]:
    return tabletop.views(BALL, POSES, None)


@pytest.fixture(scope="module")
def trajectory() -> Mapping[int, Array]:
    return tabletop.trajectory(POSES, None)


def dilated(views: Mapping[int, RayImage], trajectory: Mapping[int, Array], how: Fuser = FUSER) -> IncrementalTsdf:
    """Return a model to which the views came one by one."""
    tsdf = IncrementalTsdf(how)
    for count in range(1, len(views) + 1):
        tsdf = tsdf.updated(dict(list(views.items())[:count]), trajectory)
    return tsdf


def nudged(trajectory: Mapping[int, Array], seed: int, sigma_m: float = 0.004) -> dict[int, Array]:
    rng = np.random.default_rng(seed)
    return {k: pose @ se3.translation(rng.normal(0.0, sigma_m, size=3)) for k, pose in trajectory.items()}


def settled(
    tsdf: IncrementalTsdf, views: Mapping[int, RayImage], trajectory: Mapping[int, Array]
) -> tuple[IncrementalTsdf, int]:
    """Return the model when it has followed the poses, and in how many steps."""
    for steps in range(100):
        after = tsdf.updated(views, trajectory)
        if after is tsdf:
            return tsdf, steps
        tsdf = after
    raise AssertionError


def off_m(tsdf: IncrementalTsdf) -> Array:
    """Return how far each vertex of the mesh is from the ball."""
    return np.abs(BALL.distance(tsdf.model().vertices_m))


def test_what_is_added_and_taken_back_leaves_nothing():
    rng = np.random.default_rng(0)
    index = np.arange(400, dtype=np.int32).reshape(20, 20) - 40
    points = np.concatenate([rng.uniform(-0.1, 0.1, (360, 2)), rng.uniform(0.4, 0.5, (360, 1))], axis=1)
    normals = np.tile([0.0, 0.0, -1.0], (360, 1))
    seen = (index, np.full((20, 20), 0.6, dtype=np.float32), points, normals, rng.uniform(0.1, 1.0, 360))
    sums = np.zeros((12, 12, 24, 6), dtype=np.float32)
    box = np.array([[2, 0, 0], [12, 11, 24]])
    origin, pose, lens = np.array([-0.04, -0.06, 0.35]), np.eye(4)[:3], np.array([60.0, 60.0, 9.5, 9.5])
    colours = np.concatenate([rng.integers(0, 256, (360, 3)), np.ones((360, 1))], axis=1).astype(np.float64)
    for sign in (1.0, -1.0):
        kernels.integrate_view(sums, box, origin, 0.01, 0.03, 0.3, sign, pose, lens, *seen, colours)
        if sign > 0.0:
            assert np.count_nonzero(sums[..., 0]) > 1000
            assert not sums[:2].any()
            assert not sums[:, 11:].any()  # beyond the box
    assert np.abs(sums).max() < 1e-3


def test_distances_are_those_along_the_normal_within_the_band():
    index = np.zeros((1, 1), dtype=np.int32)
    normal = np.array([[0.0, -0.6, -0.8]])
    sums = np.zeros((1, 1, 40, 6), dtype=np.float32)
    seen = (index, np.full((1, 1), 0.5, dtype=np.float32), np.array([[0.0, 0.0, 0.5]]), normal, np.ones(1))
    origin, pose = np.array([-0.0025, -0.0025, 0.4]), np.eye(4)[:3]
    lens, colours = np.array([1.0, 1.0, 0.0, 0.0]), np.array([[10.0, 20.0, 30.0, 1.0]])
    kernels.integrate_view(
        sums, np.array([[0, 0, 0], [1, 1, 40]]), origin, 0.005, 0.02, 0.3, 1.0, pose, lens, *seen, colours
    )
    along = 0.8 * (0.5 - (0.4 + 0.005 * (np.arange(40) + 0.5)))
    inside = np.abs(along) <= 0.02
    expected = np.where(inside, np.minimum(1.0, 1.5 * (1.0 + along / 0.02) + 1e-3), np.where(along > 0.02, 0.3, 0.0))
    depth = 0.4 + 0.005 * (np.arange(40) + 0.5)
    expected[(along > 0.02) & (depth >= 0.5 - 0.02)] = 0.0  # too near the surface to be called empty
    np.testing.assert_allclose(sums[0, 0, :, 0], expected, rtol=1e-5)
    known = expected > 0.0
    np.testing.assert_allclose(
        sums[0, 0, known, 1] / expected[known], np.where(inside, along, 0.02)[known], rtol=1e-5, atol=1e-7
    )
    np.testing.assert_allclose(sums[0, 0, inside, 3:], expected[inside, None] * [10.0, 20.0, 30.0], rtol=1e-5)


def test_the_preview_is_the_surface_at_every_step(views, trajectory):
    tsdf, triangles = IncrementalTsdf(FUSER), 0
    for count in (1, 3, 8):
        tsdf = tsdf.updated(dict(list(views.items())[:count]), trajectory)
        assert len(tsdf.model().triangles) > triangles
        triangles = len(tsdf.model().triangles)
    model = tsdf.model()
    assert np.quantile(off_m(tsdf), 0.95) < tsdf.voxel_m
    np.testing.assert_array_equal(model.points_m, model.vertices_m)
    outwards = np.einsum("nk,nk->n", model.vertex_normals, model.vertices_m - model.vertices_m.mean(axis=0))
    assert np.mean(outwards > 0.0) > 0.98


def test_a_model_that_followed_the_poses_is_one_made_with_them(views, trajectory):
    before = dilated(views, nudged(trajectory, 1))
    after, steps = settled(before, views, trajectory)
    assert steps >= 1
    fresh = dilated(views, trajectory)
    low = np.maximum(after.low, fresh.low)
    high = np.minimum(np.add(after.low, after.sums.shape[:3]), np.add(fresh.low, fresh.sums.shape[:3]))

    def inner(tsdf: IncrementalTsdf) -> npt.NDArray[np.float32]:
        x, y, z = (slice(a - o, b - o) for a, b, o in zip(low, high, tsdf.low, strict=True))
        return tsdf.sums[x, y, z]

    # Views were added when the box was smaller or larger, so that what they saw empty far out may differ.
    near = inner(fresh)[..., 0] > 0.5
    values = [inner(tsdf)[..., 1][near] / inner(tsdf)[..., 0][near] for tsdf in (after, fresh)]
    assert np.mean(np.abs(values[0] - values[1]) > 0.5 * after.voxel_m) < 0.02
    assert np.median(np.abs(values[0] - values[1])) < 0.25 * after.voxel_m  # poses within half a voxel stay


def test_few_views_move_at_a_time_those_that_moved_most_first(views, trajectory):
    how = replace(FUSER, preview_moves=2)
    before = dilated(views, trajectory, how)
    shifts_m = dict(zip(views, [0.0, 0.001, 0.02, 0.03, 0.01, 0.0, 0.04, 0.05], strict=True))
    moved = {k: se3.translation(np.array([shifts_m[k], 0.0, 0.0])) @ pose for k, pose in trajectory.items()}
    order = []
    tsdf = before
    for _ in range(10):
        after = tsdf.updated(views, moved)
        if after is tsdf:
            break
        order.append({k for k in views if after.integrated[k] is not tsdf.integrated[k]})
        tsdf = after
    frames = list(views)
    assert order == [{frames[7], frames[6]}, {frames[3], frames[2]}, {frames[4]}]  # 1 mm is less than half a voxel


def test_nothing_new_changes_nothing_and_earlier_models_stay(views, trajectory):
    tsdf = dilated(views, trajectory)
    sums = tsdf.sums.copy()
    assert tsdf.updated(views, trajectory) is tsdf
    tsdf.updated(views, nudged(trajectory, 2, 0.02))
    np.testing.assert_array_equal(tsdf.sums, sums)


def test_a_view_that_loses_its_pose_is_taken_back(views, trajectory):
    frames = list(views)
    without = {k: pose for k, pose in trajectory.items() if k != frames[-1]}
    tsdf = dilated(views, trajectory).updated(views, without)
    assert set(tsdf.integrated) == set(frames[:-1])
    fresh = dilated({k: views[k] for k in frames[:-1]}, without)
    assert len(tsdf.model().triangles) == pytest.approx(len(fresh.model().triangles), rel=0.01)


def test_the_voxels_grow_until_the_box_is_small_enough(views, trajectory):
    coarse = dilated(views, trajectory, replace(FUSER, preview_limit=16_000))
    assert coarse.sums[..., 0].size <= 16_000
    assert coarse.voxel_m > 2.5 * 0.002
    assert len(coarse.integrated) == len(views)
    assert np.median(off_m(coarse)) < coarse.voxel_m


def test_colours_are_those_of_the_views_and_grey_without(views, trajectory):
    plain = {k: replace(view, frame=replace(view.frame, colour=None)) for k, view in views.items()}
    assert dilated(plain, trajectory).model().vertex_colours is None
    frame = next(iter(views))
    view = views[frame]
    red = np.zeros((*view.frame.depth_m.shape, 3), dtype=np.uint8)
    red[..., 0] = 200
    texture_colours = {**plain, frame: replace(view, frame=replace(view.frame, colour=red))}
    model = dilated(texture_colours, trajectory).model()
    assert model.vertex_colours is not None
    seen = model.vertex_colours[:, 0] != model.vertex_colours[:, 1]
    assert 0.1 < np.mean(seen) < 0.9
    assert {tuple(rgb) for rgb in model.vertex_colours} == {(200, 0, 0), (128, 128, 128)}
