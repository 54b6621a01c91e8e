"""The animation of an object that is found with its model: drawn into each frame, with the region of its place.

`python -m studies followed RUN SEQUENCE --out docs/tracked.webp` finds the model of a run in each frame for itself. The
region is where the object's middle is, at three standard deviations, magnified.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from scipy import ndimage

from modeler import se3
from modeler.runs.known_objects import known_object
from modeler.sequences import open_sequence
from modeler.tracking import Tracked, Tracker
from modeler.types import Array, Frame
from studies.growing import Picture, animated

SIDE_PX = 300
MAGNIFIED = 20.0  # regions of places, which are tenths of a millimetre beside an object of 20 cm
_SHARE = 0.5  # of the model's shading over the frame
_OUTLINE, _REGION = (255, 140, 0), (30, 110, 255)


def drawn(frame: Frame, found: Tracked, tracker: Tracker) -> Picture:
    """Return a square of a frame around the object, with the model in its pose and the region of its place."""
    assert frame.colour is not None
    if found.pose is None:
        return np.asarray(Image.fromarray(frame.colour).resize((SIDE_PX, SIDE_PX)))
    camera, renderer, pose = frame.camera, tracker.renderer, found.pose.mean
    centre_m = se3.transform(pose, renderer.centre_m[None])[0]
    x, y, z = centre_m
    focal = np.array([camera.fx, camera.fy])
    middle = focal * centre_m[:2] / z + (camera.cx, camera.cy)
    shown = renderer.view(pose, camera, tracker.sensor, most_px=np.inf)
    picture = frame.colour.copy()
    rays = shown.frame.camera
    columns = np.round(shown.pixels[:, 1] - rays.cx + camera.cx).astype(int)
    rows = np.round(shown.pixels[:, 0] - rays.cy + camera.cy).astype(int)
    inside = (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
    lit = 255.0 * np.abs(shown.normals[inside, 2:])
    place = rows[inside], columns[inside]
    picture[place] = ((1.0 - _SHARE) * picture[place] + _SHARE * lit * (0.6, 0.85, 1.0)).astype(np.uint8)
    outline = renderer.silhouette(pose, camera)[0]
    picture[np.asarray(ndimage.binary_dilation(outline), dtype=np.bool_) & ~outline] = _OUTLINE
    about = se3.covariance_about(found.pose.covariance, renderer.centre_m)
    moved = np.array([[focal[0] / z, 0.0, -focal[0] * x / z**2], [0.0, focal[1] / z, -focal[1] * y / z**2]])
    region = _ellipse(moved @ pose[:3, :3] @ about[3:, 3:] @ pose[:3, :3].T @ moved.T)
    half_px = 1.25 * renderer.radius_m * float(focal[0]) / z
    corner = middle - half_px
    image = Image.fromarray(picture).crop(
        (*np.round(corner).astype(int), *np.round(corner + 2.0 * half_px).astype(int))
    )
    image = image.resize((SIDE_PX, SIDE_PX))
    scale = SIDE_PX / (2.0 * half_px)
    pen = ImageDraw.Draw(image)
    pen.line([tuple(one) for one in (0.5 * SIDE_PX + scale * region)], fill=_REGION, width=2)
    sigma_deg = float(np.degrees(np.sqrt(np.trace(about[:3, :3]) / 3.0)))
    sigma_mm = 1e3 * float(np.sqrt(np.trace(about[3:, 3:]) / 3.0))
    pen.text((8, 8), f"{found.outcome}: sd {sigma_deg:.1f} deg, {sigma_mm:.1f} mm", fill=(255, 255, 255))
    pen.text((8, SIDE_PX - 18), f"3 sd of its place, magnified {MAGNIFIED:.0f} times", fill=(255, 255, 255))
    return np.asarray(image)


def _ellipse(covariance_px2: Array) -> Array:
    """Return the outline (n, 2) in px of three standard deviations, magnified."""
    variances, axes = np.linalg.eigh(covariance_px2)
    angles = np.linspace(0.0, 2.0 * np.pi, 61)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    return 3.0 * MAGNIFIED * (axes @ (np.sqrt(np.maximum(variances, 0.0))[:, None] * circle)).T


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw the picture."""
    parser = argparse.ArgumentParser(prog="python -m studies followed", description=__doc__)
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("sequence", type=Path, metavar="SEQUENCE")
    parser.add_argument("--out", type=Path, default=Path("docs/tracked.webp"))
    options = parser.parse_args(arguments)
    tracker = Tracker(known_object(options.run).model, independent=True)
    pictures = [drawn(frame, tracker.update(frame), tracker) for frame in open_sequence(options.sequence)]
    options.out.write_bytes(animated(pictures))
    print(f"{len(pictures)} frames: {options.out}, {options.out.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
