"""Recordings as the Azure Kinect writes them: raw 16-bit big-endian depth, JPEG colour, the calibration attached."""

import json
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from modeler import se3
from modeler.cli import main
from modeler.sequences import Overrides, open_sequence
from modeler.sequences.input_files import Node
from modeler.sequences.lens import Alignment, Lens
from modeler.sequences.videos import KinectSequence, Matroska, colour_from_depth, colour_lens, depth_lens
from modeler.types import Camera, InputError
from studies.formats.kinect import HEIGHT, WIDTH, write_mkv
from studies.formats.recorded import FOLDER, scene, unpacked
from studies.formats.recorded import kinect as recording
from studies.formats.recorded.kinect import calibration

COLOUR_FROM_DEPTH = colour_from_depth(Node(calibration(), Path("c.json")))


def test_depth_comes_out_straight_and_colour_aligned(tmp_path: Path) -> None:
    pytest.importorskip("av")
    path = tmp_path / "eine Aufnahme.mkv"
    images = write_mkv(path)
    sequence = open_sequence(path)
    assert sequence.layout == "Azure Kinect recording (MKV)"
    assert sequence.indices == (0, 1, 2)
    lens = depth_lens(Node(calibration(), path), (WIDTH, HEIGHT), None)
    for raw, frame in zip(images, sequence, strict=True):
        assert frame.time_s == pytest.approx(frame.index / 30.0, abs=2e-3)
        expected = lens.undistort(np.where(raw == 0, np.nan, raw * 0.001).astype(np.float32), float("nan"))
        np.testing.assert_allclose(frame.depth_m, expected, rtol=1e-6)
        assert np.isfinite(frame.depth_m).mean() > 0.9
        assert frame.colour is not None
    frame = sequence.frame(1)
    seen = frame.colour.sum(axis=2) > 0
    red = seen & (frame.colour[..., 0] > frame.colour[..., 2])
    # The colour camera's middle column, seen from the depth camera: 32 mm to the side at about 0.9 m.
    w, _ = frame.camera.rays()
    middle = frame.depth_m[HEIGHT // 2]
    there = se3.transform(
        COLOUR_FROM_DEPTH, np.stack([w[HEIGHT // 2] * middle, 0.0 * middle, middle], axis=1).astype(np.float64)
    )
    should_be_red = there[:, 0] / there[:, 2] < 0.0
    known = seen[HEIGHT // 2]
    assert known.sum() > 150
    assert (red[HEIGHT // 2][known] == should_be_red[known]).mean() > 0.97


def test_a_recording_of_the_makers_library_is_read(tmp_path: Path) -> None:
    path = unpacked("kinect.mkv", tmp_path)
    pytest.importorskip("av")
    sequence = open_sequence(path)
    assert isinstance(sequence, KinectSequence)
    assert sequence.indices == tuple(range(recording.COUNT))
    for number, frame in enumerate(sequence):
        raw = scene.depth(number, *recording.DEPTH)
        wanted = np.where(raw == 0, np.nan, raw * 0.001).astype(np.float32)
        np.testing.assert_allclose(frame.depth_m, sequence.lens.undistort(wanted, float("nan")), rtol=1e-6)
        assert frame.time_s == pytest.approx(number * recording.STEP_US * 1e-6, abs=1e-6)
        coloured = np.argwhere(frame.colour.any(axis=2))
        assert len(coloured) > 0.5 * raw.size
        camera = frame.camera
        for row, column in coloured[:: len(coloured) // 40]:
            z = float(frame.depth_m[row, column])
            there = se3.transform(
                COLOUR_FROM_DEPTH,
                np.array([[(column - camera.cx) / camera.fx * z, (row - camera.cy) / camera.fy * z, z]]),
            )[0]
            lens = sequence.alignment.colour
            w, h = lens.distort(np.array(there[0] / there[2]), np.array(there[1] / there[2]))
            at = round(float(h) * lens.camera.fy + lens.camera.cy), round(float(w) * lens.camera.fx + lens.camera.cx)
            if 0 <= at[0] < recording.COLOUR[1] and 0 <= at[1] < recording.COLOUR[0]:  # else it is lent
                expected = scene.colour(number, *recording.COLOUR)[at].astype(int)
                assert np.abs(frame.colour[row, column].astype(int) - expected).max() <= 12  # hidden pixels borrow


def test_cameras_see_points_where_the_makers_library_does() -> None:
    """It was asked by `recorded.kinect` for each mode of both cameras."""
    said = json.loads((FOLDER / "kinect_pixels.json").read_text())
    points_m = 0.001 * np.array(said["points_mm"], dtype=float)
    node = Node(calibration(), Path("c.json"))
    assert len(said["modes"]) == 24
    for mode in said["modes"]:
        lenses = depth_lens(node, tuple(mode["depth_size"]), None), colour_lens(node, tuple(mode["colour_size"]))
        for name, lens, pose in zip(("depth", "colour"), lenses, (np.eye(4), COLOUR_FROM_DEPTH), strict=True):
            there = se3.transform(pose, points_m)
            w, h = lens.distort(there[:, 0] / there[:, 2], there[:, 1] / there[:, 2])
            camera = lens.camera
            ours = np.stack([w * camera.fx + camera.cx, h * camera.fy + camera.cy], axis=1)
            np.testing.assert_allclose(ours, mode[name], atol=2e-3)


@pytest.mark.parametrize("share", [0.05, 0.3, 0.7, 0.95])
def test_what_is_left_of_a_recording_that_was_cut_off_is_read(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], share: float
) -> None:
    pytest.importorskip("av")
    path = unpacked("kinect.mkv", tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    status, captured = main(["info", str(path)]), capfd.readouterr()
    assert status in (0, 2)
    assert (status == 0) == (share > 0.1)
    assert captured.err.count("\n") == (status == 2)


def test_a_mode_bins_and_crops_the_sensor() -> None:
    node = Node(calibration(), Path("c.json"))
    small, large = depth_lens(node, (320, 288), None).camera, depth_lens(node, (640, 576), None).camera
    assert large.fx == pytest.approx(1024 * 0.4925)
    assert large.cx == pytest.approx(1024 * 0.51 - 192 - 0.5)
    assert small.fx == pytest.approx(large.fx / 2.0)
    assert 2.0 * (small.cx + 0.5) == pytest.approx(large.cx + 0.5)  # the same corner of the sensor
    wide = depth_lens(node, (1024, 1024), None).camera
    assert wide.cy == pytest.approx(large.cy + 180.0)
    full, cropped = colour_lens(node, (4096, 3072)).camera, colour_lens(node, (1280, 720)).camera
    assert cropped.fx == pytest.approx(full.fx / 3.2)
    assert cropped.cy + 120.5 == pytest.approx((full.cy + 0.5) / 3.2)
    with pytest.raises(InputError, match="of no mode of the Azure Kinect"):
        depth_lens(node, (600, 500), None)


def test_a_recording_without_colour_is_read_and_converted(tmp_path: Path) -> None:
    pytest.importorskip("av")
    write_mkv(tmp_path / "s.mkv", colour=False)
    assert open_sequence(tmp_path / "s.mkv").frame(0).colour is None
    assert main(["convert", str(tmp_path / "s.mkv"), "--out", str(tmp_path / "bop")]) == 0
    assert len(open_sequence(tmp_path / "bop")) == 3
    given = open_sequence(tmp_path / "s.mkv", Overrides(intrinsics=(250.0, 250.0, 160.0, 144.0), depth_scale_mm=0.5))
    assert given.frame(0).camera.fx == 250.0
    assert given.depth_unit == "0.5 mm (`depth_scale_mm`)"


@pytest.mark.parametrize(
    "fault", ["truncated", "empty", "noise", "no calibration", "wrong calibration", "no lens", "fisheye"]
)
def test_broken_recordings_are_one_line(tmp_path: Path, refusal: Callable[..., str], fault: str) -> None:
    path = tmp_path / "s.mkv"
    tree = calibration()
    if fault == "fisheye":
        tree["CalibrationInformation"]["Cameras"][0]["Intrinsics"]["ModelType"] = "CALIBRATION_LensDistortionModelTheta"
    if fault == "no lens":
        tree["CalibrationInformation"]["Cameras"][0]["Intrinsics"]["ModelParameters"] = [0] * 14
    pytest.importorskip("av")
    write_mkv(path, attached={"no": 1} if fault == "wrong calibration" else tree)
    content = path.read_bytes()
    damaged = {
        "truncated": content[:400],
        "empty": b"",
        "noise": b"noise" * 500,
        "no calibration": content.replace(b"calibration.json", b"calibration.txt_"),
    }
    path.write_bytes(damaged.get(fault, content))
    assert str(path) in refusal("info", path)


def test_images_larger_than_their_track_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit is set so low that it need not take a huge image to show."""
    av = pytest.importorskip("av")
    container = av.open(str(tmp_path / "s.mkv"), "w", format="matroska")
    track = container.add_stream("mpeg4", rate=5)
    track.width, track.height, track.pix_fmt, track.metadata["title"] = 64, 48, "yuv420p", "COLOR"
    images = []
    for width, height in ((64, 48), (320, 240)):
        coder = av.CodecContext.create("mpeg4", "w")
        coder.width, coder.height, coder.pix_fmt, coder.time_base = width, height, "yuv420p", Fraction(1, 5)
        image = av.VideoFrame.from_ndarray(np.zeros((height, width, 3), np.uint8), format="rgb24")
        images += [*coder.encode(image), *coder.encode()]
    for place, encoded in enumerate(images):
        packet = av.Packet(bytes(encoded))
        packet.stream, packet.pts, packet.dts, packet.is_keyframe = track, place, place, True
        container.mux(packet)
    container.close()
    stamp = Matroska(tmp_path / "s.mkv").stamps("COLOR")[1][1]
    assert Matroska(tmp_path / "s.mkv").image("COLOR", stamp, "image 1").shape == (240, 320, 3)
    monkeypatch.setattr("modeler.sequences.videos.MAX_PIXELS", 64 * 48)
    with pytest.raises(InputError, match=r"s\.mkv: "):
        Matroska(tmp_path / "s.mkv").image("COLOR", stamp, "image 1")


def test_without_the_library_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "s.mkv").write_bytes(b"\x1aE\xdf\xa3")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"-m pip install 'modeler\[kinect\]'"):
        open_sequence(tmp_path / "s.mkv")


def test_what_is_hidden_from_the_colour_camera_does_not_get_the_colour_before_it() -> None:
    camera = Camera(80, 60, 70.0, 70.0, 39.5, 29.5)
    beside = Alignment(camera, Lens(camera, ()), se3.translation(np.array([-0.1, 0.0, 0.0])))
    depth_m = np.full((60, 80), 2.0, np.float32)
    depth_m[20:40, 30:50] = 0.5
    depth_m[0, 0] = np.nan
    picture = np.zeros((60, 80, 3), np.uint8)
    picture[..., 0] = np.arange(80, dtype=np.uint8) + 1
    colour = beside.align(depth_m, picture)
    assert colour[0, 0].sum() == 0
    near, far = 70.0 * 0.1 / 0.5, 70.0 * 0.1 / 2.0
    assert colour[30, 40, 0] == 40 + 1 - near
    assert colour[5, 60, 0] == pytest.approx(60 + 1 - far, abs=0.5)
    hidden = colour[30, :30, 0] == 0  # behind the near thing as the other camera sees it
    assert hidden[int(30 - near + far) + 3 : 29].all()
    assert not hidden[int(far) + 1 : int(30 - near + far) - 2].any()


def test_what_is_hidden_takes_the_colour_of_the_same_surface_close_by() -> None:
    camera = Camera(160, 120, 300.0, 300.0, 79.5, 59.5)
    beside = Alignment(camera, Lens(camera, ()), se3.translation(np.array([-0.05, 0.0, 0.0])))
    depth_m = np.full((120, 160), 0.5, np.float32)
    depth_m[40:80, 100:120] = 0.4  # hides 7.5 px of the plane to its left from a camera to the right
    far_px, near_px = 300 * 0.05 / 0.5, 300 * 0.05 / 0.4
    picture = np.full((120, 160, 3), (0, 0, 200), np.uint8)
    picture[40:80, int(100 - near_px) : int(120 - near_px) + 1] = (200, 0, 0)
    colour = beside.align(depth_m, picture)
    assert (colour[60, 100:120, 0] == 200).all()
    assert (colour[60, int(far_px) + 1 : 99, 2] == 200).all()
    assert (colour[60, 122:, 2] == 200).all()
