"""What images contradict, made anew: masks without surface that does not move with the object, and alignments of parts.

A mask may hold an arm that holds the object, a moving camera sees what stands beside it, and a pair that matches by
chance misplaces all frames from it on.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from modeler import se3
from modeler.closure import MapView
from modeler.pipeline.attempts import contradicts_prior
from modeler.pipeline.joining import MIN_JOINS, Joiner, Segment, rejected_elsewhere
from modeler.pipeline.pairs import Prepared
from modeler.pipeline.state import State
from modeler.pipeline.tracking import Tracker
from modeler.segmentation.depth_images import point_image, without_specks
from modeler.types import (
    SOME_VIEWS,
    Array,
    BoolArray,
    Consistency,
    Edge,
    Outcome,
    Posterior,
    RayImage,
    Searching,
    Segmentation,
    spread,
)
from modeler.verdict.evidence import (
    FreeSpace,
    default_tolerance_m,
    faces_camera,
    free_space,
    looked_up,
    nearest_around,
)
from modeler.views import Sensor

MAX_ROUNDS: Final = 3  # of four drawn captures one was right after the first, one after the second, one settled by then
"""How often masks are made anew: better masks make better poses, which make better masks."""
_SETTLED: Final = 0.05  # share of the pixels of all masks: rims differ by as much between masks that are both right
_POINTS: Final = 5000  # of a view that are looked up in others: 1.5 % of its size apart
_BLUR: Final = 0.04  # of the mask's size, over which looks are pooled; 0.02 and 0.08 give the same masks to 2 %
CELL: Final = 0.02
"""Side of the cubes in which views of a scene are compared, as a share of the distance to which it is seen.

Measured: with 0.01, 0.02 and 0.04, masks of a drawn capture have 0.985, 0.984 and 0.983 of union with the truth in
common.
"""
_CELLS: Final = 2**20  # along each axis, of which a scene fills a hundred
_OVERRULED_BY: Final = 0.25
"""Share beyond a half with which other views overrule the view itself: cubes at a rim hold both."""
_APART: Final = 2.5  # cubes, a seventh of the object's radius, between parts of one thing

Cubes = npt.NDArray[np.int64]


def moving_along(
    views: Mapping[int, RayImage], others: Mapping[int, RayImage], trajectory: Mapping[int, Array], tolerance_m: float
) -> dict[int, BoolArray]:
    """Return the part (h, w) of each view's mask that moves with the object, by frame number.

    A point moves with it if, by the poses, others see surface where it should be more often than nothing: the space is
    free there, or the camera measured nothing around. Looks are pooled over the image, as free space is found only
    where something was measured behind; points that no look reaches go with the nearest.

    Args:
        views: with the masks as found first.
        others: in which they are looked up, with other masks, which do not matter here.
        trajectory: object_from_camera (4, 4) by frame number.
        tolerance_m: error of the surface above which a model is wrong.
    """
    chosen = spread([frame for frame in others if frame in trajectory], SOME_VIEWS)
    reaches_m = {other: nearest_around(others[other], far_gaps=True) for other in chosen}
    found = {}
    for frame, view in views.items():
        if frame not in trajectory:
            continue
        some = view.along_curve[:: max(len(view.points_m) // _POINTS, 1)]
        some = some[faces_camera(view.points_m[some], view.normals[some])]
        looks = np.zeros((2, *view.frame.depth_m.shape))
        rows, columns = view.pixels[some].T
        for other in chosen:
            if other != frame:
                motion = se3.inverse(trajectory[other]) @ trajectory[frame]
                moved_m, turned = se3.transform(motion, view.points_m[some]), view.normals[some] @ motion[:3, :3].T
                looks[:, rows, columns] += looked_up(others[other], reaches_m[other], moved_m, turned, tolerance_m)
        found[frame] = _kept(np.asarray(view.frame.mask), looks)
    return found


def _kept(mask: BoolArray, looks: Array) -> BoolArray:
    """Return the part (h, w) of a mask that moves with the object.

    Args:
        mask: (h, w).
        looks: (2, h, w) number of views with nothing, and with surface, where the point at a pixel should be.
    """
    away, there = ndimage.gaussian_filter(looks, (0.0, *[_BLUR * np.sqrt(np.count_nonzero(mask))] * 2))
    known = mask & (away + there > 0.0)
    if not known.any():
        return mask
    row, column = np.asarray(ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))
    moving = np.asarray(away <= there)
    return np.asarray(mask & moving[row, column], dtype=np.bool_)


def turned_deg(trajectory: Mapping[int, Array]) -> float:
    """Return the largest rotation in degrees between two views, given object_from_camera (4, 4) by frame number.

    Measured: an arm that was registered turned by 23° and 24°, objects in hands by 83° to 177°.
    """
    poses = np.stack([*trajectory.values()])
    return max(float(np.degrees(se3.rotation_angle(se3.inverse(pose) @ poses).max())) for pose in poses)


def settled(masks: Mapping[int, BoolArray], before: Mapping[int, BoolArray]) -> bool:
    """Return whether masks are those before, but for their rims."""
    both = [(mask, before[frame]) for frame, mask in masks.items() if frame in before]
    different = sum(np.count_nonzero(mask ^ other) for mask, other in both)
    return bool(different <= _SETTLED * sum(np.count_nonzero(mask | other) for mask, other in both))


def masks_of(views: Mapping[int, RayImage]) -> dict[int, BoolArray]:
    """Return the masks (h, w) of views by frame number."""
    return {frame: np.asarray(view.frame.mask) for frame, view in views.items()}


def segmented(view: RayImage, mask: str) -> Prepared:
    """Return a frame as it was segmented.

    Args:
        view: with its mask.
        mask: label of the segmentation's outcome.
    """
    found = Segmentation(np.asarray(view.frame.mask), view.plane, Outcome(mask))
    return Prepared(replace(view.frame, mask=None), found, view)


def remasked(prepared: Prepared, mask: BoolArray, sensor: Sensor) -> Prepared:
    """Return a frame with another mask (h, w)."""
    found = replace(prepared.segmentation, mask=mask)
    view = sensor.ray_image(replace(prepared.frame, mask=mask), found.plane)
    return Prepared(prepared.frame, found, view if len(view.points_m) else None)


def contradicting(state: State) -> list[Edge]:
    """Return edges of the refinement that determine a motion and contradict the poses, if they are several."""
    found = [edge for edge in state.spans if isinstance(edge.reason, Consistency) and not edge.accepted]
    return found if len(found) >= MIN_JOINS else []  # fewer may match by chance


def most_crossed(state: State, edges: Sequence[Edge]) -> tuple[int, int]:
    """Return the two successive views that most edges lead across, of several those with the least certain motion."""
    order, places = sorted(state.views, key=lambda frame: state.places[frame]), state.places
    across = [sorted((places[edge.target], places[edge.source])) for edge in edges]

    def crossed(gap: tuple[int, int]) -> tuple[int, float]:
        count = sum(low <= places[gap[0]] and places[gap[1]] <= high for low, high in across)
        return count, float(np.trace(state.solution.relative_gaussian(*gap).covariance[:3, :3]))

    return max(pairwise(order), key=crossed)


@dataclass(frozen=True)
class Realigner:
    """Aligns two parts of a run anew where its views contradict their poses (docs/method/segments.md).

    They do where surface of one violates the other's free space, and where registrations of the refinement contradict
    them. A pair that matches by chance, as similar sides of an object do, misplaces all frames from it on. Alignments
    of both parts are judged by all their views.
    """

    tracker: Callable[[State], Tracker]
    """Returns the tracker of a state."""
    joiner: Callable[[Tracker], Joiner]
    """Returns the joiner of segments."""
    judge: Callable[[Posterior, MapView], Edge]
    """Returns the edge of a further registration between two views of a map."""
    tolerance_m: float | None = None
    """Error of the surface above which a model is called wrong; None: `default_tolerance_m`."""

    def realigned(self, state: State) -> Generator[Searching, None, State]:
        """Return a state that its views contradict less, or the same one."""
        tried: set[tuple[int, int]] = set()
        while (gap := self._gap(state)) is not None and gap not in tried:
            tried.add(gap)
            other = yield from self._aligned_across(state, *gap)
            if other is None or self.contradictions(other) >= self.contradictions(state):
                break
            state = other
        return state

    def contradictions(self, state: State) -> tuple[float, int]:
        """Return free-space violations in units of their limit, 1 within it, and the number of contradicting spans."""
        free = self.free_space(state)
        return (1.0 if free is None else max(free.excess, 1.0)), len(contradicting(state))

    def _gap(self, state: State) -> tuple[int, int] | None:
        """Return the two successive views across which most is contradicted; None if all holds."""
        free = self.free_space(state)
        if free is not None and not free.holds:
            return self._most_contradicted(state, free)
        spans = contradicting(state)
        return most_crossed(state, spans) if spans else None

    def free_space(self, state: State, among: Iterable[int] | None = None) -> FreeSpace | None:
        """Return the free-space violations between views of a state, by default all, as the verdict judges them."""
        views = {frame: state.views[frame] for frame in (state.views if among is None else among)}
        return free_space(views, state.solution.trajectory, self.tolerance(state))

    def tolerance(self, state: State) -> float:
        """Return the error in m of the surface above which a model is called wrong."""
        return self.tolerance_m or default_tolerance_m([*state.views.values()], state.solution.variance_factor)

    def _aligned_across(self, state: State, before: int, after: int) -> Generator[Searching, None, State | None]:
        """Return a state with another alignment of the frames from one (`after`) on with those before; None if none."""
        state = state.with_spans()
        early = {frame for frame in state.views if state.places[frame] <= state.places[before]}
        target, source = state.parted(early), state.parted({*state.views} - early)
        if target is None or source is None:
            return None
        yield Searching(after)
        tracker = self.tracker(state)
        merged, _ = joined(self.joiner(tracker), target, source)
        if merged is None:
            return None
        views, motion = state.views, merged.solution.relative(before, after)
        steps = state.steps(after, before)
        if contradicts_prior(tracker.learned_prior, views[after], views[before], steps, motion[None]):
            return None
        kept = {*target.graph.edges, *source.graph.edges}
        others = [edge for edge in state.graph.edges if edge not in kept]
        again = [
            rejected_elsewhere(edge, merged.solution)
            if edge.accepted
            else self.judge(edge.posterior, merged.map_view)
            if edge in state.spans
            else edge
            for edge in others
        ]
        return merged.refined(again).with_spans()

    def _most_contradicted(self, state: State, free: FreeSpace) -> tuple[int, int] | None:
        """Return the two successive views across which most surface violates free space, if any does."""
        places, gap = state.places, free.most_contradicted(state.places)
        while gap is not None:  # of long runs, some views are compared
            between = [view for view in state.views if places[gap[0]] <= places[view] <= places[gap[1]]]
            if len(between) == 2:
                return gap
            found = self.free_space(state, between)
            gap = None if found is None else found.most_contradicted(places)
        return None


def joined(joiner: Joiner, target: State, source: State) -> tuple[State | None, Sequence[Edge]]:
    """Return two states joined by their likeliest alignment, None if too few pairs agree on it, and its edges."""
    parts = [Segment(state.views, state.solution, state.graph.edges) for state in (target, source)]
    alignments = joiner.join(parts[0], parts[1])
    joins = alignments[0].edges if alignments else ()
    if sum(edge.accepted for edge in joins) < MIN_JOINS:
        return None, joins
    merged = target.merged(source, joins)
    return merged if sum(merged.solution.takes_part(edge) for edge in joins) >= MIN_JOINS else None, joins


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
        margin = 0.0 if 2 * np.count_nonzero(own & elsewhere) > np.count_nonzero(own) else _OVERRULED_BY
        mask = np.zeros_like(seen)
        mask[seen] = share > np.where(own, 0.5 - margin, 0.5 + margin)
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
