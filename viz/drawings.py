"""Shared parts of the drawings: archetypes by entity path, and helpers for clouds, captions and ellipsoids."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import rerun as rr
from scipy.spatial.transform import Rotation

from modeler.types import Array, Posterior, Step
from modeler.viz import entities

Drawing = Iterator[tuple[str, rr.AsComponents]]  # entities in the order in which they are logged

CLEAR: Final = rr.Clear(recursive=False)  # clears an entity
POINT_SIZE: Final = rr.Radius.ui_points(1.75)
VIEW_POINTS: Final = 6_000  # of a view, as drawn: a surface is seen, and what is behind it
ABOVE_LEFT: Final = np.array([-0.36, -0.48, -0.8])  # from the object to eye or light; the camera is at -z, up is -y


def shown_posterior(step: Step) -> Posterior | None:
    """Return the first registration of the step's frame to a view that is at hand: the odometry pair."""
    own = (posterior for posterior in step.posteriors if posterior.source == step.frame.index)
    return next((posterior for posterior in own if posterior.target in step.views), None)


def caption(at_m: Array, words: str, rgb: entities.Rgb) -> rr.Points3D:
    """Return a caption at a point (3,)."""
    return rr.Points3D(at_m, labels=words, show_labels=True, radii=rr.Radius.ui_points(0.0), colors=rgb)


def shaded(rgb: entities.Rgb, normals: Array) -> npt.NDArray[np.uint8]:
    """Return RGB (n, 3) of a surface with `normals` (n, 3), lit from above left in the camera frame."""
    light = 0.35 + 0.65 * np.abs(normals @ ABOVE_LEFT)
    return np.clip(light[:, None] * np.array(rgb), 0, 255).astype(np.uint8)


def scale_words(factor: float) -> str:
    """Return the magnification in words."""
    return "to scale" if factor == 1.0 else f"drawn \N{MULTIPLICATION SIGN}{factor:g}"


def rounded_down(number: float) -> float:
    """Return the largest of …, 0.5, 1, 2, 5, 10, … that is not above a positive number."""
    decade = 10.0 ** math.floor(math.log10(number))
    return max(factor * decade for factor in (1, 2, 5) if factor * decade <= number)


def rotated(poses: Array, covariances: Array) -> Array:
    """Return covariances (n, 3, 3) along the axes of poses (n, 4, 4) along those in which the poses are."""
    rotations = poses[:, :3, :3]
    return rotations @ covariances @ np.swapaxes(rotations, 1, 2)


def pyramid(corners: Array) -> Array:
    """Return the edges of a pyramid from the origin to corners (4, 3) as one line (11, 3)."""
    tip = np.zeros(3)
    return np.array([tip, *corners, corners[0], tip, corners[1], corners[2], tip, corners[3]])


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    """Ellipsoids of one standard deviation, magnified."""

    centres_m: Array
    """(n, 3)."""
    half_axes_m: Array
    """(n, 3)."""
    quaternions: Array
    """(n, 4) x, y, z, w."""

    @classmethod
    def of(cls, centres_m: Array, covariances: Array, factor: float = 1.0) -> Ellipsoids:
        """Return those of covariances (n, 3, 3) in m² about points (n, 3), `factor` times as large as they are."""
        variances, axes = np.linalg.eigh(covariances)
        axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation, not a reflection
        half_axes = np.sqrt(np.maximum(variances, 0.0))
        thinnest = np.maximum(0.02 * half_axes.max(axis=1, keepdims=True), 1e-9)  # a disc of no thickness is not drawn
        return cls(centres_m, factor * np.maximum(half_axes, thinnest), Rotation.from_matrix(axes).as_quat())

    def drawn(
        self, sigmas: float, rgb: entities.Rgb | npt.NDArray[np.uint8], style: rr.components.FillMode
    ) -> rr.AsComponents:
        """Return the regions of the given standard deviations in one colour or one each (n, 3); nothing without any."""
        if len(self.centres_m) == 0:
            return CLEAR
        return rr.Ellipsoids3D(
            centers=self.centres_m,
            half_sizes=sigmas * self.half_axes_m,
            quaternions=self.quaternions,
            colors=rgb,
            line_radii=rr.Radius.ui_points(0.75),
            fill_mode=style,
        )
