"""The run folder: every result of a run, kept up to date step by step."""

from __future__ import annotations

import io
import json
import os
import time
import zipfile
import zlib
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from modeler.export.files import PART, cloud_ply, g2o_text, mesh_ply, settle, settle_soon, tum_text, write_atomically
from modeler.export.pairs import Pairs
from modeler.export.reading import fault
from modeler.export.report import RunMeta, report_of
from modeler.system.processes import Pace
from modeler.system.regular_files import check_regular, read_json
from modeler.types import BoolArray, InputError, Step

_REPORT = "report.json"
MASKS = "masks.npz"
"""Masks (h, w) by frame number, of views whose masks are not those found in their frames alone."""
_OURS = (_REPORT, "model.ply", "cloud.ply", "trajectory.txt", "odometry.txt", "graph.g2o", MASKS, "recording.rrd")
"""The report, without which nothing is resumed, goes first."""
_PATHS = ("sequence", "sensor", "camera")  # entries of a report and of its settings that are paths
PAGE = "report.html"  # page of `modeler report`; removed together with the run


@dataclass(frozen=True)
class RunFolder:
    """A sink for steps. Poses, graph and report are written after every step, clouds and mesh after the last.

    If this takes long, as for a thousand frames, some steps are skipped to limit it to a tenth of the time. Each file
    is replaced atomically, the report last: a run killed at any moment leaves no partial file. After the last step all
    files are on the disk; before, they are flushed in the background. Each registration is stored as well.
    `RunFolder(path)` is for reading; `RunFolder.open` makes one to write to.
    """

    path: Path
    already: int = 0
    """Number of frames of a resumed run: its files are kept until that is reached again."""
    pace: Pace = field(default_factory=Pace, init=False, repr=False)
    """When it may be written again."""

    @classmethod
    def open(cls, path: Path, *, overwrite: bool = False, resume: bool = False) -> RunFolder:
        """Create a folder to write to, or prepare an existing one. Files that do not belong to a run are never touched.

        Args:
            path: where.
            overwrite: delete the files of an earlier run first.
            resume: keep them until they are replaced, unless there is no report.

        Raises:
            InputError: if the folder has content that is not a run's, or is a run's and neither is given, or if
                it cannot be created or resumed.
        """
        folder = cls(path)
        folder.check(overwrite=overwrite, resume=resume)
        try:
            path.mkdir(parents=True, exist_ok=True)
            folder.pairs.mark()  # from here on the folder is that of a run, also after a kill
            resumes = resume and (path / _REPORT).exists()
            leftovers = [part for name in _OURS for part in path.glob(f".{name}.*{PART}")]
            # The recording is written in place: a link target stays unchanged.
            for file in [*leftovers, *(path / name for name in (_OURS[-1:] if resumes else (*_OURS, PAGE)))]:
                file.unlink(missing_ok=True)
            if not resumes:
                folder.pairs.empty()
        except OSError as error:
            raise InputError(f"{path}: no run folder can be made ({error.strerror}); choose another place") from error
        return cls(path, len(folder.report()["frames"]) if resumes else 0)

    def check(self, *, overwrite: bool = False, resume: bool = False) -> None:
        """Refuse to make a run where other things are, or, unless asked for, where another run is."""
        if self.is_empty:
            return
        if not self.is_run:
            if os.path.lexists(self.path / _REPORT):
                check_regular(self.path / _REPORT)
            raise InputError(f"{self.path}: not empty, and not the folder of a run; choose another place")
        if not (overwrite or resume):
            raise InputError(f"{self.path}: not empty; choose another place, or replace or resume the run")

    @property
    def is_empty(self) -> bool:
        """Whether nothing would be lost here.

        Raises:
            InputError: if one cannot look.
        """
        try:
            entries = list(self.path.iterdir()) if self.path.exists() else []
            return not entries or (entries == [self.pairs.folder] and not any(self.pairs.folder.iterdir()))
        except OSError as error:
            what = f"no run folder can be made ({error.strerror}); choose another place"
            raise InputError(f"{self.path}: {what}") from error

    @property
    def is_run(self) -> bool:
        """Whether a run was made here, possibly unfinished."""
        if self.pairs.marked:
            return True
        try:
            self.report()
        except InputError:  # perhaps damaged: then the other files decide
            return all((self.path / name).is_file() for name in (_REPORT, "trajectory.txt", "graph.g2o"))
        return True

    @property
    def is_sound(self) -> bool:
        """Whether a report is here that is as `modeler` writes it."""
        try:
            self.result()
        except InputError:
            return False
        return True

    @property
    def pairs(self) -> Pairs:
        """The registrations of a run."""
        return Pairs(self.path / ".pairs")

    def stored(self, path: Path) -> str:
        """Return a path as the report has it: relative to the folder, so that both can be moved together.

        What is no file or folder, such as a device, stays as it is.
        """
        place = Path(os.path.realpath(path.parent), path.name) if path.name not in ("", "..") else path.resolve()
        return os.path.relpath(place, os.path.realpath(self.path)) if path.exists() else str(path)

    def located(self, stored: str) -> Path:
        """Return the path that a report means; those of earlier versions are relative to the current folder."""
        path = Path(os.path.normpath(os.path.join(os.path.realpath(self.path), stored)))
        return path if path.exists() or not Path(stored).exists() else Path(stored)

    def report(self) -> dict[str, Any]:
        """Return the report in the folder."""
        path = self.path / _REPORT
        try:
            os.lstat(path)
        except PermissionError:
            pass  # it may be there, and reading says why it cannot be read
        except (OSError, ValueError):
            raise InputError(f"{path}: no report; give a run folder instead of {self.path}") from None
        report = read_json(path)
        if not isinstance(report, dict) or report.get("schema") not in (1, 2):
            raise InputError(f"{path}: not a report of schema 1 or 2; build the run again")
        return report

    def result(self) -> dict[str, Any]:
        """Return the report after a look at all of it, for whoever relies on more than that it is there.

        Raises:
            InputError: if there is none, it cannot be read or is not as `modeler` writes it.
        """
        report = self.report()
        wrong = fault(report)
        if wrong is not None:
            raise InputError(f"{self.path / _REPORT}: {wrong}; build the run again")
        return report

    def finished(self, meta: RunMeta) -> bool:
        """Return whether a run to be resumed was complete.

        Raises:
            InputError: if that run was made from other input or with other settings, or its report cannot be read.
        """
        if not (self.path / _REPORT).exists():
            return False
        report = self.result()
        settings = report.get("settings")
        before = {name: report.get(name) for name in ("sequence", "seed", "prior")}
        before |= settings if isinstance(settings, dict) else {}
        now = {"sequence": meta.sequence, "seed": meta.seed, "prior": meta.prior, **meta.settings}
        now = json.loads(json.dumps(now))
        for name in [*now, *sorted(before.keys() - now.keys())]:
            was, is_now = (values.get(name, "not given") for values in (before, now))
            if name in _PATHS and "not given" not in (was, is_now):
                was, is_now = (str(self.located(str(value)).resolve()) for value in (was, is_now))
            if was != is_now:
                raise InputError(
                    f"{self.path}: cannot resume, {name.replace('_', '-')} was {was} and is now {is_now}; "
                    "use the same, or build the run again"
                )
        return report.get("complete") is True and not self.pairs.folder.exists() and not self.changed_frames(meta)

    def changed_frames(self, meta: RunMeta) -> tuple[str, ...]:
        """Return in words which frames are new, others, or gone since a run was made; none where that is not known."""
        before = self.report().get("digests") if (self.path / _REPORT).exists() else None
        if not isinstance(before, dict) or not before or not meta.digests:
            return ()
        now = {str(index): digest for index, digest in meta.digests.items()}
        kinds = {
            "new": now.keys() - before.keys(),
            "changed": {name for name in now.keys() & before.keys() if now[name] != before[name]},
            "gone": before.keys() - now.keys(),
        }
        return tuple(f"{_listed(names)} {what}" for what, names in kinds.items() if names)

    def scene_frames(self) -> tuple[int, ...]:
        """Return the numbers of the frames that the scene was learned from; none where that is not known."""
        return tuple(self.result().get("scene_frames") or ()) if (self.path / _REPORT).exists() else ()

    def changed_versions(self, meta: RunMeta) -> tuple[str, ...]:
        """Return the packages, each with its version, with which a run was begun that is to be resumed with others."""
        if not (self.path / _REPORT).exists():
            return ()
        before = self.report().get("versions")
        before = before if isinstance(before, dict) else {}
        return tuple(
            f"{name} {before.get(name, '?')}" for name, now in meta.versions.items() if before.get(name) != now
        )

    def write(self, step: Step, meta: RunMeta) -> dict[str, Any]:
        """Bring the folder up to date and return the report; nothing if the step is skipped."""
        if not step.last and (len(step.frames_so_far) < self.already or self.pace.rests):
            return {}
        began_s = time.monotonic()
        report = report_of(step, meta)
        times_s = {frame: view.frame.time_s for frame, view in step.views.items()}
        contents: dict[str, str | bytes] = {
            "trajectory.txt": tum_text(step.solution.trajectory, times_s),
            "odometry.txt": tum_text(step.solution.odometry, times_s),
            "graph.g2o": g2o_text(step.edges_so_far, step.solution),
        }
        if step.last and step.model is not None:
            contents |= {"cloud.ply": cloud_ply(step.model), "model.ply": mesh_ply(step.model)}
        if step.last and step.remasked:
            masks = {str(frame): np.asarray(step.views[frame].frame.mask) for frame in sorted(step.remasked)}
            np.savez_compressed(packed := io.BytesIO(), allow_pickle=False, **masks)
            contents[MASKS] = packed.getvalue()
        contents[_REPORT] = json.dumps(report, allow_nan=False) + "\n"
        for name, content in contents.items():
            write_atomically(self.path / name, content, lasting=step.last)
        if step.last and MASKS not in contents:  # those of the run before, if it is resumed with more frames
            (self.path / MASKS).unlink(missing_ok=True)
        if not step.last:
            settle_soon(*(self.path / name for name in contents), self.path)
        self.pace.took(time.monotonic() - began_s)
        return report

    def masks(self) -> dict[int, BoolArray]:
        """Return the masks (h, w) of views, by frame number, that are not those found in their frames alone.

        Raises:
            InputError: if they cannot be read.
        """
        path = self.path / MASKS
        if not path.exists():
            return {}
        check_regular(path)
        try:
            with np.load(path, allow_pickle=False) as masks:
                return {int(frame): np.asarray(masks[frame], dtype=np.bool_) for frame in masks}
        except (OSError, ValueError, RuntimeError, zipfile.BadZipFile, zlib.error, EOFError) as error:
            raise InputError(f"{path}: cannot be read ({error}); build the run again") from error

    def finish(self) -> None:
        """Bring the recording to the disk; take the mark of an unfinished run away unless it ended early.

        Raises:
            InputError: if that cannot be.
        """
        recording = self.path / _OURS[-1]
        try:
            settle(*(file for file in (recording,) if file.is_file()))
        except OSError as error:
            raise InputError(f"{recording}: cannot be written ({error.strerror}); choose another place") from error
        if self.report()["complete"]:
            try:
                self.pairs.complete()
            except OSError as error:
                raise InputError(f"{self.pairs.folder}: cannot be renamed ({error.strerror}); remove it") from error


def _listed(numbers: Collection[str]) -> str:
    """Return frame numbers in words, as in `frames 10 to 14 (5) are`."""
    known = sorted(int(number) for number in numbers if number.isdecimal())
    if len(known) == 1:
        return f"frame {known[0]} is"
    some = ", ".join(map(str, known)) if len(known) <= 5 else f"{known[0]} to {known[-1]} ({len(known)})"
    return f"frames {some} are"
