"""What single priors know: turntables and their axes, hands, pokes, pace, marked objects, and combinations."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from prior_cases import (
    AXIS_POINT_M,
    NORMAL,
    STEP,
    edges,
    hand,
    held,
    solution,
    stated,
    truth,
    turned,
    turntable,
    view,
    views,
)

from modeler import se3
from modeler.priors import (
    FeaturesPrior,
    GeneralPrior,
    HeldPrior,
    Poke,
    PokePrior,
    ProductPrior,
    TablePrior,
    TurntablePrior,
    VelocityPrior,
)
from modeler.priors.common_axis import UNDECIDED, common_axis
from modeler.priors.mixtures import Alternatives, DefensiveMixture
from modeler.priors.poke import pushed
from modeler.priors.turntable import AxisTurn, angles_and_axes
from modeler.types import AbstractPoseDensity, Array, Edge, HandPoses, InputError, Mode, Plane, RayImage, SharedAxis

HERE = np.eye(4)
SOURCE, TARGET = views(HERE)
BARE_SOURCE, BARE_TARGET = views(HERE, table=False)
RNG = 11


def turns_deg(samples: Array, axis: Array = NORMAL) -> Array:
    return np.degrees(se3.log(samples)[:, :3] @ axis)


def at(index: int, like: RayImage) -> RayImage:
    return view(index, like.points_m, like.plane)


# Turntable


def test_a_step_turns_right_handed_about_the_tables_normal_and_errors_of_steps_add_up(rng: np.random.Generator) -> None:
    prior = TurntablePrior(24.0, 2.0)
    for index, steps in ((2, 1), (0, 3), (7, -4)):
        found = turns_deg(prior.between(at(3, SOURCE), at(index, TARGET)).sample(4000, rng))
        expected = -24.0 * steps
        assert found.mean() == pytest.approx(expected, abs=0.3)
        assert found.std() == pytest.approx(2.0 * np.sqrt(abs(steps)), rel=0.06)


def test_without_a_table_the_axis_is_about_the_cameras_up(rng: np.random.Generator) -> None:
    density = TurntablePrior(24.0, 1.0).between(BARE_SOURCE, BARE_TARGET)
    angle_rad, axes = angles_and_axes(density.sample(4000, rng)[:, :3, :3])
    assert np.degrees(angle_rad.mean()) == pytest.approx(24.0, abs=0.2)
    tilt_deg = np.degrees(np.arccos(np.clip(axes @ np.array([0.0, 1.0, 0.0]), -1, 1)))  # it turns back: about -up
    assert 30.0 < np.median(tilt_deg) < 45.0


def test_of_any_axis_every_direction_is_as_likely(rng: np.random.Generator) -> None:
    density = TurntablePrior(24.0, 1.0, axis_sigma_deg=180.0).between(BARE_SOURCE, BARE_TARGET)
    _, axes = angles_and_axes(density.sample(8000, rng)[:, :3, :3])
    np.testing.assert_allclose(axes.mean(axis=0), 0.0, atol=0.03)
    np.testing.assert_allclose(axes.T @ axes / len(axes), np.eye(3) / 3, atol=0.02)


def test_a_turntable_does_not_lift_the_object(rng: np.random.Generator) -> None:
    for prior in (TurntablePrior(24.0, 1.0), turntable(HERE, axis_point_m=stated(AXIS_POINT_M))):
        samples = prior.between(SOURCE, TARGET).sample(500, rng)
        moved = samples[:, :3, :3] @ SOURCE.centroid_m + samples[:, :3, 3] - SOURCE.centroid_m
        assert np.std(moved @ NORMAL) < 0.0015
        assert np.mean(np.linalg.norm(moved, axis=1)) > 0.005


def test_a_turntable_without_any_error_is_still_a_density(rng: np.random.Generator) -> None:
    prior = TurntablePrior(24.0, 0.0, axis_direction=stated(NORMAL), axis_sigma_deg=0.0, wobble_deg=0.0, wobble_m=0.0)
    density = prior.between(SOURCE, TARGET)
    samples = density.sample(100, rng)
    assert np.isfinite(density.log_density(samples)).all()
    np.testing.assert_allclose(turns_deg(samples), -24.0, atol=0.01)


def test_larger_turns_leave_more_room_for_what_is_seen(rng: np.random.Generator) -> None:
    for step_deg, most_m in ((20.0, 0.05), (60.0, 0.0966)):
        samples = TurntablePrior(step_deg, max_shift_m=0.05).between(SOURCE, TARGET).sample(2000, rng)
        offset_m = samples[:, :3, :3] @ SOURCE.centroid_m + samples[:, :3, 3] - TARGET.centroid_m
        across_m = offset_m - np.outer(offset_m @ NORMAL, NORMAL)
        assert np.linalg.norm(across_m, axis=1).max() == pytest.approx(most_m, rel=0.02)


def test_a_known_axis_stays_where_it_is(rng: np.random.Generator) -> None:
    prior = turntable(HERE, axis_point_m=stated(AXIS_POINT_M), axis_sigma_m=1e-4, axis_sigma_deg=0.05, wobble_m=1e-4)
    samples = prior.between(SOURCE, TARGET).sample(500, rng)
    moved = samples[:, :3, :3] @ AXIS_POINT_M + samples[:, :3, 3] - AXIS_POINT_M
    assert np.abs(moved).max() < 1e-3


def test_a_step_is_a_density_however_often_the_table_comes_round() -> None:
    """A turn by 370 degrees is one by 10; one spread over the whole circle says nothing of the angle."""
    angle_rad, cosine = np.radians(np.array([5.0, 10.0, 30.0])), np.ones(3)
    turn = AxisTurn(NORMAL, np.radians(10.0), np.radians(2.0), np.radians(1.0), np.radians(0.2))
    again = replace(turn, turn_rad=np.radians(370.0))
    np.testing.assert_allclose(turn.log_density(angle_rad, cosine), again.log_density(angle_rad, cosine), atol=1e-9)
    lost = replace(turn, sigma_turn_rad=20.0, sigma_axis_rad=np.inf, sigma_wobble_rad=1e-4)
    expected = -np.log(8 * np.pi**2 * (1 - np.cos(angle_rad)))
    np.testing.assert_allclose(lost.log_density(angle_rad, cosine), expected, atol=1e-3)


def test_views_without_their_table_are_refused_where_it_is_asked_for() -> None:
    with pytest.raises(InputError, match=r"no support plane.*general prior"):
        TurntablePrior(24.0, needs_table=True).between(BARE_SOURCE, BARE_TARGET)
    with pytest.raises(InputError, match=r"no support plane.*general prior"):
        TablePrior().between(BARE_SOURCE, BARE_TARGET)


def test_the_table_prior_holds_an_object_on_its_table(rng: np.random.Generator) -> None:
    density = TablePrior(sigma_tilt_deg=0.01, sigma_height_m=1e-5, max_shift_m=0.03).between(SOURCE, TARGET)
    plane = SOURCE.plane
    assert isinstance(plane, Plane)
    before = plane.height_m(SOURCE.points_m)
    for sample in density.sample(20, rng):
        after = plane.height_m(se3.transform(sample, SOURCE.points_m))
        np.testing.assert_allclose(after, before, atol=0.003)  # what the plane's own tilt of 0.004 rad leaves


# The axis that is learnt


def test_steps_share_the_axis_as_far_as_no_edge_holds_it() -> None:
    unknown, bare, shown = TurntablePrior(24.0), [BARE_SOURCE, BARE_TARGET], [SOURCE, TARGET]
    wobble_rad = np.radians(unknown.wobble_deg)
    assert unknown.shared_axis(bare) == SharedAxis(wobble_rad, unknown.wobble_m)
    place_alone = SharedAxis(np.inf, unknown.wobble_m)
    assert unknown.shared_axis(shown) == place_alone  # each edge goes by the table's normal
    assert unknown.shared_axis([BARE_SOURCE, TARGET]) == place_alone
    assert replace(unknown, axis_direction=(0.0, -1.0, 0.0)).shared_axis(bare) == place_alone
    assert replace(unknown, axis_direction=(0.0, -1.0, 0.0), axis_sigma_deg=180.0).shared_axis(bare) is not None
    assert replace(unknown, axis_point_m=(0.0, 0.0, 0.8)).shared_axis(bare) is None
    on_table = replace(unknown, needs_table=True)  # a pair of which one view shows the table was not refused
    assert on_table.shared_axis([BARE_SOURCE, TARGET]) == place_alone
    for guess in (VelocityPrior(unknown), FeaturesPrior(unknown), ProductPrior(GeneralPrior(), unknown)):
        assert guess.shared_axis(bare) == unknown.shared_axis(bare)
    for other in (GeneralPrior(), TablePrior()):
        assert other.shared_axis(bare) is None


@pytest.mark.slow
def test_the_common_axis_is_as_sure_as_it_is_right() -> None:
    squares = []
    for seed in range(60):
        axis = common_axis([edge.posterior.pose for edge in edges(HERE, 6, seed=seed)], 1e-5, 1e-6)
        direction = axis.direction * np.sign(axis.direction @ NORMAL)
        off_rad = np.linalg.norm(np.cross(direction, NORMAL))
        # Where the true axis passes the plane across it at the point found.
        gap_m = AXIS_POINT_M - axis.point_m
        off_m = np.linalg.norm(gap_m - NORMAL * (gap_m @ NORMAL))
        squares.append([(off_rad / axis.sigma_direction_rad) ** 2 / 2, (off_m / axis.sigma_point_m) ** 2 / 2])
    assert (np.mean(squares, axis=0) < 1.3).all()  # the sigmas are those of the less sure of two directions each
    assert (np.mean(squares, axis=0) > 0.3).all()


def test_the_common_axis_leaves_a_wrong_pair_out() -> None:
    good = [edge.posterior.pose for edge in edges(HERE, 6)]
    wrong = replace(good[3], mean=turned(0.7, np.array([1.0, 0.0, 0.0])) @ good[3].mean)
    axis = common_axis([*good[:3], wrong, *good[4:]], 1e-3, 1e-4)
    assert np.degrees(np.linalg.norm(np.cross(axis.direction, NORMAL))) < 1.5


def test_too_few_or_too_small_turns_show_no_axis() -> None:
    assert common_axis([edge.posterior.pose for edge in edges(HERE, 2)], 1e-3, 1e-4) is None
    still = [replace(edge.posterior.pose, mean=turned(0.02)) for edge in edges(HERE, 6)]
    assert common_axis(still, 1e-3, 1e-4) is None


def test_what_is_learnt_tells_where_to_look_and_is_no_evidence(rng: np.random.Generator) -> None:
    prior = TurntablePrior(24.0, 2.0)
    taught = prior.learned(solution(HERE), edges(HERE))
    before, after = (which.between(BARE_SOURCE, BARE_TARGET) for which in (prior, taught))
    samples = after.sample(1000, rng)
    np.testing.assert_allclose(after.log_prior(samples), before.log_density(samples))
    pose = truth(HERE)[None]
    assert after.log_density(pose) > before.log_density(pose) + 3.0


def test_which_way_round_is_learnt(rng: np.random.Generator) -> None:
    prior = TurntablePrior(24.0, 2.0, step_sign="unknown")
    either = turns_deg(prior.between(SOURCE, TARGET).sample(1000, rng))
    assert 0.4 < np.mean(either > 0) < 0.6
    back = [
        replace(edge, posterior=replace(edge.posterior, source=edge.target, target=edge.source)) for edge in edges(HERE)
    ]
    for taught, sign in ((edges(HERE), -1.0), (back, 1.0)):
        learned = prior.learned(solution(HERE), taught)
        assert learned.sense == -sign
        assert np.mean(sign * turns_deg(learned.between(SOURCE, TARGET).sample(1000, rng)) > 0) > 0.85


def test_which_way_round_is_one_for_all_steps() -> None:
    """What three pairs tell weighs log(500) against a step the other way, and leaves it possible."""
    prior = TurntablePrior(24.0, 2.0, step_sign="unknown")
    either, given = (p.between(SOURCE, TARGET) for p in (prior, replace(prior, sense=1)))
    right, wrong = truth(HERE)[None], se3.inverse(truth(HERE))[None]
    assert given.log_prior(right) - either.log_prior(right) == pytest.approx(np.log(2.0 * (1.0 - UNDECIDED)), abs=1e-6)
    assert given.log_prior(wrong) - either.log_prior(wrong) == pytest.approx(np.log(2.0 * UNDECIDED), abs=1e-6)


def sensed(taught: Sequence[Edge]) -> int:
    """Which way round edges tell a turntable that may turn either way."""
    return TurntablePrior(24.0, 2.0, step_sign="unknown").learned(solution(HERE), taught).sense


@pytest.mark.parametrize("noise", [1.0, 0.01, 1e-6])
def test_three_sure_pairs_tell_which_way_round_and_two_do_not(noise: float) -> None:
    """However sure: what the third tells must not hang on how numbers are rounded."""
    assert [sensed(edges(HERE, count, noise)) for count in (1, 2, 3, 4)] == [0, 0, 1, 1]


def test_pairs_that_fit_either_way_do_not_tell_which_way_round() -> None:
    torn = []
    for edge in edges(HERE, 8):
        pose = edge.posterior.pose
        either = [Mode(0.5, pose), Mode(0.5, replace(pose, mean=turned(STEP)))]
        # As a build keeps them: without samples, and with a mean that lies at neither.
        off = replace(edge.posterior, modes=tuple(either), pose=replace(pose, mean=turned(-0.02)))
        torn.append(replace(edge, posterior=off))
    assert sensed(torn) == 0


def test_a_pair_that_closes_the_loop_does_not_tell_the_wrong_way_round() -> None:
    """From frame 13 to frame 0 the table turns by -312 degrees, which looks like a turn by 48; from 15 by none."""

    def over(steps: int) -> list[Edge]:
        pose = replace(edges(HERE, 1)[0].posterior.pose, mean=turned(-steps * STEP))
        return [replace(e, posterior=replace(e.posterior, source=steps, target=0, pose=pose)) for e in edges(HERE, 4)]

    assert [sensed(over(steps)) for steps in (1, 13, 15)] == [1, 1, 0]


@pytest.mark.parametrize("prior", [TurntablePrior(24.0, 2.0), held(HERE)], ids=["turntable", "held"])
def test_steps_count_once_however_many_edges_follow_from_them(prior: TurntablePrior | HeldPrior) -> None:
    """Towards the newest frame a step is evidence; towards earlier ones it has counted, and only proposes."""
    taught = prior.learned(solution(HERE, 3), ())
    samples = prior.between(SOURCE, TARGET).sample(300, np.random.default_rng(RNG))
    np.testing.assert_allclose(
        taught.between(SOURCE, TARGET).log_prior(samples), prior.between(SOURCE, TARGET).log_prior(samples)
    )
    earlier = taught.between(SOURCE, at(1, TARGET))
    assert isinstance(earlier, DefensiveMixture)
    evidence = earlier.log_prior(earlier.known.sample(300, np.random.default_rng(RNG)))
    assert np.isfinite(evidence).all()
    assert earlier.known.sample(1, np.random.default_rng(0)).shape == (1, 4, 4)
    assert not isinstance(earlier.known, DefensiveMixture)
    placed = taught.following(1).between(SOURCE, at(1, TARGET))  # a frame that was skipped, or lost and found again
    first = prior.between(SOURCE, at(1, TARGET))
    np.testing.assert_allclose(placed.log_prior(samples), first.log_prior(samples))


# A robot's hand


def as_held(prior: HeldPrior) -> AbstractPoseDensity:
    """The density of a motion on which the hand keeps its grasp."""
    density = prior.between(SOURCE, TARGET)
    assert isinstance(density, DefensiveMixture)
    assert isinstance(density.known, Alternatives)
    return density.known.densities[0]


def test_the_object_goes_with_the_hand(rng: np.random.Generator) -> None:
    density = as_held(held(HERE))
    off = se3.log(se3.inverse(truth(HERE)) @ density.sample(4000, rng))
    np.testing.assert_allclose(np.degrees(off[:, :3].std(axis=0)), 3.0, rtol=0.05)
    place_m = hand(HERE)[1][3][:3, 3]
    shift_m = np.array([se3.transform(pose, place_m[None])[0] for pose in density.sample(2000, rng)])
    np.testing.assert_allclose(shift_m.std(axis=0), 0.008, rtol=0.08)


@pytest.mark.parametrize(("steps", "grasp_changed"), [(1.0, 0.02), (3.0, 0.0588)])
def test_a_hand_that_takes_the_object_anew_tells_nothing_of_its_motion(steps: float, grasp_changed: float) -> None:
    """What the hand does between its grasps must not matter: the density there is that of the prior without a hand."""
    times_s, poses = hand(HERE)
    regrasped = np.concatenate([poses[:3], poses[3:] @ se3.exp(np.array([3.0, 0, 0, 0, 0, 0.1]))])
    anew = HeldPrior(HandPoses(times_s, regrasped))
    density = anew.relaxed(steps).between(SOURCE, TARGET)
    without = GeneralPrior().relaxed(steps).between(SOURCE, TARGET)
    pose = truth(HERE)[None]
    expected = np.log(grasp_changed) + without.log_density(pose)
    np.testing.assert_allclose(density.log_prior(pose), expected, atol=1e-3)
    apart = se3.rotation_angle(se3.inverse(truth(HERE)) @ density.sample(2000, np.random.default_rng(RNG)))
    assert np.mean(apart < np.radians(90.0)) == pytest.approx(0.5, abs=0.05)  # the search looks at both


def test_a_new_grasp_may_turn_the_object_in_any_way_where_limits_are_assumed() -> None:
    unlimited = held(HERE).unlimited()
    over = turned(np.radians(170.0))[None]
    assert unlimited.between(SOURCE, TARGET).log_prior(over) > -10.0
    assert held(HERE).between(SOURCE, TARGET).log_prior(over) < -100.0
    assert replace(held(HERE), regrasped=GeneralPrior(40.0)).unlimited() is None


@pytest.mark.parametrize("probability", [1.0, 2.0])
def test_a_grasp_that_always_changes_is_no_grasp(probability: float) -> None:
    with pytest.raises(InputError, match="regrasp_probability"):
        replace(held(HERE), regrasp_probability=probability)


def seen_before(index: int) -> RayImage:
    """A view of a surface 7 cm before the point about which the hand turns it, on the camera's side."""
    near_m = AXIS_POINT_M + np.array([0.0, 0.0, -0.07]) + np.random.default_rng(index).normal(0.0, 0.003, (300, 3))
    return view(index, near_m, None)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_a_hand_that_turned_far_leaves_room_for_what_is_seen(steps: int) -> None:
    """What is seen lies before the middle of the object, so that a true motion parts the centroids of two views."""
    upright = np.array([0.0, 1.0, 0.0])
    poses = np.array([turned(k * STEP, upright) for k in range(6)])
    prior = HeldPrior(HandPoses(0.5 * np.arange(6.0), poses), previous=9, max_offset_m=0.04)
    source, target = (seen_before(k) for k in (steps, 0))
    true = poses[0] @ se3.inverse(poses[steps])
    apart_m = np.linalg.norm(se3.transform(true, source.centroid_m[None])[0] - target.centroid_m)
    assert (apart_m > 0.04) == (steps > 1)
    assert np.isfinite(prior.between(source, target).log_prior(true[None]))


def test_a_hand_whose_prior_grows_leaves_more_room() -> None:
    hand_only = replace(held(HERE), previous=9, max_offset_m=0.04, regrasped=GeneralPrior(max_offset_m=0.04))
    for steps, most_m in ((1.0, 0.04), (2.0, 0.08)):
        prior = hand_only.relaxed(steps)
        density = prior.between(SOURCE, TARGET)
        assert isinstance(density, DefensiveMixture)
        samples = density.known.sample(2000, np.random.default_rng(RNG))
        offset_m = samples[:, :3, :3] @ SOURCE.centroid_m + samples[:, :3, 3] - TARGET.centroid_m
        assert np.linalg.norm(offset_m, axis=1).max() == pytest.approx(most_m, rel=0.02)


def test_a_missing_pose_is_interpolated_and_less_sure() -> None:
    times_s, poses = hand(HERE)
    sparse = HeldPrior(HandPoses(np.delete(times_s, 2), np.delete(poses, 2, axis=0)))
    whole, gappy = as_held(held(HERE)), as_held(sparse)
    pose = truth(HERE)[None]
    assert whole.log_density(pose) > gappy.log_density(pose)  # at its middle a wider bump is lower
    samples = gappy.sample(2000, np.random.default_rng(RNG))
    mean = se3.mean(samples, np.ones(len(samples)))[0]
    assert np.degrees(se3.rotation_angle(se3.inverse(truth(HERE)) @ mean)) < 2.0


@pytest.mark.parametrize(("kept", "says"), [([0, 4], "2 s apart"), ([0, 1], "0 to 0.5 s"), ([3, 4], "1.5 to 2 s")])
def test_a_pose_that_is_too_far_away_is_refused(kept: list[int], says: str) -> None:
    times_s, poses = hand(HERE)
    prior = HeldPrior(HandPoses(times_s[kept], poses[kept], name="run/robot.txt"))
    with pytest.raises(InputError, match=rf"^run/robot\.txt: has no pose for frame [23] at .*{says}"):
        prior.between(SOURCE, TARGET)


# A poke


def test_a_finger_that_does_not_slip_carries_its_point_along() -> None:
    """The contact's velocity is the finger's, to first order in the length of a step."""
    rng = np.random.default_rng(RNG)
    contact, radius_m = rng.normal(0, 0.05, (200, 2)), rng.uniform(0.02, 0.08, 200)
    step = 1e-7 * rng.normal(size=(200, 2))
    turn, shift = pushed(contact, step, radius_m)
    carried = shift + turn[:, None] * np.stack([-contact[:, 1], contact[:, 0]], axis=1)
    np.testing.assert_allclose(carried, 20 * step, rtol=1e-3, atol=1e-9)


def poked(offset_m: Array, length_m: float = 0.03) -> tuple[PokePrior, Array]:
    """A push across the view beside the object's middle, and its direction in the table's plane."""
    across = np.cross(NORMAL, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    return PokePrior(Poke(stated(TARGET.centroid_m + offset_m), stated(across), length_m)), across


def test_a_poke_moves_the_object_its_way(rng: np.random.Generator) -> None:
    prior, across = poked(np.zeros(3))
    samples = prior.between(at(1, TARGET), at(0, TARGET)).sample(3000, rng)  # from after the poke to before
    moved = TARGET.centroid_m - (samples[:, :3, :3] @ TARGET.centroid_m + samples[:, :3, 3])
    assert (moved @ across).mean() == pytest.approx(0.03, abs=0.006)
    assert np.abs(moved @ NORMAL).max() < 0.01
    assert abs(turns_deg(samples).mean()) < 5.0
    assert turns_deg(samples).std() > 2.0  # where the middle of friction lies is not known


def test_a_poke_beside_the_middle_turns_the_object(rng: np.random.Generator) -> None:
    _, across = poked(np.zeros(3))
    for side in (1.0, -1.0):
        prior, _ = poked(side * 0.04 * np.cross(NORMAL, across))
        forth = prior.between(at(0, TARGET), at(1, TARGET)).sample(2000, rng)
        # A force to the left of the middle, seen along it from above, turns clockwise.
        assert side * turns_deg(forth).mean() < -8.0


def test_every_poke_of_a_sequence_stands_at_its_frame() -> None:
    prior, _ = poked(np.zeros(3))
    assert prior.poke is not None
    several = PokePrior(pokes={1: prior.poke, 2: replace(prior.poke, length_m=0.06)})
    frames = [at(index, TARGET) for index in range(4)]
    pose = prior.between(frames[1], frames[0]).sample(1, np.random.default_rng(0))
    np.testing.assert_array_equal(
        several.between(frames[1], frames[0]).log_density(pose), prior.between(frames[1], frames[0]).log_density(pose)
    )
    on_table = TablePrior().between(frames[2], frames[0])
    np.testing.assert_array_equal(several.between(frames[2], frames[0]).log_density(pose), on_table.log_density(pose))
    with pytest.raises(InputError, match=r"no poke .*frames 2 and 3"):
        several.between(frames[3], frames[2])


def test_a_poke_against_the_table_is_refused() -> None:
    prior, _ = poked(np.zeros(3))
    assert prior.poke is not None
    pressed = PokePrior(replace(prior.poke, direction=stated(-2.0 * NORMAL)))
    with pytest.raises(InputError, match=r"between frames 0 and 1 .*direction"):
        pressed.between(at(1, TARGET), at(0, TARGET))


# Guesses


def test_the_pace_of_the_last_two_frames_goes_on() -> None:
    silent = VelocityPrior()
    assert silent.between(SOURCE, TARGET).evidence
    taught = silent.learned(solution(HERE, 3), ())
    pose = truth(HERE)[None]
    gain = taught.between(SOURCE, TARGET).log_density(pose) - silent.between(SOURCE, TARGET).log_density(pose)
    assert gain > 3.0
    closure = taught.between(SOURCE, at(1, TARGET))
    assert closure.log_density(turned(-2 * STEP)[None]) > silent.between(SOURCE, TARGET).log_density(pose) + 3.0
    assert VelocityPrior().learned(solution(HERE, 1), ()).between(SOURCE, TARGET).evidence


def test_matching_shape_finds_the_motion() -> None:
    pose = truth(HERE)[None]
    prior = GeneralPrior().between(SOURCE, TARGET).log_density(pose)
    assert FeaturesPrior().between(SOURCE, TARGET).log_density(pose) > prior + 3.0


def test_few_points_have_no_features() -> None:
    few = [replace(v, points_m=v.points_m[:20], normals=v.normals[:20]) for v in (SOURCE, TARGET)]
    assert FeaturesPrior().between(few[0], few[1]).evidence


# Combinations


def test_two_that_agree_are_surer_together() -> None:
    """Two hands of 3 and 4 degrees are one of 2.4."""
    wide = replace(held(HERE), held_sigma_deg=4.0, held_sigma_m=0.006)
    samples = ProductPrior(held(HERE), wide).between(SOURCE, TARGET).sample(6000, np.random.default_rng(RNG))
    off_deg = np.degrees(se3.log(se3.inverse(truth(HERE)) @ samples)[:, :3])
    np.testing.assert_allclose(off_deg.std(axis=0), 2.4, rtol=0.06)
    place_m = hand(HERE)[1][3][:3, 3]
    shift_m = samples[:, :3, :3] @ place_m + samples[:, :3, 3]
    np.testing.assert_allclose(shift_m.std(axis=0), 0.0048, rtol=0.06)


def test_the_product_of_table_and_hand_keeps_both(rng: np.random.Generator) -> None:
    table = TablePrior(max_shift_m=0.05)
    grip = replace(held(HERE), regrasped=GeneralPrior(max_offset_m=0.04))
    samples = ProductPrior(grip, table).between(SOURCE, TARGET).sample(2000, rng)
    tilt_deg = np.degrees(np.arccos(np.clip(samples[:, :3, :3] @ NORMAL @ NORMAL, -1, 1)))
    assert np.percentile(tilt_deg, 95) < 1.2  # the table's; the hand alone would leave seven degrees
    assert turns_deg(samples).std() == pytest.approx(3.0, rel=0.15)  # the hand's; the table leaves it open


def test_priors_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(InputError, match="frames 3 and 2"):
        ProductPrior(turntable(HERE), GeneralPrior(max_rotation_deg=5.0)).between(SOURCE, TARGET)


def test_a_product_leaves_the_limits_that_either_part_assumed() -> None:
    table, grip = TablePrior(limits_assumed=True), held(HERE)
    either = ProductPrior(grip, table).unlimited()
    assert either.second == table.unlimited()
    assert either.first == grip.unlimited()
    one = ProductPrior(TablePrior(), GeneralPrior(limits_assumed=True)).unlimited()
    assert one.first == TablePrior()
    assert ProductPrior(TablePrior(), GeneralPrior()).unlimited() is None


def test_a_guess_that_lies_outside_what_is_known_is_dropped() -> None:
    tight = VelocityPrior(GeneralPrior(max_rotation_deg=2.0)).learned(solution(HERE, 3), ())
    assert tight.between(SOURCE, TARGET).evidence
