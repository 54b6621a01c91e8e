"""A run read back from its files, after a check that `report.json` is as `modeler` writes it."""

from __future__ import annotations

import io
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from modeler import se3
from modeler.system.regular_files import read_regular
from modeler.types import Array, Edge, EdgeKind, InputError, Mode, ObjectModel, Outcome, PoseGaussian, Posterior, Stated

Test = Callable[[Any], bool]
_WIDEST, _NARROWEST = 1e9, 1e-30  # variances that can be computed with
_ROUND = 1e-6  # to which rotations and directions survive being written


def edges_of(report: Mapping[str, Any]) -> tuple[Edge, ...]:
    """Return the edges in a report, in order, with their acceptance; their posteriors are without samples."""
    return tuple(
        Edge(_posterior(record), _kind(record), record["accepted"], Stated(record.get("reason", "")))
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
        InputError: if there is none, it cannot be read or has no triangles.
    """
    import trimesh
    from trimesh.visual import ColorVisuals

    if not os.path.lexists(path):
        raise InputError(f"{path}: no such mesh; give a run folder of a finished `modeler build`")
    content = io.BytesIO(read_regular(path))
    try:
        mesh = trimesh.load(content, file_type="ply", process=False)  # load_mesh would drop the normals
    except Exception as error:  # trimesh lets whatever its parser trips over through
        raise InputError(f"{path}: not a mesh that can be read ({error}); build the model again") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{path}: holds no triangles; more views are needed for a surface")
    vertices_m, triangles = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if not np.isfinite(vertices_m).all() or triangles.min() < 0 or triangles.max() >= len(vertices_m):
        raise InputError(f"{path}: is damaged: its triangles have invalid corners; build the model again")
    columns = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data", {})
    names = columns.dtype.names or () if isinstance(columns, np.ndarray) else tuple(columns)
    visual = mesh.visual
    colours = visual.vertex_colors if isinstance(visual, ColorVisuals) and visual.kind == "vertex" else None
    sigmas_m = np.asarray(columns["sigma_m"], dtype=np.float64).ravel() if "sigma_m" in names else None
    return ObjectModel(
        points_m=np.zeros((0, 3)),
        normals=np.zeros((0, 3)),
        colours=np.zeros((0, 3), dtype=np.uint8) if colours is not None else None,
        vertices_m=vertices_m,
        triangles=triangles,
        vertex_normals=np.asarray(mesh.vertex_normals, dtype=np.float64),
        vertex_colours=None if colours is None else np.asarray(colours)[:, :3].astype(np.uint8),
        vertex_views=np.asarray(columns["views"], dtype=np.int64).ravel() if "views" in names else None,
        vertex_sigmas_m=None if sigmas_m is None else np.where(sigmas_m < 0.0, np.inf, sigmas_m),
    )


def _kind(edge: Mapping[str, Any]) -> EdgeKind:
    """Return the kind of an edge; schema 1 counts spans as odometry and joins as closures, with a separate flag."""
    return "span" if edge.get("span") else "join" if edge.get("join") else edge["kind"]


def _posterior(edge: Mapping[str, Any]) -> Posterior:
    return Posterior(
        source=edge["source"],
        target=edge["target"],
        pose=_gaussian(edge),
        modes=tuple(Mode(_number(mode["weight"]), _gaussian(mode)) for mode in edge.get("modes") or ()),
        outcome=Outcome(edge["outcome"]),
        overlap=_number(edge["overlap"]),
        colour_correlation=_number(edge.get("colour_correlation")),
        independent_colours=float(edge.get("independent_colours") or 0.0),
        effective_samples=_number(edge["effective_samples"]),
        pareto_k=_number(edge["pareto_k"]),
        log_marginal_likelihood=_number(edge["log_evidence"]),
        seconds=_number(edge["seconds"]),
    )


def _gaussian(record: Mapping[str, Any]) -> PoseGaussian:
    given_camera = record.get("covariance_given_camera") or record["covariance"]  # schema 1 has only that
    mean, covariance = _matrix(record["target_from_source"], 4), _matrix(given_camera, 6)
    by_focal = record.get("by_focal")  # reports of earlier versions have none
    return PoseGaussian(mean, covariance, np.zeros(6) if by_focal is None else np.array([*map(_number, by_focal)]))


def _matrix(numbers: Sequence[float | None], size: int) -> Array:
    return np.array([_number(number) for number in numbers]).reshape(size, size)


def _number(value: float | None) -> float:
    """Return a number, NaN if it was not finite."""
    return math.nan if value is None else float(value)


# Reports of earlier versions have none of these.
_LATER = frozenset(
    {
        "by_focal",
        "covariance_given_camera",
        "modes",
        "cause",
        "mask",
        "reason",
        "colour_correlation",
        "independent_colours",
    }
)


def fault(report: Mapping[str, Any]) -> str | None:
    """Return the first defect of a report, in words; None if it is valid.

    Optional and additional fields are not checked.
    """
    for name, test in _WHOLE.items():
        if not test(report.get(name)):
            return f"{name!r} is missing or invalid"
    for name, value in report.items():
        if name not in ("frames", "edges", "poses") and not all(map(_is_text, (name, *_texts(value)))):
            return f"{name!r} holds text that no file can contain"
    for name, tests in (("frames", _FRAME), ("edges", _EDGE), ("poses", _POSE)):
        for place, record in enumerate(report[name]):
            wrong = _wrong(record, tests) or _impossible(record)
            if wrong is not None:
                return f"{wrong} of entry {place} of {name!r} is missing or invalid"
    frames, poses = ([record["id"] for record in report[name]] for name in ("frames", "poses"))
    if len({*frames}) < len(frames) or len({*poses}) < len(poses) or not {*poses} <= {*frames}:
        return "'frames' or 'poses' has a frame twice, or 'poses' has frames missing in 'frames'"
    if any(edge["source"] == edge["target"] for edge in report["edges"]):
        return "an entry of 'edges' joins a frame to itself"
    wrong = _wrong(report["settings"], _SETTINGS, may_lack=frozenset(_SETTINGS))
    return None if wrong is None else f"{wrong} of 'settings' is invalid"


def _wrong(record: Any, tests: Mapping[str, Test], may_lack: frozenset[str] = _LATER) -> str | None:
    if not isinstance(record, dict):
        return "all"
    for name, test in tests.items():
        if not test(record[name]) if name in record else name not in may_lack:
            return repr(name)
    return None


def _impossible(record: Mapping[str, Any]) -> str | None:
    """Return which pose of an edge that takes part, or of a frame, is no motion, or which covariance is none."""
    if not record.get("accepted", "object_from_camera" in record):
        return None
    for part in (record, *(record.get("modes") or ())):
        for name in ("target_from_source", "object_from_camera"):
            if name in part and not se3.is_rigid(np.array(part[name], np.float64).reshape(4, 4), tolerance=_ROUND):
                return repr(name)
        for name in ("covariance", "covariance_given_camera"):
            if part.get(name) and not _definite(part[name], 0.0 if "accepted" in record else -_ROUND):
                return repr(name)
    return None


def _definite(numbers: list[float | None], least: float) -> bool:
    covariance = np.array(numbers, dtype=np.float64).reshape(6, 6)
    if not (np.abs(covariance) < _WIDEST).all():  # not so of NaN
        return False
    if np.diag(covariance).min() < _NARROWEST:
        return False
    sigmas = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigmas, sigmas)
    return bool(np.abs(correlation - correlation.T).max() < _ROUND and np.linalg.eigvalsh(correlation)[0] > least)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**62


def _is_number(value: Any) -> bool:
    """Return whether it is a number that floats hold: JSON's whole numbers may be of any size, and NaN is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _is_number_or_null(value: Any) -> bool:
    """Return whether it is a number, or null for one that is not finite."""
    return value is None or _is_number(value)


def _is(kind: type) -> Test:
    return lambda value: isinstance(value, kind)


def _null_or(test: Test) -> Test:
    return lambda value: value is None or test(value)


def _is_text(value: Any) -> bool:
    """Return whether it is text that a file or the name of a file can hold."""
    try:
        return isinstance(value, str) and b"\0" not in os.fsencode(value)
    except UnicodeEncodeError:
        return False


def _texts(tree: Any) -> Iterator[str]:
    """Yield every text in a tree of JSON, names too."""
    if isinstance(tree, str):
        yield tree
    elif isinstance(tree, dict):
        yield from tree
    for part in tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ():
        yield from _texts(part)


def _list_of(test: Test, count: int | None = None) -> Test:
    """Return the test of a list of values that pass a test, of any number of them or of `count`."""
    return lambda value: isinstance(value, list) and count in (None, len(value)) and all(map(test, value))


def _record_of(tests: Mapping[str, Test], may_lack: frozenset[str] = frozenset()) -> Test:
    return lambda value: _wrong(value, tests, may_lack) is None


def _is_direction(value: Any) -> bool:
    return _list_of(_is_number, 3)(value) and abs(math.hypot(*value) - 1.0) < _ROUND


def _is_camera(value: Any) -> bool:
    if not isinstance(value, dict):
        return False
    factors = [value.get(name, 1.0) for name in ("focal_factor", "factor_in_run")]
    sigmas = [value.get(name, 0.0) for name in ("focal_factor_sigma", "depth_scale_sigma")]
    return all(_is_number(factor) and 0.25 <= factor <= 4.0 for factor in factors) and all(map(_is_number, sigmas))


_FIGURE: dict[str, Test] = {"value": _is_number_or_null, "limit": _is_number_or_null, "holds": _is(bool)}
_WHOLE: dict[str, Test] = {
    "sequence": _is_text,
    "settings": _is(dict),
    "frames": _is(list),
    "edges": _is(list),
    "poses": _is(list),
    "closed": _is(bool),
    "loop": _null_or(_record_of(dict.fromkeys(("opening_deg", "opening_m", "sigmas"), _is_number))),
    "camera": _null_or(_is_camera),
    "trustworthy": _is(bool),
    "tolerance_m": _null_or(_is_number),
    "trusted_to_m": _null_or(_is_number),
    "reasons": _list_of(_is_text),
    "reason_codes": _null_or(_list_of(_is(str))),
    "evidence": _null_or(lambda value: isinstance(value, dict) and all(map(_record_of(_FIGURE), value.values()))),
    "scene_frames": _null_or(_list_of(_is_whole)),
    "seconds": lambda value: isinstance(value, dict) and all(map(_is_number, value.values())),
    "up": _null_or(_is_direction),
    "support_offset_m": _null_or(_is_number),  # which reports of earlier versions have not, nor `up`
}
_FRAME: dict[str, Test] = {
    "id": _is_whole,
    "timestamp": _is_number,
    "points": _is_whole,
    "outcome": _is_text,
    "cause": _null_or(_is_text),
    "mask": _null_or(_is_text),
}
_MOTION: dict[str, Test] = {
    "target_from_source": _list_of(_is_number_or_null, 16),
    "covariance": _list_of(_is_number_or_null, 36),
    "covariance_given_camera": _null_or(_list_of(_is_number_or_null, 36)),
    "by_focal": _null_or(_list_of(_is_number_or_null, 6)),
}
_MODE: dict[str, Test] = {"weight": _is_number_or_null, **_MOTION}
_POSE: dict[str, Test] = {
    "id": _is_whole,
    "object_from_camera": _MOTION["target_from_source"],
    "covariance": _MOTION["covariance"],
}
_EDGE: dict[str, Test] = {
    "source": _is_whole,
    "target": _is_whole,
    "kind": lambda value: value in get_args(EdgeKind),
    "accepted": _is(bool),
    "reason": _is_text,
    "outcome": lambda value: value in [outcome.label for outcome in Outcome],
    **_MOTION,
    "modes": _null_or(_list_of(_record_of(_MODE, _LATER))),
    "overlap": _is_number_or_null,
    "colour_correlation": _is_number_or_null,
    "independent_colours": _is_number_or_null,
    "effective_samples": _is_number_or_null,
    "pareto_k": _is_number_or_null,
    "log_evidence": _is_number_or_null,
    "seconds": _is_number_or_null,
}
_SETTINGS: dict[str, Test] = {
    "joined": _list_of(_is_text, 2),
    "continues": _is_text,
    "same_camera": _is(bool),
    "offset": _is_whole,
    "later_s": _is_number,
    "sensor": _is_text,
    "roi": _null_or(_list_of(_is_whole, 4)),
    "max_depth_m": _null_or(_is_number),
    "voxel_m": _null_or(_is_number),
    "tolerance_mm": _null_or(_is_number),
}
