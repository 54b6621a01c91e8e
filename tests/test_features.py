"""Points recognised by shape: features do not depend on the camera, matches on both sides, motions on noise alone."""

from dataclasses import replace

import numpy as np
from prior_cases import surface

from modeler import se3
from modeler.evaluation import rotation_error_deg, true_motion
from modeler.registration.features import FeatureMatcher, fpfh, kabsch, mutual_matches
from modeler.sequences.rendering import RenderedSequence
from studies.calibration.specimens import load_specimen
from studies.calibration.study import Condition, rendered_views, staged

MOVED = se3.exp(np.array([0.3, -0.8, 0.5, 0.1, -0.2, 0.4]))


def test_features_do_not_depend_on_the_camera_frame() -> None:
    points_m, normals = surface(400)
    before = fpfh(points_m, normals, 0.02)
    after = fpfh(se3.transform(MOVED, points_m), normals @ MOVED[:3, :3].T, 0.02)
    assert before.shape == (400, 33)
    assert np.mean(np.abs(after - before).max(axis=1) < 1e-3) > 0.97  # but for bins whose edge a rounding passes


def test_matches_are_nearest_both_ways_unless_few_are() -> None:
    source = np.eye(12)
    target = np.roll(source, 1, axis=0)
    pairs = mutual_matches(source, np.concatenate([target, target[:1] + 0.01]))
    np.testing.assert_array_equal(pairs, np.column_stack([np.arange(12), (np.arange(12) + 1) % 12]))
    alike = mutual_matches(np.ones((5, 3)), np.ones((7, 3)))
    assert len(alike) == 5  # one pair is mutual: of so few none is to be left out


def test_three_points_or_more_fix_a_motion_and_never_a_mirror_image() -> None:
    rng = np.random.default_rng(0)
    for count in (3, 8):
        points_m = rng.normal(size=(50, count, 3))
        carried = se3.transform(MOVED, points_m.reshape(-1, 3)).reshape(points_m.shape)
        np.testing.assert_allclose(kabsch(points_m, carried), np.tile(MOVED, (50, 1, 1)), atol=1e-9)
        mirrored = kabsch(points_m, points_m * [1.0, 1.0, -1.0])
        np.testing.assert_allclose(np.linalg.det(mirrored[:, :3, :3]), 1.0)


def test_matches_that_fit_each_other_fix_the_motion() -> None:
    sequence = RenderedSequence(staged(load_specimen("toy_car"), Condition(step_deg=50.0), frames=2, seed=1))
    views, (earlier, later) = rendered_views(sequence), sequence.indices
    motions, votes = FeatureMatcher().motions(views[later], views[earlier])
    truth = true_motion(sequence.truth(), earlier, later)
    assert min(rotation_error_deg(motion, truth) for motion in motions[:20]) < 10.0
    assert (np.diff(votes) <= 0).all()
    few = replace(views[later], points_m=views[later].points_m[:20], normals=views[later].normals[:20])
    assert FeatureMatcher().motions(few, views[earlier])[0].shape == (0, 4, 4)
