"""Methods beside the tracker: the model's cloud found in the object's points, from any pose or from the last one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.util import find_spec
from typing import Any, Final, final

import numpy as np

from modeler import se3
from modeler.baselines import FpfhRegistrar, IcpRegistrar
from modeler.baselines.clouds import Cloud
from modeler.baselines.fpfh import REFINEMENT
from modeler.fusion.paint import SurfacePoints
from modeler.types import Array, ObjectModel, RayImage

_FITNESS: Final = 0.8  # of inliers, above which they say that the object is there: the best of a few tried
_POINTS: Final = 20_000  # of the model's cloud
_PAIRS: Final = (0.08, 0.05)  # sampling and distance steps of point pairs, in diameters; 5 s a frame, at 0.04 a minute
_SCENE_STEP: Final = 0.2  # every fifth point of the scene is a reference: OpenCV's default
_BEST: Final = 10  # of the poses of point pairs, refined
_NEIGHBOURS: Final = 10  # of a point, from which small_gicp estimates its plane


@final
@dataclass(frozen=True, eq=False)
class ModelCloud:
    """A model as the baselines have it."""

    model: ObjectModel
    diameter_m: float

    @cached_property
    def cloud(self) -> Cloud:
        """Points drawn evenly from the surface that was seen."""
        model, sigmas_m = self.model, self.model.vertex_sigmas_m
        seen = np.ones(len(model.vertices_m), bool) if sigmas_m is None else np.isfinite(sigmas_m)
        kept = model.triangles[seen[model.triangles].all(axis=1)]
        drawn = SurfacePoints.draw(model.vertices_m, kept, _POINTS, np.random.default_rng(0))
        one, two, three = np.moveaxis(model.vertices_m[drawn.corners], 1, 0)
        normals = np.cross(two - one, three - one)
        return Cloud(drawn.of(model.vertices_m), normals / np.linalg.norm(normals, axis=1, keepdims=True))

    @cached_property
    def detector(self) -> Any:
        """OpenCV's detector of point pairs, trained."""
        import cv2  # pyright: ignore[reportMissingImports]

        found = cv2.ppf_match_3d.PPF3DDetector(*_PAIRS)
        found.trainModel(_rows(self.cloud))
        return found


@final
@dataclass(frozen=True)
class Answer:
    """What a method says."""

    camera_from_model: Array
    there: bool


def fpfh_icp(thing: ModelCloud, view: RayImage, last: Array) -> Answer | None:
    """Return FPFH with RANSAC, then ICP; the last pose is not used."""
    clouds = Cloud.of(view), thing.cloud
    coarse = FpfhRegistrar().search(*clouds, np.eye(4), np.random.default_rng(0))
    fit = None if coarse is None else REFINEMENT.refine(*clouds, coarse.target_from_source)
    return None if fit is None else Answer(se3.inverse(fit.target_from_source), fit.fitness > _FITNESS)


def ppf_icp(thing: ModelCloud, view: RayImage, last: Array) -> Answer | None:
    """Return point pair features (Drost et al. 2010; OpenCV's), the best poses refined by ICP; the last is not used."""
    clouds = Cloud.of(view), thing.cloud
    found = thing.detector.match(_rows(clouds[0]), _SCENE_STEP, _PAIRS[1])
    fits = [IcpRegistrar().refine(*clouds, se3.inverse(np.asarray(one.pose))) for one in found[:_BEST]]
    kept = [fit for fit in fits if fit is not None]
    if not kept:
        return None
    best = max(kept, key=lambda fit: fit.fitness)
    return Answer(se3.inverse(best.target_from_source), best.fitness > _FITNESS)


def icp(thing: ModelCloud, view: RayImage, last: Array) -> Answer | None:
    """Return point-to-plane ICP from the last pose."""
    fit = IcpRegistrar().refine(Cloud.of(view), thing.cloud, se3.inverse(last))
    return None if fit is None else Answer(se3.inverse(fit.target_from_source), fit.fitness > _FITNESS)


def small_gicp(thing: ModelCloud, view: RayImage, last: Array) -> Answer | None:
    """Return GICP of small_gicp from the last pose."""
    import small_gicp

    voxel_m = thing.diameter_m / 64.0  # the finest of our own ICP
    (target, tree), (source, _) = (
        small_gicp.preprocess_points(points_m, voxel_m, _NEIGHBOURS)
        for points_m in (thing.cloud.points_m, view.points_m)
    )
    if min(target.size(), source.size()) <= _NEIGHBOURS:
        return None
    fit = small_gicp.align(
        target, source, tree, se3.inverse(last), "GICP", max_correspondence_distance=8.0 * voxel_m, num_threads=1
    )
    return Answer(se3.inverse(fit.T_target_source), fit.num_inliers / source.size() > _FITNESS)


Method = Callable[[ModelCloud, RayImage, Array], Answer | None]


@cache
def methods(*, local: bool) -> dict[str, Method]:
    """Return the methods by name, those whose packages are installed.

    Args:
        local: those that start from the last pose, or those that do not.
    """
    if local:
        return {"icp from the last pose": icp, "small_gicp from the last pose": small_gicp}
    return {"fpfh-icp": fpfh_icp} | ({"ppf-icp": ppf_icp} if find_spec("cv2") else {})


def _rows(cloud: Cloud) -> np.ndarray:
    """Return points and normals (n, 6) in single precision."""
    return np.ascontiguousarray(np.hstack([cloud.points_m, cloud.normals]), dtype=np.float32)
