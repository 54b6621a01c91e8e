"""Points recognised by the shape about them, and the motions that matches of such points fix."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from modeler.types import Array, BoolArray, RayImage

_FEWEST = 9  # matches that are left: three times those that fix a motion
_NEAR = 1.5  # reaches: the distance between points nearer to each other says nothing
_NORMALS_ALIKE = 0.4  # largest difference between cosines of the angle of two normals: 25° near a right angle


def fpfh(points_m: Array, normals: Array, radius_m: float) -> Array:
    """Return the Fast Point Feature Histogram (n, 33) of each point (Rusu, Blodow and Beetz 2009).

    Args:
        points_m: (n, 3).
        normals: (n, 3) unit.
        radius_m: of the neighbourhood that it describes, by at most 100 points.
    """
    import open3d as o3d  # slow to load, and only needed here

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    search = o3d.geometry.KDTreeSearchParamHybrid(radius_m, 100)
    features = o3d.pipelines.registration.compute_fpfh_feature(cloud, search)  # pyright: ignore[reportCallIssue]
    return np.ascontiguousarray(np.asarray(features.data).T)


def mutual_matches(source: Array, target: Array) -> npt.NDArray[np.int64]:
    """Return pairs (m, 2) of rows that are each other's nearest; of all nearest targets where those are too few.

    Args:
        source: (n, k) features.
        target: (m, k) features.
    """
    squares = _squares(source, target)
    forth, back = np.argmin(squares, axis=1), np.argmin(squares, axis=0)
    pairs = np.column_stack([np.arange(len(source)), forth])
    mutual = pairs[back[forth] == pairs[:, 0]]
    return mutual if len(mutual) >= _FEWEST else pairs


def kabsch(source_m: Array, target_m: Array) -> Array:
    """Return the motions (n, 4, 4) that best carry point sets (n, k, 3) onto their partners (n, k, 3) (Kabsch 1976)."""
    source_mean, target_mean = source_m.mean(axis=1), target_m.mean(axis=1)
    spread = np.swapaxes(source_m - source_mean[:, None], 1, 2) @ (target_m - target_mean[:, None])
    left, _, right = np.linalg.svd(spread)
    handed = np.sign(np.linalg.det(left @ right))
    left[:, :, 2] *= handed[:, None]
    poses = np.broadcast_to(np.eye(4), (len(source_m), 4, 4)).copy()
    poses[:, :3, :3] = np.swapaxes(left @ right, 1, 2)
    poses[:, :3, 3] = target_mean - (poses[:, :3, :3] @ source_mean[:, :, None])[:, :, 0]
    return poses


@dataclass(frozen=True)
class FeatureMatcher:
    """Finds the motions between two views on which matches of their features agree (docs/method/search.md).

    Fast Point Feature Histograms of thinned surfaces are matched, and the matches pruned by how well they fit each
    other: in pairs, and in the company of the others (second-order compatibility: Chen, Sun, Yang and Tao, CVPR 2022).
    """

    voxel: float = 1 / 25
    """Edge of the thinning cubes, as a share of twice the object's size; with 1/18 fewer motions are found, with 1/36
    no more."""
    feature_radius: float = 5.0
    """Radius of a feature's neighbourhood, in cubes."""
    agreement: float = 2.0
    """Largest distance of points that agree, in cubes."""
    max_matches: int = 1000
    """Largest number of matches; those whose features differ least stay."""
    partners: int = 12
    """Matches that fix a motion together with the one in whose company they are."""
    min_points: int = 30
    """Fewest points of each surface after thinning; with fewer there are no motions."""

    def motions(self, source: RayImage, target: RayImage) -> tuple[Array, npt.NDArray[np.int64]]:
        """Return motions target_from_source (n, 4, 4), and how many matches agree with each (n,), most first."""
        voxel_m = 2.0 * self.voxel * max(source.size_m, target.size_m)
        none = np.zeros((0, 4, 4)), np.zeros(0, dtype=np.int64)
        if min(len(source.points_m), len(target.points_m)) < self.min_points:
            return none
        first, second = (_Described.of(view, voxel_m, self.feature_radius * voxel_m) for view in (source, target))
        if min(len(first.points_m), len(second.points_m)) < self.min_points:
            return none
        pairs = _nearest_either_way(first.features, second.features, self.max_matches)
        reach_m = self.agreement * voxel_m
        here, there = first.points_m[pairs[:, 0]], second.points_m[pairs[:, 1]]
        compatible = _as_far_apart(here, there, reach_m)
        compatible &= _as_turned(first.normals[pairs[:, 0]], second.normals[pairs[:, 1]])
        groups = _in_company(compatible, self.partners)
        motions = kabsch(here[groups], there[groups])
        carried = here @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3]
        votes = np.sum(np.sum((carried - there) ** 2, axis=2) < reach_m**2, axis=1)
        order = np.argsort(-votes, kind="stable")
        return motions[order], votes[order]


@dataclass(frozen=True, eq=False)
class _Described:
    """Points of a thinned surface, and the features by which they are recognised."""

    points_m: Array
    """(n, 3)."""
    normals: Array
    """(n, 3) unit."""
    features: Array
    """(n, 33), see `fpfh`."""

    @staticmethod
    def of(view: RayImage, voxel_m: float, radius_m: float) -> _Described:
        """Return the points of a view, one a cube, with features of neighbourhoods of a radius."""
        import open3d as o3d  # slow to load, and only needed here

        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(view.points_m))
        cloud.normals = o3d.utility.Vector3dVector(view.normals)
        cloud = cloud.voxel_down_sample(voxel_m)
        cloud.normalize_normals()
        points_m, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
        order = np.lexsort(points_m.T)  # Open3D's order is that of a hash table
        points_m, normals = points_m[order], normals[order]
        return _Described(points_m, normals, fpfh(points_m, normals, radius_m))


def _nearest_either_way(source: Array, target: Array, most: int) -> npt.NDArray[np.int64]:
    """Return pairs (m, 2) of rows of which one is the nearest to the other; at most so many, the nearest."""
    squares = _squares(source, target)
    forth = np.column_stack([np.arange(len(source)), np.argmin(squares, axis=1)])
    back = np.column_stack([np.argmin(squares, axis=0), np.arange(len(target))])
    pairs = np.unique(np.concatenate([forth, back]), axis=0)
    return pairs[np.argsort(squares[pairs[:, 0], pairs[:, 1]], kind="stable")[:most]]


def _as_far_apart(first_m: Array, second_m: Array, reach_m: float) -> BoolArray:
    """Return which matches (n, n) are as far from each other in both views, and not so near that this says nothing."""
    here_m, there_m = (
        np.sqrt(np.maximum(_squares(centred, centred), 0.0))
        for centred in (points_m - points_m.mean(axis=0) for points_m in (first_m, second_m))
    )
    return (np.abs(here_m - there_m) < reach_m) & (np.minimum(here_m, there_m) > _NEAR * reach_m)


def _as_turned(first: Array, second: Array) -> BoolArray:
    """Return which matches (n, n) have normals at like angles to each other in both views."""
    return np.abs(first @ first.T - second @ second.T) < _NORMALS_ALIKE


def _in_company(compatible: BoolArray, partners: int) -> npt.NDArray[np.int64]:
    """Return groups (k, 1 + partners) of matches: each with the compatible ones that share most compatible matches.

    Wrong matches may be compatible with each other by chance, but hardly with the same others.
    """
    links = compatible.astype(np.float32)
    shared = (links @ links) * links
    nearest = np.argsort(-shared, axis=1, kind="stable")[:, :partners]
    if nearest.shape[1] < partners:
        return np.zeros((0, 1 + partners), dtype=np.int64)
    full = np.flatnonzero(np.take_along_axis(shared, nearest[:, -1:], axis=1)[:, 0] > 0.0)
    return np.column_stack([full, nearest[full]])


def _squares(first: Array, second: Array) -> npt.NDArray[np.float32]:
    """Return the squared distances (n, m) of rows (n, k) and (m, k)."""
    a, b = first.astype(np.float32), second.astype(np.float32)
    return np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2.0 * a @ b.T
