"""Trajectories: how objects move on tables, on turntables and in hands."""

import numpy as np
import pytest

from modeler import se3
from sequences.rendering.trajectory import Hand, RobotReadings, Tabletop, Turntable


def motions(table_from_object: np.ndarray) -> np.ndarray:
    return table_from_object[1:] @ se3.inverse(table_from_object[:-1])


def test_an_object_pushed_about_stays_upright_and_near() -> None:
    poses = Tabletop(2000, 25, 3, 0.03, 0.05).table_from_object(np.zeros(3), np.random.default_rng(0))
    np.testing.assert_allclose(poses[:, 2], np.broadcast_to([0, 0, 1, 0], (2000, 4)), atol=1e-12)
    assert np.hypot(poses[:, 0, 3], poses[:, 1, 3]).max() <= 0.05
    turns_deg = np.degrees(se3.rotation_angle(motions(poses)))
    assert np.mean(turns_deg) == pytest.approx(25, abs=0.3)
    assert np.std(turns_deg) == pytest.approx(3, abs=0.2)
    shifts_m = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)
    assert shifts_m.min() >= 0.015 - 1e-12
    assert shifts_m.max() <= 0.045 + 1e-12


def test_a_turntable_keeps_its_axis() -> None:
    poses = Turntable(50, 24, 0.5).table_from_object(np.zeros(3), np.random.default_rng(0))
    for motion in motions(poses):
        np.testing.assert_allclose(motion[:3, 3], 0.0, atol=1e-12)
        np.testing.assert_allclose(se3.log(motion)[:2], 0.0, atol=1e-12)
        assert np.degrees(se3.log(motion)[2]) == pytest.approx(24, abs=2.5)


def test_a_hand_turns_the_object_about_its_centre() -> None:
    centre_m = np.array([0.0, 0.0, 0.07])
    hand = Hand(400, 18, 3, 0.01, height_m=0.15)
    poses = hand.table_from_object(centre_m, np.random.default_rng(0))
    places_m = (poses @ np.append(centre_m, 1.0))[:, :3]
    np.testing.assert_allclose(places_m.mean(axis=0), [0, 0, 0.15], atol=0.003)
    np.testing.assert_allclose(places_m.std(axis=0), 0.01, rtol=0.15)
    assert np.degrees(se3.rotation_angle(motions(poses))).mean() == pytest.approx(18, abs=0.5)
    axes = se3.log(motions(poses))[:, :3]
    assert np.linalg.matrix_rank(axes, tol=1.0) == 3  # it turns every way


def test_a_robot_reads_its_hand_with_the_noise_it_says() -> None:
    poses = np.broadcast_to(se3.exp(np.arange(6) / 10), (4000, 4, 4))
    read = RobotReadings(2.0, 0.005).camera_from_hand(poses, np.random.default_rng(0))
    spread = se3.log(se3.inverse(poses) @ read).std(axis=0)
    np.testing.assert_allclose(spread, np.repeat([np.radians(2.0), 0.005], 3), rtol=0.05)
