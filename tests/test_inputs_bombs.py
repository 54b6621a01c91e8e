"""Inputs that are small on the disk and huge in memory are refused before they are unpacked, in one line."""

import bz2
import io
import json
import struct
import tempfile
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from PIL import Image
from rosbags import rosbag1, rosbag2
from slow_cases import quick_first

from modeler.sequences import open_sequence
from modeler.sequences.ros import bag
from modeler.sequences.ros.bag import Bag, from_bz2, from_lz4, from_zstd
from studies.formats.clouds import WRITERS as CLOUDS
from studies.formats.image_folders import small_frames, write_open3d
from studies.formats.ros_bags import Recorder

MEGABYTE = 1 << 20
PACKERS: dict[str, Callable[[bytes], bytes]] = {"lz4": lz4.frame.compress, "zstd": bag.zstd.compress}
UNPACKERS = {
    "bz2": (bz2.compress, from_bz2),
    "lz4": (lz4.frame.compress, from_lz4),
    "zstd": (PACKERS["zstd"], from_zstd),
}


@contextmanager
def frugal() -> Iterator[None]:
    """See to it that at no time more than 20 MB come into use."""
    tracemalloc.start()
    try:
        yield
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 20 * MEGABYTE


@pytest.fixture
def refused(refusal: Callable[..., str]) -> Callable[[Path], str]:
    """Return what gives the line that says why a path is not read."""

    def line(path: Path) -> str:
        said = refusal("build", path, "--out", path.parent / "run")
        assert str(path) in said
        assert not (path.parent / "run").exists()
        return said

    return line


# Chunks of bags


@pytest.mark.parametrize("kind", UNPACKERS)
def test_what_was_packed_comes_out_unless_it_is_too_much(kind: str) -> None:
    pack, unpack = UNPACKERS[kind]
    content = bytes(range(256)) * 40
    packed = pack(content)
    assert unpack(packed) == unpack(packed, len(content)) == content
    assert unpack(pack(b"")) == b""
    for cut in (0, 1, len(packed) // 2, len(packed) - 1):
        with pytest.raises((ValueError, OSError, RuntimeError, EOFError, bag.zstd.ZstdError)):
            unpack(packed[:cut])
    large = pack(bytes(32 * MEGABYTE))
    for much, limit in ((packed, len(content) - 1), (large, MEGABYTE)):
        with frugal(), pytest.raises(ValueError, match="more than"):
            unpack(much, limit)


def test_frames_in_a_row_count_together() -> None:
    pack = PACKERS["zstd"]
    assert from_zstd(pack(b"a" * 10) + pack(b"b" * 10)) == b"a" * 10 + b"b" * 10
    with pytest.raises(ValueError, match="more than"):
        from_zstd(pack(b"a" * 10) + pack(b"b" * 10), 19)


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def text(words: str) -> bytes:
    return struct.pack("<I", len(words)) + words.encode()


def mcap(announced: int, packed: bytes, packer: str, kept: int | None = None) -> bytes:
    """Return an MCAP file of one chunk that says of itself how large it is."""
    sizes = struct.pack("<QQQI", 0, 1, announced, 0)
    chunk = record(6, sizes + text(packer) + struct.pack("<Q", len(packed) if kept is None else kept) + packed)
    magic = b"\x89MCAP0\r\n"
    return magic + record(1, text("ros2") + text("")) + chunk + record(2, struct.pack("<QQI", 0, 0, 0)) + magic


@pytest.mark.parametrize("packer", PACKERS)
@pytest.mark.parametrize("announced", quick_first([1 << 33, 1000, 1 << 63]))
def test_a_chunk_of_mcap_is_bounded(
    tmp_path: Path, refused: Callable[[Path], str], packer: str, announced: int
) -> None:
    path = tmp_path / "s.mcap"
    path.write_bytes(mcap(announced, PACKERS[packer](bytes(64 * MEGABYTE)), packer))
    refused(path)  # what is loaded once shall not count
    with frugal():
        said = refused(path)
    assert ("more than announced" if announced == 1000 else "MB, more than 1024 MB") in said


def test_a_chunk_of_mcap_larger_than_its_file_is_refused(tmp_path: Path, refused: Callable[[Path], str]) -> None:
    for kept in (1 << 40, 1 << 63):
        path = tmp_path / "s.mcap"
        path.write_bytes(mcap(1000, b"x" * 10, "zstd", kept))
        assert "not a readable bag" in refused(path)


@pytest.mark.parametrize("compression", rosbag1.Writer.CompressionFormat)
def test_chunks_of_ros_1_are_bounded(tmp_path: Path, compression: rosbag1.Writer.CompressionFormat) -> None:
    path = Recorder(compression=compression).write(tmp_path / "s.bag", small_frames(1))
    for chunk in Bag(path)._reader.chunks.values():  # type: ignore[union-attr]
        assert chunk.decompressor in (from_bz2, from_lz4)


def test_a_packed_file_of_a_bag_is_bounded(
    tmp_path: Path, refused: Callable[[Path], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag, "MAX_BYTES", 3 * MEGABYTE)
    path = Recorder(packed=rosbag2.CompressionMode.FILE).write(tmp_path / "s", small_frames(2))
    assert len(open_sequence(path)) == 2
    next(path.glob("*.zstd")).write_bytes(PACKERS["zstd"](bytes(4 * MEGABYTE)))
    before = set(Path(tempfile.gettempdir()).iterdir())
    assert "more than 100 times its size" in refused(path)
    assert {place for place in set(Path(tempfile.gettempdir()).iterdir()) - before if place.name[:3] == "tmp"} == set()


def test_links_in_the_folder_of_a_bag_stay_in_it(tmp_path: Path, refused: Callable[[Path], str]) -> None:
    path = Recorder().write(tmp_path / "s", small_frames(1))
    inner = next(path.glob("*.mcap"))
    inner.rename(tmp_path / inner.name)
    inner.symlink_to(tmp_path / inner.name)
    assert "leads out of the sequence" in refused(path)


# Pictures


def tiff(width: int, height: int) -> bytes:
    """Return a TIFF of 16 bits whose header claims a size."""
    packed = io.BytesIO()
    Image.fromarray(np.zeros((4, 4), np.uint16)).save(packed, "TIFF")
    content = bytearray(packed.getvalue())
    (start,) = struct.unpack_from("<I", content, 4)
    (count,) = struct.unpack_from("<H", content, start)
    for place in range(start + 2, start + 2 + 12 * count, 12):
        (tag,) = struct.unpack_from("<H", content, place)
        if tag in (256, 257):
            struct.pack_into("<HII", content, place + 2, 4, 1, width if tag == 256 else height)
    return bytes(content)


def jpeg(width: int, height: int) -> bytes:
    """Return a JPEG whose header claims a size."""
    packed = io.BytesIO()
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(packed, "JPEG")
    content = bytearray(packed.getvalue())
    struct.pack_into(">HH", content, content.index(b"\xff\xc0") + 5, height, width)
    return bytes(content)


@pytest.mark.parametrize("kind", ["jpeg", "tiff"])
def test_pictures_that_claim_to_be_huge_are_not_unpacked(
    tmp_path: Path, refusal: Callable[..., str], kind: str
) -> None:
    path = tmp_path / "s"
    write_open3d(path, small_frames(2))
    if kind == "jpeg":
        (path / "color" / "000001.jpg").write_bytes(jpeg(60_000, 60_000))
    else:
        camera = {"cam_K": [150, 0, 80, 0, 150, 60, 0, 0, 1], "depth_scale": 1}
        (path / "scene_camera.json").write_text(json.dumps({"0": camera}))
        for picture in (path / "depth").iterdir():
            picture.unlink()
        (path / "depth" / "000000.tif").write_bytes(tiff(100_000, 100_000))
    assert "million pixels" in refusal("info", path)


def test_a_cloud_that_claims_more_than_its_bytes_can_hold_is_not_unpacked(
    tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    path = tmp_path / "s.pcd"
    CLOUDS["pcd compressed"][1](path, small_frames(1)[0])
    (tmp_path / "intact.pcd").write_bytes(path.read_bytes())
    assert len(open_sequence(tmp_path / "intact.pcd")) == 1
    large = path.read_bytes().replace(b"WIDTH 160", b"WIDTH 7000").replace(b"HEIGHT 120", b"HEIGHT 7000")
    path.write_bytes(large.replace(b"POINTS 19200", b"POINTS 49000000"))
    assert "is cut off" in refused(path)
