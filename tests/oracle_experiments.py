"""Recordings of a box and methods that know the truth, for tests of experiments."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import tabletop

from modeler import se3
from modeler.experiment import Experiment, Pairing, Trial
from modeler.priors import GeneralPrior
from modeler.types import (
    NOMINAL_FOCAL,
    AbstractRegistrar,
    Array,
    Frame,
    Outcome,
    PoseGaussian,
    Posterior,
    SensorNoise,
    ViewPair,
)

BODY = tabletop.Box((0.05, 0.08, 0.035))
POSES = dict(enumerate(tabletop.turntable(24)[2:6]))
SIGMAS = np.repeat([0.01, 0.002], 3)


@dataclass(frozen=True)
class Recording:
    """A box turned in front of the camera by 15° a frame."""

    name: str = "box"
    known: bool = True
    lost: int | None = None
    indices: tuple[int, ...] = tuple(POSES)

    def frame(self, index: int) -> Frame:
        frame = tabletop.view(BODY, POSES[index], index).frame
        return replace(frame, mask=np.zeros_like(frame.mask)) if index == self.lost else frame

    def truth(self) -> Mapping[int, Array] | None:
        return POSES if self.known else None

    def sensor(self) -> SensorNoise | None:
        return SensorNoise(0.002, 0.001, sigma_focal=NOMINAL_FOCAL)


@dataclass(frozen=True)
class Oracle(AbstractRegistrar):
    """Knows the truth, and is off by an error of the size it states."""

    off_rad: float = 0.0

    def posterior_of(self, pair: ViewPair) -> Posterior:
        truth = POSES[pair.target.index] @ se3.inverse(POSES[pair.source.index])
        error = se3.exp(pair.rng.normal(size=6) * SIGMAS) @ se3.exp(np.array([self.off_rad, 0, 0, 0, 0, 0]))
        pose = PoseGaussian(truth @ se3.inverse(error), np.diag(SIGMAS**2))
        return Posterior(pair.source.index, pair.target.index, pose, Outcome.CONVERGED, 0.5, seconds=0.25)


def experiment(**changes: object) -> Experiment:
    methods = {"good": Oracle(), "bad": Oracle(off_rad=0.6)}
    return replace(Experiment(methods, GeneralPrior(), pairing=Pairing(offsets=(1, 2))), **changes)


def trial(error_deg: float, *, nees: float = 5.0, usable: bool = True) -> Trial:
    return Trial("box", "icp", 1, 1, 0, "converged", usable, 25.0, error_deg, 2.0, nees, 1.0, 0.5, 0.1)
