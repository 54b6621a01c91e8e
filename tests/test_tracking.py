"""Frames that are hard to place: cut off by the prior's limits, as it seems, or hidden by something."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
import pytest
from closing import ABOUT_OBJECT, COVARIANCE, turned, view
from test_pipeline import FRAMES, Oracle, modeler, run, trajectory_error

from modeler import se3
from modeler.closure import Closer
from modeler.pipeline import Modeler, quick_registrar
from modeler.pipeline.state import State
from modeler.pipeline.tracking import Tracker, preferred
from modeler.rays import Sensor
from modeler.registration import IcpRegistrar, VisibilityRegistrar
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
    pooled,
)

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


def result(events: Generator[Searching, None, tuple[Posterior, ...]]) -> tuple[Posterior, ...]:
    """Return what is found once all events of a search are consumed."""
    while True:
        try:
            next(events)
        except StopIteration as stop:
            return stop.value


def found(outcome: Outcome, wider_deg: float, gain_nats: float, overlap: float = 0.8) -> float:
    """Return how far in degrees a view is taken to have turned that one registration leaves at 25°, a wider one not."""

    def register(source: RayImage, target: RayImage, prior: AbstractPrior) -> Posterior:
        assert isinstance(prior, Limits)
        wide = prior.limit_deg > LIMIT_DEG
        pose = PoseGaussian(turned(wider_deg if wide else TRUE_DEG), COVARIANCE)
        nats = -20.0 + gain_nats if wide else -20.0
        told = Outcome.CONVERGED if wide else outcome
        posterior = Posterior(source.index, target.index, pose, told, 0.8 if wide else overlap, seconds=1.0)
        return replace(posterior, least_overlap=0.35, log_evidence=nats)

    state = State(views={0: view(0)}, places={0: 0, 1: 1})
    tracker = Tracker(state, Limits(), Closer(), Sensor(), register)
    (posterior,) = result(tracker.locate(view(1), 0, retry=False))
    assert posterior.usable
    assert posterior.seconds == (1.0 if outcome is Outcome.CONVERGED else 2.0)
    sense = np.sign((se3.inverse(ABOUT_OBJECT) @ posterior.pose.mean @ ABOUT_OBJECT)[0, 2] * turned(1.0)[0, 2])
    return float(sense * np.degrees(se3.rotation_angle(posterior.pose.mean)))


@pytest.mark.parametrize(
    ("outcome", "wider_deg", "gain_nats", "wanted_deg"),
    [
        (Outcome.CONVERGED, -65.0, 100.0, TRUE_DEG),  # nothing was cut off
        (Outcome.AT_LIMIT, -65.0, 0.5, TRUE_DEG),  # a quarter turn on four sides alike match as well
        (Outcome.AT_LIMIT, -65.0, 30.0, -65.0),  # by far better: it did turn so far
        (Outcome.AT_LIMIT, 65.0, 30.0, 65.0),
        (Outcome.AT_LIMIT, 35.0, 0.5, 35.0),  # the same place, no longer cut off
        (Outcome.AT_LIMIT, -40.0, 0.5, -40.0),  # within what is known too
        (Outcome.AT_LIMIT, -65.0, np.nan, -65.0),  # methods without evidence
        (Outcome.NO_OVERLAP, -65.0, 0.5, -65.0),  # nothing was found within
    ],
)
def test_beyond_the_limits_only_what_matches_far_better_is_believed(
    outcome: Outcome, wider_deg: float, gain_nats: float, wanted_deg: float
) -> None:
    assert found(outcome, wider_deg, gain_nats) == pytest.approx(wanted_deg, abs=0.1)


@pytest.mark.parametrize("overlap", [0.27, 0.5])
def test_a_place_within_the_limits_that_matches_far_less_does_not_count(overlap: float) -> None:
    assert found(Outcome.AT_LIMIT, -65.0, 4.0, overlap=overlap) == pytest.approx(-65.0, abs=0.1)


@pytest.mark.parametrize(
    ("assumed", "anywhere", "placed"),
    [
        (True, Outcome.CONVERGED, True),
        (True, Outcome.AMBIGUOUS, False),  # several places, none of which is usual
        (True, Outcome.NO_OVERLAP, False),
        (False, Outcome.CONVERGED, False),  # the limits are known
    ],
)
def test_limits_that_are_assumed_hold_while_something_within_them_matches(
    *, assumed: bool, anywhere: Outcome, placed: bool
) -> None:
    asked: list[float] = []

    def register(source: RayImage, target: RayImage, prior: AbstractPrior) -> Posterior:
        assert isinstance(prior, Limits)
        asked.append(prior.limit_deg)
        outcome = anywhere if prior.limit_deg == 180.0 else Outcome.NO_OVERLAP
        pose = PoseGaussian(turned(120.0), COVARIANCE)
        return Posterior(source.index, target.index, pose, outcome, 0.8, seconds=1.0)

    state = State(views={0: view(0)}, places={0: 0, 1: 1})
    tracker = Tracker(state, Limits(assumed=assumed), Closer(), Sensor(), register)
    (posterior,) = result(tracker.locate(view(1), 0, retry=False))
    assert posterior.usable == placed
    assert asked == [LIMIT_DEG, 2.0 * LIMIT_DEG, *([180.0] if assumed else [])]
    assert posterior.seconds == len(asked)


@final
@dataclass(frozen=True)
class ContradictedWithin(AbstractRegistrar):
    """Finds a turn of 25° within limits, which the images contradict, and the true one of 120° without."""

    anywhere: Outcome = Outcome.CONVERGED

    def register(
        self, source: RayImage, target: RayImage, density: AbstractPoseDensity, *, rng: np.random.Generator
    ) -> Posterior:
        wide = np.isfinite(density.log_density(turned(120.0)))
        pose = PoseGaussian(turned(120.0 if wide else TRUE_DEG), COVARIANCE)
        outcome = self.anywhere if wide else Outcome.CONVERGED
        return Posterior(source.index, target.index, pose, outcome, 0.8, contradicted=not wide)


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
    told = tuple(Mode(weight, PoseGaussian(pose, COVARIANCE)) for (weight, _), pose in zip(modes, poses, strict=True))
    shares = np.array([weight for weight, _ in modes])
    return Posterior(1, 0, pooled(told), Outcome.AMBIGUOUS, 0.8, np.stack(poses), shares, told, log_evidence=-20.0)


def test_modes_beyond_the_limits_count_as_little_as_motions_beyond_do() -> None:
    """Whatever loops say later, they cannot choose a mode that is not there."""
    cut_off = Posterior(1, 0, PoseGaussian(turned(50.0), COVARIANCE), Outcome.NO_OVERLAP, overlap=0.0)
    both = preferred(cut_off, of_modes((0.6, -65.0), (0.4, 25.0)), Limited(LIMIT_DEG))
    assert both.modes == ()
    np.testing.assert_allclose(both.pose.mean, turned(25.0), atol=1e-12)
    np.testing.assert_allclose(both.pose.covariance, COVARIANCE, atol=1e-12)
    np.testing.assert_array_equal(both.samples, turned(25.0)[None])
    assert both.weights.sum() == pytest.approx(1.0)
    three = preferred(cut_off, of_modes((0.6, -65.0), (0.3, 25.0), (0.1, -20.0)), Limited(LIMIT_DEG))
    assert [mode.weight for mode in three.modes] == pytest.approx([0.75, 0.25])
    far = preferred(cut_off, of_modes((0.9997, -65.0), (0.0003, 25.0)), Limited(LIMIT_DEG))
    assert [mode.weight for mode in far.modes] == pytest.approx([0.752, 0.248], abs=1e-3)
    for wide in (of_modes((0.6, -65.0), (0.4, 65.0)), of_modes((0.6, 25.0), (0.4, -40.0)), of_modes((1.0, -65.0))):
        assert preferred(cut_off, wide, Limited(LIMIT_DEG)) is wide


# Frames in which something hides the object: what is spent on them, and that those after them join as ever.

HIDDEN = frozenset({2, 3, 4, 5})


def outcomes(steps: list[Step]) -> list[tuple[int, bool, Reason | None]]:
    return [(step.frame.index, step.accepted, step.left_out) for step in steps]


def test_after_one_frame_searched_for_in_vain_others_that_are_hidden_are_only_glanced_at() -> None:
    registrar, quick = Oracle(blind=HIDDEN), Oracle(blind=HIDDEN)
    steps = run(registrar=registrar, quick=quick)
    # At the end they are tried among each other: they might be a segment of their own.
    assert {source for source, target in registrar.asked if target not in HIDDEN} & HIDDEN == {2}
    assert {source for source, _ in quick.asked} >= {3, 4, 5}
    whole = run(registrar=Oracle(blind=HIDDEN))
    assert outcomes(steps) == outcomes(whole)
    assert sorted(steps[-1].solution.trajectory) == [0, 1, 6, 7, 8]
    for frame, pose in whole[-1].solution.trajectory.items():
        np.testing.assert_array_equal(steps[-1].solution.trajectory[frame], pose)


def test_a_frame_hidden_now_and_then_is_searched_for_at_the_previous_view_alone() -> None:
    hidden = frozenset({2, 4, 6})
    registrar = Oracle(blind=hidden)
    steps = run(registrar=registrar, quick=Oracle(blind=hidden))
    assert [target for source, target in registrar.asked if source == 6] == [5]
    assert sorted(steps[-1].solution.trajectory) == [0, 1, 3, 5, 7, 8]


def test_a_glance_never_joins_frames_itself() -> None:
    """What it takes for surface is searched for as ever: false hopes change nothing but the cost."""
    registrar, hopeful = Oracle(blind=HIDDEN), Oracle(noise=100.0)
    steps = run(registrar=registrar, quick=hopeful)
    whole = Oracle(blind=HIDDEN)
    assert outcomes(steps) == outcomes(run(registrar=whole))
    assert registrar.asked == whole.asked
    assert trajectory_error(steps[-1]) < 1e-6


def test_lost_frames_are_found_from_far_round_by_way_of_glances() -> None:
    early = frozenset((source, target) for source in (3, 4, 5, 6) for target in range(source) if target < 3)
    parts = Oracle(apart=early, reach=9.0), Oracle(apart=early, reach=9.0)
    last = run(registrar=parts[0], quick=parts[1])[-1]
    assert parts[1].asked
    assert set(last.solution.trajectory) == set(range(9))
    assert trajectory_error(last) < 1e-6


def test_a_search_is_announced_for_lost_frames_and_no_others() -> None:
    maker = modeler(registrar=Oracle(blind=HIDDEN), quick=Oracle(blind=HIDDEN))
    assert {event.frame for event in maker.run(FRAMES, Scene()) if isinstance(event, Searching)} == HIDDEN
    assert not any(isinstance(event, Searching) for event in modeler().run(FRAMES, Scene()))


def test_a_glance_is_a_smaller_search_of_the_same_likelihood() -> None:
    registrar = VisibilityRegistrar(likelihood=VisibilityLikelihood(points=500), min_overlap=0.3)
    quick = quick_registrar(registrar)
    assert isinstance(quick, VisibilityRegistrar)
    assert (quick.likelihood.points, quick.min_overlap) == (500, 0.3)
    assert quick.search.max_starts < registrar.search.max_starts
    assert quick.sampler.max_draws < registrar.sampler.max_draws
    assert quick.max_modes == 1
    assert quick_registrar(IcpRegistrar()) is None
