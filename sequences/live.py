"""Live cameras: the sequence of frames of a running camera, and RealSense cameras."""

from __future__ import annotations

import importlib
import itertools
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
import numpy.typing as npt

from modeler.sequences.base import AbstractLive, AbstractSequence, span
from modeler.sequences.depth_files import metres
from modeler.sequences.intrinsics import Overrides
from modeler.sequences.lens import Lens, coefficients
from modeler.system.processes import install_command
from modeler.types import CALIBRATED_FOCAL, MULTIPATH, NOMINAL_FOCAL, Camera, Frame, InputError, SensorNoise

FIRST = 10
"""Number of frames taken before the sequence is described."""


MAX_REPEATS = 100
"""Largest number of repetitions of one image."""


Image = tuple[float, npt.NDArray[np.uint16], npt.NDArray[np.uint8] | None]
"""Time in s, raw depth (h, w), and colour (h, w, 3) of the depth camera's pixels, if there is any."""


@final
@dataclass(frozen=True, eq=False)
class RunningCamera:
    """A camera that a library runs."""

    name: str
    """Model of the camera."""
    lens: Lens
    """The camera whose pixels depth and colour are on."""
    unit_mm: float
    """Millimetres per unit of depth."""
    newest: Callable[[], Image | None]
    """Waits for an image; None if none comes."""
    stop: Callable[[], object]
    failures: tuple[type[Exception], ...]
    """What the library raises."""

    def take(self) -> Image:
        """Return the newest image; older ones are dropped."""
        try:
            image = self.newest()
        except self.failures as error:
            raise InputError(f"{self.name}: gives no image ({in_a_line(error)}); reconnect it.") from None
        if image is None:
            raise InputError(f"{self.name}: gives no image for {TIMEOUT_MS / 1000:g} s; reconnect it.")
        return image


def in_a_line(error: Exception) -> str:
    """Return what a library says."""
    return " ".join(str(error).split()) or type(error).__name__


@final
@dataclass(frozen=True)
class LiveSequence(AbstractLive):
    """Images of a running camera, taken on demand until `stop()` is true."""

    camera: RunningCamera
    seen: tuple[Frame, ...]
    """Its first frame."""
    by_maker: bool = True
    """Whether the intrinsics are the maker's, not the user's."""

    def sensor(self) -> SensorNoise:
        """Return what the camera's model says of its errors."""
        by_time_of_flight = any(name in self.camera.name for name in _TIME_OF_FLIGHT)
        return SensorNoise(
            sigma_r_m=None,
            sigma_focal=CALIBRATED_FOCAL if self.by_maker else NOMINAL_FOCAL,
            sigma_multipath=MULTIPATH["tof" if by_time_of_flight else "stereo"],
        )

    @property
    def name(self) -> str:
        return self.camera.name

    @property
    def indices(self) -> tuple[int, ...]:
        return tuple(frame.index for frame in self.seen)

    def recorded(self) -> AbstractSequence:
        return replace(self, stop=lambda: True)

    def frame(self, index: int) -> Frame:
        for frame in self.seen:
            if frame.index == index:
                return frame
        raise InputError(f"{self.name}: frame {index} is not kept; the first ones are {span(self.indices)}.")

    def __iter__(self) -> Iterator[Frame]:
        """Yield the first frames and then the current image on each request."""
        low, high = self.kept.start or 0, self.kept.stop
        frames = itertools.chain(self.seen, self._coming())
        yield from itertools.islice(frames, low, high, self.every)

    @property
    def layout(self) -> str:
        return "live camera"

    @property
    def depth_unit(self) -> str:
        return f"{self.camera.unit_mm:g} mm (the camera)"

    def _coming(self) -> Iterator[Frame]:
        last = self.seen[-1]
        while not self.stop():
            last = _next(self.camera, last.index + 1, last.time_s)
            yield last


def begin(camera: RunningCamera, first: int | None = None) -> LiveSequence:
    """Return the images of a camera from now on."""
    seen: list[Frame] = []
    for number in range(FIRST if first is None else first):
        seen.append(_next(camera, number, seen[-1].time_s if seen else None))
    return LiveSequence(camera, tuple(seen))


def _next(camera: RunningCamera, number: int, after_s: float | None) -> Frame:
    """Return the first image that is not the one of `after_s` again, as it may come with another colour image."""
    for _ in range(MAX_REPEATS):
        time_s, raw, colour = camera.take()
        if time_s != after_s:
            lens = camera.lens
            depth_m = lens.undistort(metres(raw, camera.unit_mm), float("nan"))
            return Frame(number, time_s, depth_m, lens.camera, None, None if colour is None else lens.undistort(colour))
    raise InputError(f"{camera.name}: gives the same image again and again; reconnect it.")


SCHEME = "realsense:"
"""Prefix of a path that selects a camera; its serial number may follow."""
ADVICE = f"a RealSense camera is read by its maker's library; {install_command('realsense')}"
WARM_UP = 30
"""Images after which exposure has settled."""
TIMEOUT_MS = 5000  # a camera that gives nothing for so long is gone
REACH_M = 16.0
"""Depth of a live camera beyond this is a measurement error; less fits 16 bits of a fine unit."""
_TIME_OF_FLIGHT = ("Azure Kinect", "Femto", "L515")
"""Names of models that measure so; others see structured light or stereo pairs."""


def open_camera(serial: str, overrides: Overrides, context: Any = None) -> LiveSequence:
    """Start a camera."""
    try:
        library = importlib.import_module("pyrealsense2")
    except ImportError:
        raise InputError(f"{SCHEME}{serial}: {ADVICE}.") from None
    camera = _started(library, serial, context)
    return opened(camera, overrides, WARM_UP if context is None else 0)


def opened(camera: RunningCamera, overrides: Overrides, warm_up: int = WARM_UP) -> LiveSequence:
    """Return the images of a camera that was started, which is stopped once it is forgotten."""
    if overrides.intrinsics is not None:
        size = camera.lens.camera.width, camera.lens.camera.height
        camera = replace(camera, lens=Lens(Camera(*size, *overrides.intrinsics), ()))
    if overrides.depth_scale_mm is not None:
        camera = replace(camera, unit_mm=overrides.depth_scale_mm)
    weakref.finalize(camera, camera.stop)
    for _ in range(warm_up):
        camera.take()
    return replace(begin(camera), by_maker=overrides.intrinsics is None)


def _check_present(rs: Any, context: Any, serial: str) -> None:
    """Refuse a camera that is not there, for which the library would wait long."""
    devices = list(context.query_devices())
    if not devices:
        raise InputError(f"{SCHEME.removesuffix(':')}: no camera is plugged in; connect one to a USB 3 port.")
    number = rs.camera_info.serial_number
    present = [device.get_info(number) for device in devices if device.supports(number)]
    if serial and serial not in present:
        raise InputError(f"{SCHEME}{serial}: no such camera is plugged in; there is {', '.join(present) or 'another'}.")


def _started(rs: Any, serial: str, context: Any) -> RunningCamera:
    """Start the RealSense camera with a serial number, or the only one."""
    try:
        context = rs.context() if context is None else context
        _check_present(rs, context, serial)
        pipeline, config = rs.pipeline(context), rs.config()
        if serial:
            config.enable_device(serial)
        config.enable_stream(rs.stream.depth)
        # With two arguments, the library would take the format for the number of a stream.
        config.enable_stream(rs.stream.color, rs.format.rgb8, 0)
        if not config.can_resolve(rs.pipeline_wrapper(pipeline)):
            config.disable_stream(rs.stream.color)  # some cameras have none
        profile = pipeline.start(config)
        device, align = profile.get_device(), rs.align(rs.stream.depth)  # brings colour to the depth camera's pixels
        found = profile.get_stream(rs.stream.depth).as_video_stream_profile().get_intrinsics()
        unit_mm = 1000.0 * device.first_depth_sensor().get_depth_scale()
        model = device.get_info(rs.camera_info.name) if device.supports(rs.camera_info.name) else "RealSense"
    except RuntimeError as error:
        raise InputError(f"{SCHEME}{serial}: cannot be started ({in_a_line(error)}); reconnect it.") from None

    def newest() -> Image:
        frames = align.process(pipeline.wait_for_frames(TIMEOUT_MS))
        depth, colour = frames.get_depth_frame(), frames.get_color_frame()
        raw = np.asanyarray(depth.get_data()).astype(np.uint16)
        image = np.array(colour.get_data(), dtype=np.uint8) if colour else None
        return float(depth.get_timestamp()) / 1000.0, raw, image

    camera = Camera(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy)
    lens = Lens(camera, coefficients(found.coeffs))
    return RunningCamera(model, lens, unit_mm, newest, pipeline.stop, (RuntimeError,))
