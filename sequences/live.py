"""Live cameras: the sequence of frames of a running camera, and cameras of RealSense, Orbbec, OAK and Azure."""

from __future__ import annotations

import importlib
import itertools
import weakref
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from modeler.sequences.base import AbstractLive, AbstractSequence, span
from modeler.sequences.image_files import metres
from modeler.sequences.intrinsics import Overrides
from modeler.sequences.lens import Lens, coefficients
from modeler.system.processes import install_command
from modeler.types import CALIBRATED_FOCAL, MULTIPATH, NOMINAL_FOCAL, Camera, Frame, InputError, SensorNoise

FIRST = 10  # number of frames taken before the sequence is described


Image = tuple[float, npt.NDArray[np.uint16], npt.NDArray[np.uint8] | None]
"""Time in s, raw depth (h, w), and colour (h, w, 3) of the depth camera's pixels, if there is any."""


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
    failures: tuple[type[Exception], ...] = (RuntimeError,)
    """What the library raises."""

    def take(self) -> Image:
        """Return the newest image; older ones are dropped."""
        try:
            image = self.newest()
        except self.failures as error:
            raise InputError(f"{self.name}: gives no image ({_in_a_line(error)}); reconnect it.") from None
        if image is None:
            raise _silent(self.name)
        return image


def _in_a_line(error: Exception) -> str:
    """Return what a library says."""
    return " ".join(str(error).split()) or type(error).__name__


def _silent(name: str) -> InputError:
    """Return the error for a camera that gives nothing."""
    return InputError(f"{name}: gives no image for {TIMEOUT_MS / 1000:g} s; reconnect it.")


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
    for _ in range(100):
        time_s, raw, colour = camera.take()
        if time_s != after_s:
            lens = camera.lens
            depth_m = lens.undistort(metres(raw, camera.unit_mm), float("nan"))
            return Frame(number, time_s, depth_m, lens.camera, None, None if colour is None else lens.undistort(colour))
    raise InputError(f"{camera.name}: gives the same image again and again; reconnect it.")


TIMEOUT_MS = 5000  # a camera that gives nothing for so long is gone
REACH_M = 16.0  # depth of a live camera beyond this is a measurement error; less fits 16 bits of a fine unit
_TIME_OF_FLIGHT = ("Azure Kinect", "Femto", "L515")
"""Names of models that measure so; others see structured light or stereo pairs."""


def opened(camera: RunningCamera, overrides: Overrides, warm_up: int = 30) -> LiveSequence:
    """Return the images of a started camera but the first, until exposure settles; once forgotten, it is stopped."""
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
        raise InputError("realsense: no camera is plugged in; connect one to a USB 3 port.")
    number = rs.camera_info.serial_number
    present = [device.get_info(number) for device in devices if device.supports(number)]
    if serial and serial not in present:
        raise InputError(
            f"realsense:{serial}: no such camera is plugged in; there is {', '.join(present) or 'another'}."
        )


def realsense(rs: Any, serial: str, context: Any = None) -> RunningCamera:
    """Start the RealSense camera with a serial number, or the only one."""
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

    def newest() -> Image:
        frames = align.process(pipeline.wait_for_frames(TIMEOUT_MS))
        depth, colour = frames.get_depth_frame(), frames.get_color_frame()
        raw = np.asanyarray(depth.get_data()).astype(np.uint16)
        image = np.array(colour.get_data(), dtype=np.uint8) if colour else None
        return float(depth.get_timestamp()) / 1000.0, raw, image

    camera = Camera(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy)
    lens = Lens(camera, coefficients(found.coeffs))
    return RunningCamera(model, lens, unit_mm, newest, pipeline.stop)


_OAK_PX: Final = (640, 400)  # width and height of depth and colour: stereo of all models gives as many


def orbbec(ob: Any, serial: str) -> RunningCamera:
    """Start an Orbbec camera."""
    devices = ob.Context().query_devices()
    if not devices.get_count():
        raise InputError(f"orbbec:{serial}: no camera is plugged in; connect one to a USB 3 port.")
    device = devices.get_device_by_serial_number(serial) if serial else devices.get_device_by_index(0)
    pipeline, config = ob.Pipeline(device), ob.Config()
    depth, colour = ob.OBSensorType.DEPTH_SENSOR, ob.OBSensorType.COLOR_SENSOR
    config.enable_stream(pipeline.get_stream_profile_list(depth).get_default_video_stream_profile())
    config.enable_stream(pipeline.get_stream_profile_list(colour).get_video_stream_profile(0, 0, ob.OBFormat.RGB, 0))
    config.set_frame_aggregate_output_mode(ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE)
    pipeline.start(config)
    aligned = ob.AlignFilter(ob.OBStreamType.DEPTH_STREAM)  # brings colour to the depth camera's pixels

    def newest() -> Image | None:
        frames = pipeline.wait_for_frames(TIMEOUT_MS)
        frames = None if frames is None else aligned.process(frames)
        if frames is None:
            return None
        frames = frames.as_frame_set()
        depth, colour = frames.get_depth_frame(), frames.get_color_frame()
        raw = np.frombuffer(depth.get_data(), np.uint16).reshape(depth.get_height(), depth.get_width())
        image = None if colour is None else np.array(colour.get_data(), np.uint8).reshape(*raw.shape, 3)
        return depth.get_timestamp_us() / 1e6, raw.copy(), image

    frames = pipeline.wait_for_frames(TIMEOUT_MS)
    if frames is None:
        raise _silent(f"orbbec:{serial}")
    first = frames.get_depth_frame()
    profile = first.get_stream_profile().as_video_stream_profile()
    intrinsic, bent = profile.get_intrinsic(), profile.get_distortion()
    camera = Camera(intrinsic.width, intrinsic.height, intrinsic.fx, intrinsic.fy, intrinsic.cx, intrinsic.cy)
    fisheye = bent.model == ob.OBCameraDistortionModel.KANNALA_BRANDT4
    brown = (bent.k1, bent.k2, bent.p1, bent.p2, bent.k3, bent.k4, bent.k5, bent.k6)
    lens = Lens(camera, (bent.k1, bent.k2, bent.k3, bent.k4) if fisheye else brown, fisheye)
    model = f"Orbbec {device.get_device_info().get_name().removeprefix('Orbbec ')}"
    return RunningCamera(model, lens, float(first.get_depth_scale()), newest, pipeline.stop)


def oak(dai: Any, serial: str) -> RunningCamera:
    """Start an OAK camera, with depth on the pixels of its colour camera, from whose images the lens is taken out."""
    device = dai.Device(serial) if serial else dai.Device()
    pipeline, sockets = dai.Pipeline(device), dai.CameraBoardSocket
    cameras = [
        pipeline.create(dai.node.Camera).build(socket) for socket in (sockets.CAM_A, sockets.CAM_B, sockets.CAM_C)
    ]
    colour = cameras[0].requestOutput(_OAK_PX, dai.ImgFrame.Type.RGB888i, enableUndistortion=True)
    sides = [camera.requestOutput(_OAK_PX) for camera in cameras[1:]]
    stereo = pipeline.create(dai.node.StereoDepth).build(*sides)
    together = pipeline.create(dai.node.Sync)
    if device.getPlatform() == dai.Platform.RVC4:
        aligned = pipeline.create(dai.node.ImageAlign)
        stereo.depth.link(aligned.input)
        colour.link(aligned.inputAlignTo)
        aligned.outputAligned.link(together.inputs["depth"])
    else:
        colour.link(stereo.inputAlignTo)
        stereo.depth.link(together.inputs["depth"])
    colour.link(together.inputs["colour"])
    queue = together.out.createOutputQueue(maxSize=1, blocking=False)
    pipeline.start()
    limit = timedelta(milliseconds=TIMEOUT_MS)

    def newest() -> Image | None:
        if (both := queue.get(limit)) is None:
            return None
        depth, image = both["depth"], both["colour"].getFrame()
        return (
            depth.getTimestamp().total_seconds(),
            np.array(depth.getFrame(), np.uint16),
            np.array(image, np.uint8),
        )

    if (both := queue.get(limit)) is None:
        raise _silent(f"oak:{serial}")
    first = both["depth"]
    height, width = first.getFrame().shape
    (fx, _, cx), (_, fy, cy), _ = first.getTransformation().getIntrinsicMatrix()
    lens = Lens(Camera(width, height, fx, fy, cx, cy), ())
    return RunningCamera(str(device.getProductName()), lens, 1.0, newest, pipeline.stop)


def azure(k4a: Any, serial: str) -> RunningCamera:
    """Start an Azure Kinect, or with Orbbec's library in place of Microsoft's a Femto."""
    present = []
    for number in range(k4a.connected_device_count()):
        device = k4a.PyK4A(k4a.Config(), device_id=number)
        device.open()
        present.append(device.serial)
        if not serial or device.serial == serial:
            break
        device.close()
    else:
        there = f"there is {', '.join(present)}" if present else "connect one to a USB 3 port"
        raise InputError(f"azure:{serial}: no such camera is plugged in; {there}.")
    device.start()

    def newest() -> Image:
        capture = device.get_capture(TIMEOUT_MS)
        colour = capture.transformed_color  # in the depth camera's pixels, BGRA
        return (
            capture.depth_timestamp_usec / 1e6,
            np.array(capture.depth, np.uint16),
            None if colour is None else np.ascontiguousarray(colour[..., 2::-1]),
        )

    height, width = device.get_capture(TIMEOUT_MS).depth.shape
    kind = k4a.CalibrationType.DEPTH
    matrix = device.calibration.get_camera_matrix(kind)
    camera = Camera(width, height, *(float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))))
    lens = Lens(camera, tuple(map(float, device.calibration.get_distortion_coefficients(kind))))
    return RunningCamera(f"Azure Kinect {device.serial}", lens, 1.0, newest, device.stop)


LIBRARIES: Final[Mapping[str, tuple[str, Callable[[Any, str], RunningCamera], tuple[str, ...]]]] = {
    "realsense": ("pyrealsense2", realsense, ()),
    "orbbec": ("pyorbbecsdk", orbbec, ("OBError",)),
    "oak": ("depthai", oak, ()),
    "azure": ("pyk4a", azure, ("K4AException",)),
}
"""What stands before the colon of a path, and the extra that installs it: the library, what starts a camera, and what
the library raises besides RuntimeError."""


def open_camera(maker: str, serial: str, overrides: Overrides) -> LiveSequence:
    """Start a camera."""
    module, start, raised = LIBRARIES[maker]
    try:
        library = importlib.import_module(module)
    except ImportError:
        raise InputError(
            f"{maker}:{serial}: a camera of this kind is read by its maker's library; {install_command(maker)}."
        ) from None
    failures = (RuntimeError, *(getattr(library, name) for name in raised))
    try:
        camera = start(library, serial)
    except failures as error:
        raise InputError(f"{maker}:{serial}: cannot be started ({_in_a_line(error)}); reconnect it.") from None
    return opened(replace(camera, failures=failures), overrides)
