"""Intrinsics: overrides by the user, and the files that programs write next to their images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np

from modeler.sequences.input_files import Node, is_there, read_text, read_tree
from modeler.types import Array, InputError

Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy in px."""
RANGE = "fx and fy from 1 to 1e6, cx and cy from -1e6 to 1e6"
"""Range of intrinsics, for messages."""


@dataclass(frozen=True)
class Overrides:
    """Values that take precedence over the files and the defaults of the reader."""

    intrinsics: Intrinsics | None = None
    """fx, fy, cx, cy of the depth camera in px."""
    depth_scale_mm: float | None = None
    """Millimetres per unit of stored depth."""
    depth_topic: str | None = None
    """Topic of the depth images in a ROS bag."""
    colour_topic: str | None = None
    """Topic of the colour images in a ROS bag."""
    strict_paths: bool = False
    """Refuse a sequence in which a link leads out of it."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InputError: if they cannot be.
        """
        if self.intrinsics is not None and not sane(self.intrinsics):
            shown = " ".join(f"{value:g}" for value in self.intrinsics)
            raise InputError(
                f"--intrinsics {shown} are those of no camera; give FX FY CX CY in px, FX and FY from 1 to 1e6."
            )
        if self.depth_scale_mm is not None and not 1e-6 <= self.depth_scale_mm <= 1e3:
            raise InputError(
                f"--depth-scale-mm {self.depth_scale_mm:g} is out of range; give the millimetres in one unit of depth."
            )


def sane(intrinsics: Intrinsics) -> bool:
    """Return whether numbers can be the intrinsics of a camera."""
    fx, fy, cx, cy = intrinsics
    finite = all(math.isfinite(value) for value in intrinsics)
    return finite and min(fx, fy) >= 1.0 and max(fx, fy, abs(cx), abs(cy)) <= 1e6


NAMES = (
    "cam_K.txt",
    "camera_intrinsic.json",
    "camera_intrinsics.json",
    "intrinsic.json",
    "intrinsics.json",
    "camera.json",
    "calibration.txt",
    "intrinsic_depth.txt",
    "intrinsics.txt",
)
"""Files that are looked for, in this order."""


@final
@dataclass(frozen=True)
class CameraFacts:
    """The camera of a folder of images."""

    intrinsics: Intrinsics
    """fx, fy, cx, cy in px."""
    by: str
    """The file, or the option, that it comes from."""
    unit_mm: float | None = None
    """Millimetres per unit of depth, where the file says so."""
    size: tuple[int, int] | None = None
    """Width and height in px of the images that the file is of, where it says so."""

    def unit(self, overrides: Overrides, usual: tuple[float, str]) -> tuple[float, str]:
        """Return the millimetres per unit of depth, and its source.

        Args:
            overrides: values that take precedence.
            usual: the default and its source.
        """
        if overrides.depth_scale_mm is not None:
            return overrides.depth_scale_mm, "--depth-scale-mm"
        return usual if self.unit_mm is None else (self.unit_mm, self.by)

    def doubts(self, size: tuple[int, int]) -> list[str]:
        """Return remarks where the intrinsics are of images of another (width, height)."""
        if self.size in (None, size):
            return []
        return [
            f"{self.by} is of images of {self.size[0]} x {self.size[1]} where the depth images are {size[0]} x "
            f"{size[1]}: are its intrinsics theirs?"
        ]


def find_intrinsics(folder: Path, overrides: Overrides) -> CameraFacts | None:
    """Return the camera of a folder of images; None without intrinsics.

    Args:
        folder: where to look.
        overrides: values that take precedence.

    Raises:
        InputError: if a file of intrinsics cannot be read.
    """
    if overrides.intrinsics is not None:
        return CameraFacts(overrides.intrinsics, "--intrinsics")
    for name in NAMES:
        path = folder / name
        if is_there(path):
            return _from_json(read_tree(path), name) if path.suffix == ".json" else CameraFacts(_from_text(path), name)
    return None


_WITHIN = ("intrinsic", "intrinsics")
_SPACE = str.maketrans(",;[]", "    ")


def _from_text(path: Path) -> Intrinsics:
    """Read a matrix (3, 3) or (4, 4) by rows, or `fx fy cx cy` and anything after it; commas and brackets are space."""
    expected = "a matrix of 3 x 3 numbers (fx 0 cx, 0 fy cy, 0 0 1) or a line fx fy cx cy"
    lines = [line for line in read_text(path).translate(_SPACE).splitlines() if not line.startswith("#")]
    rows = [line.split() for line in lines if line.strip()]
    try:
        numbers = [[float(word) for word in row] for row in rows[:5]]
    except ValueError:
        raise InputError(f"{path}: holds words that are no numbers; it must be {expected}.") from None
    if len(numbers) == 1 and len(numbers[0]) >= 4:
        fx, fy, cx, cy = numbers[0][:4]
        found = (fx, fy, cx, cy) if sane((fx, fy, cx, cy)) else None
    elif numbers and {len(numbers)} == {len(row) for row in numbers} <= {3, 4}:
        found = of_matrix(np.array(numbers)[:3, :3])
    else:
        found = None
    if found is None:
        raise InputError(f"{path}: does not describe a pinhole camera; it must be {expected}, in px, {RANGE}.")
    return found


def _from_json(node: Node, name: str) -> CameraFacts:
    """Read what Open3D writes (columns of the matrix in turn), a matrix in rows, or fx, fy, cx, cy by name."""
    scale = node.get("depth_scale")
    node = next((within for key in _WITHIN if (within := node.get(key)) is not None), node)
    width, height = node.get("width"), node.get("height")
    size = None if width is None or height is None else (int(width.number(1.0, 1e5)), int(height.number(1.0, 1e5)))
    return CameraFacts(_pinhole(node), name, None if scale is None else _unit_mm(scale), size)


def _unit_mm(scale: Node) -> float:
    """Return the millimetres per unit of depth of a `depth_scale`, which programs give in three ways.

    BOP's files have millimetres per unit (1 or 0.1), RealSense's library metres per unit (0.001 or 0.0001), Open3D's
    and others units per metre (1000 or 5000): the three lie far apart.
    """
    number = scale.number()
    for low, high, unit_mm in (
        (1e-6, 0.01, number * 1000.0),
        (0.01, 10.0, number),
        (100.0, 1e6, 1000.0 / (number or 1)),
    ):
        if low <= number <= high:
            return unit_mm
    raise scale.fault("millimetres per unit of depth, as in 1 or 0.1")


_MATRICES = ("intrinsic_matrix", "camera_matrix", "cam_K", "K")


def _pinhole(node: Node) -> Intrinsics:
    """Return the intrinsics that an object of a JSON file holds, in whichever spelling."""
    names = next(
        (names for names in (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy")) if node.get(names[2])), None
    )
    if names is not None:
        fx, fy, cx, cy = (node.need(name).number() for name in names)
        if not sane((fx, fy, cx, cy)):
            raise node.fault(f"intrinsics in px, {RANGE}")
        return fx, fy, cx, cy
    entry = next((found for key in _MATRICES if (found := node.get(key)) is not None), None)
    if entry is None:
        raise node.fault("intrinsics, with fx, fy, cx and cy in px, or with their matrix as intrinsic_matrix")
    if isinstance(entry.value, list) and len(entry.value) == 3:
        matrix = np.stack([row.numbers(3) for row in entry.elements()])
    else:
        matrix = entry.numbers(9).reshape(3, 3)
    found = of_matrix(matrix) or of_matrix(matrix.T)
    if found is None:
        raise entry.fault(f"the matrix of a pinhole camera in px, {RANGE}")
    return found


def of_matrix(matrix: Array) -> Intrinsics | None:
    """Return fx, fy, cx, cy of the matrix (3, 3) of a pinhole camera; None if it is that of none."""
    fx, fy, cx, cy = (float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    expected = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    known = sane((fx, fy, cx, cy)) and bool(np.abs(matrix - expected).max() <= 1e-6 * fx)  # not so of NaN
    return (fx, fy, cx, cy) if known else None
