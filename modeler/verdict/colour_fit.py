"""Whether colour fits depth: print of the same surface agrees between views where colour is, not where it is displaced.

Under right poses, a place on the surface has the same print in all views. If colour is shifted, scaled or mirrored
against depth, or of another frame, it has not, and colours displaced accordingly have.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np
from scipy import ndimage
from scipy.special import ndtri

from modeler import se3
from modeler.closure.consistency import MIN_TURN_DEG, Thresholds
from modeler.kernels.photometric import displaced_correlations
from modeler.priors import GeneralPrior
from modeler.registration.visibility.likelihood import DESCENT_STRIDE
from modeler.registration.visibility.photometric import LOGS
from modeler.significance import RARE
from modeler.types import FLIPS, SOME_POINTS, Array, BoolArray, Check, Flip, RayImage, spread
from modeler.verdict.evidence import MAX_VIEWS
from modeler.views import Sensor

_PAIRS: Final = 12  # of views that are compared, spread over the run: one has a sd of some 0.1
NEAR_DEG, FAR_DEG = MIN_TURN_DEG, GeneralPrior.max_rotation_deg  # rotation between views that share surface
MIN_SHARED: Final = 60  # points of a pair: the sd of a chance correlation is then 0.13
_MARGIN: Final = 4.0  # widths of the fine band: nearer to its outline, a feature is of the background
_WIDTH: Final = 0.01  # of the object's extent in px: width of the fine band, at least a pixel
COARSE: Final = 2.0  # ratio of the widths of the two bands, and of the steps of the search to the finer one
REACH: Final = (0.12, 0.08)  # largest shifts searched, of the image's width: baselines of 15 to 50 mm at half a metre
LOG_SCALES: Final = 0.07 * np.arange(-5, 6)  # fields of view of depth and colour differ by up to 1.4
_OUTLINED: Final = 0.8  # of edges: measured 0.65 to 0.7 for plain bodies on a table, 0.98 to 1.5 for displaced colour
AT_LEAST: Final = Thresholds.min_correlation
"""Of the correlation elsewhere, and of that one: less is found by chance on few points."""
_INNER: Final[WeakKeyDictionary[RayImage, BoolArray]] = WeakKeyDictionary()  # as a view is part of several pairs
_FEATURES: Final[WeakKeyDictionary[RayImage, tuple[float, np.ndarray]]] = WeakKeyDictionary()  # with the band's width


@dataclass(frozen=True)
class Displacement:
    """Where colour is instead of where depth is."""

    scale: float = 1.0
    """Size of things in colour relative to depth, about the middle of the image."""
    shift_px: tuple[float, float] = (0.0, 0.0)
    """Shift of colour against depth, right and down."""
    flip: Flip = ""
    """How colour is turned over."""
    frames: int = 0
    """Number of frames by which the time of colour is after that of depth."""

    def row(self) -> Array:
        """Return it (5,) for the kernel."""
        return np.array([self.scale, *self.shift_px, *FLIPS[self.flip]])

    def moved_to(self, place: Array) -> Displacement:
        """Return it with a shift in px, right and down, and a logarithm of the scale (3,)."""
        return replace(self, scale=float(np.exp(place[2])), shift_px=(float(place[0]), float(place[1])))

    def moved(self, places: Array, shape: tuple[int, ...]) -> Array:
        """Return where places (n, 2) of depth, columns and rows, are in images of colour of a shape (h, w)."""
        middle = np.array([0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1)])
        return np.asarray(middle + FLIPS[self.flip] * (self.scale * (places - middle) + self.shift_px))

    def __str__(self) -> str:
        parts = [f"is {self.flip}"] if self.flip else []
        if self.frames:
            parts.append(f"is of the frame {'after' if self.frames > 0 else 'before'}")
        if abs(self.scale - 1.0) > 0.02:
            parts.append(f"shows things {self.scale:.2f} times as large")
        if max(map(abs, self.shift_px)) >= 1.0:
            parts.append(f"is shifted by ({self.shift_px[0]:.0f}, {self.shift_px[1]:.0f}) px")
        return " and ".join(parts) or "is where it is"


@dataclass(frozen=True)
class ColourFit:
    """How well colours of the same surface agree in different views."""

    correlation: float
    """Mean correlation of print over pairs of views, where colour is."""
    elsewhere: float
    """The largest with colour displaced; that where colour is if no other place is significantly better."""
    displacement: Displacement
    """Where that is."""

    @property
    def check(self) -> Check:
        """The correlation as a share of that with displaced colour."""
        share = 1.0 if self.elsewhere <= 0.0 else max(self.correlation, 0.0) / self.elsewhere
        return Check(min(share, 1.0), AT_LEAST, at_least=True)


def has_colour(view: RayImage) -> bool:
    """Return whether a view shows surface in colours that a camera measured."""
    return view.frame.colour is not None and not view.rendered and len(view.points_m) > 0


def _spread(views: Mapping[int, RayImage], trajectory: Mapping[int, Array]) -> list[tuple[int, int]]:
    """Return pairs of views that share surface, spread over the run."""
    frames, found = spread(list(views), MAX_VIEWS), []
    for place, first in enumerate(frames):
        for second in frames[place + 1 :]:
            angle_deg = np.degrees(se3.rotation_angle(se3.inverse(trajectory[first]) @ trajectory[second]))
            if NEAR_DEG <= angle_deg <= FAR_DEG:
                found.append((first, second))
    return spread(found, _PAIRS)


@dataclass(frozen=True, eq=False)
class Pair:
    """Surface that two views see."""

    first: int
    """Frame number."""
    second: int
    """Frame number."""
    points_m: Array
    """(n, 3) in the object's frame."""
    normals: tuple[Array, Array]
    """(n, 3) each, there, as the first and the second view have them; NaN in holes of the first."""
    pixels: int
    """Number of pixels of the second view that they stand for."""

    @staticmethod
    def of(views: Mapping[int, RayImage], trajectory: Mapping[int, Array], first: int, second: int) -> Pair:
        """Return the surface of the second view that the first one sees, too."""
        target, source = views[first], views[second]
        kept = np.flatnonzero(_inside(source, source.pixels))
        stride = max(len(kept) // SOME_POINTS, 1)
        kept = kept[::stride]
        target_from_source = se3.inverse(trajectory[first]) @ trajectory[second]
        points_m, normals = se3.transform(target_from_source, source.points_m[kept]), source.normals[kept]
        facing = -np.sum(points_m * (normals @ target_from_source[:3, :3].T), axis=1)
        seen = facing >= Sensor.min_cosine * np.linalg.norm(points_m, axis=1)
        pixels = np.rint(places_in(target, points_m)[:, ::-1]).astype(int)
        height, width = target.frame.depth_m.shape
        seen &= (pixels >= 0).all(axis=1) & (pixels < (height, width)).all(axis=1)
        kept, points_m, pixels = kept[seen], points_m[seen], pixels[seen]
        near = np.abs(target.frame.depth_m[pixels[:, 0], pixels[:, 1]] - points_m[:, 2])
        matched = near < 4.0 * target.sigma_r_m + _WIDTH * target.size_m
        matched &= _inside(target, pixels)
        kept, numbers = kept[matched], target.numbers[tuple(pixels[matched].T)]
        known = np.concatenate([target.normals, np.full((1, 3), np.nan)])[numbers]
        normals = (known @ trajectory[first][:3, :3].T, source.normals[kept] @ trajectory[second][:3, :3].T)
        return Pair(
            first, second, se3.transform(trajectory[second], source.points_m[kept]), normals, stride * len(kept)
        )


def places_in(view: RayImage, points_m: Array) -> Array:
    """Return column and row (n, 2) of points (n, 3) in a camera's frame; NaN behind it."""
    camera, depth_m = view.frame.camera, np.where(points_m[:, 2] > 0.0, points_m[:, 2], np.nan)
    focal, middle = (camera.fx, camera.fy), (camera.cx, camera.cy)
    return np.asarray(points_m[:, :2] / depth_m[:, None] * focal + middle)


def _width_px(view: RayImage) -> float:
    """Return the width of the fine band."""
    return max(_WIDTH * float(np.sqrt(len(view.pixels))), 1.0)


def _inside(view: RayImage, pixels: np.ndarray) -> np.ndarray:
    """Return which (n,) pixels (n, 2) are surface and some way from its outline."""
    if view not in _INNER:
        margin_px = _MARGIN * _width_px(view)
        inner = ndimage.minimum_filter(_surface(view), size=2 * round(margin_px / 2.0) + 1)
        _INNER[view] = np.asarray(inner, dtype=np.bool_)
    return np.asarray(_INNER[view][pixels[:, 0], pixels[:, 1]], dtype=np.bool_)


def _surface(view: RayImage) -> BoolArray:
    """Return where (h, w) a view has surface, without small holes."""
    surface = np.zeros(view.frame.depth_m.shape, dtype=np.bool_)
    surface[view.pixels[:, 0], view.pixels[:, 1]] = True
    return np.asarray(ndimage.binary_closing(surface), dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Colours of pairs of views, compared under displacements."""

    views: Mapping[int, RayImage]
    trajectory: Mapping[int, Array]
    pairs: Sequence[Pair]

    @staticmethod
    def of(views: Mapping[int, RayImage], trajectory: Mapping[int, Array]) -> Comparison | None:
        """Return the comparison of a run; None without pairs of views with colour that share surface.

        Args:
            views: by frame number.
            trajectory: object_from_camera (4, 4) by frame number.
        """
        coloured = {frame: views[frame] for frame in sorted(trajectory) if frame in views and has_colour(views[frame])}
        if len({view.frame.colour.shape for view in coloured.values() if view.frame.colour is not None}) != 1:
            return None
        pairs = [Pair.of(coloured, trajectory, *names) for names in _spread(coloured, trajectory)]
        pairs = [pair for pair in pairs if len(pair.points_m) >= MIN_SHARED]
        return Comparison(coloured, trajectory, tuple(pairs)) if pairs else None

    def fit(self) -> ColourFit:
        """Return how colours agree, and the best displacement if they agree poorly where they are."""
        fine_px, here = self.width_px, Displacement()
        correlation = self.correlation(here, fine_px)
        best, elsewhere = here, correlation
        if correlation < AT_LEAST:  # else no place is twice as good
            best, elsewhere = self._elsewhere(correlation)
        return ColourFit(correlation, elsewhere, best)

    @cached_property
    def width_px(self) -> float:
        """Width of the fine band."""
        return float(np.median([_width_px(view) for view in self.views.values()]))

    @cached_property
    def frames(self) -> list[int]:
        """Numbers of the frames that are compared."""
        return sorted({frame for pair in self.pairs for frame in (pair.first, pair.second)})

    @cached_property
    def _starts(self) -> np.ndarray:
        return np.cumsum([0, *(len(pair.points_m) for pair in self.pairs)])

    @cached_property
    def _indices(self) -> np.ndarray:
        number = {frame: place for place, frame in enumerate(self.frames)}
        return np.array([(number[pair.first], number[pair.second]) for pair in self.pairs])

    @cached_property
    def _features(self) -> dict[float, np.ndarray]:
        return {}

    @cached_property
    def _at_times(self) -> dict[int, Array]:
        return {}

    def feature(self, frame: int, width_px: float) -> np.ndarray:
        """Return the band-passed logarithms (h, w) of a view's colours, as (7.1) but over the whole image."""
        view = self.views[frame]
        known = _FEATURES.get(view)
        if known is None or known[0] != width_px:
            assert view.frame.colour is not None
            logs = LOGS[view.frame.colour].sum(axis=-1)
            near, wide = (ndimage.gaussian_filter(logs, ratio * width_px) for ratio in (1.0, 2.0))
            _FEATURES[view] = known = width_px, np.asarray(near - wide)
        return known[1]

    def features(self, width_px: float) -> np.ndarray:
        """Return those of all views that are compared (v, h, w)."""
        if width_px not in self._features:
            self._features[width_px] = np.stack([self.feature(frame, width_px) for frame in self.frames])
        return self._features[width_px]

    def camera_from_object(self, frame: int, frames: int) -> Array:
        """Return where (4, 4) surface is in the colour of a view if that is of `frames` later; NaN where unknown."""
        order = list(self.views)
        place = order.index(frame) + frames
        known = 0 <= place < len(order)
        return se3.inverse(self.trajectory[order[place]]) if known else np.full((4, 4), np.nan)

    def places(self, frames: int) -> Array:
        """Return where surface is in the two views (n, 4) if colour is that of `frames` later; NaN where unknown."""
        if frames not in self._at_times:
            parts = []
            for pair in self.pairs:
                sides = [
                    (self.views[frame], self.camera_from_object(frame, frames)) for frame in (pair.first, pair.second)
                ]
                places = [places_in(view, se3.transform(pose, pair.points_m)) for view, pose in sides]
                parts.append(np.concatenate(places, axis=1))
            self._at_times[frames] = np.concatenate(parts)
        return self._at_times[frames]

    def correlations(self, displacements: Sequence[Displacement], width_px: float, *, stride: int = 1) -> Array:
        """Return correlations (m, k) of the pairs under displacements of one time, at every `stride`-th point."""
        rows = np.stack([each.row() for each in displacements])
        places, starts = self.places(displacements[0].frames)[::stride], -(-self._starts // stride)
        return displaced_correlations(self.features(width_px), self._indices, starts, places, rows)

    def correlation(self, displacement: Displacement, width_px: float) -> float:
        """Return the mean correlation under a displacement."""
        return float(self.correlations([displacement], width_px).mean())

    def _still(self, displacement: Displacement) -> float:
        """Return the mean correlation under a displacement of what pairs show in the same pixels."""
        there = np.tile(self.places(displacement.frames)[:, :2], 2)
        features, row = self.features(self.width_px), displacement.row()[None]
        return float(displaced_correlations(features, self._indices, self._starts, there, row).mean())

    def edges(self, displacement: Displacement) -> float:
        """Return how steep (0..1) colours are along the outline of surface under a displacement, on average."""
        order, found = list(self.views), []
        for number, frame in enumerate(self.frames):
            place = order.index(frame) + displacement.frames
            if 0 <= place < len(order):
                surface = _surface(self.views[order[place]])
                inner = np.asarray(ndimage.binary_erosion(surface), dtype=np.bool_)
                outline = np.argwhere(surface & ~inner)[:, ::-1].astype(np.float64)
                column, row = displacement.moved(outline, self._steepness[number].shape).T
                found.append(ndimage.map_coordinates(self._steepness[number], [row, column], order=1, mode="nearest"))
        return float(np.mean(np.concatenate(found)))

    @cached_property
    def _steepness(self) -> np.ndarray:
        """Slopes (v, h, w) of the features, 0..1: 0.5 where a fifth of the image is steeper."""
        slopes = [np.hypot(*np.gradient(image)) for image in self.features(self.width_px)]
        return np.stack([slope / (slope + np.percentile(slope, 80.0) + 1e-9) for slope in slopes])

    def _elsewhere(self, correlation: float) -> tuple[Displacement, float]:
        """Return the best displacement and its correlation; alignment if none is significantly better."""
        fine_px, coarse_px, here = self.width_px, COARSE * self.width_px, Displacement()
        grid = list(self._grid(coarse_px))
        scores = self.correlations(grid, coarse_px, stride=DESCENT_STRIDE).mean(axis=1)
        order = np.argsort(-scores, kind="stable")
        some = self.correlations([grid[k] for k in order[:: max(len(order) // 100, 1)]], fine_px).mean(axis=1)
        chance = float(np.median(np.abs(some))) / float(ndtri(0.75))  # of normal variables
        groups = {(grid[k].flip, grid[k].scale): k for k in reversed(order)}  # the best shift under each
        tried = [self._refined(grid[k]) for k in groups.values()]
        times = [Displacement(frames=frames) for frames in (-1, 1) if len(self.views) > 2]
        tried += [(each, self.correlation(each, fine_px)) for each in times]
        best, found = max(tried, key=lambda each: each[1])
        clear = found >= max(AT_LEAST, correlation - float(ndtri(RARE)) * chance)  # of several thousand places
        # A plain object on a printed table that turns with it agrees where colour is that of the table, and before
        # scenery that stands still, under some poses, where it is that of the scenery.
        outlined = self.edges(best) > _OUTLINED * self.edges(here)
        return (best, found) if clear and outlined and found > self._still(best) else (here, correlation)

    def _grid(self, step_px: float) -> Iterator[Displacement]:
        """Yield displacements as far apart as the coarse band is wide."""
        width = self.features(step_px).shape[2]
        across, down = (np.arange(-int(reach * width / step_px), int(reach * width / step_px) + 1) for reach in REACH)
        for flip in FLIPS:
            for log_scale in LOG_SCALES:
                for x in across:
                    for y in down:
                        yield Displacement(float(np.exp(log_scale)), (step_px * float(x), step_px * float(y)), flip)

    def _refined(self, start: Displacement) -> tuple[Displacement, float]:
        """Return the best displacement near one of the coarse search, in the fine band, and its correlation."""
        best, step_px = start, COARSE * self.width_px
        half_px = 0.25 * self.features(self.width_px).shape[2]  # by which a scale moves most of what is seen, at most
        found = self.correlation(best, self.width_px)
        while step_px >= 0.5 * self.width_px:
            steps = [(x, y, s) for x in (-1, 0, 1) for y in (-1, 0, 1) for s in (-1, 0, 1)]
            near = [
                Displacement(
                    best.scale * float(np.exp(s * step_px / half_px)),
                    (best.shift_px[0] + x * step_px, best.shift_px[1] + y * step_px),
                    best.flip,
                )
                for x, y, s in steps
                if abs(np.log(best.scale) + s * step_px / half_px) <= LOG_SCALES[-1]
            ]
            scores = self.correlations(near, self.width_px).mean(axis=1)
            top = int(np.argmax(scores))
            if scores[top] > found:
                best, found = near[top], float(scores[top])
            else:
                step_px *= 0.5
        return best, found
