"""Two views compared in both directions: the likelihood of `visibility`, and the equations of matching surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modeler import se3
from modeler.kernels import matching, ridges
from modeler.kernels import visibility as kernel
from modeler.registration.lookup import DirectedLikelihood
from modeler.se3 import matrices, rows
from modeler.types import Array

_FEW = 20  # so many matches say nothing of their noise


@dataclass(frozen=True, eq=False)
class PairLikelihood:
    """p(surface of source | image target, T) · p(surface of target | image source, T)."""

    forward: DirectedLikelihood
    """The source's points looked up in the target."""
    backward: DirectedLikelihood
    """The target's points looked up in the source."""
    size_m: float
    """Standard deviation in m of the surface points of a view: the size of the object."""
    no_overlap: float = 50.0
    """What it costs that no surface matches (nats)."""
    little_overlap: float = 0.1
    """Share of the points at which that cost has fallen to its e-th part."""

    @property
    def centre_m(self) -> Array:
        """The source's centroid (3,), about which motions turn."""
        return self.backward.image.centroid_m

    @property
    def points(self) -> int:
        """Number of points of both views."""
        return len(self.forward.points) + len(self.backward.points)

    @property
    def patches(self) -> float:
        """Number of patches of the surface of a view, on average, whose errors have nothing to do with each other."""
        return 0.5 * (self.forward.image.patches + self.backward.image.patches)

    def independent(self, most: float) -> float:
        """Return how many independent measurements all points are worth, where at most so many are.

        On an object that covers much of the image they are worth `most`, for what even far points err by alike; on a
        small one no more than the patches that smoothing leaves apart.
        """
        return 1.0 / (1.0 / most + 1.0 / self.patches)

    def log_likelihoods(
        self, poses: Array, blur_m: float, *, stride: int = 1, typical: float = 0.5
    ) -> tuple[Array, Array]:
        """Return the log-likelihoods (n,), not tempered, and the shares (n,) of points that matching surface explains.

        Args:
            poses: (n, 4, 4) target_from_source.
            blur_m: blur of the surfaces in m.
            stride: every so manieth point stands for the others.
            typical: what a good match loses to its misfit (nats), see `typical_misfit`.
        """
        projections = self.forward.projection(stride), self.backward.projection(stride)
        models = self.forward.model(blur_m, typical), self.backward.model(blur_m, typical)
        found = stride * kernel.log_likelihoods(rows(poses), *projections, *models)
        return found[:, kernel.LOG_LIKELIHOOD], found[:, kernel.EXPLAINED] / self.points

    def tempered(
        self, poses: Array, blur_m: float, *, effective_points: float, stride: int = 2, typical: float = 0.5
    ) -> Array:
        """Return the log-likelihoods (n,) of poses (n, 4, 4) as if few points were independent, and overlap.

        Two views that are to be registered have surface in common. A likelihood does not know: poses that hide every
        point contradict nothing, and are many. Those under which next to nothing matches are all but excluded; between
        others, with more or less in common, the likelihood alone decides.

        Args:
            poses: target_from_source.
            blur_m: blur of the surfaces in m.
            effective_points: most independent measurements that all points are worth, see `independent`.
            stride: every so manieth point stands for the others.
            typical: what a good match loses to its misfit (nats), see `typical_misfit`.
        """
        plain, share = self.log_likelihoods(poses, blur_m, stride=stride, typical=typical)
        worth = self.independent(effective_points) / self.points
        return worth * plain - self.no_overlap * np.exp(-share / self.little_overlap)

    def typical_misfit(self, pose: Array, blur_m: float) -> float:
        """Return what matches under a good pose (4, 4) lose to their misfit (nats), so that they count 0 on average.

        The noise that points and planes are said to have is not what it is, and overstated it would pay for every
        match: the spin of a can would lean to where most of its surface is in common.
        """
        misfits = np.concatenate(
            [
                self.forward.misfits(rows(pose), blur_m),
                self.backward.misfits(rows(se3.inverse(pose)), blur_m),
            ]
        )
        if len(misfits) <= _FEW:
            return 0.5
        hidden = self.forward.hidden_share
        low, high = 0.0, 2.0
        for _ in range(16):  # the mean grows with what is taken for typical
            middle = 0.5 * (low + high)
            mean = np.mean(np.log((1.0 - hidden) * np.exp(middle - misfits) + hidden))
            low, high = (middle, high) if mean < 0.0 else (low, middle)
        return 0.5 * (low + high)

    def normal_equations(self, poses: Array, surface_m: float, *, stride: int = 1) -> tuple[Array, Array]:
        """Return gradients (n, 6), matrices (n, 6, 6) of matching surface for ξ of poses (n, 4, 4) about the centre."""
        projections = self.forward.projection(stride), self.backward.projection(stride)
        gradients, equations = matching.normal_equations(rows(poses), *projections, self.centre_m, surface_m)
        return stride * gradients, stride * equations

    def normal_equation(self, pose: Array, surface_m: float) -> tuple[Array, Array]:
        """Return gradient (6,) and matrix (6, 6) of one pose (4, 4), see `normal_equations`."""
        projections = self.forward.projection(), self.backward.projection()
        return matching.normal_equation(rows(pose), *projections, self.centre_m, surface_m)

    def descend(
        self, poses: Array, surface_m: float, regulariser: matching.Regulariser, *, steps: int, stride: int
    ) -> Array:
        """Return poses (n, 4, 4) so many Gauss-Newton steps further down, each held by a regulariser."""
        projections = self.forward.projection(stride), self.backward.projection(stride)
        regulariser = _for_every(regulariser, stride)
        return matrices(matching.descend(rows(poses), *projections, self.centre_m, surface_m, regulariser, steps))

    def trace_ridges(
        self,
        poses: Array,
        spreads: Array,
        axes: Array,
        *,
        blur_m: float,
        regulariser: matching.Regulariser,
        effective_points: float,
        floor: float,
        stride: float,
        max_ridge_steps: int,
    ) -> Array:
        """Return poses (n, 4, 4) on the way from some along their axes, as far as `tempered` is above a floor.

        Args:
            poses: (k, 4, 4) target_from_source.
            spreads: (k, 6, 6) lower triangular roots of the covariances of ξ about the centre.
            axes: (k, 6) unit vectors in units of those spreads.
            blur_m: blur of the surfaces in m.
            regulariser: what holds a walker on its way across.
            effective_points: as for `tempered`.
            floor: the least that a place is worth (nats).
            stride: length of a stride in standard deviations.
            max_ridge_steps: at most so many.
        """
        coarse, fine = 4, 2  # every fourth point is used for descent, and tells how good a place is
        ground = ridges.RidgeLikelihood(
            forward=self.forward.projection(coarse),
            backward=self.backward.projection(coarse),
            scoring_forward=self.forward.projection(fine),
            scoring_backward=self.backward.projection(fine),
            forward_parameters=self.forward.model(blur_m),
            backward_parameters=self.backward.model(blur_m),
            per_point=fine * self.independent(effective_points) / self.points,
            no_overlap=self.no_overlap,
            per_explained=fine / (self.points * self.little_overlap),
            floor=float(floor),
        )
        regulariser = _for_every(regulariser, coarse)
        visited, counts = ridges.walk(
            rows(poses), spreads, axes, stride, ground, self.centre_m, blur_m, regulariser, max_ridge_steps
        )
        return matrices(visited[np.arange(max_ridge_steps) < counts[:, None]])

    def surface_noise_m(self, pose: Array, blur_m: float) -> float:
        """Return the standard deviation in m of matching surfaces' distance, beyond their pixels' noise.

        It holds what smoothing does to curved surfaces and the sensor's noise that neighbours share: a nuisance
        parameter, at its most likely value given a pose (4, 4). Points farther apart than 4 standard deviations of the
        present blur do not match.
        """
        there, matched = self.forward.excess(rows(pose), blur_m)
        back, matched_back = self.backward.excess(rows(se3.inverse(pose)), blur_m)
        if matched + matched_back <= _FEW:
            return blur_m
        return float(np.sqrt(max((there + back) / (matched + matched_back), 0.0)))

    def overlap(self, target_from_source: Array) -> float:
        """Return the share of points that should be seen by both cameras and are."""
        verdicts = np.concatenate(
            [
                self.forward.verdicts(rows(target_from_source)),
                self.backward.verdicts(rows(se3.inverse(target_from_source))),
            ]
        )
        wrong = np.isin(verdicts, (kernel.BEHIND, kernel.IN_FRONT, kernel.IN_EMPTY_SPACE)).sum()
        matched = (verdicts == kernel.MATCHED).sum()
        return float(matched / max(matched + wrong, 1))


def _for_every(regulariser: matching.Regulariser, stride: int) -> matching.Regulariser:
    """Return the regulariser beside every `stride`-th point: it is lowered, instead of raising what the points say."""
    return regulariser._replace(precision=regulariser.precision / stride, damping=regulariser.damping / stride)
