"""Frames with their poses as data sets: BOP's, and those for radiance fields and splats (nerfstudio, COLMAP).

BOP has models in mm with their entry in `models_info.json`, and their visibility in scenes. For radiance fields, frames
are photographs of an object at rest by cameras around it: the camera of a run stands still and the object turns, so the
background contradicts the cameras, and is left out, by transparent black and by masks.
"""

from __future__ import annotations

import json
import os
import re
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.export.files import ply_bytes, write_atomically
from modeler.export.placing import Placement
from modeler.system.pictures import encoded, raycaster, tensor
from modeler.system.regular_files import json_lines, read_json
from modeler.types import Array, BoolArray, Camera, Frame, InputError, ObjectModel

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
    return json_lines(entries)


def _box(mask: BoolArray) -> list[int]:
    """Return left, top, width and height in px of the pixels of a mask (h, w); -1 where there are none."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return [-1, -1, -1, -1]
    return [int(columns[0]), int(rows[0]), int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1]


_PIXEL_CENTRE: Final = 0.5  # nerfstudio and COLMAP measure from the corner of the first pixel
_OPENGL_AXES: Final = se3.rigid(se3.Y_UP, np.zeros(3))


@dataclass(frozen=True, eq=False)
class PosedImages:
    """Frames with their cameras in a world in which the object is at rest, z up."""

    frames: Mapping[int, Frame]
    """With colour and mask, by number."""
    world_from_camera: Mapping[int, Array]
    """(4, 4), m, by frame number."""
    points_m: Array
    """(n, 3) on the surface, in the world."""
    normals: Array
    """(n, 3) unit, outwards."""
    colours: npt.NDArray[np.uint8]
    """(n, 3) RGB of the points."""

    @classmethod
    def of(cls, model: ObjectModel, frames: Mapping[int, Frame], world_from_camera: Mapping[int, Array]) -> PosedImages:
        """Return frames with points of a coloured model in the world.

        Depth cameras see the rim of many objects badly, and masks follow depth: where none was measured, the model says
        what the object is.
        """
        assert model.vertex_colours is not None
        camera_from_world = {k: se3.inverse(pose) for k, pose in world_from_camera.items()}
        frames = {
            frame.index: with_unmeasured(frame, silhouette)
            for frame, silhouette in silhouettes(model, frames.values(), camera_from_world)
        }
        count = len(model.vertices_m)
        # Trainers add more where they need them.
        some = np.unique(np.linspace(0, count - 1, min(count, 20_000)).astype(np.int64))
        return cls(
            frames, world_from_camera, model.vertices_m[some], model.vertex_normals[some], model.vertex_colours[some]
        )

    def observations(self, number: int, tolerance_m: float) -> tuple[npt.NDArray[np.int64], Array]:
        """Return which points a frame sees and where (k, 2), in px as `Camera` measures them."""
        frame, world_from_camera = self.frames[number], self.world_from_camera[number]
        points_m = se3.transform(se3.inverse(world_from_camera), self.points_m)
        facing = ((self.points_m - world_from_camera[:3, 3]) * self.normals).sum(axis=1) < 0.0
        places, inside = projected(frame.camera, points_m)
        columns, rows = np.rint(np.where(inside[:, None], places, 0.0)).astype(np.int64).T
        depth_m = np.where(object_of(frame), frame.depth_m, np.nan)[rows, columns]
        seen = inside & facing & (np.abs(depth_m - points_m[:, 2]) < tolerance_m)
        return np.flatnonzero(seen), places[seen]


def with_unmeasured(frame: Frame, silhouette: BoolArray) -> Frame:
    """Return a frame whose mask also holds the pixels of a silhouette (h, w) in which no depth was measured."""
    free = np.isfinite(frame.depth_m) if frame.occluder is None else np.isfinite(frame.depth_m) | frame.occluder
    return replace(frame, mask=object_of(frame) | (silhouette & ~free))


def object_of(frame: Frame) -> BoolArray:
    """Return the pixels (h, w) of the object; without a mask, all that are measured."""
    return np.isfinite(frame.depth_m) if frame.mask is None else frame.mask


def projected(camera: Camera, points_m: Array) -> tuple[Array, BoolArray]:
    """Return places (n, 2) in px of points (n, 3) of the camera frame, and whether they are in the image."""
    ahead = points_m[:, 2] > 0.0
    depth_m = np.where(ahead, points_m[:, 2], 1.0)
    places = points_m[:, :2] / depth_m[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    high = [camera.width - 0.5, camera.height - 0.5]
    return places, ahead & np.all((places >= -0.5) & (places < high), axis=1)


def write_nerfstudio(data: PosedImages, folder: Path) -> None:
    """Write `transforms.json` with RGBA images, masks, depth in mm and initial points.

    Cameras are OpenGL's (x right, y up, z backward), lengths are m.
    """
    cameras = {k: _nerfstudio_camera(frame.camera) for k, frame in data.frames.items()}
    alike = len({json.dumps(camera) for camera in cameras.values()}) == 1
    entries = []
    for number, frame in data.frames.items():
        name = f"{number:06d}.png"
        _write_images(frame, folder / "images" / name, folder / "masks" / name)
        depth_mm = np.where(object_of(frame) & np.isfinite(frame.depth_m), 1000.0 * frame.depth_m, 0.0)
        depth = np.clip(np.rint(depth_mm), 0, 65535).astype(np.uint16)
        write_atomically(folder / "depth" / name, encoded(depth, "PNG"))
        entries.append(
            {
                "file_path": f"images/{name}",
                "mask_path": f"masks/{name}",
                "depth_file_path": f"depth/{name}",
                **({} if alike else cameras[number]),
                "transform_matrix": (data.world_from_camera[number] @ _OPENGL_AXES).tolist(),
            }
        )
    content: dict[str, Any] = {"camera_model": "OPENCV", "ply_file_path": "points.ply"}
    content |= next(iter(cameras.values())) if alike else {}
    write_atomically(folder / "points.ply", ply_bytes(data.points_m, data.normals, data.colours))
    write_atomically(folder / "transforms.json", json.dumps(content | {"frames": entries}, indent=1) + "\n")


def _nerfstudio_camera(camera: Camera) -> dict[str, float]:
    return {
        **{"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy},
        **{"cx": camera.cx + _PIXEL_CENTRE, "cy": camera.cy + _PIXEL_CENTRE},
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
    }


def write_colmap(data: PosedImages, folder: Path, tolerance_m: float) -> int:
    """Write RGBA images, masks, and a sparse model as text and binary, and return its number of points.

    Its points are those of the surface that a frame sees, and their observations are projections, no matched features.
    """
    numbers: dict[Camera, int] = {}
    images: list[tuple[str, bytes]] = []
    tracks: dict[int, list[tuple[int, int]]] = {}
    for number, frame in data.frames.items():
        name = f"{number:06d}.png"
        _write_images(frame, folder / "images" / name, folder / "masks" / f"{name}.png")
        camera = numbers.setdefault(frame.camera, len(numbers) + 1)
        points, places = data.observations(number, tolerance_m)
        for row, point in enumerate(points.tolist()):
            tracks.setdefault(point, []).append((number + 1, row))
        camera_from_world = se3.inverse(data.world_from_camera[number])
        x, y, z, w = Rotation.from_matrix(camera_from_world[:3, :3]).as_quat(canonical=True).tolist()
        pose = (w, x, y, z, *camera_from_world[:3, 3].tolist())
        columns, rows = (places + _PIXEL_CENTRE).T
        seen = np.rec.fromarrays([columns, rows, points + 1], dtype=[("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
        words = " ".join(f"{column!r} {row!r} {point}" for column, row, point in seen.tolist())
        head = struct.pack("<I7dI", number + 1, *pose, camera) + name.encode() + b"\0" + struct.pack("<Q", len(seen))
        images.append((f"{number + 1} {_words(*pose)} {camera} {name}\n{words}\n", head + seen.tobytes()))
    tracks = dict(sorted(tracks.items()))
    sparse = folder / "sparse" / "0"
    text, binary = [""] * 3, [struct.pack("<Q", len(part)) for part in (numbers, images, tracks)]
    for camera, number in numbers.items():
        values = camera.fx, camera.fy, camera.cx + _PIXEL_CENTRE, camera.cy + _PIXEL_CENTRE
        text[0] += f"{number} PINHOLE {camera.width} {camera.height} {_words(*values)}\n"
        # 1: COLMAP's model without distortion.
        binary[0] += struct.pack("<iiQQ4d", number, 1, camera.width, camera.height, *values)
    text[1] += "".join(words for words, _ in images)
    binary[1] += b"".join(packed for _, packed in images)
    lines, records = [], []
    for point, track in tracks.items():
        place, rgb = data.points_m[point].tolist(), data.colours[point].tolist()
        lines.append(f"{point + 1} {_words(*place)} {_words(*rgb)} 0 {' '.join(f'{i} {k}' for i, k in track)}\n")
        records.append(struct.pack("<Q3d3BdQ", point + 1, *place, *rgb, 0.0, len(track)))
        records.append(np.array(track, dtype="<u4").tobytes())
    text[2], binary[2] = "".join(lines), binary[2] + b"".join(records)
    for name, words, data_bytes in zip(("cameras", "images", "points3D"), text, binary, strict=True):
        write_atomically(sparse / f"{name}.txt", words)
        write_atomically(sparse / f"{name}.bin", data_bytes)
    return len(tracks)


def _words(*numbers: float) -> str:
    return " ".join(map(repr, numbers))


def _write_images(frame: Frame, image: Path, mask: Path) -> None:
    """Write the object, transparent black around it, and its mask."""
    assert frame.colour is not None
    alpha = object_of(frame).astype(np.uint8) * np.uint8(255)
    pixels = np.dstack([np.where(alpha[..., None], frame.colour, 0).astype(np.uint8), alpha])
    write_atomically(image, encoded(pixels, "PNG"))
    write_atomically(mask, encoded(alpha, "PNG"))


def share_within_masks(folder: Path) -> float:
    """Return which share of the initial points of a nerfstudio folder, read back, lies in the masks of its images.

    Where the object is whole in every image, all of them do.
    """
    import trimesh
    from PIL import Image

    content = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    cloud: Any = trimesh.load(folder / content["ply_file_path"])
    points_m = np.asarray(cloud.vertices, dtype=np.float64)
    hits = []
    for entry in content["frames"]:
        world_from_camera = np.array(entry["transform_matrix"]) @ _OPENGL_AXES
        said = content | entry
        camera = Camera(
            *(said[name] for name in ("w", "h", "fl_x", "fl_y")), *(said[name] - _PIXEL_CENTRE for name in ("cx", "cy"))
        )
        places, inside = projected(camera, se3.transform(se3.inverse(world_from_camera), points_m))
        columns, rows = np.rint(places[inside]).astype(np.int64).T
        hits.append(float((np.asarray(Image.open(folder / entry["mask_path"]))[rows, columns] > 0).mean()))
    return float(np.median(hits))
