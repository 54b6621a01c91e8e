"""Whether views that match show the same surface, or surface that is only alike: by its print, and by its shape.

Sides of a box have the same shape. A view of a part of one of them matches any other as well as itself, and loops of
such pairs close. Two things tell sides apart: print, which agrees under right poses only, and shape, if more than one
flat face matches, or all of one to within the tolerance.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.kernels.point_likelihood import MIN_AGREEMENT
from modeler.priors.general import LARGE_DEG
from modeler.significance import RARE, nats_from_mode
from modeler.types import SOME_POINTS, AbstractPrior, Array, Check, InputError, RayImage, components, spread
from modeler.verdict.colour_fit import (
    AT_LEAST,
    FAR_DEG,
    MIN_SHARED,
    NEAR_DEG,
    Comparison,
    Pair,
    has_colour,
    places_in,
)
from modeler.verdict.evidence import MAX_VIEWS, TOLERANCE, pixels_of

_CLEAR_DEG: Final = 30.0  # largest rotation at which print of right poses agrees: twelve captures have more than half
_FAINT: Final = 0.015**2  # variance of a logarithm: a plain body before a strong pattern shows 0.010² of it
_FLAT_DEG: Final = 25.0  # from their mean: normals of a flat face are noisy, the next face of a body is farther
_BESIDE: Final = 0.05  # of matching surface that faces elsewhere: right runs 0.05 and more, false matches 0.00 to 0.04
_UPRIGHT: Final = 0.7  # cosine of 45°: a face nearer to the support than to its normal is no side


@dataclass(frozen=True, eq=False)
class Likeness:
    """What two views have in common under the poses found."""

    first: int
    """Frame number."""
    second: int
    """Frame number."""
    motion: Array
    """(4, 4) from the second camera to the first."""
    normal: Array
    """(3,) mean normal of matching surface, in the second camera's coordinates."""
    shaped: bool
    """Whether matching surface is more than one flat face, or all of one; or too little for an edge to tell."""
    correlation: float = np.nan
    """Of print; NaN if it was not compared."""
    contrast: float = np.nan
    """Variance of print, of the view that has less."""
    across: bool = False
    """Whether they are registered across segments, whatever the angle."""

    @property
    def angle_deg(self) -> float:
        """Rotation between the two."""
        return float(np.degrees(se3.rotation_angle(self.motion)))


def likenesses(
    views: Mapping[int, RayImage],
    trajectory: Mapping[int, Array],
    tolerance_m: float,
    edges: Container[tuple[int, int]] = (),
    across: Container[tuple[int, int]] = (),
    *,
    colour: bool = True,
) -> list[Likeness]:
    """Return what pairs of views have in common that an edge joins, or that are within reach and share surface.

    Args:
        views: by frame number.
        trajectory: object_from_camera (4, 4) by frame number.
        tolerance_m: distance within which surface matches.
        edges: pairs of frame numbers, the lower one first.
        across: those of them that join segments.
        colour: whether print is compared.
    """
    frames = [frame for frame in sorted(trajectory) if frame in views and len(views[frame].points_m)]
    frames = spread(frames, MAX_VIEWS)
    coloured = {frame: views[frame] for frame in frames if colour and has_colour(views[frame])}
    compared = Comparison(coloured, trajectory, ()) if coloured else None
    some = {frame: views[frame].along_curve[:: max(len(views[frame].points_m) // SOME_POINTS, 1)] for frame in frames}
    found = []
    for first, second in combinations(frames, 2):
        motion, joined = se3.inverse(trajectory[first]) @ trajectory[second], (first, second) in edges
        angle_deg = np.degrees(se3.rotation_angle(motion))
        if angle_deg > FAR_DEG and not joined:
            continue
        there = _matching(views[first], views[second], some[second], motion, tolerance_m)
        back = _matching(views[second], views[first], some[first], se3.inverse(motion), tolerance_m)
        known = min(len(there), len(back)) >= MIN_SHARED
        if not (known or joined):
            continue
        matches = ((there, views[second].normals[some[second]]), (back, views[first].normals[some[first]]))
        beside, whole = np.min([_shares(*match) for match in matches], axis=0) if known else (1.0, 1.0)
        shaped = bool(beside >= _BESIDE or whole >= 1.0 - TOLERANCE)
        normal = there.mean(axis=0) if known else np.zeros(3)
        one = Likeness(first, second, motion, normal, shaped, across=(first, second) in across)
        comparable = NEAR_DEG <= angle_deg and (angle_deg <= FAR_DEG or one.across)
        if compared is not None and first in coloured and second in coloured and comparable:
            correlation, contrast = _print(compared, first, second)
            one = replace(one, correlation=correlation, contrast=contrast)
        found.append(one)
    return found


def _matching(view: RayImage, other: RayImage, some: npt.NDArray[np.int64], motion: Array, tolerance_m: float) -> Array:
    """Return the normals (m, 3) of surface points of another view that match a view's surface.

    Args:
        view: in which they are looked up.
        other: whose they are.
        some: (n,) numbers of the points.
        motion: from the other camera to the view's.
        tolerance_m: distance within which surface matches.
    """
    normals, shape = other.normals[some], view.numbers.shape
    moved_m, turned = se3.transform(motion, other.points_m[some]), normals @ motion[:3, :3].T
    ahead = moved_m[:, 2] > 0.0
    moved_m, turned, normals = moved_m[ahead], turned[ahead], normals[ahead]
    pixels = pixels_of(view, moved_m).astype(int)
    inside = np.all((pixels >= 0) & (pixels < shape), axis=1)
    numbers = np.where(inside, view.numbers[tuple((pixels * inside[:, None]).T)], len(view.points_m))
    seen = numbers < len(view.points_m)
    there = numbers[seen]
    near = np.abs(view.points_m[there, 2] - moved_m[seen, 2]) <= tolerance_m
    near &= (view.normals[there] * turned[seen]).sum(axis=1) >= MIN_AGREEMENT
    return np.asarray(normals[seen][near], dtype=np.float64)


def _shares(matching: Array, normals: Array) -> tuple[float, float]:
    """Return which share of matching surface faces elsewhere than most of it, and which of the flat face matches.

    Args:
        matching: (m, 3) normals of matching surface.
        normals: (n, 3) of all surface of the view.
    """
    least, near = np.cos(np.radians(_FLAT_DEG)), np.ones(len(matching), dtype=bool)
    most = matching.mean(axis=0)
    for _ in range(3):
        near = matching @ most >= least * np.linalg.norm(most)
        if not near.any():
            return 1.0, 0.0
        most = matching[near].mean(axis=0)
    face = normals @ most >= least * np.linalg.norm(most)
    return float(1.0 - np.mean(near)), float(np.sum(near) / max(np.sum(face), 1))


def _print(compared: Comparison, first: int, second: int) -> tuple[float, float]:
    """Return the correlation of print on surface of two views, and its variance in the view with less; or NaN."""
    pair = Pair.of(compared.views, compared.trajectory, first, second)
    if len(pair.points_m) < MIN_SHARED:
        return np.nan, np.nan
    values = []
    for frame in (first, second):
        feature = compared.feature(frame, compared.width_px)
        here = places_in(compared.views[frame], se3.transform(se3.inverse(compared.trajectory[frame]), pair.points_m))
        values.append(ndimage.map_coordinates(feature, here[:, ::-1].T, order=1, mode="nearest"))
    contrast = float(min(np.var(value) for value in values))
    return (float(np.corrcoef(values)[0, 1]), contrast) if contrast > 0.0 else (np.nan, np.nan)


def print_check(pairs: Sequence[Likeness]) -> tuple[Likeness, Check] | None:
    """Return the pair whose print contradicts its match, and its correlation as a share of that of others.

    Where print of the same contrast is on surface that matches, it agrees as well as in other pairs of the run, or one
    of the poses is wrong. Light and oblique sight lower a correlation now and then: it counts if no chain of pairs that
    agree joins the two frames; of pairs across segments, the one that agrees best counts. None if print agrees nowhere.
    """
    printed = [pair for pair in pairs if pair.contrast >= _FAINT]  # NaN where it was not compared
    usual = float(np.quantile([pair.correlation for pair in printed], 0.75)) if printed else 0.0
    agreeing = [pair for pair in printed if pair.correlation >= AT_LEAST * usual]
    if usual < AT_LEAST:
        return None
    contrast = float(np.median([pair.contrast for pair in agreeing]))
    group = _groups(pairs, agreeing)
    apart = [
        pair for pair in printed if group[pair.first] != group[pair.second] and pair.contrast >= AT_LEAST * contrast
    ]
    clear = [pair for pair in apart if pair.angle_deg <= _CLEAR_DEG]
    if len(across := [pair for pair in apart if pair.across]) > 1:  # seen at any angle: one that agrees is enough
        clear.append(max(across, key=lambda pair: pair.correlation))
    worst = min(clear or agreeing, key=lambda pair: pair.correlation)
    return worst, Check(min(max(worst.correlation, 0.0) / usual, 1.0), AT_LEAST, at_least=True)


def flat_check(
    pairs: Sequence[Likeness], views: Mapping[int, RayImage], places: Mapping[int, int], prior: AbstractPrior | None
) -> tuple[int, Check] | None:
    """Return a frame that only flat faces hold to the others, and the number of such frames; None without pairs.

    Args:
        pairs: of a run.
        views: by frame number.
        places: by frame number, how many frames were read before.
        prior: of the motions; None: not known.
    """
    if not pairs:
        return None
    group = _groups(pairs, [pair for pair in pairs if pair.shaped or pair.correlation >= AT_LEAST])
    held = [
        pair
        for pair in pairs
        if group[pair.first] == group[pair.second]
        or not _has_rival(pair, views, abs(places[pair.second] - places[pair.first]), prior)
    ]
    group = _groups(pairs, held)
    numbers = list(group.values())
    largest = max(sorted(set(numbers)), key=numbers.count)
    loose = [frame for frame in group if group[frame] != largest]
    return (min(loose) if loose else min(group)), Check(float(len(loose)), 0.0)


def _groups(pairs: Sequence[Likeness], joined: Sequence[Likeness]) -> dict[int, int]:
    """Return the number of its group by frame number; pairs that are `joined` are of one group."""
    frames = np.unique([(pair.first, pair.second) for pair in pairs])
    ends = np.array([(pair.first, pair.second) for pair in joined], dtype=np.int64).reshape(-1, 2)
    return dict(zip(frames.tolist(), components(np.searchsorted(frames, ends), len(frames)).tolist(), strict=True))


def _has_rival(pair: Likeness, views: Mapping[int, RayImage], steps: int, prior: AbstractPrior | None) -> bool:
    """Return whether another face of the object may be where one of two views shows the face that matches.

    It comes there by a quarter turn more or less: about the vertical on a support, where only sides are alike; about
    any axis in the face else. From one frame to the next, nobody turns an object farther than views can be registered,
    and limits and steps that were given exclude others; in several steps it may come anywhere.

    Args:
        pair: whose matching surface is flat.
        views: by frame number.
        steps: frames from one to the other.
        prior: of the motions.
    """
    first, second = views[pair.first], views[pair.second]
    normal = pair.normal / np.linalg.norm(pair.normal)
    axes = [np.cross(normal, along) for along in np.eye(3)]
    axes = [axis / np.linalg.norm(axis) for axis in axes if np.linalg.norm(axis) > 0.5]
    if second.plane is not None:
        if abs(float(normal @ second.plane.normal)) > _UPRIGHT:
            return False
        axes = [second.plane.normal]
    if steps > 1:
        return True
    turns = Rotation.from_rotvec([sign * 0.5 * np.pi * axis for axis in axes for sign in (-1.0, 1.0)]).as_matrix()
    centre_m = second.centroid_m  # of what is seen: limits of offsets are those of its motion
    quarter = np.tile(np.eye(4), (len(turns), 1, 1))
    quarter[:, :3, :3], quarter[:, :3, 3] = turns, centre_m - turns @ centre_m
    rivals = pair.motion @ quarter
    rivals = rivals[np.degrees(se3.rotation_angle(rivals)) <= LARGE_DEG]
    if prior is not None and len(rivals):
        with suppress(InputError):  # the prior does not apply: it was not used either
            density = (prior.unlimited() or prior).between(second, first)
            least = float(density.log_prior(pair.motion[None])[0]) - nats_from_mode(RARE)
            rivals = rivals[density.log_prior(rivals) >= least]
    return len(rivals) > 0
