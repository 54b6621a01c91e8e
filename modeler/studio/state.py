"""All scans of a folder, the capture that is being taken, and the commands that run: what every page shows."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from modeler.sequences import open_sequence
from modeler.studio.capture import IDLE_S, Capture, Recorder
from modeler.studio.jobs import Job, Queue
from modeler.studio.scan import STATE, Choices, Scan, next_run, page_job
from modeler.types import InputError


class Studio:
    """All scans of a folder, and the commands that run: what every page shows."""

    def __init__(self, out: Path, place: Path | None = None) -> None:
        """Take the folder in which scans are kept, and the one in which captures are offered first."""
        self.out = out
        self.place = place
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{out}: cannot be made ({error.strerror}); choose another `out`") from error
        self.queue = Queue(out / "jobs.json")
        self.current: Scan | None = None
        """The scan that pages show."""
        self.capture: Capture | None = None
        """The folder that is being written."""
        self.recorder: Recorder | None = None
        """The camera that writes it, if it is ours."""
        self.version = 0
        """Grows where pages must be drawn anew."""
        self._scans: dict[Path, Scan] = {}

    def open(self, sequence: Path) -> Scan:
        """Go on with the scan of a capture, or begin one."""
        folder, choices = self._chosen(sequence)
        if folder not in self._scans:
            scan = self._scans[folder] = Scan(folder, choices)
            scan.choose()
        self.show(self._scans[folder])
        return self._scans[folder]

    def watch(self, folder: Path, prior: str | None, step_deg: float | None) -> list[Job]:
        """Build from a folder that a camera program writes, frame by frame, and show what comes."""
        place, choices = self._chosen(folder)
        choices = replace(choices, prior=prior, step_deg=step_deg, dropped=())
        place.mkdir(parents=True, exist_ok=True)
        choices.write(place / STATE)
        run = next_run(place)
        words = ("build", choices.sequence, "--watch", "--idle-s", f"{IDLE_S:g}", "--out", str(run), *choices.options())
        job = Job(words, place / f"{run.name}.log", "Building the model as frames come")
        if self.capture is not None:
            self.capture.stop()
        self.capture = Capture(folder, job)
        return [job, page_job(run)]

    def record(self, camera: str, prior: str | None, step_deg: float | None) -> list[Job]:
        """Build from the views that a person takes with a connected camera."""
        self.release()
        sequence = open_sequence(camera)
        stem = camera.partition(":")[0]
        names = (self.out / "taken" / f"{stem}-{number}" for number in range(1, 10_000))
        self.recorder = Recorder(sequence, next(name for name in names if not name.exists()))
        self.recorder.folder.mkdir(parents=True)
        return self.watch(self.recorder.folder, prior, step_deg)

    def release(self) -> None:
        """Let go of camera and folder."""
        if self.recorder is not None:
            self.recorder.stop()
        if self.capture is not None:
            self.capture.stop()
        self.capture = self.recorder = None

    def _chosen(self, sequence: Path) -> tuple[Path, Choices]:
        """Return the folder and the choices of the scan of a capture, or those of a new one."""
        place = str(sequence.absolute())
        for folder in self.folders():
            if (kept := Choices.read(folder / STATE)).sequence == place:
                return folder, kept
        stem = re.sub(r"[^\w.-]+", "-", sequence.absolute().name).strip(".-") or "scan"
        names = (stem if number == 1 else f"{stem}-{number}" for number in range(1, 10_000))
        return next(self.out / name for name in names if not (self.out / name).exists()), Choices(place)

    def show(self, scan: Scan) -> None:
        """Have all pages show a scan."""
        self.current = scan
        self.version += 1

    def known(self, name: str) -> Scan | None:
        """Return the scan of a name, if it has been opened."""
        return self._scans.get(self.out / name)

    def folders(self) -> list[Path]:
        """Return the folders of scans, the newest first."""
        found = [path.parent for path in self.out.glob(f"*/{STATE}")]
        return sorted(found, key=lambda folder: (folder / STATE).stat().st_mtime, reverse=True)
