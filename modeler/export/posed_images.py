"""Frames as photographs of an object at rest by cameras around it: data sets for radiance fields and splats.

The camera of a run stands still and the object turns, so the background contradicts the cameras: it is left out, by
transparent black and by masks.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.export.bop import silhouettes
from modeler.export.files import ply_bytes, write_atomically
from modeler.system.pictures import encoded
from modeler.types import Array, BoolArray, Camera, Frame, ObjectModel

_PIXEL_CENTRE: Final = 0.5  # nerfstudio and COLMAP measure from the corner of the first pixel
_OPENGL_AXES: Final = np.diag([1.0, -1.0, -1.0, 1.0])  # x right, y up, z backward


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
