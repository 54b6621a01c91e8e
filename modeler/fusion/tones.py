"""Colours of different frames made to agree, and how much say each frame has in them."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import laplace, minimum_filter

from modeler.fusion.views import DepthViews
from modeler.kernels import fusion
from modeler.types import Array

DARK, BRIGHT = 12.0, 243.0  # levels beyond which a camera no longer tells brightness
LOOKS = 100_000  # points times views that exposures are compared at
ROUNDS = 8  # of reweighted least squares
STEADY = 0.05  # differences in exposure of this much (log) are believed without evidence to the contrary
AGREED = 0.1  # colours that differ by more than this (log) show a highlight or a wrong place
LARGEST = 2.5  # factor between exposures


def gains(seen: DepthViews, points_m: Array, normals: Array, *, tau_m: float, near_m: float) -> Array:
    """Return (f, 4): factors on red, green and blue that even out exposure, and the say of each view, 0 without colour.

    A point has one colour, each view a gain: both are fitted to the logarithms of what the views show of common points.
    Sharper views have more say.

    Args:
        seen: the views.
        points_m: (n, 3) on the surface, in the object frame.
        normals: (n, 3) unit.
        tau_m: half width of the band around the surface.
        near_m: surface further away along the normal is another one.
    """
    result = np.concatenate([np.ones((len(seen.coloured), 3)), _sharpness(seen)[:, None]], axis=1)
    with_colour = np.flatnonzero(seen.coloured)
    if len(with_colour) < 2 or not len(points_m):
        return result
    chosen = np.arange(0, len(points_m), max(1, len(points_m) * len(with_colour) // LOOKS))
    points_m, normals = np.ascontiguousarray(points_m[chosen]), np.ascontiguousarray(normals[chosen])
    levels = np.zeros((len(with_colour), len(chosen), 3))
    shown = np.zeros((len(with_colour), len(chosen)))
    plain = np.ones((1, 4))
    for row, view in enumerate(with_colour):
        one = seen.alone(int(view))
        _, colours = fusion.survey(points_m, normals, near_m, tau_m, *one.lookup, one.colour, plain, 1.0)
        levels[row], shown[row] = colours[:, :3], colours[:, 3]
    shown[np.any((levels < DARK) | (levels > BRIGHT), axis=2)] = 0.0
    shown[:, np.count_nonzero(shown, axis=0) < 2] = 0.0
    if not shown.any():
        return result
    logs = np.log(np.maximum(levels, 1.0))
    for channel in range(3):
        result[with_colour, channel] = np.exp(_evened(logs[:, :, channel], shown))
    return result


def _evened(logs: Array, shown: Array) -> Array:
    """Return log gains (f,), zero on average, that make logs (f, n) agree where they are shown (f, n), robustly."""
    gain, weights = np.zeros(len(logs)), shown
    for _ in range(ROUNDS):
        totals = np.maximum(weights.sum(axis=0), 1e-12)
        shares = weights / totals
        means = np.sum(shares * logs, axis=0)
        # Σ_p w_fp (x_fp + g_f - Σ_k s_kp (x_kp + g_k))² over f and p, with the points' colours already solved for.
        normal = np.diag(weights.sum(axis=1)) - weights @ shares.T
        ridge = 1e-3 * normal.trace() / len(logs) + (AGREED / STEADY) ** 2
        gain = np.linalg.solve(normal + ridge * np.eye(len(logs)), np.sum(weights * (means - logs), axis=1))
        gain = np.clip(gain - gain.mean(), -np.log(LARGEST), np.log(LARGEST))
        off = logs + gain[:, None] - np.sum(shares * (logs + gain[:, None]), axis=0)
        weights = shown / (1.0 + (off / AGREED) ** 2)
    return gain


def _sharpness(seen: DepthViews) -> Array:
    """Return the say (f,) of the views: how much fine detail their object shows, against the others; 0 = no colour."""
    say = np.zeros(len(seen.coloured))
    for view in np.flatnonzero(seen.coloured):
        light = seen.colour[view].astype(np.float64).mean(axis=2)
        inside = np.asarray(minimum_filter(seen.index[view] >= 0, size=3), dtype=bool)
        if inside.any():
            say[view] = np.median(np.abs(laplace(light)[inside])) / max(float(light[inside].mean()), 1.0)
    known = say > 0.0
    if known.any():
        say[known] = np.clip(say[known] / np.median(say[known]), 0.3, 3.0)
    say[seen.coloured & ~known] = 1.0
    return say
