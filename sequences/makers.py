"""Cameras of other makers, each by its maker's library: Orbbec (Femto, Gemini, Astra), OAK, and the Azure Kinect.

A function starts a camera and returns what takes its images; `live` does the rest. docs/cameras.md says how to add one.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from datetime import timedelta
from typing import Any, Final

import numpy as np

from modeler.sequences.intrinsics import Overrides
from modeler.sequences.lens import Lens
from modeler.sequences.live import TIMEOUT_MS, Image, LiveSequence, RunningCamera, in_a_line, opened
from modeler.system.processes import install_command
from modeler.types import Camera, InputError

_OAK_PX: Final = (640, 400)  # width and height of depth and colour: stereo of all models gives as many


def orbbec(ob: Any, serial: str) -> RunningCamera:
    """Start an Orbbec camera."""
    where, failures = f"orbbec:{serial}", (ob.OBError, RuntimeError)
    try:
        devices = ob.Context().query_devices()
        if not devices.get_count():
            raise InputError(f"{where}: no camera is plugged in; connect one to a USB 3 port.")
        device = devices.get_device_by_serial_number(serial) if serial else devices.get_device_by_index(0)
        pipeline, config = ob.Pipeline(device), ob.Config()
        depth, colour = ob.OBSensorType.DEPTH_SENSOR, ob.OBSensorType.COLOR_SENSOR
        config.enable_stream(pipeline.get_stream_profile_list(depth).get_default_video_stream_profile())
        config.enable_stream(
            pipeline.get_stream_profile_list(colour).get_video_stream_profile(0, 0, ob.OBFormat.RGB, 0)
        )
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
            raise InputError(f"{where}: gives no image for {TIMEOUT_MS / 1000:g} s; reconnect it.")
        first = frames.get_depth_frame()
        profile = first.get_stream_profile().as_video_stream_profile()
        intrinsic, bent = profile.get_intrinsic(), profile.get_distortion()
        camera = Camera(intrinsic.width, intrinsic.height, intrinsic.fx, intrinsic.fy, intrinsic.cx, intrinsic.cy)
        fisheye = bent.model == ob.OBCameraDistortionModel.KANNALA_BRANDT4
        brown = (bent.k1, bent.k2, bent.p1, bent.p2, bent.k3, bent.k4, bent.k5, bent.k6)
        lens = Lens(camera, (bent.k1, bent.k2, bent.k3, bent.k4) if fisheye else brown, fisheye)
        model = f"Orbbec {device.get_device_info().get_name().removeprefix('Orbbec ')}"
        return RunningCamera(model, lens, float(first.get_depth_scale()), newest, pipeline.stop, failures)
    except failures as error:
        raise InputError(f"{where}: cannot be started ({in_a_line(error)}); reconnect it.") from None


def oak(dai: Any, serial: str) -> RunningCamera:
    """Start an OAK camera, with depth on the pixels of its colour camera, from whose images the lens is taken out."""
    where, failures = f"oak:{serial}", (RuntimeError,)
    try:
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
            raise InputError(f"{where}: gives no image for {TIMEOUT_MS / 1000:g} s; reconnect it.")
        first = both["depth"]
        height, width = first.getFrame().shape
        (fx, _, cx), (_, fy, cy), _ = first.getTransformation().getIntrinsicMatrix()
        lens = Lens(Camera(width, height, fx, fy, cx, cy), ())
        return RunningCamera(str(device.getProductName()), lens, 1.0, newest, pipeline.stop, failures)
    except failures as error:
        raise InputError(f"{where}: cannot be started ({in_a_line(error)}); reconnect it.") from None


def azure(k4a: Any, serial: str) -> RunningCamera:
    """Start an Azure Kinect, or with Orbbec's library in place of Microsoft's a Femto."""
    where, failures = f"azure:{serial}", (k4a.K4AException, RuntimeError)
    try:
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
            raise InputError(f"{where}: no such camera is plugged in; {there}.")
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
        return RunningCamera(f"Azure Kinect {device.serial}", lens, 1.0, newest, device.stop, failures)
    except failures as error:
        raise InputError(f"{where}: cannot be started ({in_a_line(error)}); reconnect it.") from None


LIBRARIES: Final[Mapping[str, tuple[str, str, Callable[[Any, str], RunningCamera]]]] = {
    "orbbec": ("pyorbbecsdk", "orbbec", orbbec),
    "oak": ("depthai", "oak", oak),
    "azure": ("pyk4a", "azure", azure),
}
"""What stands before the colon of a path: the library, the extra that installs it, and what starts a camera."""


def open_camera_of(maker: str, serial: str, overrides: Overrides) -> LiveSequence:
    """Start a camera."""
    module, extra, start = LIBRARIES[maker]
    try:
        library = importlib.import_module(module)
    except ImportError:
        raise InputError(
            f"{maker}:{serial}: a camera of this kind is read by its maker's library; {install_command(extra)}."
        ) from None
    return opened(start(library, serial), overrides)
