"""A run read back from what it left on disk: edges and poses from its report, the mesh from its PLY file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from modeler.types import Array, Edge, EdgeKind, InputError, Mode, ObjectModel, Outcome, PoseGaussian, Posterior


def edges_of(report: Mapping[str, Any]) -> tuple[Edge, ...]:
    """Return the edges in a report, in order, as they were judged; their posteriors are without samples."""
    return tuple(
        Edge(_posterior(record), _kind(record), record["accepted"], record.get("reason", ""))
        for record in report["edges"]
    )


def poses_of(report: Mapping[str, Any]) -> dict[int, PoseGaussian]:
    """Return object_from_camera of the accepted frames in a report, by frame number."""
    return {
        record["id"]: PoseGaussian(_matrix(record["object_from_camera"], 4), _matrix(record["covariance"], 6))
        for record in report["poses"]
    }


def read_model(path: Path) -> ObjectModel:
    """Return the mesh in a PLY file as a model without a cloud.

    Args:
        path: as `modeler build` writes it; colours, `views` and `sigma_m` where it has them.

    Raises:
        InputError: where there is none, it cannot be read or has no triangles.
    """
    import trimesh
    from trimesh.visual import ColorVisuals

    if not path.is_file():
        raise InputError(f"{path}: there is no such mesh; give a run folder in which `modeler build` has finished")
    try:
        mesh = trimesh.load(path, process=False)  # load_mesh would drop the normals
    except Exception as error:  # trimesh lets whatever its parser trips over through
        raise InputError(f"{path}: not a mesh that can be read ({error}); build the model again") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{path}: holds no triangles; more views are needed for a surface")
    columns = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data", {})
    names = columns.dtype.names or () if isinstance(columns, np.ndarray) else tuple(columns)
    visual = mesh.visual
    colours = visual.vertex_colors if isinstance(visual, ColorVisuals) and visual.kind == "vertex" else None
    sigmas_m = np.asarray(columns["sigma_m"], dtype=np.float64).ravel() if "sigma_m" in names else None
    return ObjectModel(
        points_m=np.zeros((0, 3)),
        normals=np.zeros((0, 3)),
        colours=np.zeros((0, 3), dtype=np.uint8) if colours is not None else None,
        vertices_m=np.asarray(mesh.vertices, dtype=np.float64),
        triangles=np.asarray(mesh.faces, dtype=np.int64),
        vertex_normals=np.asarray(mesh.vertex_normals, dtype=np.float64),
        vertex_colours=None if colours is None else np.asarray(colours)[:, :3].astype(np.uint8),
        vertex_views=np.asarray(columns["views"], dtype=np.int64).ravel() if "views" in names else None,
        vertex_sigmas_m=None if sigmas_m is None else np.where(sigmas_m < 0.0, np.inf, sigmas_m),
    )


def _kind(edge: Mapping[str, Any]) -> EdgeKind:
    """Return what an edge is for; reports count spans as odometry, and say so beside."""
    return "span" if edge.get("span") else edge["kind"]


def _posterior(edge: Mapping[str, Any]) -> Posterior:
    information = edge["information"]
    return Posterior(
        source=edge["source"],
        target=edge["target"],
        pose=_gaussian(edge),
        modes=tuple(Mode(_number(mode["weight"]), _gaussian(mode)) for mode in edge.get("modes") or ()),
        outcome=Outcome(edge["outcome"]),
        overlap=_number(edge["overlap"]),
        information=None if information is None else _matrix(information, 6),
        effective_samples=_number(edge["effective_samples"]),
        pareto_k=_number(edge["pareto_k"]),
        log_evidence=_number(edge["log_evidence"]),
        seconds=_number(edge["seconds"]),
    )


def _gaussian(record: Mapping[str, Any]) -> PoseGaussian:
    return PoseGaussian(_matrix(record["target_from_source"], 4), _matrix(record["covariance"], 6))


def _matrix(numbers: Sequence[float | None], size: int) -> Array:
    return np.array([_number(number) for number in numbers]).reshape(size, size)


def _number(value: float | None) -> float:
    """Return a number, NaN for what was not finite."""
    return math.nan if value is None else float(value)
