"""Trajectories: how objects move on tables, on turntables and in hands."""

from dataclasses import replace

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


@pytest.mark.parametrize("kind", [Tabletop, Turntable])
def test_motions_wobble_as_much_as_is_said(kind: type[Tabletop | Turntable]) -> None:
    wobbling = kind(4001, wobble_deg=0.2, wobble_m=0.0007).table_from_object(np.zeros(3), np.random.default_rng(0))
    tilted = motions(wobbling)[:, :3, 2]  # where motions take the vertical
    np.testing.assert_allclose(np.degrees(tilted[:, :2].std(axis=0)), 0.2, rtol=0.05)
    np.testing.assert_allclose(np.degrees(tilted[:, :2].mean(axis=0)), 0.0, atol=0.01)
    lifts_m = np.diff(wobbling[:, 2, 3])
    assert np.std(lifts_m) == pytest.approx(0.0007, rel=0.05)
    assert abs(np.corrcoef(tilted[:, 0], lifts_m)[0, 1]) < 0.06


@pytest.mark.parametrize("kind", [Tabletop, Turntable])
@pytest.mark.parametrize(("wobble_deg", "wobble_m"), [(0.2, 0.0), (0.0, 0.0007), (0.2, 0.0007)])
def test_a_wobble_is_about_the_foot_and_changes_nothing_else(
    kind: type[Tabletop | Turntable], wobble_deg: float, wobble_m: float
) -> None:
    true = kind(50).table_from_object(np.zeros(3), np.random.default_rng(0))
    trajectory = kind(50, wobble_deg=wobble_deg, wobble_m=wobble_m)
    wobbling = trajectory.table_from_object(np.zeros(3), np.random.default_rng(0))
    wobble = se3.inverse(true) @ wobbling
    turn, lift_m = se3.log(wobble)[:, :3], wobble[:, :3, 3]
    np.testing.assert_allclose(turn[:, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(lift_m[:, :2], 0.0, atol=1e-12)
    assert len(np.unique(turn[:, :2])) == (100 if wobble_deg else 1)  # every frame its own, the first too
    assert len(np.unique(lift_m[:, 2])) == (50 if wobble_m else 1)
    shorter = replace(trajectory, frames=20).table_from_object(np.zeros(3), np.random.default_rng(0))
    np.testing.assert_array_equal(shorter, wobbling[:20])


def test_what_does_not_wobble_draws_the_steps_alone() -> None:
    rng, alike = np.random.default_rng(0), np.random.default_rng(0)
    poses = Turntable(50, 24, 0.5).table_from_object(np.zeros(3), rng)
    turns_deg = np.degrees(se3.log(motions(poses))[:, 2])
    np.testing.assert_allclose(turns_deg, alike.normal(24, 0.5, 49), atol=1e-9)
    assert rng.bit_generator.state == alike.bit_generator.state
    pushed = Tabletop(50, shift_m=0.0, wobble_deg=0.0, wobble_m=0.0)
    rng, alike = np.random.default_rng(0), np.random.default_rng(0)
    turns_deg = np.degrees(se3.log(motions(pushed.table_from_object(np.zeros(3), rng)))[:, 2])
    drawn_deg = []
    for _ in range(49):
        drawn_deg.append(alike.normal(25, 3))
        alike.uniform(size=2)  # the shift's direction and length
    np.testing.assert_allclose(turns_deg, drawn_deg, atol=1e-9)
    assert rng.bit_generator.state == alike.bit_generator.state


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
