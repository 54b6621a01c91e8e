"""The attempts to register a view: against which views of the graph, with which prior, with how much effort.

`LADDER` lists all of them, cheapest first. `Tracker.place` makes those of one stage until the gate
(`Closer.placement`) places the view.

An object with similar sides matches as well after a quarter turn. A mode beyond the prior's limits is therefore only
accepted if its likelihood outweighs the small prior probability of such motions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np

from modeler import se3
from modeler.closure import Closer
from modeler.graph.focal import LIMIT_STEPS
from modeler.pipeline.pairs import BEYOND_LIMITS_NATS, are_apart, converged_or
from modeler.pipeline.state import State
from modeler.priors import PredictedProposal
from modeler.registration.posterior import MIN_MODE_SHARE
from modeler.significance import RARE, nats_from_mode
from modeler.types import (
    FULL_EFFORT,
    AbstractPoseDensity,
    AbstractPrior,
    Array,
    BoolArray,
    InputError,
    JoinsPrevious,
    Mode,
    Outcome,
    PoseGaussian,
    Posterior,
    RayImage,
    are_separate,
    pooled,
)
from modeler.verdict.evidence import distance_nats

_LIMIT_OUTCOMES = (Outcome.AT_LIMIT, Outcome.NO_OVERLAP, Outcome.DEGENERATE)  # possible for motions beyond the limits
_MIN_OVERLAP_GAIN = 0.15  # similar sides have about the same overlap; the true mode has more than one at the limits
_UNEVEN_SHARE = 0.25
"""Of the way: sd in the middle between two views, if the speed is uneven (0.29 if it is anywhere)."""


@dataclass(frozen=True, eq=False)
class Attempt:
    """One registration of a view against a view of the graph."""

    source: RayImage
    """The view."""
    target: int
    """Number of the view of the graph."""
    prior: AbstractPrior
    """Of the motion between them."""
    effort: float = FULL_EFFORT
    """Share (0..1] of the usual effort. With less than `FULL_EFFORT`, a match is only a reason to try with that."""
    near: Array | None = None
    """(4, 4) the only mode that is asked for, if it is known roughly."""
    prefer: Prefer = field(default_factory=lambda: _newest)
    """Which of two registrations of the pair counts: an earlier one, or this one."""


@dataclass(frozen=True, eq=False)
class Search:
    """What is known while a view is registered: the run so far, and the registrations of this view."""

    state: State
    """The state of the run."""
    prior: AbstractPrior
    """Prior on the motion between two frames, with what was learned from the sequence so far."""
    closer: Closer
    """Selects other views."""
    view: RayImage
    """The view to register."""
    first: int
    """Number of the view of the graph to register it against first."""
    least_effort: float = FULL_EFFORT
    """Effort of the cheapest registration that the method has."""
    base: Posterior | None = None
    """The registration that placed the view, if one did."""
    last: bool = False
    """Whether it is the last of the sequence."""
    found: dict[int, Posterior] = field(default_factory=dict)
    """The registrations that count so far, by target, in order."""
    made: list[Posterior] = field(default_factory=list)
    """All registrations so far."""

    def attempts(self, stage: Stage) -> Iterator[Attempt]:
        """Yield the attempts of a stage; what was found by earlier ones decides about later ones."""
        for rung in LADDER[stage]:
            for target in rung.targets(self) if rung.condition(self) else ():
                prior = rung.prior(self, target)
                if prior is None:
                    continue
                attempt = Attempt(self.view, target, prior, prefer=rung.prefer)
                if self.least_effort < FULL_EFFORT and self._probably_hidden:
                    yield replace(attempt, effort=self.least_effort, prefer=lambda search, earlier, newer: earlier)
                    if not self.made[-1].matches or self.made[-1].outcome is Outcome.AT_LIMIT:
                        continue  # nor would it place the frame with full effort
                yield attempt

    def add(self, attempt: Attempt, posterior: Posterior) -> None:
        """Add the registration that an attempt made."""
        earlier = self.found.get(attempt.target)
        self.made.append(posterior)
        if earlier is not None:
            seconds = earlier.seconds + posterior.seconds
            posterior = replace(attempt.prefer(self, earlier, posterior), seconds=seconds)
        self.found[attempt.target] = posterior

    @property
    def steps(self) -> int:
        """Number of frames from the first view to this one."""
        return self.state.steps(self.view.index, self.first)

    @property
    def following(self) -> AbstractPrior:
        """The prior for a frame that is placed relative to the first view."""
        return self.prior.following(self.first)

    @property
    def posteriors(self) -> tuple[Posterior, ...]:
        """The registrations so far, in order."""
        return tuple(self.found.values())

    @property
    def candidates(self) -> tuple[Posterior, ...]:
        """The registrations that may place the view: without those of other views that contradict what was given.

        What was given of the motion is not part of them. So they would be the only evidence for themselves.
        """
        first = self.found.get(self.first)
        return tuple(found for found in self.posteriors if found is first or not self._contradicts_prior(found))

    def _contradicts_prior(self, posterior: Posterior) -> bool:
        """Return whether a registration contradicts a prior that was given."""
        if not posterior.usable:
            return False
        means = np.stack([mode.pose.mean for mode in posterior.modes] or [posterior.pose.mean])
        steps = self.state.steps(self.view.index, posterior.target)
        prior = self.prior.following(posterior.target)
        return contradicts_prior(prior, self.view, self.state.views[posterior.target], steps, means)

    @property
    def _probably_hidden(self) -> bool:
        """Whether something probably hides the object: a search failed, and nothing matches since."""
        first_try = self.steps == 1 and not self.found and self.view.index not in self.state.lost
        matched = any(posterior.matches for posterior in self.found.values())
        placed = self.base is not None or self.view.index in self.state.views
        return self.state.failed_searches > 0 and not (first_try or matched or placed)


def contradicts_prior(prior: AbstractPrior, source: RayImage, target: RayImage, steps: int, motions: Array) -> bool:
    """Return whether all of some motions contradict a prior that was given, as the verdict would say (13.2).

    Args:
        prior: of the motion between two frames.
        source: a view.
        target: another.
        steps: number of frames from one to the other.
        motions: target_from_source (n, 4, 4).
    """
    if prior.unlimited() is not None:
        return False
    with suppress(InputError):
        density = prior.relaxed(max(steps, 2)).between(source, target)
        return distance_nats(density, float(density.log_prior(motions).max())) > nats_from_mode(RARE)
    return False


# Views to register a view against.


def _first(search: Search) -> Iterable[int]:
    return (search.first,)


def _others(search: Search) -> Iterator[int]:
    """Yield other views of the graph, each selected by what was found before it."""
    while (target := search.closer.relocalisation_target(search.posteriors, search.state.map_view)) is not None:
        yield target


def _returned_to(search: Search) -> Iterator[int]:
    """Yield earlier views to which the object seems to have returned, but for those registered already."""
    assert search.base is not None
    frame, tried = search.view.index, set[int]()
    if frame in search.state.lost:  # only such a frame has edges
        tried = {edge.target for edge in search.state.graph.edges if edge.source == frame}
    for target in search.closer.closure_targets(search.base, search.state.map_view, last=search.last):
        if target not in tried and target not in search.found:
            yield target


# Priors of a pair.


def _of_the_steps(search: Search, target: int) -> AbstractPrior:
    """Return the prior with the limits of the number of steps to the first view."""
    return search.following.relaxed(search.steps) if search.steps > 1 else search.following


def _of_two_steps(search: Search, target: int) -> AbstractPrior:
    """Return the prior with the limits of at least two steps."""
    return search.following.relaxed(max(search.steps, 2))


def _unlimited(search: Search, target: int) -> AbstractPrior | None:
    """Return the prior without limits if these are defaults."""
    return search.following.unlimited()


def _by_the_graph(search: Search, target: int) -> AbstractPrior:
    """Return the prior with the graph's prediction of the motion between two of its views as a proposal.

    Steps are evidence for a pair whose edge already holds them: one with the previous view, registered anew.
    """
    ends = search.view.index, target
    own = (edge.reason for edge in search.state.graph.accepted if (edge.source, edge.target) == ends)
    placed = any(isinstance(reason, JoinsPrevious) for reason in own)
    motion = search.state.solution.relative_gaussian(target, search.view.index)
    return predicted(search, target, search.following if placed else search.prior, motion, far=True)


def _through_base(search: Search, target: int) -> AbstractPrior:
    """Return the prior with the motion predicted by the registration that placed the view as a proposal."""
    assert search.base is not None
    motion = search.closer.predicted_motion(search.base, target, search.state.solution)
    return predicted(search, target, search.following, motion)


def _between(search: Search, target: int) -> AbstractPrior:
    """Return the prior with a motion predicted from the two views nearest in time as a proposal."""
    known, solution = search.state.map_view, search.state.solution
    nearest = known.nearest_in_time(search.view.index)
    if len(nearest) == 1:
        return _of_the_steps(search, target)
    centroid_m = search.view.centroid_m
    motion = se3.inverse(solution.trajectory[target]) @ known.extrapolated(search.view.index)
    step = solution.relative(target, nearest[-1])
    way = float(se3.rotation_angle(step)), float(np.linalg.norm(se3.transform(step, centroid_m) - centroid_m))
    spread = np.diag(np.repeat(_UNEVEN_SHARE * np.array(way), 3) ** 2)
    expected = PoseGaussian(motion, se3.covariance_about(spread, -centroid_m))
    return predicted(search, target, search.following, expected)


def predicted(
    search: Search, target: int, prior: AbstractPrior, motion: PoseGaussian, *, far: bool = False
) -> PredictedProposal:
    """Return the prior of a pair whose motion is predicted: without its limits if they exclude it.

    Args:
        search: of the source.
        target: number of a view of the graph.
        prior: of the pair.
        motion: target_from_source.
        far: whether limits are those of several steps also for small rotations.
    """
    far |= bool(np.degrees(se3.rotation_angle(motion.mean)) > search.closer.max_angle_deg)
    within, unlimited = prior.relaxed(LIMIT_STEPS) if far else prior, prior.unlimited()
    if unlimited is not None:  # limits that are defaults
        with suppress(InputError):  # registering says so
            if not _inside(within.between(search.view, search.state.views[target]), motion.mean[None])[0]:
                within = unlimited
    return PredictedProposal(within, motion)


# Conditions on what was found so far.


def _at_the_limits(search: Search) -> bool:
    """Return whether the motion may exceed the limits of one step."""
    return search.steps == 1 and search.found[search.first].outcome in _LIMIT_OUTCOMES


def _unconvincing(search: Search) -> bool:
    return not search.found[search.first].convincing


# Which of two registrations of a pair counts.


def _newest(search: Search, earlier: Posterior, newer: Posterior) -> Posterior:
    return newer


def _if_converged(search: Search, earlier: Posterior, newer: Posterior) -> Posterior:
    return converged_or(earlier, newer)


def _unless_alike(search: Search, earlier: Posterior, newer: Posterior) -> Posterior:
    target = search.state.views[search.first]
    return unless_alike(earlier, newer, search.following.between(search.view, target))


def unless_alike(within: Posterior, wider: Posterior, density: AbstractPoseDensity) -> Posterior:
    """Return the registration that counts of a view whose motion seemed to exceed the prior's limits.

    Args:
        within: its registration within the limits.
        wider: that within wider limits.
        density: the prior density, with the limits.
    """
    if within.outcome is Outcome.AT_LIMIT and within.matches and wider.usable:
        # Only for one mode: the mean of several may lie inside without being near any of them.
        inside = wider.outcome is Outcome.CONVERGED and _inside(density, wider.pose.mean[None])[0]
        better_nats = wider.log_marginal_likelihood - within.log_marginal_likelihood
        similar_overlap = wider.overlap < within.overlap + _MIN_OVERLAP_GAIN
        if are_apart(within, wider) and not inside and similar_overlap and better_nats < BEYOND_LIMITS_NATS:
            return replace(within, outcome=Outcome.AMBIGUOUS)
    return _discounted(wider, density)


def _discounted(posterior: Posterior, density: AbstractPoseDensity) -> Posterior:
    """Return a posterior whose modes beyond the limits are weighted by the prior probability of such motions."""
    if not are_separate(posterior.modes):
        return posterior
    inside = _inside(density, np.stack([mode.pose.mean for mode in posterior.modes]))
    if inside.all() or not inside.any():
        return posterior
    weights = np.array([mode.weight for mode in posterior.modes]) * np.where(inside, 1.0, np.exp(-BEYOND_LIMITS_NATS))
    weights /= weights.sum()
    order = [int(place) for place in np.argsort(-weights, kind="stable") if weights[place] >= MIN_MODE_SHARE]
    total = float(weights[order].sum())
    modes = tuple(Mode(float(weights[place]) / total, posterior.modes[place].pose) for place in order)
    kept = _inside(density, posterior.samples) if len(posterior.samples) else np.zeros(0, dtype=bool)
    shares = posterior.weights[kept]
    return replace(
        posterior,
        pose=pooled(modes),
        modes=modes if len(modes) > 1 else (),
        samples=posterior.samples[kept],
        weights=shares / shares.sum() if shares.sum() > 0.0 else shares,
    )


def _inside(density: AbstractPoseDensity, motions: Array) -> BoolArray:
    """Return whether motions (n, 4, 4) are within the limits, (n,)."""
    return np.isfinite(density.log_density(motions))


Prefer = Callable[[Search, Posterior, Posterior], Posterior]
Stage = Literal["track", "revisit", "fill", "close", "refine"]


@dataclass(frozen=True)
class Rung:
    """One or more attempts: the views, the prior of the motion to each, if what was found so far, counting which."""

    targets: Callable[[Search], Iterable[int]]
    """The views of the graph to register the view against."""
    prior: Callable[[Search, int], AbstractPrior | None]
    """Prior of the motion to one of them; None: it is not tried."""
    condition: Callable[[Search], bool] = lambda search: True
    """On the registrations so far."""
    prefer: Prefer = _newest
    """Which of two registrations of a pair counts."""


LADDER: Final[Mapping[Stage, tuple[Rung, ...]]] = {
    #               against       prior on the motion   if the first         instead of an earlier one
    "track": (Rung(_first,        _of_the_steps),
              Rung(_first,        _of_two_steps,        _at_the_limits,      _unless_alike),
              Rung(_first,        _unlimited,           _unconvincing,       _if_converged),
              Rung(_others,       _of_two_steps)),
    "revisit": (Rung(_first,      _of_the_steps),
                Rung(_first,      _of_two_steps,        _at_the_limits,      _unless_alike)),
    "fill": (Rung(_first,         _between),),
    "close": (Rung(_returned_to,  _through_base),),
    "refine": (Rung(_first,       _by_the_graph),),
}  # fmt: skip
