"""What `paper` prepares of two views, so that most motions are dropped before their likelihood is summed."""

from dataclasses import dataclass, replace

import numpy as np

from modeler.kernels import free_space as kernel
from modeler.kernels import paper
from modeler.types import Array, BoolArray, EvenSpread

_ANGLE_LIMIT_RAD = 2.0  # up to here most tries at a rotation within the limit succeed
_NEARER = 1.5  # the test holds for points up to where rays spread so many times as wide as at the nearest point seen


@dataclass(frozen=True, eq=False)
class Measured:
    """What the paper's likelihood takes of one view."""

    points_m: Array
    """(n, 3) surface points."""
    ranges_m: Array
    """(h, w) range of every pixel, 0 = no measurement."""
    intrinsics: Array
    """(4,) fx, fy, cx, cy in px."""
    noise: Array
    """(3, 3) L, the covariance of the sensor in ray coordinates (w, h, r)."""


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """A test that motions fail only if a point of theirs has less density than `reject_below` under eq. pbd.

    For a point b carried to b_A, let Σ = L + J L Jᵀ be the covariance of b_A - a_i in ray coordinates, with J = Q_A R
    Q_B⁻¹. D of eq. pbd is the inverse of Σ's lateral part, so that pixels within reach lie within reach · √λ_max(Σ_wh);
    and where a_i lies d > 0 behind b_A, its term is at most 2 exp(-½ d² / Σ_rr). Both entries of Σ are bounded over
    rotations by the largest eigenvalue of Q_B⁻¹ L Q_B⁻ᵀ. So a point that lies far enough in front of the nearest pixel
    within the widest reach has a sum below the threshold, whatever D and v are.
    """

    checks: Array
    """(n, 5), see `kernels.free_space`."""
    near_m: tuple[np.ndarray, np.ndarray]
    """`nearest_ranges` of target and source."""
    images: tuple[Array, Array]
    """Their images, see `kernels.free_space.forbidden`."""

    @staticmethod
    def of(source: Measured, target: Measured, reach_sigmas: float, reject_below: float) -> "FreeSpace":
        """Return the test of two views; one that forbids nothing where reach or threshold bound nothing."""
        sides = _side(source, target, reach_sigmas, reject_below), _side(target, source, reach_sigmas, reject_below)
        checks = np.concatenate([np.insert(side[0], kernel.BACKWARD, k, axis=1) for k, side in enumerate(sides)])
        return FreeSpace(checks, (sides[0][1], sides[1][1]), (sides[0][2], sides[1][2]))

    def ordered(self, poses: Array) -> "FreeSpace":
        """Return the test with the checks first that forbid most of poses (m, 12) that those before let pass."""
        forbidden = kernel.verdicts(poses, self.checks, self.near_m, self.images)
        order: list[int] = []
        left = forbidden
        while len(left) and left.any():
            order.append(int(left.sum(axis=0).argmax()))
            left = left[~left[:, order[-1]]]
        rest = np.setdiff1d(np.argsort(-forbidden.sum(axis=0), kind="stable"), order, assume_unique=True)
        return replace(self, checks=np.ascontiguousarray(self.checks[np.concatenate([order, rest]).astype(int)]))

    def passes(self, poses: Array) -> BoolArray:
        """Return which (m,) of poses (m, 12) may have a likelihood."""
        return kernel.passing_poses(poses, self.checks, self.near_m, self.images)

    def passing(self, draws: "Draws", first: int, count: int) -> Array:
        """Return those (m, 12) of the motions numbered from `first` that may have a likelihood."""
        alive = kernel.passing(first, count, (draws.seed, draws.spread), self.checks, self.near_m, self.images)
        return kernel.drawn(first + np.flatnonzero(alive), draws.seed, draws.spread)


@dataclass(frozen=True, eq=False)
class Draws:
    """Numbered motions of an even spread."""

    seed: np.uint64
    spread: Array
    """(17,), see `kernels.free_space.draw`."""

    @staticmethod
    def of(even: EvenSpread | None, rng: np.random.Generator) -> "Draws | None":
        """Return motions of a spread; None where there is none, or one too wide to be drawn by trying."""
        if even is None or not 0.0 <= even.max_rotation_rad <= _ANGLE_LIMIT_RAD:
            return None
        limits = np.sin(0.5 * even.max_rotation_rad), even.max_offset_m
        spread = np.concatenate([limits, even.source_centroid_m, even.target_centroid_m, even.middle.ravel()])
        return Draws(rng.integers(2**64, dtype=np.uint64), spread)

    def poses(self, first: int, count: int) -> Array:
        """Return the motions (count, 12) numbered from `first`."""
        return kernel.drawn(np.arange(first, first + count), self.seed, self.spread)


def _side(own: Measured, other: Measured, reach_sigmas: float, reject_below: float) -> tuple[Array, np.ndarray, Array]:
    """Return checks (n, 4) of one view's points against another, and the other's nearest ranges and image."""
    fx, fy, cx, cy = other.intrinsics
    noise = other.noise
    inverses = np.stack([paper.ray_jacobian_inverse(point) for point in own.points_m])
    spread_m2 = np.linalg.eigvalsh(inverses @ noise @ inverses.transpose(0, 2, 1))[:, -1]
    widening = _NEARER * max(
        np.max(np.sum(view.points_m**2, axis=1) / view.points_m[:, 2] ** 4) for view in (own, other)
    )
    lateral = np.linalg.eigvalsh(noise[:2, :2])[-1]
    reach_px = reach_sigmas * np.sqrt(lateral + spread_m2.max() * widening) * np.array([fx, fy]) + 1e-6
    if not (reject_below > 0.0 and np.all(reach_px < max(other.ranges_m.shape))):
        return np.zeros((0, 4)), np.zeros((1, 1), dtype=np.float32), np.zeros(7)
    near_m = kernel.nearest_ranges(other.ranges_m, reach_px)
    across, down = (
        (near - full) // 2 for near, full in zip(near_m.shape[::-1], other.ranges_m.shape[::-1], strict=True)
    )
    # K2 is at most √8 times its value for a point that is not turned, and terms are no more than the window's pixels.
    terms = 2.0 * np.sqrt(8.0) * (2 * across + 1) * (2 * down + 1)
    sigmas = np.sqrt(2.0 * np.log(max(terms / reject_below, 1.0))) + 1e-6
    margins_m = sigmas * np.sqrt(noise[2, 2] + spread_m2)
    height, width = near_m.shape
    image = np.array([fx, fy, cx + across, cy + down, width, height, widening])
    return np.column_stack([own.points_m, margins_m]), near_m, image
