"""One registration as one Gaussian, which is what a factor holds."""

from __future__ import annotations

import numpy as np

from modeler import se3
from modeler.types import Array, PoseGaussian, Posterior

_APART = 2.0  # standard deviations: two equal Gaussians with means nearer than that have but one peak


def separate(posterior: Posterior) -> bool:
    """Return whether a posterior has modes that are more than ripples on one peak.

    No loop could tell ripples apart, however many there are: each would be asked in vain.
    """
    if len(posterior.modes) < 2:
        return False
    first, *others = (mode.pose for mode in posterior.modes)
    xi = se3.log(se3.inverse(first.mean) @ np.stack([other.mean for other in others]))
    spread = 0.5 * (first.covariance + np.stack([other.covariance for other in others]))
    squares = np.sum(xi * np.linalg.solve(spread, xi[..., None])[..., 0], axis=-1)
    return bool(squares.max() > _APART**2)


def belief(posterior: Posterior, weights: Array | None = None) -> PoseGaussian:
    """Return a posterior as one Gaussian: at its heaviest mode, as wide as all of them make it.

    The mean of several modes lies at none of them; a mode alone would be sure of what is not decided. Modes that are
    not separate have a mean and covariance that say as much as they do.

    Args:
        posterior: with its modes.
        weights: (m,) of the modes, as far as loops have decided; None: the posterior's own.
    """
    modes = posterior.modes
    if not separate(posterior):
        return posterior.pose
    weights = np.array([mode.weight for mode in modes]) if weights is None else weights
    mean = modes[int(np.argmax(weights))].pose.mean
    offsets = se3.log(se3.inverse(mean) @ np.stack([mode.pose.mean for mode in modes]))
    spread = np.stack([mode.pose.covariance for mode in modes]) + offsets[:, :, None] * offsets[:, None, :]
    return PoseGaussian(mean, np.tensordot(weights / np.sum(weights), spread, 1))
