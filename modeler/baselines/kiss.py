"""KISS-Matcher, refined by ICP."""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from modeler.baselines.clouds import AbstractCloudRegistrar, Cloud, Fit, cube_edges_m
from modeler.baselines.icp import FINE, IcpRegistrar
from modeler.system.extras import install_command
from modeler.types import Array, InputError, RayImage

MISSING = f"KISS-Matcher is not installed; install it with: {install_command('peers')}"


def installed() -> bool:
    """Return whether KISS-Matcher can be imported."""
    return importlib.util.find_spec("kiss_matcher") is not None


@final
@dataclass(frozen=True)
class KissIcpRegistrar(AbstractCloudRegistrar):
    """KISS-Matcher (Lim et al., ICRA 2025), refined by point-to-plane ICP.

    Faster-PFH features, matches pruned by the largest k-core of their compatibility graph (ROBIN), and a robust solver,
    with its default parameters for voxels of one unit. The prior is used only for its spread in directions that the
    surfaces leave open.
    """

    voxel: float = 1 / 40
    """Voxel edge, as a fraction of the object's size."""
    icp: IcpRegistrar = field(default_factory=lambda: IcpRegistrar(voxels=FINE))
    """The refinement, without coarse levels, which could leave the basin of a good initial pose."""

    def fit(self, source: RayImage, target: RayImage, initial: Array, rng: np.random.Generator) -> Fit | None:
        """Return the local optimum from KISS-Matcher's motion.

        Raises:
            InputError: if KISS-Matcher is not installed.
        """
        if not installed():
            raise InputError(MISSING)
        clouds = Cloud.of(source), Cloud.of(target)
        if min(len(cloud.points_m) for cloud in clouds) < self.min_points:
            return None
        return self.icp.refine(*clouds, self.search(*clouds, initial))

    def search(self, source: Cloud, target: Cloud, fallback: Array) -> Array:
        """Return the motion (4, 4) that KISS-Matcher finds; `fallback` (4, 4) if it finds none."""
        matcher: Any = importlib.import_module("kiss_matcher")  # its types are known only if it is installed
        (unit_m,) = cube_edges_m(source, target, (self.voxel,))  # it rejects voxels below 5 mm
        centres_m = source.points_m.mean(axis=0), target.points_m.mean(axis=0)
        centred = [
            list(((cloud.points_m - centre_m) / unit_m).astype(np.float32))
            for cloud, centre_m in zip((source, target), centres_m, strict=True)
        ]
        with _one_processor():
            found = matcher.KISSMatcher(matcher.KISSMatcherConfig(1.0)).estimate(*centred)
        if not found.valid:
            return fallback
        pose = np.eye(4)
        pose[:3, :3] = found.rotation
        pose[:3, 3] = centres_m[1] + unit_m * np.asarray(found.translation).ravel() - pose[:3, :3] @ centres_m[0]
        return pose


@contextmanager
def _one_processor() -> Iterator[None]:
    """Restrict this thread, and those that a library starts for it, to one processor, if the system can.

    KISS-Matcher sums in the order in which its threads finish, so that 5 of 27 pairs registered three times differ.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)
