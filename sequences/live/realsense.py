"""A RealSense camera that is plugged in, by its maker's library."""

from __future__ import annotations

import importlib
import weakref
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import numpy.typing as npt

from modeler.types import Camera, InputError
from sequences.given import Given
from sequences.lens import Lens, coefficients
from sequences.live.sequence import AbstractCamera, LiveSequence, begin

SCHEME = "realsense:"
"""What a path begins with that means a camera; its serial number may follow."""
ADVICE = "a RealSense camera is read by its maker's library; pip install 'modeler[realsense]'"
WARM_UP = 30
"""Images after which exposure has settled."""
PATIENCE_MS = 5000


def open_camera(serial: str, given: Given, context: Any = None) -> LiveSequence:
    """Start a camera.

    Args:
        serial: its serial number; empty for the only one.
        given: what counts more than what the camera says.
        context: where to look for cameras; everywhere without it.

    Raises:
        InputError: where the library is not installed, or no such camera gives images.
    """
    try:
        library = importlib.import_module("pyrealsense2")
    except ImportError:
        raise InputError(f"{SCHEME}{serial}: {ADVICE}.") from None
    camera = RealsenseCamera.start(library, serial, given, context)
    for _ in range(WARM_UP if context is None else 0):
        camera.take()
    return begin(camera)


def _check_present(rs: Any, context: Any, serial: str) -> None:
    """Refuse a camera that is not there, for which the library would wait long."""
    devices = list(context.query_devices())
    if not devices:
        raise InputError(f"{SCHEME.removesuffix(':')}: no camera is plugged in; connect one to a USB 3 port.")
    number = rs.camera_info.serial_number
    present = [device.get_info(number) for device in devices if device.supports(number)]
    if serial and serial not in present:
        raise InputError(f"{SCHEME}{serial}: no such camera is plugged in; there is {', '.join(present) or 'another'}.")


@final
@dataclass(frozen=True, eq=False)
class RealsenseCamera(AbstractCamera):
    """A camera that streams depth and colour."""

    pipeline: Any
    """Gives the images."""
    align: Any
    """Brings colour to the depth camera's pixels."""
    model: str
    """What the camera is."""
    depth: Lens
    """The depth camera."""
    scale_mm: float
    """Millimetres per unit."""

    @classmethod
    def start(cls, rs: Any, serial: str, given: Given, context: Any) -> RealsenseCamera:
        """Start the camera with a serial number, or the only one.

        Args:
            rs: the library.
            serial: may be empty.
            given: what counts more than what the camera says.
            context: where to look for cameras; None for everywhere.

        Raises:
            InputError: where it cannot be started.
        """
        where = f"{SCHEME}{serial}"
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
            device = profile.get_device()
            stream = profile.get_stream(rs.stream.depth).as_video_stream_profile()
            intrinsics = stream.get_intrinsics()
            unit_mm = 1000.0 * device.first_depth_sensor().get_depth_scale()
            model = device.get_info(rs.camera_info.name) if device.supports(rs.camera_info.name) else "RealSense"
        except RuntimeError as error:
            raise InputError(f"{where}: cannot be started ({' '.join(str(error).split())}); plug it in anew.") from None
        found = (intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy)
        camera = Camera(intrinsics.width, intrinsics.height, *(given.intrinsics or found))
        bend = () if given.intrinsics else coefficients(intrinsics.coeffs)
        scale_mm = unit_mm if given.depth_scale_mm is None else given.depth_scale_mm
        running = cls(pipeline, rs.align(rs.stream.depth), model, Lens(camera, bend), scale_mm)
        weakref.finalize(running, pipeline.stop)
        return running

    @property
    def name(self) -> str:
        """What it is called."""
        return self.model

    @property
    def lens(self) -> Lens:
        """The depth camera."""
        return self.depth

    @property
    def unit_mm(self) -> float:
        """Millimetres per unit of depth."""
        return self.scale_mm

    def take(self) -> tuple[float, npt.NDArray[np.uint16], npt.NDArray[np.uint8] | None]:
        """Return the newest image; older ones that nobody asked for are lost."""
        try:
            frames = self.align.process(self.pipeline.wait_for_frames(PATIENCE_MS))
            depth, colour = frames.get_depth_frame(), frames.get_color_frame()
            raw = np.asanyarray(depth.get_data()).astype(np.uint16)
            picture = np.array(colour.get_data(), dtype=np.uint8) if colour else None
            return float(depth.get_timestamp()) / 1000.0, raw, picture
        except RuntimeError as error:
            raise InputError(
                f"{self.model}: gives no image ({' '.join(str(error).split())}); plug it in anew."
            ) from None
