"""ROS 1 and ROS 2 bags, and MCAP files, by the rosbags library: topics and their messages, without ROS."""

from __future__ import annotations

import bz2
import struct
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import lz4.frame
from rosbags import rosbag1, rosbag2
from rosbags.rosbag1.reader import Chunk
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from modeler.types import InputError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore

MAX_CHUNK_BYTES = 1 << 30
"""Chunks that would unpack to more are refused."""


@final
@dataclass(frozen=True)
class Stamp:
    """Which message of a topic."""

    received_ns: int
    """Time at which the bag received it."""
    ordinal: int = 0
    """Place among the messages of the topic that were received at that very time."""


@final
@dataclass(frozen=True)
class Bag:
    """A bag that is open while it is used."""

    path: Path
    """`*.bag`, `*.mcap`, `*.db3`, or the folder of a ROS 2 bag."""

    @property
    def is_ros1(self) -> bool:
        """Whether it is a bag of ROS 1, whose fields are named in capitals."""
        return self.path.suffix.lower() == ".bag"

    @property
    def types(self) -> dict[str, str]:
        """Message types by topic, as in `sensor_msgs/msg/Image`."""
        named = ((str(connection.topic), str(connection.msgtype)) for connection in self._reader.connections)
        return {topic: kind for topic, kind in named if topic.isprintable()}

    def messages(self, topic: str, most: int | None = None) -> Iterator[tuple[Stamp, Any]]:
        """Read the messages of a topic in the order in which they were received.

        Args:
            topic: one of `types`.
            most: stop after so many.

        Raises:
            InputError: where the bag is broken.
        """
        with self._told():
            stamp = Stamp(-1)
            for count, (connection, received_ns, data) in enumerate(self._reader.messages(self._of(topic))):
                if count == most:
                    return
                alike = stamp.received_ns == received_ns
                stamp = replace(stamp, ordinal=stamp.ordinal + 1) if alike else Stamp(received_ns)
                yield stamp, self._message(connection, data)

    def message(self, topic: str, stamp: Stamp) -> Any:
        """Return one message.

        Raises:
            InputError: where the bag is broken.
        """
        with self._told():
            start = stamp.received_ns
            found = self._reader.messages(self._of(topic), start=start, stop=start + 1)
            for place, (connection, _, data) in enumerate(found):
                if place == stamp.ordinal:
                    return self._message(connection, data)
            raise InputError(f"{self.path}: lacks a message of {topic} that it had; record it anew.")

    def _of(self, topic: str) -> list[Connection]:
        return [connection for connection in self._reader.connections if str(connection.topic) == topic]

    def _message(self, connection: Connection, data: bytes) -> Any:
        store, kind = _typestore(ros1=self.is_ros1), str(connection.msgtype)
        if not self.is_ros1:
            return store.deserialize_cdr(data, kind)
        return store.deserialize_ros1(_image_alone(data) if kind == "sensor_msgs/msg/Image" else data, kind)

    @cached_property
    def _reader(self) -> rosbag1.Reader | rosbag2.Reader:
        """Return the open reader; it is closed when this bag is forgotten."""
        with self._told():
            if self.is_ros1:
                reader = rosbag1.Reader(self.path)
                reader.open()
                reader.chunks = {place: _bounded(chunk) for place, chunk in reader.chunks.items()}
            else:
                reader = rosbag2.Reader(self.path)
                reader.open()
            weakref.finalize(self, reader.close)
            return reader

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Turn whatever the library says of a broken file into one line."""
        try:
            yield
        except (InputError, GeneratorExit):
            raise
        except FileNotFoundError as error:
            raise InputError(f"{self.path}: is no complete bag ({_line(error)}); copy all of it.") from None
        except OSError as error:
            why = error.strerror or _line(error)
            raise InputError(f"{self.path}: cannot be read ({why}); check the path and its permissions.") from None
        except Exception as error:  # a broken file can make the library raise anything
            advice = "reindex it (rosbag reindex)" if "index" in str(error) else "record or copy it anew"
            raise InputError(f"{self.path}: is not a readable bag ({_line(error)}); {advice}.") from None


def _image_alone(data: bytes) -> bytes:
    """Return a ROS 1 image message without the bytes that RealSense's recorder leaves behind it."""
    at = 12  # behind number and time
    for fixed in (8, 5, 0):  # texts and pixels tell their lengths; between them: size, order and step
        (length,) = struct.unpack_from("<I", data, at)
        at += 4 + length + fixed
    return data[:at]


def _line(error: Exception) -> str:
    words = " ".join(str(error).split()) or type(error).__name__
    return words if len(words) <= 120 else words[:117] + "..."


@lru_cache(maxsize=2)
def _typestore(*, ros1: bool) -> Typestore:
    """Return the standard messages, which are the same in all versions for images and cameras."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if ros1:  # whose standard messages lack it
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


def _bounded(chunk: Chunk) -> Chunk:
    """Return a chunk that refuses to unpack to something enormous."""
    unpack = {bz2.decompress: _bz2, lz4.frame.decompress: _lz4}.get(chunk.decompressor)
    return chunk if unpack is None else chunk._replace(decompressor=unpack)


def _bz2(data: bytes) -> bytes:
    unpacker = bz2.BZ2Decompressor()
    unpacked = unpacker.decompress(data, MAX_CHUNK_BYTES)
    return _whole(unpacked, bool(unpacker.eof))


def _lz4(data: bytes) -> bytes:
    unpacker = lz4.frame.LZ4FrameDecompressor()
    unpacked = unpacker.decompress(data, MAX_CHUNK_BYTES)
    return _whole(unpacked, bool(unpacker.eof))


def _whole(unpacked: bytes, ended: bool) -> bytes:
    if not ended:
        raise ValueError(f"a chunk is cut off, or larger than {MAX_CHUNK_BYTES >> 20} MB")
    return unpacked
