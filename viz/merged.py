"""What all views saw, laid together without loop closure and with it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
import rerun as rr

from modeler import se3
from modeler.types import Array, Step
from viz import entities
from viz.drawings import Drawing

_POINTS: Final = 60_000
_RAMP_RGB: Final = ((70, 100, 255), (40, 190, 190), (255, 225, 60))  # from the first view to the last


def drawing(step: Step) -> Drawing:
    """Yield the merged points along the chain of edges and after optimisation, on the last step alone."""
    if step.last and len(step.solution.trajectory) > 1:
        yield entities.MERGED_BEFORE, _points(step, step.solution.odometry)
        yield entities.MERGED_AFTER, _points(step, step.solution.trajectory)


def _points(step: Step, poses: Mapping[int, Array]) -> rr.Points3D:
    """Return the points of all views that have a pose, a colour a view from blue to yellow."""
    frames = [frame for frame in sorted(poses) if frame in step.views]
    stride = math.ceil(max(sum(len(step.views[frame].points_m) for frame in frames), 1) / _POINTS)
    parts = [se3.transform(poses[frame], step.views[frame].points_m[::stride]) for frame in frames]
    along = np.linspace(0.0, 2.0, max(len(frames), 2))[: len(frames)]
    shades = np.stack([np.interp(along, [0.0, 1.0, 2.0], channel) for channel in zip(*_RAMP_RGB, strict=True)], axis=1)
    colours = np.repeat(np.rint(shades), [len(part) for part in parts], axis=0)
    return rr.Points3D(
        np.concatenate([np.zeros((0, 3)), *parts]), colors=colours.astype(np.uint8), radii=rr.Radius.ui_points(1.25)
    )
