"""Several modes taken together: whether they are separate, and the one Gaussian that says as much as they do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modeler import se3
from modeler.types.arrays import Array
from modeler.types.posteriors import Mode, PoseGaussian

_APART = 2.0  # standard deviations: two equal Gaussians with means nearer than that have but one peak


def separate(modes: Sequence[Mode]) -> bool:
    """Return whether some modes are more than ripples on one peak, that of the first."""
    if len(modes) < 2:
        return False
    first, *others = (mode.pose for mode in modes)
    xi = se3.log(se3.inverse(first.mean) @ np.stack([other.mean for other in others]))
    spread = 0.5 * (first.covariance + np.stack([other.covariance for other in others]))
    squares = np.sum(xi * np.linalg.solve(spread, xi[..., None])[..., 0], axis=-1)
    return bool(squares.max() > _APART**2)


def as_one(modes: Sequence[Mode], weights: Array | None = None) -> PoseGaussian:
    """Return one Gaussian at the heaviest of separate modes, as wide as all of them make it.

    The mean of several modes lies at none of them; the heaviest alone would be sure of what is not decided.

    Args:
        modes: one at least.
        weights: (m,) of the modes; None: their own.
    """
    weights = np.array([mode.weight for mode in modes]) if weights is None else weights
    mean = modes[int(np.argmax(weights))].pose.mean
    offsets = se3.log(se3.inverse(mean) @ np.stack([mode.pose.mean for mode in modes]))
    spread = np.stack([mode.pose.covariance for mode in modes]) + offsets[:, :, None] * offsets[:, None, :]
    return PoseGaussian(mean, np.tensordot(weights / np.sum(weights), spread, 1))
