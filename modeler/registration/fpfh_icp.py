"""Global alignment by features, made exact by ICP: the strongest of the field's usual recipes without a prior."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np

from modeler.registration.clouds import Cloud, Fit, registered
from modeler.registration.fpfh import FpfhRegistrar
from modeler.registration.icp import IcpRegistrar
from modeler.types import AbstractPoseDensity, AbstractRegistrar, Array, Posterior, RayImage


@final
@dataclass(frozen=True)
class FpfhIcpRegistrar(AbstractRegistrar):
    """Take the motion that most FPFH matches agree with, and start point-to-plane ICP there."""

    fpfh: FpfhRegistrar = field(default_factory=FpfhRegistrar)
    """The global search."""
    icp: IcpRegistrar = field(default_factory=lambda: IcpRegistrar(voxels=(1 / 32, 1 / 64)))
    """The refinement, with no coarse levels, whose basins are wide enough to leave a good start."""

    def register(
        self, source: RayImage, target: RayImage, density: AbstractPoseDensity, *, rng: np.random.Generator
    ) -> Posterior:
        """Return the local optimum nearest to the feature matches' motion, with its residual-scaled inverse Hessian."""
        clouds = Cloud.of(source), Cloud.of(target)

        def fit(begin: Array) -> Fit | None:
            coarse = self.fpfh.search(*clouds, begin, rng)
            return None if coarse is None else self.icp.refine(*clouds, coarse.target_from_source)

        return registered((source, target), density, rng, min_fitness=self.icp.min_fitness, fit=fit)
