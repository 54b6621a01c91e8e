"""Covariances of solved frames and of the motion between any two, by back substitution (method, eq. 8.5 and 8.6).

Errors are ξ_k with true object_from_camera(k) = object_from_camera(k) exp(ξ_k). GTSAM linearises and eliminates all
factors. Covariances are sums of squares of what back substitution gives, never differences or inverses, so that an
unobserved direction with a standard deviation of metres does not degrade others of micrometres (Kaess and Dellaert,
Covariance recovery from a square root information matrix, RAS 2009). Solutions whose loops are others are eliminated
anew when first asked: an incremental square root takes as long for 200 frames, and saves 20 of 65 ms a frame at 1,000.
Most frames of larger graphs are eliminated already, see `condensed`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import get_blas_funcs
from scipy.special import chdtri

from modeler import se3
from modeler.graph import lazy_gtsam as gtsam
from modeler.graph.condensed import Condensed, Conditional
from modeler.graph.optimise import gtsam_graph_of, values_of
from modeler.graph.pose_graph import ROOT_SIGMA, Factor, PoseGraph
from modeler.types import Array, FocalLength, Solution

(_trsm,) = get_blas_funcs(("trsm",))  # LAPACK's trtrs starts threads even for the smallest system
_MOST_LEAVES = 32  # frames: back substitution through as many takes as long as through 1,000 eliminated ones


@dataclass(frozen=True, eq=False)
class _Elimination:
    """Factors linearised at a solution, and eliminated when first asked for."""

    trajectory: Mapping[int, Array]
    root: int
    factors: Sequence[Factor]
    extra: Sequence[gtsam.JacobianFactor]
    condensed: Condensed | None
    """Further factors, most of whose frames are eliminated already."""
    _known: dict[int, Conditional] = field(default_factory=dict, init=False)

    def conditional(self, variable: int) -> Conditional:
        """Return the conditional of a variable."""
        if self.condensed is not None and variable in self.condensed.order:
            return self.condensed.conditional(variable)
        if variable not in self._known:
            self._known[variable] = Conditional.of(self.net.at(self.order[variable] - self._before))
        return self._known[variable]

    @cached_property
    def order(self) -> Mapping[int, int]:
        """Number of each variable in the order of elimination."""
        before = {} if self.condensed is None else self.condensed.order
        return {**before, **{self.net.at(k).firstFrontalKey(): self._before + k for k in range(self.net.size())}}

    @cached_property
    def net(self) -> gtsam.GaussianBayesNet:
        """The conditionals, by Cholesky factorisation; by QR if one direction is so uncertain that Cholesky fails."""
        frames = dict.fromkeys(frame for factor in self.factors for frame in (factor.target, factor.source))
        poses = {frame: self.trajectory[frame] for frame in {self.root: None, **frames}}
        linear = gtsam_graph_of(self.factors, self.root, ROOT_SIGMA).linearize(values_of(poses))
        for factor in (*self.extra, *(() if self.condensed is None else self.condensed.linear)):
            linear.add(factor)
        ordering = gtsam.Ordering.OrderingType.METIS
        try:
            return linear.eliminateSequential(ordering)
        except RuntimeError:  # GTSAM reports an indeterminate system
            return linear.eliminateSequential(ordering, gtsam.EliminateQR)

    @property
    def _before(self) -> int:
        """Number of the variables that are eliminated already."""
        return 0 if self.condensed is None else len(self.condensed.order)


@dataclass(frozen=True, eq=False)
class RelativeCovariance:
    """Covariances of target_from_source between solved frames, computed when called."""

    trajectory: Mapping[int, Array]
    """object_from_camera (4, 4) by frame number."""
    factors: Sequence[Factor]
    """All that take part."""
    eliminated: _Elimination
    """The factors but for those of `leaves`."""
    leaves: Mapping[int, Conditional] = field(default_factory=dict)
    """Of frames added since, each by a single factor, which says nothing about others; in order of arrival."""

    @classmethod
    def of(
        cls,
        trajectory: Mapping[int, Array],
        root: int,
        factors: Sequence[Factor],
        extra: Sequence[gtsam.JacobianFactor] = (),
        condensed: Condensed | None = None,
    ) -> RelativeCovariance:
        """Return the covariances of a solution.

        Args:
            trajectory: object_from_camera (4, 4) by frame number.
            root: the frame without error.
            factors: all that take part.
            extra: further factors of the errors, possibly with variables other than frames.
            condensed: those of the factors that are condensed already, if any.
        """
        others = factors if condensed is None else condensed.new(factors)
        return cls(trajectory, factors, _Elimination(trajectory, root, others, extra, condensed))

    def plus(self, trajectory: Mapping[int, Array], factors: Sequence[Factor]) -> RelativeCovariance:
        """Return the covariances with further frames, each placed by one factor: nothing is eliminated again.

        Args:
            trajectory: with the further frames.
            factors: each of a frame that is in no earlier one.
        """
        leaves, all_factors = dict(self.leaves), [*self.factors, *factors]
        if len(leaves) + len(factors) > _MOST_LEAVES:
            known = self.eliminated
            return RelativeCovariance.of(trajectory, known.root, all_factors, known.extra, known.condensed)
        for factor in factors:
            source_is_new = factor.target in leaves or factor.target in self.eliminated.trajectory
            leaves[factor.source if source_is_new else factor.target] = _leaf(factor, source_is_new=source_is_new)
        return replace(self, trajectory=trajectory, factors=all_factors, leaves=leaves)

    def __call__(self, target: int, source: int) -> Array:
        """Return the covariance (6, 6) of ξ in `target_from_source @ exp(ξ)`; KeyError if a frame was not solved."""
        source_from_target = se3.inverse(self.trajectory[source]) @ self.trajectory[target]
        covariance = ROOT_SIGMA**2 * np.eye(6)
        if target == source:
            return covariance
        right = {source: np.eye(6), target: -se3.adjoint(source_from_target).T}  # columns still to be solved for
        rank, leaves, conditional = self._ranks.__getitem__, self.leaves, self.eliminated.conditional
        while right:  # method, eq. 8.6
            variable = min(right, key=rank)
            root, others, parents = leaves.get(variable) or conditional(variable)
            solved = _trsm(1.0, root, right.pop(variable), trans_a=1)
            covariance += solved.T @ solved
            updates = (others.T @ solved).reshape(-1, 6, 6)
            for parent, update in zip(parents, updates, strict=True):
                right[parent] = right[parent] - update if parent in right else -update
        return 0.5 * (covariance + covariance.T)

    @property
    def deforming(self) -> RelativeCovariance:
        """The part due to errors that deform the model: all."""
        return self

    @cached_property
    def log_determinant(self) -> float:
        """Half the log determinant of the information of all variables."""
        of_leaves = sum(np.log(np.abs(np.diag(leaf.root))).sum() for leaf in self.leaves.values())
        condensed = self.eliminated.condensed
        of_condensed = 0.0 if condensed is None else condensed.net.logDeterminant()
        return float(self.eliminated.net.logDeterminant() + of_condensed + of_leaves)

    @cached_property
    def _ranks(self) -> Mapping[int, int]:
        """Place of each variable in the order of elimination, in which the newest frame is first."""
        return {**self.eliminated.order, **{frame: -number for number, frame in enumerate(self.leaves, 1)}}


def _leaf(factor: Factor, *, source_is_new: bool) -> Conditional:
    """Return the conditional of a frame that a single factor places, so that the factor's residual is 0."""
    by_source = factor.root_information
    by_target = -by_source @ se3.adjoint(se3.inverse(factor.pose.mean))
    if source_is_new:
        return Conditional(by_source, by_target, (factor.target,))
    turn, root = np.linalg.qr(by_target)
    return Conditional(root, turn.T @ by_source, (factor.source,))


@dataclass(frozen=True, eq=False)
class PoseCovariances(Mapping[int, Array]):
    """Covariances (6, 6) of object_from_camera by frame number, computed on access."""

    trajectory: Mapping[int, Array]
    """object_from_camera (4, 4) by frame number."""
    one: Callable[[int], Array]
    """Computes the covariance of one frame."""
    known: dict[int, Array] = field(default_factory=dict, repr=False)
    """By frame number, those computed so far."""

    def __getitem__(self, frame: int) -> Array:
        """Return the covariance of one pose."""
        if frame not in self.known:
            self.known[frame] = self.one(frame)
        return self.known[frame]

    def __contains__(self, frame: object) -> bool:
        """Return whether a frame was solved."""
        return frame in self.trajectory

    def __iter__(self) -> Iterator[int]:
        """Yield the solved frames."""
        return iter(self.trajectory)

    def __len__(self) -> int:
        """Return the number of solved frames."""
        return len(self.trajectory)


_QUANTILE = 0.16  # one standard error towards larger covariances
_MAX_SHARE = 0.9  # of a covariance: each registration also has sampling noise


@dataclass(frozen=True, eq=False)
class SharedCovariance:
    """Covariances under errors that edges share: noise of their images, of all views, and of the focal length.

    A fraction ρ of an edge's covariance Σ is due to its two images: pixel noise moves an image as a whole, alike in all
    its edges. Frame k then appears not at T_k but at T_k exp(η_k), with one η_k ~ N(0, Q_k) for all its edges, and
    edges are independent measurements of covariance (1 − ρ) Σ between these apparent poses. The optimum is the same, as
    one factor on all covariances moves nothing; relative covariances are those of method, eq. 8.9: a single edge keeps
    its covariance, several edges of a frame make it no smaller than the images allow, and along a chain the images'
    noise cancels.

    All views may also have a common error: one camera sees one object from one height, and its distance may be biased.
    Every frame then appears at T_k exp(β), with one β ~ N(0, B) in camera coordinates (eq. 8.10). All loops still
    close, and β is not observable; it cancels between frames that see the same side of the object. It includes a shift
    of all measured surface, as by a biased distance.

    The error of the focal length moves all edges together; each motion's covariance grows by its derivative (eq. 10.6).
    """

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
    variance_factor: float = Solution.variance_factor
    """On the covariances of edges; see `variance_factor`."""

    def __call__(self, target: int, source: int) -> Array:
        """Return the covariance (6, 6) of ξ in `target_from_source @ exp(ξ)`; KeyError if a frame was not solved."""
        return self._widened(self.independent(target, source), target, source)

    @property
    def deforming(self) -> SharedCovariance:
        """The part due to errors of single poses; a common one moves the surface of each view with its pose."""
        return replace(self, focal=None, common=0.0, common_shift_m2=None)

    def _widened(self, independent: Array, target: int, source: int) -> Array:
        if target == source:
            return independent
        source_from_target = se3.inverse(self.independent.trajectory[source]) @ self.independent.trajectory[target]
        of_target = se3.inverse_covariance(source_from_target, self._noise.get(target, np.zeros((6, 6))))
        covariance = self.variance_factor * (1.0 - self.share) * independent
        covariance = covariance + self._noise.get(source, np.zeros((6, 6))) + of_target  # eq. 8.9
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
        share = 0.5 * self.variance_factor * self.share
        return {
            frame: np.asarray(share * np.linalg.inv(np.mean(some, axis=0)), dtype=np.float64)
            for frame, some in informations.items()
        }

    @cached_property
    def _common_covariance(self) -> Array:
        """B (6, 6)."""
        covariance = np.zeros((6, 6))
        if self.common:
            informations = [factor.root_information.T @ factor.root_information for factor in self.factors]
            covariance += self.variance_factor * self.common * np.linalg.inv(np.mean(informations, axis=0))
        if self.common_shift_m2 is not None:
            covariance[3:, 3:] += self.common_shift_m2
        return covariance


def variance_factor(graph: PoseGraph, solution: Solution, least: float) -> float:
    """Return the factor on edges' covariances with which loops are as likely as one of six is to be larger (eq. 8.12).

    Smooth errors of depth are stated as large as they may be; loops show how large they are. It is 1 without loops.

    Args:
        graph: the edges.
        solution: of that graph.
        least: share of the covariances that is not due to smooth errors.
    """
    distance, conditions = _distance(graph, solution)
    return float(np.clip(distance / chdtri(conditions, 1.0 - _QUANTILE), least, 1.0)) if conditions > 0 else 1.0


def shared_noise(graph: PoseGraph, solution: Solution, factor: float = 1.0) -> float:
    """Estimate the fraction ρ of edges' covariances that is noise of their images from the loops' errors (eq. 8.11).

    The images' noise cancels around a loop, so that the squared distance over the 6 l conditions of l loops is (1 − ρ)
    of that of independent edges. The estimate is one standard error towards independence, and 0 without loops or if
    they close no better than independent edges.

    Args:
        graph: the edges.
        solution: of that graph.
        factor: on the edges' covariances: `variance_factor`.
    """
    distance, conditions = _distance(graph, solution)
    if conditions <= 0:
        return 0.0
    return float(np.clip(1.0 - distance / factor / chdtri(conditions, 1.0 - _QUANTILE), 0.0, _MAX_SHARE))


def _distance(graph: PoseGraph, solution: Solution) -> tuple[float, int]:
    """Return the squared Mahalanobis distance of the edges from a solution, and the number of conditions of loops."""
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
    return distance, 6 * (count - len(solution.trajectory) + 1) if count else 0
