"""Live cameras of other makers, by stand-ins of their libraries that give the frames of a scene."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from modeler.sequences import Overrides, open_sequence
from modeler.sequences.live import LIBRARIES
from modeler.types import CALIBRATED_FOCAL, MULTIPATH, NOMINAL_FOCAL, InputError, SensorNoise
from studies.formats.image_folders import raw_depth, small_frames

FRAMES = small_frames(3)
CAMERA = FRAMES[0].camera
SIZE = CAMERA.height, CAMERA.width
BEND = (0.01, -0.002, 0.001, 0.0005, 0.0, 0.0, 0.0, 0.0)
"""k1 k2 p1 p2 k3 k4 k5 k6 of the depth camera, where its images are bent."""


class Shown:
    """What a camera sees, one frame after the other, and again; `silent` where it stops giving images."""

    def __init__(self) -> None:
        self.numbers = itertools.count()
        self.silent = self.stopped = False

    def image(self) -> tuple[int, np.ndarray, np.ndarray]:
        """Return time in µs, depth in mm, and colour."""
        number = next(self.numbers)
        frame = FRAMES[number % len(FRAMES)]
        assert frame.colour is not None
        return 100_000 * number, raw_depth(frame, 1.0), frame.colour

    def stop(self) -> None:
        self.stopped = True


class OBError(Exception):
    """Of Orbbec's library."""


def orbbec(shown: Shown) -> SimpleNamespace:
    """Stand in for `pyorbbecsdk`."""
    device = SimpleNamespace(get_device_info=lambda: SimpleNamespace(get_name=lambda: "Orbbec Femto Bolt"))

    def by_serial(serial: str) -> SimpleNamespace:
        if serial != "CL1":
            raise OBError(f"no device {serial}")
        return device

    intrinsic = SimpleNamespace(width=SIZE[1], height=SIZE[0], fx=CAMERA.fx, fy=CAMERA.fy, cx=CAMERA.cx, cy=CAMERA.cy)
    bent = SimpleNamespace(model=3, **dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), BEND, strict=True)))
    profile = SimpleNamespace(get_intrinsic=lambda: intrinsic, get_distortion=lambda: bent)

    def frames(limit_ms: int) -> SimpleNamespace | None:
        assert limit_ms > 0
        if shown.silent:
            return None
        time_us, raw, colour = shown.image()
        depth = SimpleNamespace(
            get_data=lambda: raw.view(np.uint8).ravel(),  # bytes, as the library gives them
            get_height=lambda: SIZE[0],
            get_width=lambda: SIZE[1],
            get_depth_scale=lambda: 1.0,
            get_timestamp_us=lambda: time_us,
            get_stream_profile=lambda: SimpleNamespace(as_video_stream_profile=lambda: profile),
        )
        picture = SimpleNamespace(get_data=lambda: colour.ravel())
        both = SimpleNamespace(get_depth_frame=lambda: depth, get_color_frame=lambda: picture)
        both.as_frame_set = lambda: both
        return both

    profiles = SimpleNamespace(
        get_default_video_stream_profile=lambda: "depth", get_video_stream_profile=lambda *size_format_rate: "colour"
    )
    return SimpleNamespace(
        OBError=OBError,
        OBSensorType=SimpleNamespace(DEPTH_SENSOR=3, COLOR_SENSOR=2),
        OBFormat=SimpleNamespace(RGB=22),
        OBStreamType=SimpleNamespace(DEPTH_STREAM=3),
        OBFrameAggregateOutputMode=SimpleNamespace(FULL_FRAME_REQUIRE=0),
        OBCameraDistortionModel=SimpleNamespace(KANNALA_BRANDT4=5),
        AlignFilter=lambda to: SimpleNamespace(process=lambda frames: frames),
        Config=lambda: SimpleNamespace(
            enable_stream=lambda profile: None, set_frame_aggregate_output_mode=lambda mode: None
        ),
        Context=lambda: SimpleNamespace(
            query_devices=lambda: SimpleNamespace(
                get_count=lambda: 1, get_device_by_index=lambda place: device, get_device_by_serial_number=by_serial
            )
        ),
        Pipeline=lambda device: SimpleNamespace(
            start=lambda config: None,
            stop=shown.stop,
            wait_for_frames=frames,
            get_stream_profile_list=lambda sensor: profiles,
        ),
    )


class Node:
    """Of a pipeline of an OAK."""

    def __init__(self, frames: Callable[[timedelta], Any]) -> None:
        self.inputs: dict[str, Node] = {"depth": self, "colour": self}
        self.stereo = self.depth = self.out = self.inputAlignTo = self
        self.createOutputQueue = lambda maxSize, blocking: SimpleNamespace(get=frames)

    def build(self, *parts: object) -> Node:
        return self

    def requestOutput(self, size: tuple[int, int], *kind: object, enableUndistortion: bool = False) -> Node:
        return self

    def link(self, to: Node) -> None:
        assert isinstance(to, Node)


def oak(shown: Shown) -> SimpleNamespace:
    """Stand in for `depthai` 3."""
    matrix = [[CAMERA.fx, 0.0, CAMERA.cx], [0.0, CAMERA.fy, CAMERA.cy], [0.0, 0.0, 1.0]]

    def frames(limit: timedelta) -> dict[str, Any] | None:
        if shown.silent:
            return None
        time_us, raw, colour = shown.image()
        depth = SimpleNamespace(
            getFrame=lambda: raw,
            getTimestamp=lambda: timedelta(microseconds=time_us),
            getTransformation=lambda: SimpleNamespace(getIntrinsicMatrix=lambda: matrix),
        )
        return {"depth": depth, "colour": SimpleNamespace(getFrame=lambda: colour)}

    def device(serial: str = "CL1") -> SimpleNamespace:
        if serial != "CL1":
            raise RuntimeError(f"Cannot find any device with given deviceInfo\n({serial})")
        return SimpleNamespace(getPlatform=lambda: 0, getProductName=lambda: "OAK-D-LITE")

    pipeline = SimpleNamespace(create=lambda kind: Node(frames), start=lambda: None, stop=shown.stop)
    return SimpleNamespace(
        Device=device,
        Pipeline=lambda device: pipeline,
        Platform=SimpleNamespace(RVC2=0, RVC4=2),
        CameraBoardSocket=SimpleNamespace(CAM_A=0, CAM_B=1, CAM_C=2),
        ImgFrame=SimpleNamespace(Type=SimpleNamespace(RGB888i=1)),
        node=SimpleNamespace(Camera=0, StereoDepth=1, Sync=2, ImageAlign=3),
    )


class K4AException(Exception):
    """Of the Azure Kinect's library, which says nothing."""


def azure(shown: Shown) -> SimpleNamespace:
    """Stand in for `pyk4a`."""
    matrix = np.array([[CAMERA.fx, 0.0, CAMERA.cx], [0.0, CAMERA.fy, CAMERA.cy], [0.0, 0.0, 1.0]])

    def capture(limit_ms: int) -> SimpleNamespace:
        if shown.silent:
            raise K4AException
        time_us, raw, colour = shown.image()
        bgra = np.concatenate([colour[..., ::-1], np.full((*SIZE, 1), 255, np.uint8)], axis=2)
        return SimpleNamespace(depth=raw, depth_timestamp_usec=time_us, transformed_color=bgra)

    def device(config: object, device_id: int) -> SimpleNamespace:
        return SimpleNamespace(
            serial=f"CL{device_id}",
            open=lambda: None,
            close=lambda: None,
            start=lambda: None,
            stop=shown.stop,
            get_capture=capture,
            calibration=SimpleNamespace(
                get_camera_matrix=lambda kind: matrix, get_distortion_coefficients=lambda kind: np.array(BEND)
            ),
        )

    return SimpleNamespace(
        K4AException=K4AException,
        CalibrationType=SimpleNamespace(DEPTH=0),
        Config=lambda: None,
        PyK4A=device,
        connected_device_count=lambda: 2,
    )


STAND_INS = {"orbbec": orbbec, "oak": oak, "azure": azure}


@pytest.fixture(params=STAND_INS)
def maker(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def shown(maker: str, monkeypatch: pytest.MonkeyPatch) -> Shown:
    seen = Shown()
    monkeypatch.setitem(sys.modules, LIBRARIES[maker][0], STAND_INS[maker](seen))  # type: ignore[arg-type]
    return seen


def test_frames_of_a_camera_are_read(maker: str, shown: Shown) -> None:
    sequence = open_sequence(f"{maker}:CL1")
    assert sequence.live
    assert sequence.name in ("Orbbec Femto Bolt", "OAK-D-LITE", "Azure Kinect CL1")
    by_time_of_flight = 0.0 if maker == "oak" else MULTIPATH["tof"]
    noise = SensorNoise(sigma_r_m=None, sigma_focal=CALIBRATED_FOCAL, sigma_multipath=by_time_of_flight)
    assert sequence.sensor() == noise
    read = list(itertools.islice(sequence, 14))
    assert [frame.index for frame in read] == list(range(14))
    assert (np.diff([frame.time_s for frame in read]) > 0.05).all()
    assert {frame.camera for frame in read} == {CAMERA}
    bent = maker != "oak"  # which undistorts
    for frame in read:
        wrote = FRAMES[round(frame.time_s / 0.1) % len(FRAMES)]
        same = np.isclose(frame.depth_m, wrote.depth_m, atol=6e-4, equal_nan=True)
        assert same.mean() > (0.5 if bent else 0.999)
        assert (frame.colour == wrote.colour).all(axis=-1).mean() > (0.5 if bent else 0.999)
        assert bool((frame.depth_m != wrote.depth_m).any()) or not bent
    del sequence
    assert shown.stopped


def test_values_that_are_given_count_before_those_of_a_camera(maker: str, shown: Shown) -> None:
    sequence = open_sequence(f"{maker}:", Overrides(intrinsics=(100.0, 101.0, 40.0, 30.0), depth_scale_mm=2.0))
    frame = next(iter(sequence))
    noise = sequence.sensor()
    assert noise.sigma_focal == NOMINAL_FOCAL
    assert (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy) == (100.0, 101.0, 40.0, 30.0)
    wrote = FRAMES[round(frame.time_s / 0.1) % len(FRAMES)]
    np.testing.assert_allclose(frame.depth_m, 2.0 * wrote.depth_m, atol=2e-3)
    assert not shown.stopped


def test_a_camera_that_is_not_there_or_falls_silent_is_said_in_one_line(
    maker: str, shown: Shown, refusal: Callable[..., str]
) -> None:
    assert refusal("info", f"{maker}:other").startswith(f"modeler: {maker}:other: ")
    sequence = open_sequence(f"{maker}:")
    shown.silent = True
    with pytest.raises(InputError, match="gives no image"):
        list(sequence)
    with pytest.raises(InputError, match=f"^{maker}:.*(no image|cannot be started)"):
        open_sequence(f"{maker}:")


@pytest.mark.parametrize("maker", LIBRARIES)
def test_without_the_library_it_says_what_to_install(
    maker: str, monkeypatch: pytest.MonkeyPatch, refusal: Callable[..., str]
) -> None:
    monkeypatch.setitem(sys.modules, LIBRARIES[maker][0], None)
    assert f"-m pip install 'modeler[{maker}]'" in refusal("info", f"{maker}:")


def test_a_folder_of_that_name_is_a_folder(maker: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path(f"{maker}:").mkdir()
    with pytest.raises(InputError, match="holds no depth images"):
        open_sequence(f"{maker}:")
