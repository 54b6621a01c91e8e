"""The cameras of an Azure Kinect, from the calibration that the device keeps and recordings carry.

The device tells principal point and focal length as shares of its whole sensor, from the corner of the first pixel;
a mode of the camera bins and crops the sensor.
"""

from __future__ import annotations

import numpy as np

from modeler import se3
from modeler.types import Array, Camera, InputError
from sequences.files.json_input import Node
from sequences.given import Intrinsics, sane
from sequences.lens import Lens, coefficients

DEPTH, COLOUR = "CALIBRATION_CameraPurposeDepth", "CALIBRATION_CameraPurposePhotoVideo"
Size = tuple[int, int]
_MODELS = tuple(f"CALIBRATION_LensDistortionModel{name}" for name in ("BrownConrady", "Rational6KT"))
"""Those that the maker's library takes; they differ by less than a tenth of a pixel, in a tangential term."""
_DEPTH_MODES: dict[Size, tuple[Size, Size]] = {  # image: (binned sensor, corner of the image in it)
    (320, 288): ((512, 512), (96, 90)),
    (640, 576): ((1024, 1024), (192, 180)),
    (512, 512): ((512, 512), (0, 0)),
    (1024, 1024): ((1024, 1024), (0, 0)),
}


def depth_lens(calibration: Node, size: Size, intrinsics: Intrinsics | None) -> Lens:
    """Return the depth camera for images of (width, height).

    Raises:
        InputError: where the size is of no mode of the camera, or the calibration lacks something.
    """
    if intrinsics is not None:
        return Lens(Camera(*size, *intrinsics), ())
    if size not in _DEPTH_MODES:
        raise InputError(
            f"{calibration.path}: depth of {size[0]} x {size[1]} pixels is of no mode of the Azure Kinect; "
            "convert with --intrinsics FX FY CX CY."
        )
    return _lens(calibration, DEPTH, size, *_DEPTH_MODES[size])


def colour_lens(calibration: Node, size: Size) -> Lens:
    """Return the colour camera for images of (width, height): the sensor of 4 : 3, cropped above and below for 16 : 9.

    Raises:
        InputError: where the calibration lacks something.
    """
    whole = size[0], size[0] * 3 // 4
    return _lens(calibration, COLOUR, size, whole, (0, (whole[1] - size[1]) // 2))


def colour_from_depth(calibration: Node) -> Array:
    """Return the motion (4, 4), in m, that takes points of the depth camera to the colour camera.

    Raises:
        InputError: where the calibration lacks something.
    """
    return _camera_from_device(calibration, COLOUR) @ se3.inverse(_camera_from_device(calibration, DEPTH))


def _lens(calibration: Node, purpose: str, size: Size, sensor: Size, corner: Size) -> Lens:
    intrinsics = _camera(calibration, purpose).need("Intrinsics")
    model = intrinsics.get("ModelType")
    if model is not None and model.value not in _MODELS:
        raise model.fault(f"one of {', '.join(_MODELS)}")
    entry = intrinsics.need("ModelParameters")
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = (float(value) for value in entry.numbers(14))
    pixels = (
        fx * sensor[0],
        fy * sensor[1],
        cx * sensor[0] - corner[0] - 0.5,  # from the corner of the first pixel to its centre
        cy * sensor[1] - corner[1] - 0.5,
    )
    if not sane(pixels):
        raise entry.fault("the 14 parameters of a lens")
    return Lens(Camera(*size, *pixels), coefficients([k1, k2, p1, p2, k3, k4, k5, k6]))


def _camera_from_device(calibration: Node, purpose: str) -> Array:
    entry = _camera(calibration, purpose).need("Rt")
    rotation = entry.need("Rotation").numbers(9).reshape(3, 3)
    if np.abs(rotation).max() > 2.0 or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise entry.need("Rotation").fault("a rotation matrix, row by row")
    pose = se3.translation(entry.need("Translation").numbers(3))
    pose[:3, :3] = rotation
    return pose


def _camera(calibration: Node, purpose: str) -> Node:
    for entry in calibration.need("CalibrationInformation").need("Cameras").elements():
        if entry.need("Purpose").value == purpose:
            return entry
    raise InputError(f"{calibration.path}: its calibration knows no {purpose}; record it anew.")
