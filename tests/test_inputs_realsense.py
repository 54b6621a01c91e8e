"""RealSense: recordings by the maker's own recorder, and a camera that is running."""

import itertools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_runner import Run

from modeler.cli import main
from modeler.export import RunFolder
from modeler.sequences import CalibratedSequence, NoiseModel, Overrides, open_sequence, survey
from modeler.sequences.lens import Lens, lens_of_model
from modeler.sequences.live import Image, RunningCamera, begin, opened, realsense
from modeler.sequences.ros import RosSequence
from modeler.types import Camera, Frame, InputError
from studies.formats.image_folders import raw_depth, small_frames
from studies.formats.recorded import realsense as recording
from studies.formats.recorded import scene, unpacked
from studies.formats.ros_bags import NAMES, SHIFT_M, TURN, OldRealSense


def assert_motion(sequence: object) -> None:
    assert isinstance(sequence, RosSequence)
    motion = sequence.colour.alignment.colour_from_depth
    np.testing.assert_allclose(motion[:3, :3], TURN, atol=1e-5)
    np.testing.assert_allclose(motion[:3, 3], SHIFT_M, atol=1e-6)


def test_bags_of_the_old_recorder_are_read(tmp_path: Path) -> None:
    frames = small_frames(2)
    recorder = OldRealSense("mono16", "rgb8", names=NAMES, colour_scale=1.1)
    sequence = open_sequence(recorder.write(tmp_path / "s.bag", frames))
    assert sequence.depth_unit == "0.25 mm (/device_0/sensor_0/option/Depth Units/value)"
    assert "by RealSense" in sequence.layout
    for read, wrote in zip(sequence, frames, strict=True):
        np.testing.assert_allclose(
            read.depth_m, raw_depth(wrote, 1.0) * 0.00025 + np.where(np.isnan(wrote.depth_m), np.nan, 0), rtol=1e-5
        )
        assert read.colour is not None
    assert_motion(sequence)


# What the recorders write themselves; since 2.58 a bag of ROS 2.


@pytest.fixture
def rs() -> Any:
    return pytest.importorskip("pyrealsense2")


@pytest.fixture
def recorded(rs: Any, tmp_path: Path) -> Path:
    """Return where the recorder that is installed writes to: its version decides the format."""
    version = tuple(int(part) for part in re.findall(r"\d+", rs.__version__)[:2])
    return tmp_path / ("s.db3" if version >= (2, 58) else "s.bag")


def assert_read(path: Path, count: int) -> None:
    """Check that every number of a recording of `recorded.realsense` comes out as it went in."""
    sees = grey if "yuyv" in path.name else scene.colour
    sequence = open_sequence(path)
    assert isinstance(sequence, RosSequence)
    assert "by RealSense" in sequence.layout
    assert sequence.depth_unit == "0.25 mm (/device_0/sensor_0/option/Depth_Units/value)"
    assert sequence.notes == ()
    assert len(sequence) == count
    motion, lens = sequence.colour.alignment.colour_from_depth, sequence.colour.alignment.colour
    np.testing.assert_allclose(motion[:3, :3], recording.TURN, atol=2e-6)
    np.testing.assert_allclose(motion[:3, 3], recording.SHIFT_M, atol=1e-6)
    np.testing.assert_allclose(lens.coefficients, recording.BEND, rtol=1e-5)
    width, height, focal_px = recording.DEPTH
    for number, frame in enumerate(sequence):
        raw = scene.depth(number, width, height)
        np.testing.assert_allclose(frame.depth_m, np.where(raw == 0, np.nan, raw * recording.UNIT_M), rtol=1e-6)
        camera = frame.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (focal_px, focal_px, width / 2 - 0.5, height / 2)
        at = np.argwhere(frame.colour[..., 2] > 0)
        assert len(at) > 0.7 * raw.size
        picture = sees(number, *recording.COLOUR[:2])
        assert set(frame.colour[..., 2][at[:, 0], at[:, 1]]) <= set(picture[..., 2].ravel())
        for row, column in ((43, 14), (43, 48), (8, 48)):  # none of it hidden
            z = raw[row, column] * recording.UNIT_M
            point = np.array([(column - camera.cx) / focal_px * z, (row - camera.cy) / focal_px * z, z])
            there = motion[:3, :3] @ point + motion[:3, 3]
            w, h = lens.distort(np.array(there[0] / there[2]), np.array(there[1] / there[2]))
            u, v = (recording.COLOUR[2] * np.array([w, h]) + [lens.camera.cx, lens.camera.cy]).round().astype(int)
            np.testing.assert_array_equal(frame.colour[row, column], picture[v, u])


def grey(number: int, width: int, height: int) -> np.ndarray:
    """Return RGB (h, w, 3) of the YUYV that `recorded.realsense` gives: black is 16, white 235 (ITU-R BT.601)."""
    light = 1.164 * (scene.colour(number, width, height)[..., 1:2] - 16.0)
    return np.clip(np.rint(light), 0.0, 255.0).astype(np.uint8).repeat(3, axis=2)


RECORDED = (
    "realsense-2.56.bag",  # ROS 1, lz4
    "realsense-2.58.db3",  # ROS 2, each message packed by zstd, cameras as text
    "realsense-2.59.db3",  # ROS 2, images packed as PNG
    "realsense-2.59-yuyv.db3",  # and colour that shares chroma by zstd
)


@pytest.mark.parametrize("name", RECORDED)
def test_recordings_of_the_makers_recorders_are_read(tmp_path: Path, name: str) -> None:
    assert_read(unpacked(name, tmp_path), 3)


def test_recordings_of_the_recorder_that_is_installed_are_read(rs: Any, recorded: Path) -> None:
    recording.record(rs, recorded, 3)
    assert_read(recorded, 3)


@pytest.mark.parametrize("name", RECORDED)
def test_a_recording_that_was_cut_off_is_one_line(tmp_path: Path, refusal: Callable[..., str], name: str) -> None:
    path = unpacked(name, tmp_path)
    content = path.read_bytes()
    for share in (0.05, 0.5, 0.9):
        path.write_bytes(content[: int(share * len(content))])
        assert refusal("info", path).startswith(f"modeler: {path}: is not a readable bag")


@pytest.mark.parametrize("model", ["brown_conrady", "modified_brown_conrady", "inverse_brown_conrady"])
def test_the_makers_library_sees_points_where_our_lens_does(rs: Any, model: str) -> None:
    intrinsics = rs.intrinsics()
    intrinsics.width, intrinsics.height, intrinsics.fx, intrinsics.fy = 640, 480, 385.0, 384.0
    intrinsics.ppx, intrinsics.ppy, intrinsics.coeffs = 320.0, 240.0, list(recording.BEND)
    intrinsics.model = getattr(rs.distortion, model)
    camera = Camera(640, 480, 385.0, 384.0, 320.0, 240.0)
    ours = lens_of_model(camera, recording.BEND, model.replace("_", " ").title(), "here")
    for x, y in itertools.product(np.linspace(-0.8, 0.8, 9), np.linspace(-0.6, 0.6, 7)):
        w, h = ours.distort(np.array(x), np.array(y))
        theirs = rs.rs2_project_point_to_pixel(intrinsics, [x, y, 1.0])
        np.testing.assert_allclose([w * 385.0 + 320.0, h * 384.0 + 240.0], theirs, atol=0.02)


# A camera that is running


class StandIn:
    """A camera that sees one thing after the other."""

    def __init__(self, frames: list[Frame], times_s: tuple[float, ...] = (), lasts: int = 1000) -> None:
        self.frames, self.times_s, self.lasts = frames, times_s, lasts
        self.taken: list[int] = []
        lens = Lens(frames[0].camera, ())
        self.camera = RunningCamera("stand-in", lens, 1.0, self.newest, self.taken.clear, (RuntimeError,))

    def newest(self) -> Image | None:
        number = len(self.taken)
        if number == self.lasts:
            return None
        self.taken.append(number)
        frame = self.frames[number % len(self.frames)]
        return self.times_s[number] if self.times_s else 0.1 * number, raw_depth(frame, 1.0), frame.colour


def test_images_are_taken_when_they_are_asked_for() -> None:
    camera = StandIn(small_frames(3))
    sequence = begin(camera.camera, first=2)
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
    with pytest.raises(InputError, match=r"frame 7 .* 0 to 1"):
        sequence.frame(7)


def test_a_live_camera_stays_live_whatever_it_is_wrapped_in() -> None:
    camera = StandIn(small_frames(3))
    sensed = CalibratedSequence(begin(camera.camera, first=2), NoiseModel(0.5, 500.0, 0.001, (0.0, 0.0, 0.0)))
    assert sensed.live
    assert [frame.index for frame in sensed.recorded()] == [0, 1]
    assert len(camera.taken) == 2  # to look at what it has shown takes nothing from it
    assert [frame.index for frame in sensed.until(lambda: len(camera.taken) == 3)] == [0, 1, 2]
    assert [frame.index for frame in sensed.select(every=2).select(every=2, frames=slice(0, 9))] == [0, 4, 8]


def test_an_image_that_comes_again_is_not_taken_for_a_new_one() -> None:
    camera = StandIn(small_frames(3), times_s=(0.0, 0.0, 0.1, 0.1, 0.1, 0.2, 0.3, *[0.3] * 200))
    sequence = begin(camera.camera, first=2)
    assert [frame.time_s for frame in itertools.islice(sequence, 4)] == [0.0, 0.1, 0.2, 0.3]
    with pytest.raises(InputError, match=r"stand-in: .*same image"):
        list(begin(camera.camera, first=2))


def test_a_camera_of_the_makers_library_is_read_while_it_runs(
    rs: Any, recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is played back is to the library a camera like any other."""
    recording.record(rs, recorded, 14, pause_s=0.05)
    context = rs.context()
    with pytest.raises(InputError, match=r"realsense: no camera"):
        realsense(rs, "123", context)
    played = context.load_device(str(recorded))
    with pytest.raises(InputError, match=r"realsense:123: .* 0123456789\."):
        realsense(rs, "123", context)
    monkeypatch.setattr("modeler.sequences.live.TIMEOUT_MS", 500)
    monkeypatch.setattr("modeler.sequences.live.FIRST", 4)
    sequence = opened(realsense(rs, "0123456789", context), Overrides(), warm_up=0)
    assert (sequence.name, sequence.depth_unit) == ("Software D455", "0.25 mm (the camera)")
    frames: list[Frame] = []
    with pytest.raises(InputError, match=r"Software D455: gives no image"):
        frames.extend(sequence)
    for frame in frames:
        raw = scene.depth(round(30.0 * (frame.time_s - 1.0)), *recording.DEPTH[:2])
        np.testing.assert_allclose(frame.depth_m, np.where(raw == 0, np.nan, raw * recording.UNIT_M), rtol=1e-6)
        assert frame.camera.fx == recording.DEPTH[2]
        assert np.count_nonzero(frame.colour[..., 2] >= 100) > 0.6 * raw.size
    assert played.is_playback()
    assert len(frames) >= 4
    assert (np.diff([frame.time_s for frame in frames]) > 0.0).all()


@pytest.fixture
def plug(monkeypatch: pytest.MonkeyPatch) -> Callable[[StandIn], None]:
    """Return what makes a stand-in the camera that `realsense:` opens."""

    def plugged(camera: StandIn) -> None:
        for module in ("modeler.sequences", "modeler.cli.reading"):
            monkeypatch.setattr(
                f"{module}.open_sequence",
                lambda path, *_: begin(camera.camera, 2) if str(path) == "realsense:" else open_sequence(path),
            )

    return plugged


def test_recording_a_live_camera_needs_an_end(
    plug: Callable[[StandIn], None], refusal: Callable[..., str], tmp_path: Path
) -> None:
    plug(StandIn(small_frames(3)))
    assert "limit the number of frames to record" in refusal("convert", "realsense:", "--out", tmp_path / "bop")
    assert main(["convert", "realsense:", "--frames", ":5", "--out", str(tmp_path / "bop")]) == 0
    assert open_sequence(tmp_path / "bop").indices == (0, 1, 2, 3, 4)


@pytest.mark.parametrize("command", [("convert", "--frames", ":8"), ("build", "--prior", "general", "--method", "icp")])
def test_a_camera_that_is_unplugged_leaves_what_it_gave(
    plug: Callable[[StandIn], None], cli: Run, tmp_path: Path, command: tuple[str, ...]
) -> None:
    out = tmp_path / "out"
    plug(StandIn(small_frames(3), lasts=3))
    ended = cli(command[0], "realsense:", "--out", out, *command[1:])
    assert ended.status in (0, 3)
    assert "modeler: stand-in: gives no image" in ended.err
    if command[0] == "convert":
        assert open_sequence(out).indices == (0, 1, 2)
    else:
        assert RunFolder(out).report()["complete"]
        assert (out / "model.ply").exists()
        assert len(RunFolder(out).report()["frames"]) == 3
