"""The run folder: every result of a run, kept up to date step by step."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from modeler.export.files import PART, write_atomically
from modeler.export.g2o import g2o_text
from modeler.export.ply import cloud_ply, mesh_ply
from modeler.export.report import FrameRecord, RunMeta, frame_record, posteriors_of, report_of
from modeler.export.tum import tum_text
from modeler.types import InputError, Posterior, Step

_REPORT = "report.json"
_OURS = ("model.ply", "cloud.ply", "trajectory.txt", "odometry.txt", "graph.g2o", "recording.rrd", _REPORT)


@dataclass(frozen=True)
class RunFolder:
    """A sink for steps. Poses, graph and report are written after every step, clouds and mesh after the last.

    Each file is replaced in one go, the report after what it reports on: a run killed at any moment leaves no half
    file. `RunFolder(path)` is for reading; `RunFolder.open` makes one to write to.
    """

    path: Path
    """The folder."""
    already: int = 0
    """Number of frames that a resumed run had got to: until it is there again its files stay as they are."""
    frames: dict[int, FrameRecord] = field(default_factory=dict, init=False, repr=False)
    """What became of the frames so far; a step knows only its own."""

    @classmethod
    def open(cls, path: Path, *, overwrite: bool = False, resume: bool = False) -> RunFolder:
        """Make a folder to write to, or prepare the one that is there. Files that are not of a run are never touched.

        Args:
            path: where.
            overwrite: delete the files of an earlier run first.
            resume: keep them until they are replaced.

        Raises:
            InputError: where the folder has content and neither is given, or where it cannot be made or resumed.
        """
        try:
            path.mkdir(parents=True, exist_ok=True)
            if any(path.iterdir()) and not (overwrite or resume):
                raise InputError(f"{path}: not empty; choose another --out, or give --overwrite or --resume")
            leftovers = [part for name in _OURS for part in path.glob(f".{name}.*{PART}")]
            for file in [*leftovers, *(path / name for name in _OURS if overwrite)]:
                file.unlink(missing_ok=True)
        except OSError as error:
            raise InputError(f"{path}: no run folder can be made ({error.strerror}); choose another --out") from error
        resumes = resume and (path / _REPORT).exists()
        return cls(path, len(cls(path).report()["frames"]) if resumes else 0)

    def report(self) -> dict[str, Any]:
        """Return the report as it stands in the folder.

        Raises:
            InputError: where there is none or it cannot be read.
        """
        path = self.path / _REPORT
        try:
            report = json.loads(path.read_bytes())
        except FileNotFoundError:
            raise InputError(f"{path}: there is no report; is {self.path} the folder of a run?") from None
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: the report cannot be read ({error}); build again with --overwrite") from error
        if not isinstance(report, dict) or report.get("schema") != 1:
            raise InputError(f"{path}: not a report of schema 1; build again with --overwrite")
        return report

    def posteriors(self, meta: RunMeta) -> Mapping[tuple[int, int], Posterior]:
        """Return by (source, target) what an interrupted run has registered; empty where it had not got that far.

        Raises:
            InputError: where that run was made from other input or with other settings, or its report cannot be read.
        """
        if not (self.path / _REPORT).exists():
            return {}
        report = self.report()
        wanted = {"sequence": meta.sequence, "seed": meta.seed, "prior": meta.prior, "settings": dict(meta.settings)}
        wanted = json.loads(json.dumps(wanted))
        for key, value in wanted.items():
            if report.get(key) != value:
                raise InputError(
                    f"{self.path}: cannot resume, its {key} was {report.get(key)!r} and is now {value!r}; "
                    "use the same, or --overwrite"
                )
        return posteriors_of(report)

    def write(self, step: Step, meta: RunMeta) -> dict[str, Any]:
        """Bring the folder up to date and return the report after this step.

        Raises:
            InputError: where a file cannot be written.
        """
        self.frames[step.frame.index] = frame_record(step)
        report = report_of(step, list(self.frames.values()), meta)
        if len(self.frames) < self.already and not step.last:
            return report
        times_s = {frame: view.frame.time_s for frame, view in step.views.items()}
        self._write("trajectory.txt", tum_text(step.solution.trajectory, times_s))
        self._write("odometry.txt", tum_text(step.solution.odometry, times_s))
        self._write("graph.g2o", g2o_text(step.edges_so_far, step.solution))
        if step.last and step.model is not None:
            self._write("cloud.ply", cloud_ply(step.model))
            self._write("model.ply", mesh_ply(step.model))
        self._write(_REPORT, json.dumps(report, allow_nan=False) + "\n")
        return report

    def _write(self, name: str, content: str | bytes) -> None:
        write_atomically(self.path / name, content)
