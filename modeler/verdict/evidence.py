"""Evidence for and against a model: values with the limits beyond which it is not trusted.

Views are by frame number; `edges` are those that take part, and `solution` has their poses. `tolerance_m` is the error
of the surface above which a model is wrong; `distances` are those of `prior_distances`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import ndimage
from scipy.special import chdtri

from modeler import se3
from modeler.fusion import Fuser
from modeler.significance import OUTSIDE, RARE, SELDOM, SIGMAS, radius
from modeler.types import (
    SOME_POINTS,
    AbstractPoseDensity,
    AbstractPrior,
    Array,
    BoolArray,
    Check,
    Contradictions,
    Edge,
    InputError,
    JoinsSegments,
    LoopClosureError,
    RayImage,
    Solution,
    spread,
)

MAX_UNSURE: Final = 0.5
"""Share of frames with an unsure mask: beyond, unsure masks are the rule, and another object may have been modelled."""
MAX_VIOLATIONS: Final = 0.1
"""Share of a frame's surface in the free space of other frames, by more than the tolerance: a model is called wrong if
less than 90 % of its surface lies within it of the true one."""
MAX_FALSE_SURFACE: Final = 0.03
"""Share of a frame's surface contradicted by the frames that observe it: up to 0.02 in right runs, where hole filling
adds surface along outlines; 0.04 for a box with a post of 3 cm in an upside-down pose."""
TOLERANCE: Final = 0.075
"""Default tolerance on the surface, as a share of the object's size: 5 mm for a box of 15 x 20 x 14 cm."""
TOLERANCE_SDS: Final = 2.5
"""The least default tolerance, in standard deviations of the camera's range noise, which one pixel in 80 exceeds."""
WRONG_RAD: Final = np.radians(3.0)
"""Error above which a rotation is called wrong."""

_DRAWS: Final = 1000  # of a prior: the best of them lies 0.2 nats below the mode of a Gaussian in six dimensions
MAX_VIEWS: Final = 40  # compared with each other, spread over the run: 1,600 pairs take a second
_MIN_POINTS: Final = 200  # per frame observed by others: standard deviation of its share is then 0.02
_MIN_JUDGED: Final = 100  # points of a frame observed by two others or more: a share of 0.02 is two of them
_MARGIN_PX: Final = Fuser.margin_px  # as what carves: pixels at depth edges mix foreground and background
_MIN_COSINE: Final = 0.5  # beyond 60° range noise grows with slope


def displacement(views: Mapping[int, RayImage], solution: Solution) -> Check | None:
    """Return the largest displacement in m of the first view's surface, as root mean square.

    None for fewer than two views. Below some standard deviations of a pixel's range, no motion is detectable.
    """
    frames = [frame for frame in solution.trajectory if frame in views]
    if len(frames) < 2 or not len(views[frames[0]].points_m):
        return None
    first = views[frames[0]]
    points_m = first.points_m[:: max(len(first.points_m) // SOME_POINTS, 1)]
    moved_m = [
        float(
            np.sqrt(np.mean(np.sum((se3.transform(solution.relative(frame, frames[0]), points_m) - points_m) ** 2, 1)))
        )
        for frame in frames[1:]
    ]
    return Check(max(moved_m), SIGMAS * first.sigma_r_m, at_least=True)


def prior_distances(
    edges: Sequence[Edge],
    views: Mapping[int, RayImage],
    prior: AbstractPrior,
    places: Mapping[int, int] | None = None,
    solution: Solution | None = None,
) -> list[tuple[Edge, float]]:
    """Return edges with the distances Δ, in nats, from the prior's mode to the means of their posteriors.

    For edges that do not hold the prior, to the pose that all edges together give if that is nearer: the mean of a
    posterior that leaves a rotation open may be anywhere.

    Limits of a search, outside of which a density is zero, are those for several steps, because the search extends to
    them; limits that nobody stated are none. Edges to which the prior does not apply are left out, and those between
    segments.

    Args:
        edges: those that take part.
        views: by frame number.
        prior: of the motions.
        places: by frame number, how many frames were read before; None: the number itself.
        solution: the poses; None: means alone are compared.
    """
    found = []
    prior = prior.unlimited() or prior
    for edge in edges:
        if edge.kind == "join" or edge.source not in views or edge.target not in views:
            continue
        source, target = views[edge.source], views[edge.target]
        try:
            steps = abs(places[edge.source] - places[edge.target]) if places else abs(edge.source - edge.target)
            density = prior.relaxed(max(steps, 2)).between(source, target)
        except InputError:  # the prior does not apply: it was not used either
            continue
        posterior = edge.posterior
        means = np.stack([mode.pose.mean for mode in posterior.modes] or [posterior.pose.mean])
        if solution is not None and edge.kind != "odometry":
            means = np.concatenate([means, solution.relative(edge.target, edge.source)[None]])
        here = float(density.log_prior(means).max())
        if np.isfinite(here):  # not at a limit of the search, where the posterior is cut off
            found.append((edge, distance_nats(density, here)))
    return found


def distance_nats(density: AbstractPoseDensity, here: float) -> float:
    """Return how far from the mode of a density, in nats of a Gaussian, a pose of log prior `here` is.

    For a Gaussian it is the difference of the logs. For densities with a wide part of little mass, such as a possible
    regrasp, it is at most the distance that a pose drawn from a Gaussian exceeds with the same probability.
    """
    drawn = density.sample(_DRAWS, np.random.default_rng(0))
    logs = density.log_prior(drawn)
    weights = np.exp(logs - density.log_density(drawn))
    rarer = float(weights[logs <= here].sum() / weights.sum())
    height = max(float(logs.max()) - here, 0.0)
    return min(height, 0.5 * float(chdtri(6, rarer))) if rarer > 0.0 else height


def contradiction(distances: Sequence[tuple[Edge, float]]) -> tuple[Edge, Check] | None:
    """Return the edge whose posterior contradicts the prior most, and by how much; None if nothing can be compared.

    In standard deviations of a Gaussian prior in six dimensions: √(2 Δ), with Δ in nats from the prior's mode to the
    posterior's mean. Defined alike for other densities.
    """
    if not distances:
        return None
    edge, nats = max(distances, key=lambda found: found[1])
    return edge, Check(float(np.sqrt(2.0 * nats)), radius(RARE))


def prior_check(distances: Sequence[tuple[Edge, float]]) -> Check | None:
    """Return the mean squared distance of the odometry edges from a Gaussian prior, per degree of freedom.

    A wrong step shows a little in every pair. Under a true prior, a posterior's mean is nearer to the mode than the
    motion, whose squared distance follows χ² with six degrees of freedom. None if nothing can be compared.
    """
    squared = [2.0 * nats for edge, nats in distances if edge.kind == "odometry"]
    if not squared:
        return None
    freedom = 6 * len(squared)
    return Check(sum(squared) / freedom, float(chdtri(freedom, SELDOM)) / freedom)


def loop_check(errors: Sequence[LoopClosureError], tolerance_m: float = 0.0) -> tuple[LoopClosureError, Check] | None:
    """Return the loop with the largest closure error by its limit, in standard deviations; None without a loop.

    The NEES of a closure error follows χ² with six degrees of freedom. For the largest of several loops, the tail
    probability is at most their number times as large (Bonferroni). A closure error that would not make a pose wrong if
    it were that pose's is within the limit, however small its standard deviation.
    """
    finite = [error for error in errors if np.isfinite(error.sigmas)]
    if not finite:
        return None
    chance = float(np.sqrt(chdtri(6, SELDOM / len(finite)) / 6.0))
    shares = [_wrong_share(error.rotation_rad, error.translation_m, tolerance_m) for error in finite]
    checks = [
        Check(error.sigmas, max(chance, error.sigmas / share)) for error, share in zip(finite, shares, strict=True)
    ]
    worst = max(range(len(finite)), key=lambda k: checks[k].value / checks[k].limit)
    return finite[worst], checks[worst]


def _wrong_share(rotation_rad: float, translation_m: float, tolerance_m: float) -> float:
    """Return an error of a pose as a share of the least that is called wrong; always above 0."""
    return float(max(rotation_rad / WRONG_RAD, translation_m / max(tolerance_m, 1e-12), 1e-12))


def graph_check(
    edges: Sequence[Edge], solution: Solution, views: Mapping[int, RayImage] | None = None, tolerance_m: float = 0.0
) -> Check | None:
    """Return the edges' squared residuals in units of their covariances, per degree of freedom; None for a tree.

    What they exceed chance by is part of the uncertainty of poses (`misfit`). The limit is that of chance, or that at
    which some residual would make a pose wrong if it were that pose's error.

    Args:
        edges: those that take part.
        solution: the poses.
        views: by frame number; None: the limit is that of chance.
        tolerance_m: error of the surface above which a model is wrong.
    """
    freedom = 6 * (len(edges) - len(solution.trajectory) + 1)
    if freedom <= 0 or not edges:
        return None
    poses = [solution.pose_of(edge) for edge in edges]
    apart = [
        se3.inverse(pose.mean) @ solution.relative(edge.target, edge.source)
        for pose, edge in zip(poses, edges, strict=True)
    ]
    xi = se3.log(np.stack(apart))
    whitened = np.linalg.solve(np.stack([pose.covariance for pose in poses]), xi[..., None])[..., 0]
    value, limit = float(np.sum(xi * whitened)) / freedom, float(chdtri(freedom, SELDOM)) / freedom
    if views is not None:
        middles_m = [views[edge.source].centroid_m for edge in edges]
        off_m = [
            float(np.linalg.norm(se3.transform(motion, middle_m[None])[0] - middle_m))
            for motion, middle_m in zip(apart, middles_m, strict=True)
        ]
        turned_rad = np.linalg.norm(xi[:, :3], axis=1)
        share = max(_wrong_share(*both, tolerance_m) for both in zip(turned_rad, off_m, strict=True))
        limit = max(limit, value / share**2)
    return Check(value, limit)


def default_tolerance_m(views: Sequence[RayImage], variance_factor: float = 1.0) -> float:
    """Return the error in m of the surface above which a model is called wrong, unless the user says what it is for.

    Args:
        views: of the run.
        variance_factor: of the solution; smooth errors of depth are smaller by its root.
    """
    if not views:
        return 0.0
    size_m, noise_m, smooth_m = np.median([(view.size_m, view.sigma_r_m, view.multipath_m) for view in views], axis=0)
    sigma_m = np.hypot(noise_m, np.sqrt(variance_factor) * smooth_m)
    return float(max(TOLERANCE * size_m, TOLERANCE_SDS * sigma_m))


def other_modes(edges: Sequence[Edge], solution: Solution, views: Mapping[int, RayImage], tolerance_m: float) -> Check:
    """Return the probability that some pair is not at its heaviest mode, by the weights after the graph.

    Alternative alignments of segments count likewise. Modes that differ by less than the error limits are one.
    """
    settled = 1.0
    for edge in edges:
        weights, modes = solution.mode_weights.get((edge.source, edge.target)), edge.posterior.modes
        if weights is None or len(weights) != len(modes) or edge.source not in views:
            continue
        centroid_m = views[edge.source].centroid_m[None]
        heaviest = modes[int(np.argmax(weights))].pose.mean
        alike = [
            float(se3.rotation_angle(se3.inverse(heaviest) @ mode.pose.mean)) <= WRONG_RAD
            and np.linalg.norm(se3.transform(heaviest, centroid_m) - se3.transform(mode.pose.mean, centroid_m))
            <= tolerance_m
            for mode in modes
        ]
        settled *= float(np.sum(np.asarray(weights)[alike]) / np.sum(weights))
    for share in {edge.reason.share for edge in edges if isinstance(edge.reason, JoinsSegments)}:
        settled *= share
    return Check(1.0 - settled, OUTSIDE)


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """Free-space violations of the most contradicted frames."""

    frame: int
    """Number of the frame with the largest share of free-space violations."""
    violations: Check
    """That share of all observations of its surface by others and of theirs by it."""
    contradicted_frame: int
    """Number of the frame with the largest share of contradicted surface."""
    false_surface: Check
    """That share: points in the free space of two frames or more, and of most of those that observe them."""
    contradictions: Mapping[int, Contradictions]
    """By number of a frame beyond a limit."""
    frames: Sequence[int]
    """Numbers of the n frames that were compared."""
    looks: Array
    """(2, n, n) number of points of one frame in the free space of another, and that are on its surface."""

    @property
    def holds(self) -> bool:
        """Whether both shares are within their limits."""
        return self.violations.holds and self.false_surface.holds

    @property
    def excess(self) -> float:
        """The larger of the two shares, in units of its limit."""
        return max(check.value / check.limit for check in (self.violations, self.false_surface))

    def most_contradicted(self, places: Mapping[int, int]) -> tuple[int, int] | None:
        """Return the two successive frames across which most surface violates free space; None if none does.

        Pairs across are those of a frame up to the first with one from the second on.

        Args:
            places: by frame number, its place in order of time.
        """
        order = sorted(range(len(self.frames)), key=lambda k: places[self.frames[k]])
        through, seen = (both + both.T for both in self.looks[:, order][:, :, order])
        shares = [
            through[:k, k:].sum() / max(through[:k, k:].sum() + seen[:k, k:].sum(), 1.0) for k in range(1, len(order))
        ]
        k = int(np.argmax(shares))
        return (self.frames[order[k]], self.frames[order[k + 1]]) if shares[k] > 0.0 else None


def free_space(views: Mapping[int, RayImage], trajectory: Mapping[int, Array], tolerance_m: float) -> FreeSpace | None:
    """Return the free-space violations between frames; None if none can be evaluated.

    A surface point of one frame is transformed into another, where it faces the camera. If the pixel and those around
    it measured something farther away by more than the tolerance, there is no surface: one of the two poses is wrong.

    Args:
        views: by frame number.
        trajectory: object_from_camera (4, 4) by frame number.
        tolerance_m: error of the surface above which a model is wrong.
    """
    frames = [frame for frame in sorted(views) if frame in trajectory and len(views[frame].points_m)]
    frames = spread(frames, MAX_VIEWS)
    reaches_m = {frame: nearest_around(views[frame]) for frame in frames}
    looks, false_surface = np.zeros((2, len(frames), len(frames))), np.zeros((len(frames), 2))
    surface: list[Array] = []  # by frame: of it in the free space of others, and of others in its free space
    free: list[list[Array]] = [[] for _ in frames]
    for row, frame in enumerate(frames):
        points_m, normals, places = _facing(views[frame])
        tally = np.zeros((2, len(points_m)))  # per point: frames with it in free space, frames that see it
        for column, other in enumerate(frames):
            if other != frame:
                motion = se3.inverse(trajectory[other]) @ trajectory[frame]
                moved_m, turned = se3.transform(motion, points_m), normals @ motion[:3, :3].T
                found = looked_up(views[other], reaches_m[other], moved_m, turned, tolerance_m)
                tally += found
                free[column].append(pixels_of(views[other], moved_m[found[0]]))
                looks[:, row, column] = found.sum(axis=1)
        through, judged = tally[0], tally.sum(axis=0) >= 2
        false_surface[row] = np.sum(judged & (through >= 2) & (through > tally[1])), judged.sum()
        surface.append(np.column_stack([places, tally.T])[through > 0])
    through, seen = looks.sum(axis=1) + looks.sum(axis=2)  # which of the two is wrong is unknown
    known = through + seen >= _MIN_POINTS
    if not known.any():
        return None
    shares = np.where(known, through / np.maximum(through + seen, 1.0), 0.0)
    bare = np.where(false_surface[:, 1] >= _MIN_JUDGED, false_surface[:, 0] / np.maximum(false_surface[:, 1], 1.0), 0.0)
    worst, barest = int(np.argmax(shares)), int(np.argmax(bare))
    return FreeSpace(
        frames[worst],
        Check(float(shares[worst]), MAX_VIOLATIONS),
        frames[barest],
        Check(float(bare[barest]), MAX_FALSE_SURFACE),
        {
            frame: Contradictions(surface[row], np.unique(np.concatenate(free[row]), axis=0))
            for row, frame in enumerate(frames)
            if shares[row] > MAX_VIOLATIONS or bare[row] > MAX_FALSE_SURFACE
        },
        frames,
        looks,
    )


def _facing(view: RayImage) -> tuple[Array, Array, np.ndarray]:
    """Return surface points (n, 3) of a view that face its camera, away from its outline, normals (n, 3) and pixels."""
    mask = np.isfinite(view.frame.depth_m) if view.frame.mask is None else view.frame.mask
    inner = ndimage.minimum_filter(mask, size=2 * _MARGIN_PX + 1, mode="nearest")[view.pixels[:, 0], view.pixels[:, 1]]
    some = np.flatnonzero(inner)[:: max(np.count_nonzero(inner) // SOME_POINTS, 1)]
    some = some[faces_camera(view.points_m[some], view.normals[some])]
    return view.points_m[some], view.normals[some], view.pixels[some]


def faces_camera(points_m: Array, normals: Array) -> BoolArray:
    """Return which (n,) points (n, 3) in camera coordinates with normals (n, 3) face the camera."""
    return -np.sum(points_m * normals, axis=1) >= _MIN_COSINE * np.linalg.norm(points_m, axis=1)


def nearest_around(view: RayImage, *, far_gaps: bool = False) -> Array:
    """Return the least depth (h, w) in m around each pixel; NaN where the pixel measured nothing.

    Args:
        view: the view.
        far_gaps: whether such pixels have what is around them, and infinity where nothing was measured there either.
    """
    depth_m = np.asarray(view.frame.depth_m, dtype=np.float64)
    measured = np.isfinite(depth_m) & (depth_m > 0.0)
    near_m = ndimage.minimum_filter(np.where(measured, depth_m, np.inf), size=2 * _MARGIN_PX + 1, mode="nearest")
    return near_m if far_gaps else np.where(measured, near_m, np.nan)


def pixels_of(view: RayImage, points_m: Array) -> Array:
    """Return row and column (n, 2), whole numbers, at which points (n, 3) in front of a view's camera appear in it."""
    camera, (x, y, z) = view.frame.camera, points_m.T
    return np.rint(np.column_stack([camera.fy * y / z + camera.cy, camera.fx * x / z + camera.cx]))


def looked_up(view: RayImage, near_m: Array, points_m: Array, normals: Array, tolerance_m: float) -> BoolArray:
    """Return which points lie in the free space of a view, and which on its surface, (2, n).

    Args:
        view: the view.
        near_m: (h, w) least depth around each of its pixels, see `nearest_around`.
        points_m: (n, 3) in its camera's coordinates.
        normals: (n, 3) unit.
        tolerance_m: distance up to which a point is on the surface.
    """
    depth_m = points_m[:, 2]
    ahead = np.flatnonzero(faces_camera(points_m, normals) & (depth_m > 0.0))
    rows, columns = pixels_of(view, points_m[ahead]).T
    height, width = near_m.shape
    inside = (columns >= _MARGIN_PX) & (columns < width - _MARGIN_PX)
    inside &= (rows >= _MARGIN_PX) & (rows < height - _MARGIN_PX)
    beyond_m = np.full(len(points_m), np.nan)  # that the view measured; NaN of points that do not face its camera
    judged = ahead[inside]
    beyond_m[judged] = near_m[rows[inside].astype(int), columns[inside].astype(int)] - depth_m[judged]
    return np.stack([beyond_m > tolerance_m, np.abs(beyond_m) <= tolerance_m])
