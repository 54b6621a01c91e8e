"""Separate places where a posterior has its mass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modeler import se3
from modeler.registration.posterior import weighted_gaussian
from modeler.registration.search import Candidates, distances
from modeler.types import Array, Mode


@dataclass(frozen=True, eq=False)
class Place:
    """Samples of one place, and how much of the mass is there."""

    poses: Array
    """(n, 4, 4) equally weighted."""
    log_mass: float
    """Log of the prior mass times likelihood, up to a constant that all places share."""


def separate(found: Candidates, centre_m: Array, *, apart: float = 3.5) -> list[Candidates]:
    """Return the candidates by place, the best place first.

    Two candidates share a place where a chain of candidates leads from one to the other, each link within `apart`
    standard deviations of both its ends, or of a blunt one. A ridge, such as the spin of a can, is one place.
    """
    centre = se3.translation(centre_m)
    near = np.stack([distances(found, number, centre) <= apart for number in range(len(found))])
    linked = (near & near.T) | (near & found.blunt[:, None] & ~found.blunt)
    linked |= linked.T
    place = np.arange(len(found))
    for number in range(len(found)):  # each takes the name of the best that it hangs together with
        neighbours = np.unique(place[linked[number]])
        place[np.isin(place, neighbours)] = neighbours[0]
    return [found.some(place == name) for name in np.unique(place[~found.blunt])]


def shares(places: Sequence[Place]) -> Array:
    """Return the share (m,) of the mass in each place."""
    log_mass = np.array([place.log_mass for place in places])
    mass = np.exp(log_mass - log_mass.max())
    return mass / mass.sum()


def told(places: Sequence[Place], centre_m: Array, *, least: float = 0.02) -> tuple[Mode, ...]:
    """Return the places with at least a share of the mass as modes, heaviest first; none where one holds it all."""
    mass = shares(places)
    kept = [number for number in np.argsort(-mass, kind="stable") if mass[number] >= least]
    if len(kept) < 2:
        return ()
    return tuple(
        Mode(
            float(mass[number] / mass[kept].sum()),
            weighted_gaussian(places[number].poses, np.ones(len(places[number].poses)), centre_m),
        )
        for number in kept
    )
