"""The views cut to the object and laid side by side, as the kernels look them up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.fusion.crop import Crop, crop, pose_variances, window
from modeler.kernels import fusion
from modeler.types import Array, BoolArray, InputError, RayImage

WITNESSES = 20000  # points asked for how well the views agree
LOOKS = 10_000_000  # witnesses times views, at most
AT_ONCE = 1_000_000  # of these, for the memory it takes


@dataclass(frozen=True, eq=False)
class DepthViews:
    """Views side by side; see `modeler.kernels.fusion` for how they are looked up. Points are in the object frame."""

    index: npt.NDArray[np.int32]
    """(f, h, w) number of the surface point at a pixel, -1 = none."""
    free_m: npt.NDArray[np.float32]
    """(f, h, w) depth up to which the space along a pixel was seen empty, 0 = nothing known."""
    beside_m: npt.NDArray[np.float32]
    """(f, h, w) depth measured at pixels around which nothing of the object is seen, 0 = object near by, or nothing."""
    colour: npt.NDArray[np.uint8]
    """(f, h, w, 3) RGB."""
    coloured: BoolArray
    """(f,) which views have colour."""
    poses: Array
    """(f, 3, 4) camera_from_object."""
    lenses: Array
    """(f, 4) fx, fy, cx, cy of the pixels as stacked."""
    planes: Array
    """(f, 4) normal and offset in m of the plane on which the object stands, in the object frame; NaN = none seen."""
    points_m: Array
    """(n, 3) surface points."""
    normals: Array
    """(n, 3) unit normals."""
    weights: Array
    """(n,) 1 = seen head-on from the median distance, away from edges."""
    colours: npt.NDArray[np.uint8]
    """(n, 3) RGB of the points."""
    views: npt.NDArray[np.int64]
    """(n,) which view each point is of."""

    @property
    def lookup(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32], Array, Array, Array, Array, Array]:
        """Arguments that every kernel shares."""
        return self.index, self.free_m, self.poses, self.lenses, self.points_m, self.normals, self.weights

    def alone(self, view: int) -> DepthViews:
        """Return the stack with the images of one view only; the surface points of all stay, by their numbers."""
        here = slice(view, view + 1)
        return replace(
            self,
            index=self.index[here],
            free_m=self.free_m[here],
            beside_m=self.beside_m[here],
            colour=self.colour[here],
            coloured=self.coloured[here],
            poses=self.poses[here],
            lenses=self.lenses[here],
            planes=self.planes[here],
        )

    def carving(self, tau_m: float) -> DepthViews:
        """Return the views with empty space that ends behind what is measured beside the object, by a band ±`tau_m`.

        Empty space ends a band short of the object's surface, whose place is not known better. Something else that is
        seen tells more: right there is nothing of the object.
        """
        beside_m = np.where(self.beside_m > 0.0, self.beside_m + np.float32(1.5 * tau_m), np.float32(0.0))
        return replace(self, free_m=np.maximum(self.free_m, beside_m))


def posed(views: Mapping[int, RayImage], trajectory: Mapping[int, Array]) -> list[tuple[RayImage, Array]]:
    """Return the views that have a pose with object_from_camera, by ascending frame number.

    Raises:
        InputError: where no view has a pose, or none of them a surface point.
    """
    pairs = [(views[k], np.asarray(trajectory[k], dtype=np.float64)) for k in sorted(views) if k in trajectory]
    if not any(len(view.points_m) for view, _ in pairs):
        raise InputError("nothing to fuse: no view with surface points has a pose; check the masks and the trajectory")
    return pairs


def stack(
    pairs: list[tuple[RayImage, Array]],
    corners_m: Array,
    *,
    margin_px: int,
    min_cosine: float,
    edge_weight: float,
    covariances: Mapping[int, Array] | None = None,
) -> DepthViews:
    """Lay views side by side.

    Args:
        pairs: views with object_from_camera.
        corners_m: (8, 3) corners of the box of interest in the object frame.
        margin_px: a pixel calls space empty only as far as all pixels within this distance do.
        min_cosine: points seen at a flatter angle than this cosine are left out.
        edge_weight: factor on the weight of pixels next to a silhouette or a step in depth.
        covariances: (6, 6) of object_from_camera by frame number; poses without one count as exact.

    Raises:
        InputError: where no view sees anything of the object in the box.
    """
    windows = [window(view, se3.inverse(pose), corners_m) for view, pose in pairs]
    size = (len(pairs), *(max(where[axis].stop - where[axis].start for where in windows) for axis in range(2)))
    index = np.full(size, -1, dtype=np.int32)
    free_m, beside_m = np.zeros(size, dtype=np.float32), np.zeros(size, dtype=np.float32)
    colour = np.zeros((*size, 3), dtype=np.uint8)
    lenses, told, counts = [], [], []
    for number, ((view, pose), where) in enumerate(zip(pairs, windows, strict=True)):
        part = crop(view, where, margin_px=margin_px, min_cosine=min_cosine, edge_weight=edge_weight)
        here = number, *map(slice, part.index.shape)
        index[here] = np.where(part.index >= 0, part.index + sum(counts), -1)
        free_m[here], beside_m[here] = part.free_m, part.beside_m
        if part.colour is not None:
            colour[here] = part.colour
        lenses.append(part.lens)
        told.append(_told(part, pose, None if covariances is None else covariances.get(view.index), view.sigma_r_m))
        counts.append(len(part.points_m))
    if sum(counts) == 0:
        raise InputError("nothing to fuse: the object is seen at flat angles only; check the masks and the trajectory")
    points_m, normals, depth_m, weights, noise, colours = (np.concatenate(some) for some in zip(*told, strict=True))
    # The noise of a triangulating camera grows with z².
    weights = weights * (np.median(depth_m) / depth_m) ** 4
    trust = 1.0 / (1.0 + weights * noise)
    return DepthViews(
        index=index,
        free_m=free_m,
        beside_m=beside_m,
        colour=colour,
        coloured=np.array([view.frame.colour is not None for view, _ in pairs]),
        poses=np.stack([se3.inverse(pose)[:3] for _, pose in pairs]),
        lenses=np.stack(lenses),
        planes=np.stack([_plane(view, pose) for view, pose in pairs]),
        points_m=points_m,
        normals=normals,
        weights=weights * trust / np.median(trust),
        colours=colours,
        views=np.repeat(np.arange(len(pairs)), counts),
    )


def _plane(view: RayImage, object_from_camera: Array) -> Array:
    """Return normal and offset (4,) of a view's support plane in the object frame, NaN where there is none."""
    if view.plane is None:
        return np.full(4, np.nan)
    normal = object_from_camera[:3, :3] @ view.plane.normal
    return np.append(normal, view.plane.offset_m - normal @ object_from_camera[:3, 3])


def _told(
    part: Crop, object_from_camera: Array, covariance: Array | None, sigma_r_m: float
) -> tuple[Array, Array, Array, Array, Array, npt.NDArray[np.uint8]]:
    """Return points and normals (n, 3) in the object frame, their depths, weights and pose variances (n,), and RGB."""
    return (
        se3.transform(object_from_camera, part.points_m),
        part.normals @ object_from_camera[:3, :3].T,
        part.points_m[:, 2].copy(),  # so that the rest of the cut need not be kept
        part.weights,
        pose_variances(part, covariance, sigma_r_m),
        part.colours,
    )


def spread(views: DepthViews, limit_m: float) -> tuple[float, float] | None:
    """Return by how much views disagree about where the surface is, in m: robust standard deviations.

    They hold the noise of both views and the error of their poses. None where no two views see the same surface.

    Args:
        views: the views.
        limit_m: disagreements beyond this are two surfaces.

    Returns:
        The standard deviation between two views, and that of one view of weight 1.
    """
    witnesses = min(WITNESSES, -(-LOOKS // len(views.index)))
    chosen = np.arange(0, len(views.points_m), max(1, len(views.points_m) // witnesses))
    lookup = views.index, views.poses, views.lenses, views.points_m, views.normals
    told = []
    for some in np.array_split(chosen, -(-len(chosen) * len(views.index) // AT_ONCE)):
        distance_m, rivals = fusion.disagreements(some, views.views[some], limit_m, *lookup)
        found = rivals >= 0
        mine, theirs = views.weights[some[np.nonzero(found)[0]]], views.weights[rivals[found]]
        off_m = np.abs(distance_m[found])
        told.append((off_m, off_m / np.sqrt(1.0 / mine + 1.0 / theirs)))
    off_m, share_m = (np.concatenate(some) for some in zip(*told, strict=True))
    return (1.4826 * float(np.median(off_m)), 1.4826 * float(np.median(share_m))) if len(off_m) else None
