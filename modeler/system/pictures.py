"""Pictures as the bytes of files, and rays cast at meshes by Open3D."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from modeler.types import Array

if TYPE_CHECKING:
    import open3d as o3d


def encoded(pixels: npt.NDArray[Any], kind: Literal["PNG", "JPEG"], **options: Any) -> bytes:
    """Return pixels (h, w) or (h, w, c) as a file; options are those of Pillow's writer."""
    from PIL import Image  # many who import this write no picture

    buffer = io.BytesIO()
    options = {"quality": 85, **options} if kind == "JPEG" else options  # edges are then free of visible blocks
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, kind, **options)
    return buffer.getvalue()


def linear_light(srgb: npt.NDArray[np.floating]) -> Array:
    """Return sRGB values of any shape, 0 to 1, in proportion to light (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0.0) + 0.055) / 1.055) ** 2.4)


def tensor(values: npt.NDArray[Any]) -> o3d.core.Tensor:
    """Return an array of any shape as Open3D's numbers of 32 bits."""
    import open3d as o3d  # takes a second to import

    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def raycaster(vertices_m: Array, triangles: npt.NDArray[np.int64]) -> o3d.t.geometry.RaycastingScene:
    """Return a mesh of vertices (v, 3) and triangles (t, 3), which may be none, ready for rays."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    if len(triangles):
        numbers = o3d.core.Tensor.from_numpy(np.ascontiguousarray(triangles, dtype=np.uint32))
        scene.add_triangles(tensor(vertices_m), numbers)
    return scene
