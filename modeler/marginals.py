"""Uncertainty of the motion between any two frames of a solved graph, in square-root covariance form.

A spanning tree of the edges carries the poses, the other edges close loops. Write the error of edge e in object
coordinates, Ad(object_from_source) ξ = S_e u_e with unit errors u ~ N(0, I): errors along a path simply add up, and a
loop observes that those around it add up to its own. A path's error is then W u, what the loops observe is M u, each a
row of signed S_e, and with Θ an orthonormal basis of the rows of M

    cov(path) = W (I − ΘᵀΘ) Wᵀ.

No covariance is ever inverted or subtracted, so that a direction nobody observed, metres wide beside micrometres, is as
welcome as any other; elimination in information form refuses it. First order in the errors.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from modeler import se3
from modeler.types import Array, Edge

_GAUGE_SIGMA = 1e-9  # rad and m: a pose relative to itself, as a covariance that is still positive definite


@dataclass(frozen=True, eq=False)
class RelativeCovariance:
    """Covariances of target_from_source between solved frames; see `network` for its making."""

    trajectory: Mapping[int, Array]
    """object_from_camera (4, 4) by frame number."""
    paths: Mapping[int, Array]
    """Signs (t,) of the tree's edges on the way from the root, by frame number."""
    roots: Array
    """(t, 6, 6) square roots S_e of the tree edges' covariances, in object coordinates."""
    observed: Array
    """(6 t + 6 l, 6 l) Θᵀ: orthonormal directions, among the unit errors of tree and loops, that the loops observe."""

    def __call__(self, target: int, source: int) -> Array:
        """Return the covariance (6, 6) of ξ in `target_from_source @ exp(ξ)`.

        Raises:
            KeyError: where a frame was not solved.
        """
        path = _row(self.paths[source] - self.paths[target], self.roots)
        path = np.concatenate([path, np.zeros((6, self.observed.shape[0] - path.shape[1]))], axis=1)
        free = path - (path @ self.observed) @ self.observed.T
        free = se3.adjoint(se3.inverse(self.trajectory[source])) @ free
        covariance = free @ free.T
        return 0.5 * (covariance + covariance.T) + _GAUGE_SIGMA**2 * np.eye(6)


def network(
    trajectory: Mapping[int, Array], root: int, tree: Sequence[Edge], loops: Sequence[Edge]
) -> RelativeCovariance:
    """Return the uncertainty of all motions between solved frames.

    Args:
        trajectory: object_from_camera (4, 4) by frame number.
        root: a frame of the tree, which must span the trajectory.
        tree: the edges along which the frames hang together, each reaching one frame not reached by the others.
        loops: the edges beyond those.

    Raises:
        ValueError: where the covariance of an edge is not positive definite.
    """
    numbers = {id(edge): number for number, edge in enumerate(tree)}
    paths = {root: np.zeros(len(tree))}
    for frame, neighbour, edge in walk(tree, root):
        paths[neighbour] = paths[frame].copy()
        paths[neighbour][numbers[id(edge)]] = 1.0 if edge.target == frame else -1.0
    roots = _roots(trajectory, tree)
    around = [_row(paths[edge.source] - paths[edge.target], roots) for edge in loops]
    own = [_row(sign, _roots(trajectory, loops)) for sign in np.eye(len(loops))]
    observed = np.zeros((6 * len(tree) + 6 * len(loops), 0))
    for pair in zip(around, own, strict=True):
        observed = np.concatenate([observed, _beyond(observed, np.concatenate(pair, axis=1).T)], axis=1)
    return RelativeCovariance(trajectory, paths, roots, observed)


def _beyond(basis: Array, columns: Array) -> Array:
    """Return an orthonormal basis (n, 6) of what `columns` (n, 6) add to the span of an orthonormal `basis` (n, m).

    Loop by loop, for the large QR of all loops at once lets BLAS threads fight over busy cores, a hundred times slower.
    """
    for _ in range(2):  # once loses digits where little is left; twice is enough
        columns = np.asarray(np.linalg.qr(columns - basis @ (basis.T @ columns)).Q, dtype=np.float64)
    return columns


def _row(signs: Array, roots: Array) -> Array:
    """Return [s_1 S_1, s_2 S_2, …] (6, 6 n) for signs (n,) and roots (n, 6, 6)."""
    return (signs[:, None, None] * roots).transpose(1, 0, 2).reshape(6, -1)


def _roots(trajectory: Mapping[int, Array], edges: Iterable[Edge]) -> Array:
    """Return square roots (n, 6, 6) of the covariances of the edges' errors in object coordinates."""
    roots = [np.zeros((0, 6, 6))]
    for edge in edges:
        try:
            root = np.linalg.cholesky(edge.posterior.pose.covariance)
        except np.linalg.LinAlgError as error:
            raise ValueError(
                f"the covariance of edge {edge.source} -> {edge.target} is not positive definite: leave it out"
            ) from error
        roots.append((se3.adjoint(trajectory[edge.source]) @ root)[None])
    return np.concatenate(roots)


def walk(tree: Sequence[Edge], root: int) -> Iterator[tuple[int, int, Edge]]:
    """Yield (frame, neighbour, edge) over a tree of edges, outwards from the root, nearer frames first."""
    edges: dict[int, list[Edge]] = {}
    for edge in tree:
        edges.setdefault(edge.target, []).append(edge)
        edges.setdefault(edge.source, []).append(edge)
    waiting, reached = [root], {root}
    for frame in waiting:
        for edge in edges.get(frame, []):
            neighbour = edge.source if edge.target == frame else edge.target
            if neighbour not in reached:
                reached.add(neighbour)
                waiting.append(neighbour)
                yield frame, neighbour, edge


@dataclass(frozen=True, eq=False)
class PoseCovariances(Mapping[int, Array]):
    """Covariances (6, 6) of object_from_camera by frame number, worked out when asked."""

    root: int
    """The frame that the poses are relative to."""
    relative_covariance: RelativeCovariance
    """Answers for each."""

    def __getitem__(self, frame: int) -> Array:
        """Return the covariance of one pose."""
        return self.relative_covariance(self.root, frame)

    def __iter__(self) -> Iterator[int]:
        """Yield the solved frames."""
        return iter(self.relative_covariance.trajectory)

    def __len__(self) -> int:
        """Return the number of solved frames."""
        return len(self.relative_covariance.trajectory)
