"""Posteriors of poses far apart, averaged over the focal length (method.md, eq. 29)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from modeler import se3
from modeler.registration.posterior import weighted_gaussian
from modeler.types import Array, PoseGaussian, Posterior, are_separate

_FAR_RAD = 0.05  # least sd of a rotation at which poses follow the focal length differently: see method.md
_NODE = np.sqrt(3.0)  # standard deviations: Gauss-Hermite quadrature, exact for polynomials of degree 5
_MIDDLE, _OUTER = 2.0 / 3.0, 1.0 / 6.0  # its weights


def averaged(found: Posterior, under: Callable[[float], Posterior], sigma_focal: float, centre_m: Array) -> Posterior:
    """Return a posterior averaged over the focal length, if its poses are far apart; otherwise as it is.

    What all poses have in common stays in the derivative by the focal length. Separate modes stay as they are, too.

    Args:
        found: the posterior under the given focal length.
        under: returns the posterior under another, given as the logarithm of its factor.
        sigma_focal: standard deviation of that logarithm.
        centre_m: (3,) point of the source about which the covariance is taken.
    """
    far = np.linalg.eigvalsh(found.pose.covariance[:3, :3])[-1] > _FAR_RAD**2
    if sigma_focal == 0.0 or not found.usable or not far or are_separate(found.modes):
        return found
    parts = [(_MIDDLE, found, found.samples)]
    for log_factor in (-_NODE * sigma_focal, _NODE * sigma_focal):
        other = under(log_factor)
        if other.usable:
            parts.append((_OUTER, other, other.samples @ se3.exp(-log_factor * found.pose.by_focal)))
    shares = np.array([share for share, _, _ in parts])
    shares /= shares.sum()
    samples = np.concatenate([poses for _, _, poses in parts])
    weights = np.concatenate([share * one.weights for share, (_, one, _) in zip(shares, parts, strict=True)])
    pose = weighted_gaussian(samples, weights, centre_m)
    return replace(
        found,
        pose=PoseGaussian(pose.mean, pose.covariance, found.pose.by_focal),
        samples=samples,
        weights=weights,
        modes=(),
        effective_samples=1.0 / float(np.sum(weights**2)),
        seconds=sum(one.seconds for _, one, _ in parts),
    )
