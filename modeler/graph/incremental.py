"""The nonlinear solution of links that keep coming: only what a new one moves is worked out again.

iSAM2 (Kaess et al., iSAM2: Incremental smoothing and mapping using the Bayes tree, IJRR 2012), by Cholesky, which takes
a sixth of the time of QR; where one direction is so much vaguer than others that it gives up, by QR.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam

from modeler.graph.links import Link
from modeler.graph.optimise import anchor
from modeler.types import Array

# Rotation in rad and translation in m by which a pose may be off the point at which its links are linearised. What that
# leaves of the error is this times the links' own residuals: a thousandth of their standard deviations.
_RELINEARISE = 1e-3
_STILL = 1e-5  # changes in rad and m that are not handed on
_ROUNDS = 8  # of relinearisation; where they do not end it, the start was too far off


@dataclass(frozen=True, eq=False)
class Incremental:
    """Links with their solution, ready for more. A value: `plus` works on a copy, which is cheap."""

    links: frozenset[Link]
    """What takes part."""
    engine: gtsam.ISAM2
    """Never changed once it is here."""

    @classmethod
    def of(cls, links: Sequence[Link], poses: Mapping[int, Array], root: int) -> Incremental | None:
        """Return links that connect all frames of poses, object_from_camera (4, 4) not far from their optimum."""
        for factorisation in ("CHOLESKY", "QR"):
            parameters = gtsam.ISAM2Params()
            parameters.setFactorization(factorisation)
            parameters.setRelinearizeThreshold(_RELINEARISE)
            parameters.relinearizeSkip = 1
            parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(_STILL))
            factors = gtsam.NonlinearFactorGraph()
            factors.add(anchor(root))
            found = _updated(gtsam.ISAM2(parameters), factors, links, poses)
            if found is not None:
                return found
        return None

    def plus(self, links: Sequence[Link], poses: Mapping[int, Array]) -> Incremental | None:
        """Return the solution with more links; None where it cannot be found from here.

        Args:
            links: those that are in already are passed over.
            poses: object_from_camera (4, 4) from which to start, at least of the frames that are new.
        """
        new = [link for link in links if link not in self.links]
        grown = _updated(gtsam.ISAM2(self.engine), gtsam.NonlinearFactorGraph(), new, poses)
        return None if grown is None else Incremental(self.links | grown.links, grown.engine)

    @property
    def error(self) -> float:
        """Half the squared Mahalanobis distance of all links to the solution."""
        return self.engine.getFactorsUnsafe().error(self.values)

    @cached_property
    def values(self) -> gtsam.Values:
        """The solution."""
        return self.engine.calculateEstimate()


def _updated(
    engine: gtsam.ISAM2, factors: gtsam.NonlinearFactorGraph, links: Sequence[Link], poses: Mapping[int, Array]
) -> Incremental | None:
    """Return an engine brought up to date with more factors; None where that does not come to an end."""
    values = gtsam.Values()
    for frame in dict.fromkeys(frame for link in links for frame in (link.target, link.source)):
        if not engine.valueExists(frame):
            values.insert(frame, gtsam.Pose3(poses[frame]))
    for link in links:
        factors.push_back(link.factor)
    try:
        result = engine.update(factors, values)
        for _ in range(_ROUNDS):
            if result.getVariablesRelinearized() == 0:
                return Incremental(frozenset(links), engine)
            result = engine.update()
    except RuntimeError:  # GTSAM's word for a system that it cannot solve
        pass
    return None
