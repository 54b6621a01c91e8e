"""Frames, the views prepared from them for registration, and the poses of a robot's hand by time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass, field, replace
from functools import cached_property
from typing import Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.types.base import Array, BoolArray, InputError, Outcome, checked

Flip = Literal["", "mirrored", "upside down", "flipped top to bottom"]
FLIPS: Final[Mapping[Flip, tuple[float, float]]] = {
    "": (1.0, 1.0),
    "mirrored": (-1.0, 1.0),
    "upside down": (-1.0, -1.0),
    "flipped top to bottom": (1.0, -1.0),
}
"""Ways in which programs turn over colour against depth: -1 for left and right exchanged, and for top and bottom."""
_FARTHEST_M = 20.0  # that a depth camera for objects measures
_KINDS = {"f": "floating-point numbers", "b1": "bool", "u1": "8-bit integers"}


@checked
@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion; x right, y down, z forward."""

    width: int
    height: int
    fx: float
    """Focal length along x in px."""
    fy: float
    """Focal length along y in px."""
    cx: float
    """Column of the principal point in px; pixel centres lie at whole numbers."""
    cy: float
    """Row of the principal point in px."""

    def __post_init__(self) -> None:
        """Reject a camera that has no pixels or no focal length."""
        if not (self.width > 0 < self.height and self.fx > 0.0 < self.fy and np.isfinite(astuple(self)).all()):
            raise InputError(f"{self} is none; give a size in px, positive focal lengths and a principal point")

    @classmethod
    @checked
    def of(cls, intrinsics: Intrinsics, shape: tuple[int, ...]) -> Camera:
        """Return the camera of images of a shape (h, w); InputError if the intrinsics are invalid."""
        if isinstance(intrinsics, Camera):
            return intrinsics
        numbers = _numbers("camera", intrinsics).astype(np.float64)
        if numbers.shape == (3, 3):
            numbers = numbers[[0, 1, 0, 1], [0, 1, 2, 2]]
        if numbers.shape != (4,) or not np.isfinite(numbers).all() or not (numbers[:2] > 0.0).all():
            raise InputError("the intrinsics are invalid; give (fx, fy, cx, cy) in px, or the (3, 3) camera matrix")
        return cls(shape[1], shape[0], *(float(number) for number in numbers))

    def rays(self) -> tuple[Array, Array]:
        """Return w = x/z and h = y/z of every pixel, each (h, w)."""
        w = (np.arange(self.width, dtype=np.float64) - self.cx) / self.fx
        h = (np.arange(self.height, dtype=np.float64) - self.cy) / self.fy
        return np.broadcast_to(w, (self.height, self.width)), np.broadcast_to(h[:, None], (self.height, self.width))


Intrinsics = Camera | npt.ArrayLike  # a camera, `(fx, fy, cx, cy)` in px, or the (3, 3) camera matrix


@checked
@dataclass(frozen=True, eq=False)
class Frame:
    """One image of the depth camera. `Frame.of` makes one from arrays."""

    index: int
    """Number of the frame in its sequence."""
    time_s: float
    """Time of capture in s; the index where none is known."""
    depth_m: npt.NDArray[np.float32]
    """(h, w) distance along the optical axis; NaN = no measurement."""
    camera: Camera
    """Intrinsics of the depth image."""
    mask: BoolArray | None = None
    """(h, w) True = object; None = not segmented."""
    colour: npt.NDArray[np.uint8] | None = None
    """(h, w, 3) RGB aligned to depth."""
    occluder: BoolArray | None = None
    """(h, w) True where a hand or a gripper is marked, which may hide the object; None = none is."""

    def __post_init__(self) -> None:
        """Reject images of other shapes or types than the fields say: compiled functions read them unchecked."""
        shape = (self.camera.height, self.camera.width)
        for name, image, expected, kind in (
            ("depth", self.depth_m, shape, "f"),
            ("mask", self.mask, shape, "b1"),
            ("colour", self.colour, (*shape, 3), "u1"),
            ("occluder", self.occluder, shape, "b1"),
        ):
            if image is not None and not (image.shape == expected and image.dtype.str[1:].startswith(kind)):
                raise InputError(
                    f"frame {self.index}: {name} has shape {image.shape} of {image.dtype}, where its camera has "
                    f"{expected} of {_KINDS[kind]}; correct one of them"
                )

    @classmethod
    @checked
    def of(
        cls,
        depth_m: npt.ArrayLike,
        intrinsics: Intrinsics,
        index: int = 0,
        *,
        time_s: float | None = None,
        mask: npt.ArrayLike | None = None,
        colour: np.ndarray | None = None,
    ) -> Frame:
        """Return a frame of copies of arrays; InputError if an array cannot be used.

        Args:
            depth_m: (h, w) distance along the optical axis in m; 0, NaN or infinite where nothing was measured.
            intrinsics: a `Camera`, `(fx, fy, cx, cy)` in px, or the (3, 3) camera matrix.
            index: number of the frame; numbers ascend with time, by one for each step of a turntable.
            time_s: time of capture in s; None: the index.
            mask: (h, w) true on the object; None: not segmented.
            colour: (h, w, 3) 8-bit RGB, aligned to depth.
        """
        pixels = _numbers("depth image", depth_m).astype(np.float32)
        if pixels.ndim != 2 or not pixels.size:
            raise InputError(f"a depth image has shape {pixels.shape}; give an array (h, w)")
        pixels[~(pixels > 0.0) | np.isinf(pixels)] = np.nan
        if (measured := pixels[np.isfinite(pixels)]).size and measured.min() > _FARTHEST_M:
            raise InputError(f"depth is beyond {_FARTHEST_M:g} m everywhere; give it in m, not in mm")
        region = None if mask is None else _numbers("mask", mask)
        if region is not None and (region.shape != pixels.shape or np.isnan(region).any()):
            raise InputError(f"a mask holds NaN, or has another shape than depth's {pixels.shape}; correct it")
        if colour is not None and (np.shape(colour) != (*pixels.shape, 3) or np.asarray(colour).dtype != np.uint8):
            what = f"{np.shape(colour)} of {np.asarray(colour).dtype}"
            raise InputError(f"the colours have shape {what}; give 8-bit RGB of depth's {pixels.shape}")
        return cls(
            index,
            float(index) if time_s is None else time_s,
            pixels,
            Camera.of(intrinsics, pixels.shape),
            mask=None if region is None else region != 0,
            colour=None if colour is None else np.array(colour),
        )

    @property
    def unoccluded(self) -> Frame:
        """The frame without depth and object at occluders.

        Behind an occluder may be object or free space. All comparisons of views use this frame.
        """
        if self.occluder is None or not self.occluder.any():
            return self
        depth_m = np.where(self.occluder, np.float32(np.nan), self.depth_m)
        return replace(self, depth_m=depth_m, mask=None if self.mask is None else self.mask & ~self.occluder)


def _numbers(name: str, image: npt.ArrayLike) -> np.ndarray:
    """Return an image as an array of its own."""
    try:
        array = np.array(image)
    except ValueError as error:  # rows of different lengths
        raise InputError(f"a {name} is no array ({error}); give one of numbers") from None
    if array.dtype.kind not in "fiub":
        raise InputError(f"a {name} is of {array.dtype}; give real numbers")
    return array


@dataclass(frozen=True, eq=False)
class Plane:
    """A support plane in camera coordinates: normal · p + offset_m = 0."""

    normal: Array
    """(3,) unit, pointing to the side on which the camera and the object are."""
    offset_m: float
    """Distance of the camera from the plane, positive."""
    sigma_tilt_rad: float
    """Standard deviation of the normal's direction, about either axis in the plane."""
    sigma_offset_m: float
    """Standard deviation of the plane's distance below the object."""

    def height_m(self, points: Array) -> Array:
        """Return the height (n,) of points (n, 3) above the plane."""
        return points @ self.normal + self.offset_m


@dataclass(frozen=True, eq=False)
class Segmentation:
    """What of a frame is the object, and what it stands on."""

    mask: BoolArray
    """(h, w) True = object."""
    plane: Plane | None
    """The support plane, where one is seen."""
    outcome: Outcome
    """CONVERGED, or UNSURE_MASK / CUT_OFF / TOO_FEW_POINTS where a person should look."""


COLOUR_SHIFT_PX = 0.5
"""Default standard deviation of the shift of colours against depth from one image to the next.

Fitted with the pose to the pairs of three captures: 0.44 by column and 0.26 px by row (`cap`), 0.38 and 0.21
(`kleenex`, both a first Kinect), 0.5 and 0.4 (`bear`, a D435).
"""


NOMINAL_FOCAL = 0.02  # default standard deviation of the logarithm of a focal length: typical manufacturing tolerance
CALIBRATED_FOCAL = 0.005
"""The same where the camera was calibrated: by its maker, or by a program that wrote a file of its lens.

Focal lengths fitted to boards are good to some 0.002; the rest is for temperature and other distances.
"""
MULTIPATH = {"structured": 0.0, "stereo": 0.0, "laser": 0.0, "tof": 0.1}
"""`sigma_multipath` by the kind of a depth camera.

Measured on rendered time of flight beside a table: errors of a view, but for their mean, are 0.04 of the object's size
across, 0.10 along the height, 0.15 along the line of sight, and 0.09 beside these.
"""


_USUAL_NOISE = 0.003
"""Noise along the ray as a share of the distance, where it is unknown: depth cameras are built for their range. It is
the first Kinect's 2 mm at 0.7 m, where the captures that this was settled with stand."""


class SensorNoise(NamedTuple):
    """Noise of a depth camera in ray coordinates (paper, section II); the defaults are the first Kinect's."""

    sigma_wh: float = 0.002  # as in the paper
    """Lateral noise in (w, h)."""
    sigma_r_m: float | None = 0.002  # as in the paper
    """Noise along the ray in m, for a surface that faces the camera; None = unknown."""
    sigma_colour_px: float = COLOUR_SHIFT_PX
    """Shift of colours beside depth from one image to the next, in px: they are aligned so well at best, and may be
    taken at another moment."""
    sigma_focal: float = 0.0
    """Standard deviation of the logarithm of the focal length; 0 = it is exact."""
    sigma_multipath: float = 0.0
    """Standard deviation, as a share of the object's size, of errors of depth by light that reaches a surface by way of
    others, as time of flight has them: smooth, and alike in all views."""

    def along_ray_m(self, distance_m: float) -> float:
        """Return the noise along the ray at a distance, in m."""
        return _USUAL_NOISE * distance_m if self.sigma_r_m is None else self.sigma_r_m


@dataclass(frozen=True, eq=False)
class RayImage:
    """A segmented frame made ready for registration: what was seen, and where it was empty.

    Surface points are the object's pixels with a normal; they lie on the measured surface smoothed by local planes.
    """

    frame: Frame
    """The frame, with its mask."""
    plane: Plane | None
    """The support plane, where one is seen."""
    sigma_wh: float
    """Lateral noise of the sensor in ray coordinates (w, h)."""
    sigma_r_m: float
    """Noise of the sensor along the ray, for a surface that faces it."""
    points_m: Array
    """(n, 3) surface points in camera coordinates."""
    normals: Array
    """(n, 3) unit normals, towards the camera."""
    pixels: npt.NDArray[np.int64]
    """(n, 2) row and column of each point."""
    layers: Mapping[str, npt.NDArray[np.float64] | npt.NDArray[np.float32]] = field(default_factory=dict)
    """Images a likelihood looks up, made by `rays`."""
    sigma_colour_px: float = COLOUR_SHIFT_PX
    """Standard deviation in px of the shift of colours against depth from one image to the next."""
    sigma_focal: float = 0.0
    """Standard deviation of the logarithm of the camera's focal length."""
    sigma_multipath: float = 0.0
    """See `SensorNoise`."""
    sharing: float = 1.0
    """Number of surface points that share the noise of a pixel, in the sensor and by smoothing."""
    error_area_px: float = 1.0
    """Integral of the autocorrelation of the errors of surface points over the image in px."""
    range_noise_m: float = 0.0
    """Standard deviation of these errors along the ray, as planes around the object show it; 0 = unknown."""
    pattern_share: float = 0.0
    """Share of the variance of these errors that is fixed-pattern noise: a pixel repeats it from frame to frame."""
    rendered: bool = False
    """Whether it shows a model, not a photograph: then nothing of its colours stays in place because of lights."""

    @property
    def index(self) -> int:
        """Number of the frame in its sequence."""
        return self.frame.index

    @property
    def patches(self) -> float:
        """Number of patches of the surface whose errors have nothing to do with each other."""
        return len(self.points_m) / self.sharing

    @cached_property
    def along_curve(self) -> npt.NDArray[np.int64]:
        """Numbers (n,) of the surface points in the order of a curve that fills the image square by square (Morton)."""
        code = np.zeros(len(self.pixels), dtype=np.int64)
        for bit in range(int(self.pixels.max(initial=0)).bit_length()):
            for axis in (0, 1):
                code |= (self.pixels[:, axis] >> bit & 1) << (2 * bit + axis)
        return np.argsort(code, kind="stable")

    @cached_property
    def numbers(self) -> npt.NDArray[np.int32]:
        """Number (h, w) of the surface point at each pixel; n, one beyond the last, for none."""
        found = np.full(self.frame.depth_m.shape, len(self.pixels), dtype=np.int32)
        found[self.pixels[:, 0], self.pixels[:, 1]] = np.arange(len(self.pixels))
        return found

    @cached_property
    def measured_share(self) -> float:
        """Fraction (0..1) of measured pixels around the surface points: low for very sparse images.

        Pixels of occluders are left out.
        """
        rows, columns = self.pixels[:: max(len(self.pixels) // 500, 1)].T
        height, width = self.frame.depth_m.shape
        steps = np.arange(-2, 3)
        near_rows = np.clip(rows[:, None, None] + steps[:, None], 0, height - 1)
        near_columns = np.clip(columns[:, None, None] + steps, 0, width - 1)
        measured = self.frame.depth_m[near_rows, near_columns] > 0
        if self.frame.occluder is None:
            return float(np.mean(measured))
        return float(np.mean(measured[~self.frame.occluder[near_rows, near_columns]]))

    @cached_property
    def centroid_m(self) -> Array:
        """Mean (3,) of the surface points; the origin where there are none."""
        return np.array([axis_m.mean() for axis_m in self.points_m.T]) if len(self.points_m) else np.zeros(3)

    @property
    def multipath_m(self) -> float:
        """Standard deviation in m of smooth errors of depth."""
        return self.sigma_multipath * self.size_m

    @cached_property
    def size_m(self) -> float:
        """Root mean square distance in m of the surface points from their centroid; 0 where there are none."""
        return float(np.sqrt(np.sum((self.points_m - self.centroid_m) ** 2) / max(len(self.points_m), 1)))


_SAME_TIME_S = 1e-3  # largest time difference of simultaneous poses and frames


@dataclass(frozen=True, eq=False)
class HandPoses:
    """The poses of a hand by time, interpolated in between."""

    times_s: Array = field(repr=False)
    """(n,) increasing, on the clock of the frames."""
    camera_from_hand: Array = field(repr=False)
    """(n, 4, 4) poses of the hand in camera coordinates."""
    max_gap_s: float = 1.0
    """Poses farther apart in time than this are not interpolated."""
    name: str = "the hand's trajectory"
    """Source of the poses, for messages."""

    def at(self, frame: Frame) -> tuple[Array, Array]:
        """Return the hand's pose (4, 4) at a frame, and its standard deviation (2,) from interpolation: rad, m.

        Raises:
            InputError: if there are no poses near enough in time.
        """
        after = int(np.searchsorted(self.times_s, frame.time_s))
        for number in (after - 1, after):
            if 0 <= number < len(self.times_s) and abs(self.times_s[number] - frame.time_s) <= _SAME_TIME_S:
                return self.camera_from_hand[number], np.zeros(2)
        if not 0 < after < len(self.times_s):
            raise InputError(
                f"{self.name}: has no pose for frame {frame.index} at {frame.time_s:g} s, its times are "
                f"{self.times_s[0]:g} to {self.times_s[-1]:g} s; leave the frame out or complete the file"
            )
        gap_s = float(self.times_s[after] - self.times_s[after - 1])
        if gap_s > self.max_gap_s + _SAME_TIME_S:
            raise InputError(
                f"{self.name}: has no pose for frame {frame.index} at {frame.time_s:g} s, those around it are "
                f"{gap_s:g} s apart; complete the file, or allow larger gaps (max_gap_s)"
            )
        before, behind = self.camera_from_hand[after - 1], self.camera_from_hand[after]
        share = (frame.time_s - self.times_s[after - 1]) / gap_s
        way = se3.log(se3.inverse(before) @ behind)
        # At the middle, the standard deviation is a quarter of the way, for a hand with uneven speed.
        error = share * (1.0 - share) * np.array([np.linalg.norm(way[:3]), np.linalg.norm(way[3:])])
        return before @ se3.exp(share * way), error
