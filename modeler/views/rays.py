"""From a segmented frame to the image that registration uses: smoothed surface points, local planes, silhouette."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from modeler.kernels import planes
from modeler.significance import UNLIKELY
from modeler.types import BoolArray, Camera, Float32Array, Frame, Plane, RayImage, SensorNoise, checked
from modeler.views.range_noise import RangeNoise

ON_PLANE = 25.0  # measurements to which a plane is fitted; with fewer, errors of a laser are 1.2 to 3 times as large
_LEAST = 0.01  # least share; of fewer measurements no more than a few would be in reach of each other
_WIDE_PX = 10  # grids of measurements are no coarser


def measured_share(measured: BoolArray, within: BoolArray | None = None) -> float:
    """Return the share of measured pixels next to measured ones: about 1 where an image only has holes.

    Neighbours are the four adjacent pixels, or those up to 10 px away if gaps remain: measurements may form a grid.

    Args:
        measured: (h, w).
        within: (h, w) region, with all measured pixels, whose pixels count; None: the whole image.
    """
    both = either = 0
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both += 2 * np.count_nonzero(measured[one] & measured[other])
        if within is None:
            either += np.count_nonzero(measured[one]) + np.count_nonzero(measured[other])
        else:
            either += np.count_nonzero(measured[one] & within[other]) + np.count_nonzero(within[one] & measured[other])
    share = both / either if either else 1.0
    if gap_px(share) < 1.0:
        return share
    width, inside = 2 * _WIDE_PX + 1, np.ones_like(measured) if within is None else within
    seen, all_of = (
        width**2 * ndimage.uniform_filter(image.astype(np.float64), width, mode="constant")[measured].sum()
        - np.count_nonzero(measured)  # themselves
        for image in (measured, inside)
    )
    return float(seen / all_of)


def gap_px(share: float) -> float:
    """Return the radius in px of the largest gaps of random loss, for a share of measured pixels.

    A disc of n pixels holds no measurement with probability (1 - share)^n, which is `UNLIKELY`. Below 1 px there is
    nothing between measurements.
    """
    share = min(max(share, _LEAST), 1.0 - 1e-6)
    return float(np.sqrt(np.log(UNLIKELY) / (np.pi * np.log1p(-share))))


def nearest_depth(depth_m: Float32Array, measured: BoolArray, within: BoolArray, gap: float) -> Float32Array:
    """Return depth (h, w) in which pixels between measurements have that of the nearest; NaN where there is none.

    Args:
        depth_m: (h, w) in m.
        measured: (h, w) pixels whose depth counts.
        within: (h, w) pixels that may be filled.
        gap: largest distance in px to the nearest measurement.
    """
    filled = np.where(measured, depth_m, np.float32(np.nan))
    if not measured.any():
        return filled
    nearest = np.asarray(ndimage.distance_transform_edt(~measured, return_distances=False, return_indices=True))
    away_px = np.hypot(*(nearest - np.indices(measured.shape)))
    between = within & (away_px <= gap)
    filled[between] = depth_m[nearest[0][between], nearest[1][between]]
    return filled


def closed(measured: BoolArray, gap: float) -> BoolArray:
    """Return measured pixels (h, w) and those between them: their morphological closing by a disc.

    A pixel is left out if any of dozens of empty discs contains it: with 1.5 times the radius of
    `gap_px` the probability is below 1 % again.
    """
    if not measured.any():
        return measured
    near = np.asarray(ndimage.distance_transform_edt(~measured)) <= 1.5 * gap
    return near if near.all() else measured | (np.asarray(ndimage.distance_transform_edt(near)) > 1.5 * gap)


def interpolated(depth_m: Float32Array, camera: Camera) -> Float32Array:
    """Return depth (h, w) with pixels between measurements on planes of their neighbours; dense images are unchanged.

    Args:
        depth_m: (h, w) in m; not positive or NaN = no measurement.
        camera: the camera.
    """
    measured = np.isfinite(depth_m) & (depth_m > 0.0)
    share = max(measured_share(measured), _LEAST)
    gap = gap_px(share)
    if gap < 1.0:
        return depth_m
    between = closed(measured, gap)
    guess_m = nearest_depth(depth_m, measured, between, gap)
    reach_px = np.sqrt(ON_PLANE / (np.pi * share))
    radius_m = float(reach_px * np.median(depth_m[measured]) / camera.fx)
    ball = planes.Ball(radius_m, int(np.ceil(1.2 * reach_px)), 1, noise_m=0.0)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    nothing = np.zeros(depth_m.shape, dtype=np.float32)
    cells = planes.local_planes(guess_m, between, nothing, intrinsics, ball, 1e-6, measured)
    w, h = camera.rays()
    towards = -(cells[..., planes.NORMAL_X] * w + cells[..., planes.NORMAL_Y] * h + cells[..., planes.NORMAL_Z])
    on_plane = (cells[..., planes.KIND] == planes.SURFACE) & (towards > 0.0) & ~measured
    guess_m[on_plane] = cells[on_plane, planes.DISTANCE] / towards[on_plane]
    return guess_m


_KINECT = SensorNoise()
_ALIKE = 2.0  # areas of correlated noise that err alike: measured
_RIM_PX = 10.0  # distance from the silhouette at which errors there have fallen to 1/e: measured


@checked
@dataclass(frozen=True)
class Sensor:
    """A depth camera: its noise, how errors of pixels are alike, and how its images are smoothed."""

    noise: SensorNoise = _KINECT
    """Noise that the camera's makers state or a calibration has measured."""
    smoothing: float = 0.24
    """Radius of the ball in which planes are fitted, as a share of the geometric mean of noise and object's extent.

    The noise is that along the ray, or that of pixels of planes around the object if it is less.

    Smoothing over a ball of radius r displaces a surface whose radius of curvature is about the extent by r² / extent,
    away from the camera, so that the image of a turning object lags behind it. With this radius the displacement is the
    same share of the noise, whatever the noise (method, eq. 1.1).
    """
    min_neighbours: float = ON_PLANE
    """The ball grows until it holds about this many pixels of a surface that faces the camera."""
    noise_area_px: float = 12.5
    """Integral of the autocorrelation of the sensor's noise over the image in px: depth cameras compare windows.

    The default is that of noise smoothed over 1 px, as our renderer's. `measured` has that of a scene.
    """
    sigma_inverse_per_m: float = 0.0
    """Standard deviation of inverse depth in 1/m of the errors of smoothed surface; `measured` has that of a scene."""
    pixel_sigma_inverse_per_m: float = math.inf
    """The same of single pixels; infinite = unknown."""
    pattern_share: float = 0.0
    """Share of the variance of errors that is fixed-pattern noise: a pixel repeats it from frame to frame.

    Captures show 0.3 to 0.9; `measured` has that of a scene.
    """
    min_cosine: float = 0.35
    """Least cosine between normal and viewing ray: surface seen at a flatter angle, where noise grows (70°), gives no
    points."""
    max_silhouette_px: float = 60.0
    """Distance from the silhouette at which its transform is cut off: errors there have fallen to e⁻⁶."""

    def measured(self, noise: RangeNoise | None) -> Sensor:
        """Return the sensor with what a scene shows of how its errors are alike; None where it shows nothing."""
        if noise is None:
            return self
        share = self.pattern_share if noise.pattern_share is None else noise.pattern_share
        return replace(
            self,
            noise_area_px=noise.area_px,
            sigma_inverse_per_m=noise.sigma_inverse_per_m,
            pixel_sigma_inverse_per_m=noise.pixel_sigma_inverse_per_m,
            pattern_share=share,
        )

    def refocused(self, view: RayImage, log_factor: float) -> RayImage:
        """Return a view as it is under another focal length: x and y of every point shrink as it grows.

        Args:
            view: as this sensor made it.
            log_factor: logarithm of the other focal length over that of the view.
        """
        factor = math.exp(log_factor)
        return self.ray_image(_drawn_frame(view.frame, factor), view.plane and _drawn_plane(view.plane, factor))

    def ray_image(self, frame: Frame, plane: Plane | None = None) -> RayImage:
        """Make a segmented frame ready for registration; without object pixels it has no points.

        Args:
            frame: with its mask; without one, every measured pixel is the object's. Where an occluder is, nothing is
                known of the object.
            plane: the support plane, where one is seen.
        """
        frame = frame.unoccluded
        camera = frame.camera
        depth_m = np.ascontiguousarray(frame.depth_m, dtype=np.float32)
        seen = (depth_m > 0) & (depth_m < np.inf)  # not NaN either
        mask = seen if frame.mask is None else seen & frame.mask
        # Object pixels without depth still occlude: the silhouette is that of the whole mask.
        outline, surface = mask if frame.mask is None else frame.mask, mask
        window = _window(outline, 0)
        gap = gap_px(measured_share(mask[window], None if frame.mask is None else outline[window]))
        if gap >= 1.0:  # surface and background go on between measurements
            outline = closed(mask, gap) if frame.mask is None else outline
            window = _window(outline, math.ceil(self.max_silhouette_px))
            near_m, near, inside = depth_m[window], seen[window], outline[window]
            depth_m = depth_m.copy()
            depth_m[window] = np.where(
                inside,
                nearest_depth(near_m, near & inside, inside, gap),
                nearest_depth(near_m, near & ~inside, ~inside, gap),
            )
            surface = outline & (depth_m > 0)
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        middle_m = float(np.median(frame.depth_m[_places(mask)])) if mask.any() else 0.0
        sigma_r_m = self.noise.along_ray_m(middle_m)
        ball, sigma_inverse_per_m, (sharing, area_px) = self._smoothing(frame, mask, outline, sigma_r_m)
        # The object may go on behind what hides it, so its silhouette is known only beyond.
        covered = outline if frame.occluder is None else outline | frame.occluder
        silhouette = planes.silhouette_distance(covered, self.max_silhouette_px)
        window = _window(outline, 1)
        silhouette[window] = np.where(outline[window], rim_weights(outline[window]), silhouette[window])
        cells = planes.local_planes(
            depth_m,
            surface,
            silhouette,
            intrinsics,
            ball,
            sigma_inverse_per_m,
            None if surface is mask else mask,
        )
        if frame.occluder is not None:
            cells[frame.occluder, planes.KIND] = planes.RAGGED  # counts 0: it neither confirms nor contradicts
        points_m, normals, pixels, variance_m2 = planes.frontal_points(cells, surface, intrinsics, self.min_cosine)
        if surface is not mask:  # all measured pixels take part, and most points lie between them
            sharing *= max(len(points_m), 1) / max(np.count_nonzero(mask), 1)
        return RayImage(
            frame=frame,
            plane=plane,
            sigma_wh=self.noise.sigma_wh,
            sigma_r_m=sigma_r_m,
            sigma_colour_px=self.noise.sigma_colour_px,
            sigma_focal=self.noise.sigma_focal,
            sigma_multipath=self.noise.sigma_multipath,
            points_m=points_m,
            normals=normals,
            pixels=pixels,
            layers={"cells": cells, "variance_m2": variance_m2},
            sharing=sharing,
            error_area_px=area_px,
            range_noise_m=self.sigma_inverse_per_m * float(np.median(points_m[:, 2])) ** 2 if len(points_m) else 0.0,
            pattern_share=self.pattern_share,
        )

    def _smoothing(
        self, frame: Frame, measured: BoolArray, outline: BoolArray, sigma_r_m: float
    ) -> tuple[planes.Ball, float, tuple[float, float]]:
        """Return how an object is smoothed (method, eq. 1.1 and 1.2).

        Args:
            frame: with the depth.
            measured: (h, w) its measured pixels.
            outline: (h, w) all its pixels.
            sigma_r_m: noise along the ray.

        Returns:
            The ball; the least standard deviation of inverse depth (1/m); and the number of measured pixels that share
            the noise of one, with the area in px over which errors are alike.
        """
        rows, columns = _places(measured)
        if rows.size == 0:  # nothing to smooth
            return planes.Ball(0.0, 1, 1, 0.0), 0.0, (1.0, 1.0)
        depth_m = frame.depth_m[rows, columns]
        nearest_m, middle_m = (float(value) for value in np.percentile(depth_m, [2, 50]))
        metres_per_px = middle_m / frame.camera.fx
        extent_m = metres_per_px * float(np.hypot(np.ptp(rows), np.ptp(columns)))
        density = rows.size / float(outline.sum())
        sparse_px = np.sqrt(self.min_neighbours / (np.pi * max(density, 0.01)))
        # method, eq. 1.1; no more noise than stated, as unevenness of planes adds to theirs
        known = math.isfinite(self.pixel_sigma_inverse_per_m)
        pixel_m = self.pixel_sigma_inverse_per_m * middle_m**2 if known else sigma_r_m
        noise_m = min(pixel_m, sigma_r_m)
        radius_m = max(self.smoothing * np.sqrt(noise_m * extent_m), sparse_px * metres_per_px)
        reach_px = int(np.clip(np.ceil(radius_m * frame.camera.fx / nearest_m), 2, max(16, np.ceil(1.2 * sparse_px))))
        # A stride of 2 px is enough where a wide window holds many pixels.
        enough = np.pi * reach_px**2 * density > 8.0 * self.min_neighbours
        ball = planes.Ball(radius_m, reach_px, 2 if reach_px > 4 and enough else 1, pixel_m)
        # method, eq. 1.4
        ball_px = np.pi * (radius_m / metres_per_px) ** 2
        sharing = max(density * (ball_px + _ALIKE * self.noise_area_px), 1.0)
        # A tenth of the sensor's noise: neighbouring pixels err alike, so that residuals understate it.
        return ball, 0.1 * sigma_r_m / middle_m**2, (float(sharing), float(ball_px + self.noise_area_px))


def rim_weights(outline: BoolArray) -> np.ndarray:
    """Return the weights (h, w) float32, 0 to 1, of errors near the silhouette of an object (method, eq. 4.8).

    Args:
        outline: (h, w) bool, the object's pixels. The edge of the image is no silhouette.
    """
    inside_px = planes.silhouette_distance(~outline, 3.0 * _RIM_PX)
    return np.asarray(np.exp(-((inside_px / np.float32(_RIM_PX)) ** 2)), dtype=np.float32)


def _window(mask: BoolArray, margin: int) -> tuple[slice, slice]:
    """Return the rows and columns of an image that hold a mask (h, w) and a margin in px."""
    top, bottom, left, right = planes.bounds(mask)
    return slice(max(top - margin, 0), bottom + margin), slice(max(left - margin, 0), right + margin)


def _places(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns (n,) of the pixels that a mask (h, w) holds."""
    top, bottom, left, right = planes.bounds(mask)
    rows, columns = np.nonzero(mask[top:bottom, left:right])
    return rows + top, columns + left


def _drawn_frame(frame: Frame, factor: float) -> Frame:
    """Return the frame whose points have x and y divided by a factor: that of a longer focal length."""
    camera = frame.camera
    return replace(frame, camera=replace(camera, fx=camera.fx * factor, fy=camera.fy * factor))


def _drawn_plane(plane: Plane, factor: float) -> Plane:
    """Return the support plane whose points have x and y divided by a factor."""
    drawn = plane.normal * (factor, factor, 1.0)
    length = float(np.linalg.norm(drawn))
    return replace(plane, normal=drawn / length, offset_m=plane.offset_m / length)


def part_of(frame: Frame, rows: slice, columns: slice) -> Frame:
    """Return a frame at some rows and columns, both with the same step, of a camera that sees these alone."""
    rows, columns = (
        slice(*axis.indices(size)) for axis, size in zip((rows, columns), frame.depth_m.shape, strict=True)
    )
    kept, camera, step = (rows, columns), frame.camera, rows.step
    depth_m = np.ascontiguousarray(frame.depth_m[kept])
    part = Camera(
        depth_m.shape[1],
        depth_m.shape[0],
        camera.fx / step,
        camera.fy / step,
        (camera.cx - columns.start) / step,
        (camera.cy - rows.start) / step,
    )
    return replace(
        frame,
        depth_m=depth_m,
        camera=part,
        mask=None if frame.mask is None else np.ascontiguousarray(frame.mask[kept]),
        colour=None if frame.colour is None else np.ascontiguousarray(frame.colour[kept]),
        occluder=None if frame.occluder is None else np.ascontiguousarray(frame.occluder[kept]),
    )


def thinned(frame: Frame, sensor: Sensor, step: int) -> tuple[Frame, Sensor]:
    """Return a frame at every `step`-th pixel in both directions, and its sensor.

    Depth is kept as measured, as means of pixels would bridge edges; colours are blurred as by means over `step` px.
    """
    if step == 1:
        return frame, sensor
    if frame.colour is not None:
        sigma_px = math.sqrt((step**2 - 1) / 12.0)
        colour = np.empty_like(frame.colour)
        ndimage.gaussian_filter(frame.colour, (sigma_px, sigma_px, 0.0), output=colour, truncate=2.0)
        frame = replace(frame, colour=colour)
    kept = slice((step - 1) // 2, None, step)  # the middle of a square of `step` px
    noise = sensor.noise._replace(sigma_colour_px=sensor.noise.sigma_colour_px / step)
    return part_of(frame, kept, kept), replace(sensor, noise=noise, noise_area_px=sensor.noise_area_px / step**2)
