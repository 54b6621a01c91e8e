"""Separate places where a posterior has its mass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modeler.registration.candidates import Candidates
from modeler.registration.posterior import weighted_gaussian
from modeler.types import Array, PoseGaussian


@dataclass(frozen=True, eq=False)
class ModeSamples:
    """Samples of one place, and how much of the mass is there."""

    poses: Array
    """(n, 4, 4)."""
    weights: Array
    """(n,), their sum 1."""
    log_mass: float
    """Log of the prior mass times likelihood, up to a constant that all places share."""
    effective_samples: float
    """Effective number of the samples."""
    pareto_k: float
    """Tail index of the weights with which they came about."""

    def gaussian(self, centre_m: Array) -> PoseGaussian:
        """Return the mean and covariance of the samples, taken about a point (3,) of the source."""
        return weighted_gaussian(self.poses, self.weights, centre_m)


def split_modes(found: Candidates, centre_m: Array, *, apart: float = 3.5) -> list[Candidates]:
    """Return the candidates by place, the best place first.

    Two candidates share a place where a chain of candidates leads from one to the other, each link within `apart`
    standard deviations of both its ends, or of a coarse one. A ridge, such as the spin of a can, is one place.
    """
    near = found.distances(centre_m) <= apart
    linked = (near & near.T) | (near & found.coarse[:, None] & ~found.coarse)
    linked |= linked.T
    place = np.arange(len(found))
    for number in range(len(found)):  # each takes the name of the best that it hangs together with
        neighbours = np.unique(place[linked[number]])
        place[np.isin(place, neighbours)] = neighbours[0]
    return [found.some(place == name) for name in np.unique(place[~found.coarse])]


def weigh_modes(places: Sequence[ModeSamples], *, least: float = 0.005) -> list[tuple[float, ModeSamples]]:
    """Return the places with their shares of the mass, heaviest first; without those that hold less than the least."""
    log_mass = np.array([place.log_mass for place in places])
    mass = np.exp(log_mass - log_mass.max())
    mass /= mass.sum()
    kept = [number for number in np.argsort(-mass, kind="stable") if mass[number] >= least]
    return [(float(mass[number] / mass[kept].sum()), places[number]) for number in kept]
