"""A connected camera: shown as it sees, and recorded view by view, when a person says so."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import final

import numpy as np

from modeler.export import write_atomically
from modeler.sequences import AbstractSequence, finest_unit_mm
from modeler.sequences.live import REACH_M
from modeler.system.pictures import encoded
from modeler.types import Frame, InputError


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
