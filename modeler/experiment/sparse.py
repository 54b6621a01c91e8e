"""Frames and views with few measurements left, for the paper's experiments on very sparse clouds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modeler.types import Frame, RayImage


def sparse_frame(frame: Frame, count: int, rng: np.random.Generator) -> Frame:
    """Return a frame whose mask keeps the depth of at most `count` of its pixels; the others have no measurement.

    Args:
        frame: with its mask.
        count: pixels to keep.
        rng: chooses them.
    """
    assert frame.mask is not None
    measured = np.flatnonzero(frame.mask & np.isfinite(frame.depth_m))
    dropped = rng.permutation(measured)[count:]
    depth_m = frame.depth_m.copy()
    depth_m.flat[dropped] = np.nan
    return replace(frame, depth_m=depth_m)


def sparse_view(view: RayImage, count: int, rng: np.random.Generator) -> RayImage:
    """Return a view with at most `count` of its surface points; its images stay whole.

    Args:
        view: a frame made ready.
        count: points to keep.
        rng: chooses them.
    """
    total = len(view.points_m)
    kept = np.sort(rng.permutation(total)[:count])
    layers = {name: layer[kept] if layer.shape == (total,) else layer for name, layer in view.layers.items()}
    return replace(
        view, points_m=view.points_m[kept], normals=view.normals[kept], pixels=view.pixels[kept], layers=layers
    )
