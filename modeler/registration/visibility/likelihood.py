"""The likelihood of a pair of views, each looked up in the other, and the point-to-plane equations of matches."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from modeler import se3
from modeler.kernels import gauss_newton, point_likelihood, point_to_plane, scores
from modeler.kernels.gauss_newton import Regulariser
from modeler.kernels.photometric import NO_COLOURS, Colours
from modeler.kernels.point_likelihood import Projection
from modeler.registration.posterior import rows_under
from modeler.registration.visibility.directed import (
    MISFIT,
    DirectedLikelihood,
    FixedPattern,
    IntArray,
    by_motion,
    points_of,
    significant_variances,
    spread_points,
)
from modeler.registration.visibility.photometric import ASSUMED_RHO, PairColour, correlations, weight_of, without_shift
from modeler.se3 import matrices, rows
from modeler.significance import UNLIKELY
from modeler.types import Array, RayImage

_ROUNDING_M = 1e-6  # of depths in single precision: planes without noise may match exactly
MIN_MATCHES = 20
"""Fewer matches, or points, do not determine the nuisance parameters: of 20, a variance has a relative standard
deviation of 0.3. With 10 or 40, pairs of six sequences are the same to 0.1 %."""
DESCENT_STRIDE = 4
"""Every fourth point is used for descent; with every second or eighth, pairs of six sequences are as good."""


class Scores(NamedTuple):
    """Scores of poses (n, 4, 4)."""

    surface: Array
    """(n,) log-likelihoods L of surface, not tempered (nats)."""
    explained: Array
    """(n,) fractions E of points explained by matching surface."""
    colours: Array
    """(n,) log-likelihoods of the colours of matching surface (method, eq. 7.3); 0 if they are not compared."""


class MatchNoise(NamedTuple):
    """Noise of matching surface and its colours."""

    surface_m: float
    """Noise b of surfaces beyond that of points and planes."""
    correlation: float = 0.0
    """Correlation of colours; 0 if they are not compared."""
    band: int = 0
    """Band in which colours are compared."""


@dataclass(frozen=True)
class VisibilityLikelihood:
    """Parameters of the likelihood: surface that faces a camera is seen by it, other surface is hidden."""

    points: int = 600
    """Number of surface points of each view for search and sampling; another choice of them moves results by 0.2 to 0.3
    standard deviations."""
    refining_points: int = 2400
    """Number of surface points of each view for refinement; 10,000 are no better."""
    surface_noise: float = 0.1
    """Least noise of smoothed surfaces, common to neighbours, as a fraction of the sensor's range noise; without it, 6
    of 30 right pairs of a dog are rejected."""
    surface_detail: float = 0.003
    """Least error of local planes on a curved surface, as a fraction of the object's size; halved or doubled, 68 pairs
    are as good."""
    hidden_share: float = 0.5
    """Prior probability η that a point that faces the other camera is hidden by another part of the object. With 0.25
    and 0.75, NEES/6 of 710 pairs is 1.14 and 1.02, with 0.5 1.08."""
    holes: bool = True
    """Whether points that should be seen where nothing was measured are evidence (method, eq. 4.4)."""
    max_point_cost: float = 10.0
    """Upper bound K (nats) of the cost of one point; halved or doubled, 68 pairs are as good."""
    normal_cost: float = 2.0
    """Cost κ (nats) of a match whose normals are at right angles; halved or doubled, 68 pairs are as good."""
    max_independent: float = 300.0
    """Largest number of independent measurements in the points of both views, limited by common errors."""
    max_independent_colours: float = 140.0
    """The same for colours that are print, whose common errors are those of surface and of where colours lie on it:
    with 200, peaks of real print are hard to sample."""
    max_independent_noise: float = 400.0
    """The same for colours that are noise. Under wrong poses, correlations in the finest band scatter about their mean
    as those of 200 to 1,000 independent features, on drawn bodies with print and without."""
    no_overlap_cost: float = 50.0
    """Cost (nats) of a pose under which no surface matches; with half, 12 of 100 pairs fail, not 5, and twice as much
    changes nothing."""
    overlap_scale: float = 0.1
    """Fraction of matching points at which that cost has fallen to 1/e; halved or doubled, 68 pairs are as good."""
    colour: bool = True
    """Whether the colours of matching surface are compared, if both frames have them."""

    def between(self, source: RayImage, target: RayImage, rng: np.random.Generator) -> PairLikelihood:
        """Return the likelihood of target_from_source, at surface points drawn with `rng`."""
        size_m = 0.5 * (source.size_m + target.size_m)
        chosen = spread_points(source, self.points, rng), spread_points(target, self.points, rng)
        pattern = FixedPattern.between(source, target)
        forward = DirectedLikelihood(self, points_of(source, chosen[0]), target, size_m, pattern)
        backward = DirectedLikelihood(self, points_of(target, chosen[1]), source, size_m, pattern)
        coloured = self.colour and source.frame.colour is not None and target.frame.colour is not None
        if not coloured:
            return PairLikelihood(forward, backward, size_m)
        plain = PairLikelihood(forward, backward, size_m)
        limits = self.max_independent_colours, self.max_independent_noise
        return replace(plain, colour=PairColour(source, target, *chosen, *limits))

    def denser(self, pair: PairLikelihood, rng: np.random.Generator) -> PairLikelihood:
        """Return the likelihood of a pair at more points, for refinement; the same if it already has all of them."""
        source, target = pair.backward.image, pair.forward.image
        if max(len(source.points_m), len(target.points_m)) <= self.points:
            return pair
        chosen = (spread_points(view, self.refining_points, rng) for view in (source, target))
        return pair.at(*chosen)


@dataclass(frozen=True, eq=False)
class PairLikelihood:
    """p(surface of source | image target, T) · p(surface of target | image source, T) (method, eq. 4.1)."""

    forward: DirectedLikelihood
    """The source's points looked up in the target."""
    backward: DirectedLikelihood
    """The target's points looked up in the source."""
    size_m: float
    """Size of the object: root mean square distance in m of the surface points from their centroid."""
    colour: PairColour | None = None
    """The colours of both views, if they are compared."""

    def at(self, source_points: IntArray, target_points: IntArray) -> PairLikelihood:
        """Return the likelihood at other surface points of source and target, given by index."""
        target, source = self.forward.image, self.backward.image
        forward = replace(self.forward, points=points_of(source, source_points))
        backward = replace(self.backward, points=points_of(target, target_points))
        plain = replace(self, forward=forward, backward=backward, colour=None)
        if self.colour is None:
            return plain
        return replace(plain, colour=self.colour.at(source_points, target_points))

    @property
    def centre_m(self) -> Array:
        """The source's centroid (3,), about which tangents are taken."""
        return self.backward.image.centroid_m

    @property
    def range_noise_m(self) -> float:
        """Standard deviation of distances between smoothed surfaces of both views, as planes show it; 0 = unknown."""
        return float(np.hypot(self.forward.image.range_noise_m, self.backward.image.range_noise_m))

    @property
    def points(self) -> int:
        """Number of points of both views."""
        return len(self.forward.points) + len(self.backward.points)

    @property
    def patches(self) -> float:
        """Number P of independent patches of the surface of a view; mean of both."""
        return 0.5 * (self.forward.image.patches + self.backward.image.patches)

    @property
    def temper(self) -> float:
        """Fraction n / N of independent measurements in the points (method, eq. 4.6).

        Smoothing and the sensor's correlated noise limit n to the number of patches; errors common to distant points
        limit it on an object that covers much of the image.
        """
        return 1.0 / (1.0 / self.forward.model.max_independent + 1.0 / self.patches) / self.points

    def scores(
        self,
        poses: Array,
        blur_m: float,
        *,
        stride: int,
        typical_misfit: float = MISFIT,
        log_focal: Array | None = None,
    ) -> Scores:
        """Return the scores of poses.

        Args:
            poses: (n, 4, 4) target_from_source.
            blur_m: blur of the surfaces in m.
            stride: every `stride`-th point is used, with this weight.
            typical_misfit: misfit μ of a typical match (nats).
            log_focal: (n,) logarithms of the focal lengths under which poses are scored, over that of the views; that
                of the views if not given.
        """
        band = 0 if self.colour is None else self.colour.band(blur_m)
        found = self._summed(rows_under(poses, log_focal), blur_m, band, stride=stride, typical_misfit=typical_misfit)
        plain, share = stride * found[:, scores.LOG_LIKELIHOOD], stride * found[:, scores.EXPLAINED] / self.points
        if self.colour is None:
            return Scores(plain, share, np.zeros(len(poses)))
        return Scores(plain, share, self.colour.log_likelihoods(found, band, stride=stride))

    def _summed(self, poses: Array, blur_m: float, band: int, *, stride: int, typical_misfit: float) -> Array:
        """Return the sums (n, 6) of `scores.scores` of `rows_under`, see `scores`; `band` is that of the colours."""
        sides = (
            *self.surfaces(stride),
            self.forward.parameters(blur_m, typical_misfit),
            self.backward.parameters(blur_m, typical_misfit),
        )
        return scores.scores(poses, *sides, self._colours(band, stride))

    def tempered(
        self,
        poses: Array,
        blur_m: float,
        *,
        typical_misfit: float = MISFIT,
        stride: int = 1,
        log_focal: Array | None = None,
    ) -> Array:
        """Return tempered log-likelihoods (n,) of poses (n, 4, 4) (method, eq. 4.6).

        Args:
            poses: target_from_source.
            blur_m: blur of the surfaces in m.
            typical_misfit: misfit μ of a typical match (nats).
            stride: every `stride`-th point is used, with this weight.
            log_focal: see `scores`.
        """
        model = self.forward.model
        found = self.scores(poses, blur_m, stride=stride, typical_misfit=typical_misfit, log_focal=log_focal)
        no_overlap = model.no_overlap_cost * np.exp(-found.explained / model.overlap_scale)
        return self.temper * found.surface - no_overlap + found.colours

    def surfaces(self, stride: int) -> tuple[Projection, Projection]:
        """Return every `stride`-th point of both directions for kernels."""
        return self.forward.projection(stride), self.backward.projection(stride)

    def _colours(self, band: int, stride: int) -> tuple[Colours, Colours]:
        """Return the colours of both directions for kernels."""
        return (NO_COLOURS, NO_COLOURS) if self.colour is None else self.colour.colours(band, stride)

    def match_noise(self, pose: Array, surface_m: float) -> MatchNoise:
        """Return the noise of surfaces, which is given (`noises_m`), and of colours under a pose (4, 4)."""
        if self.colour is None:
            return MatchNoise(surface_m)
        band = self.colour.band(surface_m)
        found = self._summed(rows(pose[None]), surface_m, band, stride=1, typical_misfit=MISFIT)
        return MatchNoise(surface_m, float(correlations(found)[0]), band)

    def agreement(self, pose: Array, blurs_m: Array) -> tuple[float, float]:
        """Return how well the colours of matching surface agree under a pose (4, 4), and how many are independent.

        It is the largest correlation of the bands for some blurs (k,), as displaced colours agree in wide bands only;
        NaN without colour. The number is that of print in the finest band.
        """
        if self.colour is None:
            return math.nan, 0.0
        found = []
        for blur_m in blurs_m:
            band = self.colour.band(float(blur_m))
            summed = self._summed(rows(pose[None]), float(blur_m), band, stride=1, typical_misfit=MISFIT)
            count = self.colour.compared(summed, band, np.ones(1), stride=1)
            found.append((float(correlations(summed)[0]), float(count[0])))
        largest, counts = np.max(found, axis=0)
        return float(largest), float(counts)

    def typical_misfit(self, pose: Array, blur_m: float) -> float:
        """Return the misfit μ at which matches under a good pose (4, 4) contribute 0 on average (method, eq. 4.7).

        The predicted noise of points and planes is not exact. If too large, it would reward every match, and bias the
        spin of a can towards the largest overlap.
        """
        misfits = np.concatenate(
            [
                self.forward.misfits(rows(pose), blur_m),
                self.backward.misfits(rows(se3.inverse(pose)), blur_m),
            ]
        )
        if len(misfits) <= MIN_MATCHES:
            return MISFIT
        hidden = self.forward.model.hidden_share
        low, high = 0.0, 2.0
        for _ in range(16):  # bisection: the mean grows with μ
            middle = 0.5 * (low + high)
            mean = np.mean(np.log((1.0 - hidden) * np.exp(middle - misfits) + hidden))
            low, high = (middle, high) if mean < 0.0 else (low, middle)
        return 0.5 * (low + high)

    def noises_m(self, pose: Array, blur_m: float) -> tuple[float, float]:
        """Return the noise b of matching surfaces, beyond that of points and planes, and that near silhouettes, in m.

        Nuisance parameters at their most likely values given a pose (4, 4) (method, eq. 4.7 and 4.8): the effect of
        smoothing on curved surfaces, sensor noise common to neighbours, and depth flattened near outlines, if that is
        significant. `blur_m` is the value of b at which matches are selected, and returned with too few of them.
        """
        sums = self.forward.residual_excess(rows(pose), blur_m)
        sums += self.backward.residual_excess(rows(se3.inverse(pose)), blur_m)
        if sums[0, 0] <= MIN_MATCHES:
            return blur_m, self.forward.rim_m
        surface_m2, rim_m2 = significant_variances(sums, 2.0 * self.patches)
        return max(math.sqrt(surface_m2), _ROUNDING_M), math.sqrt(rim_m2)

    def with_rim_m(self, rim_m: float) -> PairLikelihood:
        """Return the pair with this standard deviation of depth errors near silhouettes in m (eq. 4.8)."""
        if rim_m == self.forward.rim_m == self.backward.rim_m:
            return self  # with its cached projections
        return replace(self, forward=replace(self.forward, rim_m=rim_m), backward=replace(self.backward, rim_m=rim_m))

    def without_holes(self) -> PairLikelihood:
        """Return the pair for which points that should be seen where nothing was measured are no evidence."""
        model = replace(self.forward.model, holes=False)
        return replace(self, forward=replace(self.forward, model=model), backward=replace(self.backward, model=model))

    def overlap(self, target_from_source: Array) -> float:
        """Return the fraction of matches among the points that both cameras should see."""
        # Within one standard deviation of the noise are two thirds under the true pose, and fewer under wrong ones.
        noise_m = self.range_noise_m / point_likelihood.LOOSE_SIGMAS
        forward = self.forward.classify(rows(target_from_source), noise_m)
        classes = np.append(forward, self.backward.classify(rows(se3.inverse(target_from_source)), noise_m))
        contradicting = (
            point_likelihood.BEHIND,
            point_likelihood.IN_FRONT,
            point_likelihood.IN_EMPTY_SPACE,
            point_likelihood.IN_SUPPORT,
        )
        wrong = np.isin(classes, contradicting).sum()
        matched = (classes == point_likelihood.MATCHED).sum()
        return float(matched / max(matched + wrong, 1))

    def fits(self, target_from_source: Array, blur_m: float) -> bool:
        """Return whether the images contradict a pose (4, 4) no more than 99 of 100 true ones (method, eq. 6.5).

        `blur_m` is the blur at which matches are selected, and the least noise of surfaces.
        """
        noise_m = max(self.noises_m(target_from_source, blur_m)[0], blur_m)
        surface = replace(self, colour=None).scores(target_from_source[None], noise_m, stride=1).surface
        independent = self.temper * self.points
        return bool(self.temper * surface[0] >= 0.5 * (independent - chdtri(independent, UNLIKELY)))

    def colour_matches(
        self, transform: Array, matches: Array, points: IntArray, noise: MatchNoise, *, forward: bool
    ) -> Array:
        """Return the equations of the colours of matches, in the layout of `DirectedLikelihood.matches`.

        Empty if colours are not compared, or not correlated; see `PairColour.matches`.
        """
        weight = weight_of(noise.correlation)
        if self.colour is None or weight == 0.0:
            return matches[:0]
        return self.colour.matches(transform, matches, points, noise.band, weight, forward=forward)

    def normal_equations(
        self, poses: Array, noise: MatchNoise, *, stride: int, log_focal: Array | None = None
    ) -> tuple[Array, Array]:
        """Return the normal equations of the matches: gradients (n, 6) and matrices (n, 6, 6) for ξ about the centre.

        Args:
            poses: (n, 4, 4) target_from_source.
            noise: of matching surface and colours.
            stride: every `stride`-th point is used, with this weight.
            log_focal: see `scores`.
        """
        colours, weight = self._colours(noise.band, stride), np.float32(weight_of(noise.correlation))
        found = gauss_newton.normal_equations(
            rows_under(poses, log_focal), self.surfaces(stride), colours, weight, self.centre_m, noise.surface_m
        )
        (gradients, of_colour), (equations, by_colour) = (stride * part.swapaxes(0, 1) for part in found)
        if self.colour is not None:
            kept = without_shift(by_colour, self.colour.shifts(poses))
            gradients = gradients + (kept @ of_colour[:, :, None])[:, :, 0]
            equations = equations + kept @ by_colour
        return gradients, equations

    def curvatures(self, poses: Array, blur_m: float, *, stride: int) -> Array:
        """Return curvatures (n, 6, 6) of `tempered` by ξ about the centre, at poses (n, 4, 4) that match, best first.

        They are those of squared distances, and of the squared differences of features that decrease correlations.
        """
        of_surface, of_colours = self._curvatures(poses, blur_m, stride)
        return of_surface + of_colours

    def moved_by_shift(self, pose: Array, spread: Array, blur_m: float) -> Array:
        """Return motions M (6, 2) ξ about the centre: of the mode if colours shift by one sd (method, eq. 7.6).

        Args:
            pose: (4, 4) the mode.
            spread: (6, 6) root of the covariance of ξ, by surface, colours and prior.
            blur_m: blur of the surfaces in m.
        """
        if self.colour is None:
            return np.zeros((6, 2))
        _, of_colours = self._curvatures(pose[None], blur_m, 1)
        shares, axes = np.linalg.eigh(spread.T @ of_colours[0] @ spread)  # of the information; no more than all of it
        shifts = np.linalg.solve(spread, self.colour.shifts(pose))
        return np.asarray(spread @ (axes * np.clip(shares, 0.0, 1.0)) @ axes.T @ shifts, dtype=np.float64)

    def sensitivity(self, pose: Array, blur_m: float) -> Array:
        """Return the sensitivity J (6, 6) of matching surface to ξ about the centre, at a pose (4, 4), tempered.

        Products of either surface's normals: the noise of normals, which seems to tell how a ball turns, averages out
        (method, eq. 6.1).
        """
        found = np.zeros((6, 6))
        for directed, transform in ((self.forward, pose), (self.backward, se3.inverse(pose))):
            matches = directed.matches(rows(transform), blur_m)
            to_source = np.eye(4) if directed is self.backward else se3.inverse(pose)
            arms = se3.transform(to_source, matches[:, point_to_plane.POSITION]) - self.centre_m
            own, other = (
                by_motion(arms, matches[:, normal] @ to_source[:3, :3].T)
                for normal in (point_to_plane.OWN, point_to_plane.OTHER)
            )
            found += (own.T * matches[:, point_to_plane.WEIGHT]) @ other
        return 0.5 * self.temper * (found + found.T)

    def _curvatures(self, poses: Array, blur_m: float, stride: int) -> tuple[Array, Array]:
        """Return the parts (n, 6, 6) of `curvatures`: of surface, and of colours."""
        band, weight = 0, 0.0
        if self.colour is not None:
            band = self.colour.band(blur_m)
            found = self._summed(rows(poses[:1]), blur_m, band, stride=1, typical_misfit=MISFIT)
            weight = self.colour.curvature(float(correlations(found)[0]), band) / self.points
        colours = self._colours(band, stride)
        _, (of_surface, of_colours) = (
            part.swapaxes(0, 1)
            for part in gauss_newton.normal_equations(
                rows(poses), self.surfaces(stride), colours, np.float32(weight), self.centre_m, blur_m
            )
        )
        return stride * self.temper * of_surface, stride * of_colours

    def descend(self, poses: Array, blur_m: float, regulariser: Regulariser, *, steps: int) -> Array:
        """Return poses (n, 4, 4) after Gauss-Newton steps on matching surface (method, eq. 5.2)."""
        regulariser = _per_point(regulariser, DESCENT_STRIDE)
        band = 0 if self.colour is None else self.colour.band(blur_m)
        colours, weight = self._colours(band, DESCENT_STRIDE), np.float32(weight_of(ASSUMED_RHO))
        surfaces = self.surfaces(DESCENT_STRIDE)
        moved = gauss_newton.descend(rows(poses), surfaces, colours, weight, self.centre_m, blur_m, regulariser, steps)
        return matrices(moved)


def _per_point(regulariser: Regulariser, stride: int) -> Regulariser:
    """Return the regulariser for equations of every `stride`-th point, without their weight `stride`."""
    return regulariser._replace(precision=regulariser.precision / stride, damping=regulariser.damping / stride)
