"""The object in views of a moving camera, which show what stands still beside it as well: cut out as most see it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.pipeline.joining import MAX_VIEWS
from modeler.segmentation.depth_images import point_image, without_specks
from modeler.types import Array, BoolArray, RayImage, spread

CELL: Final = 0.02
"""Side of the cubes in which views of a scene are compared, as a share of the distance to which it is seen."""
_CELLS: Final = 2**20  # along each axis, of which a scene fills a hundred
_SURER: Final = 0.25  # by which the other views have to be surer than the view itself: cubes at a rim hold both


def by_most(
    views: Mapping[int, RayImage], found: Mapping[int, BoolArray], trajectory: Mapping[int, Array], cell_m: float
) -> dict[int, BoolArray]:
    """Return the object's masks (h, w) in views of a scene that is still, by frame number: as most other views have it.

    Args:
        views: with masks of the object and of what is beside it.
        found: masks of what each view alone takes for the object.
        trajectory: object_from_camera (4, 4) by frame number.
        cell_m: side of the cubes in which views are compared.
    """

    def looked_at(frame: int) -> tuple[BoolArray, npt.NDArray[np.int64]]:
        """Return which pixels (h, w) a view compares, and the numbers (n,) of the cubes in which they lie."""
        images = views[frame].frame
        seen: BoolArray = np.asarray(images.mask) & (images.depth_m > 0.0)
        points_m = np.asarray(point_image(images.depth_m, images.camera)[seen], dtype=np.float64)
        x, y, z = np.floor(se3.transform(trajectory[frame], points_m) / cell_m).astype(np.int64).T + _CELLS // 2
        return seen, (x * _CELLS + y) * _CELLS + z

    votes = {}
    for frame in spread([*views], MAX_VIEWS):
        seen, cubes = looked_at(frame)
        own, which = np.unique(cubes, return_inverse=True)
        votes[frame] = own, np.bincount(which, found[frame][seen]) / np.bincount(which)
    known, which = np.unique(np.concatenate([cubes for cubes, _ in votes.values()]), return_inverse=True)
    yes, looks, masks = (
        np.bincount(which, np.concatenate([share for _, share in votes.values()])),
        np.bincount(which),
        {},
    )
    for frame in views:
        seen, cubes = looked_at(frame)
        place, own = np.minimum(np.searchsorted(known, cubes), len(known) - 1), found[frame][seen]
        for_it, others = yes[place], np.where(known[place] == cubes, looks[place], 0)
        if frame in votes:  # the others decide
            for_it, others = for_it - votes[frame][1][np.searchsorted(votes[frame][0], cubes)], others - 1
        share = np.divide(for_it, others, out=own.astype(np.float64), where=others > 0)
        mask = np.zeros_like(seen)
        mask[seen] = share > np.where(own, 0.5 - _SURER, 0.5 + _SURER)
        masks[frame] = without_specks(mask)
    return masks


def agreeing(masks: Mapping[int, BoolArray], found: Mapping[int, BoolArray]) -> bool:
    """Return whether at least half of the masks are about what was found in their views alone."""
    pairs = [(mask, found[frame]) for frame, mask in masks.items()]
    alike = [2 * int(np.sum(mask & other)) > int(np.sum(mask | other)) for mask, other in pairs]
    return bool(2 * sum(alike) >= len(alike))
