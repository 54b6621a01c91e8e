"""Predicts the edge of a view not yet taken, by Laplace's approximation of the likelihood.

The view's points are those of the model that are visible to its camera; the registration's likelihood looks them up in
the images of earlier views. Unobserved surface is not part of this.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from modeler import se3
from modeler.kernels import point_to_plane, scores
from modeler.kernels.gauss_newton import Regulariser
from modeler.registration.posterior import PRIOR_SAMPLES, weighted_gaussian
from modeler.registration.visibility.directed import DirectedLikelihood, FixedPattern
from modeler.registration.visibility.likelihood import MatchNoise, PairLikelihood, VisibilityLikelihood
from modeler.registration.visibility.refinement import Refiner, visible_share
from modeler.registration.visibility.search import Search
from modeler.se3 import rows
from modeler.types import AbstractPoseDensity, AbstractPrior, Array, Edge, InputError, RayImage, Solution
from modeler.views import Sensor

USUAL_NOISE: Final = 0.66
"""Noise b of matching surfaces before there is an edge, of the sensor's along the ray: 0.59 to 0.70 for 7 shapes."""
USUAL_SCALE: Final = 1.7
"""Actual over predicted information of an edge, before there is one: 1.6 to 1.9 for 6 shapes that determine a pose."""
EVEN_ODDS_DEG, ODDS_DEG = 106.0, 21.0
"""Rotation between views at which half of the registrations fail or are clearly wrong, and over which the odds change
e-fold: a logistic fit to 475 steps over 48 rendered shapes of the tuning half, 42 of which failed."""
TURNS_RAD: Final = np.radians(3.0) * np.arange(-60, 60)
"""Turns from the true pose about the table's normal, a posterior's width apart, for the likelihood."""
_TRUE: Final = int(np.argmin(np.abs(TURNS_RAD)))  # index of the true pose among them
_MODE_TEMPER: Final = 0.3
"""Tempering of the predicted likelihood between modes, so that the true mode's mass is right on average.

Over 175 steps of 35 shapes of the tuning half, the predicted mass of the true mode is 0.76 untempered and 0.61
tempered; realised 0.63."""
_CORE_RAD: Final = np.radians(6.0)  # two steps: nearer turns are described by the local Gaussian


@dataclass(frozen=True, eq=False)
class PredictedView:
    """A view not yet taken, predicted from the model."""

    image: RayImage
    """Its visible known points; it has no images."""
    points: Array
    """(n, 10), see `point_rows`."""
    weight: float
    """Number of points of a real view that each of them represents."""
    unseen_m: Array
    """(u, 3) places in its camera where it may see new surface."""
    unseen_normals: Array
    """(u, 3) unit normals there."""
    unseen_share: float
    """New share (0..1) of its points."""
    normal_variance: float
    """Variance in each tangent direction of the noise that its normals share with those of earlier views."""
    axis_m: Array
    """(3,) point in its camera on the axis of turns: other modes of a body on a table are turns about its middle."""


@dataclass(frozen=True, eq=False)
class PredictedEdge:
    """The predicted edge between a view not yet taken and another."""

    target: int
    """Frame number of the other."""
    covariance: Array
    """(6, 6) of target_from_source about the source's camera; of several modes, that of all about the true one."""
    masses: Array
    """(t,) probabilities, which sum to 1, that the registration places the view at each of `TURNS_RAD`."""
    right: float
    """Probability (0..1) of finding the true pose, from the modes' masses and the rotation between the views."""
    usable: float
    """Probability (0..1) of finding one of the modes, from the rotation between the views."""
    mode_nats: float
    """Entropy of the modes' weights."""


@dataclass(frozen=True, eq=False)
class ColourInformation:
    """Information from colour in the pairs so far, which is expected of further pairs."""

    matrix: Array
    """(6, 6) sensitivity of their matches per point of the pair, for ξ about the object's middle in the camera."""
    losses: Array
    """(t,) nats by which they contradict turns about the table's normal, see `TURNS_RAD`; at most 0."""
    explained: float
    """Share of the points that matched in those pairs."""


@dataclass(frozen=True, eq=False)
class EdgePredictor:
    """Predicts edges, with parameters learned from the edges so far."""

    likelihood: VisibilityLikelihood = field(default_factory=VisibilityLikelihood)
    """That of the registration."""
    noise_m: float = 0.0
    """Noise b of matching surfaces (method, eq. 4.7), the median of the edges so far."""
    scale: float = USUAL_SCALE
    """Actual over predicted information of the edges so far."""
    colour: ColourInformation | None = None
    """Information from colour; None if no colours have been compared yet."""

    def learned(
        self,
        edges: Sequence[Edge],
        views: Mapping[int, RayImage],
        solution: Solution,
        prior: AbstractPrior,
        ready: Callable[[RayImage], RayImage],
        *,
        axis: tuple[Array, Array],
    ) -> EdgePredictor:
        """Return the predictor with noise and scale from the newest edges (method, eq. 14.4).

        One typical edge is added, which is the prior before the first edge.

        Args:
            edges: those so far.
            views: by frame number.
            solution: determines which edges take part.
            prior: of the run.
            ready: returns a view with the images that a likelihood looks up.
            axis: (3,) point and (3,) direction of the axis of turns in the object frame.
        """
        used = [
            edge
            for edge in edges
            if solution.takes_part(edge) and edge.source in views and edge.target in views and not edge.posterior.modes
        ]
        pairs, noises_m = [], []
        for edge in used[-6:]:  # the newest; they scatter by about a factor of two
            pair = self.likelihood.between(
                ready(views[edge.source]), ready(views[edge.target]), np.random.default_rng(0)
            )
            pose = edge.posterior.pose
            surface_m, _ = pair.noises_m(pose.mean, 0.015 * pair.size_m)  # as fine as the search
            noise = pair.match_noise(pose.mean, surface_m)
            pairs.append((edge, pair, noise))
            noises_m.append(noise.surface_m)
        if not pairs:
            return self
        scales, colours = [np.log(USUAL_SCALE)], []
        for edge, pair, noise in pairs:
            pose = edge.posterior.pose
            _, matrix = pair.normal_equations(pose.mean[None], noise, stride=1)
            information = self.independent(pair.patches) / pair.points * matrix[0]
            if pair.colour is not None:
                camera_from_object = se3.inverse(solution.trajectory[edge.source])
                axis_m = se3.transform(camera_from_object, axis[0][None])[0]
                colours.append(
                    _colour_information(
                        pair, pose.mean, noise, matrix[0], axis_m=axis_m, up=camera_from_object[:3, :3] @ axis[1]
                    )
                )
            known = prior_information(prior, views[edge.source], views[edge.target], pair.centre_m)
            actual = inverted(se3.covariance_about(pose.covariance, pair.centre_m))
            scales.append(_log_scale(information, known, actual))
        colour = ColourInformation(*(np.mean(part, axis=0) for part in zip(*colours, strict=True))) if colours else None
        return replace(self, noise_m=float(np.median(noises_m)), scale=float(np.exp(np.mean(scales))), colour=colour)

    def independent(self, patches: float) -> float:
        """Return the number of independent measurements in a pair's points (method, eq. 14.3).

        n of the tempered likelihood (eq. 4.6), and those of the refinement (eq. 6.1) with residuals as predicted.
        """
        tempered = 1.0 / (1.0 / self.likelihood.max_independent + 1.0 / patches)
        return tempered + visible_share(patches / Refiner.patches) * patches

    def edge(
        self,
        source: PredictedView,
        target: RayImage,
        target_from_source: Array,
        density: AbstractPoseDensity,
        up: Array,
    ) -> PredictedEdge | None:
        """Return the edge between a predicted view and another; None if the motion is beyond the prior.

        Args:
            source: the predicted view.
            target: an earlier view with the images that a likelihood looks up.
            target_from_source: (4, 4) expected.
            density: of target_from_source before the images are compared.
            up: (3,) unit normal of the table in the source's camera, about which other modes are searched.
        """
        if not np.isfinite(density.log_density(target_from_source[None])[0]):
            return None
        centre_m = source.image.centroid_m
        pattern = FixedPattern.between(source.image, target)
        directed = DirectedLikelihood(self.likelihood, source.points, target, target.size_m, pattern)
        points = 2.0 * self.likelihood.points
        matrix = (
            2.0 * source.weight * matched(directed, target_from_source, self.noise_m, centre_m, source.normal_variance)
        )
        patches = max(target.patches, 1.0)
        poses, log_likelihoods, log_priors, explained = self._turned(directed, source, target_from_source, density, up)
        if self.colour is not None:
            alike = min(explained / max(self.colour.explained, 1e-9), 1.0)
            matrix = matrix + alike * points * self.colour.matrix
            log_likelihoods = log_likelihoods + alike * self.colour.losses
        information = self.scale * self.independent(patches) / points * matrix
        known = density_information(density, centre_m)
        local = inverted(information + known)
        away = se3.difference(target_from_source, poses, centre_m)
        posterior = normalised(log_likelihoods + log_priors) * (np.abs(TURNS_RAD) > _CORE_RAD)  # nearer: `local`
        spread = local + (away.T * posterior) @ away
        share = normalised(_MODE_TEMPER * log_likelihoods + log_priors)
        offsets_rad, masses = basins(TURNS_RAD, _MODE_TEMPER * log_likelihoods + log_priors)
        angle_deg = float(np.degrees(se3.rotation_angle(target_from_source)))
        usable = 1.0 / (1.0 + float(np.exp((angle_deg - EVEN_ODDS_DEG) / ODDS_DEG)))
        own = usable * float(masses[np.argmin(np.abs(offsets_rad))])
        entropy = float(-np.sum(masses * np.log(np.maximum(masses, 1e-12))))
        return PredictedEdge(target.index, se3.covariance_about(spread, -centre_m), share, own, usable, entropy)

    def _turned(
        self,
        directed: DirectedLikelihood,
        source: PredictedView,
        target_from_source: Array,
        density: AbstractPoseDensity,
        up: Array,
    ) -> tuple[Array, Array, Array, float]:
        """Return the poses (t, 4, 4) that match best at `TURNS_RAD`, with log-likelihoods (t,) and log priors (t,).

        The last value is the share of matching points at the true pose.
        """
        pair = PairLikelihood(directed, replace(directed, points=directed.points[:0]), directed.size_m)
        poses = turned(pair, target_from_source, source.axis_m, up)
        parameters = directed.parameters(self.noise_m, pair.typical_misfit(target_from_source, self.noise_m))
        projection = directed.projection(1)
        nothing = projection._replace(points=np.ascontiguousarray(projection.points[:, :0]))
        found = scores.scores(rows(poses), projection, nothing, parameters, parameters)
        sums = source.weight * found / self.likelihood.points  # a point, in the mean of both directions
        independent = 1.0 / (1.0 / self.likelihood.max_independent + 1.0 / max(directed.image.patches, 1.0))
        alike = sums[:, 1] + np.where(TURNS_RAD == 0.0, 0.0, self._confusable_share(source, poses))
        costs = [np.exp(-share / self.likelihood.overlap_scale) for share in (sums[:, 1], alike)]
        costs = [self.likelihood.no_overlap_cost * cost for cost in costs]
        looks = np.logaddexp(-costs[0], -costs[1]) - np.log(2.0)
        log_likelihoods = independent * sums[:, 0] + looks  # method, eq. 4.6 and 14.7
        return poses, log_likelihoods, density.log_density(poses), float(sums[_TRUE, 1])

    def _confusable_share(self, source: PredictedView, poses: Array) -> Array:
        """Return the share (n,) of a view's points that are new surface and could match the other view by mistake.

        New surface that faces the other camera would match if it resembled the known surface; at the true pose it is
        occluded there.
        """
        if not len(source.unseen_m):
            return np.zeros(len(poses))
        some = slice(None, None, max(len(source.unseen_m) // 100, 1))
        points_m = np.einsum("nij,uj->nui", poses[:, :3, :3], source.unseen_m[some]) + poses[:, None, :3, 3]
        normals = np.einsum("nij,uj->nui", poses[:, :3, :3], source.unseen_normals[some])
        facing = -np.sum(points_m * normals, axis=2) >= Sensor.min_cosine * np.linalg.norm(points_m, axis=2)
        return source.unseen_share * facing.mean(axis=1)


def turned(pair: PairLikelihood, target_from_source: Array, axis_m: Array, up: Array) -> Array:
    """Return the poses (t, 4, 4) at `TURNS_RAD` from a pose (4, 4) that match best.

    A body of revolution looks alike at turns about its own axis, which may differ from the middle of the observed
    surface: each turned pose is moved along the table to match.

    Args:
        pair: the likelihood.
        target_from_source: the pose.
        axis_m: (3,) point of the source on the axis of turns.
        up: (3,) its direction.
    """
    none = np.zeros((len(TURNS_RAD), 3))
    poses = se3.moved(target_from_source, np.hstack([TURNS_RAD[:, None] * up, none]), axis_m)
    held = Regulariser(rows(target_from_source), np.zeros((6, 6)), np.repeat([1e9, 1e3], 3), Search.basin)
    # Noise of 0.02 to 0.1 of the size, and 2 to 8 steps, give the same masses to 0.03; without steps they differ.
    moved = pair.descend(poses, 0.05 * pair.size_m, held, steps=Search.steps)
    shifts_m = se3.difference(poses, moved, axis_m)[:, 3:]
    shifts_m = shifts_m - (shifts_m @ up)[:, None] * up
    poses = se3.moved(poses, np.hstack([none, shifts_m]), axis_m)
    poses[_TRUE] = target_from_source
    return poses


def _colour_information(
    pair: PairLikelihood, pose: Array, noise: MatchNoise, matrix: Array, *, axis_m: Array, up: Array
) -> tuple[Array, Array, float]:
    """Return the fields of a `ColourInformation` of a pair at its pose (4, 4); matrix (6, 6): of all its matches."""
    _, of_depth = pair.normal_equations(pose[None], MatchNoise(noise.surface_m), stride=1)
    found = pair.scores(turned(pair, pose, axis_m, up), noise.surface_m, stride=1)
    gains = np.minimum(found.colours - found.colours[_TRUE], 0.0)
    return (matrix - of_depth[0]) / pair.points, gains, float(found.explained[_TRUE])


def matched(
    directed: DirectedLikelihood, target_from_source: Array, noise_m: float, centre_m: Array, normal_variance: float
) -> Array:
    """Return the sensitivity (6, 6) of the matches of one direction, for ξ about a point of the source.

    Args:
        directed: the source's points looked up in the target.
        target_from_source: (4, 4).
        noise_m: noise b of matching surfaces.
        centre_m: (3,).
        normal_variance: contribution of noise common to both normals to their product, per tangent direction.
    """
    found = directed.matches(rows(target_from_source), noise_m)
    used = found[found[:, point_to_plane.WEIGHT] > 0.0]
    to_source = se3.inverse(target_from_source)
    arms = se3.transform(to_source, used[:, point_to_plane.POSITION]) - centre_m
    scale_m = max(float(np.sqrt(np.mean(np.sum(arms**2, axis=1)))) if len(arms) else 0.0, 1e-6)
    own, other = (
        np.hstack([np.cross(arms, normals) / scale_m, normals])
        for normals in (used[:, k] @ to_source[:3, :3].T for k in (point_to_plane.OWN, point_to_plane.OTHER))
    )
    weights = used[:, point_to_plane.WEIGHT]
    product = (own.T * weights) @ other  # method, J of eq. 6.1: the noise of independent normals averages out
    tangent = np.eye(3) - own[:, 3:, None] * own[:, None, 3:]
    levers = np.concatenate([se3.hat(arms) / scale_m @ tangent, tangent], axis=1)
    product = product - normal_variance * np.einsum("n,nik,njk->ij", weights, levers, levers)
    sizes, axes = np.linalg.eigh(0.5 * (product + product.T))
    units = np.repeat([scale_m, 1.0], 3)
    return units[:, None] * ((axes * np.maximum(sizes, 0.0)) @ axes.T) * units


def prior_information(prior: AbstractPrior, source: RayImage, target: RayImage, centre_m: Array) -> Array:
    """Return the information (6, 6) of a prior about a point of the source; 0 if it does not apply."""
    try:
        return density_information(prior.between(source, target), centre_m)
    except InputError:
        return np.zeros((6, 6))


def density_information(density: AbstractPoseDensity, centre_m: Array) -> Array:
    """Return the inverse covariance (6, 6) of a density about a point of the source."""
    poses = density.sample(PRIOR_SAMPLES, np.random.default_rng(0))
    wide = weighted_gaussian(poses, np.ones(len(poses)), centre_m)
    return inverted(se3.covariance_about(wide.covariance, centre_m))


def inverted(matrix: Array) -> Array:
    """Return the inverse (6, 6)."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def basins(places: Array, log_mass: Array) -> tuple[Array, Array]:
    """Return where modes of a density on a line have their peaks (m,), and their masses (m,), which sum to 1.

    Peaks without a valley of e⁻² of the lower one between them are one mode, whose place is that nearest to 0.

    Args:
        places: (n,) ascending.
        log_mass: (n,), -inf outside the support.
    """
    mass = normalised(log_mass)
    lows = [k for k in range(1, len(mass) - 1) if mass[k] < mass[k - 1] and mass[k] <= mass[k + 1]]
    cuts = [0, *lows, len(mass)]
    parts = [[start, stop] for start, stop in itertools.pairwise(cuts)]
    joined = parts[:1]
    for start, stop in parts[1:]:
        before = mass[joined[-1][0] : joined[-1][1]].max()
        # Separates two Gaussians two standard deviations apart each.
        if mass[start] > np.exp(-2.0) * min(before, mass[start:stop].max()):
            joined[-1][1] = stop
        else:
            joined.append([start, stop])
    zero = int(np.argmin(np.abs(places)))
    peaks = [
        0.0 if start <= zero < stop else float(places[start + np.argmax(mass[start:stop])]) for start, stop in joined
    ]
    return np.array(peaks), np.array([mass[start:stop].sum() for start, stop in joined])


def normalised(log_mass: Array) -> Array:
    """Return the probabilities (n,) of log masses, which sum to 1."""
    mass = np.exp(log_mass - np.max(log_mass))
    return mass / mass.sum()


def _log_scale(information: Array, known: Array, actual: Array) -> float:
    """Return log κ with log det(κ I + Λ) = log det of the actual information (6, 6), within a factor of 100."""
    low, high = np.log(0.01), np.log(100.0)
    wanted = np.linalg.slogdet(actual)[1]
    for _ in range(20):
        middle = 0.5 * (low + high)
        found = np.linalg.slogdet(np.exp(middle) * information + known)[1]
        low, high = (middle, high) if found < wanted else (low, middle)
    return 0.5 * (low + high)
