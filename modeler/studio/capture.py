"""A capture that is being taken: by a camera of ours, or in a folder that one writes; and what is wrong with it."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from modeler.export import RunFolder, write_atomically
from modeler.segmentation import Scene, Segmenter
from modeler.sequences import AbstractSequence, Overrides, WatchLimits, finest_unit_mm
from modeler.sequences.base import FIRST
from modeler.sequences.live import REACH_M
from modeler.sequences.watch import arriving
from modeler.studio.aiming import ghost, is_filled, nothing_near, suggested_turn_deg, too_far
from modeler.studio.jobs import Job
from modeler.system.pictures import encoded
from modeler.types import BoolArray, Frame, InputError, Outcome, Segmentation, SensorNoise
from modeler.views import Sensor

IDLE_S: Final = 600.0
"""A person who turns an object by hand, and is called away, takes so long at most."""
_LEARNT_FROM: Final = 12  # frames; the segmenter asks for about a dozen
_SENSOR: Final = Sensor(SensorNoise(sigma_r_m=None))  # noise of an unknown camera: a share of the distance
_END_PX: Final = (5, 250)  # colours beyond are black or saturated, whatever was there


@final
class Capture:
    """Follows a folder from a thread of its own until the build that reads it ends."""

    def __init__(self, folder: Path, job: Job) -> None:
        """Begin to follow a folder, which need not be there yet, and the build that watches it."""
        self.folder, self.job = folder, job
        self.frame: Frame | None = None
        """The newest frame."""
        self.found: Segmentation | None = None
        """The object in it; None before the scene is learned."""
        self.count = 0
        """Number of frames so far."""
        self.fault = ""
        """Why nothing can be read."""
        self.kept: dict[int, tuple[Frame, BoolArray]] = {}
        """The newest frames in which the object was found, with its masks, by frame number."""
        self._too_far = ""
        self._came_s = time.monotonic()
        self._scene = Scene()
        self._stopped = threading.Event()
        threading.Thread(target=self._follow, daemon=True, name="capture").start()

    def stop(self) -> None:
        """Follow the folder no longer."""
        self._stopped.set()

    @property
    def mask(self) -> BoolArray | None:
        """The object (h, w) in the newest frame."""
        return None if self.found is None else self.found.mask

    @property
    def waits_s(self) -> float:
        """For how long no frame has come."""
        return time.monotonic() - self._came_s

    def facts(self) -> list[str]:
        """Return distance, size and exposure of the object in the newest frame, in words."""
        frame, mask = self.frame, self.mask
        if frame is None or mask is None or not mask.any():
            return []
        depth_m = frame.depth_m[mask]
        measured = depth_m > 0.0
        if not measured.any():
            return ["nothing is measured on the object"]
        rows, columns = np.nonzero(mask)
        words = [
            f"{float(np.median(depth_m[measured])):.2f} m away, {np.ptp(columns) + 1} x {np.ptp(rows) + 1} pixels, "
            f"{100.0 * measured.mean():.0f} % of them measured"
        ]
        if frame.colour is not None:
            light = frame.colour[mask].max(axis=1)
            dark, bright = (
                100.0 * float(share) for share in ((light < _END_PX[0]).mean(), (light > _END_PX[1]).mean())
            )
            words.append(f"exposure: {dark:.0f} % of it black, {bright:.0f} % saturated")
        return words

    def doubts(self) -> list[str]:
        """Return what looks wrong, in words."""
        found = []
        if self.found is not None and self.found.outcome is not Outcome.CONVERGED:
            found.append(f"{self.found.outcome.label}: {self.found.outcome.advice}".replace("`", ""))
        if self.frame is not None and (self.mask is None or not self.mask.any()) and nothing_near(self.frame.depth_m):
            found.append("the middle of the image has no depth: too close, or shiny, dark or transparent")
        if self.frame is not None and is_filled(self.frame.depth_m):
            found.append(
                "hole filling seems on: depth has no holes, not even beside edges; switch it off in the camera"
            )
        if self._too_far:
            found.append(self._too_far)
        if self._scene.camera_moves:
            found.append("the camera seems to move; keep it still")
        if self._scene.arms:
            found.append("an arm is in view; take it out of the image before each frame")
        return [*found, *([self.fault] if self.fault else [])]

    def said(self) -> tuple[bool | None, str]:
        """Return whether the build has placed the newest frame, None where it has not said yet, and its words."""
        placed, words = None, ""
        for _, _, line in self.job.messages():
            if line.startswith("frame "):
                placed, words = "left out" not in line, line.partition(";")[0]
        return placed, words

    def report(self) -> Mapping[str, Any] | None:
        """Return the report of the run so far; None before there is one."""
        with contextlib.suppress(InputError):
            return RunFolder(Path(self.job.words[self.job.words.index("--out") + 1])).report()
        return None

    def next(self) -> str:
        """Return what the build suggests to do next; "" before."""
        suggested = [line for _, _, line in self.job.messages() if line.startswith(("next: ", "nothing more"))]
        return suggested[-1] if suggested else ""

    def ghost(self) -> BoolArray | None:
        """Return where the object (h, w) will be after the turn that the build suggests; None if it suggests none."""
        turn_deg, report = suggested_turn_deg(self.next()), self.report()
        kept = dict(self.kept)
        return None if turn_deg is None or report is None or not kept else ghost(kept, report, turn_deg)

    def _follow(self) -> None:
        """Take the frames as they come."""
        kept: list[Frame] = []
        try:
            for frame in arriving(self.folder, Overrides(), WatchLimits(IDLE_S), self._stopped.is_set):
                kept = [*kept, frame][-_LEARNT_FROM:]
                self.count += 1
                if self.count >= FIRST and self.count <= _LEARNT_FROM:
                    self._scene = Segmenter().scene(kept)
                self.found = Segmenter().segment(frame, self._scene) if self.count >= FIRST else None
                if self.found is not None and self.found.mask.any():
                    self._found(frame, self.found.mask)
                self.frame, self._came_s = frame, time.monotonic()
        except InputError as error:
            self.fault = str(error).replace("`", "")

    def _found(self, frame: Frame, mask: BoolArray) -> None:
        """Keep a frame in which the object was found."""
        newest = [*self.kept.items()][1 - _LEARNT_FROM :]
        self.kept = {**dict(newest), frame.index: (frame, mask)}
        view = _SENSOR.ray_image(replace(frame, mask=mask))
        self._too_far = too_far(view) if len(view.points_m) else ""


@final
class Recorder:
    """Takes the images of a camera from a thread of its own, and writes those that are wanted into a folder."""

    def __init__(self, camera: AbstractSequence, folder: Path) -> None:
        """Begin to look through a camera; `folder` will hold the views, as `modeler build --watch` reads them."""
        self.folder = folder
        self.frame: Frame | None = None
        """The newest image."""
        self.shown = 0
        """Number of images so far."""
        self.taken = 0
        """Number of views in the folder."""
        self.fault = ""
        """Why no more images come."""
        self._camera = camera
        self._wanted, self._stopped = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True, name="camera")
        self._thread.start()

    def take(self) -> None:
        """Keep the next image."""
        self._wanted.set()

    def stop(self) -> None:
        """Let go of the camera."""
        self._stopped.set()
        self._thread.join()

    def _follow(self) -> None:
        try:
            for frame in self._camera.until(self._stopped.is_set):
                self.frame = frame
                self.shown += 1
                if self._wanted.is_set():
                    self._wanted.clear()
                    self._write(frame)
                if self._stopped.is_set():
                    return
        except InputError as error:
            self.fault = str(error)

    def _write(self, frame: Frame) -> None:
        """Write a view: depth last, with which it is complete."""
        name, camera, unit_mm = f"{self.taken:06d}.png", frame.camera, finest_unit_mm(REACH_M)
        if not self.taken:
            known = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "depth_scale": unit_mm}
            write_atomically(self.folder / "camera.json", json.dumps(known) + "\n")
        if frame.colour is not None:
            write_atomically(self.folder / "rgb" / name, encoded(frame.colour, "PNG", compress_level=1))
        near_m = np.where((frame.depth_m > 0.0) & (frame.depth_m < REACH_M), frame.depth_m, 0.0)
        depth = np.rint(near_m * (1000.0 / unit_mm)).astype(np.uint16)
        write_atomically(self.folder / "depth" / name, encoded(depth, "PNG", compress_level=1))
        self.taken += 1
