"""Belief about an object after some views, and the predicted information of a further view."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Final

import numpy as np

from modeler import se3
from modeler.closure import Closer, MapView
from modeler.graph.focal import LIMIT_STEPS
from modeler.priors import PokePrior, turntable_in
from modeler.priors.mixtures import Gaussian
from modeler.registration import VisibilityLikelihood, VisibilityRegistrar
from modeler.registration.visibility.directed import point_rows
from modeler.suggestion.candidates import Candidate
from modeler.suggestion.edge_prediction import TURNS_RAD, USUAL_NOISE, EdgePredictor, PredictedEdge, PredictedView
from modeler.suggestion.pose_gain import PoseGraphBelief, edge_information
from modeler.suggestion.surface_cells import STEPS, IntArray, Stand, SurfaceCells
from modeler.types import (
    SOME_POINTS,
    AbstractPoseDensity,
    AbstractPrior,
    Array,
    BoolArray,
    Edge,
    Frame,
    InputError,
    Outcome,
    PoseGaussian,
    Posterior,
    RayImage,
    Solution,
)

_JOINED: Final = 0.85  # 17 of 20 recordings with a turned-over object gave one right model (docs/method/suggestion.md)


@dataclass(frozen=True, eq=False)
class Prediction:
    """The predicted effect of an action."""

    candidate: Candidate
    pose_nats: float
    """Predicted decrease of ½ log det of the covariance of the poses so far."""
    surface_nats: float
    """Predicted decrease of the entropy of the surface given the poses, both seen and new."""
    mode_nats: float
    """Entropy of the modes of the edge that places the new view."""
    right: float
    """Probability (0..1) that the new view is placed at the true mode."""
    usable: float
    """Probability (0..1) that registering the new view succeeds, at any mode."""
    new_surface: float
    """Share (0..1) of the surface in the view not observed before."""
    spin_deg: float
    """Largest standard deviation afterwards of a pose's turn about the table's normal."""
    pose_deg: float
    """Largest standard deviation afterwards of a pose's rotation about any axis."""
    new_covariance: Array
    """(6, 6) of the new pose's error in object coordinates."""
    edges: tuple[PredictedEdge, ...]
    """Predicted edges of the new view."""

    @property
    def gain_nats(self) -> float:
        """Expected information gain on poses and surface."""
        return self.usable * (self.pose_nats + self.surface_nats)

    @property
    def worth_nats(self) -> float:
        """Ranking criterion: a misplaced view misleads by as much as a correctly placed one informs."""
        return (2.0 * self.right - 1.0) * (self.pose_nats + self.surface_nats)


@dataclass(frozen=True, eq=False)
class Shown:
    """The part of the object visible in a view."""

    cells: IntArray
    """(k,) numbers of the visible cells."""
    surface: Array
    """(k,) expected surface there, in cells: see `SurfaceCells.looked_at`."""


@dataclass(frozen=True, eq=False)
class Belief:
    """The belief about poses and surface, and the components of the run that would process a new view."""

    views: Mapping[int, RayImage]
    """By frame number."""
    solution: Solution
    edges: Sequence[Edge]
    """Every edge judged so far."""
    prior: AbstractPrior
    stand: Stand
    """Pose of the object on its table."""
    closer: Closer = field(default_factory=Closer)
    """Selects the views with which a view is registered."""
    predictor: EdgePredictor = field(default_factory=EdgePredictor)
    ready: Callable[[RayImage], RayImage] = field(default=lambda view: view)
    """Returns a view with the images that a likelihood looks up (ten times the memory of the frame)."""

    @classmethod
    def of(
        cls,
        views: Mapping[int, RayImage],
        solution: Solution,
        edges: Sequence[Edge],
        prior: AbstractPrior,
        *,
        closer: Closer | None = None,
        likelihood: VisibilityLikelihood | None = None,
        ready: Callable[[RayImage], RayImage] = lambda view: view,
    ) -> Belief:
        """Return the belief after some views, with noise and scale of predictions from the edges so far.

        Arguments as the fields.

        Raises:
            InputError: if no view has a pose and surface points.
        """
        posed = {frame: view for frame, view in views.items() if frame in solution.trajectory and len(view.points_m)}
        if not posed:
            raise InputError("no view with surface points has a pose; build the run again")
        ready = lru_cache(maxsize=None)(ready)
        noise_m = USUAL_NOISE * float(np.median([view.sigma_r_m for view in posed.values()]))
        predictor = EdgePredictor(VisibilityLikelihood() if likelihood is None else likelihood, noise_m)
        stand = Stand.of(posed, solution)
        axis = stand.object_from_stand[:3, 3], stand.up
        predictor = predictor.learned(edges, posed, solution, prior, ready, axis=axis)
        return cls(posed, solution, edges, prior, stand, Closer() if closer is None else closer, predictor, ready)

    @property
    def last(self) -> RayImage:
        """The newest view that has a pose."""
        return self.views[max(frame for frame in self.solution.trajectory if frame in self.views)]

    @property
    def object_from_last(self) -> Array:
        """Its pose (4, 4)."""
        return self.solution.trajectory[self.last.index]

    @cached_property
    def cells(self) -> SurfaceCells:
        """Observed surface, and where unseen surface may be."""
        return SurfaceCells.of(self.views, self.solution, self.stand)

    @cached_property
    def can_be_seen(self) -> BoolArray:
        """Which cells (c,) are visible to the camera at some turn on the table."""
        return self.cells.around(self.object_from_last) | self.cells.seen

    @property
    def seen(self) -> float:
        """Observed share (0..1) of the surface that turns on the table can show."""
        return float(np.count_nonzero(self.cells.seen) / max(np.count_nonzero(self.can_be_seen), 1))

    @cached_property
    def poses(self) -> PoseGraphBelief:
        """The joint Gaussian of the poses."""
        return PoseGraphBelief.of(self.edges, self.solution)

    @property
    def spin_deg(self) -> float:
        """Largest standard deviation of a pose's turn about the table's normal."""
        return _spin_deg(self.poses.marginals, self.stand.up)

    @property
    def pose_deg(self) -> float:
        """Largest standard deviation of a pose's rotation about any axis."""
        return _pose_deg(self.poses.marginals)

    @cached_property
    def sigma_m(self) -> float:
        """Standard deviation of the surface along its normal, by noise and poses: root mean square of the worst view.

        Poses err relative to the first.
        """
        worst_m2 = 0.0
        for frame, covariance in self.poses.marginals.items():
            if frame in self.views and len(self.views[frame].points_m):
                points_m, normals, variances_m2 = self._some_points(self.views[frame])
                variance = variances_m2 + displacement_m2(points_m, normals, covariance)
                worst_m2 = max(worst_m2, float(np.mean(variance)))
        return float(np.sqrt(worst_m2))

    @cached_property
    def cell_variances_m2(self) -> Array:
        """Variance (c,) of the surface in each cell along its normal, by noise and poses; of unseen one its spread."""
        information = np.zeros(len(self.cells.points_m))
        for frame, covariance in self.poses.marginals.items():
            if frame not in self.views:
                continue
            pose = self.solution.trajectory[frame]
            mine, _ = self.cells.at(se3.transform(pose, self.views[frame].points_m))
            information[mine] += 1.0 / self._measured_m2(
                self.cells.points_m[mine], self.cells.normals[mine], covariance
            )
        spread_m2 = self.cells.depth_sd_m**2
        return 1.0 / (information + 1.0 / spread_m2)

    def predict(self, candidate: Candidate) -> Prediction | None:
        """Return the predicted effect of an action; None if the prior excludes it or nothing would be visible."""
        new_from_last = candidate.motion(self.last, self.stand, self.object_from_last)
        object_from_new = self.object_from_last @ se3.inverse(new_from_last)
        if candidate.action == "lay":
            return self._laid(candidate, object_from_new)
        shown = self._shown(object_from_new)
        predicted = self._predicted_view(object_from_new, shown, candidate)
        if predicted is None:
            return None
        edges = self._edges(predicted, object_from_new, candidate)
        if not edges:
            return None
        new = predicted.image.index
        gain = self.poses.gain([(e.target, edge_information(object_from_new, e.covariance)) for e in edges], new)
        placed = [(share, self._shown(pose)) for share, pose in self._placements(edges[0], object_from_new)]
        return Prediction(
            candidate=candidate,
            pose_nats=gain.nats,
            surface_nats=sum(share * self.surface_nats(some, gain.covariances[new]) for share, some in placed),
            mode_nats=edges[0].mode_nats,
            right=edges[0].right,
            usable=edges[0].usable,
            new_surface=sum(share * self.new_share(some) for share, some in placed),
            spin_deg=_spin_deg(gain.covariances, self.stand.up),
            pose_deg=_pose_deg(gain.covariances),
            new_covariance=gain.covariances[new],
            edges=edges,
        )

    def _placements(self, edge: PredictedEdge, object_from_new: Array) -> list[tuple[float, Array]]:
        """Return where a view may be placed: probabilities, which sum to 1, and poses (4, 4).

        If the images do not determine the turn, the view may be placed at any likely turn, and appears to show what is
        visible from there. Turns are grouped in bins of 15°, represented by their middle.
        """
        bin_rad = 2.0 * np.pi / STEPS
        bins = np.round(TURNS_RAD / bin_rad).astype(np.intp)
        masses = np.bincount(bins - bins.min(), edge.masses)
        kept = np.flatnonzero(masses >= 0.03)
        shares = masses[kept] / masses[kept].sum()
        turns_rad = bin_rad * (kept + bins.min())
        return [
            (float(share), self.stand.turned(turn_rad) @ object_from_new)
            for share, turn_rad in zip(shares, turns_rad, strict=True)
        ]

    def _laid(self, candidate: Candidate, object_from_new: Array) -> Prediction | None:
        """Return the predicted effect of the first view of an object on its side.

        Its resting pose is unpredictable, and whole segments of views determine it: their success rate replaces the
        modes, and the poses so far are assumed to remain unchanged.
        """
        shown = Shown(*self.cells.looked_at(se3.inverse(object_from_new)))
        if not len(shown.cells):
            return None
        covariance = self.poses.marginals[self.last.index]
        return Prediction(
            candidate=candidate,
            pose_nats=0.0,
            surface_nats=self.surface_nats(shown, covariance),
            mode_nats=0.0,
            right=_JOINED,
            usable=_JOINED,
            new_surface=self.new_share(shown),
            spin_deg=self.spin_deg,
            pose_deg=self.pose_deg,
            new_covariance=covariance,
            edges=(),
        )

    def _shown(self, object_from_camera: Array) -> Shown:
        """Return what a camera at a pose (4, 4) would see of an object that stands."""
        cells, surface = self.cells.looked_at(se3.inverse(object_from_camera))
        kept = ~self.cells.under[cells]
        return Shown(cells[kept], surface[kept])

    def new_share(self, shown: Shown) -> float:
        """Return the share of the surface in some cells that was not seen before."""
        new = shown.surface[~self.cells.seen[shown.cells]].sum()
        return float(new / max(shown.surface.sum(), 1e-9))

    def surface_nats(self, shown: Shown, covariance: Array) -> float:
        """Return by how much the entropy of the surface falls if a view sees some cells (method, eq. 14.5).

        Args:
            shown: the cells.
            covariance: (6, 6) of the view's pose in object coordinates.
        """
        points_m, normals = self.cells.points_m[shown.cells], self.cells.normals[shown.cells]
        gains = self._nats(self.cell_variances_m2[shown.cells], self._measured_m2(points_m, normals, covariance))
        return self._independent_share * float(shown.surface @ gains)

    def _nats(self, before_m2: Array, measured_m2: Array) -> Array:
        """Return by how much the entropy (k,) of surface of known variance falls by a further measurement.

        Variances below the noise of a single view are clipped: more precision is not needed.
        """
        after_m2 = 1.0 / (1.0 / before_m2 + 1.0 / measured_m2)
        return 0.5 * np.log(np.maximum(before_m2, self._noise_m2) / np.maximum(after_m2, self._noise_m2))

    def brought(self, view: RayImage, object_from_camera: Array, covariance: Array) -> tuple[float, float]:
        """Return the realised gain of a view: `surface_nats`, and the new share of its surface.

        Args:
            view: a view that is no part of the belief.
            object_from_camera: (4, 4) its pose.
            covariance: (6, 6) of the pose in object coordinates.
        """
        points_m = se3.transform(object_from_camera, view.points_m)
        again, first = self.cells.at(points_m)
        normals = view.normals[first] @ object_from_camera[:3, :3].T
        measured_m2 = self._measured_m2(points_m[first], normals, covariance)
        unseen_m2 = np.full(len(first), self.cells.depth_sd_m**2)
        new_nats = self._independent_share * float(np.sum(self._nats(unseen_m2, measured_m2)))
        again = np.intersect1d(again, self.cells.visible(se3.inverse(object_from_camera)))
        share = len(first) / max(len(first) + len(again), 1)
        return self.surface_nats(Shown(again, np.ones(len(again))), covariance) + new_nats, share

    @cached_property
    def _independent_share(self) -> float:
        """Independent measurements in a cell: those of the last view, over the cells that it sees."""
        patches = max(self.last.patches, 1.0)
        count = 1.0 / (1.0 / self.predictor.likelihood.max_independent + 1.0 / patches)
        cells = self.cells.visible(se3.inverse(self.object_from_last))
        return count / max(np.count_nonzero(self.cells.seen[cells]), 1)

    def _measured_m2(self, points_m: Array, normals: Array, covariance: Array) -> Array:
        """Return the variance (k,) along normals of a view's measurement of points, by noise and its pose."""
        return self._noise_m2 + displacement_m2(points_m, normals, covariance)

    @cached_property
    def _noise_m2(self) -> float:
        """Variance of a point of the last view along its normal, and the noise of matching surfaces."""
        return self._variance_m2 + self.predictor.noise_m**2

    @cached_property
    def _variance_m2(self) -> float:
        """Variance of a point of the last view along its normal."""
        return float(np.median(self._some_points(self.last)[2]))

    def _some_points(self, view: RayImage) -> tuple[Array, Array, Array]:
        """Return points (n, 3), normals (n, 3), in the object frame, and variances (n,) in m² of a view."""
        chosen = np.arange(0, len(view.points_m), max(len(view.points_m) // SOME_POINTS, 1))
        pose = self.solution.trajectory[view.index]
        source = view if view.layers or view is self.last else self.last  # others are as noisy as the last
        found = np.asarray(self.ready(source).layers["variance_m2"], dtype=np.float64)
        variances_m2 = found[chosen] if source is view else np.full(len(chosen), np.median(found))
        return se3.transform(pose, view.points_m[chosen]), view.normals[chosen] @ pose[:3, :3].T, variances_m2

    def _predicted_view(self, object_from_new: Array, shown: Shown, candidate: Candidate) -> PredictedView | None:
        """Return the part of the model visible to a camera; None if there are too few points to register."""
        camera_from_object, visible = se3.inverse(object_from_new), shown.cells
        points_m = se3.transform(camera_from_object, self.cells.points_m[visible])
        normals = self.cells.normals[visible] @ camera_from_object[:3, :3].T
        seen = np.flatnonzero(self.cells.seen[visible])
        if len(seen) < VisibilityRegistrar.min_points:
            return None
        share = 1.0 - self.new_share(shown)
        count = int(self.predictor.likelihood.points * share)
        some = seen[np.linspace(0, len(seen) - 1, max(min(count, len(seen)), 1)).astype(np.intp)]
        variances_m2 = np.full(len(some), self._variance_m2)
        frame, table = self.last.frame, turntable_in(self.prior)
        # A turntable's prior counts steps.
        ahead = 1 if table is None else max(round(abs(candidate.turn_deg / table.step_deg)), 1)
        frame = Frame(frame.index + ahead, frame.time_s + ahead, frame.depth_m, frame.camera)
        image = replace(self.last, frame=frame, points_m=points_m[seen], normals=normals[seen], layers={})
        unseen = ~self.cells.seen[visible]
        return PredictedView(
            image=image,
            points=point_rows(points_m[some], normals[some], variances_m2, frame.camera),
            weight=self.predictor.likelihood.points * share / len(some),
            unseen_m=points_m[unseen],
            unseen_normals=normals[unseen],
            unseen_share=1.0 - share,
            normal_variance=self.cells.normal_variance,
            axis_m=se3.transform(camera_from_object, self.stand.object_from_stand[None, :3, 3])[0],
        )

    def _edges(
        self, predicted: PredictedView, object_from_new: Array, candidate: Candidate
    ) -> tuple[PredictedEdge, ...]:
        """Return the predicted edges of the view: to the last view, and to those that the closer would choose."""
        up = object_from_new[:3, :3].T @ self.stand.up

        def edge(target: int) -> PredictedEdge | None:
            view, target_from_new = self.views[target], self._relative(target, object_from_new)
            density = self._density(predicted.image, view, candidate, target_from_new)
            if density is None:
                return None
            return self.predictor.edge(predicted, self.ready(view), target_from_new, density, up)

        first = edge(self.last.index)
        if first is None:
            return ()
        pose = PoseGaussian(self._relative(first.target, object_from_new), first.covariance)
        base = Posterior(predicted.image.index, first.target, pose, Outcome.CONVERGED, 1.0)
        others = [
            target for target in self.closer.closure_targets(base, self._map, last=True) if target != first.target
        ]
        return (first, *(found for target in others if (found := edge(target)) is not None))

    def _density(
        self, source: RayImage, target: RayImage, candidate: Candidate, target_from_new: Array
    ) -> AbstractPoseDensity | None:
        """Return the prior density of the motion between a new view and another; None if there is none."""
        if candidate.sigmas is not None:
            return Gaussian(target_from_new, np.diag(np.repeat(candidate.sigmas, 3)) ** 2, source.centroid_m)
        prior = self.prior
        if target.index != self.last.index:  # a closure, whose motion the graph predicts: only limits count
            prior = prior.relaxed(LIMIT_STEPS)
        elif candidate.poke is not None:
            prior = PokePrior(candidate.poke)
        try:
            return prior.between(source, target)
        except InputError:
            return None

    @cached_property
    def _map(self) -> MapView:
        return MapView(self.views, self.solution, self.edges)

    def _relative(self, target: int, object_from_new: Array) -> Array:
        return se3.inverse(self.solution.trajectory[target]) @ object_from_new


def displacement_m2(points_m: Array, normals: Array, covariance: Array) -> Array:
    """Return variances (n,) in m² along normals (n, 3) of points (n, 3) by a pose's error (6, 6), all in one frame."""
    levers = np.hstack([np.cross(points_m, normals), normals])
    return np.maximum(np.einsum("ni,ij,nj->n", levers, covariance, levers), 0.0)


def _spin_deg(covariances: Mapping[int, Array], up: Array) -> float:
    """Return the largest standard deviation in degrees of turns about a direction (3,)."""
    return float(np.degrees(np.sqrt(max(max(up @ c[:3, :3] @ up, 0.0) for c in covariances.values()))))


def _pose_deg(covariances: Mapping[int, Array]) -> float:
    """Return the largest standard deviation in degrees of a rotation about any axis."""
    largest = max(float(np.linalg.eigvalsh(c[:3, :3])[-1]) for c in covariances.values())
    return float(np.degrees(np.sqrt(max(largest, 0.0))))
