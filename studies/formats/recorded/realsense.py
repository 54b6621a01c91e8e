"""Records with whatever version of pyrealsense2 is installed, from a camera that exists in software only."""

from __future__ import annotations

import importlib
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from scene import colour, depth

UNIT_M = 0.00025
DEPTH, COLOUR = (64, 48, 60.0), (96, 72, 95.0)  # width, height, focal length in pixels
BEND = (-0.05, 0.06, -0.0005, 0.0008, -0.02)  # of the colour camera, as those of the D455
TURN = ((0.99995, 0.0, 0.0099998333), (0.0, 1.0, 0.0), (-0.0099998333, 0.0, 0.99995))
SHIFT_M = (0.015, 0.001, 0.002)


class Device:
    """A camera that exists in software only."""

    def __init__(self, rs: Any, *, yuyv: bool) -> None:
        self.rs, self.yuyv = rs, yuyv
        self.kept: list[np.ndarray] = []
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "Software D455")
        self.device.register_info(rs.camera_info.serial_number, "0123456789")
        self.sensors = [self.device.add_sensor(name) for name in ("Stereo Module", "RGB Camera")]
        self.sensors[0].add_read_only_option(rs.option.depth_units, UNIT_M)
        self.profiles = []
        kinds = (
            (rs.stream.depth, rs.format.z16, 2, DEPTH, rs.distortion.brown_conrady, (0.0,) * 5),
            (
                rs.stream.color,
                rs.format.yuyv if yuyv else rs.format.rgb8,
                2 if yuyv else 3,
                COLOUR,
                rs.distortion.inverse_brown_conrady,
                BEND,
            ),
        )
        for uid, (kind, pixels, size, (width, height, focal_px), model, bend) in enumerate(kinds):
            lens = rs.intrinsics()
            lens.width, lens.height, lens.fx, lens.fy = width, height, focal_px, focal_px
            lens.ppx, lens.ppy, lens.model, lens.coeffs = width / 2 - 0.5, height / 2, model, list(bend)
            stream = rs.video_stream()
            stream.type, stream.index, stream.uid, stream.width, stream.height = kind, 0, uid, width, height
            stream.fps, stream.bpp, stream.fmt, stream.intrinsics = 30, size, pixels, lens
            self.profiles.append(self.sensors[uid].add_video_stream(stream))
        motion = rs.extrinsics()
        motion.rotation, motion.translation = np.array(TURN).T.ravel().tolist(), list(SHIFT_M)  # columns in turn
        self.profiles[0].register_extrinsics_to(self.profiles[1], motion)
        self.device.create_matcher(rs.matchers.default)

    def see(self, number: int) -> None:
        """Take an image of each kind."""
        picture = colour(number, *COLOUR[:2])
        if self.yuyv:
            picture = grey(picture)
        for place, pixels in enumerate((depth(number, *DEPTH[:2]), picture)):
            image = self.rs.software_video_frame()
            image.pixels, image.stride = pixels, pixels.strides[0]
            image.bpp = pixels.strides[1]
            image.timestamp, image.domain = 1000.0 * (1.0 + number / 30.0), self.rs.timestamp_domain.hardware_clock
            image.frame_number, image.profile = number + 1, self.profiles[place].as_video_stream_profile()
            if place == 0 and "depth_units" in dir(image):  # newer versions
                image.depth_units = UNIT_M
            self.kept.append(pixels)
            self.sensors[place].on_video_frame(image)


def grey(picture: np.ndarray) -> np.ndarray:
    """Return the brightness of an image, taken for its green, as YUYV (h, w, 2) without colour."""
    return np.stack([picture[..., 1], np.full_like(picture[..., 1], 128)], axis=2)


def record(rs: Any, path: Path, count: int, pause_s: float = 0.1, *, yuyv: bool = False) -> None:
    """Write a recording of so many images."""
    device = Device(rs, yuyv=yuyv)
    recorder = rs.recorder(str(path), device.device)
    sensors, queue = recorder.query_sensors(), rs.frame_queue(50, True)
    for place in range(len(sensors)):
        sensors[place].open(sensors[place].get_stream_profiles()[0])
        sensors[place].start(queue)
    for number in range(count):
        device.see(number)
        time.sleep(pause_s)
    time.sleep(0.3)
    for place in range(len(sensors)):
        sensors[place].stop()
        sensors[place].close()
    del recorder, sensors  # which writes the rest


if __name__ == "__main__":
    record(importlib.import_module("pyrealsense2"), Path(sys.argv[1]), 3, yuyv="yuyv" in sys.argv[1])
