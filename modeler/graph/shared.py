"""What edges share, noise of their frames and of all views and the focal length: how it widens a solution.

Of an edge's covariance Σ a share ρ is its two images' own: pixel noise moves an image as a whole, alike in all its
edges. Frame k then appears not at T_k but at T_k exp(η_k), with one η_k ~ N(0, Q_k) for all its edges, and edges are
independent measurements of covariance (1 − ρ) Σ between these apparent poses. The optimum is the same, as one factor on
all covariances moves nothing; relative covariances are those of method.md, eq. G9: a single edge keeps its covariance,
several edges of a frame make it no smaller than the images allow, and along a chain the images' noise cancels.

All views may also err alike: one camera sees one object from one height, and puts it too near, say. Every frame then
appears at T_k exp(β), with one β ~ N(0, B) in camera coordinates (eq. G10). Every loop still closes, so that no graph
observes β; it cancels between frames that see the same side of the object.

A focal length that is not known exactly moves all edges together, and widens every motion by how it follows (eq. G14).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modeler import se3
from modeler.graph.covariance import RelativeCovariance, chi_square_quantile
from modeler.graph.pose_graph import Factor, PoseGraph
from modeler.types import Array, FocalLength, Solution

_QUANTILE = 0.16  # one standard error towards larger covariances
_MAX_SHARE = 0.9  # of a covariance: registration has noise of its own, from its samples


@dataclass(frozen=True, eq=False)
class SharedCovariance:
    """Covariances of target_from_source between solved frames whose edges share the frames' noise."""

    independent: RelativeCovariance
    """Those for independent edges."""
    factors: Sequence[Factor]
    """All that take part."""
    share: float
    """Share (0..1) of covariances that is the frames' own noise."""
    common: float = 0.0
    """B, as a share of the harmonic mean of all edges' covariances."""
    focal: FocalLength | None = None
    """What is known of the focal length; None: it is taken for known."""

    def __call__(self, target: int, source: int) -> Array:
        """Return the covariance (6, 6) of ξ in `target_from_source @ exp(ξ)`.

        Raises:
            KeyError: where a frame was not solved.
        """
        return self._widened(self.independent(target, source), target, source)

    def marginals(self) -> Mapping[int, Array]:
        """Return covariances (6, 6) of ξ in `object_from_camera @ exp(ξ)` by frame number."""
        return self._marginals

    @cached_property
    def _marginals(self) -> dict[int, Array]:
        root = self.independent.root
        return {frame: self._widened(alone, root, frame) for frame, alone in self.independent.marginals().items()}

    def _widened(self, alone: Array, target: int, source: int) -> Array:
        if target == source:
            return alone
        source_from_target = se3.inverse(self.independent.trajectory[source]) @ self.independent.trajectory[target]
        of_target = se3.inverse_covariance(source_from_target, self._own.get(target, np.zeros((6, 6))))
        covariance = (1.0 - self.share) * alone + self._own.get(source, np.zeros((6, 6))) + of_target  # eq. G9
        if self.focal is not None:
            still = np.zeros(6)  # of frames that came later
            apart = self.focal.by_focal.get(source, still) - self.focal.by_focal.get(target, still)
            moved = self.focal.sigma * se3.adjoint(se3.inverse(self.independent.trajectory[source])) @ apart
            covariance = covariance + np.outer(moved, moved)  # eq. G14
        if self.common:
            left = np.eye(6) - se3.adjoint(source_from_target)
            covariance = covariance + left @ self._alike @ left.T  # eq. G10
        return 0.5 * (covariance + covariance.T)

    @cached_property
    def _own(self) -> dict[int, Array]:
        """Covariances Q (6, 6) of the frames' own noise: ρ/2 of the harmonic mean of each frame's edges."""
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
    def _alike(self) -> Array:
        """B (6, 6)."""
        informations = [factor.root_information.T @ factor.root_information for factor in self.factors]
        return np.asarray(self.common * np.linalg.inv(np.mean(informations, axis=0)), dtype=np.float64)


def shared_noise(graph: PoseGraph, solution: Solution) -> float:
    """Estimate the share ρ of edges' covariances that is their images' own from how well loops close (eq. G11).

    The images' noise cancels around a loop, so that 6 l conditions of l loops are met with (1 − ρ) of the squared
    distance of independent edges. The estimate errs towards independence by one standard error; without loops, and
    where they close no better than independent edges, it is 0.

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
