"""Writers of ROS bags of small frames, with rosbags as its users write them."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection
from rosbags.rosbag2.storage_mcap import Channel, McapWriter, Schema, write_channel, write_schema
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.types import Frame
from studies.formats.image_folders import matrix, raw_depth

START_NS = 1_700_000_000_000_000_000


class Ros1Mcap(McapWriter):
    """Writes messages of ROS 1, as `mcap convert` does a bag's."""

    def __init__(self, path: Path, compression: rosbag2.CompressionMode) -> None:
        super().__init__(path, compression)
        self.bio.seek(21)  # behind the magic, the header's length and that of the profile
        self.bio.write(b"ros1")
        self.bio.seek(0, io.SEEK_END)

    def add_msgtype(self, connection: Connection) -> None:
        name = connection.msgtype.replace("/msg/", "/")
        self.schemas.append(Schema(len(self.schemas) + 1, name, "ros1msg", connection.msgdef.data))
        write_schema(self.chunk.bio, self.schemas[-1])

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        name = connection.msgtype.replace("/msg/", "/")
        self.channels.append(Channel(connection.id, name, connection.topic, "ros1", b""))
        self.channel_stats[connection.id] = 0
        write_channel(self.chunk.bio, self.channels[-1], self.schemas)


@dataclass(frozen=True)
class Recorder:
    """What a robot records."""

    encoding: str = "16UC1"
    """16UC1, mono16 or 32FC1; "compressedDepth" for image_transport's PNG."""
    colour: str | None = "rgb8"
    """rgb8, bgr8, bgra8, mono8, "jpeg", or None."""
    big_endian: bool = False
    """Order of the bytes of depth."""
    padding: int = 0
    """Bytes after each row."""
    distortion: tuple[float, ...] = (0.0,) * 5
    """D of both cameras."""
    compression: rosbag1.Writer.CompressionFormat | None = None
    """Of ROS 1 bags."""
    packed: rosbag2.CompressionMode | None = None
    """What of ROS 2 bags is packed by zstd."""
    camera_info: bool = True
    """Whether it is recorded."""
    names: dict[str, str] = field(
        default_factory=lambda: {
            "depth": "/camera/depth/image_raw",
            "info": "/camera/depth/camera_info",
            "colour": "/camera/rgb/image_raw",
            "colour_info": "/camera/rgb/camera_info",
        }
    )
    """Topics."""
    colour_scale: float = 1.0
    """What the colour camera's focal length is a multiple of."""
    ros1: bool = False
    """Whether MCAP holds messages of ROS 1."""

    def write(self, path: Path, frames: list[Frame]) -> Path:
        """Write `*.bag` for ROS 1, `*.mcap` for one such file, and a folder of ROS 2 otherwise."""
        if path.suffix == ".bag":
            writer = rosbag1.Writer(path)
            if self.compression is not None:
                writer.set_compression(self.compression)
        else:
            plugin = rosbag2.StoragePlugin.SQLITE3 if path.suffix == ".db3" else rosbag2.StoragePlugin.MCAP
            writer = rosbag2.Writer(path.with_suffix(""), version=9, storage_plugin=plugin)
            if self.ros1:
                writer.STORAGE_PLUGINS = {plugin: Ros1Mcap}
            if self.packed is not None:
                writer.set_compression(self.packed, rosbag2.CompressionFormat.ZSTD)
        with writer:
            self._fill(writer, frames)
        if path.suffix in (".mcap", ".db3"):
            inner = next(path.with_suffix("").glob(f"*{path.suffix}"))
            inner.rename(path)
            return path
        return path if path.suffix == ".bag" else path.with_suffix("")

    def _fill(self, writer: Any, frames: list[Frame]) -> None:
        ros1 = self.ros1 or isinstance(writer, rosbag1.Writer)
        store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        types, connections = store.types, {}

        def send(topic: str, time_ns: int, message: Any) -> None:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
            writer.write(connections[topic], time_ns, bytes(serialize(message, kind)))

        def header(time_ns: int, frame_id: str) -> Any:
            stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
            extra = {"seq": 0} if ros1 else {}
            return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id, **extra)

        for frame in frames:
            time_ns = START_NS + round(frame.time_s * 1e9)
            received_ns = time_ns + 7_000_000
            if self.camera_info:
                for name, scale in (("info", 1.0), ("colour_info", self.colour_scale)):
                    camera = self._camera(types, header(time_ns, name), frame, scale, ros1=ros1)
                    send(self.names[name], received_ns, camera)
            send(self.names["depth"], received_ns, self._depth(types, header(time_ns, "depth"), frame))
            if self.colour is not None and frame.colour is not None:
                late = time_ns + 4_000_000
                send(self.names["colour"], received_ns, self._colour(types, header(late, "colour"), frame.colour))

    def _camera(self, types: Any, header: Any, frame: Frame, scale: float, *, ros1: bool) -> Any:
        camera = frame.camera
        k = matrix(camera) * np.array([[scale], [scale], [1.0]])
        p = np.hstack([k, np.zeros((3, 1))]).ravel()
        values = {"d": np.array(self.distortion), "k": k.ravel(), "r": np.eye(3).ravel(), "p": p}
        roi = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return types["sensor_msgs/msg/CameraInfo"](
            header=header,
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **({name.upper(): value for name, value in values.items()} if ros1 else values),
        )

    def _depth(self, types: Any, header: Any, frame: Frame) -> Any:
        if self.encoding == "compressedDepth":
            packed = io.BytesIO()
            Image.fromarray(raw_depth(frame, 1.0)).save(packed, "PNG")
            data = np.frombuffer(b"\0" * 12 + packed.getvalue(), np.uint8)
            return types["sensor_msgs/msg/CompressedImage"](
                header=header, format="16UC1; compressedDepth png", data=data
            )
        pixels = frame.depth_m if self.encoding == "32FC1" else raw_depth(frame, 1.0)
        return self._image(types, header, self.encoding, pixels.astype(pixels.dtype.newbyteorder(self._order)))

    def _colour(self, types: Any, header: Any, colour: np.ndarray) -> Any:
        if self.colour == "jpeg":
            packed = io.BytesIO()
            Image.fromarray(colour).save(packed, "JPEG", quality=95)
            data = np.frombuffer(packed.getvalue(), np.uint8)
            return types["sensor_msgs/msg/CompressedImage"](
                header=header, format="rgb8; jpeg compressed bgr8", data=data
            )
        pixels = {
            "rgb8": colour,
            "bgr8": colour[..., ::-1],
            "bgra8": np.concatenate([colour[..., ::-1], np.full_like(colour[..., :1], 255)], axis=2),
            "mono8": colour[..., 1],
        }[str(self.colour)]
        return self._image(types, header, str(self.colour), pixels)

    def _image(self, types: Any, header: Any, encoding: str, pixels: np.ndarray) -> Any:
        height, width = pixels.shape[:2]
        rows = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, self.padding)))
        return types["sensor_msgs/msg/Image"](
            header=header,
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=int(self.big_endian),
            step=rows.shape[1],
            data=rows.ravel(),
        )

    @property
    def _order(self) -> Literal[">", "<"]:
        return ">" if self.big_endian else "<"


COLOUR_FROM_DEPTH = se3.exp(np.array([0.01, -0.02, 0.03, 0.015, 0.001, -0.002]))


class Rig(Recorder):
    """Records fixed transforms too."""

    def _fill(self, writer: Any, frames: list[Frame]) -> None:
        ros1 = self.ros1 or isinstance(writer, rosbag1.Writer)
        store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
        types, link_from_depth = store.types, se3.exp(np.array([0.5, 0.1, -0.3, 0.0, 0.02, 0.01]))
        link_from_colour = link_from_depth @ se3.inverse(COLOUR_FROM_DEPTH)
        extra = {"seq": 0} if ros1 else {}
        stamped = []
        for child, pose in (("depth", link_from_depth), ("colour", link_from_colour)):
            quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
            transform = types["geometry_msgs/msg/Transform"](
                translation=types["geometry_msgs/msg/Vector3"](*map(float, pose[:3, 3])),
                rotation=types["geometry_msgs/msg/Quaternion"](*map(float, quaternion)),
            )
            stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="link", **extra)
            stamped.append(
                types["geometry_msgs/msg/TransformStamped"](header=header, child_frame_id=child, transform=transform)
            )
        message = types["tf2_msgs/msg/TFMessage"](transforms=stamped)
        connection = writer.add_connection("/tf_static", message.__msgtype__, typestore=store)
        serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
        writer.write(connection, START_NS, bytes(serialize(message, message.__msgtype__)))
        super()._fill(writer, frames)


TURN = Rotation.from_rotvec([0.1, 0.3, -0.2]).as_matrix()
SHIFT_M = np.array([0.015, 0.001, 0.002])
STREAMS = ("/device_0/sensor_0/Depth_0", "/device_0/sensor_1/Color_0")


class OldRealSense(Recorder):
    """Adds what RealSense's recorder up to version 2.56 adds, in messages of ROS 1: four bytes behind each image."""

    def _fill(self, writer: Any, frames: list[Frame]) -> None:
        store = get_typestore(Stores.ROS1_NOETIC)
        types = store.types

        def send(topic: str, message: Any) -> None:
            connection = writer.add_connection(topic, message.__msgtype__, typestore=store)
            writer.write(connection, 1, bytes(store.serialize_ros1(message, message.__msgtype__)))

        send("/device_0/sensor_0/option/Depth Units/value", types["std_msgs/msg/Float32"](data=0.00025))
        for stream, turn, shift in ((STREAMS[0], np.eye(3), np.zeros(3)), (STREAMS[1], TURN, SHIFT_M)):
            x, y, z, w = Rotation.from_matrix(turn).as_quat()
            pose = types["geometry_msgs/msg/Transform"](
                translation=types["geometry_msgs/msg/Vector3"](*map(float, shift)),
                rotation=types["geometry_msgs/msg/Quaternion"](*map(float, (-x, -y, -z, -w))),
            )
            send(f"{stream}/tf/1", pose)
        write = writer.write
        writer.write = lambda connection, when, data: write(
            connection, when, bytes(data) + (b"\0" * 4 if connection.msgtype.endswith("/Image") else b"")
        )
        super()._fill(writer, frames)


NAMES = {
    "depth": f"{STREAMS[0]}/image/data",
    "info": f"{STREAMS[0]}/info/camera_info",
    "colour": f"{STREAMS[1]}/image/data",
    "colour_info": f"{STREAMS[1]}/info/camera_info",
}
