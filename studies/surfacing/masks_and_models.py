"""Draw depth, mask and model of runs: `python -m studies surfacing.masks_and_models RUN... --out FILE`.

A column for each run: the depth image of its first frame with the object's mask in orange, and the model from the first
camera, shaded by its normals, grey where the inner side of open surface is seen.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from PIL import Image

from modeler.export import read_model
from modeler.runs.reopening import reopened
from modeler.sequences.image_files import write_image
from modeler.types import Camera, Frame
from studies.surfacing.drawing import Scene

_SIDE_PX: Final = 180
_ORANGE: Final = np.array([255, 140, 0])
Picture = npt.NDArray[np.uint8]


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the picture."""
    parser = argparse.ArgumentParser(
        prog="python -m studies surfacing.masks_and_models",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("runs", nargs="+", type=Path, help="run folders")
    parser.add_argument("--out", type=Path, required=True, help="image file")
    options = parser.parse_args(arguments)
    write_image(options.out, np.hstack([column(run) for run in options.runs]))
    return 0


def column(folder: Path) -> Picture:
    """Return the pictures of a run, one above the other."""
    run = reopened(folder)
    first = min(run.solution.trajectory)
    frame = run.views[first].frame
    model = read_model(folder / "model.ply")
    scene = Scene(model.vertices_m, model.triangles)
    return np.vstack([masked(frame), shaded(scene, frame.camera, run.solution.trajectory[first], frame)])


def masked(frame: Frame) -> Picture:
    """Return the depth about the object, nearer brighter, with its mask in orange."""
    assert frame.mask is not None
    own = frame.depth_m[frame.mask & (frame.depth_m > 0.0)]
    low_m, high_m = float(np.percentile(own, 1)) - 0.1, float(np.percentile(own, 99)) + 0.25
    near = np.clip((high_m - np.nan_to_num(frame.depth_m, nan=np.inf)) / (high_m - low_m), 0.0, 1.0)
    grey = np.repeat(np.where(frame.depth_m > 0.0, 40.0 + 200.0 * near, 0.0)[..., None], 3, axis=2)
    grey[frame.mask] = 0.45 * grey[frame.mask] + 0.55 * _ORANGE * near[frame.mask][:, None]
    return _cut(grey, frame)


def shaded(scene: Scene, camera: Camera, object_from_camera: npt.NDArray[np.float64], frame: Frame) -> Picture:
    """Return the model from a camera, brighter where it faces it; inner sides are darker."""
    drawn = scene.seen(camera, object_from_camera)
    corners = scene.vertices_m[scene.triangles[drawn.triangle[drawn.hit]]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    facing = -normals @ object_from_camera[:3, 2]
    image = np.full((*drawn.hit.shape, 3), 255.0)
    image[drawn.hit] = np.where(facing > 0.0, 60.0 + 190.0 * np.abs(facing), 90.0)[:, None]
    return _cut(image, frame)


def _cut(image: npt.NDArray[np.float64], frame: Frame) -> Picture:
    """Return the square about the object's mask, scaled."""
    assert frame.mask is not None
    rows, columns = np.nonzero(frame.mask)
    half = int(0.62 * max(np.ptp(rows), np.ptp(columns))) + 8
    middle = int(np.mean([rows.min(), rows.max()])), int(np.mean([columns.min(), columns.max()]))
    padded = np.pad(image, ((half, half), (half, half), (0, 0)), mode="edge")
    square = padded[middle[0] : middle[0] + 2 * half, middle[1] : middle[1] + 2 * half]
    picture = Image.fromarray(np.clip(square, 0, 255).astype(np.uint8))
    return np.asarray(picture.resize((_SIDE_PX, _SIDE_PX), Image.Resampling.LANCZOS))


if __name__ == "__main__":
    sys.exit(main())
