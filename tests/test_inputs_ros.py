"""ROS 1 and ROS 2 bags and MCAP files: what was recorded is what is read."""

import contextlib
import dataclasses
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags import rosbag1, rosbag2

from modeler.sequences import Overrides, open_sequence
from modeler.sequences.lens import Lens
from modeler.sequences.ros import RosSequence, messages
from modeler.sequences.ros.bag import zstd
from modeler.types import Camera, Frame, InputError
from studies.formats.image_folders import small_frames, unchecked
from studies.formats.recorded import foxglove, scene, unpacked
from studies.formats.ros_bags import COLOUR_FROM_DEPTH, START_NS, Recorder, Rig

SUFFIXES = (".bag", ".mcap", ".db3", "")


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_what_was_recorded_is_read(tmp_path: Path, frames: list[Frame], suffix: str, encoding: str) -> None:
    path = Recorder(encoding).write(tmp_path / f"two boxes{suffix}", frames)
    sequence = open_sequence(path)
    assert sequence.indices == (0, 1, 2, 3)
    assert sequence.name == "two boxes"
    assert sequence.layout.startswith({".bag": "ROS 1 bag", ".mcap": "MCAP file"}.get(suffix, "ROS 2 bag"))
    assert sequence.depth_unit == ("1 mm (16UC1)" if encoding == "16UC1" else "m (32FC1)")
    assert sequence.truth() is None
    for read, wrote in zip(sequence, frames, strict=True):
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(read.colour, wrote.colour)  # type: ignore[arg-type]
        assert read.camera == wrote.camera
        assert read.time_s == pytest.approx(START_NS * 1e-9 + wrote.time_s, abs=1e-6)
    again = sequence.frame(1)  # in any order
    np.testing.assert_allclose(again.depth_m, frames[1].depth_m, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "recorder",
    [
        Recorder("mono16", "bgr8"),
        Recorder("16UC1", "bgra8", big_endian=True),
        Recorder("32FC1", "mono8", big_endian=True, padding=12),
        Recorder("16UC1", "rgb8", padding=5),
        Recorder("compressedDepth", "jpeg"),
        Recorder(compression=rosbag1.Writer.CompressionFormat.LZ4),
        Recorder(compression=rosbag1.Writer.CompressionFormat.BZ2),
    ],
)
@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_every_way_of_storing_pixels_is_read(
    tmp_path: Path, frames: list[Frame], recorder: Recorder, suffix: str
) -> None:
    sequence = open_sequence(recorder.write(tmp_path / f"s{suffix}", frames))
    for read, wrote in zip(sequence, frames, strict=True):
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, rtol=0, atol=1e-6)
        expected = wrote.colour[..., 1:2].repeat(3, axis=2) if recorder.colour == "mono8" else wrote.colour
        assert np.abs(read.colour.astype(float) - expected).mean() < (3.0 if recorder.colour == "jpeg" else 1e-9)


@pytest.mark.parametrize("packed", rosbag2.CompressionMode)
def test_packed_bags_of_ros_2_are_read(tmp_path: Path, frames: list[Frame], packed: rosbag2.CompressionMode) -> None:
    sequence = open_sequence(Recorder(packed=packed).write(tmp_path / "s", frames))
    for index in (2, 0, 1):
        np.testing.assert_allclose(sequence.frame(index).depth_m, frames[index].depth_m, rtol=0, atol=1e-6)


def test_colour_is_optional_and_must_be_aligned(tmp_path: Path, frames: list[Frame]) -> None:
    bare = open_sequence(Recorder(colour=None).write(tmp_path / "bare.bag", frames))
    assert bare.frame(0).colour is None
    assert bare.notes == ()
    other = open_sequence(Recorder(colour_scale=1.2).write(tmp_path / "other.bag", frames))
    assert other.frame(0).colour is None
    (note,) = other.notes
    assert "/camera/rgb/image_raw is not aligned" in note
    forced = open_sequence(tmp_path / "other.bag", Overrides(colour_topic="/camera/rgb/image_raw"))
    assert forced.frame(0).colour is not None


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_colour_of_a_camera_that_is_fixed_beside_is_aligned(tmp_path: Path, frames: list[Frame], suffix: str) -> None:
    """As realsense-ros records: both optical frames hang on one link."""
    sequence = open_sequence(Rig(colour_scale=1.1).write(tmp_path / f"s{suffix}", frames))
    assert sequence.notes == ()
    assert isinstance(sequence, RosSequence)
    np.testing.assert_allclose(sequence.colour.alignment.colour_from_depth, COLOUR_FROM_DEPTH, atol=1e-12)
    for read in sequence:
        assert (read.colour.sum(axis=2) > 0).mean() > 0.3


def test_images_come_in_order_of_capture_each_once(tmp_path: Path, frames: list[Frame]) -> None:
    shuffled = [frames[place] for place in (1, 0, 0, 2)]
    shuffled[2] = dataclasses.replace(shuffled[2], index=9)
    sequence = open_sequence(Recorder().write(tmp_path / "s.bag", shuffled))
    for read, wrote in zip(sequence, frames[:3], strict=True):
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, rtol=0, atol=1e-6)


def test_several_depth_topics_need_a_choice(tmp_path: Path, frames: list[Frame]) -> None:
    def named(depth: str, colour: str) -> dict[str, str]:
        return {"depth": depth, "info": "/a/camera_info", "colour": colour, "colour_info": "/b/camera_info"}

    path = Recorder(colour="rgb8", names=named("/a/depth", "/b/rgb")).write(tmp_path / "one.bag", frames)
    assert open_sequence(path).frame(0).colour is not None
    both = tmp_path / "both.bag"
    Two("16UC1", "32FC1", names=named("/a/depth_one", "/a/depth_two")).write(both, frames)
    with pytest.raises(InputError, match=r"/a/depth_one, /a/depth_two.*`depth_topic`"):
        open_sequence(both)
    assert "topic /a/depth_two" in open_sequence(both, Overrides(depth_topic="/a/depth_two")).layout
    with pytest.raises(InputError, match="/c holds no depth images"):
        open_sequence(both, Overrides(depth_topic="/c"))


class Two(Recorder):
    """Records depth twice, the second time as floats."""

    def _colour(self, types, header, colour):
        depth = np.full(colour.shape[:2], 0.7, np.float32)
        return self._image(types, header, "32FC1", depth)


# Lenses


def test_distortion_is_taken_out(tmp_path: Path) -> None:
    """A slanted plane seen through a bent lens comes out as a plane."""
    camera = Camera(160, 120, 140.0, 141.0, 79.0, 60.5)
    lens = Lens(camera, (-0.35, 0.12, 0.003, -0.002))
    w, h = camera.rays()
    for _ in range(100):  # rays whose bent image the pixels are
        bent_w, bent_h = lens.distort(w, h)
        straight_w, straight_h = camera.rays()
        w, h = w + straight_w - bent_w, h + straight_h - bent_h
    depth_m = (1.0 / (1.2 - 0.6 * w + 0.3 * h)).astype(np.float32)
    frame = Frame(0, 0.0, depth_m, camera)
    path = Recorder("32FC1", None, distortion=lens.coefficients).write(tmp_path / "s.bag", [frame])
    read = open_sequence(path).frame(0)
    true_w, true_h = camera.rays()
    plane_m = 1.0 / (1.2 - 0.6 * true_w + 0.3 * true_h)
    seen = np.isfinite(read.depth_m)
    assert seen.mean() > 0.95
    np.testing.assert_allclose(read.depth_m[seen], plane_m[seen], rtol=0.006)  # within a pixel of slope
    assert np.abs(depth_m / plane_m - 1.0).max() > 0.02


# Faults


@pytest.fixture
def fails(refusal: Callable[..., str]) -> Callable[[Path], str]:
    """Return what gives the line with which a build refuses a recording."""

    def line(path: Path) -> str:
        said = refusal("build", path, "--out", path.parent / "run")
        assert not (path.parent / "run").exists()
        return said

    return line


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
@pytest.mark.parametrize("fault", ["truncated", "empty", "noise", "a folder"])
def test_broken_bags_are_one_line(
    tmp_path: Path, frames: list[Frame], fails: Callable[[Path], str], suffix: str, fault: str
) -> None:
    path = Recorder().write(tmp_path / f"s{suffix}", frames)
    content = path.read_bytes()
    path.unlink()
    if fault == "a folder":
        path.mkdir()
    else:
        damaged = {"truncated": content[: len(content) // 2], "empty": b"", "noise": b"noise" * 1000}
        path.write_bytes(damaged[fault])
    assert str(path) in fails(path)


def test_a_bag_of_ros_2_that_lacks_its_data_is_one_line(
    tmp_path: Path, frames: list[Frame], fails: Callable[[Path], str]
) -> None:
    path = Recorder().write(tmp_path / "s", frames)
    shutil.copytree(path, tmp_path / "yaml")
    (tmp_path / "yaml" / "metadata.yaml").write_text("rosbag2_bagfile_information: [1")
    assert "YAML" in fails(tmp_path / "yaml")
    next(path.glob("*.mcap")).unlink()
    assert "missing" in fails(path)


_HOSTILE = {
    "endless view": "DROP TABLE schema; CREATE VIEW schema AS WITH RECURSIVE r(schema_version) AS "
    "(SELECT 4 UNION ALL SELECT schema_version FROM r) SELECT max(schema_version) AS schema_version FROM r",
    "view of topics": "ALTER TABLE topics RENAME TO t; CREATE VIEW topics AS SELECT * FROM t",
    "generated": "CREATE TABLE m(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
    "data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL); INSERT INTO m SELECT id, topic_id, timestamp "
    "FROM messages; DROP TABLE messages; ALTER TABLE m RENAME TO messages",
}


@pytest.mark.parametrize("folder", [False, True])
@pytest.mark.parametrize("change", _HOSTILE)
def test_a_database_computes_nothing(
    tmp_path: Path, frames: list[Frame], fails: Callable[[Path], str], change: str, folder: bool
) -> None:
    path = Recorder().write(tmp_path / "s.db3", frames[:2])
    if folder:
        (tmp_path / "s" / path.name).write_bytes(path.read_bytes())
        path = tmp_path / "s"
    file = next(path.glob("*.db3")) if folder else path
    with contextlib.closing(sqlite3.connect(file)) as database:
        database.executescript(_HOSTILE[change])
    assert str(path) in fails(path)


def test_a_database_that_takes_too_long_is_one_line(
    tmp_path: Path, frames: list[Frame], fails: Callable[[Path], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("modeler.sequences.ros.bag._STEP", 10)
    monkeypatch.setattr("modeler.sequences.ros.bag._STEPS", 1)
    monkeypatch.setattr("modeler.sequences.ros.bag._STEPS_PER_BYTE", 0.0)
    assert "interrupted" in fails(Recorder().write(tmp_path / "s.db3", frames)).lower()


def test_messages_that_a_crashed_recorder_left_beside_the_bag_are_not_passed_over(
    tmp_path: Path, frames: list[Frame], fails: Callable[[Path], str]
) -> None:
    whole = Recorder().write(tmp_path / "s.db3", frames)
    with contextlib.closing(sqlite3.connect(whole)) as database:
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("UPDATE messages SET timestamp = timestamp + 1")
        database.commit()
        (tmp_path / "crashed").mkdir()
        for file in tmp_path.glob("s.db3*"):
            shutil.copy(file, tmp_path / "crashed")
    path = tmp_path / "crashed" / "s.db3"
    assert "s.db3-wal: the recorder ended before" in fails(path)
    with contextlib.closing(sqlite3.connect(path)) as database:  # as the message says
        database.execute("PRAGMA wal_checkpoint")
        database.execute("SELECT count(*) FROM messages")
    assert len(open_sequence(path)) == len(frames)


def test_recordings_without_what_is_needed_are_one_line(
    tmp_path: Path, frames: list[Frame], fails: Callable[[Path], str]
) -> None:
    no_info = Recorder(camera_info=False).write(tmp_path / "no_info.bag", frames)
    assert "no camera_info" in fails(no_info)
    assert open_sequence(no_info, Overrides(intrinsics=(140.0, 140.0, 80.0, 60.0))).frame(0).camera.fx == 140.0
    flat = [dataclasses.replace(f, depth_m=np.full_like(f.depth_m, np.nan)) for f in frames]
    assert "all is 0 or NaN" in fails(Recorder("32FC1").write(tmp_path / "nan.bag", flat))
    large = [dataclasses.replace(f, depth_m=f.depth_m * 1000.0) for f in frames]
    assert "looks like millimetres" in fails(Recorder("32FC1").write(tmp_path / "mm.bag", large))
    small = [unchecked(f, depth_m=f.depth_m[:50]) for f in frames]
    assert "160 x 50 pixels" in fails(Recorder().write(tmp_path / "size.bag", small))
    bent = [unchecked(f, camera=unchecked(f.camera, fx=0.0)) for f in frames]
    assert "no usable K" in fails(Recorder().write(tmp_path / "k.bag", bent))
    assert "no depth images" in fails(Recorder("8UC1", None).write(tmp_path / "grey.bag", frames))
    cut = Cut().write(tmp_path / "cut.bag", frames)
    assert "it is cut off" in fails(cut)


class Cut(Recorder):
    """Records images that lack their last rows."""

    def _image(self, types, header, encoding, pixels):
        message = super()._image(types, header, encoding, pixels)
        return dataclasses.replace(message, data=message.data[:-1000]) if encoding == "16UC1" else message


def test_what_the_library_of_the_format_wrote_is_read(tmp_path: Path) -> None:
    sequence = open_sequence(unpacked("foxglove.mcap", tmp_path))
    assert sequence.layout == "MCAP file, topic /camera/depth/image_raw"
    assert len(sequence) == foxglove.COUNT
    width, height = foxglove.SIZE
    for number, frame in enumerate(sequence):
        raw = scene.depth(number, width, height)
        np.testing.assert_allclose(frame.depth_m, np.where(raw == 0, np.nan, raw * 0.001), rtol=1e-6)
        assert frame.camera == Camera(width, height, 45.0, 45.0, width / 2, height / 2)
        np.testing.assert_array_equal(frame.colour, scene.colour(number, width, height))
        assert frame.time_s == pytest.approx(1e-9 * (foxglove.START_NS + number * foxglove.STEP_NS), abs=1e-6)


@pytest.mark.parametrize(
    "recorder",
    [
        Recorder(ros1=True),
        Recorder("32FC1", "bgr8", ros1=True, packed=rosbag2.CompressionMode.STORAGE),
        Recorder("compressedDepth", "jpeg", ros1=True),
        Rig(ros1=True, colour_scale=1.1),
    ],
    ids=["raw", "packed", "pictures", "fixed frames"],
)
def test_mcap_of_ros1_is_read_as_its_bag(tmp_path: Path, frames: list[Frame], recorder: Recorder) -> None:
    mcap = recorder.write(tmp_path / "s.mcap", frames)
    bag = dataclasses.replace(recorder, ros1=False, packed=None).write(tmp_path / "s.bag", frames)
    assert mcap.read_bytes()[17:25] == b"\x04\0\0\0ros1"
    ours, theirs = open_sequence(mcap), open_sequence(bag)
    assert ours.layout.removeprefix("MCAP file") == theirs.layout.removeprefix("ROS 1 bag")
    assert (ours.indices, ours.depth_unit, ours.notes) == (theirs.indices, theirs.depth_unit, theirs.notes)
    for one, other in zip(ours, theirs, strict=True):
        assert (one.camera, one.time_s) == (other.camera, other.time_s)
        np.testing.assert_array_equal(one.depth_m, other.depth_m)
        np.testing.assert_array_equal(one.colour, other.colour)


def test_mcap_of_other_systems_says_so(tmp_path: Path, refusal: Callable[..., str]) -> None:
    path = unpacked("foxglove.mcap", tmp_path)
    content = path.read_bytes()
    assert content[17:25] == b"\x04\0\0\0ros2"
    path.write_bytes(content[:21] + b"ros3" + content[25:])
    said = refusal("info", path)
    assert said.startswith(f"modeler: {path}: ")
    assert "'ros3'" in said


@pytest.mark.parametrize(
    ("given", "data", "says"),
    [
        ("YUYV; zstd; 4x2 step=8", b"nothing", "cannot be unpacked"),
        ("YUYV; zstd; 4x2 step=8", zstd.compress(bytes(16))[:-3], "cannot be unpacked"),
        ("YUYV; zstd; 4x2 step=8", zstd.compress(bytes(1000)), "cannot be unpacked"),
        ("YUYV; zstd; 4x2 step=8", zstd.compress(bytes(15)), "has 15 bytes"),
        ("UYVY; zstd; 4x2 step=7", zstd.compress(bytes(14)), "7 a row"),
        ("UYVY; zstd; 99999x99999 step=199998", zstd.compress(bytes(16)), "99999 x 99999 pixels"),
    ],
)
def test_packed_chroma_that_is_not_what_it_says_is_one_line(given: str, data: bytes, says: str) -> None:
    message = SimpleNamespace(__msgtype__=messages.PACKED, format=given, data=np.frombuffer(data, np.uint8))
    assert messages.is_colour(message)
    with pytest.raises(InputError, match=says):
        messages.colour(message, "here")


@pytest.mark.parametrize(("encoding", "order"), [("yuv422", (1, 0, 3, 2)), ("YUYV", (0, 1, 2, 3))])
def test_colour_that_shares_chroma_is_read(encoding: str, order: tuple[int, ...]) -> None:
    """White, black, red and blue as the standard has them, two pixels each."""
    colours = {(235, 128, 128): (255, 255, 255), (16, 128, 128): (0, 0, 0), (82, 90, 240): (255, 0, 0)}
    colours[(41, 240, 110)] = (0, 0, 255)
    y_u_y_v = np.array([[y, u, y, v] for y, u, v in colours], np.uint8)
    data = np.tile(np.pad(y_u_y_v[:, order].ravel(), (0, 3)), 2)
    message = SimpleNamespace(
        __msgtype__=messages.IMAGE, encoding=encoding, height=2, width=8, step=19, is_bigendian=0, data=data
    )
    assert messages.is_colour(message)
    assert not messages.is_depth(message)
    picture = messages.colour(message, "here")
    expected = np.repeat(np.array(list(colours.values())), 2, axis=0)
    assert np.abs(picture.astype(int) - expected).max() <= 2


@dataclasses.dataclass(frozen=True)
class OddColour(Recorder):
    """Has a colour camera of a kind that nobody knows."""

    def _camera(self, types: Any, header: Any, frame: Frame, scale: float, *, ros1: bool) -> Any:
        message = super()._camera(types, header, frame, scale, ros1=ros1)
        return dataclasses.replace(message, distortion_model="odd" if header.frame_id == "colour_info" else "plumb_bob")


def test_a_colour_camera_that_nobody_knows_costs_the_colour_alone(tmp_path: Path) -> None:
    recorder = OddColour(distortion=(-0.1, 0.0, 0.0, 0.0, 0.0))
    sequence = open_sequence(recorder.write(tmp_path / "s.bag", small_frames(2)))
    assert sequence.frame(0).colour is None
    (note,) = sequence.notes
    assert [words for words in ("/camera/rgb/image_raw", "/camera/rgb/camera_info", "'odd'") if words not in note] == []
