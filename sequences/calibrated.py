"""Sequences as corrected: noise, focal length and depth scale of a calibration, and depth that is along the ray."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from math import isfinite
from pathlib import Path
from typing import Final, Literal

import numpy as np

from modeler.sequences.base import AbstractDerived
from modeler.sequences.input_files import build, read_tree
from modeler.types import NOMINAL_FOCAL, Array, Camera, Frame, InputError, SensorNoise


@dataclass(frozen=True)
class NoiseModel:
    """Noise across and along the ray.

    Across, pixels err by a share of themselves, so that noise in (w, h) depends neither on distance nor on angle. Along
    the ray, triangulating cameras err by z², more on slopes: the variance is
    floor² + z⁴ (c0 + c1 q + c2 q²) with q = (θ / (π/2 - θ))², a form that Nguyen, Izadi & Lovell (2012) found.
    """

    lateral_px: float
    """Standard deviation across the ray, along either axis, in px."""
    focal_px: float
    """Focal length of the camera that was measured."""
    floor_m: float
    """Standard deviation along the ray that does not depend on distance."""
    growth: tuple[float, float, float]
    """c0, c1, c2 in m⁻²."""

    def sigma_wh(self) -> float:
        """Return the standard deviation in (w, h)."""
        return self.lateral_px / self.focal_px

    def sigma_r_m(self, distance_m: Array | float, angle_rad: Array | float = 0.0) -> Array:
        """Return the standard deviation along the ray in m, of any shape.

        Args:
            distance_m: along the optical axis.
            angle_rad: between the ray and the normal of the surface.
        """
        columns = slope_terms(np.asarray(distance_m, np.float64), np.asarray(angle_rad, np.float64))
        return np.sqrt(columns @ np.array([self.floor_m**2, *self.growth]))

    def at(self, distance_m: float) -> tuple[float, float]:
        """Return `(sigma_wh, sigma_r_m)` for a surface that faces the camera."""
        return self.sigma_wh(), float(self.sigma_r_m(distance_m))


def slope_terms(distance_m: Array, angle_rad: Array) -> Array:
    """Return the regressors (..., 4) of the variance along the ray: 1, z⁴, z⁴ q, z⁴ q²."""
    angle = np.minimum(np.abs(angle_rad), np.radians(85.0))  # beyond, the noise would grow without bounds
    slope = (angle / (0.5 * np.pi - angle)) ** 2
    fourth, slope = np.broadcast_arrays(np.asarray(distance_m) ** 4, slope)
    return np.stack([np.ones_like(fourth), fourth, fourth * slope, fourth * slope**2], axis=-1)


def read_noise(path: Path) -> NoiseModel:
    """Read a model that `modeler calibrate-sensor` has stored.

    Raises:
        InputError: if it is missing or says something else.
    """
    node = read_tree(path).need("noise")
    model = build(NoiseModel, node)
    in_pixels = 1e-6 <= model.lateral_px <= 1e3 and 1.0 <= model.focal_px <= 1e6
    if not in_pixels or not all(0.0 <= number <= 1.0 for number in (model.floor_m, *model.growth)):
        raise node.fault("of positive lateral_px and focal_px, and floor_m and growth from 0 to 1")
    return model


def noise_text(model: NoiseModel, facts: Mapping[str, object]) -> str:
    """Return the file of a model: with the noise at the distance where it was measured, and further facts."""
    return json.dumps({**facts, "noise": asdict(model)}, indent=1, allow_nan=False) + "\n"


def object_distance_m(frame: Frame) -> float:
    """Return the approximate distance of the object: the median in its mask, or the nearest quartile of a scene."""
    measured = np.isfinite(frame.depth_m) & (frame.depth_m > 0.0)
    inside = measured if frame.mask is None else measured & frame.mask
    share = 25.0 if frame.mask is None else 50.0
    return float(np.percentile(frame.depth_m[inside], share)) if inside.any() else 1.0


@dataclass(frozen=True)
class CalibratedSequence(AbstractDerived):
    """Another sequence, of a camera with this noise."""

    noise: NoiseModel

    def sensor(self) -> SensorNoise:
        """Return the noise at the distance of the object in the first frame."""
        said = self.whole.sensor()
        sigma_wh, sigma_r_m = self._at_object
        known = SensorNoise(sigma_focal=NOMINAL_FOCAL) if said is None else said
        return known._replace(sigma_wh=sigma_wh, sigma_r_m=sigma_r_m)

    def select(self, every: int = 1, frames: slice | None = None) -> CalibratedSequence:
        return replace(self, whole=self.whole.select(every, frames))

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.whole)

    @cached_property
    def _at_object(self) -> tuple[float, float]:
        return self.noise.at(object_distance_m(self.whole.frame(self.whole.indices[0])))


def has_focal(frame: Frame, stated_px: float) -> bool:
    """Return whether the focal length of a frame is the stated one of a camera; files have rounded values."""
    return abs(frame.camera.fx / stated_px - 1.0) <= 1e-3


@dataclass(frozen=True)
class FocalFactor:
    """The focal length and the depth scale of a camera, relative to those in its sequences."""

    factor: float
    """True focal length relative to the given one, the same for fx and fy."""
    stated_px: float
    """Given fx of the sequence."""
    depth_scale: float = 1.0
    """True depth relative to the given one: scales the model and the distances of its poses alike."""
    depth_scale_sigma: float = 0.0
    """Standard deviation of the depth scale's logarithm; 0 = known, or not asked about."""
    factor_sigma: float = 0.0
    """Standard deviation of the factor's logarithm; 0 = not estimated."""
    determined_by: Literal["loop", "prior"] = "prior"
    """Whether loops determined the factor."""

    def values(self) -> dict[str, float | str]:
        """Return its values, under the names of its file and of report.json."""
        return {
            "focal_factor": self.factor,
            "focal_factor_sigma": self.factor_sigma,
            "depth_scale": self.depth_scale,
            "depth_scale_sigma": self.depth_scale_sigma,
            "told_by": self.determined_by,
        }

    def text(self, facts: Mapping[str, object]) -> str:
        """Return the file of the factor, with further values; null for unknown numbers."""
        said = {"schema": 1, "stated_fx_px": self.stated_px, **self.values()}
        known = {name: None if isinstance(fact, float) and not isfinite(fact) else fact for name, fact in facts.items()}
        return json.dumps(said | known, indent=1, allow_nan=False) + "\n"


def read_focal_factor(path: Path) -> FocalFactor:
    """Read a factor that `modeler calibrate-camera` has stored.

    Raises:
        InputError: if the file is missing or says something else.
    """
    node = read_tree(path)
    return FocalFactor(
        node.need("focal_factor").number(0.5, 2.0),
        node.need("stated_fx_px").number(1.0, 1e6),
        1.0 if (scale := node.get("depth_scale")) is None else scale.number(0.5, 2.0),
        0.0 if (sigma := node.get("depth_scale_sigma")) is None else sigma.number(0.0, 1.0),
        0.0 if (error := node.get("focal_factor_sigma")) is None else error.number(0.0, 1.0),
        "loop" if (teller := node.get("told_by")) is not None and teller.text() == "loop" else "prior",
    )


@dataclass(frozen=True)
class RefocusedSequence(AbstractDerived):
    """Another sequence, whose camera has this focal length and depth scale."""

    focal: FocalFactor

    def sensor(self) -> SensorNoise | None:
        """Return the noise of its camera, with the uncertainty of its focal length; None if unknown."""
        noise = self.whole.sensor()
        if self.focal.determined_by != "loop" or self.focal.factor_sigma == 0.0:
            return noise
        return (SensorNoise(sigma_r_m=None) if noise is None else noise)._replace(sigma_focal=self.focal.factor_sigma)

    def frame(self, index: int) -> Frame:
        return self._refocused(self.whole.frame(index))

    def __iter__(self) -> Iterator[Frame]:
        return map(self._refocused, self.whole)

    def select(self, every: int = 1, frames: slice | None = None) -> RefocusedSequence:
        return replace(self, whole=self.whole.select(every, frames))

    def _refocused(self, frame: Frame) -> Frame:
        camera, focal = frame.camera, self.focal
        if not has_focal(frame, focal.stated_px):
            raise InputError(
                f"{self.name}: frame {frame.index} has fx {camera.fx:g} px where the calibrated camera has "
                f"{focal.stated_px:g}; give the calibration of this camera"
            )
        refocused = replace(camera, fx=camera.fx * focal.factor, fy=camera.fy * focal.factor)
        return replace(frame, camera=refocused, depth_m=frame.depth_m * np.float32(focal.depth_scale))


def stretch(camera: Camera) -> Array:
    """Return the distance along the ray of depth 1, (h, w): the square root of 1 + w² + h²."""
    w, h = camera.rays()
    return np.sqrt(1.0 + w**2 + h**2)


@dataclass(frozen=True)
class AxialSequence(AbstractDerived):
    """Another sequence, whose depth is the distance along the ray, with depth along the optical axis."""

    def frame(self, index: int) -> Frame:
        frame = self.whole.frame(index)
        return replace(frame, depth_m=(frame.depth_m / stretch(frame.camera)).astype(np.float32))

    @property
    def notes(self) -> tuple[str, ...]:
        return (*self.whole.notes, "depth is taken for the distance along the ray (`along_ray`)")


_POINTS: Final = 4000  # of a frame: shares are then known to 1 %
_NEAR: Final = 0.008  # relative residual of a plane; cameras measure 0.5 m and 2 m to half of that


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
    if len(places) < 500:  # fewer tell of no plane
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
    # So many triples find a plane with a third of all points with a probability of 99.6 %.
    for three in rng.integers(0, len(w), (150, 3)):
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
