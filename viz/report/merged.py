"""The points of all frames laid together before loop closure and after it, as in the paper's last figure."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.export.standing import ring_axes
from modeler.types import Array, PoseGaussian
from viz.report.plots import new_figure
from viz.report.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SLICE: Final = 0.03  # of all points, those that lie nearest to the level
_MARGIN: Final = 0.04  # room around the points, as a share of their extent
_SIDE: Final = np.array([0, 1])  # across and up: the plane of a picture from the side
_ABOVE: Final = np.array([0, 2])  # across and away: the plane of one from above
_NEARNESS: Final = np.array([0.0, 1.0, -1.0])  # to the eye of both pictures, along what their planes leave out
_STRAY: Final = 0.002  # the share of points at either end that may lie outside the picture
_TALLEST_IN: Final = 7.0  # the picture, so that a page shows it whole
_LEVEL_COLOUR: Final = "#c8453f"


@dataclass(frozen=True, eq=False)
class _Cloud:
    """Points of several frames."""

    points_m: Array
    """(n, 3) across, up, and away from who looks from the side."""
    order: npt.NDArray[np.int64]
    """(n,) which frame each is from, counted from 0."""

    def near(self, level_m: float) -> _Cloud:
        """Return the points that lie nearest to a level."""
        away_m = np.abs(self.points_m[:, 1] - level_m)
        kept = away_m <= np.quantile(away_m, _SLICE)
        return _Cloud(self.points_m[kept], self.order[kept])


def merged_clouds(result: Result, surfaces_m: Mapping[int, Array]) -> bytes:
    """Draw merged clouds before and after closure, from the side and in a slice from above, coloured by frame, as PNG.

    Args:
        result: the run.
        surfaces_m: (n, 3) points by frame number, each in its own camera's frame.
    """
    axes = _broadside(result, surfaces_m)
    before, after = (_merged(poses, surfaces_m, axes) for poses in (result.chain, result.poses))
    box_m = _box_m((before, after), _SIDE)
    level_m = float(box_m[:, 1].mean())
    slices = [cloud.near(level_m) for cloud in (before, after)]
    slice_box_m = _box_m(slices, _ABOVE)
    shares = [float(np.ptp(box[:, 1]) / np.ptp(box[:, 0])) for box in (box_m, slice_box_m)]
    figure = new_figure(9.0, min(4.4 * sum(shares) + 0.6, _TALLEST_IN))
    (top, bottom) = figure.subplots(2, 2, height_ratios=shares)
    for axis, cloud, title in zip(top, (before, after), ("before closure", "after closure"), strict=True):
        _draw(axis, cloud, _SIDE, box_m, size=0.5)
        axis.axhline(level_m, color=_LEVEL_COLOUR, linewidth=0.6)
        axis.set_title(title, fontsize=10, loc="left")
    for axis, cloud in zip(bottom, slices, strict=True):
        _draw(axis, cloud, _ABOVE, slice_box_m, size=3.0)
        axis.set_title("slice at the red line, from above", fontsize=10, loc="left")
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=120, metadata={"Software": None})
    return picture.getvalue()


def _broadside(result: Result, surfaces_m: Mapping[int, Array]) -> Array:
    """Return the axes (3, 3), rows, of a picture from the side where the object is longest: across, up, away."""
    across, up = ring_axes(np.array([pose.mean[:3, 3] for pose in result.poses.values()]))
    level = np.stack([across, np.cross(up, across)])
    plan_m = _merged(result.poses, surfaces_m, np.stack([*level, up])).points_m[:, :2]
    longest = np.linalg.eigh(np.cov(plan_m.T))[1][:, -1]
    across = longest * (np.sign(longest[0]) or 1.0) @ level
    return np.stack([across, up, np.cross(up, across)])


def _merged(poses: Mapping[int, PoseGaussian], surfaces_m: Mapping[int, Array], axes: Array) -> _Cloud:
    """Return the points of all frames along `axes` (3, 3), rows."""
    parts = [
        se3.transform(pose.mean, surfaces_m[frame]) @ axes.T for frame, pose in poses.items() if frame in surfaces_m
    ]
    return _Cloud(np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(part) for part in parts]))


def _box_m(clouds: Sequence[_Cloud], plane: npt.NDArray[np.int64]) -> Array:
    """Return the lowest and the highest coordinates (2, 2) in a plane, with a margin, without a few strays."""
    places_m = np.concatenate([cloud.points_m[:, plane] for cloud in clouds])
    low, high = np.quantile(places_m, (_STRAY, 1.0 - _STRAY), axis=0)
    margin_m = _MARGIN * float((high - low).max()) + 1e-6
    return np.array([low - margin_m, high + margin_m])


def _draw(axis: Axes, cloud: _Cloud, plane: npt.NDArray[np.int64], box_m: Array, *, size: float) -> None:
    """Draw points in a plane of their axes, nearer ones over farther ones."""
    (depth,) = np.setdiff1d(np.arange(3), plane)
    order = np.argsort(_NEARNESS[depth] * cloud.points_m[:, depth], kind="stable")
    axis.scatter(*cloud.points_m[order][:, plane].T, c=cloud.order[order], cmap="viridis", s=size, linewidths=0)
    axis.set_xlim(*box_m[:, 0])
    axis.set_ylim(*box_m[:, 1])
    axis.set_aspect("equal")
    axis.set_axis_off()
