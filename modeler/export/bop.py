"""BOP models: meshes in mm with their entry in `models_info.json`, and their visibility in scenes."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist

from modeler import se3
from modeler.export.files import ply_bytes, write_atomically
from modeler.export.placing import Placement
from modeler.system.pictures import raycaster, tensor
from modeler.system.regular_files import read_json
from modeler.types import Array, BoolArray, Frame, InputError, ObjectModel

MODELS_INFO = "models_info.json"  # BOP's list of models, in their folder


def write_bop(model: ObjectModel, out: Path, place: Placement, more: Mapping[str, Any] | None = None) -> None:
    """Write a mesh in mm with its entry in `models_info.json` in the same folder; entries of other objects stay.

    The entry has the diameter and the box as BOP defines them, and `object_from_mesh` (16, row by row, m), which takes
    the mesh to the object frame of the run.

    Args:
        model: the mesh, in the object frame.
        out: PLY file whose name ends in the number of the object (`obj_000001.ply`); without a number it is object 1.
        place: the frame to write it in; BOP's own has the origin in the centre of the box and z up.
        more: further values of the entry.

    Raises:
        InputError: if the folder is not empty or cannot be written, or depth does not fit into 16 bits.
    """
    if out.suffix.lower() != ".ply":
        raise InputError(f"{out}: BOP models are PLY files; choose a name such as obj_000001.ply")
    digits = re.search(r"(\d+)$", out.stem)
    number = str(int(digits.group(1))) if digits else "1"
    model = place.placed(model)
    places_mm = 1000.0 * model.vertices_m
    path = out.with_name(MODELS_INFO)
    entries = _entries(path)
    low_mm, size_mm = places_mm.min(axis=0), np.ptp(places_mm, axis=0)
    entries[number] = {
        "diameter": _diameter(places_mm),
        **{f"min_{axis}": float(value) for axis, value in zip("xyz", low_mm, strict=True)},
        **{f"size_{axis}": float(value) for axis, value in zip("xyz", size_mm, strict=True)},
        **(more or {}),
        "object_from_mesh": place.object_from_mesh.ravel().tolist(),
    }
    write_atomically(out, ply_bytes(places_mm, model.vertex_normals, model.vertex_colours, model.triangles))
    write_atomically(path, json.dumps(dict(sorted(entries.items(), key=lambda entry: int(entry[0]))), indent=2) + "\n")


def _entries(path: Path) -> dict[str, Any]:
    """Return the entries of other objects, by their numbers, in `models_info.json`."""
    entries = read_json(path) if os.path.lexists(path) else {}
    if not isinstance(entries, dict) or not all(number.isdecimal() for number in entries):
        raise InputError(f"{path}: lists no objects by their numbers; correct it or choose another folder")
    return entries


def _diameter(points: Array) -> float:
    """Return the largest distance between two points (n, 3)."""
    try:
        points = points[ConvexHull(points).vertices]
    except QhullError:  # flat
        points = np.unique(points, axis=0)
    return float(pdist(points).max()) if len(points) > 1 else 0.0


def symmetry_entries(
    discrete: Iterable[Array], continuous: Iterable[tuple[Array, Array]], object_from_mesh: Array
) -> dict[str, Any]:
    """Return the entries of `models_info.json` for symmetries; none where there are none.

    Args:
        discrete: rotations (4, 4) of the object frame onto itself, m.
        continuous: directions (3,) and points (3,), m, of axes in the object frame.
        object_from_mesh: (4, 4) from the frame of the model, m.
    """
    mesh_from_object = se3.inverse(object_from_mesh)
    turns = []
    for pose in discrete:
        turn = mesh_from_object @ pose @ object_from_mesh
        turn[:3, 3] *= 1000.0
        turns.append(turn.ravel().tolist())
    axes = [
        {
            "axis": (mesh_from_object[:3, :3] @ direction).tolist(),
            "offset": (1000.0 * se3.transform(mesh_from_object, point_m[None])[0]).tolist(),
        }
        for direction, point_m in continuous
    ]
    entries = {"symmetries_discrete": turns, "symmetries_continuous": axes}
    return {name: values for name, values in entries.items() if values}


def silhouettes(
    model: ObjectModel, frames: Iterable[Frame], camera_from_model: Mapping[int, Array]
) -> Iterator[tuple[Frame, BoolArray]]:
    """Yield frames with the pixels (h, w) that the model covers.

    Args:
        model: the mesh, in m.
        frames: of the cameras.
        camera_from_model: (4, 4), m, by frame number.
    """
    scene = raycaster(model.vertices_m, model.triangles)
    for frame in frames:
        pose = camera_from_model[frame.index]
        w, h = frame.camera.rays()
        directions = np.stack([w, h, np.ones_like(w)], axis=-1) @ pose[:3, :3]  # rotated into the model's frame
        origins = np.broadcast_to(-pose[:3, :3].T @ pose[:3, 3], directions.shape)
        rays = tensor(np.concatenate([origins, directions], axis=-1))
        yield frame, np.isfinite(scene.cast_rays(rays)["t_hit"].numpy())


def scene_gt_info(model: ObjectModel, frames: Iterable[Frame], camera_from_model: Mapping[int, Array]) -> str:
    """Return `scene_gt_info.json` of frames with masks: boxes and counts of pixels, as BOP defines them.

    Args:
        model: the mesh, in m.
        frames: with the object's visible pixels as mask.
        camera_from_model: (4, 4), m, by frame number.
    """
    entries = {}
    for frame, silhouette in silhouettes(model, frames, camera_from_model):
        visible = np.zeros_like(silhouette) if frame.mask is None else frame.mask
        whole, seen = int(silhouette.sum()), int(visible.sum())
        entries[str(frame.index)] = [
            {
                "bbox_obj": _box(silhouette),
                "bbox_visib": _box(visible),
                "px_count_all": whole,
                "px_count_valid": int((silhouette & np.isfinite(frame.depth_m)).sum()),
                "px_count_visib": seen,
                "visib_fract": min(1.0, seen / whole) if whole else 0.0,
            }
        ]
    return "{\n" + ",\n".join(f' "{index}": {json.dumps(entry)}' for index, entry in entries.items()) + "\n}\n"


def _box(mask: BoolArray) -> list[int]:
    """Return left, top, width and height in px of the pixels of a mask (h, w); -1 where there are none."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return [-1, -1, -1, -1]
    return [int(columns[0]), int(rows[0]), int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1]
