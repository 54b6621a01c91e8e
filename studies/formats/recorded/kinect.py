"""Records with Microsoft's own library (k4arecord 1.4, in pyk4a-bundle), and asks it where points appear."""

from __future__ import annotations

import ctypes
import importlib.util
import io
import json
import sys
from pathlib import Path
from typing import Any

from PIL import Image

sys.path.insert(0, str(Path(__file__).parent))
from scene import colour, depth

DEPTH, COLOUR = (320, 288), (1280, 720)  # NFOV_2X2BINNED, 720P
DEPTH_SIZES = {1: (320, 288), 2: (640, 576), 3: (512, 512), 4: (1024, 1024)}
COLOUR_SIZES = {1: (1280, 720), 2: (1920, 1080), 3: (2560, 1440), 4: (2048, 1536), 5: (3840, 2160), 6: (4096, 3072)}
START_US, STEP_US, COUNT = 800_222, 33_333, 2
MJPG, DEPTH16, IR16 = 0, 4, 5
POINTS_MM = ((0, 0, 500), (120, -80, 600), (-200, 150, 700), (300, 220, 1000), (-90, -260, 900))
Handle = ctypes.c_void_p


class Configuration(ctypes.Structure):
    """k4a_device_configuration_t."""

    _fields_ = [
        ("color_format", ctypes.c_int),
        ("color_resolution", ctypes.c_int),
        ("depth_mode", ctypes.c_int),
        ("camera_fps", ctypes.c_int),
        ("synchronized_images_only", ctypes.c_bool),
        ("depth_delay_off_color_usec", ctypes.c_int32),
        ("wired_sync_mode", ctypes.c_int),
        ("subordinate_delay_off_master_usec", ctypes.c_uint32),
        ("disable_streaming_indicator", ctypes.c_bool),
    ]


class ImuSample(ctypes.Structure):
    """k4a_imu_sample_t."""

    _fields_ = [
        ("temperature", ctypes.c_float),
        ("acc", ctypes.c_float * 3),
        ("acc_us", ctypes.c_uint64),
        ("gyro", ctypes.c_float * 3),
        ("gyro_us", ctypes.c_uint64),
    ]


def calibration() -> dict[str, Any]:
    """Return what a device tells of itself, of invented numbers."""

    def camera(purpose: str, place: str, parameters: list[float], rt: dict[str, Any], size: tuple[int, int]) -> Any:
        return {
            "Intrinsics": {
                "ModelParameterCount": 14,
                "ModelParameters": parameters,
                "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
            },
            "Location": f"CALIBRATION_CameraLocation{place}",
            "Purpose": f"CALIBRATION_CameraPurpose{purpose}",
            "MetricRadius": 1.74 if place == "D0" else 0,
            "Rt": rt,
            "SensorHeight": size[1],
            "SensorWidth": size[0],
            "Shutter": "CALIBRATION_ShutterTypeUndefined",
            "ThermalAdjustmentParams": {"Params": [0] * 12},
        }

    def inertial(kind: str) -> dict[str, Any]:
        scale = [1, 0, 0, 0, *[0] * 12, 1, 0, 0, 0, *[0] * 12, 1, 0, 0, 0]
        return {
            "BiasTemperatureModel": [0] * 12,
            "BiasUncertainty": [1e-4] * 3,
            "Id": "CALIBRATION_InertialSensorId_LSM6DSM",
            "MixingMatrixTemperatureModel": scale,
            "ModelTypeMask": 16,
            "Noise": [1e-3, 1e-3, 1e-3, 0, 0, 0],
            "Rt": {"Rotation": [0, 0, -1, -1, 0, 0, 0, 1, 0], "Translation": [0, 0, 0]},
            "SecondOrderScaling": [0] * 9,
            "SensorType": f"CALIBRATION_InertialSensorType_{kind}",
            "TemperatureBounds": [5, 60],
            "TemperatureC": 0,
        }

    cos, sin = 0.9950041652780258, 0.09983341664682815
    still = {"Rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "Translation": [0, 0, 0]}
    moved = {"Rotation": [1, 0, 0, 0, cos, sin, 0, -sin, cos], "Translation": [-0.032, -0.002, 0.004]}
    lens = [0.51, 0.515, 0.4925, 0.4929, 0.55, -0.021, -0.0027, 0.89, 0.086, -0.0139, 0, 0, -7e-5, 2e-5]
    other = [0.5, 0.5066, 0.478, 0.6374, 0.33, -2.489, 1.4537, 0.2089, -2.3029, 1.3751, 0, 0, -1.3e-4, -1.6e-4]
    return {
        "CalibrationInformation": {
            "Cameras": [
                camera("Depth", "D0", lens, still, (1024, 1024)),
                camera("PhotoVideo", "PV0", other, moved, (4096, 3072)),
            ],
            "InertialSensors": [inertial("Gyro"), inertial("Accelerometer")],
            "Metadata": {
                "SerialId": "000000000000",
                "Version": {"Major": 1, "Minor": 2},
                "DeviceName": "AzureKinect-PV",
            },
        }
    }


def libraries() -> tuple[Any, Any]:
    """Return k4a and k4arecord."""
    found = importlib.util.find_spec("k4a_module")
    if found is None or found.origin is None:
        raise ImportError("pip install pyk4a-bundle==1.5.0")
    folder = Path(found.origin).parent / "pyk4a_bundle.libs"
    loaded = [
        ctypes.CDLL(str(next(folder.glob(f"{name}*"))), mode=ctypes.RTLD_GLOBAL)
        for name in ("libudev", "libk4a-", "libk4arecord")
    ]
    return loaded[1], loaded[2]


def done(result: int) -> None:
    """Raise where a call failed."""
    if result != 0:
        raise RuntimeError("the library refused; set K4A_LOG_LEVEL=i and K4A_ENABLE_LOG_TO_STDOUT=1")


def image(k4a: Any, kind: int, size: tuple[int, int], data: bytes, time_us: int) -> Any:
    """Return an image of the library."""
    made, step = Handle(), 0 if kind == MJPG else 2 * size[0]
    kept = ctypes.create_string_buffer(data, len(data))
    KEPT.append(kept)
    create = k4a.k4a_image_create_from_buffer
    create.argtypes = [*[ctypes.c_int] * 4, Handle, ctypes.c_size_t, Handle, Handle, ctypes.POINTER(Handle)]
    done(create(kind, *size, step, kept, len(data), None, None, ctypes.byref(made)))
    k4a.k4a_image_set_device_timestamp_usec(made, ctypes.c_uint64(time_us))
    return made


KEPT: list[Any] = []


def record(k4a: Any, recorder: Any, path: Path) -> None:
    """Write a recording."""
    handle = Handle()
    recorder.k4a_record_create.argtypes = [ctypes.c_char_p, Handle, Configuration, ctypes.POINTER(Handle)]
    settings = Configuration(MJPG, 1, 1, 2, True, 0, 0, 0, False)
    done(recorder.k4a_record_create(str(path).encode(), None, settings, ctypes.byref(handle)))
    content = json.dumps(calibration()).encode()
    done(recorder.k4a_record_add_attachment(handle, b"calibration.json", content, ctypes.c_size_t(len(content))))
    for name, value in ((b"K4A_CALIBRATION_FILE", b"calibration.json"), (b"K4A_DEVICE_SERIAL_NUMBER", b"000000000000")):
        done(recorder.k4a_record_add_tag(handle, name, value))
    done(recorder.k4a_record_add_imu_track(handle))
    done(recorder.k4a_record_write_header(handle))
    recorder.k4a_record_write_imu_sample.argtypes = [Handle, ImuSample]
    for number in range(COUNT):
        time_us, capture = START_US + number * STEP_US, Handle()
        raw, packed = depth(number, *DEPTH), io.BytesIO()
        Image.fromarray(colour(number, *COLOUR)).save(packed, "JPEG", quality=80)
        done(k4a.k4a_capture_create(ctypes.byref(capture)))
        k4a.k4a_capture_set_depth_image(capture, image(k4a, DEPTH16, DEPTH, raw.tobytes(), time_us))
        k4a.k4a_capture_set_ir_image(capture, image(k4a, IR16, DEPTH, (raw // 4).tobytes(), time_us))
        k4a.k4a_capture_set_color_image(capture, image(k4a, MJPG, COLOUR, packed.getvalue(), time_us))
        done(recorder.k4a_record_write_capture(handle, capture))
        still = (ctypes.c_float * 3)(0.0, 0.0, -9.8)
        sample = ImuSample(30.0, still, time_us, (ctypes.c_float * 3)(), time_us)
        done(recorder.k4a_record_write_imu_sample(handle, sample))
    done(recorder.k4a_record_flush(handle))
    recorder.k4a_record_close.restype = None
    recorder.k4a_record_close(handle)


def pixels(k4a: Any) -> list[dict[str, Any]]:
    """Return where the library sees points, in m of the depth camera, in each mode of both cameras."""
    raw, found = json.dumps(calibration()).encode() + b"\0", []
    for mode, depth_size in DEPTH_SIZES.items():
        for resolution, colour_size in COLOUR_SIZES.items():
            known, seen = ctypes.create_string_buffer(1 << 14), {"depth": [], "colour": []}
            size = ctypes.c_size_t(len(raw))
            done(k4a.k4a_calibration_get_from_raw(ctypes.c_char_p(raw), size, mode, resolution, known))
            for camera, name in enumerate(seen):
                for point in POINTS_MM:
                    at, pixel, valid = (ctypes.c_float * 3)(*point), (ctypes.c_float * 2)(), ctypes.c_int()
                    done(k4a.k4a_calibration_3d_to_2d(known, at, 0, camera, pixel, ctypes.byref(valid)))
                    seen[name].append([round(value, 3) for value in pixel] if valid.value else None)
            found.append({"depth_size": depth_size, "colour_size": colour_size, **seen})
    return found


if __name__ == "__main__":
    sensor, writer = libraries()
    record(sensor, writer, Path(sys.argv[1]))
    Path(sys.argv[2]).write_text(json.dumps({"points_mm": POINTS_MM, "modes": pixels(sensor)}))
