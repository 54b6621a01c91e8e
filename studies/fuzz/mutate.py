"""Ways to damage bytes."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence

import numpy as np

TOKENS = (
    b"",
    b"0",
    b"-1",
    b"NaN",
    b"Infinity",
    b"1e400",
    b"null",
    b"[]",
    b"{}",
    b'""',
    b"\0",
    b"\n",
    b" ",
    b"\xff" * 8,
    b"\x00" * 8,
    b"9" * 30,
    b"99999999999999999999",
    b"../",
    b"[" * 200,
    b"true",
    b"%s",
    "é三".encode(),
)
"""What parsers stumble over."""
NUMBERS = (0, 1, 2, 255, 256, 32767, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1)


def mutated(content: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """Return content with one kind of damage or several.

    Args:
        content: intact bytes.
        others: more intact bytes, of which pieces may be taken.
        rng: decides.
    """
    for _ in range(int(rng.geometric(0.6))):
        content = _once(content, others, rng)
    return with_sums(content) if content.startswith(b"\x89PNG") and rng.random() < 0.7 else content


def _once(content: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    size = len(content)
    at = int(rng.integers(0, size + 1))
    length = int(min(size - at, rng.integers(0, 64)))
    match int(rng.integers(0, 9)):
        case 0:  # flip a few bits
            data = bytearray(content)
            for place in rng.integers(0, max(size, 1), int(rng.integers(1, 9))) if size else ():
                data[place] ^= 1 << int(rng.integers(8))
            return bytes(data)
        case 1:  # cut off
            return content[:at]
        case 2:  # cut out
            return content[:at] + content[at + length :]
        case 3:  # repeat
            return content[: at + length] + content[at : at + length] * int(rng.integers(1, 4)) + content[at + length :]
        case 4:  # a token instead
            token = TOKENS[int(rng.integers(len(TOKENS)))]
            return content[:at] + token + content[at + (length if rng.random() < 0.5 else 0) :]
        case 5:  # a number instead
            number, wide = NUMBERS[int(rng.integers(len(NUMBERS)))], int(rng.choice([1, 2, 4, 8]))
            packed = struct.pack("<Q", number)[:wide]
            packed = packed[::-1] if rng.random() < 0.5 else packed
            return content[:at] + packed + content[at + wide :]
        case 6:  # a piece of another
            other = others[int(rng.integers(len(others)))]
            start = int(rng.integers(0, len(other) + 1))
            return content[:at] + other[start : start + length] + content[at + length :]
        case 7:  # a digit instead
            digits = [place for place in range(at, min(size, at + 400)) if 48 <= content[place] <= 57]
            if not digits:
                return content
            place = digits[int(rng.integers(len(digits)))]
            return content[:place] + b"%d" % rng.integers(0, 10) + content[place + 1 :]
        case _:  # anything
            return content[:at] + rng.bytes(length) + content[at + length :]


def with_sums(content: bytes) -> bytes:
    """Return a PNG with its check sums put right, so that what they protect is reached."""
    data, at = bytearray(content), 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        if at + 12 + length > len(data):
            break
        struct.pack_into(">I", data, at + 8 + length, zlib.crc32(data[at + 4 : at + 8 + length]))
        at += 12 + length
    return bytes(data)
