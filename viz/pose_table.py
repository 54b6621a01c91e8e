"""How sure every pose is, in words: a row for each frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from modeler import se3
from modeler.types import Edge, PoseGaussian, Step
from modeler.viz.readings import Sd, sd_of


def pose_table(step: Step, chain: Mapping[int, PoseGaussian], frames: Sequence[int]) -> str:
    """Return in Markdown how sure each pose relative to the first is, before and after closure, the newest first.

    Args:
        step: with the poses after closure, and the views.
        chain: object_from_camera before closure, by frame number.
        frames: those with a pose that have a row; frames that were lost have one too.
    """
    if not step.solution.trajectory:
        return "No frame has a pose yet."
    first = next(iter(step.solution.trajectory))
    placed_by = {edge.source: edge for edge in step.edges_so_far if edge.kind == "odometry" and edge.accepted}
    lost = {edge.source: edge for edge in step.edges_so_far if edge.source not in step.solution.trajectory}
    rows = [
        f"| {frame} | lost: {lost[frame].posterior.outcome.label} | | |"
        if frame in lost
        else f"| {frame} | {' | '.join(_row(step, frame, placed_by.get(frame), chain))} |"
        for frame in sorted({*frames, *lost}, reverse=True)
    ]
    return "\n".join(
        [
            f"Standard deviation of each pose relative to frame {first}, before **→ after** loop closure.",
            "",
            "| frame | turned | rotation | translation |",
            "|--:|--:|--:|--:|",
            *rows,
        ]
    )


def _row(step: Step, frame: int, placed_by: Edge | None, chain: Mapping[int, PoseGaussian]) -> tuple[str, str, str]:
    """Return the rotation of a frame relative to the one it was registered to, and its standard deviations."""
    if placed_by is None:
        return ("first" if chain and frame == next(iter(chain)) else ""), "", ""
    turned_rad = se3.rotation_angle(placed_by.posterior.pose.mean)
    before, after = _sd(step, frame, chain.get(frame)), _sd(step, frame, _solved(step, frame))
    return (
        f"{math.degrees(float(turned_rad)):.1f}°",
        _change(before.rotation_deg, after.rotation_deg, "°"),
        _change(before.translation_mm, after.translation_mm, " mm"),
    )


def _solved(step: Step, frame: int) -> PoseGaussian | None:
    """Return the pose of a frame after closure; None if its covariance is not known."""
    covariance = step.solution.covariances.get(frame)
    return None if covariance is None else PoseGaussian(step.solution.trajectory[frame], covariance)


def _sd(step: Step, frame: int, pose: PoseGaussian | None) -> Sd:
    """Return how sure a pose is, about the object's centre; NaN where that is not known."""
    if pose is None or frame not in step.views:
        return Sd(math.nan, math.nan)
    return sd_of(pose, step.views[frame].centroid_m)


def _change(before: float, after: float, unit: str) -> str:
    """Return two standard deviations, of which either may be unknown."""
    said = [f"{value:.2g}" if math.isfinite(value) else "?" for value in (before, after)]
    return f"{said[0]} **→ {said[1]}**{unit}"
