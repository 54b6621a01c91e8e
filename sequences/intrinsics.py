"""Intrinsics: overrides by the user, and the files that programs write next to their images."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from modeler.sequences.input_files import Node, entries, is_there, read_text, read_tree
from modeler.sequences.lens import Lens, lens_of_model
from modeler.types import Array, Camera, InputError

Intrinsics = tuple[float, float, float, float]  # fx, fy, cx, cy in px
RANGE = "fx and fy from 1 to 1e6, cx and cy from -1e6 to 1e6"  # range of intrinsics, for messages


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
    along_ray: bool = False
    """Stored depth is the distance along the ray, as renderers write it, not along the optical axis."""
    strict_paths: bool = False
    """Refuse a sequence in which a link leads out of it."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.intrinsics is not None and not sane(self.intrinsics):
            shown = " ".join(f"{value:g}" for value in self.intrinsics)
            raise InputError(
                f"`intrinsics` {shown} are those of no camera; give FX FY CX CY in px, FX and FY from 1 to 1e6."
            )
        if self.depth_scale_mm is not None and not 1e-6 <= self.depth_scale_mm <= 1e3:
            raise InputError(
                f"`depth_scale_mm` {self.depth_scale_mm:g} is out of range; give the millimetres in one unit of depth."
            )


MAX_ASPECT = 1.5  # pixels are nearly square


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
    "camera_info.json",
    "calibration.txt",
    "intrinsic_depth.txt",
    "intrinsics.txt",
    "camera_matrix.csv",
    "transforms.json",
    "metadata.json",
    "metadata",
)
"""Files that are looked for, in this order; after them, files of YAML (OpenCV, ROS, ORB-SLAM, Kalibr)."""
OF_PHONES = ("camera_matrix.csv", "metadata.json", "metadata", "cameras/")  # of Stray Scanner, Record3D and Polycam
OF_COLOUR = (*OF_PHONES, "transforms.json")  # intrinsics of colour images, whose view depth has in fewer pixels
_PHONE_SIZE = (1920, 1440)  # images of Stray Scanner, whose file does not state their size


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
    distortion: tuple[float, ...] = ()
    """Coefficients of the lens, in the order of the model."""
    model: str = ""
    """Name of the distortion model; "" if the file states none."""

    @property
    def calibrated(self) -> bool:
        """Whether a calibration wrote it, which states the lens as well, or a phone."""
        return bool(self.distortion or self.model) or self.of_phone

    @property
    def of_phone(self) -> bool:
        """Whether a program of phones wrote it; their depth is by time of flight."""
        return self.by in OF_PHONES

    def lens(self, size: tuple[int, int]) -> Lens:
        """Return the camera, with its lens, for images of (width, height)."""
        return lens_of_model(Camera(*size, *self.intrinsics), self.distortion, self.model, self.by)

    def scaled(self, size: tuple[int, int]) -> CameraFacts:
        """Return the camera for the same view in images of (width, height); itself where shape or size do not fit."""
        if self.by not in OF_COLOUR or self.size is None or abs(self.size[0] * size[1] / size[0] - self.size[1]) > 2.0:
            return self
        factor, (fx, fy, cx, cy) = size[0] / self.size[0], self.intrinsics
        pixels = (fx * factor, fy * factor, (cx + 0.5) * factor - 0.5, (cy + 0.5) * factor - 0.5)
        return self if factor == 1.0 else replace(self, intrinsics=pixels, size=size)

    def remarks(self, size: tuple[int, int]) -> list[str]:
        """Return what is assumed of the camera for images of (width, height), and what is doubtful."""
        lens = self.lens(size)
        said = []
        if lens.is_distorted:
            numbers = " ".join(f"{value:g}" for value in lens.coefficients)
            kind = "fisheye lens" if lens.fisheye else "lens distortion"
            said.append(f"{kind} {numbers} ({self.by}) is taken out of depth, colour and masks")
        if self.size not in (None, size):
            said.append(
                f"{self.by} is of images of {self.size[0]} x {self.size[1]} where the depth images are {size[0]} x "
                f"{size[1]}: are its intrinsics theirs?"
            )
        return said

    def unit(self, overrides: Overrides, usual: tuple[float, str]) -> tuple[float, str]:
        """Return the millimetres per unit of depth, and its source."""
        if overrides.depth_scale_mm is not None:
            return overrides.depth_scale_mm, "`depth_scale_mm`"
        return usual if self.unit_mm is None else (self.unit_mm, self.by)


def find_intrinsics(folder: Path, overrides: Overrides) -> CameraFacts | None:
    """Return the camera of a folder of images; None without intrinsics."""
    if overrides.intrinsics is not None:
        return CameraFacts(overrides.intrinsics, "`intrinsics`")
    named = [folder / name for name in NAMES]
    others = [path for path in entries(folder) if path.suffix.lower() in (".yaml", ".yml") and path.name[0] != "."]
    for path in [*named, *others]:
        if not is_there(path):
            continue
        if path.suffix in ("", ".json", ".yaml", ".yml"):
            node = read_tree(path)
            if (path in others or path.name in OF_COLOUR) and not _describes_camera(node):
                continue  # whatever else has such a name
            return camera_of(node, path.name)
        found = _from_text(path)
        return replace(found, size=_phone_size(found)) if path.name in OF_COLOUR else found
    return None


def _phone_size(found: CameraFacts) -> tuple[int, int]:
    """Return (width, height) of the images of which a phone's camera has its principal point in the middle."""
    wide, high = round(2.0 * found.intrinsics[2]), round(2.0 * found.intrinsics[3])
    usual = next((size for size in (_PHONE_SIZE, _PHONE_SIZE[::-1]) if abs(size[0] - wide) < 0.1 * size[0]), None)
    return (wide, high) if usual is None else (usual[0], usual[1])


_WITHIN = ("intrinsic", "intrinsics")
_SPACE = str.maketrans(",;[]", "    ")


def _from_text(path: Path) -> CameraFacts:
    """Read a matrix (3, 3) or (4, 4) by rows, or `fx fy cx cy` and perhaps coefficients of Brown's model."""
    expected = "a matrix of 3 x 3 numbers (fx 0 cx, 0 fy cy, 0 0 1) or a line fx fy cx cy"
    lines = [line for line in read_text(path).translate(_SPACE).splitlines() if not line.startswith("#")]
    rows = [line.split() for line in lines if line.strip()]
    distortion: tuple[float, ...] = ()
    try:
        numbers = [[float(word) for word in row] for row in rows[:5]]
    except ValueError:
        raise InputError(f"{path}: holds words that are no numbers; it must be {expected}.") from None
    if len(numbers) == 1 and len(numbers[0]) >= 4:
        fx, fy, cx, cy = numbers[0][:4]
        found = (fx, fy, cx, cy) if sane((fx, fy, cx, cy)) else None
        # Widths and heights, which may stand there, are larger.
        if len(numbers[0]) - 4 in (4, 5, 8) and max(map(abs, numbers[0][4:])) < 100.0:
            distortion = tuple(numbers[0][4:])
    elif numbers and {len(numbers)} == {len(row) for row in numbers} <= {3, 4}:
        found = of_matrix(np.array(numbers)[:3, :3])
    else:
        found = None
    if found is None:
        raise InputError(f"{path}: does not describe a pinhole camera; it must be {expected}, in px, {RANGE}.")
    return CameraFacts(found, path.name, distortion=distortion)


_SCALES = ("depth_scale", "DepthMapFactor", "depth_unit_scale_factor")
_WIDTHS, _HEIGHTS = ("width", "w", "image_width", "Camera.width"), ("height", "h", "image_height", "Camera.height")


def _describes_camera(node: Node) -> bool:
    """Return whether a tree holds intrinsics in whichever spelling."""
    if not isinstance(node.value, dict):
        return False
    keys = {str(key) for key in node.value}
    return bool(keys & {"fl_x", "fx", "Camera.fx", "Camera1.fx", "cam0", *_MATRICES, *_WITHIN})


def camera_of(node: Node, name: str) -> CameraFacts:
    """Read what Open3D writes (columns of the matrix in turn), a matrix in rows, or fx, fy, cx, cy by name."""
    scale = _first(node, _SCALES)
    node = next((within for key in ("cam0", *_WITHIN) if (within := _inner(node, key)) is not None), node)
    width, height = _first(node, _WIDTHS), _first(node, _HEIGHTS)
    size = None if width is None or height is None else (int(width.number(1.0, 1e5)), int(height.number(1.0, 1e5)))
    model = _first(node, _MODELS)
    return CameraFacts(
        _pinhole(node),
        name,
        None if scale is None else _unit_mm(scale),
        size,
        _distortion(node),
        model.value if model is not None and isinstance(model.value, str) else "",
    )


def cameras_of_frames(path: Path, stems: Iterable[str], size: tuple[int, int]) -> dict[str, CameraFacts]:
    """Return the camera of each depth image of (width, height) by name, as Polycam and `transforms.json` have it."""
    if is_there(path / "transforms.json"):
        whole = read_tree(path / "transforms.json")
        frames = whole.get("frames")
        common = {key: node.value for key, node in whole.items().items() if key != "frames"}
        found = {
            Path(depth.text()).stem: camera_of(
                Node({**common, **{key: node.value for key, node in frame.items().items()}}, whole.path, frame.keys),
                "transforms.json",
            ).scaled(size)
            for frame in (() if frames is None else frames.elements())
            if (depth := frame.get("depth_file_path")) is not None and _describes_camera(frame)
        }
        return found if {*stems} <= found.keys() else {}
    files = {stem: path / "cameras" / f"{stem}.json" for stem in stems}
    if not all(map(is_there, files.values())):
        return {}
    return {stem: camera_of(read_tree(file), "cameras/").scaled(size) for stem, file in files.items()}


def _first(node: Node, keys: tuple[str, ...]) -> Node | None:
    return next((found for key in keys if (found := node.get(key)) is not None), None)


def _inner(node: Node, key: str) -> Node | None:
    """Return an entry that is an object itself."""
    found = node.get(key)
    return found if found is not None and isinstance(found.value, dict) else None


_MODELS = ("distortion_model", "camera_model", "distortion_type", "model", "Camera.type")
_COEFFICIENTS = (
    "coeffs", "coefficients", "distortion_coefficients", "distortion_coeffs", "dist_coeffs", "distCoeffs", "distortion",
    "dist", "D", "d",
)  # fmt: skip
_BY_NAME = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def _distortion(node: Node) -> tuple[float, ...]:
    """Return the coefficients of a lens beside intrinsics, in whichever spelling; () without."""
    entry = _first(node, _COEFFICIENTS)
    if entry is not None and isinstance(entry.value, dict):
        entry = entry if (data := entry.get("data")) is None else data
    if entry is not None and isinstance(entry.value, list):
        found = [number for each in entry.elements() for number in (each.elements() if _is_row(each) else [each])]
        return tuple(number.number() for number in found[:14])  # as many as OpenCV has
    node = node if entry is None else entry
    if not isinstance(node.value, dict):
        return ()
    prefix = next((start for start in ("Camera.", "Camera1.", "") if node.get(f"{start}k1") is not None), None)
    if prefix is None:
        return ()
    fisheye = node.get("p1") is None and node.get(f"{prefix}p1") is None and node.get(f"{prefix}k4") is not None
    names = ("k1", "k2", "k3", "k4") if fisheye else _BY_NAME
    values = (node.get(f"{prefix}{name}") for name in names)
    return tuple(0.0 if value is None else value.number() for value in values)


def _is_row(node: Node) -> bool:
    return isinstance(node.value, list)


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


_MATRICES = ("intrinsic_matrix", "camera_matrix", "cameraMatrix", "cam_K", "K", "k", "intrinsics")
_NAMED = (
    ("fx", "fy", "cx", "cy"),
    ("fx", "fy", "ppx", "ppy"),
    ("fl_x", "fl_y", "cx", "cy"),
    ("Camera.fx", "Camera.fy", "Camera.cx", "Camera.cy"),
    ("Camera1.fx", "Camera1.fy", "Camera1.cx", "Camera1.cy"),
)


def _pinhole(node: Node) -> Intrinsics:
    """Return the intrinsics that an object of a tree holds, in whichever spelling."""
    names = next((names for names in _NAMED if node.get(names[0]) and node.get(names[2])), None)
    names = names or next((names for names in _NAMED if node.get(names[2])), None)
    if names is not None:
        corner_px = 0.5 if names[0] == "fl_x" else 0.0  # nerfstudio measures from the corner of the first pixel
        fx, fy, cx, cy = (node.need(name).number() for name in names)
        return _as_sane(node, [fx, fy, cx - corner_px, cy - corner_px])
    entry = _first(node, _MATRICES)
    if entry is None:
        raise node.fault("intrinsics, with fx, fy, cx and cy in px, or with their matrix as intrinsic_matrix")
    entry = entry if _is_row(entry) or (data := _inner(node, entry.keys[-1])) is None else data.need("data")
    if isinstance(entry.value, list) and len(entry.value) == 4:  # Kalibr's
        return _as_sane(entry, entry.numbers(4).tolist())
    if isinstance(entry.value, list) and len(entry.value) == 3:
        matrix = np.stack([row.numbers(3) for row in entry.elements()])
    else:
        matrix = entry.numbers(9).reshape(3, 3)
    found = of_matrix(matrix) or of_matrix(matrix.T)
    if found is None:
        raise entry.fault(f"the matrix of a pinhole camera in px, {RANGE}")
    return found


def _as_sane(node: Node, numbers: list[float]) -> Intrinsics:
    fx, fy, cx, cy = numbers
    if not sane((fx, fy, cx, cy)):
        raise node.fault(f"intrinsics in px, {RANGE}")
    return fx, fy, cx, cy


def of_matrix(matrix: Array) -> Intrinsics | None:
    """Return fx, fy, cx, cy of the matrix (3, 3) of a pinhole camera; None if it is that of none."""
    fx, fy, cx, cy = (float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    expected = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    known = sane((fx, fy, cx, cy)) and bool(np.abs(matrix - expected).max() <= 1e-6 * fx)  # not so of NaN
    return (fx, fy, cx, cy) if known else None
