"""Frames that are hard to place: cut off by the prior's limits, as it seems, or hidden by something."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
import pytest
from closure_runs import ABOUT_OBJECT, COVARIANCE, turned, view
from test_pipeline import FRAMES, Oracle, modeler, run, trajectory_error

from modeler import se3
from modeler.baselines import IcpRegistrar
from modeler.closure import Closer
from modeler.pipeline import Modeler
from modeler.pipeline.attempts import unless_alike
from modeler.pipeline.pairs import Registrations, converged_or
from modeler.pipeline.state import State
from modeler.pipeline.tracking import Tracker
from modeler.registration import VisibilityRegistrar
from modeler.registration.visibility import VisibilityLikelihood
from modeler.segmentation import Scene
from modeler.types import (
    AbstractPoseDensity,
    AbstractPrior,
    AbstractRegistrar,
    Array,
    Edge,
    Mode,
    Outcome,
    PoseGaussian,
    Posterior,
    RayImage,
    Reason,
    Searching,
    Solution,
    Step,
    ViewPair,
    pooled,
)
from modeler.views import Sensor

TRUE_DEG, LIMIT_DEG = 25.0, 50.0


@final
@dataclass(frozen=True)
class Limited(AbstractPoseDensity):
    limit_deg: float
    evidence = True

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        return np.broadcast_to(np.eye(4), (count, 4, 4))

    def log_density(self, target_from_source: Array) -> Array:
        return np.where(np.degrees(se3.rotation_angle(target_from_source)) <= self.limit_deg, 0.0, -np.inf)


@final
@dataclass(frozen=True)
class Limits(AbstractPrior):
    limit_deg: float = LIMIT_DEG
    assumed: bool = False

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        return Limited(self.limit_deg)

    def relaxed(self, steps: float) -> AbstractPrior:
        return replace(self, limit_deg=steps * self.limit_deg)

    def unlimited(self) -> AbstractPrior | None:
        return Limits(180.0) if self.assumed else None

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> AbstractPrior:
        return self


@final
@dataclass(frozen=True)
class ByLimit(AbstractRegistrar):
    """Returns one posterior within each limit of the rotation."""

    posteriors: dict[float, Posterior]
    """By limit in degrees."""
    asked: list[float] = field(default_factory=list)

    def posterior_of(self, pair: ViewPair) -> Posterior:
        assert isinstance(pair.density, Limited)
        self.asked.append(pair.density.limit_deg)
        return self.posteriors[pair.density.limit_deg]


def registered(
    angle_deg: float, outcome: Outcome = Outcome.CONVERGED, nats: float = -20.0, overlap: float = 0.8
) -> Posterior:
    pose = PoseGaussian(turned(angle_deg), COVARIANCE)
    return Posterior(1, 0, pose, outcome, overlap, least_overlap=0.35, log_marginal_likelihood=nats, seconds=1.0)


def placed(registrar: AbstractRegistrar, prior: Limits) -> Posterior:
    """Return the registration of a second view with the first."""
    state = State(views={0: view(0)}, places={0: 0, 1: 1})
    search = Tracker(state, prior, Closer(), Sensor(), Registrations(registrar)).place(view(1), 0, "track")
    while True:
        try:
            assert next(search) == Searching(1)
        except StopIteration as stop:
            (posterior,), _ = stop.value
            return posterior


AT_LIMIT, CONVERGED, NO_OVERLAP = Outcome.AT_LIMIT, Outcome.CONVERGED, Outcome.NO_OVERLAP


@pytest.mark.parametrize(
    ("within", "wider_deg", "wider_nats", "wanted_deg"),
    [
        (registered(25.0), -65.0, 100.0, 25.0),  # not at the limits: no second attempt
        (registered(25.0, AT_LIMIT), -65.0, -19.5, 25.0),  # a quarter turn of four sides alike matches as well
        (registered(25.0, AT_LIMIT), -65.0, 10.0, -65.0),  # far better: it did turn so far
        (registered(25.0, AT_LIMIT), 65.0, 10.0, 65.0),
        (registered(25.0, AT_LIMIT), 35.0, -19.5, 35.0),  # the same mode, no longer at the limits
        (registered(25.0, AT_LIMIT), -40.0, -19.5, -40.0),  # within the limits too
        (registered(25.0, AT_LIMIT), -65.0, np.nan, -65.0),  # a method without likelihoods
        (registered(25.0, NO_OVERLAP), -65.0, -19.5, -65.0),  # nothing matches within
        (registered(25.0, AT_LIMIT, overlap=0.27), -65.0, -16.0, -65.0),  # far less overlap within
        (registered(25.0, AT_LIMIT, overlap=0.5), -65.0, -16.0, -65.0),
    ],
)
def test_a_motion_beyond_the_limits_needs_a_far_better_match(
    within: Posterior, wider_deg: float, wider_nats: float, wanted_deg: float
) -> None:
    registrar = ByLimit({LIMIT_DEG: within, 2.0 * LIMIT_DEG: registered(wider_deg, nats=wider_nats)})
    posterior = placed(registrar, Limits())
    assert posterior.usable
    assert posterior.seconds == len(registrar.asked) == (1 if within.outcome is CONVERGED else 2)
    sense = np.sign((se3.inverse(ABOUT_OBJECT) @ posterior.pose.mean @ ABOUT_OBJECT)[0, 2] * turned(1.0)[0, 2])
    assert sense * np.degrees(se3.rotation_angle(posterior.pose.mean)) == pytest.approx(wanted_deg, abs=0.1)


@pytest.mark.parametrize(
    ("assumed", "anywhere", "usable"),
    [
        (True, CONVERGED, True),
        (True, Outcome.AMBIGUOUS, False),  # several modes, none within the usual limits
        (True, NO_OVERLAP, False),
        (False, CONVERGED, False),  # the limits are given
    ],
)
def test_limits_that_are_defaults_hold_while_something_within_them_matches(
    *, assumed: bool, anywhere: Outcome, usable: bool
) -> None:
    nothing = registered(120.0, NO_OVERLAP)
    registrar = ByLimit({LIMIT_DEG: nothing, 2.0 * LIMIT_DEG: nothing, 180.0: registered(120.0, anywhere)})
    posterior = placed(registrar, Limits(assumed=assumed))
    assert posterior.usable == usable
    assert registrar.asked == [LIMIT_DEG, 2.0 * LIMIT_DEG, *([180.0] if assumed else [])]
    assert posterior.seconds == len(registrar.asked)


@final
@dataclass(frozen=True)
class ContradictedWithin(AbstractRegistrar):
    """Finds a turn of 25° within limits, which the images contradict, and the true one of 120° without."""

    anywhere: Outcome = Outcome.CONVERGED

    def posterior_of(self, pair: ViewPair) -> Posterior:
        wide = np.isfinite(pair.density.log_density(turned(120.0)))
        pose = PoseGaussian(turned(120.0 if wide else TRUE_DEG), COVARIANCE)
        outcome = self.anywhere if wide else Outcome.CONVERGED
        return Posterior(pair.source.index, pair.target.index, pose, outcome, 0.8, contradicted=not wide)


@pytest.mark.parametrize(
    ("assumed", "anywhere", "wanted_deg"),
    [(True, Outcome.CONVERGED, 120.0), (True, Outcome.NO_OVERLAP, TRUE_DEG), (False, Outcome.CONVERGED, TRUE_DEG)],
)
def test_what_the_images_contradict_within_assumed_limits_is_looked_for_beyond(
    *, assumed: bool, anywhere: Outcome, wanted_deg: float
) -> None:
    loop = Modeler(prior=Limits(assumed=assumed), registrar=ContradictedWithin(anywhere))
    posterior = loop.register(view(1), view(0))
    assert np.degrees(se3.rotation_angle(posterior.pose.mean)) == pytest.approx(wanted_deg)


def of_modes(*modes: tuple[float, float]) -> Posterior:
    """Return a posterior of modes: weights, and turns in degrees."""
    poses = [turned(deg) for _, deg in modes]
    stated = tuple(Mode(weight, PoseGaussian(pose, COVARIANCE)) for (weight, _), pose in zip(modes, poses, strict=True))
    shares = np.array([weight for weight, _ in modes])
    return Posterior(
        1, 0, pooled(stated), Outcome.AMBIGUOUS, 0.8, np.stack(poses), shares, stated, log_marginal_likelihood=-20.0
    )


def test_modes_beyond_the_limits_count_as_little_as_motions_beyond_do() -> None:
    """Whatever loops say later, they cannot choose a mode that is not there."""
    cut_off = Posterior(1, 0, PoseGaussian(turned(50.0), COVARIANCE), Outcome.NO_OVERLAP, overlap=0.0)
    both = unless_alike(cut_off, of_modes((0.6, -65.0), (0.4, 25.0)), Limited(LIMIT_DEG))
    assert both.modes == ()
    np.testing.assert_allclose(both.pose.mean, turned(25.0), atol=1e-12)
    np.testing.assert_allclose(both.pose.covariance, COVARIANCE, atol=1e-12)
    np.testing.assert_array_equal(both.samples, turned(25.0)[None])
    assert both.weights.sum() == pytest.approx(1.0)
    three = unless_alike(cut_off, of_modes((0.6, -65.0), (0.3, 25.0), (0.1, -20.0)), Limited(LIMIT_DEG))
    assert [mode.weight for mode in three.modes] == pytest.approx([0.75, 0.25])
    far = unless_alike(cut_off, of_modes((0.9997, -65.0), (0.0003, 25.0)), Limited(LIMIT_DEG))
    assert [mode.weight for mode in far.modes] == pytest.approx([0.769, 0.231], abs=1e-3)
    for wide in (of_modes((0.6, -65.0), (0.4, 65.0)), of_modes((0.6, 25.0), (0.4, -40.0)), of_modes((1.0, -65.0))):
        assert unless_alike(cut_off, wide, Limited(LIMIT_DEG)) is wide


@pytest.mark.parametrize(
    ("outcome", "contradicted", "better_nats", "replaced"),
    [
        (Outcome.CONVERGED, True, 2.0, False),
        (Outcome.CONVERGED, True, 3.0, True),
        (Outcome.CONVERGED, False, 6.5, False),
        (Outcome.CONVERGED, False, 7.5, True),
        (Outcome.NO_OVERLAP, False, -50.0, True),
    ],
)
def test_a_match_within_the_limits_gives_way_to_a_more_probable_one(
    outcome: Outcome, contradicted: bool, better_nats: float, replaced: bool
) -> None:
    """One motion in a thousand exceeds the limits, and one right match in a hundred is contradicted by the images."""
    pose = PoseGaussian(turned(25.0), COVARIANCE)
    within = Posterior(1, 0, pose, outcome, 0.8, contradicted=contradicted, log_marginal_likelihood=-20.0)
    beyond = Posterior(1, 0, pose, Outcome.CONVERGED, 0.8, log_marginal_likelihood=-20.0 + better_nats)
    assert converged_or(within, beyond) is (beyond if replaced else within)


@pytest.mark.parametrize(
    ("contradicted", "better_nats", "turned_deg", "beaten"),
    [(True, 7.5, 120.0, True), (True, 6.5, 120.0, False), (False, 7.5, 120.0, False), (True, 7.5, 35.0, False)],
)
def test_a_contradicted_match_within_the_limits_is_none_if_another_is_far_more_probable(
    contradicted: bool, better_nats: float, turned_deg: float, beaten: bool
) -> None:
    """Whichever of the two is right, the one within the limits is not."""
    poses = [PoseGaussian(turned(deg), COVARIANCE) for deg in (25.0, turned_deg)]
    within = Posterior(1, 0, poses[0], CONVERGED, 0.8, contradicted=contradicted, log_marginal_likelihood=-20.0)
    beyond = Posterior(1, 0, poses[1], NO_OVERLAP, 0.7, contradicted=True, log_marginal_likelihood=-20.0 + better_nats)
    assert converged_or(within, beyond).outcome is (AT_LIMIT if beaten else CONVERGED)


# Frames in which something hides the object: what is spent on them, and that those after them join as ever.

HIDDEN = frozenset({2, 3, 4, 5})


def outcomes(steps: list[Step]) -> list[tuple[int, bool, Reason | None]]:
    return [(step.frame.index, step.accepted, step.left_out) for step in steps]


def test_after_a_failed_search_hidden_frames_are_searched_with_little_effort_only() -> None:
    registrar = Oracle(blind=HIDDEN, quick=Oracle(blind=HIDDEN))
    steps = run(registrar=registrar)
    # At the end they are tried among each other: they might be a segment of their own.
    assert {source for source, target in registrar.asked if target not in HIDDEN} & HIDDEN == {2}
    assert {source for source, _ in quick_pairs(registrar)} >= {3, 4, 5}
    whole = run(registrar=Oracle(blind=HIDDEN))
    assert outcomes(steps) == outcomes(whole)
    assert sorted(steps[-1].solution.trajectory) == [0, 1, 6, 7, 8]
    for frame, pose in whole[-1].solution.trajectory.items():
        np.testing.assert_array_equal(steps[-1].solution.trajectory[frame], pose)


def test_a_frame_hidden_now_and_then_is_searched_for_at_the_previous_view_alone() -> None:
    hidden = frozenset({2, 4, 6})
    registrar = Oracle(blind=hidden, quick=Oracle(blind=hidden))
    steps = run(registrar=registrar)
    assert [target for source, target in registrar.asked if source == 6] == [5]
    assert sorted(steps[-1].solution.trajectory) == [0, 1, 3, 5, 7, 8]


def test_a_registration_of_little_effort_places_no_frame() -> None:
    """What matches in it is registered with full effort: false hopes change nothing but the cost."""
    registrar, whole = Oracle(blind=HIDDEN, quick=Oracle(noise=100.0)), Oracle(blind=HIDDEN)
    steps = run(registrar=registrar)
    assert outcomes(steps) == outcomes(run(registrar=whole))
    assert registrar.asked == whole.asked
    assert trajectory_error(steps[-1]) < 1e-6


def test_lost_frames_are_found_from_far_round_with_little_effort_first() -> None:
    early = frozenset((source, target) for source in (3, 4, 5, 6) for target in range(source) if target < 3)
    registrar = Oracle(apart=early, reach=9.0, quick=Oracle(apart=early, reach=9.0))
    last = run(registrar=registrar)[-1]
    assert quick_pairs(registrar)
    assert set(last.solution.trajectory) == set(range(9))
    assert trajectory_error(last) < 1e-6


def quick_pairs(registrar: Oracle) -> list[tuple[int, int]]:
    return registrar.quick.asked


def test_a_search_is_announced_for_lost_frames_and_no_others() -> None:
    maker = modeler(registrar=Oracle(blind=HIDDEN, quick=Oracle(blind=HIDDEN)))
    assert {event.frame for event in maker.run(FRAMES, Scene()) if isinstance(event, Searching)} == HIDDEN
    assert not any(isinstance(event, Searching) for event in modeler().run(FRAMES, Scene()))


def test_little_effort_is_a_smaller_search_of_the_same_likelihood() -> None:
    registrar = VisibilityRegistrar(likelihood=VisibilityLikelihood(points=500), min_overlap=0.3)
    quick = registrar.scaled(registrar.least_effort)
    assert (quick.likelihood.points, quick.min_overlap) == (500, 0.3)
    assert quick.search.max_starts < registrar.search.max_starts
    assert quick.sampler.max_draws < registrar.sampler.max_draws
    assert quick.max_modes == 1
    assert IcpRegistrar().least_effort == 1.0
