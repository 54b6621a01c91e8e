"""The stages of fusion: models of the same views with the same poses."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.spatial import KDTree

from modeler import se3
from modeler.evaluation import rotation_error_deg
from modeler.fusion import Fuser, Matcher, SymmetryFinder
from modeler.types import Array, Camera, Float32Array, ObjectModel
from studies.ablation.constants.inputs import Figures, Posed, digest

NEAR_M: Final = 0.005
"""Distance of surface within which a point counts as modelled."""


def surface(posed: Posed) -> Figures:
    """Fuse all views but every fourth, and compare the mesh with those left out."""
    frames = sorted(posed.trajectory)
    out = frames[1::4]
    rest = {frame: posed.views[frame] for frame in frames if frame not in out}
    model = Fuser().fuse(rest, posed.trajectory, posed.covariances)
    tree = KDTree(model.vertices_m)
    apart, missing, through = [], [], []
    for frame in out:
        view, pose = posed.views[frame], posed.trajectory[frame]
        points_m = se3.transform(pose, view.points_m)
        near_m, near = tree.query(points_m)
        along_m = np.abs(np.sum((points_m - model.vertices_m[near]) * model.vertex_normals[near], axis=1))
        apart.append(float(np.median(along_m[near_m < NEAR_M])))
        missing.append(float(np.mean(near_m >= NEAR_M)))
        through.append(
            _in_front(view.frame.depth_m, view.frame.camera, se3.transform(se3.inverse(pose), model.vertices_m))
        )
    return {
        "digest": _digest_of(model),
        "apart_mm": 1e3 * float(np.mean(apart)),
        "missing": float(np.mean(missing)),
        "through": float(np.mean(through)),
        "vertices": float(len(model.vertices_m)),
    }


def _in_front(depth_m: Float32Array, camera: Camera, vertices_m: Array) -> float:
    """Return the share of vertices that a view sees in front of what it measures."""
    columns = np.rint(camera.fx * vertices_m[:, 0] / vertices_m[:, 2] + camera.cx).astype(int)
    rows = np.rint(camera.fy * vertices_m[:, 1] / vertices_m[:, 2] + camera.cy).astype(int)
    inside = (columns >= 0) & (rows >= 0) & (columns < camera.width) & (rows < camera.height)
    measured_m = depth_m[rows[inside], columns[inside]]
    return float(np.count_nonzero(vertices_m[inside, 2] + NEAR_M < measured_m)) / max(len(vertices_m), 1)


def _digest_of(model: ObjectModel) -> str:
    parts = (
        model.vertices_m,
        model.triangles,
        model.vertex_colours,
        model.vertex_sigmas_m,
        model.points_m,
        model.colours,
    )
    return digest(parts).hex()[:12]


def preview(posed: Posed) -> Figures:
    """Make the preview of a run in progress."""
    model = Fuser().preview(posed.views, posed.trajectory)
    assert model is not None
    return {"digest": _digest_of(model), "vertices": float(len(model.vertices_m))}


def closed(posed: Posed) -> Figures:
    """Close the mesh of all views where none saw surface."""
    model = Fuser().volume(posed.views, posed.trajectory, posed.covariances).model(watertight=True)
    volume_m3 = float(np.sum(np.linalg.det(model.vertices_m[model.triangles]))) / 6.0
    return {"digest": _digest_of(model), "vertices": float(len(model.vertices_m)), "volume_cm3": 1e6 * volume_m3}


def symmetries(posed: Posed) -> Figures:
    """Find the symmetries of a coarse model."""
    model = Fuser(max_voxels=48**3).fuse(posed.views, posed.trajectory, posed.covariances)
    found = SymmetryFinder().find_in(model, np.array([0.0, -1.0, 0.0]))
    of_colour = found.with_colour
    counts = [len(found.discrete), len(found.continuous), len(found.seen_in_part)]
    counts += [] if of_colour is None else [len(of_colour.discrete), len(of_colour.continuous)]
    return {"digest": digest((found.discrete, found.tolerance_m, counts)).hex()[:12], "found": str(counts)}


def alignment(posed: Posed) -> Figures:
    """Align the models of the first and the last two thirds of the views."""
    frames = sorted(posed.trajectory)
    parts = []
    for some in (frames[: 2 * len(frames) // 3], frames[len(frames) // 3 :]):
        volume = Fuser(max_voxels=48**3).volume({f: posed.views[f] for f in some}, posed.trajectory)
        parts.append((volume, volume.model()))
    (target, one), (source, other) = parts
    matches = Matcher().matches(target, source, (one, other))
    best = matches[0]
    return {
        "digest": digest([(match.target_from_source, match.score) for match in matches]).hex()[:12],
        "error_deg": float(rotation_error_deg(best.target_from_source, np.eye(4))),
        "matches": float(len(matches)),
    }
