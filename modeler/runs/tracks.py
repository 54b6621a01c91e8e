"""The files of an object tracked through a sequence: `poses.json`, `trajectory.txt` and `bop.csv`."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from modeler.export import tum_text, write_atomically
from modeler.export.files import PART
from modeler.system.concurrency import Pace
from modeler.system.regular_files import left_behind
from modeler.tracking import Tracked
from modeler.types import InputError, PoseGaussian

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
