"""Intrinsics as programs write them beside their pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from modeler.types import Array, InputError
from sequences.files.folders import inside
from sequences.files.json_input import Node, read_text, read_tree
from sequences.given import Given, Intrinsics, sane

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


def find_intrinsics(folder: Path, given: Given) -> tuple[Intrinsics, str] | None:
    """Return the intrinsics of a folder of pictures and who says so; None where nobody does.

    Args:
        folder: where to look.
        given: what counts more.

    Raises:
        InputError: where a file of intrinsics cannot be read.
    """
    if given.intrinsics is not None:
        return given.intrinsics, "--intrinsics"
    for name in NAMES:
        path = folder / name
        if path.exists():
            inside(path, folder)
            return (_from_json(read_tree(path)) if path.suffix == ".json" else _from_text(path)), name
    return None


def _from_text(path: Path) -> Intrinsics:
    """Read a matrix (3, 3) or (4, 4) row by row, or `fx fy cx cy` with anything after it."""
    expected = "a matrix of 3 x 3 numbers (fx 0 cx, 0 fy cy, 0 0 1) or a line fx fy cx cy"
    rows = [line.split() for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
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
        raise InputError(f"{path}: does not describe a pinhole camera; it must be {expected}, in px.")
    return found


def _from_json(node: Node) -> Intrinsics:
    """Read what Open3D writes (columns of the matrix in turn), a matrix in rows, or fx, fy, cx, cy by name."""
    if node.get("intrinsic") is not None:
        node = node.need("intrinsic")
    names = next(
        (names for names in (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy")) if node.get(names[2])), None
    )
    if names is not None:
        fx, fy, cx, cy = (node.need(name).number() for name in names)
        if not sane((fx, fy, cx, cy)):
            raise node.fault("intrinsics in px with fx and fy of at least 1")
        return fx, fy, cx, cy
    key = next((key for key in ("intrinsic_matrix", "camera_matrix", "cam_K", "K") if node.get(key) is not None), None)
    entry = node.need("intrinsic_matrix" if key is None else key)
    if isinstance(entry.value, list) and len(entry.value) == 3:
        matrix = np.stack([row.numbers(3) for row in entry.elements()])
    else:
        matrix = entry.numbers(9).reshape(3, 3)
    found = of_matrix(matrix) or of_matrix(matrix.T)
    if found is None:
        raise entry.fault("the matrix of a pinhole camera in px with fx and fy of at least 1")
    return found


def of_matrix(matrix: Array) -> Intrinsics | None:
    """Return fx, fy, cx, cy of the matrix (3, 3) of a pinhole camera; None where it is that of none."""
    fx, fy, cx, cy = (float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    expected = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    known = sane((fx, fy, cx, cy)) and bool(np.abs(matrix - expected).max() <= 1e-6 * fx)  # not so of NaN
    return (fx, fy, cx, cy) if known else None
