"""Objects whose model is at hand, run folders and mesh files, and the files of one that is tracked."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from modeler.export import RunFolder, read_model, tum_text, write_atomically
from modeler.export.datasets import MODELS_INFO
from modeler.export.files import PART
from modeler.fusion.symmetries import Axis, Symmetries
from modeler.sequences import AbstractSequence, FocalFactor, RefocusedSequence
from modeler.sequences.calibrated import has_focal
from modeler.sequences.meshes import opened_mesh
from modeler.system.processes import Pace
from modeler.system.regular_files import left_behind, read_json
from modeler.tracking import Tracked
from modeler.tracking.tracker import UNITS_M
from modeler.types import InputError, ObjectModel, PoseGaussian, checked

Unit = Literal["m", "cm", "mm"]


@dataclass(frozen=True, eq=False)
class KnownObject:
    """An object with its model."""

    model: ObjectModel
    """In m, in the frame of its file, or of `model.ply` of its run."""
    focal: FocalFactor | None = None
    """What the run that made the model found out about its camera."""
    symmetries: Symmetries | None = None
    """Those that the model's entry in BOP's `models_info.json` names; None: none are named."""

    def seen_by(self, sequence: AbstractSequence) -> AbstractSequence:
        """Return a sequence with the focal length that the model was made with, if it is of the same camera.

        Model and frames then err alike; otherwise the model would fit badly for no fault of its pose.
        """
        if self.focal is None or sequence.live:
            return sequence
        same = has_focal(sequence.frame(sequence.indices[0]), self.focal.stated_px)
        return RefocusedSequence(sequence, self.focal) if same else sequence


@checked
def known_object(path: str | Path, unit: Unit | None = None) -> KnownObject:
    """Return the object of a run folder or a mesh file.

    Args:
        path: a run folder, or a mesh (PLY, OBJ, GLB, STL).
        unit: of lengths in the file; None: m, or mm for a model of BOP, which `models_info.json` lies beside.
    """
    path = Path(path)
    if path.is_dir():
        if unit not in (None, "m"):
            raise InputError(f"{path}: models of runs are in m; leave `unit` out")
        camera = RunFolder(path).result().get("camera")
        return KnownObject(read_model(path / "model.ply"), None if camera is None else _focal(camera))
    of_bop = path.with_name(MODELS_INFO).is_file()
    scale_m = UNITS_M[unit or ("mm" if of_bop else "m")]
    model = read_model(path) if path.suffix.lower() == ".ply" else _read(path)
    sigmas_m = None if model.vertex_sigmas_m is None else scale_m * model.vertex_sigmas_m
    return KnownObject(
        replace(model, vertices_m=scale_m * model.vertices_m, vertex_sigmas_m=sigmas_m),
        symmetries=_of_bop(path, scale_m) if of_bop else None,
    )


def _of_bop(path: Path, scale_m: float) -> Symmetries | None:
    """Return the symmetries that the entry of a model in BOP's `models_info.json` names; None where it names none."""
    info, digits = path.with_name(MODELS_INFO), re.search(r"(\d+)$", path.stem)
    entries = read_json(info)
    number = str(int(digits.group(1))) if digits else "1"
    try:
        entry = entries.get(number, {})
        turns = np.asarray(entry.get("symmetries_discrete", []), np.float64).reshape(-1, 4, 4)
        axes = [
            (np.asarray(one["axis"], np.float64).reshape(3), np.asarray(one["offset"], np.float64).reshape(3))
            for one in entry.get("symmetries_continuous", [])
        ]
    except (AttributeError, KeyError, TypeError, ValueError):
        turns, axes = np.zeros((1, 4, 4)), []
    rotations = turns[:, :3, :3]
    if not (
        np.allclose(rotations @ np.swapaxes(rotations, 1, 2), np.eye(3), atol=1e-3)
        and np.isfinite(turns).all()
        and all(np.isfinite(point).all() and 0.0 < np.linalg.norm(direction) < np.inf for direction, point in axes)
    ):
        raise InputError(f"{info}: the symmetries of object {number} are not as BOP has them; correct or remove them")
    if not len(turns) and not axes:
        return None
    turns[:, :3, 3] *= scale_m
    named = [Axis(direction / np.linalg.norm(direction), scale_m * point) for direction, point in axes]
    return Symmetries(0.0, tuple(turns), tuple(named))


def _focal(camera: dict[str, Any]) -> FocalFactor | None:
    """Return the estimate of a run's camera; None where loops did not determine it."""
    if camera.get("told_by") != "loop" or not camera.get("fx_px"):
        return None
    factor = camera["focal_factor"]
    return FocalFactor(
        factor,
        camera["fx_px"] / factor,
        camera.get("depth_scale", 1.0),
        camera.get("depth_scale_sigma", 0.0),
        camera.get("focal_factor_sigma", 0.0),
        "loop",
    )


def _colours(visual: Any) -> np.ndarray | None:
    """Return the RGB (v, 3) of a mesh's vertices, those of its texture included; None without any."""
    if visual is None or not visual.defined:
        return None
    return np.asarray((visual if visual.kind in ("vertex", "face") else visual.to_color()).vertex_colors)[:, :3]


def _read(path: Path) -> ObjectModel:
    """Return the mesh in a file of any format, with its colours if it has any."""
    with opened_mesh(path) as mesh:
        vertices, triangles = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        colours, normals = _colours(mesh.visual), np.asarray(mesh.vertex_normals, np.float64)
    if colours is not None and len(colours) != len(vertices):
        colours = None
    return ObjectModel(
        points_m=np.zeros((0, 3)),
        normals=np.zeros((0, 3)),
        colours=None,
        vertices_m=vertices,
        triangles=triangles,
        vertex_normals=normals,
        vertex_colours=None if colours is None else colours.astype(np.uint8),
    )


POSES: Final = "poses.json"  # the file by which a folder is known
PAGE: Final = "report.html"  # the page about a track
FILES: Final = (POSES, "trajectory.txt", "bop.csv", "recording.rrd", PAGE)


@dataclass(frozen=True, eq=False)
class TrackFolder:
    """Where a track is written, at most a tenth of the time as it goes, and complete at the end."""

    path: Path
    model: str
    sequence: str
    pace: Pace = field(default_factory=Pace, init=False, repr=False)
    """When it may be written again."""

    def check(self, *, overwrite: bool) -> None:
        """Refuse a folder with other contents or, unless asked for, with another track."""
        if not self.path.exists():
            return
        if not self.path.is_dir():
            raise InputError(f"{self.path}: is no folder; choose another `out`")
        names = {entry.name for entry in self.path.iterdir()}
        of_kills = {left.name for name in FILES for left in left_behind(self.path / name, PART)}
        if names - {*FILES} - of_kills:
            raise InputError(f"{self.path}: not empty, and not the folder of a track; choose another `out`")
        if names and not overwrite:
            raise InputError(f"{self.path}: not empty; choose another `out`, or give `overwrite`")

    def write(self, found: Sequence[Tracked], *, last: bool = False) -> None:
        """Bring the files up to date."""
        if self.pace.rests and not last:
            return
        began_s = time.monotonic()
        report = {"schema": 1, "model": self.model, "sequence": self.sequence, "poses": [record(one) for one in found]}
        placed = {one.frame: one.pose.mean for one in found if one.pose is not None and one.outcome != "unsure"}
        contents = {
            "trajectory.txt": tum_text(placed, {one.frame: one.time_s for one in found}),
            "bop.csv": bop_text(found, *_numbers(self.sequence, self.model)),
            POSES: json.dumps(report, allow_nan=False) + "\n",
        }
        for name, content in contents.items():
            write_atomically(self.path / name, content, lasting=last)
        self.pace.took(time.monotonic() - began_s)


def record(found: Tracked) -> dict[str, Any]:
    """Return the object in one frame as an entry of `poses.json`; poses are null where it is not there."""
    return {
        "id": found.frame,
        "timestamp": float(found.time_s),
        "outcome": found.outcome,
        "usable": found.usable,
        "reason": found.reason,
        **({"camera_from_model": None, "covariance": None} if found.pose is None else _pose(found.pose)),
        "modes": [{"weight": mode.weight, **_pose(mode.pose)} for mode in found.modes],
        "overlap": found.overlap,
        "seconds": found.seconds,
    }


def _pose(pose: PoseGaussian) -> dict[str, list[float]]:
    return {"camera_from_model": pose.mean.ravel().tolist(), "covariance": pose.covariance.ravel().tolist()}


def bop_text(found: Sequence[Tracked], scene: int, thing: int) -> str:
    """Return the results as the BOP toolkit reads them: mm, the overlap as score, frames in which the object is."""
    lines = ["scene_id,im_id,obj_id,score,R,t,time"]
    for one in found:
        if one.pose is not None:
            rotation = " ".join(repr(float(number)) for number in one.pose.mean[:3, :3].ravel())
            place = " ".join(repr(1000.0 * float(number)) for number in one.pose.mean[:3, 3])
            lines.append(f"{scene},{one.frame},{thing},{one.overlap!r},{rotation},{place},{one.seconds!r}")
    return "\n".join(lines) + "\n"


def _numbers(sequence: str, model: str) -> tuple[int, int]:
    """Return the numbers of scene and object in the names of their files, as BOP has them; 1 for an object without."""
    scene, thing = (re.search(r"(\d+)$", Path(name).stem) for name in (sequence, model))
    return int(scene.group(1)) if scene else 0, int(thing.group(1)) if thing else 1
