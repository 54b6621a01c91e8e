"""Planes in depth images: robust fits with their uncertainty, dominant planes, and the support of an object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, TypeVar, cast

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from modeler.segmentation.depth_images import CELL_PX, FEW, LEAST_PIXELS, MOSTLY, NEARLY_ALL, DepthNoise
from modeler.significance import SIGMAS
from modeler.types import Array, BoolArray, Float32Array, Plane

Real = TypeVar("Real", bound=np.floating[Any])
# Invisible in the residuals: the axes of turntables and the normals of their plates, measured with three consumer
# cameras, differ by 3, 4 and 13 mrad.
_SYSTEMATIC_TILT_RAD = 0.005
_SYSTEMATIC_SHARE = 0.0015  # error of the plane's distance that its residuals do not show, and of the depth's scale
_BLOCKS_ACROSS = (3, 6, 12)
"""Numbers of blocks along the longer side: correlation lengths that are tried. Halved or doubled, masks of ten
sequences are the same."""
_MAX_HYPOTHESES = 200  # cells that are tried, evenly: one of a plane of `LEAST_SHARE`
_MOST_PLANES = 10  # at most, of a scene; without the limit, masks of the airplane have an IoU of 0.995 with these
LEAST_SHARE: Final = 0.006
"""Share of an image that a dominant plane covers at least."""
_UPRIGHT = 0.2
"""Least upward (-y) component of the normal of a plane that faces up: walls lean by less than 12°. Halved or doubled,
masks of four captures are the same."""
_SAME_DIRECTION = np.cos(np.radians(20.0))
"""Between the normals of a cell and its plane; with 10 or 40°, masks of a plant have an IoU of 0.993 and more with
these."""
_LEVEL = np.cos(np.radians(2.0))
"""Planes that tilt by less are kept level; without, masks of cap have an IoU of 0.993 with these."""
_LEVEL_BONUS = 1.5
"""Factor on the votes for level planes; at 0.75, masks of a plant have an IoU of 0.90 with these, at 3 1.00."""
_PARALLEL = np.cos(np.radians(6.0))
"""Between the normals of parallel planes, given the accuracy of small ones; with 3 or 12°, masks of four captures are
the same."""
_REACH_SIZES = 1.5
"""Radius of an object's surroundings, in sizes of the object; with half, five of a plant's six frames have another
outcome, with twice masks have an IoU of 0.995 and more with these."""
_MAX_GROUND = 6000  # points; more do not help, since their errors are correlated


def heights(points: npt.NDArray[Real], plane: Array) -> npt.NDArray[Real]:
    """Return the heights (...) of points (..., 3) above a plane (4,) of normal and offset, in the points' precision."""
    return cast("npt.NDArray[Real]", points @ plane[:3].astype(points.dtype) + points.dtype.type(plane[3]))


def fit_plane(
    points: Array, *, sigma_m: Array | float, guess: Array | None = None, foot_m: Array | None = None
) -> Plane | None:
    """Fit the plane that most of the points lie on, by trimmed least squares.

    Depth errors are correlated between pixels, so thousands of points are worth far fewer. The covariance is the
    sandwich estimator over spatial blocks (Liang and Zeger, Biometrika 1986), with the block size that gives most, and
    what a slow warp adds; on top comes what no residual can show, the camera's calibration.

    Args:
        points: (n, 3) in camera coordinates, m.
        sigma_m: (n,) or one number: noise of the points across the plane; points beyond three of them are left out.
        guess: (4,) normal and offset near which the plane lies; None = start from all points.
        foot_m: (3,) where the object stands, for which the offset's uncertainty holds; None = the points' centre.

    Returns:
        The plane with its normal towards the camera, or None where too few points agree or they lie on a line.
    """
    if len(points) < LEAST_PIXELS:
        return None
    sigma = np.broadcast_to(np.asarray(sigma_m, dtype=np.float64), len(points))
    found = _trimmed(points, sigma, guess)
    if found is None:
        return None
    plane, inlier = found
    near, weight = points[inlier], sigma[inlier] ** -2.0
    centre = np.average(near, axis=0, weights=weight)
    axes = np.linalg.svd(plane[None, :3])[2][1:]
    uv = (near - centre) @ axes.T
    residual = heights(near, plane)
    narrow = np.sqrt(max(np.linalg.eigvalsh(np.cov(uv.T))[0], 0.0))
    foot = centre if foot_m is None else foot_m
    systematic_m = _SYSTEMATIC_SHARE * float(np.linalg.norm(foot))
    if narrow < max(SIGMAS * residual.std(), systematic_m):
        return None
    covariance = _sandwich(uv, residual, weight) + _warp(uv, residual, weight)
    at_foot = np.append((foot - centre) @ axes.T, 1.0)
    tilt = np.linalg.eigvalsh(covariance[:2, :2])[-1] + _SYSTEMATIC_TILT_RAD**2
    offset = at_foot @ covariance @ at_foot + systematic_m**2
    return Plane(plane[:3], float(plane[3]), float(np.sqrt(tilt)), float(np.sqrt(offset)))


def _trimmed(points: Array, sigma: Array, guess: Array | None) -> tuple[Array, BoolArray] | None:
    """Return the plane (4,) and the inliers (n,) of points (n, 3); None with too few inliers."""
    weight, widths = sigma**-2.0, [1.0] * 4
    if guess is None:
        # Trim from the outside in: start at the scale the points show, end at the noise.
        plane = least_squares(points, weight)
        shown = 1.5 * float(np.median(np.abs(heights(points, plane)) / sigma))
        widths = [max(1.0, shown / 2**k) for k in range(6)] + widths
    else:
        plane = np.asarray(guess, dtype=np.float64)
    inlier = np.zeros(len(points), dtype=np.bool_)
    for width in widths:
        inlier = np.abs(heights(points, plane)) < SIGMAS * width * sigma
        if np.count_nonzero(inlier) < LEAST_PIXELS:
            return None
        plane = least_squares(points[inlier], weight[inlier])
    return plane, inlier


def least_squares(points: Array, weight: Array) -> Array:
    """Return the plane (4,) nearest to points (n, 3) with weights (n,), its normal towards the camera."""
    centre = weight @ points / weight.sum()
    centred = points - centre
    normal = np.linalg.eigh((centred * weight[:, None]).T @ centred)[1][:, 0]
    offset = -float(normal @ centre)
    return np.append(normal, offset) * (1.0 if offset > 0.0 else -1.0)


def _sandwich(uv: Array, residual: Array, weight: Array) -> Array:
    """Return the covariance (3, 3) of slopes and height at the origin due to errors correlated over blocks.

    Args:
        uv: (n, 2) coordinates of the points in the plane.
        residual: (n,) their heights above it.
        weight: (n,) of the points.
    """
    design = np.column_stack([uv, np.ones(len(uv))])
    bread = np.linalg.inv((design * weight[:, None]).T @ design)
    score = design * (weight * residual)[:, None]
    covariance = bread @ (score.T @ score) @ bread
    low, side = uv.min(axis=0), float(np.ptp(uv, axis=0).max())
    for across in _BLOCKS_ACROSS:
        cell = np.minimum((uv - low) * (across / side), across - 1).astype(np.int64)
        block = cell[:, 0] * across + cell[:, 1]
        blocks = int(np.count_nonzero(np.bincount(block)))
        if blocks <= 3:  # as many as a plane has parameters
            continue
        sums = np.stack([np.bincount(block, score[:, k]) for k in range(3)])
        other = bread @ (sums @ sums.T) @ bread * (blocks / (blocks - 3))
        covariance = other if np.trace(other[:2, :2]) > np.trace(covariance[:2, :2]) else covariance
    return covariance


def _warp(uv: Array, residual: Array, weight: Array) -> Array:
    """Return the covariance (3, 3) of slopes and height at the origin due to a warp of the whole surface.

    Errors that vary as slowly as the plane itself are absorbed by it. The next slowest, quadratic ones show, and slow
    errors are no smaller than faster ones: what they have in each of their three modes is taken for the plane's three.
    """
    u, v = (uv / uv.std(axis=0)).T
    modes = np.column_stack([np.ones(len(u)), u, v, u * u, u * v, v * v]) * np.sqrt(weight / weight.sum())[:, None]
    basis = np.linalg.qr(modes)[0][:, 3:]
    power = float(np.mean((basis.T @ (residual * np.sqrt(weight / weight.sum()))) ** 2))
    return power * np.diag(np.append(1.0 / uv.var(axis=0), 1.0))


@dataclass(frozen=True, eq=False)
class _Cells:
    """The flat cells of an image."""

    mean: Array
    """(n, 3)."""
    normal: Array
    """(n, 3) towards the camera."""
    count: Array
    """(n,) points."""
    tolerance_m: Array
    """(n,)."""

    @property
    def weight(self) -> Array:
        """Weights (n,) in least squares."""
        return self.count / self.tolerance_m**2

    def agree(self, at: Array, normals: Array) -> BoolArray:
        """Return which cells (n,) are part of planes (m,) through points (m, 3) with normals (m, 3), as (n, m)."""
        off = self.mean @ normals.T - np.einsum("mi,mi->m", at, normals)
        return (np.abs(off) < self.tolerance_m[:, None]) & (self.normal @ normals.T > _SAME_DIRECTION)

    def on(self, plane: Array, width: float) -> BoolArray:
        """Return which cells (n,) are part of a plane (4,), within a multiple of the tolerance."""
        near = np.abs(heights(self.mean, plane)) < width * self.tolerance_m
        return near & (self.normal @ plane[:3] > _SAME_DIRECTION)


def dominant_planes(
    points: Float32Array, noise: DepthNoise, *, least_share: float = LEAST_SHARE, prefer_level: bool = False
) -> Array:
    """Find the planes that cover most of an image, largest first.

    Flat cells of the image propose planes, the cells vote, and the winner's cells are taken out. Nothing is random.

    Args:
        points: (h, w, 3) image of points in camera coordinates, m; NaN where nothing was measured.
        noise: of the depth camera.
        least_share: share of the image that a plane must cover.
        prefer_level: once a plane that faces up is found, prefer others parallel to it: a small plate half hidden by
            what stands on it is level, too.

    Returns:
        (k, 4) unit normals towards the camera and offsets.
    """
    cells = _flat_cells(points, noise)
    least = max(1.0, least_share * points.shape[0] * points.shape[1])
    free = np.ones(len(cells.mean), dtype=np.bool_)
    level: Array | None = None
    planes: list[Array] = []
    while len(planes) < _MOST_PLANES and cells.count[free].sum() >= least:
        plane = _largest(cells, free, level)
        taken = free & cells.on(plane, 2.0)
        if cells.count[taken].sum() < least:
            break
        planes.append(plane)
        free &= ~taken
        if prefer_level and level is None and upright(plane[None])[0]:
            level = plane[:3]
    return np.array(planes).reshape(-1, 4)


def choose_support(planes: Array, body: Float32Array, ground: Float32Array, noise: DepthNoise) -> Array | None:
    """Choose the plane that an object stands on.

    That is the highest plane with almost all of the object above it that is seen near the object and not far below it.
    Planes parallel to the first that faces up in the image go before others that face up, and those before the rest: a
    carton does not stand on the wall behind it. Planes that face down, as those walls do that a camera above sees, hold
    only what reaches them: the camera may hang upside down.

    Args:
        planes: (k, 4) normals and offsets, largest first.
        body: (n, 3) points of the object.
        ground: (m, 3) points around the object.
        noise: of the depth camera.

    Returns:
        (4,) normal and offset, or None if nothing holds the object.
    """
    if len(body) == 0:
        return None
    size = extent(body)[1]
    body = body[:: 1 + len(body) // _MAX_GROUND]
    tolerance = noise.tolerance_m(body[:, 2])
    facing = upright(planes)
    rank = facing.astype(np.int64)
    if facing.any():
        rank += facing & parallel(planes, planes[facing.argmax()])
    best, found = (-1, 0.0), None
    for plane, grade in zip(planes, rank, strict=True):
        height = heights(body, plane)
        seen = np.count_nonzero(np.abs(heights(ground, plane)) < np.median(tolerance))
        lowest, low = np.percentile(height, [1, 5])
        # Bodies that overhang are seen from 0.7 of their size above the support, balls from 0.3.
        holds = np.mean(height > -tolerance) > NEARLY_ALL and low < size
        # 0.04 to 0.06 of the size are left above a support, 0.2 before a near wall.
        holds &= lowest < FEW * size or plane[1] < _UPRIGHT
        merit = (int(grade), -float(np.median(height)))
        if seen >= LEAST_PIXELS and holds and merit > best:
            best, found = merit, plane
    return found


def fit_beside(ground: Float32Array, body: Float32Array, *, guess: Array, noise: DepthNoise) -> Plane | None:
    """Fit the support of an object.

    Args:
        ground: (m, 3) points around the object.
        body: (n, 3) points of the object.
        guess: (4,) the approximate support.
        noise: of the depth camera.
    """
    ground = ground[np.abs(heights(ground, guess)) < noise.tolerance_m(ground[:, 2])]
    points = ground[:: 1 + len(ground) // _MAX_GROUND].astype(np.float64)
    centre = extent(body)[0]
    foot = centre - guess[:3] * float(heights(centre, guess))
    return fit_plane(points, sigma_m=noise.sigma_m(points[:, 2]), guess=guess, foot_m=foot)


def surroundings(points: Float32Array, found: BoolArray) -> BoolArray:
    """Return the pixels (h, w) around an object, beyond its outline, where its support may be seen.

    Args:
        points: (h, w, 3) image of points.
        found: (h, w) the object.
    """
    body = points[found & np.isfinite(points[..., 2])]
    if len(body) == 0:
        return np.zeros_like(found)
    centre, size = extent(body)
    square = np.zeros(found.shape, dtype=np.float32)
    for axis in range(3):
        square += (points[..., axis] - np.float32(centre[axis])) ** 2
    return ~outline(found) & (square < (_REACH_SIZES * size) ** 2)


def outline(found: BoolArray) -> BoolArray:
    """Return the pixels (h, w) within 2 px of a mask, and those enclosed: the floor of a dish is not its support."""
    near = ndimage.binary_dilation(found, iterations=2)
    return np.asarray(ndimage.binary_fill_holes(near), dtype=np.bool_)


def extent(points: Float32Array) -> tuple[Array, float]:
    """Return the median (3,) of points (n, 3) and the diagonal of the box that contains most of them."""
    low, centre, high = np.percentile(points, [5.0, 50.0, 95.0], axis=0).astype(np.float64)
    return centre, float(np.linalg.norm(high - low))


def upright(planes: Array) -> BoolArray:
    """Return which planes (k, 4) face up in the image."""
    return -planes[:, 1] > _UPRIGHT


def parallel(planes: Array, plane: Array) -> BoolArray:
    """Return which planes (k, 4) are parallel to one (4,), and face the same way."""
    return planes[:, :3] @ plane[:3] > _PARALLEL


def _largest(cells: _Cells, free: BoolArray, level: Array | None) -> Array:
    """Return the plane (4,) that most of the free cells are part of; planes normal to `level` (3,) get a bonus."""
    tried = np.flatnonzero(free)
    tried = tried[:: 1 + len(tried) // _MAX_HYPOTHESES]
    normals = [cells.normal[tried]] + ([] if level is None else [np.tile(level, (len(tried), 1))])
    agree = np.concatenate([cells.agree(cells.mean[tried], normal) for normal in normals], axis=1) & free[:, None]
    merit = cells.count @ agree
    merit[len(tried) :] *= _LEVEL_BONUS
    best = int(merit.argmax())
    first = inlier = agree[:, best]
    plane = np.append(cells.normal[tried[best % len(tried)]], np.inf)
    for _ in range(4):
        if np.count_nonzero(inlier) < 3:
            break
        plane = least_squares(cells.mean[inlier], cells.weight[inlier])
        inlier = free & cells.on(plane, 1.0)
    if level is not None and best >= len(tried) and plane[:3] @ level < _LEVEL:
        # Objects on the plane tilt the fit: keep it level.
        plane = np.append(level, -float(np.average(cells.mean[first] @ level, weights=cells.weight[first])))
    return plane


def _flat_cells(points: Float32Array, noise: DepthNoise) -> _Cells:
    """Return the flat cells of an image of points (h, w, 3)."""
    rows, columns = points.shape[0] // CELL_PX, points.shape[1] // CELL_PX
    block = points[: rows * CELL_PX, : columns * CELL_PX].reshape(rows, CELL_PX, columns, CELL_PX, 3)
    block = block.swapaxes(1, 2).reshape(rows * columns, CELL_PX**2, 3)
    finite = np.isfinite(block[..., 2])
    kept = finite.sum(axis=1) >= MOSTLY * CELL_PX**2
    block, finite = block[kept].astype(np.float64), finite[kept]
    count = finite.sum(axis=1).astype(np.float64)
    block[~finite] = 0.0
    mean = block.sum(axis=1) / count[:, None]
    centred = (block - mean[:, None]) * finite[..., None]
    values, vectors = np.linalg.eigh(centred.swapaxes(1, 2) @ centred / count[:, None, None])
    flat = np.sqrt(np.maximum(values[:, 0], 0.0)) < noise.tolerance_m(mean[:, 2])
    normal = vectors[flat, :, 0]
    normal *= np.where(np.einsum("ni,ni->n", normal, mean[flat]) > 0.0, -1.0, 1.0)[:, None]
    return _Cells(mean[flat], normal, count[flat], noise.tolerance_m(mean[flat, 2]))
