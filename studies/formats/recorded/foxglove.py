"""Records with the MCAP project's own library, as `pip install mcap-ros2-support` brings it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from scene import colour, depth

SIZE, FOCAL_PX, COUNT = (48, 36), 45.0, 3
START_NS, STEP_NS = 1_700_000_000_000_000_000, 33_333_333
_BAR = "=" * 80
HEADER = f"""{_BAR}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_BAR}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
IMAGE = f"""std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
{HEADER}"""
CAMERA = f"""std_msgs/Header header
uint32 height
uint32 width
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p
uint32 binning_x
uint32 binning_y
sensor_msgs/RegionOfInterest roi
{HEADER}{_BAR}
MSG: sensor_msgs/RegionOfInterest
uint32 x_offset
uint32 y_offset
uint32 height
uint32 width
bool do_rectify
"""


def record(writer: Any) -> None:
    """Write depth, colour and their camera with a writer of `mcap_ros2`."""
    image = writer.register_msgdef("sensor_msgs/msg/Image", IMAGE)
    camera = writer.register_msgdef("sensor_msgs/msg/CameraInfo", CAMERA)
    (width, height), f = SIZE, FOCAL_PX
    roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    for number in range(COUNT):
        time_ns = START_NS + number * STEP_NS
        header = {"stamp": {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}, "frame_id": "camera"}
        common = {"header": header, "height": height, "width": width}
        intrinsics = {
            "distortion_model": "plumb_bob",
            "d": [0.0] * 5,
            "k": [f, 0.0, width / 2, 0.0, f, height / 2, 0.0, 0.0, 1.0],
            "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            "p": [f, 0.0, width / 2, 0.0, 0.0, f, height / 2, 0.0, 0.0, 0.0, 1.0, 0.0],
            "binning_x": 0,
            "binning_y": 0,
            "roi": roi,
        }
        pictures = (
            ("depth", depth(number, *SIZE), {"encoding": "16UC1", "is_bigendian": 0, "step": 2 * width}),
            ("color", colour(number, *SIZE), {"encoding": "rgb8", "is_bigendian": 0, "step": 3 * width}),
        )
        for name, pixels, kind in pictures:
            writer.write_message(f"/camera/{name}/camera_info", camera, common | intrinsics, time_ns, time_ns)
            message = common | kind | {"data": pixels.tobytes()}
            writer.write_message(f"/camera/{name}/image_raw", image, message, time_ns, time_ns)


if __name__ == "__main__":
    from mcap_ros2.writer import Writer  # type: ignore[import-not-found]

    with Path(sys.argv[1]).open("wb") as file:
        opened = Writer(file)
        record(opened)
        opened.finish()
