"""Covariances under errors that edges share: noise of their images, of all views, and of the focal length.

A fraction ρ of an edge's covariance Σ is due to its two images: pixel noise moves an image as a whole, alike in all its
edges. Frame k then appears not at T_k but at T_k exp(η_k), with one η_k ~ N(0, Q_k) for all its edges, and edges are
independent measurements of covariance (1 − ρ) Σ between these apparent poses. The optimum is the same, as one factor on
all covariances moves nothing; relative covariances are those of method, eq. 8.9: a single edge keeps its covariance,
several edges of a frame make it no smaller than the images allow, and along a chain the images' noise cancels.

All views may also have a common error: one camera sees one object from one height, and its distance may be biased.
Every frame then appears at T_k exp(β), with one β ~ N(0, B) in camera coordinates (eq. 8.10). All loops still close,
and β is not observable; it cancels between frames that see the same side of the object. It includes a shift of all
measured surface, as by a biased distance.

The error of the focal length moves all edges together; each motion's covariance grows by its derivative (eq. 10.6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modeler import se3
from modeler.graph.covariance import RelativeCovariance, chi_square_quantile
from modeler.graph.pose_graph import Factor, PoseGraph
from modeler.types import Array, FocalLength, Solution

_QUANTILE = 0.16  # one standard error towards larger covariances
_MAX_SHARE = 0.9  # of a covariance: each registration also has sampling noise


@dataclass(frozen=True, eq=False)
class SharedCovariance:
    """Covariances of target_from_source between solved frames whose edges share the frames' noise."""

    independent: RelativeCovariance
    """Those for independent edges."""
    factors: Sequence[Factor]
    """All that take part."""
    share: float
    """Fraction (0..1) of covariances that is noise of the images."""
    common: float = 0.0
    """B, as a fraction of the harmonic mean of all edges' covariances."""
    focal: FocalLength | None = None
    """Estimate of the focal length; None: exact."""
    common_shift_m2: Array | None = None
    """(3, 3) covariance in m², in camera coordinates, of a shift of the surface in all views, added to B; None: 0."""

    def __call__(self, target: int, source: int) -> Array:
        """Return the covariance (6, 6) of ξ in `target_from_source @ exp(ξ)`.

        Raises:
            KeyError: if a frame was not solved.
        """
        return self._widened(self.independent(target, source), target, source)

    def _widened(self, independent: Array, target: int, source: int) -> Array:
        if target == source:
            return independent
        source_from_target = se3.inverse(self.independent.trajectory[source]) @ self.independent.trajectory[target]
        of_target = se3.inverse_covariance(source_from_target, self._noise.get(target, np.zeros((6, 6))))
        covariance = (1.0 - self.share) * independent + self._noise.get(source, np.zeros((6, 6))) + of_target  # eq. 8.9
        if self.focal is not None:
            zero = np.zeros(6)  # of frames added since
            apart = self.focal.by_focal.get(source, zero) - self.focal.by_focal.get(target, zero)
            moved = self.focal.sigma * se3.adjoint(se3.inverse(self.independent.trajectory[source])) @ apart
            covariance = covariance + np.outer(moved, moved)  # eq. 10.6
        if self.common or self.common_shift_m2 is not None:
            left = np.eye(6) - se3.adjoint(source_from_target)
            covariance = covariance + left @ self._common_covariance @ left.T  # eq. 8.10
        return 0.5 * (covariance + covariance.T)

    @cached_property
    def _noise(self) -> dict[int, Array]:
        """Covariances Q_k (6, 6) of the noise of images: ρ/2 of the harmonic mean of each frame's edges."""
        informations: dict[int, list[Array]] = {}
        for factor in self.factors:
            information = factor.root_information.T @ factor.root_information
            to_target = se3.adjoint(se3.inverse(factor.pose.mean))  # ξ of the source frame from one of the target's
            informations.setdefault(factor.source, []).append(information)
            informations.setdefault(factor.target, []).append(to_target.T @ information @ to_target)
        return {
            frame: np.asarray(0.5 * self.share * np.linalg.inv(np.mean(some, axis=0)), dtype=np.float64)
            for frame, some in informations.items()
        }

    @cached_property
    def _common_covariance(self) -> Array:
        """B (6, 6)."""
        covariance = np.zeros((6, 6))
        if self.common:
            informations = [factor.root_information.T @ factor.root_information for factor in self.factors]
            covariance += self.common * np.linalg.inv(np.mean(informations, axis=0))
        if self.common_shift_m2 is not None:
            covariance[3:, 3:] += self.common_shift_m2
        return covariance


def shared_noise(graph: PoseGraph, solution: Solution) -> float:
    """Estimate the fraction ρ of edges' covariances that is noise of their images from the loops' errors (eq. 8.11).

    The images' noise cancels around a loop, so that the squared distance over the 6 l conditions of l loops is (1 − ρ)
    of that of independent edges. The estimate is one standard error towards independence, and 0 without loops or if
    they close no better than independent edges.

    Args:
        graph: the edges.
        solution: of that graph.
    """
    count, distance = 0, 0.0
    for edge in graph.accepted:
        if edge.target not in solution.trajectory or edge.source not in solution.trajectory:
            continue
        if not solution.takes_part(edge):
            continue
        pose = solution.pose_of(edge)
        xi = se3.log(se3.inverse(pose.mean) @ solution.relative(edge.target, edge.source))
        distance += float(xi @ np.linalg.solve(pose.covariance, xi))
        count += 1
    conditions = 6 * (count - len(solution.trajectory) + 1)
    if not count or conditions <= 0:
        return 0.0
    return float(np.clip(1.0 - distance / chi_square_quantile(_QUANTILE, conditions), 0.0, _MAX_SHARE))
