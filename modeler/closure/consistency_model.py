"""How far a registration may be from what the graph foretells: covariances hold less than all errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modeler import se3
from modeler.closure.consistency import agreement, modes
from modeler.closure.extrapolation import composed
from modeler.closure.map_view import MapView
from modeler.closure.paths import ShortestPaths
from modeler.types import Array, Consistency, PoseGaussian, Posterior


@dataclass(frozen=True)
class ConsistencyModel:
    """What is believed of stated covariances.

    Pairwise covariances hold no systematic error, which adds up along a chain instead of averaging out, so that
    registrations are compared with a wider one than they say.
    """

    sigma_scale: float = 2.0
    """How many times the standard deviations of edges may understate their random errors."""
    drift_deg: float = 0.15
    """Systematic rotation error of an edge in degrees; along a chain it adds up."""
    drift_m: float = 0.00025
    """Systematic translation error of an edge in m, at the object; along a chain it adds up."""

    def systematic(self, length: int, centroid_m: Array) -> Array:
        """Return the covariance (6, 6) of the systematic error of a chain of `length` edges, seen from its end.

        Args:
            length: of the chain.
            centroid_m: (3,) of the object in the camera at its end.
        """
        sigmas = length * np.repeat([np.radians(self.drift_deg), self.drift_m], 3)
        return se3.covariance_about(np.diag(sigmas**2), -centroid_m)

    def agreement(
        self,
        posterior: Posterior,
        predictions: Sequence[tuple[float, PoseGaussian]],
        *,
        length: int,
        centroid_m: Array,
    ) -> Consistency:
        """Return how well a registration agrees with what a chain of edges says of the same motion.

        Args:
            posterior: target_from_source as the images have it.
            predictions: as the chain has it, with weights that sum to 1.
            length: of the chain.
            centroid_m: (3,) of the object in the source camera.
        """
        systematic = self.systematic(length, centroid_m)
        return agreement(posterior, predictions, systematic=systematic, scale=self.sigma_scale, centroid_m=centroid_m)

    def consistency_through(
        self,
        base: Posterior,
        posterior: Posterior,
        map_view: MapView,
        reach: ShortestPaths,
    ) -> Consistency:
        """Return how well a registration of a frame agrees with the way through the graph and along another of it.

        Args:
            base: the other, by which the frame is placed.
            posterior: target_from_source of the frame and some view.
            map_view: what is known so far.
            reach: ways from the view of `base`.
        """
        way = map_view.solution.relative_gaussian(posterior.target, base.target)
        predictions = [(weight, composed(way, pose)) for weight, pose in modes(base)]
        centroid_m = se3.transform(se3.inverse(modes(base)[0][1].mean), map_view.views[base.target].centroid_m[None])[0]
        surest = reach.get(posterior.target)
        order = list(map_view.views)
        length = abs(order.index(base.target) - order.index(posterior.target)) if surest is None else surest.edges
        return self.agreement(posterior, predictions, length=1 + length, centroid_m=centroid_m)
