"""The models in the folder of a batch: records of single runs, and the list of all."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from typing import Any

from modeler.batch.jobs import NOTES, read_note
from modeler.export import RunFolder, mesh_of, poses_of, read_model, write_atomically
from modeler.export.models_table import finite, fits, model_columns, report_columns, write_table
from modeler.types import Array, InputError

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
    return finite(record)


def _errors(run: Path, report: dict[str, Any], centre_m: Array) -> dict[str, float]:
    """Return the pose errors of an object with that centre; empty without ground truth."""
    from modeler.evaluation import trajectory_errors
    from modeler.runs.reopening import parts_of

    truth: dict[int, Any] = {}
    for part in parts_of(run):
        truth |= part.truth() or {}
    poses = {frame: pose.mean for frame, pose in poses_of(report).items() if frame in truth}
    if not poses:
        return {}
    off = trajectory_errors(poses, truth, centre_m)  # the object frame is the camera frame of the first frame
    return {"rotation_error_deg": off.max_rotation_deg, "translation_error_m": off.max_translation_m}


def thumbnail_of(run: Path, out: Path) -> None:
    """Write a small picture of the model of a run, if it has one."""
    from modeler.export import model_upright
    from modeler.viz.report.mesh import portrait, read_mesh

    mesh = read_mesh(run / "model.ply")
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
