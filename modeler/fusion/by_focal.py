"""Surface uncertainty due to the focal length, which moves the measurements and the poses of all views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modeler import se3
from modeler.fusion.fuser import Fuser
from modeler.types import ObjectModel, Solution

_MAX_VIEWS = 60  # spread over a run: more are redundant


def widened(model: ObjectModel, solution: Solution) -> ObjectModel:
    """Return a model whose vertex uncertainty includes that of the focal length (method, eq. 12.9).

    Args:
        model: fused under the solution's poses.
        solution: with the estimate of the focal length; without one, the model is unchanged.
    """
    focal, sigmas_m = solution.focal, model.vertex_sigmas_m
    frames = [] if focal is None else [frame for frame in solution.trajectory if frame in focal.by_focal]
    if focal is None or sigmas_m is None or not frames:
        return model
    vertices_m, normals = model.vertices_m, model.vertex_normals
    total, weight = np.zeros(len(vertices_m)), np.zeros(len(vertices_m))
    for place in np.unique(np.linspace(0, len(frames) - 1, _MAX_VIEWS).astype(np.int64)).tolist():
        object_from_camera, by_focal = solution.trajectory[frames[place]], focal.by_focal[frames[place]]
        points_m = se3.transform(se3.inverse(object_from_camera), vertices_m)
        drawn = (points_m * (-1.0, -1.0, 0.0)) @ object_from_camera[:3, :3].T
        moved = drawn + np.cross(by_focal[:3], vertices_m) + by_focal[3:]
        rays = object_from_camera[:3, 3] - vertices_m
        cosines = np.sum(normals * rays, axis=1) / np.linalg.norm(rays, axis=1)
        share = np.where(cosines >= Fuser.min_cosine, cosines, 0.0)  # what contributes to the mesh
        total += share * np.sum(normals * moved, axis=1)
        weight += share
    by_normal = np.divide(total, weight, out=np.zeros(len(total)), where=weight > 0.0)
    return replace(model, vertex_sigmas_m=np.hypot(sigmas_m, focal.sigma * by_normal))
