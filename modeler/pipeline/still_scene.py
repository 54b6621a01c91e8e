"""The object in views of a moving camera, which show what stands still beside it as well: cut out as most see it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from modeler import se3
from modeler.segmentation.depth_images import point_image, without_specks
from modeler.types import SOME_VIEWS, Array, BoolArray, RayImage, spread

CELL: Final = 0.02
"""Side of the cubes in which views of a scene are compared, as a share of the distance to which it is seen.

Measured: with 0.01, 0.02 and 0.04, masks of a drawn capture have 0.985, 0.984 and 0.983 of union with the truth in
common.
"""
_CELLS: Final = 2**20  # along each axis, of which a scene fills a hundred
_SURER: Final = 0.25  # by which the other views have to be surer than the view itself: cubes at a rim hold both

_APART: Final = 2.5  # cubes, a seventh of the object's radius, between parts of one thing

Cubes = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Majority:
    """What most views of a scene that is still take for the object."""

    views: Mapping[int, RayImage]
    """By frame number, with masks of the object and of what is beside it."""
    found: Callable[[int], BoolArray]
    """Returns the mask (h, w) of what a view alone takes for the object."""
    trajectory: Mapping[int, Array]
    """object_from_camera (4, 4) by frame number."""
    cell_m: float
    """Side of the cubes in which views are compared."""

    def mask(self, frame: int) -> BoolArray:
        """Return the object's mask (h, w) in a view, as most of the others have it."""
        (known, yes, looks), (seen, cubes) = self._summed, self._cubes(frame)
        place, own = np.minimum(np.searchsorted(known, cubes), len(known) - 1), self.found(frame)[seen]
        for_it, others = yes[place], np.where(known[place] == cubes, looks[place], 0)
        if frame in self._votes:  # the others decide
            voted, share = self._votes[frame]
            for_it, others = for_it - share[np.searchsorted(voted, cubes)], others - 1
        share = np.divide(for_it, others, out=own.astype(np.float64), where=others > 0)
        elsewhere = self._elsewhere[place] & (known[place] == cubes)
        share[elsewhere] = 0.0
        # A view that takes another thing for the object does not count at all.
        surer = 0.0 if 2 * np.count_nonzero(own & elsewhere) > np.count_nonzero(own) else _SURER
        mask = np.zeros_like(seen)
        mask[seen] = share > np.where(own, 0.5 - surer, 0.5 + surer)
        return without_specks(mask)

    @cached_property
    def sure(self) -> bool:
        """Whether at least half of the masks are about what was found in their views alone."""
        pairs = [(self.mask(frame), self.found(frame)) for frame in self._votes]
        alike = [2 * int(np.sum(mask & found)) > int(np.sum(mask | found)) for mask, found in pairs]
        return bool(2 * sum(alike) >= len(alike))

    @cached_property
    def _votes(self) -> dict[int, tuple[Cubes, Array]]:
        """Cubes that some of the views see, and the share of each that a view takes for the object."""
        votes = {}
        for frame in spread([*self.views], SOME_VIEWS):
            seen, cubes = self._cubes(frame)
            own, which = np.unique(cubes, return_inverse=True)
            votes[frame] = own, np.bincount(which, self.found(frame)[seen]) / np.bincount(which)
        return votes

    @cached_property
    def _summed(self) -> tuple[Cubes, Array, npt.NDArray[np.int64]]:
        """Cubes (n,) that any of them sees, the sum of their shares, and how many see it."""
        known, which = np.unique(np.concatenate([cubes for cubes, _ in self._votes.values()]), return_inverse=True)
        shares = np.concatenate([share for _, share in self._votes.values()])
        return known, np.asarray(np.bincount(which, shares), dtype=np.float64), np.bincount(which)

    @cached_property
    def _elsewhere(self) -> BoolArray:
        """Which of the cubes (n,) are not at the thing that most of the views take for the object."""
        known, yes, looks = self._summed
        places, own = (
            np.stack([known // _CELLS**2, known // _CELLS % _CELLS, known % _CELLS], axis=1),
            2.0 * yes > looks,
        )
        if not own.any():
            return own
        near = KDTree(places[own]).query_pairs(_APART, output_type="ndarray")
        size = (int(np.count_nonzero(own)),) * 2
        things = np.full(len(known), -1)
        count, things[own] = connected_components(coo_matrix((np.ones(len(near)), near.T), size), directed=False)
        taken = np.zeros(count)
        for cubes, share in self._votes.values():
            found = things[np.searchsorted(known, cubes[share > 0.5])]
            if (found >= 0).any():
                taken[np.bincount(found[found >= 0]).argmax()] += 1.0
        away, _ = KDTree(places[things == taken.argmax()]).query(places, distance_upper_bound=_APART)
        return np.asarray(np.isinf(away), dtype=np.bool_)

    def _cubes(self, frame: int) -> tuple[BoolArray, Cubes]:
        """Return which pixels (h, w) a view compares, and the numbers (n,) of the cubes in which they lie."""
        images = self.views[frame].frame
        seen: BoolArray = np.asarray(images.mask) & (images.depth_m > 0.0)
        points_m = np.asarray(point_image(images.depth_m, images.camera)[seen], dtype=np.float64)
        places = np.floor(se3.transform(self.trajectory[frame], points_m) / self.cell_m).astype(np.int64)
        x, y, z = places.T + _CELLS // 2
        return seen, (x * _CELLS + y) * _CELLS + z
