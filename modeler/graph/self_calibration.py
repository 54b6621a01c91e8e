"""Self-calibration: the focal length under which the loops of a run close.

A surface at angle θ to the image plane, seen with a focal length too short by a factor c, appears at atan(c tan θ), so
that estimated rotations are too small or too large, and those of a closed loop do not sum up to 360°. A run estimates
its focal length from the derivatives of its edges, which hold near the given one. Here every edge is registered again
under each estimate, until convergence (method, eq. 10.5).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

from modeler.graph import MovingGraph, estimate_focal_length
from modeler.graph.focal import MAX_SIGMAS
from modeler.graph.pose_graph import Factor, collapse_modes
from modeler.priors.proposals import PredictedProposal
from modeler.types import AbstractPrior, Edge, FocalLength, Posterior, RayImage
from modeler.views import Sensor

Register = Callable[[RayImage, RayImage, AbstractPrior], Posterior]
"""Returns the posterior of target_from_source of a source and a target view under a prior."""

_LIMIT_STEPS = 2.0  # steps for which limits hold, as where a run places a view that one step's do not


@final
@dataclass(frozen=True)
class FocalCalibrator:
    """Estimates the focal length from the views and the edges of a run."""

    prior_sigma: float = 0.05
    """Prior standard deviation of log c; up to three of them are considered. Given focal lengths of three captures were
    off by 4 to 10 %, calibrated ones by 1 %."""

    def estimate(
        self,
        views: Mapping[int, RayImage],
        edges: Sequence[Edge],
        sensor: Sensor,
        register: Register,
        prior: AbstractPrior,
    ) -> FocalLength:
        """Return the focal length of least graph error.

        Args:
            views: by frame number, made with the given focal length.
            edges: of the run. Closures also take part if they were rejected as contradicting the chain.
            sensor: that made the views.
            register: as the run did.
            prior: of the run.
        """
        known, root = prior.relaxed(_LIMIT_STEPS), min(views)
        unsure = replace(sensor, sigma_focal=self.prior_sigma)  # so that registrations tell how they follow it
        taking_part = [edge for edge in edges if {edge.source, edge.target} <= views.keys() and _counts(edge)]

        def estimate_at(centre: float) -> FocalLength:
            made = _Made(views, unsure, centre)
            found = [self._registered(edge, made, register, known) for edge in taking_part]
            graph = MovingGraph([factor for factor in found if factor is not None], root, {})
            return graph.estimate(self.prior_sigma, -centre)

        return estimate_focal_length(estimate_at, reach=MAX_SIGMAS * self.prior_sigma)

    def _registered(self, edge: Edge, made: _Made, register: Register, prior: AbstractPrior) -> Factor | None:
        """Return an edge under another focal length; None if its change is unknown.

        If it cannot be registered again, such as steps at the limit of the search, its derivative predicts the change;
        edges of a run with an exact focal length have none.

        Args:
            edge: of the run, whose solution proposes where to search: the focal length changes it by a few degrees.
            made: the views.
            register: see `estimate`.
            prior: of the motion.
        """
        proposal = PredictedProposal(prior, collapse_modes(edge.posterior))
        posterior = register(made.view(edge.source), made.view(edge.target), proposal)
        pose = collapse_modes(posterior if posterior.usable else edge.posterior.under(made.centre))
        return Factor(edge, pose) if pose.by_focal.any() else None


@dataclass(frozen=True, eq=False)
class _Made:
    """Views under another focal length."""

    views: Mapping[int, RayImage]
    sensor: Sensor
    centre: float
    """log c."""

    def view(self, frame: int) -> RayImage:
        """Return a view at the centre."""
        if frame not in self._known:
            self._known[frame] = self.sensor.refocused(self.views[frame], self.centre)
        return self._known[frame]

    @cached_property
    def _known(self) -> dict[int, RayImage]:
        return {}


def _counts(edge: Edge) -> bool:
    return edge.kind != "join" and (edge.accepted or (edge.kind == "closure" and edge.posterior.usable))
