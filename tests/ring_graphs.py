"""Pose graphs made up on a turntable, with edges whose errors are what their covariances say."""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.graph import PoseGraph
from modeler.types import Array, Edge, EdgeKind, Mode, Outcome, PoseGaussian, Posterior, Stated

OBJECT_M = np.array([0.05, 0.02, 0.8])


def edge(
    target: int,
    source: int,
    pose: PoseGaussian,
    kind: EdgeKind = "odometry",
    *,
    accepted: bool = True,
    modes: Sequence[Mode] = (),
) -> Edge:
    posterior = Posterior(source, target, pose, Outcome.CONVERGED, overlap=0.8, modes=tuple(modes))
    return Edge(posterior, kind, accepted, Stated("made up"))


def covariance(rng: np.random.Generator, sigma_rad: float = 0.01, sigma_m: float = 0.002) -> Array:
    """A covariance (6, 6) as registration gives it: compact at the object, strongly correlated at the camera."""
    scale = np.diag([sigma_rad] * 3 + [sigma_m] * 3)
    factor = 0.3 * rng.normal(size=(6, 6)) + np.eye(6)
    adjoint = se3.adjoint(se3.translation(OBJECT_M))
    return adjoint @ scale @ factor @ factor.T @ scale @ adjoint.T


def spin(rotation_rad: npt.ArrayLike) -> Array:
    """Motion (4, 4) of an object turned through itself by a rotation vector (3,)."""
    return se3.translation(OBJECT_M) @ se3.exp(np.append(rotation_rad, np.zeros(3))) @ se3.translation(-OBJECT_M)


def spun(of: Edge, rotation_rad: npt.ArrayLike) -> Edge:
    """The edge, wrong by a turn of the object through itself."""
    pose = of.posterior.pose
    return edge(of.target, of.source, PoseGaussian(pose.mean @ spin(rotation_rad), pose.covariance), of.kind)


def turn(angle_rad: float) -> Array:
    """Motion (4, 4) of an object turned about a tilted axis through itself."""
    return spin([0.1, angle_rad, -0.05 * angle_rad])


def turntable(count: int, per_turn: int | None = None) -> dict[int, Array]:
    """True object_from_camera of `count` stops of a turntable, so many of which make a turn (all, without it)."""
    angles = 2.0 * np.pi * np.arange(count) / (per_turn or count)
    return {k: se3.inverse(turn(angle)) @ turn(0.0) for k, angle in enumerate(angles)}


def measured(
    truth: Mapping[int, Array], target: int, source: int, rng: np.random.Generator, luck: float = 1.0
) -> PoseGaussian:
    """A measurement with the error that its covariance states, or `luck` times that: truth = mean @ exp(ξ)."""
    spread = covariance(rng)
    xi = luck * np.linalg.cholesky(spread) @ rng.normal(size=6)
    return PoseGaussian(se3.inverse(truth[target]) @ truth[source] @ se3.exp(-xi), spread)


def ring(
    count: int, rng: np.random.Generator, closures: Sequence[tuple[int, int]], luck: float = 1.0
) -> tuple[PoseGraph, dict[int, Array]]:
    """A turn of `count` stops with edges between neighbours and closures (target, source), and the truth."""
    truth = turntable(count)
    odometry = [edge(k - 1, k, measured(truth, k - 1, k, rng, luck)) for k in range(1, count)]
    loops = [edge(t, s, measured(truth, t, s, rng, luck), "closure") for t, s in closures]
    return PoseGraph((*odometry, *loops)), truth


def nees(gaussian: PoseGaussian, truth: Array) -> float:
    """Normalised estimation error squared: chi² with 6 degrees of freedom where the covariance is true."""
    xi = se3.log(se3.inverse(gaussian.mean) @ truth)
    return float(xi @ np.linalg.solve(gaussian.covariance, xi))


def rotation_error(poses: Mapping[int, Array], truth: Mapping[int, Array]) -> float:
    """Root mean square rotation error in rad over frames other than the first."""
    angles = [se3.rotation_angle(se3.inverse(truth[k]) @ poses[k]) for k in truth if k]
    return float(np.sqrt(np.mean(np.square(angles))))
