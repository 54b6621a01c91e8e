"""What a person who takes views can see wrong in the newest one, and where the object will be in the next."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial.transform import Rotation

from modeler.types import Array, BoolArray, Camera, Frame, RayImage
from modeler.verdict.evidence import TOLERANCE

_MIDDLE: Final = 0.25  # of the image on each side is not its middle
_HOLES: Final = 1e-3  # of all pixels: ten recordings of whole scenes lack 0.01 to 0.3 of them
_STEP: Final = 0.1  # of the distance: less is one surface, seen at a slant
_GHOST_POINTS: Final = 3000  # of each view: of an object of 300 x 300 px, one in 30 pixels
_GHOST_PX: Final = 3  # closes gaps of 6 px between them, and clears specks as wide
_OUTER: Final = (2, 98)  # percentiles between which the object lies; pixels at its edges may lie anywhere
_TURN: Final = re.compile(r"turn by (\d+)°")


def nothing_near(depth_m: npt.NDArray[np.float32]) -> bool:
    """Return whether most of the middle of a depth image (h, w) is not measured, as where something is too close."""
    rows, columns = (slice(round(_MIDDLE * side), round((1.0 - _MIDDLE) * side)) for side in depth_m.shape)
    return bool(np.mean(depth_m[rows, columns] > 0.0) < 0.5)


def is_filled(depth_m: npt.NDArray[np.float32]) -> bool:
    """Return whether a depth image (h, w) seems to have had its holes filled by the camera's program.

    Beside an edge, one of a camera's two lenses sees a background that the other does not: unless somebody fills them,
    some pixels there have no depth. Time-of-flight cameras lose those pixels too, as they mix two surfaces.
    """
    known = depth_m > 0.0
    if np.mean(~known) > _HOLES:
        return False
    left, right = depth_m[:, :-1], depth_m[:, 1:]
    with np.errstate(invalid="ignore"):
        steps = np.abs(right - left) > _STEP * np.minimum(left, right)
    return bool(np.count_nonzero(steps) > depth_m.shape[0] // 10)


def too_far(view: RayImage) -> str:
    """Return that the camera's noise is large for the object, in words; "" if it is not.

    It is large if its standard deviation exceeds the usual tolerance on a model of this size: every third pixel would.
    """
    tolerance_m, distance_m = TOLERANCE * view.size_m, float(view.centroid_m[2])
    if view.sigma_r_m <= tolerance_m:
        return ""
    return (
        f"too far for its size: at {distance_m:.2f} m the camera's noise is {1000.0 * view.sigma_r_m:.1f} mm; go "
        f"nearer, to {distance_m * tolerance_m / view.sigma_r_m:.2f} m if the camera can measure there"
    )


def suggested_turn_deg(words: str) -> float | None:
    """Return the turn that a build suggests in words, right-handed about up; None if it suggests none."""
    found = _TURN.search(words)
    return None if found is None else float(found[1]) * (-1.0 if "(clockwise" in words else 1.0)


def ghost(frames: Mapping[int, tuple[Frame, BoolArray]], report: Mapping[str, Any], turn_deg: float) -> BoolArray:
    """Return where the object will be seen (h, w) once it has been turned from its newest pose.

    Args:
        frames: some frames of a run with the object's masks (h, w), by frame number.
        report: of the run so far.
        turn_deg: about the support's normal, right-handed about up; the object stays at its place.
    """
    poses = {pose["id"]: np.reshape(pose["object_from_camera"], (4, 4)) for pose in report["poses"]}
    placed = sorted(set(frames) & set(poses))
    points_m = np.concatenate([_in_object(*frames[number], poses[number]) for number in placed] or [np.empty((0, 3))])
    camera = next(iter(frames.values()))[0].camera
    if not len(points_m):
        return np.zeros((camera.height, camera.width), dtype=bool)
    up = np.asarray(report.get("up") or (0.0, -1.0, 0.0), dtype=np.float64)
    middle_m = np.percentile(points_m, _OUTER, axis=0).mean(axis=0)  # the mean would lean to what was seen most
    turn = Rotation.from_rotvec(np.radians(turn_deg) * up)
    turned_m = turn.apply(points_m - middle_m) + middle_m
    newest = poses[placed[-1]]
    return _covered((turned_m - newest[:3, 3]) @ newest[:3, :3], camera)


def _in_object(frame: Frame, mask: BoolArray, object_from_camera: Array) -> Array:
    """Return some points (n, 3) of the object in its own coordinates."""
    rows, columns = np.nonzero(mask & (frame.depth_m > 0.0))
    some = slice(None, None, max(len(rows) // _GHOST_POINTS, 1))
    w, h = frame.camera.rays()
    places = rows[some], columns[some]
    depth_m = frame.depth_m[places].astype(np.float64)
    points_m = np.stack([w[places], h[places], np.ones(len(depth_m))], axis=1) * depth_m[:, None]
    return points_m @ object_from_camera[:3, :3].T + object_from_camera[:3, 3]


def _covered(points_m: Array, camera: Camera) -> BoolArray:
    """Return the pixels (h, w) that points (n, 3) of a surface cover, gaps between them closed."""
    found = np.zeros((camera.height, camera.width), dtype=bool)
    x, y, z = points_m[points_m[:, 2] > 0.0].T
    columns, rows = np.rint(camera.fx * x / z + camera.cx), np.rint(camera.fy * y / z + camera.cy)
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    found[rows[inside].astype(np.int64), columns[inside].astype(np.int64)] = True
    closed = ndimage.binary_closing(np.pad(found, _GHOST_PX), iterations=_GHOST_PX)
    without_specks = ndimage.binary_opening(closed, iterations=_GHOST_PX)
    return np.asarray(without_specks[_GHOST_PX:-_GHOST_PX, _GHOST_PX:-_GHOST_PX], dtype=bool)
