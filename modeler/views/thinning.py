"""Images of objects that cover more pixels than registration has use for: every few pixels are kept."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from modeler.types import Camera, Frame
from modeler.views.rays import Sensor


def thinned(frame: Frame, sensor: Sensor, step: int) -> tuple[Frame, Sensor]:
    """Return a frame at every `step`-th pixel in both directions, and its sensor.

    Depth is kept as measured, as means of pixels would bridge edges; colours are blurred as by means over `step` px.
    """
    if step == 1:
        return frame, sensor
    start = (step - 1) // 2  # the middle of a square of `step` px
    kept = (slice(start, None, step), slice(start, None, step))
    depth_m, camera = np.ascontiguousarray(frame.depth_m[kept]), frame.camera
    colour: npt.NDArray[np.uint8] | None = None
    if frame.colour is not None:
        sigma_px = math.sqrt((step**2 - 1) / 12.0)
        colour = np.empty_like(frame.colour)
        ndimage.gaussian_filter(frame.colour, (sigma_px, sigma_px, 0.0), output=colour, truncate=2.0)
        colour = np.ascontiguousarray(colour[kept])
    small = Frame(
        frame.index,
        frame.time_s,
        depth_m,
        Camera(
            depth_m.shape[1],
            depth_m.shape[0],
            camera.fx / step,
            camera.fy / step,
            (camera.cx - start) / step,
            (camera.cy - start) / step,
        ),
        None if frame.mask is None else np.ascontiguousarray(frame.mask[kept]),
        colour,
        None if frame.occluder is None else np.ascontiguousarray(frame.occluder[kept]),
    )
    noise = sensor.noise._replace(sigma_colour_px=sensor.noise.sigma_colour_px / step)
    return small, replace(sensor, noise=noise, noise_area_px=sensor.noise_area_px / step**2)
