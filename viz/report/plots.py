"""The plots of a run as SVG: where the camera was, how sure that is, and how far off where the truth is known."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from modeler import evaluation, se3
from modeler.export.standing import ring_axes
from modeler.types import Array, PoseGaussian
from viz.calibration import Curve, Panel, coverage_curves
from viz.certainty import Sd, sd_of
from viz.report.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AFTER: Final = "#3b6fb6"
BEFORE: Final = "#8a6bb8"
TRUE: Final = "#4f9d69"
ODOMETRY: Final = "#7a828c"
CLOSURE: Final = "#2f9e58"
REJECTED: Final = "#c8453f"
_SHAPE: Final = "#c9ced4"
_CIRCLE: Final = np.stack([np.cos(np.linspace(0, 2 * np.pi, 49)), np.sin(np.linspace(0, 2 * np.pi, 49))])


def trajectory(result: Result, shape_m: Array) -> bytes:
    """Draw the cameras around the object from above and from the side, with 3 sd ellipses of their positions.

    Args:
        result: the run.
        shape_m: (n, 3) points of the object, in the object frame.
    """
    figure = new_figure(9.0, 4.6)
    centres = np.array([pose.mean[:3, 3] for pose in result.poses.values()])
    middle = centres.mean(axis=0)
    across, up = ring_axes(centres)
    plans = (("from above", np.stack([across, np.cross(up, across)])), ("from the side", np.stack([across, up])))
    for axis, (title, axes) in zip(figure.subplots(1, 2), plans, strict=True):
        flat = (shape_m - middle) @ axes.T
        axis.scatter(flat[:, 0], flat[:, 1], s=0.4, color=_SHAPE, linewidths=0, rasterized=True)
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
        axis.plot(*places.T, "x", color=TRUE, markersize=5, label="truth")
    axis.plot(*((result.poses[result.first].mean[:3, 3] - middle) @ axes.T), "o", color="#222222", markersize=4)


def uncertainty(result: Result, centre_m: Array) -> bytes:
    """Draw the sd of every edge, and of every pose before closure and after, with errors where the truth is known.

    Args:
        result: the run.
        centre_m: (3,) the object's centre, in the object frame.
    """
    figure = new_figure(9.0, 4.0)
    of_rotation, of_translation = figure.subplots(1, 2)
    for label, poses, colour in (("before closure", result.chain, BEFORE), ("after optimisation", result.poses, AFTER)):
        spread, frames = _sds(poses, centre_m), list(poses)
        for axis, values in (
            (of_rotation, [sd.rotation_deg for sd in spread]),
            (of_translation, [sd.translation_mm for sd in spread]),
        ):
            axis.plot(frames, values, ".-", color=colour, linewidth=1.4, label=f"sd of the pose, {label}")
    for kind, colour, marker in (("odometry", ODOMETRY, "o"), ("span", ODOMETRY, "^"), ("closure", CLOSURE, "D")):
        edges = [e for e in result.edges if e.kind == kind and e.accepted and e.source in result.poses]
        if edges:
            own = [sd_of(e.posterior.pose, _seen_m(result, e.source, centre_m)) for e in edges]
            style = {"color": colour, "marker": marker, "s": 14, "facecolors": "none", "linewidths": 1.0}
            sources = [edge.source for edge in edges]
            of_rotation.scatter(sources, [sd.rotation_deg for sd in own], label=f"sd of the edge, {kind}", **style)
            of_translation.scatter(sources, [sd.translation_mm for sd in own], **style)
    return _by_frame(figure, of_rotation, of_translation)


def errors(result: Result, centre_m: Array) -> bytes:
    """Draw how far every pose is from the truth, before closure and after, over the sd it states.

    Args:
        result: with the truth of at least its first frame.
        centre_m: (3,) the object's centre, in the object frame.
    """
    figure = new_figure(9.0, 3.8)
    of_rotation, of_translation = figure.subplots(1, 2)
    for label, poses, colour in (("before closure", result.chain, BEFORE), ("after optimisation", result.poses, AFTER)):
        known = {k: pose for k, pose in poses.items() if result.true_pose(k) is not None}
        off = evaluation.trajectory_errors({k: pose.mean for k, pose in known.items()}, result.truth, centre_m)
        stated = _sds(known, centre_m)
        for axis, values, sd in (
            (of_rotation, list(off.rotation_deg.values()), [one.rotation_deg for one in stated]),
            (of_translation, [1000.0 * v for v in off.translation_m.values()], [one.translation_mm for one in stated]),
        ):
            axis.plot(sorted(known), values, ".-", color=colour, linewidth=1.4, label=f"error, {label}")
            axis.fill_between(list(known), sd, color=colour, alpha=0.14, linewidth=0, label=f"stated sd, {label}")
    return _by_frame(figure, of_rotation, of_translation)


def coverage(result: Result) -> bytes:
    """Draw the share of truths inside the stated regions against their probability, for edges and for poses, as PNG."""
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


def _sds(poses: Mapping[int, PoseGaussian], centre_m: Array) -> list[Sd]:
    """Return how sure poses object_from_camera are, the object's centre (3,) given in the object frame."""
    return [sd_of(pose, se3.transform(se3.inverse(pose.mean), centre_m[None])[0]) for pose in poses.values()]


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
