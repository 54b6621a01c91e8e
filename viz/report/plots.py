"""The figures of the page: cameras, uncertainty, errors and coverage as SVG, merged clouds as PNG."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from modeler import evaluation, se3
from modeler.export.placing import ring_axes
from modeler.types import Array, PoseGaussian
from modeler.viz.figures import Curve, Panel, coverage_curves, png
from modeler.viz.readings import Sd, sd_of
from modeler.viz.report.run_data import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AFTER: Final = "#3b6fb6"
BEFORE: Final = "#8a6bb8"
ODOMETRY: Final = "#7a828c"
CLOSURE: Final = "#2f9e58"
_DRAWS: Final = 4000  # of a norm: its 95 % quantile is then known to 1 %
_CIRCLE: Final = np.stack([np.cos(np.linspace(0, 2 * np.pi, 49)), np.sin(np.linspace(0, 2 * np.pi, 49))])


def trajectory(result: Result, shape_m: Array) -> bytes:
    """Draw the cameras around points (n, 3) of the object from above and from the side, with 3 sd ellipses."""
    figure = new_figure(9.0, 4.6)
    centres = np.array([pose.mean[:3, 3] for pose in result.poses.values()])
    middle = centres.mean(axis=0)
    across, up = ring_axes(centres)
    plans = (("from above", np.stack([across, np.cross(up, across)])), ("from the side", np.stack([across, up])))
    for axis, (title, axes) in zip(figure.subplots(1, 2), plans, strict=True):
        flat = (shape_m - middle) @ axes.T
        axis.scatter(flat[:, 0], flat[:, 1], s=0.4, color="#c9ced4", linewidths=0, rasterized=True)
        _cameras(axis, result, axes, middle)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_title(title, fontsize=10, loc="left")
        axis.set_xlabel("m")
        _plain(axis)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=8, frameon=False, loc="outside upper center", ncols=4)
    return _svg(figure)


def _cameras(axis: Axes, result: Result, axes: Array, middle: Array) -> None:
    sets: tuple[tuple[str, dict[int, PoseGaussian], str, str], ...] = (
        ("chain, before closure", result.chain, BEFORE, "--"),
        ("after optimisation, 3 sd", result.poses, AFTER, "-"),
    )
    for label, poses, colour, dashes in sets:
        places = (np.array([pose.mean[:3, 3] for pose in poses.values()]) - middle) @ axes.T
        axis.plot(*places.T, dashes, color=colour, linewidth=1.1, marker=".", markersize=4, label=label)
        for place, pose in zip(places, poses.values(), strict=True):
            if np.isfinite(pose.covariance).all():
                jacobian = axes @ pose.mean[:3, :3]
                outline = 3.0 * _root(jacobian @ pose.covariance[3:, 3:] @ jacobian.T) @ _CIRCLE
                axis.plot(*(place[:, None] + outline), color=colour, linewidth=0.6, alpha=0.8)
    true = {frame: pose for frame in result.poses if (pose := result.true_pose(frame)) is not None}
    if true:
        places = (np.array([pose[:3, 3] for pose in true.values()]) - middle) @ axes.T
        axis.plot(*places.T, "x", color="#4f9d69", markersize=5, label="truth")
    axis.plot(*((result.poses[result.first].mean[:3, 3] - middle) @ axes.T), "o", color="#222222", markersize=4)


def uncertainty(result: Result, centre_m: Array) -> bytes:
    """Draw the sd of every edge, and of every pose before closure and after, with errors where the truth is known."""
    figure = new_figure(9.0, 4.0)
    of_rotation, of_translation = figure.subplots(1, 2)
    for label, poses, colour in (("before closure", result.chain, BEFORE), ("after optimisation", result.poses, AFTER)):
        spread, frames = sds(poses, centre_m), list(poses)
        for axis, values in (
            (of_rotation, [sd.rotation_deg for sd in spread]),
            (of_translation, [sd.translation_mm for sd in spread]),
        ):
            axis.plot(frames, values, ".-", color=colour, linewidth=1.4, label=f"sd of the pose, {label}")
    for kind, colour, marker in (
        ("odometry", ODOMETRY, "o"),
        ("span", ODOMETRY, "^"),
        ("closure", CLOSURE, "D"),
        ("join", CLOSURE, "s"),
    ):
        edges = [e for e in result.edges if e.kind == kind and e.accepted and e.source in result.poses]
        if edges:
            own = [sd_of(e.posterior.pose, _seen_m(result, e.source, centre_m)) for e in edges]
            style = {"color": colour, "marker": marker, "s": 14, "facecolors": "none", "linewidths": 1.0}
            sources = [edge.source for edge in edges]
            of_rotation.scatter(sources, [sd.rotation_deg for sd in own], label=f"sd of the edge, {kind}", **style)
            of_translation.scatter(sources, [sd.translation_mm for sd in own], **style)
    return _by_frame(figure, of_rotation, of_translation)


def errors(result: Result, centre_m: Array) -> bytes:
    """Draw the error of every pose, before and after closure, with the limit that it keeps with 95 % probability."""
    figure = new_figure(9.0, 3.8)
    of_rotation, of_translation = figure.subplots(1, 2)
    for label, poses, colour in (("before closure", result.chain, BEFORE), ("after optimisation", result.poses, AFTER)):
        known = {k: pose for k, pose in poses.items() if result.true_pose(k) is not None}
        off = evaluation.trajectory_errors({k: pose.mean for k, pose in known.items()}, result.truth, centre_m)
        expected = np.array([_expected(pose, centre_m) for pose in known.values()])
        for axis, values, limits in (
            (of_rotation, list(off.rotation_deg.values()), np.degrees(expected[:, 0])),
            (of_translation, [1000.0 * v for v in off.translation_m.values()], 1000.0 * expected[:, 1]),
        ):
            axis.plot(sorted(known), values, ".-", color=colour, linewidth=1.4, label=f"error, {label}")
            words = f"95 % limit, {label}"
            axis.fill_between(list(known), limits, color=colour, alpha=0.14, linewidth=0, label=words)
    return _by_frame(figure, of_rotation, of_translation)


def coverage(result: Result) -> bytes:
    """Draw the share of truths inside confidence regions against their probability, for edges and for poses, as PNG."""
    panels = []
    for title, estimates in (("edges", edge_estimates(result)), ("poses, relative to the first", _poses(result))):
        parts = (("all six", slice(0, 6), 6), ("rotation", slice(0, 3), 3), ("translation", slice(3, 6), 3))
        curves = [
            Curve(label, [evaluation.nees(pose, truth, part) for pose, truth in estimates], degrees)
            for label, part, degrees in parts
        ]
        panels.append(Panel(f"{title} ({len(estimates)})", curves))
    return coverage_curves([panels])


def edge_estimates(result: Result) -> list[tuple[PoseGaussian, Array]]:
    """Return accepted edges with their true motion."""
    pairs = ((edge.posterior.pose, result.true_motion(edge)) for edge in result.edges if edge.accepted)
    return [(pose, truth) for pose, truth in pairs if truth is not None and np.isfinite(pose.covariance).all()]


def _poses(result: Result) -> list[tuple[PoseGaussian, Array]]:
    """Return the poses but the first, each with the truth."""
    pairs = ((pose, result.true_pose(frame)) for frame, pose in result.poses.items() if frame != result.first)
    return [(pose, truth) for pose, truth in pairs if truth is not None and np.isfinite(pose.covariance).all()]


def _seen_m(result: Result, frame: int, centre_m: Array) -> Array:
    """Return the object's centre (3,) in the camera of a frame."""
    return se3.transform(se3.inverse(result.poses[frame].mean), centre_m[None])[0]


def sds(poses: Mapping[int, PoseGaussian], centre_m: Array) -> list[Sd]:
    """Return how sure poses object_from_camera are, the object's centre (3,) given in the object frame."""
    return [sd_of(pose, se3.transform(se3.inverse(pose.mean), centre_m[None])[0]) for pose in poses.values()]


def _expected(pose: PoseGaussian, centre_m: Array) -> tuple[float, float]:
    """Return the 95 % quantiles of the norms of rotation (rad) and of the centre's translation (m) under a covariance.

    A norm over three axes exceeds the standard deviation along the least certain one more often than not.
    """
    covariance = se3.covariance_about(pose.covariance, se3.transform(se3.inverse(pose.mean), centre_m[None])[0])
    drawn = np.random.default_rng(0).normal(size=(_DRAWS, 3))
    norms = [np.linalg.norm(drawn @ _root(covariance[part, part]).T, axis=1) for part in (slice(3), slice(3, 6))]
    return float(np.quantile(norms[0], 0.95)), float(np.quantile(norms[1], 0.95))


def _root(covariance: Array) -> Array:
    """Return a square root of a covariance, also where it is singular."""
    variances, axes = np.linalg.eigh(covariance)
    return axes * np.sqrt(np.maximum(variances, 0.0))


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure as the page has them."""
    from matplotlib.figure import Figure  # slow to load

    return Figure(figsize=(width_in, height_in), layout="constrained")


def _by_frame(figure: Figure, of_rotation: Any, of_translation: Any) -> bytes:
    """Return a figure of rotations in degrees and translations in mm, frame by frame, as SVG."""
    for axis, words in ((of_rotation, "rotation [deg]"), (of_translation, "translation of the centre [mm]")):
        axis.set_xlabel("frame")
        axis.set_ylabel(words)
        axis.set_ylim(bottom=0.0)
        axis.xaxis.get_major_locator().set_params(integer=True)
        _plain(axis)
    of_rotation.legend(fontsize=8, frameon=False)
    return _svg(figure)


def _plain(axis: Axes) -> None:
    axis.grid(color="#e4e6e9", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=8)
    for label in (axis.xaxis.label, axis.yaxis.label):
        label.set_fontsize(9)


def _svg(figure: Figure) -> bytes:
    """Return a figure as SVG, the same bytes for the same figure."""
    import matplotlib as mpl

    picture = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "modeler", "svg.fonttype": "path"}):
        figure.savefig(picture, format="svg", dpi=150, metadata={"Date": None, "Creator": None})
    return picture.getvalue()


@dataclass(frozen=True, eq=False)
class _Cloud:
    """Points of several frames."""

    points_m: Array
    """(n, 3) across and up in a picture, and away from who looks at it."""
    order: npt.NDArray[np.int64]
    """(n,) which frame each is from, counted from 0."""

    def slice_at(self, level_m: float) -> _Cloud:
        """Return the 3 % of the points that lie nearest to a level, as seen from above."""
        off_m = np.abs(self.points_m[:, 1] - level_m)
        kept = off_m <= np.quantile(off_m, 0.03)
        across, up, away = self.points_m[kept].T
        return _Cloud(np.stack([across, away, -up], axis=1), self.order[kept])


def merged_clouds(result: Result, surfaces_m: Mapping[int, Array]) -> bytes:
    """Draw merged clouds before and after closure, from the side and in a slice from above, coloured by frame, as PNG.

    Args:
        result: the run.
        surfaces_m: (n, 3) points by frame number, each in its own camera's frame.
    """
    axes = _broadside(result, surfaces_m)
    before, after = (_merged(poses, surfaces_m, axes) for poses in (result.chain, result.poses))
    box_m = _box_m((before, after))
    level_m = float(box_m[:, 1].mean())
    slices = [cloud.slice_at(level_m) for cloud in (before, after)]
    slice_box_m = _box_m(slices)
    shares = [float(np.ptp(box[:, 1]) / np.ptp(box[:, 0])) for box in (box_m, slice_box_m)]
    figure = new_figure(9.0, min(4.4 * sum(shares) + 0.6, 7.0))  # so that a page shows it whole
    (top, bottom) = figure.subplots(2, 2, height_ratios=shares)
    for axis, cloud, title in zip(top, (before, after), ("before closure", "after closure"), strict=True):
        _draw_cloud(axis, cloud, box_m, size=0.5)
        axis.axhline(level_m, color="#c8453f", linewidth=0.6)
        axis.set_title(title, fontsize=10, loc="left")
    for axis, cloud in zip(bottom, slices, strict=True):
        _draw_cloud(axis, cloud, slice_box_m, size=3.0)
        axis.set_title("slice at the red line, from above", fontsize=10, loc="left")
    return png(figure, dpi=120)


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


def _box_m(clouds: Sequence[_Cloud]) -> Array:
    """Return the lowest and the highest coordinates (2, 2) in a picture, with a margin, without 0.2 % of strays."""
    places_m = np.concatenate([cloud.points_m[:, :2] for cloud in clouds])
    low, high = np.quantile(places_m, (0.002, 0.998), axis=0)
    margin_m = 0.04 * float((high - low).max()) + 1e-6
    return np.array([low - margin_m, high + margin_m])


def _draw_cloud(axis: Axes, cloud: _Cloud, box_m: Array, *, size: float) -> None:
    """Draw points, nearer ones over farther ones."""
    order = np.argsort(-cloud.points_m[:, 2], kind="stable")
    axis.scatter(*cloud.points_m[order, :2].T, c=cloud.order[order], cmap="viridis", s=size, linewidths=0)
    axis.set_xlim(*box_m[:, 0])
    axis.set_ylim(*box_m[:, 1])
    axis.set_aspect("equal")
    axis.set_axis_off()
