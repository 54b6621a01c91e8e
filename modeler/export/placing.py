"""The frame that an exported mesh is given in, which axis is up, and upright views of an object on its support."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from modeler import se3
from modeler.export.files import write_atomically
from modeler.export.reading import poses_of
from modeler.types import Array, ObjectModel, RayImage, areas_m2

Origin = Literal["camera", "base", "centre", "bbox"]
Up = Literal["z", "y"]

CAMERA_AXES: Final = "x right, y down, z forward in the first image"
_AXES: Final[Mapping[Up, str]] = {
    "z": "x right, y away from the first camera, z up",
    "y": "x right, y up, z towards the first camera",
}
_ORIGINS: Final[Mapping[Origin, str]] = {
    "camera": "the first camera",
    "base": "the centre of the base",
    "centre": "the centroid of the surface",
    "bbox": "the centre of the bounding box",
}
_UP_WORDS: Final[Mapping[UpSource, str]] = {
    "support": "the normal of the support",
    "ring": "the axis of the cameras' ring, as no support was seen",
    "camera": "the upper edge of the first image, as neither a support nor a ring of cameras was seen",
}


@dataclass(frozen=True, eq=False)
class Placement:
    """A frame for an exported mesh."""

    object_from_mesh: Array
    """(4, 4) takes a point of the mesh, in m, to the object frame of the run: the camera frame of its first frame."""
    origin: Origin
    """What lies at the origin."""
    up: Up | None
    """Which axis is up; None: the axes are the first camera's."""
    up_from: UpSource | None
    """Source of the up direction; None if none is used."""
    base_from: Literal["support", "lowest vertex"] | None
    """Source of the height of the base; None if the origin is not there."""

    @property
    def axes(self) -> str:
        """The three axes in words."""
        return CAMERA_AXES if self.up is None else _AXES[self.up]

    @property
    def words(self) -> str:
        """Origin and axes in a sentence, with their sources."""
        base = " at its lowest vertex" if self.base_from == "lowest vertex" else ""
        up = "" if self.up is None or self.up_from is None else f"; up is {_UP_WORDS[self.up_from]}"
        return f"origin at {_ORIGINS[self.origin]}{base}, {self.axes}{up}"

    def placed(self, model: ObjectModel) -> ObjectModel:
        """Return a model of the object frame in this frame."""
        mesh_from_object = se3.inverse(self.object_from_mesh)
        turn = mesh_from_object[:3, :3].T
        return replace(
            model,
            points_m=se3.transform(mesh_from_object, model.points_m),
            normals=model.normals @ turn,
            vertices_m=se3.transform(mesh_from_object, model.vertices_m),
            vertex_normals=model.vertex_normals @ turn,
        )

    def write(self, out: Path, *, unit: Literal["m", "mm"] = "m") -> None:
        """Write the sidecar of an exported mesh, from which it can be put back where the camera saw it.

        Args:
            out: the mesh; the sidecar is `pose_file(out)`.
            unit: in which its coordinates are written.
        """
        content: dict[str, Any] = {
            "schema": 1,
            "mesh": out.name,
            "unit": unit,
            "object_from_mesh": self.object_from_mesh.ravel().tolist(),
            "origin": self.origin,
            "axes": self.axes,
            "up_from": self.up_from,
            "base_from": self.base_from,
        }
        write_atomically(pose_file(out), json.dumps(content, indent=1) + "\n")


def pose_file(out: Path) -> Path:
    """Return the sidecar of an exported mesh: `cup.obj.pose.json` of `cup.obj`."""
    return out.with_name(f"{out.name}.pose.json")


def default_up(suffix: str, origin: Origin) -> Up | None:
    """Return which axis users of a format expect to be up; None at the camera's origin, where its axes are kept."""
    if origin == "camera":
        return None
    return "y" if suffix == ".glb" else "z"


def placement(model: ObjectModel, report: Mapping[str, Any], origin: Origin, up: Up | None) -> Placement:
    """Return the frame of the model of a run with the requested origin and axes.

    The horizontal axes are the first camera's: x is its right. The base is on the support; without one, at the
    height of the lowest vertex. Its centre is that of the box around the model.

    Args:
        model: with a mesh, in the object frame.
        report: of the run.
        origin: what lies at the origin.
        up: which axis is up; None: the camera's axes are kept.
    """
    object_from_mesh, up_from, base_from = np.eye(4), None, None
    vertical = None
    if up is not None or origin == "base":
        direction, up_from = model_up(report)
        right, forward, vertical = level_axes(direction).T
        if up is not None:
            turned = (right, forward, vertical) if up == "z" else (right, vertical, -forward)
            object_from_mesh[:3, :3] = np.stack(turned, axis=1)
    match origin:
        case "camera":
            pass
        case "centre":
            middles_m = model.vertices_m[model.triangles].mean(axis=1)
            areas = areas_m2(model.vertices_m, model.triangles)
            object_from_mesh[:3, 3] = np.average(middles_m, axis=0, weights=areas)
        case "bbox":
            turn = object_from_mesh[:3, :3]
            object_from_mesh[:3, 3] = turn @ _box_centre(model.vertices_m @ turn)
        case "base":
            assert vertical is not None
            level = level_axes(vertical)
            centre = _box_centre(model.vertices_m @ level)
            offset_m = report.get("support_offset_m") if up_from == "support" else None
            # The plane is normal · p + offset = 0, and `up` its normal.
            centre[2] = (model.vertices_m @ vertical).min() if offset_m is None else -float(offset_m)
            base_from = "lowest vertex" if offset_m is None else "support"
            object_from_mesh[:3, 3] = level @ centre
    return Placement(object_from_mesh, origin, up, up_from, base_from)


def _box_centre(points: Array) -> Array:
    """Return the centre (3,) of the box around points (n, 3)."""
    return 0.5 * (points.min(axis=0) + points.max(axis=0))


_LEAST_BACK = 0.3
"""Least horizontal part of the direction to the camera: within 17° of the vertical it looks straight down."""
_WIDE, _FLAT = 0.1, 0.3  # a ring is no line, and all but plane

UpSource = Literal["support", "ring", "camera"]
"""Source of the up direction: the support, the ring of the cameras, or the first image."""


def standing(up: Array) -> Array:
    """Return right, down and forward (3, 3), as columns, of a view from the camera's side in which `up` (3,) is up.

    Returns:
        The identity, which is the camera's own view, if the camera looks along `up`.
    """
    back = np.array([0.0, 0.0, -1.0])
    back = back - up * (up @ back)
    length = float(np.linalg.norm(back))
    if length < _LEAST_BACK:
        return np.eye(3)
    forward = -back / length
    return np.stack([np.cross(forward, up), -up, forward], axis=1)


def upright(view: RayImage) -> Array:
    """Return right, down and forward (3, 3), as columns, of a view in which the support of an object is level.

    The identity, which is the camera's own view, if no support is seen.
    """
    return np.eye(3) if view.plane is None else standing(view.plane.normal)


def model_upright(report: Mapping[str, Any]) -> Array:
    """Return right, down and forward (3, 3), as columns, of a view in which the model of a run stands upright.

    The support is level in it; without one, the ring of cameras around it; without a ring, it is the view of the first
    frame's camera.
    """
    up, source = model_up(report)
    return np.eye(3) if source == "camera" else standing(up)


def model_up(report: Mapping[str, Any]) -> tuple[Array, UpSource]:
    """Return the up direction (3,) in the object frame of a run, and its source."""
    up = report.get("up")  # which reports of earlier versions have not
    if up is not None:
        up = np.array(up, dtype=np.float64)
        return up / np.linalg.norm(up), "support"
    up = _ring_up(np.array([pose.mean[:3, 3] for pose in poses_of(report).values()]))
    return (np.array([0.0, -1.0, 0.0]), "camera") if up is None else (up, "ring")


def level_axes(up: Array) -> Array:
    """Return right, forward and up (3, 3), as columns, of level axes, as a camera faces in which `up` (3,) is up."""
    for ahead in (np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])):
        forward = ahead - up * (up @ ahead)
        length = float(np.linalg.norm(forward))
        if length >= _LEAST_BACK:
            break
    forward = forward / length
    return np.stack([np.cross(forward, up), forward, up], axis=1)


def _ring_up(centres_m: Array) -> Array | None:
    """Return the up direction (3,) of a ring of cameras at (n, 3); None if there is no ring."""
    long, wide, high = np.pad(np.linalg.svd(centres_m - centres_m.mean(axis=0), compute_uv=False), (0, 3))[:3]
    return ring_axes(centres_m)[1] if wide > _WIDE * long and high < _FLAT * wide else None


def ring_axes(centres_m: Array) -> tuple[Array, Array]:
    """Return the right (3,) and up (3,) directions for pictures of a ring of cameras.

    From above the first camera's left is on the left; from the side, its up is up.

    Args:
        centres_m: (n, 3) where the cameras are, in the object frame.
    """
    middle = centres_m.mean(axis=0)
    spread = np.linalg.svd(centres_m - middle)[2] if len(centres_m) > 2 else np.eye(3)[[0, 2, 1]]
    across = spread[0] * (np.sign(spread[0, 0]) or 1.0)
    up = np.cross(spread[0], spread[1])
    return across, -up if up[1] > 0 else up  # y is down
