"""Two views compared in both directions: the likelihood of `visibility` at any blur."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modeler import se3
from modeler.kernels import visibility as kernel
from modeler.registration.annealing import LogLikelihood
from modeler.registration.lookup import Lookup
from modeler.registration.posterior import rows
from modeler.types import Array


@dataclass(frozen=True, eq=False)
class Pair:
    """p(surface of source | image target, T) · p(surface of target | image source, T), tempered."""

    forward: Lookup
    """The source's points looked up in the target."""
    backward: Lookup
    """The target's points looked up in the source."""
    effective_points: float
    """Number of independent measurements that the points of both views together are worth."""

    def level(self, blur_m: float, _: Array, *, lead: bool = True) -> LogLikelihood:
        """Return the tempered log-likelihood of poses (n, 4, 4), the surfaces blurred by `blur_m`.

        With `lead` it leans towards poses where surface with relief matches, so that blurred levels do not settle for
        the many poses that merely contradict nothing.
        """
        stride = 2 if blur_m < 0.003 else 4 if blur_m < 0.006 else 8  # blunt comparisons need fewer points
        weight = stride * self.effective_points / (len(self.forward.points) + len(self.backward.points))

        forward, backward = self.forward.at(blur_m, stride, lead=lead), self.backward.at(blur_m, stride, lead=lead)

        def log_likelihood(target_from_source: Array) -> Array:
            there, back = rows(target_from_source), rows(se3.inverse(target_from_source))
            return weight * (forward(there) + backward(back))

        return log_likelihood

    def surface_noise_m(self, poses: Array, blur_m: float) -> float:
        """Return the standard deviation in m of matching surfaces' distance, beyond their pixels' noise.

        It holds what smoothing does to curved surfaces, the sensor's noise that neighbours share, and what is left of
        the spread of the samples `poses` (n, 4, 4): a nuisance parameter, at its most likely value given the samples.
        Points farther apart than 4 standard deviations of the present blur do not match.
        """
        variances = []
        for pose in poses[:: max(len(poses) // 20, 1)]:
            matched = np.concatenate(
                [
                    self.forward.matched_residuals(rows(pose[None])[0], blur_m),
                    self.backward.matched_residuals(rows(se3.inverse(pose)[None])[0], blur_m),
                ]
            )
            if len(matched) > 20:
                variances.append(np.mean(matched))
        return float(np.sqrt(max(np.median(variances), 0.0))) if variances else blur_m

    def overlap(self, target_from_source: Array) -> float:
        """Return the share of points that should be seen by both cameras and are."""
        verdicts = np.concatenate(
            [
                self.forward.verdicts(rows(target_from_source[None])[0]),
                self.backward.verdicts(rows(se3.inverse(target_from_source)[None])[0]),
            ]
        )
        wrong = np.isin(verdicts, (kernel.BEHIND, kernel.IN_FRONT, kernel.IN_EMPTY_SPACE)).sum()
        matched = (verdicts == kernel.MATCHED).sum()
        return float(matched / max(matched + wrong, 1))
