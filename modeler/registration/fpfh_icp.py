"""Global alignment by features, made exact by ICP: the strongest of the field's usual recipes without a prior."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from modeler.registration.clouds import Cloud, posterior, start
from modeler.registration.fpfh import FpfhRegistrar
from modeler.registration.icp import IcpRegistrar
from modeler.types import AbstractMotion, AbstractRegistrar, Posterior, RayImage


@final
@dataclass(frozen=True)
class FpfhIcpRegistrar(AbstractRegistrar):
    """Take the motion that most FPFH matches agree with, and start point-to-plane ICP there."""

    fpfh: FpfhRegistrar = field(default_factory=FpfhRegistrar)
    """The global search."""
    icp: IcpRegistrar = field(default_factory=lambda: IcpRegistrar(voxels=(1 / 32, 1 / 64)))
    """The refinement, with no coarse levels, whose basins are wide enough to leave a good start."""

    def register(
        self, source: RayImage, target: RayImage, motion: AbstractMotion, *, rng: np.random.Generator
    ) -> Posterior:
        """Return the local optimum nearest to the feature matches' motion, with its residual-scaled inverse Hessian."""
        began = time.perf_counter()
        begin = start(source, target, motion, rng)
        clouds = Cloud.of(source), Cloud.of(target)
        fit = self.fpfh.search(*clouds, begin.target_from_source, rng)
        if fit is not None:
            fit = self.icp.refine(*clouds, fit.target_from_source)
        found = posterior(source, target, begin, fit, self.icp.min_fitness)
        return replace(found, seconds=time.perf_counter() - began)
