"""RealSense: recordings by the maker's own recorder, and a camera that is running."""

from __future__ import annotations

import itertools
import re
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import Recorder
from recordings import raw_depth, small_frames
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from modeler.cli import main
from modeler.types import Camera, Frame, InputError
from sequences import Given, open_sequence, survey
from sequences.lens import Lens
from sequences.live import AbstractCamera, begin
from sequences.realsense import open_camera
from sequences.ros import RosSequence

TURN = Rotation.from_rotvec([0.1, 0.3, -0.2]).as_matrix()
SHIFT_M = np.array([0.015, 0.001, 0.002])
STREAMS = ("/device_0/sensor_0/Depth_0", "/device_0/sensor_1/Color_0")


# What the recorder of versions up to 2.56 writes: messages of ROS 1, with four bytes behind each image.


class OldRecorder(Recorder):
    """Adds to a bag what RealSense's recorder adds."""

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


def assert_motion(sequence: object) -> None:
    assert isinstance(sequence, RosSequence)
    assert sequence.colour is not None
    assert sequence.colour.alignment is not None
    motion = sequence.colour.alignment.colour_from_depth
    np.testing.assert_allclose(motion[:3, :3], TURN, atol=1e-5)
    np.testing.assert_allclose(motion[:3, 3], SHIFT_M, atol=1e-6)


def test_bags_of_the_old_recorder_are_read(tmp_path: Path) -> None:
    frames = small_frames(2)
    recorder = OldRecorder("mono16", "rgb8", names=NAMES, colour_scale=1.1)
    sequence = open_sequence(recorder.write(tmp_path / "s.bag", frames))
    assert sequence.depth_unit == "0.25 mm (/device_0/sensor_0/option/Depth Units/value)"
    assert "by RealSense" in sequence.layout
    for read, wrote in zip(sequence, frames, strict=True):
        np.testing.assert_allclose(
            read.depth_m, raw_depth(wrote, 1.0) * 0.00025 + np.where(np.isnan(wrote.depth_m), np.nan, 0), rtol=1e-5
        )
        assert read.colour is not None
    assert_motion(sequence)


# What the recorder that is installed writes; since 2.57 a bag of ROS 2.


@pytest.fixture
def rs() -> Any:
    return pytest.importorskip("pyrealsense2")


@dataclass
class Device:
    """A camera that exists in software only."""

    rs: Any
    kept: list[np.ndarray] = field(default_factory=list)

    def __post_init__(self) -> None:
        rs = self.rs
        self.device = rs.software_device()
        self.sensors = [self.device.add_sensor(name) for name in ("Depth", "Color")]
        self.sensors[0].add_read_only_option(rs.option.depth_units, 0.00025)
        self.profiles = []
        kinds = (
            (rs.stream.depth, rs.format.z16, 64, 48, 60.0, 2),
            (rs.stream.color, rs.format.rgb8, 128, 96, 125.0, 3),
        )
        for uid, (kind, pixels, width, height, focal_px, size) in enumerate(kinds):
            lens = rs.intrinsics()
            lens.width, lens.height, lens.fx, lens.fy = width, height, focal_px, focal_px
            lens.ppx, lens.ppy, lens.model, lens.coeffs = width / 2, height / 2, rs.distortion.brown_conrady, [0.0] * 5
            stream = rs.video_stream()
            stream.type, stream.index, stream.uid, stream.width, stream.height = kind, 0, uid, width, height
            stream.fps, stream.bpp, stream.fmt, stream.intrinsics = 30, size, pixels, lens
            self.profiles.append(self.sensors[uid].add_video_stream(stream))
        motion = rs.extrinsics()
        motion.rotation, motion.translation = TURN.T.ravel().tolist(), SHIFT_M.tolist()  # columns in turn
        self.profiles[0].register_extrinsics_to(self.profiles[1], motion)
        self.device.create_matcher(rs.matchers.default)

    def see(self, number: int) -> None:
        depth, colour = np.full((48, 64), 3000 + number, np.uint16), np.full((96, 128, 3), 50 + number, np.uint8)
        for sensor, profile, pixels in zip(self.sensors, self.profiles, (depth, colour), strict=True):
            image = self.rs.software_video_frame()
            image.pixels, image.stride = pixels, pixels.strides[0]
            image.bpp = pixels.strides[1]
            image.timestamp, image.domain = 1000.0 * (1.0 + number / 30.0), self.rs.timestamp_domain.hardware_clock
            image.frame_number, image.profile = number + 1, profile.as_video_stream_profile()
            if pixels is depth:
                image.depth_units = 0.00025
            self.kept.append(pixels)
            sensor.on_video_frame(image)


def test_recordings_of_the_makers_recorder_are_read(rs: Any, tmp_path: Path) -> None:
    version = tuple(int(part) for part in re.findall(r"\d+", rs.__version__)[:2])
    path = tmp_path / ("s.db3" if version >= (2, 57) else "s.bag")
    device = Device(rs)
    recorder = rs.recorder(str(path), device.device)
    sensors, queue = recorder.query_sensors(), rs.frame_queue(50, True)
    for place in range(len(sensors)):
        sensors[place].open(sensors[place].get_stream_profiles()[0])
        sensors[place].start(queue)
    for number in range(3):
        device.see(number)
        time.sleep(0.1)
    time.sleep(0.3)
    for place in range(len(sensors)):
        sensors[place].stop()
        sensors[place].close()
    del recorder, sensors  # which writes the rest
    sequence = open_sequence(path)
    assert "by RealSense" in sequence.layout
    assert sequence.depth_unit.startswith("0.25 mm (/device_0/sensor_0/option/Depth")
    assert len(sequence) == 3
    for number, frame in enumerate(sequence):
        np.testing.assert_allclose(frame.depth_m, (3000 + number) * 0.00025, rtol=1e-6)
        camera = frame.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (60.0, 60.0, 32.0, 24.0)
        assert frame.colour is not None
        assert set(np.unique(frame.colour)) == {0, 50 + number}
    assert_motion(sequence)


# A camera that is running


@dataclass(frozen=True)
class StandIn(AbstractCamera):
    """A camera that sees one thing after the other."""

    frames: list[Frame]
    taken: list[int] = field(default_factory=list)

    @property
    def name(self) -> str:
        return "stand-in"

    @property
    def lens(self) -> Lens:
        return Lens(self.frames[0].camera, ())

    @property
    def unit_mm(self) -> float:
        return 1.0

    def take(self) -> tuple[float, np.ndarray, np.ndarray | None]:
        number = len(self.taken)
        self.taken.append(number)
        frame = self.frames[number % len(self.frames)]
        return 0.1 * number, raw_depth(frame, 1.0), frame.colour


def test_images_are_taken_when_they_are_asked_for() -> None:
    camera = StandIn(small_frames(3))
    sequence = begin(camera, first=2)
    assert sequence.live
    assert sequence.indices == (0, 1)
    assert len(survey(sequence.recorded()).indices) == 2
    assert len(camera.taken) == 2
    frames = list(itertools.islice(sequence, 4))
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert len(camera.taken) == 4
    np.testing.assert_allclose(frames[3].depth_m, frames[0].depth_m)
    assert frames[3].time_s == pytest.approx(0.3)
    seen: list[int] = []
    for frame in sequence.until(lambda: len(seen) == 3):
        seen.append(frame.index)
    assert seen == [0, 1, 2]
    assert [frame.index for frame in sequence.select(every=2, frames=slice(1, 6))] == [1, 3, 5]
    with pytest.raises(InputError, match="frame 7 is not kept; the first ones are 0 to 1"):
        sequence.frame(7)


def test_the_makers_library_is_driven_as_it_wants(rs: Any) -> None:
    """All but starting: a camera in software cannot be started by a pipeline."""
    with pytest.raises(InputError, match=r"realsense:(123)?: (no camera|cannot be started)"):
        open_camera("123", Given(), rs.context())


def test_without_the_library_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    assert main(["build", "realsense:", "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert "pip install 'modeler[realsense]'" in said
    assert said.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_recording_a_live_camera_needs_an_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    camera = StandIn(small_frames(3))
    monkeypatch.setattr(
        "modeler.cli.converting.open_sequence",
        lambda path, *_: begin(camera, 2) if str(path) == "realsense:" else open_sequence(path),
    )
    assert main(["convert", "realsense:", "--out", str(tmp_path / "bop")]) == 2
    assert "say how many frames to record" in capsys.readouterr().err
    assert main(["convert", "realsense:", "--frames", ":5", "--out", str(tmp_path / "bop")]) == 0
    assert open_sequence(tmp_path / "bop").indices == (0, 1, 2, 3, 4)


def test_a_camera_is_straightened() -> None:
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    lens = Lens(camera, (-0.3, 0.1))
    assert lens.bends
    straight = lens.straight(np.arange(64 * 48, dtype=np.uint16).reshape(48, 64))
    assert straight[0, 0] > 0  # from further in
    assert straight[24, 32] == 24 * 64 + 32
