"""The animation of the README: a growing model, and the uncertainty of its poses.

`python -m studies growing SEQUENCE --out docs/growing.webp` builds a sequence with the table prior (that of
the README: `modeler render figurine`). For each frame it draws what the camera sees with the object outlined, the model
so far, and the cameras around the object from above, with regions of their positions at one standard deviation,
magnified.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from PIL import Image
from scipy import ndimage

from modeler import Modeler, Step, TablePrior
from modeler.sequences import open_sequence
from modeler.types import Array, BoolArray
from modeler.viz.report.mesh import look_at, shade

SIDE_PX = 300
MAGNIFIED = 40.0  # regions of positions, which are millimetres beside a circle of 0.7 m
Picture = npt.NDArray[np.uint8]


def draw(steps: Sequence[Step]) -> list[Picture]:
    """Return a picture (h, w, 3) for each step."""
    last = steps[-1]
    assert last.model is not None
    plane = steps[0].segmentation.plane
    assert plane is not None
    vertices_m = last.model.vertices_m
    centre_m = 0.5 * (vertices_m.min(axis=0) + vertices_m.max(axis=0))
    size_m = float(np.linalg.norm(np.ptp(vertices_m, axis=0)))
    side = np.cross(plane.normal, [0.0, 0.0, 1.0])
    viewer = look_at(
        centre_m, -np.array([0.0, 0.0, 1.0]) + 0.5 * plane.normal + 0.6 * side, 1.75 * size_m, plane.normal
    )
    cut = _cut(np.any([step.segmentation.mask for step in steps], axis=0))
    return [np.hstack([_seen(step, cut), _model(step, viewer), _poses(step, centre_m, plane.normal)]) for step in steps]


def _cut(everywhere: BoolArray) -> tuple[slice, slice]:
    """Return rows and columns of a square around where the object is in any frame, half as wide again."""
    rows, columns = (np.flatnonzero(everywhere.any(axis=axis)) for axis in (1, 0))
    half = min(int(0.75 * max(np.ptp(rows), np.ptp(columns))), min(everywhere.shape) // 2)
    starts = [
        int(np.clip((seen[0] + seen[-1]) // 2 - half, 0, length - 2 * half))
        for seen, length in zip((rows, columns), everywhere.shape, strict=True)
    ]
    return slice(starts[0], starts[0] + 2 * half), slice(starts[1], starts[1] + 2 * half)


def _seen(step: Step, cut: tuple[slice, slice]) -> Picture:
    """Return the frame with the object outlined."""
    if step.frame.colour is None:
        raise SystemExit("growing: the sequence has no colour images.")
    picture, mask = step.frame.colour.copy(), step.segmentation.mask
    picture[np.asarray(ndimage.binary_dilation(mask), dtype=np.bool_) & ~mask] = (255, 140, 0)
    return np.asarray(Image.fromarray(picture[cut]).resize((SIDE_PX, SIDE_PX)))


def _model(step: Step, viewer: Array) -> Picture:
    """Return the model so far."""
    model = step.model
    assert model is not None
    if not len(model.triangles):
        return np.full((SIDE_PX, SIDE_PX, 3), 255, dtype=np.uint8)
    return shade(model.vertices_m, model.triangles, model.vertex_colours, viewer, (SIDE_PX, SIDE_PX))


def _poses(step: Step, centre_m: Array, up: Array) -> Picture:
    """Return the cameras around the object from above."""
    across = np.stack([np.cross(up, [0.0, 0.0, 1.0]), np.cross(up, np.cross(up, [0.0, 0.0, 1.0]))])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    figure = Figure(figsize=(3, 3), dpi=SIDE_PX / 3)
    axis: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axis.set(xlim=(-1.0, 1.0), ylim=(-1.0, 1.0), aspect="equal")
    axis.axis("off")
    trajectory: Mapping[int, Array] = step.solution.trajectory
    places = np.array([across @ (trajectory[frame][:3, 3] - centre_m) for frame in sorted(trajectory)])
    axis.plot(*places.T, color="0.75", linewidth=0.8)
    axis.plot(*places.T, ".", color="0.2", markersize=4)
    if step.model is not None and len(step.model.points_m):
        axis.plot(*(across @ (step.model.points_m[::5] - centre_m).T), ",", color="0.5")
    for frame, covariance in step.solution.covariances.items():
        axes = across @ trajectory[frame][:3, :3]
        variances, directions = np.linalg.eigh(axes @ covariance[3:, 3:] @ axes.T)
        width, height = 2.0 * MAGNIFIED * np.sqrt(np.maximum(variances, 0.0))
        tilt_deg = float(np.degrees(np.arctan2(directions[1, 0], directions[0, 0])))
        place = across @ (trajectory[frame][:3, 3] - centre_m)
        axis.add_patch(Ellipse(place, width, height, angle=tilt_deg, color="tab:blue", alpha=0.25, linewidth=0))
    axis.text(-0.96, 0.9, f"{len(trajectory)} poses, 1 sd, magnified {MAGNIFIED:.0f} times", fontsize=7)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def animated(pictures: Sequence[Picture]) -> bytes:
    """Return pictures as a WebP that is shown again and again, half a second each and the last for two."""
    content = io.BytesIO()
    first, *others = (Image.fromarray(picture) for picture in pictures)
    lasting_ms = [500] * (len(pictures) - 2) + [1500, 2500]
    first.save(content, "WEBP", save_all=True, append_images=others, duration=lasting_ms, loop=0, quality=80, method=6)
    return content.getvalue()


def main() -> None:
    """Draw the picture."""
    parser = argparse.ArgumentParser(prog="python -m studies growing", description=__doc__)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--out", type=Path, default=Path("docs/growing.webp"))
    options = parser.parse_args()
    frames = open_sequence(options.sequence)
    modeler = Modeler(prior=TablePrior())
    scene = modeler.segmenter.scene(list(frames))
    steps = [event for event in modeler.run(frames, scene) if isinstance(event, Step)]
    options.out.write_bytes(animated(draw(steps)))


if __name__ == "__main__":
    main()
