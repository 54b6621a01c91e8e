"""Where one model lies on another, when nothing is known of the motion between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.fusion import cloud
from modeler.fusion.volume import FusionVolume
from modeler.types import Array, ObjectModel


@dataclass(frozen=True, eq=False)
class Match:
    """One way to lay a model on another."""

    target_from_source: Array
    """(4, 4) object frame of the source to that of the target."""
    score: float
    """At most 1: share of the surface that the other model's views see in its place, less what they see empty."""


@dataclass(frozen=True)
class Matcher:
    """Lay two models on each other from every side and keep what the views of both agree with.

    From rotations spread evenly over all there are, points are drawn to the other model's surface (point to plane);
    what comes out is judged by the views: surface that a view of the other model sees in its place counts for a match,
    in the same colour more, surface that it sees through against.
    """

    rotations: int = 400
    """Starts."""
    points: int = 300
    """Points of the source that are drawn to the target."""
    witnesses: int = 1500
    """Points of each model that are judged."""
    steps: int = 15
    """Of drawing, with a reach that shrinks from a third of the object to a fiftieth."""
    judged: int = 40
    """Best starts that are judged by the views."""
    apart_rad: float = 0.25
    """Matches closer than this in rotation are one."""
    colour_level: float = 40.0
    """Difference of colours at which they count as different."""

    def matches(
        self, target: FusionVolume, source: FusionVolume, models: tuple[ObjectModel, ObjectModel]
    ) -> list[Match]:
        """Return different ways to lay the source on the target, best first.

        Args:
            target: views of one model.
            source: views of the other.
            models: the models of both, target first.
        """
        extent_m = float(np.linalg.norm(np.ptp(models[0].points_m, axis=0)))
        target_m, target_normals = _even(models[0], 0.02 * extent_m)
        source_m, source_normals = _even(models[1], 0.02 * extent_m)
        chosen = np.linspace(0, len(source_m) - 1, min(self.points, len(source_m))).astype(np.int64)
        tree = KDTree(target_m)
        drawn = []
        for turn in _spread(self.rotations):
            start = np.eye(4)
            start[:3, :3] = turn
            start[:3, 3] = target_m.mean(axis=0) - turn @ source_m.mean(axis=0)
            drawn.append(
                self._drawn(start, tree, target_normals, source_m[chosen], source_normals[chosen], extent_m=extent_m)
            )
        drawn.sort(key=lambda found: -found[1])
        found: list[Match] = []
        for pose, _ in drawn:
            if len(found) == self.judged:
                break
            if all(_angle(pose, other.target_from_source) > 0.3 * self.apart_rad for other in found):
                found.append(Match(pose, self.score(pose, target, source, models)))
        found.sort(key=lambda match: -match.score)
        distinct: list[Match] = []
        for match in found:
            if all(_angle(match.target_from_source, o.target_from_source) > self.apart_rad for o in distinct):
                distinct.append(match)
        return distinct

    def score(
        self,
        target_from_source: Array,
        target: FusionVolume,
        source: FusionVolume,
        models: tuple[ObjectModel, ObjectModel],
    ) -> float:
        """Return how well the views of both models agree with one lying on the other so, at most 1."""
        forth = self._agreement(models[1], target_from_source, target)
        back = self._agreement(models[0], se3.inverse(target_from_source), source)
        return 0.5 * (forth + back)

    def _agreement(self, model: ObjectModel, volume_from_model: Array, volume: FusionVolume) -> float:
        """Return what the views of one model say of the surface of the other, on average."""
        chosen = np.linspace(0, len(model.points_m) - 1, min(self.witnesses, len(model.points_m))).astype(np.int64)
        points = se3.transform(volume_from_model, model.points_m[chosen])
        support = volume.support(points, model.normals[chosen] @ volume_from_model[:3, :3].T)
        worth = np.where(support.views > 0, 1.0, 0.0)
        if model.colours is not None:
            off = np.linalg.norm(support.colours.astype(float) - model.colours[chosen].astype(float), axis=1)
            alike = np.exp(-((off / self.colour_level) ** 2))
            worth = np.where((support.views > 0) & support.coloured, 0.5 + 0.5 * alike, worth)
        return float(np.mean(worth - ((support.views == 0) & (support.emptiness > 0.0))))

    def _drawn(
        self, pose: Array, tree: KDTree, target_normals: Array, points_m: Array, normals: Array, *, extent_m: float
    ) -> tuple[Array, float]:
        """Return a motion drawn to the target's surface, and the share of the points that lie on it."""
        target_m = np.asarray(tree.data)
        share = 0.0
        for reach_m in extent_m * np.geomspace(0.33, 0.02, self.steps):
            moved, turned = se3.transform(pose, points_m), normals @ pose[:3, :3].T
            off_m, nearest = (np.atleast_1d(found) for found in tree.query(moved, distance_upper_bound=reach_m))
            kept = np.isfinite(off_m)
            kept[kept] = np.sum(turned[kept] * target_normals[nearest[kept]], axis=1) > 0.4
            share = float(np.mean(kept))
            if np.count_nonzero(kept) < 12:
                return pose, 0.0
            aim, facing = target_m[nearest[kept]], target_normals[nearest[kept]]
            centre = moved[kept].mean(axis=0)
            rows = np.concatenate([np.cross(moved[kept] - centre, facing), facing], axis=1)
            gap = np.sum(facing * (aim - moved[kept]), axis=1)
            # A little damping: round and flat surfaces leave directions open.
            normal = rows.T @ rows + 1e-3 * np.count_nonzero(kept) * np.diag([1e-2 * extent_m**2] * 3 + [1.0] * 3)
            xi = np.linalg.solve(normal, rows.T @ gap)
            pose = se3.translation(centre) @ se3.exp(xi) @ se3.translation(-centre) @ pose
        return pose, share


def _even(model: ObjectModel, voxel_m: float) -> tuple[Array, Array]:
    """Return points (n, 3) and normals (n, 3) of a model's cloud, one a voxel."""
    return cloud.thinned(
        model.points_m, model.normals, np.ones(len(model.points_m)), voxel_m=voxel_m, max_voxels=128**3
    )


def _spread(count: int) -> Array:
    """Return rotations (n, 3, 3) spread evenly over all (Alexa 2022, "Super-Fibonacci spirals")."""
    steps = np.arange(count) + 0.5
    small, large = np.sqrt(steps / count), np.sqrt(1.0 - steps / count)
    first, second = 2.0 * np.pi * steps / np.sqrt(2.0), 2.0 * np.pi * steps / 1.533751168755204288118041
    quaternions = np.stack(
        [small * np.sin(first), small * np.cos(first), large * np.sin(second), large * np.cos(second)], axis=1
    )
    return Rotation.from_quat(quaternions).as_matrix()


def _angle(one: Array, other: Array) -> float:
    """Return the angle in rad between two motions."""
    return float(se3.rotation_angle(se3.inverse(one) @ other))
