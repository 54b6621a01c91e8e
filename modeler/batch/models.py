"""The models in the folder of a batch: records of single runs, and the list of all, in Parquet and as a page."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from modeler.batch.jobs import NOTES, read_note
from modeler.export import RunFolder, mesh_of, poses_of, read_model, write_atomically
from modeler.export.placing import model_upright
from modeler.export.report import json_value
from modeler.types import ACCEPTED, Array, InputError, ObjectModel

if TYPE_CHECKING:
    import pyarrow as pa


TABLE = "models.parquet"  # the list, in the folder of a batch
THUMBNAIL_PX = 160  # side of a picture of a model


def record_of(run: Path) -> dict[str, Any]:
    """Return the report, the size of the model and, if known, the errors of a finished run, as JSON values.

    Raises:
        InputError: if the folder holds no run.
    """
    folder = RunFolder(run)
    report = folder.result()
    record = report_columns(report) | {"sequence": str(folder.located(report["sequence"]))}
    record["settings"] = json.dumps(report["settings"])
    record["versions"] = json.dumps(report.get("versions") or {})
    with contextlib.suppress(InputError):  # a run without surface, or whose sequence has moved
        model = read_model(mesh_of(run))
        record |= model_columns(model, report)
        record |= _errors(run, report, model.vertices_m.mean(axis=0))
    return json_value(record)


def _errors(run: Path, report: dict[str, Any], centre_m: Array) -> dict[str, float]:
    """Return the pose errors of an object with that centre; empty without ground truth."""
    from modeler.evaluation import trajectory_errors
    from modeler.runs.reopening import parts_of, truth_of

    truth = truth_of(parts_of(run))
    poses = {frame: pose.mean for frame, pose in poses_of(report).items() if frame in truth}
    if not poses:
        return {}
    off = trajectory_errors(poses, truth, centre_m)  # the object frame is the camera frame of the first frame
    return {"rotation_error_deg": off.max_rotation_deg, "translation_error_m": off.max_translation_m}


def thumbnail_of(run: Path, out: Path) -> None:
    """Write a small picture of the model of a run, if it has one that is newer than the picture."""
    from modeler.viz.report.mesh import portrait, read_mesh

    model = run / "model.ply"
    if out.exists() and not (model.exists() and out.stat().st_mtime_ns < model.stat().st_mtime_ns):
        return
    mesh = read_mesh(model)
    if mesh is not None:
        upright = model_upright(RunFolder(run).report())
        write_atomically(out, portrait(mesh, upright, (THUMBNAIL_PX, THUMBNAIL_PX)))


def models_in(out: Path) -> list[dict[str, Any]]:
    """Return a row for each sequence of a batch, and for each run that `modeler build` made in its folder, by name."""
    notes = {note.stem: read_note(note) for note in (out / NOTES).glob("*.json")}
    runs = {path.parent.name for path in out.glob("*/report.json")}
    rows = []
    for name in sorted(notes.keys() | runs):
        note = notes.get(name, {})
        record = note.get("record")
        if record is not None and not fits(record):
            record, note = None, {}
        if record is None and not note and name in runs:
            record, note = _of_build(out / name)
        row = {**(record or {}), "name": name, "status": note.get("status"), "tries": note.get("tries", 0)}
        row["input"] = note.get("content")
        row["failure"] = note.get("line") if record is None else None
        rows.append(row | {"sequence": note.get("sequence") or row.get("sequence")})
    return rows


def closed_in(out: Path) -> list[str]:
    """Return the names of what lies in a folder and may not be looked into: the runs of other users, perhaps."""

    def closed(path: Path) -> bool:
        try:
            os.lstat(path / "report.json")
        except PermissionError:
            return True
        except OSError:
            return False
        return False

    return sorted(path.name for path in out.glob("*") if closed(path))


def _of_build(run: Path) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """Return record and note of a run that no batch has made."""
    try:
        record = record_of(run)
    except InputError as error:
        return None, {"line": str(error)}
    complete = RunFolder(run).report().get("complete") is True
    return record, {"status": (0 if record["trustworthy"] else 3) if complete else None}


def write_models(out: Path) -> None:
    """Write the list of the models in a folder."""
    write_table(out / TABLE, models_in(out))


_COLUMNS = {
    "name": "string",  # of the run folder
    "sequence": "string",
    "status": "int64",  # 0 trustworthy, 3 not; 2 and above: no model; null: not ended
    "trustworthy": "bool",
    "reasons": "list",  # why not
    "failure": "string",  # message of the build, if there is no model
    "tries": "int64",  # how often it has failed
    "frames": "int64",
    "accepted": "int64",
    "closed": "bool",
    "opening_deg": "double",  # of the loop, before the optimisation
    "opening_m": "double",
    "opening_sigmas": "double",
    "rotation_error_deg": "double",  # largest over the frames, aligned at the first; where the truth is known
    "translation_error_m": "double",
    "width_m": "double",  # upright
    "height_m": "double",
    "depth_m": "double",
    "volume_m3": "double",  # holes closed by flat fans
    "triangles": "int64",
    "surface_sigma_m": "double",  # median over the vertices that were seen
    "pose_sigma_deg": "double",  # largest over the frames
    "pose_sigma_m": "double",
    "seconds": "double",
    "prior": "string",
    "seed": "int64",
    "settings": "string",  # JSON
    "versions": "string",  # JSON
    "input": "string",  # digest of names and bytes
}
"""Columns and their types; all may be null."""


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as a table; missing values are null."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    content = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(list(rows), schema=_schema()), content)
    write_atomically(path, content.getvalue())


def fits(row: Mapping[str, Any]) -> bool:
    """Return whether the values of a row are of the types of its columns."""
    import pyarrow as pa

    try:
        pa.Table.from_pylist([dict(row)], schema=_schema())
    except (pa.ArrowException, TypeError, ValueError, OverflowError):
        return False
    return True


def _schema() -> pa.Schema:
    import pyarrow as pa

    kinds = {"string": pa.string(), "int64": pa.int64(), "bool": pa.bool_(), "double": pa.float64()}
    return pa.schema([(name, kinds.get(kind) or pa.list_(pa.string())) for name, kind in _COLUMNS.items()])


def report_columns(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a report in the columns of the table."""
    loop, evidence = report.get("loop") or {}, report.get("evidence") or {}
    return {
        "sequence": report["sequence"],
        "trustworthy": report["trustworthy"],
        "reasons": list(report["reasons"]),
        "frames": len(report["frames"]),
        "accepted": sum(frame["outcome"] == ACCEPTED for frame in report["frames"]),
        "closed": report["closed"],
        **{f"opening_{unit}": loop.get(f"opening_{unit}") for unit in ("deg", "m")},
        "opening_sigmas": loop.get("sigmas"),
        "pose_sigma_deg": (evidence.get("pose_sd_deg") or {}).get("value"),
        "pose_sigma_m": (evidence.get("pose_sd_m") or {}).get("value"),
        "seconds": report["seconds"].get("total"),
        "prior": report.get("prior"),
        "seed": report.get("seed"),
    }


def model_columns(model: ObjectModel, report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the measures of a model in the columns of the table."""
    upright_m = model.vertices_m @ model_upright(report)  # right, down, forward
    width_m, height_m, depth_m = (upright_m.max(axis=0) - upright_m.min(axis=0)).tolist()
    sigmas_m = model.vertex_sigmas_m
    known = None if sigmas_m is None else sigmas_m[np.isfinite(sigmas_m)]
    return {
        "width_m": width_m,
        "height_m": height_m,
        "depth_m": depth_m,
        "volume_m3": enclosed_m3(model.vertices_m, model.triangles),
        "triangles": len(model.triangles),
        "surface_sigma_m": None if known is None or not len(known) else float(np.median(known)),
    }


def enclosed_m3(vertices_m: Array, triangles: npt.NDArray[np.int64]) -> float:
    """Return the volume in a mesh, each of its holes closed by a fan about the mean of its rim."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(vertices_m)
    centred_m = vertices_m - vertices_m.mean(axis=0)
    first, second, third = (centred_m[triangles[:, k]] for k in range(3))
    volume = float(np.einsum("ij,ij->", first, np.cross(second, third)))
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    code, back = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    rim = edges[~np.isin(code, back)]
    if not len(rim):
        return volume / 6.0
    corners, place = np.unique(rim, return_inverse=True)
    place = place.reshape(-1, 2)
    graph = coo_array((np.ones(len(rim)), (place[:, 0], place[:, 1])), shape=(len(corners), len(corners)))
    loops, loop = connected_components(graph, directed=False)
    sums = np.zeros((loops, 3))
    np.add.at(sums, loop, centred_m[corners])
    middle = sums / np.bincount(loop, minlength=loops)[:, None]
    fan = np.cross(centred_m[rim[:, 1]], centred_m[rim[:, 0]])
    volume += float(np.einsum("ij,ij->", middle[loop[place[:, 0]]], fan))
    return volume / 6.0


_SHOWN: Final = {
    "name": ("name", 1.0, ""),
    "frames": ("frames", 1.0, ""),
    "accepted": ("frames placed", 1.0, ""),
    "opening_deg": ("loop closure error", 1.0, "°"),
    "opening_sigmas": ("loop closure error, in sd", 1.0, " sd"),
    "rotation_error_deg": ("largest rotation error", 1.0, "°"),
    "translation_error_m": ("largest translation error", 1000.0, " mm"),
    "width_m": ("width", 1000.0, " mm"),
    "height_m": ("height", 1000.0, " mm"),
    "depth_m": ("depth", 1000.0, " mm"),
    "volume_m3": ("volume", 1e6, " cm³"),
    "surface_sigma_m": ("sd of the surface", 1000.0, " mm"),
    "pose_sigma_deg": ("largest sd of a rotation", 1.0, "°"),
    "triangles": ("triangles", 1.0, ""),
    "seconds": ("build time", 1.0, " s"),
}
"""Columns of the list of models, each in words, with the factor to its unit."""


def write_gallery(
    out: Path,
    title: str,
    rows: Sequence[Mapping[str, Any]],
    pictures: Mapping[str, bytes],
    links: Mapping[str, str],
) -> None:
    """Write a self-contained page.

    Args:
        out: file to write.
        title: of the page.
        rows: one a sequence, as the list of models has them.
        pictures: JPEG by name, of those that have a model.
        links: addresses by name, relative to the page.
    """
    from modeler.viz.report import asset

    models = [
        {
            "status": row["status"],
            "why": row["failure"] or "; ".join(row.get("reasons") or ()),
            "link": links.get(row["name"]),
            "values": [_rounded(row.get(column), factor) for column, (_, factor, _) in _SHOWN.items()],
        }
        for row in rows
    ]
    coded = [base64.b64encode(pictures.get(row["name"], b"")).decode() for row in rows]
    columns = [{"words": words, "unit": unit} for words, _, unit in _SHOWN.values()]
    page = Template(asset("gallery.html")).substitute(
        title=escape(title), columns=_script(columns), models=_script(models), pictures=_script(coded)
    )
    write_atomically(out, page)


def _rounded(value: Any, factor: float) -> Any:
    """Return a number in its unit, to four digits; other values unchanged."""
    return float(f"{factor * value:.4g}") if isinstance(value, float) else value


def _script(value: Any) -> str:
    """Return a value as a script has it: nothing in it ends the script."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
