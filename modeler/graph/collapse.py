"""One registration as one Gaussian, which is what a factor holds."""

from __future__ import annotations

from modeler.types import Array, PoseGaussian, Posterior, are_separate, pooled


def collapse_modes(posterior: Posterior, weights: Array | None = None) -> PoseGaussian:
    """Return a posterior as one Gaussian: at its heaviest mode, as wide as all of them make it.

    Modes that are not separate have a mean and covariance that say as much as they do.

    Args:
        posterior: with its modes.
        weights: (m,) of the modes, as far as loops have decided; None: the posterior's own.
    """
    return pooled(posterior.modes, weights) if are_separate(posterior.modes) else posterior.pose
