"""Noise across the ray, from the borders of near things before far ones, in a scene that stands still."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.signal import savgol_coeffs

from modeler.types import Array

REACH = 4
"""Pixels on either side of a border that must belong to the near and to the far thing."""
MIN_JUMP = 0.03
"""Least step of depth at a border, as a share of the depth."""
LARGEST_STEP_PX = 1.5
"""A border goes on in the next row within so many pixels."""
WIDEST_SHADOW_PX = 60
"""A near thing that is followed by nothing for longer is not known to have a border there."""
STEEPEST = 1.5
"""Columns a row; steeper borders are measured along the other axis alone, those about the diagonal along both."""
WINDOW = 9
"""Rows over which a border is compared with a smooth curve."""


@final
@dataclass(frozen=True)
class Border:
    """A border across a number of rows (or columns)."""

    variance_px2: float
    """Variance of its position at right angles to itself: over time, and about a smooth curve."""
    depth_m: float
    """Depth of the near thing."""
    length: int
    """Number of rows."""


def borders(depth_m: Array, middle_m: Array) -> list[Border]:
    """Find the borders in frames of a still scene and measure how unsteady they are.

    In each row the position of a border is the number of pixels around it that belong to the near thing: pixel by pixel
    a frame either sees the near thing or does not. Its variance over time tells of what changes from frame to frame,
    its distance from a curve through its neighbours of what stays.

    Args:
        depth_m: (n, h, w), NaN where nothing was measured.
        middle_m: (h, w), their median.
    """
    found = []
    for swap in (False, True):
        frames, middle = (np.swapaxes(depth_m, 1, 2), middle_m.T) if swap else (depth_m, middle_m)
        for flip in (False, True):
            ordered = (frames[:, :, ::-1], middle[:, ::-1]) if flip else (frames, middle)
            for chain in _chains(_positions(*ordered), middle.shape[0]):
                found += _measured(chain, frames.shape[0])
    return found


def pooled_px(found: list[Border]) -> float | None:
    """Return the standard deviation in px that half of the borders, by length, do not exceed; None without any."""
    if not found:
        return None
    order = sorted(found, key=lambda border: border.variance_px2)
    lengths = np.cumsum([border.length for border in order])
    return float(np.sqrt(order[int(np.searchsorted(lengths, 0.5 * lengths[-1]))].variance_px2))


def _positions(depth_m: Array, middle_m: Array) -> Array:
    """Return rows, mean positions, variances over time in px² and depths (k, 4) where near ends, left to right."""
    near = middle_m[:, REACH - 1 : -REACH]
    jump = MIN_JUMP * near
    width = near.shape[1]
    good = np.isfinite(near)
    with np.errstate(invalid="ignore"):
        for step in range(1, REACH):
            good &= np.abs(middle_m[:, REACH - 1 - step :][:, :width] - near) < 0.5 * jump
        for step in range(1, REACH + 1):
            beyond = middle_m[:, REACH - 1 + step :][:, :width]
            good &= np.isnan(beyond) | (beyond > near + jump)
        # A camera with a projector sees nothing in the shadow of the near thing; what follows must be farther.
        good &= _following(middle_m)[:, REACH:][:, :width] > near + jump
    rows, starts = np.nonzero(good)
    columns = starts + REACH - 1
    window = columns[:, None] + np.arange(1 - REACH, REACH + 1)
    with np.errstate(invalid="ignore"):
        limit = (near[rows, starts] + 0.5 * jump[rows, starts])[:, None]
        counts = (depth_m[:, rows[:, None], window] < limit).sum(axis=2)
    where = columns + 1.0 + counts.mean(axis=0) - REACH
    return np.stack([rows.astype(np.float64), where, counts.var(axis=0, ddof=1), near[rows, starts]], axis=1)


def _following(middle_m: Array) -> Array:
    """Return at each pixel (h, w) the next measurement to the right, itself included; NaN where none follows soon."""
    places = np.where(np.isfinite(middle_m), np.arange(middle_m.shape[1]), middle_m.shape[1] - 1)
    following = np.minimum.accumulate(places[:, ::-1], axis=1)[:, ::-1]
    found = np.take_along_axis(middle_m, following, axis=1)
    return np.where(following - np.arange(middle_m.shape[1]) <= WIDEST_SHADOW_PX, found, np.nan)


def _chains(positions: Array, rows: int) -> list[Array]:
    """Return positions (m, 4) that continue each other from row to row."""
    by_row = [positions[positions[:, 0] == row] for row in range(rows)]
    open_chains: list[list[Array]] = []
    closed: list[list[Array]] = []
    for row in by_row:
        free, going = list(row), []
        for chain in open_chains:
            last = chain[-1]
            near = [i for i, one in enumerate(free) if abs(one[1] - last[1]) <= LARGEST_STEP_PX]
            near = [i for i in near if abs(free[i][3] - last[3]) <= MIN_JUMP * last[3]]
            if near:
                chain.append(free.pop(min(near, key=lambda i: abs(free[i][1] - last[1]))))
                going.append(chain)
            else:
                closed.append(chain)
        open_chains = going + [[one] for one in free]
    return [np.stack(chain) for chain in closed + open_chains if len(chain) >= WINDOW + 3]


def _measured(chain: Array, frames: int) -> list[Border]:
    """Return what a chain says, unless it runs too nearly along the rows."""
    smooth, slope = savgol_coeffs(WINDOW, 2), savgol_coeffs(WINDOW, 2, deriv=1)
    where = chain[:, 1]
    half = WINDOW // 2
    residual = where[half:-half] - np.convolve(where, smooth, mode="valid")
    gradient = np.convolve(where, slope, mode="valid")
    straight = np.abs(gradient) <= STEEPEST
    if np.count_nonzero(straight) < 3:
        return []
    squeeze = 1.0 / (1.0 + gradient[straight] ** 2)
    over_time = chain[half:-half, 2][straight]
    about_curve = residual[straight] ** 2 / (1.0 - smooth[half]) - over_time / frames
    variance = float(np.mean(squeeze * over_time) + max(np.mean(squeeze * about_curve), 0.0))
    return [Border(variance, float(np.median(chain[:, 3])), int(np.count_nonzero(straight)))]
