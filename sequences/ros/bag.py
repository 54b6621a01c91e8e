"""ROS 1 and ROS 2 bags and MCAP files, read by the rosbags library: topics and their messages, without ROS."""

from __future__ import annotations

import bz2
import io
import os
import struct
import sys
import weakref
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast
from urllib.parse import quote

import apsw
import lz4.frame
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag1.reader import Chunk
from rosbags.rosbag2 import storage_mcap
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from modeler.sequences.input_files import check_link, entries, input_errors, read_text
from modeler.system.regular_files import MAX_BYTES, PIECE_BYTES, open_regular
from modeler.types import InputError

_STEP = 1_000_000  # instructions of the database between two looks at their number
_STEPS = 100  # for one message of a small file: some seconds
_STEPS_PER_BYTE = 1e-4  # and more in large ones: a row of ten bytes or more takes fewer than a thousand instructions
_PRAGMAS = ("table_info", "table_xinfo")
_FUNCTIONS = ("count", "min", "max")


def database(path: Path) -> Sqlite3Reader:
    """Return the library's reader of a file, which is not open yet.

    What a hostile file would have computed, such as a view that never ends, is refused.
    """
    reader: Any = Sqlite3Reader(Path(quote(str(path))))  # quoted for an address, as the library expects it
    opening, reading, work = reader.open, reader.messages, _Work(path)

    def open_guarded() -> None:
        for beside in (Path(f"{path}-wal"), Path(f"{path}-journal")):
            if beside.exists() and beside.stat().st_size:
                raise InputError(
                    f'{beside}: the recorder ended before this was moved into the bag; run: sqlite3 "{path}" '
                    '"PRAGMA wal_checkpoint; SELECT count(*) FROM messages"'
                )
        apsw.connection_hooks.append(work.guard)
        try:
            opening()
        finally:
            apsw.connection_hooks.remove(work.guard)
        for table in ("messages", "topics"):
            if any(column[6] > 1 for column in reader.dbconn.execute(f"PRAGMA table_xinfo({table})")):
                raise ValueError("it has generated columns")

    def messages(
        connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        work.renew()
        for message in reading(connections, start, stop):
            yield message
            work.renew()

    reader.open, reader.messages = open_guarded, messages
    return reader


class _Work:
    """Limits what a database does for one message."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._left = 0.0
        self.renew()

    def renew(self) -> None:
        """Begin with another message."""
        self._left = _STEPS + _STEPS_PER_BYTE * (os.path.getsize(self._path) if self._path.is_file() else 0)

    def guard(self, connection: apsw.Connection) -> None:
        """Restrict a connection that is being opened."""
        connection.authorizer = _permission
        connection.set_progress_handler(self._is_over, _STEP)
        connection.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_BYTES)

    def _is_over(self) -> bool:
        self._left -= 1.0
        return self._left < 0.0


def _permission(action: int, first: str | None, second: str | None, name: str | None, within: str | None) -> int:
    """Permit reading tables; not views, whatever they hold, nor functions."""
    permitted = within is None and (
        action in (apsw.SQLITE_SELECT, apsw.SQLITE_READ)
        or (action == apsw.SQLITE_FUNCTION and second in _FUNCTIONS)
        or (action == apsw.SQLITE_PRAGMA and first in _PRAGMAS)
    )
    return apsw.SQLITE_OK if permitted else apsw.SQLITE_DENY


if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore


MAX_RATIO = 100  # largest compression ratio of larger files: depth images never reach it
_ZSTD = b"\x28\xb5\x2f\xfd"  # magic bytes of its files


def from_bz2(data: bytes, most: int = MAX_BYTES) -> bytes:
    """Return what bzip2 packed; ValueError if it is cut off, or more than `most` bytes."""
    unpacker = bz2.BZ2Decompressor()
    return _whole(unpacker.decompress(data, most + 1), ended=unpacker.eof, most=most)


def from_lz4(data: bytes, most: int = MAX_BYTES) -> bytes:
    """Return what LZ4 packed; ValueError if it is cut off, or more than `most` bytes."""
    unpacker = lz4.frame.LZ4FrameDecompressor()
    unpacked = unpacker.decompress(data, most + 1)
    return _whole(unpacked, ended=bool(unpacker.eof), most=most)


def from_zstd(data: bytes, most: int = MAX_BYTES) -> bytes:
    """Return what zstd packed; ValueError if it is cut off, not of zstd, or more than `most` bytes."""
    unpacked, ended = b"", False
    while data:
        unpacker = zstd.ZstdDecompressor()
        try:
            unpacked += unpacker.decompress(data, most + 1 - len(unpacked))
        except zstd.ZstdError as error:
            raise ValueError(str(error)) from None
        ended, data = unpacker.eof, unpacker.unused_data
        if not ended or len(unpacked) > most:
            break
    return _whole(unpacked, ended=ended, most=most)


def is_zstd(data: bytes) -> bool:
    """Return whether something is packed by zstd."""
    return bytes(data[: len(_ZSTD)]) == _ZSTD


def of_size(unpack: Callable[[bytes, int], bytes]) -> Callable[[bytes, int], bytes]:
    """Return a decompressor that checks the size announced for the result."""

    def bounded(data: bytes, size: int) -> bytes:
        if size > MAX_BYTES:
            raise ValueError(f"a chunk would unpack to {size >> 20} MB, more than {MAX_BYTES >> 20} MB")
        return unpack(data, size)

    return bounded


def check_file(path: Path) -> None:
    """Refuse, by a ValueError, a file packed by zstd that would unpack to something enormous."""
    with open_regular(path) as packed:
        if not is_zstd(packed.read(len(_ZSTD))):
            return
        packed.seek(0)
        left = max(MAX_BYTES, MAX_RATIO * os.fstat(packed.fileno()).st_size)
        file = zstd.open(packed, "rb")
        while piece := file.read(PIECE_BYTES):
            left -= len(piece)
            if left < 0:
                raise ValueError(f"{path.name} would unpack to more than {MAX_RATIO} times its size")


def _whole(unpacked: bytes, *, ended: bool, most: int) -> bytes:
    if len(unpacked) > most:
        raise ValueError(f"a chunk would unpack to more than announced, or than {MAX_BYTES >> 20} MB")
    if not ended:
        raise ValueError("a chunk is cut off")
    return unpacked


_ROS1 = b"#ROSBAG V"
_MCAP = b"\x89MCAP0\r\n\x01"  # magic bytes: the format, and the start of a header
_PROFILE_AT = 21  # behind the header's length and that of the profile's name


def _definition(
    schema: storage_mcap.Schema | None, known: Callable[[storage_mcap.Schema | None], MessageDefinition]
) -> MessageDefinition:
    """Return the definition of a message, also of ROS 1, which the library has no name for."""
    if schema is not None and schema.encoding == "ros1msg":
        return MessageDefinition(MessageDefinitionFormat.MSG, schema.data)
    return known(schema)


# The library unpacks chunks of MCAP to whatever they hold, and has no other place to say how, nor what it may read.
storage_mcap.DECOMPRESSORS.update(lz4=of_size(from_lz4), zstd=of_size(from_zstd))
storage_mcap.get_msgdef = partial(_definition, known=storage_mcap.get_msgdef)


@dataclass(frozen=True)
class Stamp:
    """Which message of a topic."""

    received_ns: int
    """Time at which the bag received it."""
    ordinal: int = 0
    """Place among the messages of the topic that were received at that very time."""


@dataclass(frozen=True)
class Bag:
    """A bag that is open while it is used."""

    path: Path
    """`*.bag`, `*.mcap`, `*.db3`, or the folder of a ROS 2 bag."""

    @cached_property
    def is_ros1(self) -> bool:
        """Whether its messages are those of ROS 1, whose fields are named in capitals."""
        return self._is_bag or (self.path.suffix.lower() == ".mcap" and _profile(self.path) == "ros1")

    @property
    def types(self) -> dict[str, str]:
        """Message types by topic, as in `sensor_msgs/msg/Image`."""
        named = ((str(connection.topic), _kind(connection)) for connection in self._reader.connections)
        return {topic: kind for topic, kind in named if topic.isprintable()}

    def messages(self, topic: str, most: int | None = None) -> Iterator[tuple[Stamp, Any]]:
        """Read the messages of a topic in the order in which they were received."""
        with input_errors(self.path, "bag", self._advice):
            stamp = Stamp(-1)
            for count, (connection, received_ns, data) in enumerate(self._reader.messages(self._of(topic))):
                if count == most:
                    return
                alike = stamp.received_ns == received_ns
                stamp = replace(stamp, ordinal=stamp.ordinal + 1) if alike else Stamp(received_ns)
                yield stamp, self._message(connection, data)

    def first(self, topic: str) -> Any | None:
        """Return the first message of a topic; None if it has none."""
        return next((message for _, message in self.messages(topic)), None)

    def message(self, topic: str, stamp: Stamp) -> Any:
        """Return one message."""
        with input_errors(self.path, "bag", self._advice):
            start = stamp.received_ns
            found = self._reader.messages(self._of(topic), start=start, stop=start + 1)
            for place, (connection, _, data) in enumerate(found):
                if place == stamp.ordinal:
                    return self._message(connection, data)
            raise InputError(f"{self.path}: lacks a message of {topic} that it had; record it again.")

    def _of(self, topic: str) -> list[Connection]:
        return [connection for connection in self._reader.connections if str(connection.topic) == topic]

    def _message(self, connection: Connection, data: bytes) -> Any:
        store, kind = _typestore(ros1=self.is_ros1), _kind(connection)
        if not self.is_ros1:
            # Recorders pack messages by themselves and need not say so; no message begins as packed ones do.
            return store.deserialize_cdr(from_zstd(data) if is_zstd(data) else data, kind)
        return store.deserialize_ros1(_image_alone(data) if kind == "sensor_msgs/msg/Image" else data, kind)

    @property
    def _advice(self) -> str:
        return "reindex it (rosbag reindex), or record it again" if self._is_bag else "record or copy it again"

    @property
    def _is_bag(self) -> bool:
        """Whether it is a file of ROS 1's own format."""
        return self.path.suffix.lower() == ".bag"

    @cached_property
    def _reader(self) -> rosbag1.Reader | rosbag2.Reader:
        """Return the open reader, which is closed when this bag is forgotten."""
        with input_errors(self.path, "bag", self._advice):
            if self._is_bag:
                _check_start(self.path)
                reader = rosbag1.Reader(self.path)
                reader.open()
                reader.chunks = {place: _bounded(chunk) for place, chunk in reader.chunks.items()}
            else:
                reader = _ros2(self.path)
                if reader.compression_mode == "message":  # which we unpack ourselves
                    reader.storage.metadata = reader.storage.metadata._replace(compression_mode=None)
            weakref.finalize(self, reader.close)
            return reader


def _kind(connection: Connection) -> str:
    """Return the type of a topic's messages as ROS 2 writes it, `sensor_msgs/msg/Image`, also where ROS 1 did."""
    kind = str(connection.msgtype)
    return kind.replace("/", "/msg/") if kind.count("/") == 1 else kind


def _image_alone(data: bytes) -> bytes:
    """Return a ROS 1 image message without the bytes that RealSense's recorder leaves behind it."""
    at = 12  # behind number and time
    for fixed in (8, 5, 0):  # strings and pixels are preceded by their lengths; between them: size, byte order and step
        (length,) = struct.unpack_from("<I", data, at)
        at += 4 + length + fixed
    return data[:at]


@lru_cache(maxsize=2)
def _typestore(*, ros1: bool) -> Typestore:
    """Return the standard messages, which are the same in all versions for images and cameras."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if ros1:  # whose standard messages lack it
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


def _bounded(chunk: Chunk) -> Chunk:
    """Return a chunk that refuses to unpack to something enormous."""
    unpack = {bz2.decompress: from_bz2, lz4.frame.decompress: from_lz4}.get(chunk.decompressor)
    return chunk if unpack is None else chunk._replace(decompressor=unpack)


def _check_start(path: Path) -> None:
    """Refuse a file that does not start as a bag of ROS 1: the library would search for the end of its first line."""
    with open_regular(path) as file:
        if not file.read(len(_ROS1)).startswith(_ROS1):
            raise ValueError("it does not start with #ROSBAG")


def _ros2(path: Path) -> rosbag2.Reader:
    """Return an open reader of a bag of ROS 2."""
    for entry in entries(path):
        check_link(entry, path)
        check_file(entry)
    reader = rosbag2.Reader(path)
    if isinstance(reader.storage, DirectoryReader):
        read_text(path / "metadata.yaml")
        storage: Any = reader.storage
        storage.STORAGE_PLUGINS = {**storage.STORAGE_PLUGINS, "sqlite3": database}
    elif isinstance(reader.storage, Sqlite3Reader):
        reader.storage = database(path)
    else:
        _check_profile(path)
        if _profile(path) == "ros1" and isinstance(reader.storage, storage_mcap.McapReader):
            reader.storage.path = cast("Path", _AsRos2(path))
    reader.open()
    return reader


@dataclass(frozen=True)
class _AsRos2:
    """An MCAP file of ROS 1 that calls itself one of ROS 2, for the library opens no other and reads both alike."""

    path: Path

    def open(self, mode: str) -> BinaryIO:
        """Open the file."""
        return io.BufferedReader(_Renamed(self.path, mode))


class _Renamed(io.FileIO):
    """A file in which the last letter of the profile reads 2."""

    def readinto(self, buffer: Any) -> int:
        """Read into a buffer and return how many bytes."""
        place = _PROFILE_AT + 3 - self.tell()
        count = super().readinto(buffer) or 0
        if 0 <= place < count:
            buffer[place : place + 1] = b"2"
        return count


def _profile(path: Path) -> str | None:
    """Return the profile of an MCAP file, such as `ros2`; None if it is no MCAP file."""
    with open_regular(path) as file:
        start = file.read(_PROFILE_AT + 64)
    if not start.startswith(_MCAP) or len(start) < _PROFILE_AT:
        return None
    (length,) = struct.unpack_from("<I", start, _PROFILE_AT - 4)
    return start[_PROFILE_AT : _PROFILE_AT + min(length, 32)].decode("ascii", "replace")


def _check_profile(path: Path) -> None:
    """Refuse an MCAP file of messages that are not ROS's, as far as its header says so."""
    profile = _profile(path)
    if profile not in ("ros1", "ros2", None):  # the library rejects other files
        raise InputError(
            f"{path}: holds messages of profile {profile!r} where those of ROS are read from MCAP; record it with ROS."
        )
