"""Depth that is the distance along the ray, as renderers and some maker's libraries write it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np

from modeler.sequences.base import AbstractDerived
from modeler.types import Array, Camera, Frame


def stretch(camera: Camera) -> Array:
    """Return the distance along the ray of depth 1, (h, w): the square root of 1 + w² + h²."""
    w, h = camera.rays()
    return np.sqrt(1.0 + w**2 + h**2)


@final
@dataclass(frozen=True)
class AxialSequence(AbstractDerived):
    """Another sequence, whose depth is the distance along the ray, with depth along the optical axis."""

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`."""
        frame = self.whole.frame(index)
        return replace(frame, depth_m=(frame.depth_m / stretch(frame.camera)).astype(np.float32))

    @property
    def notes(self) -> tuple[str, ...]:
        """Assumptions and omissions of the reader."""
        return (*self.whole.notes, "depth is taken for the distance along the ray (`along_ray`)")


_POINTS: Final = 4000
_TRIALS: Final = 150
_NEAR: Final = 0.008  # relative residual of a plane; cameras measure 0.5 m and 2 m to half of that
_LEAST_PIXELS: Final = 500


def flat_shares(frames: Sequence[Frame]) -> tuple[float, float]:
    """Return the shares of measured pixels on the largest plane if depth is along the axis, and along the ray.

    In ray coordinates (w, h), a plane is a linear function for the inverse of depth along the axis. Distances along the
    ray are linear once multiplied by `stretch`: a table of 60° is bent by 15 % otherwise.
    """
    shares = [found for frame in frames if (found := _flat_shares(frame)) is not None]
    if not shares:
        return 0.0, 0.0
    axis, ray = np.median(shares, axis=0)
    return float(axis), float(ray)


def _flat_shares(frame: Frame) -> tuple[float, float] | None:
    measured = np.isfinite(frame.depth_m) & (frame.depth_m > 0.0)
    places = np.flatnonzero(measured)[:: max(1, np.count_nonzero(measured) // _POINTS)]
    if len(places) < _LEAST_PIXELS:
        return None
    w, h = (np.ascontiguousarray(each).ravel()[places] for each in frame.camera.rays())
    inverse = 1.0 / frame.depth_m.ravel()[places].astype(np.float64)
    along_axis, along_ray = (
        _largest_plane(w, h, values) for values in (inverse, inverse * stretch(frame.camera).ravel()[places])
    )
    return along_axis, along_ray


def _largest_plane(w: Array, h: Array, inverse: Array) -> float:
    """Return the share of points near the plane, of some through three of them each, that most are near."""
    rng = np.random.default_rng(0)
    design = np.stack([w, h, np.ones_like(w)], axis=1)
    best = np.zeros(len(w), dtype=np.bool_)
    for three in rng.integers(0, len(w), (_TRIALS, 3)):
        if abs(np.linalg.det(design[three])) < 1e-6:
            continue
        near = np.abs(design @ np.linalg.solve(design[three], inverse[three]) / inverse - 1.0) < _NEAR
        best = near if np.count_nonzero(near) > np.count_nonzero(best) else best
    for _ in range(3):
        if np.count_nonzero(best) < 3:
            return 0.0
        plane, *_ = np.linalg.lstsq(design[best], inverse[best], rcond=None)
        best = np.abs(design @ plane / inverse - 1.0) < _NEAR
    return float(np.mean(best))
