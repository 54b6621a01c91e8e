"""Directions in space: drawn evenly, drawn about an axis, and those across one."""

from __future__ import annotations

import numpy as np

from modeler.types import Array


def directions(count: int, rng: np.random.Generator) -> Array:
    """Draw unit vectors (count, 3) evenly over the sphere."""
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def directions_about(axis: Array, concentration: Array | float, count: int, rng: np.random.Generator) -> Array:
    """Draw unit vectors (count, 3) about one (3,), by von Mises and Fisher.

    Args:
        axis: (3,) unit.
        concentration: κ > 0, one or (count,): the density is in proportion to exp(κ cos).
        count: how many.
        rng: source of all randomness.
    """
    cosine = 1.0 + np.log1p(rng.random(count) * np.expm1(-2.0 * concentration)) / concentration
    bearing = rng.uniform(0.0, 2.0 * np.pi, count)
    across = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    local = np.stack([across * np.cos(bearing), across * np.sin(bearing), cosine], axis=1)
    return local @ np.vstack([across_axis(axis), axis])


def across_axis(axis: Array) -> Array:
    """Return two unit vectors (2, 3) that span the plane across a unit axis (3,), right-handed with it."""
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first = np.asarray(first / np.linalg.norm(first), dtype=np.float64)
    return np.array([first, np.cross(axis, first)], dtype=np.float64)
