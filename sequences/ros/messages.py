"""Images and cameras in ROS messages, static transforms, and further data of the RealSense recorder."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.sequences.image_files import MAX_PIXELS, EmbeddedImage, metres, read_colour, read_depth
from modeler.sequences.intrinsics import sane
from modeler.sequences.lens import Lens, lens_of_model
from modeler.sequences.ros.bag import Bag, from_zstd
from modeler.system.regular_files import MAX_BYTES
from modeler.types import Array, Camera, InputError

IMAGE, PACKED, CAMERA = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
MILLIMETRES = ("16UC1", "mono16")
METRES = ("32FC1",)
COLOURS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "8UC4": 4, "mono8": 1, "8UC1": 1}
"""Bytes per pixel; OpenCV's 8UC3 is BGR."""
YUV = {"yuv422": (1, 0, 2), "UYVY": (1, 0, 2), "yuv422_yuy2": (0, 1, 3), "YUYV": (0, 1, 3)}
"""Where Y, U and V stand in the four bytes of two pixels."""
_PACKED_YUV = re.compile(r"(YUYV|UYVY); zstd; (\d{1,5})x(\d{1,5}) step=(\d{1,6})")  # RealSense's recorder, since 2.59
_PACKED_DEPTH_HEADER = 12  # bytes of image_transport's compressedDepth before the PNG


def is_depth(message: Any) -> bool:
    """Return whether an image message may be depth."""
    if _is_raw(message):
        return message.encoding in MILLIMETRES + METRES
    return "compressedDepth" in message.format


def is_colour(message: Any) -> bool:
    """Return whether an image message holds colour or grey that can be read."""
    if _is_raw(message):
        return message.encoding in COLOURS or message.encoding in YUV
    if _PACKED_YUV.fullmatch(message.format):
        return True
    return not is_depth(message) and any(kind in message.format for kind in ("jpeg", "jpg", "png"))


def depth_m(message: Any, unit_mm: float, where: str) -> npt.NDArray[np.float32]:
    """Return depth (h, w) in m, NaN where nothing was measured, of an image for which `is_depth`."""
    if not is_depth(message):
        raise InputError(f"{where}: is {_kind(message)} where images before it are depth; record it again.")
    if _is_raw(message) and message.encoding in METRES:
        depth = _rows(message, 4, where).view(">f4" if message.is_bigendian else "<f4").astype(np.float32)
        return np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(np.nan))
    if _is_raw(message):
        raw = _rows(message, 2, where).view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
    elif "32FC1" in message.format:
        raise InputError(f"{where}: holds packed 32FC1 depth, which is lossy; record the raw topic or 16UC1.")
    elif message.format.rstrip().endswith("rvl"):
        raw = from_rvl(bytes(message.data[_PACKED_DEPTH_HEADER:]), where)
    else:
        raw = read_depth(EmbeddedImage(bytes(message.data[_PACKED_DEPTH_HEADER:]), where))
    return metres(raw, unit_mm)


def from_rvl(data: bytes, where: str) -> npt.NDArray[np.uint16]:
    """Return depth (h, w) of an image packed by RVL (Wilson 2017), with its width and height before it.

    Numbers are of digits of three bits, lowest first, in groups of four bits, the highest of which says that more
    follow. They are the lengths of runs without and with depth in turn, and after the second the differences along it,
    with their sign in the lowest bit.
    """
    width, height = struct.unpack_from("<II", data) if len(data) >= 8 else (0, 0)
    if not 0 < width * height <= MAX_PIXELS:
        raise InputError(f"{where}: an image has {width} x {height} pixels; record it again.")
    words = np.frombuffer(data, "<u4", offset=8, count=(len(data) - 8) // 4)
    groups = ((words[:, None] >> np.arange(28, -4, -4, dtype=np.uint32)) & 15).ravel().astype(np.int64)
    last = np.flatnonzero(groups < 8)
    first = np.concatenate([[0], last[:-1] + 1])
    place = np.arange(int(last[-1]) + 1 if last.size else 0) - np.repeat(first, last - first + 1)
    digits = (groups[: place.size] & 7) << np.minimum(3 * place, 60)
    numbers = np.add.reduceat(digits, first) if last.size else digits
    result, at, pixel, before = np.zeros(width * height, np.int64), 0, 0, 0
    while pixel < result.size:
        if at + 1 >= len(numbers):
            raise InputError(f"{where}: an image packed by RVL is cut off; record it again.")
        empty, filled = int(numbers[at]), int(numbers[at + 1])
        pixel, at = pixel + empty, at + 2
        if pixel + filled > result.size or at + filled > len(numbers) or empty + filled == 0:
            raise InputError(f"{where}: an image packed by RVL is cut off or broken; record it again.")
        steps = numbers[at : at + filled]
        values = before + np.cumsum((steps >> 1) ^ -(steps & 1))
        result[pixel : pixel + filled] = values
        before = int(values[-1]) if filled else before
        pixel, at = pixel + filled, at + filled
    return (result & 0xFFFF).astype(np.uint16).reshape(height, width)


def colour(message: Any, where: str) -> npt.NDArray[np.uint8]:
    """Return colour (h, w, 3) as RGB of an image for which `is_colour`."""
    if not is_colour(message):
        raise InputError(f"{where}: is {_kind(message)} where images before it are colour; record it again.")
    packed = None if _is_raw(message) else _PACKED_YUV.fullmatch(message.format)
    if packed is not None:
        return colour(_unpacked(message, packed, where), where)
    if not _is_raw(message):
        return read_colour(EmbeddedImage(bytes(message.data), where))
    if message.encoding in YUV:
        return _from_yuv(_rows(message, 2, where), YUV[message.encoding])
    channels = COLOURS[message.encoding]
    pixels = _rows(message, channels, where).reshape(message.height, message.width, channels)
    if channels == 1:
        return np.repeat(pixels, 3, axis=2)
    in_order = pixels[..., :3] if message.encoding.startswith("rgb") else pixels[..., 2::-1]
    return np.ascontiguousarray(in_order)


@dataclass(frozen=True, eq=False)
class _Raw:
    """An image message as if its pixels had not been packed."""

    encoding: str
    width: int
    height: int
    step: int
    data: npt.NDArray[np.uint8]
    __msgtype__: str = IMAGE


def _unpacked(message: Any, packing: re.Match[str], where: str) -> _Raw:
    """Return an image with its zstd-compressed pixels decompressed; `packing` is the match of its format."""
    width, height, step = (int(number) for number in packing.groups()[1:])
    try:
        data = from_zstd(bytes(message.data), min(step * height, MAX_BYTES))
    except ValueError as error:
        raise InputError(f"{where}: cannot be unpacked ({error}); record it again.") from None
    return _Raw(packing[1], width, height, step, np.frombuffer(data, np.uint8))


def lens(message: Any, where: str, *, ros1: bool) -> Lens:
    """Return the camera that a CameraInfo message describes."""
    matrix = np.asarray(message.K if ros1 else message.k, dtype=np.float64)
    distortion = np.asarray(message.D if ros1 else message.d, dtype=np.float64)
    fx, _, cx, _, fy, cy = (float(value) for value in matrix[:6])
    if not sane((fx, fy, cx, cy)) or not np.isfinite(distortion).all():
        raise InputError(f"{where}: camera_info has no usable K; calibrate the camera, or convert with `intrinsics`.")
    camera = Camera(int(message.width), int(message.height), fx, fy, cx, cy)
    return lens_of_model(camera, distortion.tolist(), str(message.distortion_model), where)


def _from_yuv(rows: npt.NDArray[np.uint8], places: tuple[int, int, int]) -> npt.NDArray[np.uint8]:
    """Return RGB (h, w, 3) of rows (h, 2 w) in which two pixels share U and V (ITU-R BT.601, as cameras send it)."""
    height, width = rows.shape[0], rows.shape[1] // 4 * 2  # an odd last column has no partner to share with
    pairs = rows[:, : 2 * width].reshape(height, width // 2, 4).astype(np.float32)
    y = pairs[..., [places[0], places[0] + 2]].reshape(height, width)
    u, v = (np.repeat(pairs[..., place] - 128.0, 2, axis=1) for place in places[1:])
    light = 1.164 * (y - 16.0)
    rgb = np.stack([light + 1.596 * v, light - 0.392 * u - 0.813 * v, light + 2.017 * u], axis=2)
    return np.clip(np.rint(rgb), 0.0, 255.0).astype(np.uint8)


def _kind(message: Any) -> str:
    return repr(message.encoding if _is_raw(message) else message.format)[:40]


def _is_raw(message: Any) -> bool:
    return bool(message.__msgtype__ == IMAGE)


def _rows(message: Any, bytes_a_pixel: int, where: str) -> npt.NDArray[np.uint8]:
    """Return the bytes (h, w · bytes) of an image without row padding."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    length, needed = len(message.data), width * bytes_a_pixel
    if not 0 < height * width <= MAX_PIXELS:
        raise InputError(f"{where}: an image has {width} x {height} pixels; record it again.")
    if step < needed or step * height > length:
        raise InputError(
            f"{where}: an image of {width} x {height} pixels, {message.encoding}, has {length} bytes, {step} a row; "
            "it is cut off or not what it says."
        )
    rows = np.asarray(message.data, dtype=np.uint8)[: step * height].reshape(height, step)
    return np.ascontiguousarray(rows[:, :needed])


MOST = 1000  # messages of fixed transforms that are read; drivers send one or a few


def static_transform(bag: Bag, target: str, source: str) -> Array | None:
    """Return target_from_source (4, 4), in m, between two frames; None if no fixed transforms lead there."""
    if not target or not source:
        return None
    steps: dict[str, list[tuple[str, Array]]] = {}
    for topic in (
        name for name, kind in bag.types.items() if kind == "tf2_msgs/msg/TFMessage" and name.endswith("tf_static")
    ):
        for _, message in bag.messages(topic, most=MOST):
            for stamped in message.transforms:
                parent, child = _name(stamped.header.frame_id), _name(stamped.child_frame_id)
                parent_from_child = transform_pose(stamped.transform)
                if parent_from_child is not None:
                    steps.setdefault(child, []).append((parent, parent_from_child))
                    steps.setdefault(parent, []).append((child, se3.inverse(parent_from_child)))
    found, front = {_name(source): np.eye(4)}, [_name(source)]
    while front:
        here = front.pop(0)
        for there, there_from_here in steps.get(here, []):
            if there not in found:
                found[there] = there_from_here @ found[here]
                front.append(there)
    return found.get(_name(target))


def transform_pose(transform: Any) -> Array | None:
    """Return the motion (4, 4), in m, of a `geometry_msgs/Transform`; None if it is not rigid."""
    turn, shift = transform.rotation, transform.translation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w], dtype=np.float64)
    offset_m = np.array([shift.x, shift.y, shift.z], dtype=np.float64)
    if not 0.9 < float(np.linalg.norm(quaternion)) < 1.1:  # not so of NaN
        return None
    motion = se3.rigid(Rotation.from_quat(quaternion).as_matrix(), offset_m)
    return motion if se3.is_rigid(motion, tolerance=1e-3) else None


def _name(frame_id: str) -> str:
    return str(frame_id).removeprefix("/")


TEXT = "std_msgs/msg/String"
_STREAM = r"(/device_\d+/sensor_\d+)/\w+"


def realsense_unit_mm(bag: Bag, topic: str) -> tuple[float, str] | None:
    """Return the millimetres in one unit of depth and the topic that says so; None if nothing does."""
    sensor = re.match(_STREAM, topic)
    if sensor is None:
        return None
    for name in bag.types:
        if name.replace(" ", "_") == f"{sensor[1]}/option/Depth_Units/value":
            found = _number(str(getattr(bag.first(name), "data", ""))) * 1000.0
            if 1e-6 <= found <= 1e3:
                return found, name
    return None


def realsense_lens(bag: Bag, topic: str) -> Lens | None:
    """Return the camera of a topic from a text message, as version 2.58 writes it; None without."""
    stream = re.match(_STREAM, topic)
    name = None if stream is None else f"{stream[0]}/camera_info"
    if name is None or bag.types.get(name) != TEXT or (message := bag.first(name)) is None:
        return None
    entries = _entries(message)
    width, height, *pixels = (_number(entries.get(key, "")) for key in ("width", "height", "fx", "fy", "ppx", "ppy"))
    distortion = _numbers(entries.get("coeffs", ""), 5)
    sound = sane((pixels[0], pixels[1], pixels[2], pixels[3])) and bool(np.isfinite(distortion).all())
    if not sound or not (1.0 <= width <= 1e5 and 1.0 <= height <= 1e5):
        raise InputError(f"{bag.path}: {name}: describes no camera; record it again, or convert with `intrinsics`.")
    camera = Camera(int(width), int(height), pixels[0], pixels[1], pixels[2], pixels[3])
    return lens_of_model(camera, distortion.tolist(), entries.get("model", ""), f"{bag.path}: {name}")


def realsense_colour_from_depth(bag: Bag, colour_topic: str, depth_topic: str) -> Array | None:
    """Return the motion (4, 4), in m, from the depth to the colour camera; None if unknown."""
    poses = [_from_reference(bag, topic) for topic in (colour_topic, depth_topic)]
    colour, depth = poses
    return None if colour is None or depth is None else colour @ se3.inverse(depth)


def _from_reference(bag: Bag, topic: str) -> Array | None:
    """Return camera_from_reference (4, 4) of the camera of a topic."""
    stream = re.match(_STREAM, topic)
    if stream is None:
        return None
    for name in bag.types:
        if re.fullmatch(re.escape(stream[0]) + r"/tf/\w+", name) and (message := bag.first(name)) is not None:
            return _pose(message, f"{bag.path}: {name}")
    return None


def _pose(message: Any, where: str) -> Array:
    if message.__msgtype__ == "geometry_msgs/msg/Transform":
        found = transform_pose(message)
        pose = np.full((4, 4), np.nan) if found is None else found
    else:
        entries = _entries(message)
        # Matrices of the camera's library stand column by column.
        rotation = _numbers(entries.get("rotation", ""), 9).reshape(3, 3).T
        pose = se3.rigid(rotation, _numbers(entries.get("translation", ""), 3))
    if not se3.is_rigid(pose, tolerance=1e-3, farthest_m=10.0):  # of one device
        raise InputError(f"{where}: is no rigid motion; record it again.")
    return pose


def _entries(message: Any) -> dict[str, str]:
    """Return the values of a text message `key=value;key=value`."""
    return dict(part.split("=", 1) for part in str(getattr(message, "data", "")).split(";") if "=" in part)


def _numbers(text: str, count: int) -> Array:
    found = [_number(word) for word in text.split(",")]
    return np.array(found) if len(found) == count else np.full(count, np.nan)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")
