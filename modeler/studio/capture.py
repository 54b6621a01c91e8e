"""A capture that is being taken: by a camera of ours, or in a folder that one writes; and what is wrong with it."""

from __future__ import annotations

import contextlib
import json
import re
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial.transform import Rotation

from modeler.export import RunFolder, write_atomically
from modeler.segmentation import Scene, Segmenter
from modeler.sequences import AbstractSequence, Overrides, WatchLimits, finest_unit_mm
from modeler.sequences.base import FIRST
from modeler.sequences.live import REACH_M
from modeler.sequences.opening import arriving
from modeler.studio.jobs import Job
from modeler.system.pictures import encoded
from modeler.types import Array, BoolArray, Camera, Frame, InputError, Outcome, RayImage, Segmentation, SensorNoise
from modeler.verdict.evidence import TOLERANCE
from modeler.views import Sensor

IDLE_S: Final = 600.0  # a person who turns an object by hand, and is called away, takes so long at most
_LEARNT_FROM: Final = 12  # frames; the segmenter asks for about a dozen
_SENSOR: Final = Sensor(SensorNoise(sigma_r_m=None))  # noise of an unknown camera: a share of the distance


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
            dark, bright = 100.0 * (light < 5).mean(), 100.0 * (light > 250).mean()  # whatever was there
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
            found.append("the camera seems to move; keep it still, or the object")
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


_STEP: Final = 0.1  # of the distance: less is one surface, seen at a slant
_GHOST_PX: Final = 3  # closes gaps of 6 px between them, and clears specks as wide
_TURN: Final = re.compile(r"turn by (\d+)°")


def nothing_near(depth_m: npt.NDArray[np.float32]) -> bool:
    """Return whether most of the middle of a depth image (h, w) is not measured, as where something is too close."""
    rows, columns = (slice(round(0.25 * side), round(0.75 * side)) for side in depth_m.shape)
    return bool(np.mean(depth_m[rows, columns] > 0.0) < 0.5)


def is_filled(depth_m: npt.NDArray[np.float32]) -> bool:
    """Return whether a depth image (h, w) seems to have had its holes filled by the camera's program.

    Beside an edge, one of a camera's two lenses sees a background that the other does not: unless somebody fills them,
    some pixels there have no depth. Time-of-flight cameras lose those pixels too, as they mix two surfaces.
    """
    known = depth_m > 0.0
    if np.mean(~known) > 1e-3:  # ten recordings of whole scenes lack 0.01 to 0.3 of all pixels
        return False
    left, right = depth_m[:, :-1], depth_m[:, 1:]
    with np.errstate(invalid="ignore"):
        steps = np.abs(right - left) > _STEP * np.minimum(left, right)
    return bool(np.count_nonzero(steps) > depth_m.shape[0] // 10)


def too_far(view: RayImage) -> str:
    """Return that the camera's noise is large for the object, in words; "" if it is not.

    It is large if its standard deviation exceeds the usual tolerance on a model of this size: every third pixel would.
    """
    tolerance_m, distance_m = TOLERANCE * view.size_m, float(view.centroid_m[2])
    if view.sigma_r_m <= tolerance_m:
        return ""
    return (
        f"too far for its size: at {distance_m:.2f} m the camera's noise is {1000.0 * view.sigma_r_m:.1f} mm; go "
        f"nearer, to {distance_m * tolerance_m / view.sigma_r_m:.2f} m if the camera can measure there"
    )


def suggested_turn_deg(words: str) -> float | None:
    """Return the turn that a build suggests in words, right-handed about up; None if it suggests none."""
    found = _TURN.search(words)
    return None if found is None else float(found[1]) * (-1.0 if "(clockwise" in words else 1.0)


def ghost(frames: Mapping[int, tuple[Frame, BoolArray]], report: Mapping[str, Any], turn_deg: float) -> BoolArray:
    """Return where the object will be seen (h, w) once it has been turned from its newest pose.

    Args:
        frames: some frames of a run with the object's masks (h, w), by frame number.
        report: of the run so far.
        turn_deg: about the support's normal, right-handed about up; the object stays at its place.
    """
    poses = {pose["id"]: np.reshape(pose["object_from_camera"], (4, 4)) for pose in report["poses"]}
    placed = sorted(set(frames) & set(poses))
    points_m = np.concatenate([_in_object(*frames[number], poses[number]) for number in placed] or [np.empty((0, 3))])
    camera = next(iter(frames.values()))[0].camera
    if not len(points_m):
        return np.zeros((camera.height, camera.width), dtype=bool)
    up = np.asarray(report.get("up") or (0.0, -1.0, 0.0), dtype=np.float64)
    # Pixels at edges may lie anywhere, and the mean would lean to what was seen most.
    middle_m = np.percentile(points_m, (2, 98), axis=0).mean(axis=0)
    turn = Rotation.from_rotvec(np.radians(turn_deg) * up)
    turned_m = turn.apply(points_m - middle_m) + middle_m
    newest = poses[placed[-1]]
    return _covered((turned_m - newest[:3, 3]) @ newest[:3, :3], camera)


def _in_object(frame: Frame, mask: BoolArray, object_from_camera: Array) -> Array:
    """Return some points (n, 3) of the object in its own coordinates."""
    rows, columns = np.nonzero(mask & (frame.depth_m > 0.0))
    some = slice(None, None, max(len(rows) // 3000, 1))  # of an object of 300 x 300 px, one in 30 pixels
    w, h = frame.camera.rays()
    places = rows[some], columns[some]
    depth_m = frame.depth_m[places].astype(np.float64)
    points_m = np.stack([w[places], h[places], np.ones(len(depth_m))], axis=1) * depth_m[:, None]
    return points_m @ object_from_camera[:3, :3].T + object_from_camera[:3, 3]


def _covered(points_m: Array, camera: Camera) -> BoolArray:
    """Return the pixels (h, w) that points (n, 3) of a surface cover, gaps between them closed."""
    found = np.zeros((camera.height, camera.width), dtype=bool)
    x, y, z = points_m[points_m[:, 2] > 0.0].T
    columns, rows = np.rint(camera.fx * x / z + camera.cx), np.rint(camera.fy * y / z + camera.cy)
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    found[rows[inside].astype(np.int64), columns[inside].astype(np.int64)] = True
    closed = ndimage.binary_closing(np.pad(found, _GHOST_PX), iterations=_GHOST_PX)
    without_specks = ndimage.binary_opening(closed, iterations=_GHOST_PX)
    return np.asarray(without_specks[_GHOST_PX:-_GHOST_PX, _GHOST_PX:-_GHOST_PX], dtype=bool)
