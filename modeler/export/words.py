"""What images leave open about a motion, in words that a person at the camera can act on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from modeler import se3
from modeler.types import Array, PoseGaussian, Posterior, RayImage

_FREE_RAD = np.radians(8.0)  # two such are the usual step between views: the edge does not tell whether there was one
_FREE_M = 0.01  # surfaces of a hand-sized object then come to lie visibly apart
_ALIKE = np.cos(np.radians(25.0))  # nearer than this, a direction goes by the name of another
_LONG = 1.5  # how many times longer than wide an object is said to have an axis of its own


def undetermined(posterior: Posterior, view: RayImage | None = None) -> list[str]:
    """Name the directions of a motion that the data do not determine, the freest first; none where all are.

    Of a posterior with several modes the heaviest is meant, and where the others lie is named after.

    Args:
        posterior: of target_from_source.
        view: the source view, by which directions are named; None: by the camera alone, and turns only.
    """
    modes = posterior.modes if len(posterior.modes) > 1 else ()
    pose = modes[0].pose if modes else posterior.pose
    if not np.isfinite(pose.covariance).all():
        return []
    return [*_free(pose, view), *_elsewhere(posterior, view)]


def _free(pose: PoseGaussian, view: RayImage | None) -> Iterator[str]:
    """Yield the directions in which one Gaussian is wide."""
    sigmas_rad, axes = _principal(pose.covariance[:3, :3])
    if sigmas_rad[-1] > _FREE_RAD:
        yield f"free to turn about any axis: {_degrees(sigmas_rad[-1])} sd and more"
    else:
        for sigma_rad, axis in zip(sigmas_rad, axes, strict=True):
            if sigma_rad > _FREE_RAD:
                yield f"free to turn about {_name(axis, view)}: {_degrees(sigma_rad)} sd"
    if view is None or not len(view.points_m):
        return
    of_centre = se3.covariance_about(pose.covariance, view.centroid_m)[3:, 3:]  # how the object's middle moves
    sigmas_m, axes = _principal(of_centre)
    for sigma_m, axis in zip(sigmas_m, axes, strict=True):
        if sigma_m > _FREE_M:
            yield f"free to shift along {_name(axis, view)}: {1000.0 * sigma_m:.0f} mm sd"


def _elsewhere(posterior: Posterior, view: RayImage | None) -> Iterator[str]:
    """Yield where the lighter modes lie, as seen from the heaviest."""
    if not posterior.modes:
        return
    first, *others = posterior.modes
    against = f"against {_percent(first.weight)}"
    nearby: list[str] = []
    for mode in others:
        xi = se3.log(se3.inverse(first.pose.mean) @ mode.pose.mean)
        angle_rad, share = float(np.linalg.norm(xi[:3])), _percent(mode.weight)
        if angle_rad > _FREE_RAD:
            about = _name(xi[:3] / angle_rad, view)
            yield f"perhaps turned by {_degrees(angle_rad)} more about {about}: {share} {against}"
        else:
            nearby.append(share)
    if nearby:
        yield f"perhaps elsewhere nearby: {', '.join(nearby)} {against}"


def _principal(covariance: Array) -> tuple[Array, Array]:
    """Return standard deviations (3,) and their directions (3, 3) as rows, largest first."""
    variances, vectors = np.linalg.eigh(covariance)
    return np.sqrt(np.maximum(variances[::-1], 0.0)), np.asarray(vectors.T[::-1], dtype=np.float64)


def _name(direction: Array, view: RayImage | None) -> str:
    """Return what a person would call a unit direction (3,) of the source camera frame, whichever way it points."""
    for name, known in _directions(view):
        if abs(float(direction @ known)) >= _ALIKE:
            return name
    direction = direction if direction[int(np.argmax(np.abs(direction)))] > 0.0 else -direction
    x, y, z = np.round(direction, 2) + 0.0  # no minus before a zero
    return f"the direction ({x:.2f}, {y:.2f}, {z:.2f}) of the camera"


def _directions(view: RayImage | None) -> Iterator[tuple[str, Array]]:
    """Yield named unit directions (3,), those that say most first."""
    if view is not None and len(view.points_m) > 3:
        lengths, axes = _principal(np.cov(view.points_m.T))
        if lengths[0] > _LONG * lengths[1]:
            yield "its own axis", axes[0]
    if view is not None and view.plane is not None:
        yield "the table's normal", view.plane.normal
    yield "the viewing direction", np.array([0.0, 0.0, 1.0])
    yield "the camera's vertical", np.array([0.0, 1.0, 0.0])
    yield "the camera's horizontal", np.array([1.0, 0.0, 0.0])


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _degrees(angle_rad: float) -> str:
    return f"{np.degrees(angle_rad):.0f}°"
