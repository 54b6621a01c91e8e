"""The test that drops motions before their likelihood is summed, and the motions that are drawn by number."""

import numba
import numpy as np
import pytest
from prior_cases import views
from scipy.spatial.transform import Rotation
from slow_cases import sampled
from test_kernels import ANISOTROPIC, INTRINSICS, ISOTROPIC, SHAPE, random_pose

from modeler import se3
from modeler.baselines.paper import FreeSpace, Measured, NumberedDraws
from modeler.kernels import paper as kernel
from modeler.priors import TablePrior
from modeler.priors.general import GeneralDensity, GeneralPrior
from modeler.se3 import matrices, rows

CENTRE_M = np.array([0.02, -0.03, 0.8])
MIDDLE = se3.exp(np.array([0.3, -0.5, 0.2, 0.0, 0.0, 0.0]))[:3, :3]
MOTION = GeneralDensity(CENTRE_M, CENTRE_M + 0.05, np.radians(50.0), 0.04, MIDDLE)
# Lateral and range noise that leave windows of several pixels in an image of 64 px.
NOISES = {
    "isotropic": 0.3 * ISOTROPIC,
    "far in range": np.diag([0.004, 0.004, 0.01]) ** 2,
    "wide": np.diag([0.03, 0.01, 0.002]) ** 2,
    "anisotropic": 0.02 * ANISOTROPIC,
}


def scene(rng, noise, gaps=0.0):
    """Return a view of random points in front of background, with a share of pixels missing."""
    scale = 4.0
    shape = int(scale * SHAPE[0]), int(scale * SHAPE[1])
    ranges_m = np.full(shape, rng.uniform(0.9, 2.0))
    ranges_m[16:48, 20:60] = rng.uniform(0.7, 0.9) + 0.02 * rng.random((32, 40))
    ranges_m[rng.random(shape) < gaps] = 0.0
    z = rng.uniform(0.7, 0.85, 12)
    points_m = np.stack([rng.uniform(-0.15, 0.15, 12), rng.uniform(-0.12, 0.12, 12), z], axis=1)
    return Measured(points_m, ranges_m, scale * INTRINSICS, noise)


@pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES.keys())
@pytest.mark.parametrize("options", [(4.0, 1e-6), (2.0, 1e-2), (6.0, 1e-12)])
@pytest.mark.parametrize("seed", sampled(range(4), every=4))
def test_what_is_forbidden_has_no_likelihood(noise, options, seed):
    rng = np.random.default_rng(seed)
    source, target = (scene(rng, noise, (0.0, 1e-3, 0.02)[seed % 3]) for _ in range(2))
    free = FreeSpace.of(source, target, *options)
    poses = rows(np.stack([random_pose(rng, 0.3) for _ in range(300)]))
    verdicts = kernel.verdicts(poses, free.checks, free.near_m, free.images)
    assert 0.02 < verdicts.mean() < 0.98
    np.testing.assert_array_equal(free.passes(poses), ~verdicts.any(axis=1))
    sides = (
        (poses, source, target, verdicts[:, :12]),
        (rows(se3.inverse(matrices(poses))), target, source, verdicts[:, 12:]),
    )
    for motions, own, other, forbidden in sides:
        for k, point in enumerate(own.points_m):
            rejected = motions[forbidden[:, k]]
            values = kernel.log_likelihoods(
                rejected, point[None], other.ranges_m, other.intrinsics, noise, np.array(options)
            )
            assert np.isneginf(values).all()


def test_most_of_what_has_no_likelihood_is_forbidden(rng):
    source, target = scene(rng, NOISES["isotropic"]), scene(rng, NOISES["isotropic"])
    poses = rows(np.stack([random_pose(rng, 0.3) for _ in range(500)]))
    free = FreeSpace.of(source, target, 4.0, 1e-6)
    options = np.array([4.0, 1e-6])
    values = kernel.log_likelihoods(poses, source.points_m, target.ranges_m, target.intrinsics, target.noise, options)
    assert free.passes(poses).sum() - np.isfinite(values).sum() < 0.1 * len(poses)


@pytest.mark.parametrize("options", [(4.0, 0.0), (np.inf, 1e-6)])
def test_nothing_is_forbidden_where_nothing_is_bounded(rng, options):
    free = FreeSpace.of(scene(rng, NOISES["isotropic"]), scene(rng, NOISES["isotropic"]), *options)
    poses = rows(np.stack([random_pose(rng) for _ in range(20)]))
    assert free.ordered(poses).passes(poses).all()


def test_order_changes_no_verdict(rng):
    free = FreeSpace.of(scene(rng, NOISES["isotropic"]), scene(rng, NOISES["isotropic"]), 4.0, 1e-6)
    poses = rows(np.stack([random_pose(rng, 0.3) for _ in range(300)]))
    ordered = free.ordered(poses)
    np.testing.assert_array_equal(np.sort(ordered.checks, axis=0), np.sort(free.checks, axis=0))
    np.testing.assert_array_equal(ordered.passes(poses), free.passes(poses))
    forbidden = kernel.verdicts(poses, free.checks, free.near_m, free.images)
    first = kernel.verdicts(poses, ordered.checks[:1], ordered.near_m, ordered.images)
    assert first.sum() == forbidden.sum(axis=0).max()


def test_nearest_ranges_are_least_within_the_ellipse(rng):
    ranges_m = rng.uniform(0.5, 2.0, (14, 17))
    reach_px = np.array([3.3, 2.2])
    near_m = kernel.nearest_ranges(ranges_m, reach_px)
    across, down = (near_m.shape[1] - 17) // 2, (near_m.shape[0] - 14) // 2
    row, column = np.indices(ranges_m.shape)
    for v, u in rng.uniform([-down, -across], [13 + down, 16 + across], (500, 2)):
        within = ((column - u) / reach_px[0]) ** 2 + ((row - v) / reach_px[1]) ** 2 <= 1.0
        least = ranges_m[within].min() if within.any() else np.inf
        assert near_m[int(v + down + 0.5), int(u + across + 0.5)] <= least


@pytest.mark.slow
def test_motions_drawn_by_number_are_those_of_the_prior():
    count = 200_000
    draws = NumberedDraws.of(MOTION, np.random.default_rng(3))
    poses = matrices(draws.poses(0, count))
    assert np.isfinite(MOTION.log_density(poses)).all()
    turns = poses[:, :3, :3]
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-12)
    # Every one of these is even over 0..1, whatever the others are.
    xi = Rotation.from_matrix(turns @ MIDDLE.T).as_rotvec()
    angle = np.linalg.norm(xi, axis=1)
    limit = MOTION.max_rotation_rad
    offset = turns @ CENTRE_M + poses[:, :3, 3] - MOTION.target_centroid_m
    radius = np.linalg.norm(offset, axis=1)
    even = np.column_stack(
        [
            (angle - np.sin(angle)) / (limit - np.sin(limit)),
            0.5 + 0.5 * xi / angle[:, None],
            (radius / MOTION.max_offset_m) ** 3,
            0.5 + 0.5 * offset / radius[:, None],
        ]
    )
    # Kolmogorov's statistic: beyond 2.2 once in 8000 draws.
    steps = np.arange(1, count + 1) / count
    distance = np.abs(np.sort(even, axis=0) - steps[:, None]).max(axis=0)
    assert (np.sqrt(count) * distance < 2.2).all()
    # What is independent under the prior is so here: rotation, offset, and one number and the next.
    ranks = np.column_stack([even, np.roll(even, 1, axis=0)]) - 0.5
    correlation = np.corrcoef(ranks.T)
    np.fill_diagonal(np.asarray(correlation), 0.0)
    assert np.abs(correlation).max() < 5.0 / np.sqrt(count)


def test_a_spread_too_wide_to_draw_by_trying_is_left_to_the_prior(rng):
    wide = GeneralDensity(CENTRE_M, CENTRE_M, np.radians(170.0), 0.04)
    assert NumberedDraws.of(wide, rng) is None
    assert NumberedDraws.of(TablePrior().between(*views(np.eye(4))), rng) is None
    narrow = GeneralPrior().relaxed(100.0).max_rotation_deg
    assert NumberedDraws.of(GeneralDensity(CENTRE_M, CENTRE_M, np.radians(narrow), 0.04), rng) is not None


def test_which_motions_pass_depends_on_no_thread_and_no_batch(rng):
    free = FreeSpace.of(scene(rng, NOISES["isotropic"]), scene(rng, NOISES["isotropic"]), 4.0, 1e-6)
    spread = GeneralDensity(CENTRE_M, CENTRE_M, 0.3, 0.04)
    draws = NumberedDraws.of(spread, rng)
    drawn = draws.poses(0, 30_000)
    passes = free.passes(drawn)
    assert 0 < passes.sum() < 30_000
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        parts = [draws.poses(first, 10_000) for first in (0, 10_000, 20_000)]
        assert np.concatenate(parts).tobytes() == drawn.tobytes()
        assert np.concatenate([free.passes(part) for part in parts]).tobytes() == passes.tobytes()
    finally:
        numba.set_num_threads(threads)
