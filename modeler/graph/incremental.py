"""The nonlinear solution of factors that keep coming: only what a new one moves is worked out again.

iSAM2 (Kaess et al., iSAM2: Incremental smoothing and mapping using the Bayes tree, IJRR 2012), by Cholesky, which takes
a sixth of the time of QR; where one direction is so much vaguer than others that it gives up, by QR.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam

from modeler.graph.factors import Factor
from modeler.graph.optimise import anchor
from modeler.types import Array

# Rotation in rad and translation in m by which a pose may be off the point at which its factors are linearised. What
# that leaves of the error is this times the factors' own residuals: a thousandth of their standard deviations.
_RELINEARISE = 1e-3
_STILL = 1e-5  # changes in rad and m that are not handed on
_ROUNDS = 8  # of relinearisation; where they do not end it, the start was too far off


@dataclass(frozen=True, eq=False)
class Incremental:
    """Factors with their solution, ready for more. A value: `plus` works on a copy, which is cheap."""

    factors: frozenset[Factor]
    """What takes part."""
    engine: gtsam.ISAM2
    """Never changed once it is here."""

    @classmethod
    def of(cls, factors: Sequence[Factor], poses: Mapping[int, Array], root: int) -> Incremental | None:
        """Return factors that connect all frames of poses, object_from_camera (4, 4) not far from their optimum."""
        for factorisation in ("CHOLESKY", "QR"):
            parameters = gtsam.ISAM2Params()
            parameters.setFactorization(factorisation)
            parameters.setRelinearizeThreshold(_RELINEARISE)
            parameters.relinearizeSkip = 1
            parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(_STILL))
            gtsam_graph = gtsam.NonlinearFactorGraph()
            gtsam_graph.add(anchor(root))
            found = _updated(gtsam.ISAM2(parameters), gtsam_graph, factors, poses)
            if found is not None:
                return found
        return None

    def plus(self, factors: Sequence[Factor], poses: Mapping[int, Array]) -> Incremental | None:
        """Return the solution with more factors; None where it cannot be found from here.

        Args:
            factors: those that are in already are passed over.
            poses: object_from_camera (4, 4) from which to start, at least of the frames that are new.
        """
        new = [factor for factor in factors if factor not in self.factors]
        grown = _updated(gtsam.ISAM2(self.engine), gtsam.NonlinearFactorGraph(), new, poses)
        return None if grown is None else Incremental(self.factors | grown.factors, grown.engine)

    @property
    def error(self) -> float:
        """Half the squared Mahalanobis distance of all factors to the solution."""
        return self.engine.getFactorsUnsafe().error(self.values)

    @cached_property
    def values(self) -> gtsam.Values:
        """The solution."""
        return self.engine.calculateEstimate()


def _updated(
    engine: gtsam.ISAM2, gtsam_graph: gtsam.NonlinearFactorGraph, factors: Sequence[Factor], poses: Mapping[int, Array]
) -> Incremental | None:
    """Return an engine brought up to date with more factors; None where that does not come to an end."""
    values = gtsam.Values()
    for frame in dict.fromkeys(frame for factor in factors for frame in (factor.target, factor.source)):
        if not engine.valueExists(frame):
            values.insert(frame, gtsam.Pose3(poses[frame]))
    for factor in factors:
        gtsam_graph.push_back(factor.between)
    try:
        result = engine.update(gtsam_graph, values)
        for _ in range(_ROUNDS):
            if result.getVariablesRelinearized() == 0:
                return Incremental(frozenset(factors), engine)
            result = engine.update()
    except RuntimeError:  # GTSAM's word for a system that it cannot solve
        pass
    return None
