"""A model as the BOP benchmark's pose estimators take it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist

from modeler.export.files import write_atomically
from modeler.export.ply import ply_bytes
from modeler.types import Array, InputError, ObjectModel

INFO = "models_info.json"


def write_bop(model: ObjectModel, out: Path) -> None:
    """Write a mesh in mm, its origin in the centre of its box, with its entry in `models_info.json` beside it.

    The entry has the diameter and the box as BOP defines them, and `origin_m`: where in the object frame of the run the
    model's origin lies. Entries of other objects stay.

    Args:
        model: the mesh.
        out: PLY file whose name ends in the number of the object (`obj_000001.ply`); without a number it is object 1.

    Raises:
        InputError: where the name is not that of a PLY file, or a file cannot be read or written.
    """
    if out.suffix.lower() != ".ply":
        raise InputError(f"{out}: BOP models are PLY files; give --out a name such as obj_000001.ply")
    digits = re.search(r"(\d+)$", out.stem)
    number = str(int(digits.group(1))) if digits else "1"
    low, high = model.vertices_m.min(axis=0), model.vertices_m.max(axis=0)
    origin_m = 0.5 * (low + high)
    places_mm = 1000.0 * (model.vertices_m - origin_m)
    path = out.with_name(INFO)
    entries = _entries(path)
    size_mm = 1000.0 * (high - low)
    entries[number] = {
        "diameter": _diameter(places_mm),
        **{f"min_{axis}": float(value) for axis, value in zip("xyz", -0.5 * size_mm, strict=True)},
        **{f"size_{axis}": float(value) for axis, value in zip("xyz", size_mm, strict=True)},
        "origin_m": origin_m.tolist(),
    }
    write_atomically(out, ply_bytes(places_mm, model.vertex_normals, model.vertex_colours, model.triangles))
    write_atomically(path, json.dumps(dict(sorted(entries.items(), key=lambda entry: int(entry[0]))), indent=2) + "\n")


def _entries(path: Path) -> dict[str, Any]:
    """Return the entries of other objects, by their numbers, in a `models_info.json` whose folder is made if need be.

    Raises:
        InputError: where it cannot be read, or is no such file.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        entries = json.loads(path.read_text()) if path.exists() else {}
    except OSError as error:
        raise InputError(
            f"{path.parent}: cannot be used ({error.strerror}); choose another place with --out"
        ) from error
    except ValueError as error:
        raise InputError(f"{path}: cannot be read ({error}); mend it or choose another folder") from error
    if not isinstance(entries, dict) or not all(number.isdecimal() for number in entries):
        raise InputError(f"{path}: lists no objects by their numbers; mend it or choose another folder")
    return entries


def _diameter(points: Array) -> float:
    """Return the largest distance between two points (n, 3)."""
    try:
        points = points[ConvexHull(points).vertices]
    except QhullError:  # flat
        points = np.unique(points, axis=0)
    return float(pdist(points).max()) if len(points) > 1 else 0.0
