"""Edges as the optimisation takes them, and how they hang together: a spanning tree, and loops beyond it.

Variables are object_from_camera(k). A link is `BetweenFactorPose3(target, source, target_from_source)`, whose noise
GTSAM expresses as `target_from_source @ exp(ξ)`, rotation first: the package's own convention, see `se3`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from modeler import se3
from modeler.types import Array, Edge, EdgeKind, Mode, PoseGaussian, separate

ROOT_SIGMA = 1e-9
"""Of a pose relative to itself, in rad and m: nothing, as a covariance that is still positive definite."""
_FIRST: tuple[EdgeKind, ...] = ("odometry", "span", "closure")  # what connects frames, if it can


@dataclass(frozen=True, eq=False)
class Link:
    """One edge as one Gaussian."""

    edge: Edge
    """As it was judged."""
    pose: PoseGaussian
    """target_from_source as the optimisation takes it."""

    @cached_property
    def target(self) -> int:
        """Frame number of the target view."""
        return self.edge.target

    @cached_property
    def source(self) -> int:
        """Frame number of the source view."""
        return self.edge.source

    @cached_property
    def modes(self) -> tuple[Mode, ...]:
        """Between which loops may decide: those of the posterior, unless they are as good as one."""
        return self.edge.posterior.modes if separate(self.edge.posterior.modes) else ()

    @cached_property
    def factor(self) -> gtsam.BetweenFactorPose3:
        """The link as GTSAM takes it.

        Raises:
            ValueError: where the covariance is not positive definite.
        """
        # smart=False: GTSAM's tests for simpler models have thresholds that near-singular information falls through.
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(self.root_information, False)
        return gtsam.BetweenFactorPose3(self.target, self.source, gtsam.Pose3(self.pose.mean), noise)

    @cached_property
    def root_information(self) -> Array:
        """R (6, 6), upper triangular, with RᵀR = Σ⁻¹: from Σ = UUᵀ with U upper triangular, R = U⁻¹.

        Raises:
            ValueError: where the covariance is not positive definite.
        """
        try:
            upper = np.linalg.cholesky(self.pose.covariance[::-1, ::-1])[::-1, ::-1]
        except np.linalg.LinAlgError as error:
            raise ValueError(
                f"the covariance of edge {self.source} -> {self.target} is not positive definite: leave it out"
            ) from error
        return np.asarray(np.triu(np.linalg.inv(upper)), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Frames:
    """How links hang together: those that first connect each frame with the root, odometry preferred, and loops."""

    links: Sequence[Link] = ()
    """All of them, in order of arrival."""
    tree: Sequence[Link] = ()
    """Those that connect, whatever closes loops."""
    loops: Sequence[Link] = ()
    """The rest; links that do not hang together with the root are in neither."""
    reached: frozenset[int] = frozenset()
    """The frames of the tree, and the root."""
    last: int = 0
    """Place among the kinds, from the preferred one on, of the last that the tree needed."""

    @classmethod
    def of(cls, links: Sequence[Link], root: int) -> Frames:
        """Return how links hang together with the root."""
        tree: list[Link] = []
        loops: list[Link] = []
        group: dict[int, set[int]] = {}
        for link in sorted(links, key=_place):  # stable: by arrival within a kind
            target, source = (group.setdefault(frame, {frame}) for frame in (link.target, link.source))
            if source is target:
                loops.append(link)
                continue
            tree.append(link)
            larger, smaller = (target, source) if len(target) >= len(source) else (source, target)
            larger |= smaller
            group.update(dict.fromkeys(smaller, larger))
        reached = frozenset(group.get(root, {root}))
        tree, loops = ([link for link in some if link.target in reached] for some in (tree, loops))
        return cls(links, tree, loops, reached, max(map(_place, tree), default=0))

    def plus(self, links: Sequence[Link]) -> Frames | None:
        """Return it with more links; None where these would have connected other frames than the tree did."""
        if len(self.tree) + len(self.loops) < len(self.links):
            return None
        tree, loops, reached, last = list(self.tree), list(self.loops), set(self.reached), self.last
        for link in sorted(links, key=_place):
            known = (link.target in reached) + (link.source in reached)
            if known == 0 or (known == 2 and _place(link) < last):
                return None
            if known == 2:
                loops.append(link)
                continue
            tree.append(link)
            reached |= {link.target, link.source}
            last = max(last, _place(link))
        return Frames([*self.links, *links], tree, loops, frozenset(reached), last)


def _place(link: Link) -> int:
    return _FIRST.index(link.edge.kind)


def walk(tree: Sequence[Link], *starts: int) -> Iterator[tuple[int, int, Link]]:
    """Yield (frame, neighbour, link) over links that make no loop, outwards from frames, nearer frames first."""
    links: dict[int, list[Link]] = {}
    for link in tree:
        links.setdefault(link.target, []).append(link)
        links.setdefault(link.source, []).append(link)
    waiting, reached = list(starts), set(starts)
    for frame in waiting:
        for link in links.get(frame, []):
            neighbour = link.source if link.target == frame else link.target
            if neighbour not in reached:
                reached.add(neighbour)
                waiting.append(neighbour)
                yield frame, neighbour, link


def chain(tree: Sequence[Link], root: int, guess: Mapping[int, Array]) -> dict[int, Array]:
    """Return object_from_camera by frame, outwards from the root: the guess, or else dead reckoning."""
    poses = {root: np.eye(4)}
    poses |= {frame: guess[frame] for link in tree for frame in (link.target, link.source) if frame in guess}
    poses[root] = np.eye(4)
    left = [link for link in tree if link.target not in poses or link.source not in poses]
    known = [frame for link in left for frame in (link.target, link.source) if frame in poses]
    for frame, neighbour, link in walk(left, *known):
        target_from_source = link.pose.mean
        frame_from_neighbour = target_from_source if link.target == frame else se3.inverse(target_from_source)
        poses[neighbour] = poses[frame] @ frame_from_neighbour
    return poses


def anchored(guess: Mapping[int, Array], root: int) -> Mapping[int, Array]:
    """Return the guess with the root's pose at the identity; without the root it says nothing."""
    if root not in guess:
        return {}
    if np.array_equal(guess[root], np.eye(4)):
        return guess
    root_from_guess = se3.inverse(guess[root])
    return {frame: root_from_guess @ pose for frame, pose in guess.items()}


def inverse_right_jacobian(xi: Array) -> Array:
    """Return J (n, 6, 6) with log(exp(ξ) exp(η)) = ξ + J η to first order in η, to third order in small ξ (n, 6)."""
    adjoint = np.zeros((len(xi), 6, 6))
    adjoint[:, :3, :3] = adjoint[:, 3:, 3:] = se3.hat(xi[:, :3])
    adjoint[:, 3:, :3] = se3.hat(xi[:, 3:])
    return np.eye(6) + 0.5 * adjoint + adjoint @ adjoint / 12.0
