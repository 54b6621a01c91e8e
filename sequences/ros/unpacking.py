"""Compressed parts of bags, unpacked to no more than they may hold."""

from __future__ import annotations

import bz2
import sys
from collections.abc import Callable
from pathlib import Path

import lz4.frame

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAX_BYTES = 1 << 30
"""Chunks and messages that would unpack to more are refused."""
MAX_RATIO = 100
"""So are larger files that would unpack to more than so many times their size: depth images are not so dull."""
_PIECE = 1 << 20
_ZSTD = b"\x28\xb5\x2f\xfd"  # what its files begin with


def from_bz2(data: bytes, most: int = MAX_BYTES) -> bytes:
    """Return what was packed.

    Raises:
        ValueError: where that is more than `most` bytes, or cut off.
    """
    unpacker = bz2.BZ2Decompressor()
    return _whole(unpacker.decompress(data, most + 1), ended=unpacker.eof, most=most)


def from_lz4(data: bytes, most: int = MAX_BYTES) -> bytes:
    """Return what was packed.

    Raises:
        ValueError: where that is more than `most` bytes, or cut off.
    """
    unpacker = lz4.frame.LZ4FrameDecompressor()
    unpacked = unpacker.decompress(data, most + 1)
    return _whole(unpacked, ended=bool(unpacker.eof), most=most)


def from_zstd(data: bytes, most: int = MAX_BYTES) -> bytes:
    """Return what was packed.

    Raises:
        ValueError: where that is more than `most` bytes, cut off, or not packed by zstd.
    """
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
    """Return what unpacks to a size that is told beforehand, if it is one that may be."""

    def bounded(data: bytes, size: int) -> bytes:
        if size > MAX_BYTES:
            raise ValueError(f"a chunk would unpack to {size >> 20} MB, more than {MAX_BYTES >> 20} MB")
        return unpack(data, size)

    return bounded


def check_file(path: Path) -> None:
    """Refuse a file packed by zstd that would unpack to something enormous; other files may be what they are.

    Raises:
        ValueError: where it would.
    """
    with path.open("rb") as file:
        if not is_zstd(file.read(len(_ZSTD))):
            return
    left = max(MAX_BYTES, MAX_RATIO * path.stat().st_size)
    with zstd.open(path, "rb") as file:
        while piece := file.read(_PIECE):
            left -= len(piece)
            if left < 0:
                raise ValueError(f"{path.name} would unpack to more than {MAX_RATIO} times its size")


def _whole(unpacked: bytes, *, ended: bool, most: int) -> bytes:
    if len(unpacked) > most:
        raise ValueError(f"a chunk would unpack to more than it says, or than {MAX_BYTES >> 20} MB")
    if not ended:
        raise ValueError("a chunk is cut off")
    return unpacked
