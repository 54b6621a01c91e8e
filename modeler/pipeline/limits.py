"""What is believed of a registration in limits made wider, because the motion seemed to lie beyond those known.

An object with sides alike matches as well a quarter turn on. That there is such a place beyond the limits is no reason
to believe that the object turned so far: a place there must match so much better as motions beyond are rare.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modeler import se3
from modeler.types import AbstractPoseDensity, Array, BoolArray, Mode, Outcome, Posterior, as_one, separate

_SURPRISE_NATS = 7.0  # one motion of a thousand goes beyond what is known
_MORE_OVERLAP = 0.15  # sides that are alike match about as much; the right place shows more than the end of the limits
_ELSEWHERE_RAD = 0.26  # two registrations turned against each other by more are at two places
_LEAST_WEIGHT = 0.01  # of a mode that is kept


def believed(within: Posterior, wider: Posterior, known: AbstractPoseDensity) -> Posterior:
    """Return what is believed of a view that a prior's limits seemed to cut off.

    Args:
        within: its registration in the limits.
        wider: that in wider ones.
        known: the motion that is known, with its limits.
    """
    if within.outcome is Outcome.AT_LIMIT and within.matches and wider.usable:
        elsewhere = se3.rotation_angle(se3.inverse(within.pose.mean) @ wider.pose.mean) > _ELSEWHERE_RAD
        # Unless it is one bump: a mean between places may lie inside, and is at none of them.
        possible = wider.outcome is Outcome.CONVERGED and _inside(known, wider.pose.mean[None])[0]
        better_nats = wider.log_evidence - within.log_evidence
        alike = wider.overlap < within.overlap + _MORE_OVERLAP
        if elsewhere and not possible and alike and better_nats < _SURPRISE_NATS:
            return replace(within, outcome=Outcome.AMBIGUOUS)
    return _discounted(wider, known)


def _discounted(posterior: Posterior, known: AbstractPoseDensity) -> Posterior:
    """Return a posterior with modes beyond the limits as unlikely as such motions are."""
    if not separate(posterior.modes):
        return posterior
    inside = _inside(known, np.stack([mode.pose.mean for mode in posterior.modes]))
    if inside.all() or not inside.any():
        return posterior
    weights = np.array([mode.weight for mode in posterior.modes]) * np.where(inside, 1.0, np.exp(-_SURPRISE_NATS))
    weights /= weights.sum()
    order = [int(place) for place in np.argsort(-weights, kind="stable") if weights[place] >= _LEAST_WEIGHT]
    total = float(weights[order].sum())
    modes = tuple(Mode(float(weights[place]) / total, posterior.modes[place].pose) for place in order)
    kept = _inside(known, posterior.samples) if len(posterior.samples) else np.zeros(0, dtype=bool)
    shares = posterior.weights[kept]
    return replace(
        posterior,
        pose=as_one(modes),
        modes=modes if len(modes) > 1 else (),
        samples=posterior.samples[kept],
        weights=shares / shares.sum() if shares.sum() > 0.0 else shares,
    )


def _inside(known: AbstractPoseDensity, motions: Array) -> BoolArray:
    """Return which motions (n, 4, 4) are within the limits."""
    return np.isfinite(known.log_density(motions))
