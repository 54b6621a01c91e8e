"""One scan: a capture, what of it is the object, and the runs made from it, kept in a folder of its own."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import shutil
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image, ImageDraw

from modeler.composition import compose
from modeler.composition.options import PriorOptions
from modeler.export import FORMATS, RunFolder, write_atomically
from modeler.segmentation import Segmenter, scene_frames
from modeler.sequences import AbstractSequence, KeptSequence, finest_unit_mm, open_sequence, scene_meta, write_bop
from modeler.studio.jobs import Job
from modeler.system.pictures import encoded
from modeler.system.regular_files import read_regular
from modeler.types import BoolArray, Camera, InputError, Outcome, Segmentation

STATE: Final = "scan.json"  # file of a scan's choices, by which its folder is known
_RUN: Final = re.compile(r"run-(\d+)")
MESHES: Final = tuple(suffix.removeprefix(".") for suffix in FORMATS)  # kinds of mesh files


@dataclass(frozen=True)
class Choices:
    """What a person has chosen."""

    sequence: str
    """Path of the capture."""
    roi: tuple[int, int, int, int] | None = None
    """Region of the object in px, x0 y0 x1 y1."""
    prior: str | None = None
    """Name of the motion prior; None: as the sequence says, else auto."""
    step_deg: float | None = None
    """Turn from frame to frame (turntable)."""
    step_sigma_deg: float | None = None
    """Its standard deviation (turntable)."""
    camera: str | None = None
    """File of the estimated focal length."""
    masked: str | None = None
    """Name of the folder of frames with the masks as they are now; None: not written."""
    dropped: tuple[int, ...] = ()
    """Frames taken out of the latest run."""

    @classmethod
    def read(cls, path: Path) -> Choices:
        """Read the choices of a scan."""
        try:
            found = json.loads(read_regular(path))
            known = {one.name for one in fields(cls)}
            given: dict[str, Any] = {name: found[name] for name in known & found.keys()}
            if not isinstance(given["sequence"], str):
                raise ValueError("its sequence is no path")
            given |= {name: tuple(one) for name, one in given.items() if isinstance(one, list)}
            return cls(**given)
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise InputError(f"{path}: is no scan of modeler studio ({error}); remove it") from error

    def write(self, path: Path) -> None:
        """Keep them, for a server after this one."""
        write_atomically(path, json.dumps(asdict(self), indent=1) + "\n")

    def options(self, *, within: bool = True) -> list[str]:
        """Return them as options of the build."""
        words = [] if self.prior is None else ["--prior", self.prior]
        if self.prior == "turntable" and self.step_deg is not None:
            words += ["--step-deg", f"{self.step_deg:g}"]
            words += [] if self.step_sigma_deg is None else ["--step-sigma-deg", f"{self.step_sigma_deg:g}"]
        if self.roi is not None and within:
            words += ["--roi", *map(str, self.roi)]
        return words + ([] if self.camera is None else ["--camera", self.camera])


class Scan:
    """A capture being made into a model. Methods may be called from any thread."""

    def __init__(self, folder: Path, choices: Choices) -> None:
        """Open a capture, and begin to look for the object in it."""
        self.folder, self.choices = folder, choices
        self.sequence: AbstractSequence = KeptSequence(open_sequence(Path(choices.sequence)))
        self.version = 0
        """Grows with every change that pages show."""
        self.found: dict[int, Segmentation] = {}
        """The object by frame number, as far as it has been looked for."""
        self.painted: dict[int, BoolArray] = self._read_painted()
        """Masks (h, w) corrected by hand, by frame number."""
        self.strokes: dict[int, int] = {}
        """Number of corrections since the start, by frame number: pictures of before are out of date."""
        self.fault = ""
        """Why the object is not found, if frames cannot be read."""
        self._asked = 0
        self._worker = ThreadPoolExecutor(1, "segmentation")
        self._lock = threading.RLock()
        self.look()

    @property
    def name(self) -> str:
        """Name of the scan, which is that of its folder."""
        return self.folder.name

    @property
    def looking(self) -> bool:
        """Whether the object has not been looked for in all frames yet."""
        return len(self.found) < len(self.sequence.indices)

    @property
    def looked(self) -> int:
        """How many times the object has been looked for anew."""
        return self._asked

    def mask(self, frame: int) -> BoolArray | None:
        """Return the object (h, w) in a frame; None if it has not been looked for yet."""
        if frame in self.painted:
            return self.painted[frame]
        return self.found[frame].mask if frame in self.found else None

    def doubts(self) -> dict[int, str]:
        """Return in words what is doubtful about the masks, by frame number."""
        found = list(self.found.items())
        return {
            k: one.outcome.label for k, one in found if one.outcome is not Outcome.CONVERGED and k not in self.painted
        }

    # What the object is

    def look(self) -> None:
        """Look for the object in all frames, in the background."""
        with self._lock:
            self._asked += 1
            self.found = {}
            self._changed()
            self._worker.submit(self._look, self._asked)

    def box(self, corner: tuple[float, float], opposite: tuple[float, float]) -> None:
        """Say that the object is within a box, given by two opposite corners (x, y) in px."""
        camera = self.sequence.frame(self.sequence.indices[0]).camera
        (x0, x1), (y0, y1) = (sorted((corner[axis], opposite[axis])) for axis in (0, 1))
        roi = max(0, int(x0)), max(0, int(y0)), min(camera.width, int(x1) + 1), min(camera.height, int(y1) + 1)
        if roi[2] - roi[0] < 2 or roi[3] - roi[1] < 2:
            raise InputError("the box lies outside the image; draw it around the object")
        self.choose(roi=roi)
        self.look()

    def point_at(self, frame: int, x: float, y: float) -> None:
        """Say that the object is at a pixel: it is looked for in the whole image, then in boxes around the pixel.

        The first is taken in which an object is found there that does not reach the edge of the box.
        """
        image = self.sequence.frame(frame)
        column, row, camera = int(x), int(y), image.camera
        if not (0 <= column < camera.width and 0 <= row < camera.height):
            raise InputError("that is outside the image; click on the object")
        mask = self.mask(frame)
        if mask is not None and mask[row, column]:
            return
        frames = [self.sequence.frame(k) for k in scene_frames(self.sequence.indices)]
        # Sides, as shares of the image's.
        for roi in (None, *(_around(column, row, share, camera) for share in (0.25, 0.4, 0.6, 0.85))):
            segmenter = Segmenter(roi=roi)
            inside = segmenter.segment(image, segmenter.scene(frames)).mask
            if inside[row, column] and not (roi is not None and _at_edge(inside, roi)):
                self.choose(roi=roi)
                self.look()
                return
        raise InputError("no object stands out there; draw a box around it, or paint it")

    def whole_image(self) -> None:
        """Forget the box."""
        self.choose(roi=None)
        self.look()

    def paint(self, frame: int, points: Sequence[tuple[float, float]], radius_px: float, *, add: bool) -> None:
        """Correct the mask of a frame with a stroke of a round brush.

        Args:
            frame: its number.
            points: (x, y) in px along the stroke.
            radius_px: of the brush.
            add: whether the stroke is object; otherwise it is not.
        """
        mask = self.mask(frame)
        if mask is None:
            raise InputError("the object is still being looked for in this frame; wait a moment")
        stroke = drawn(mask.shape, points, radius_px)
        with self._lock:
            self._keep_painted(frame, mask | stroke if add else mask & ~stroke)

    def unpaint(self, frame: int) -> None:
        """Take the found mask of a frame again."""
        with self._lock:
            if self.painted.pop(frame, None) is not None:
                self._painted_file(frame).unlink(missing_ok=True)
                self.strokes[frame] = self.strokes.get(frame, 0) + 1
                self.choose(masked=None)

    # Runs

    def runs(self) -> list[Path]:
        """Return the runs of `build`, from the first."""
        return runs_in(self.folder)

    @property
    def run(self) -> Path | None:
        """The latest run, without the frames taken out; None if there is none."""
        runs = self.runs()
        return None if not runs else self._edited(runs[-1]) if self.choices.dropped else runs[-1]

    def report(self) -> Mapping[str, Any] | None:
        """Return `report.json` of the latest run; None if there is none yet."""
        if (run := self.run) is None:
            return None
        with contextlib.suppress(InputError):
            return RunFolder(run).report()
        return None

    def build_jobs(self, *, resume: bool = False) -> list[Job]:
        """Return the build that the choices ask for, and its page; painted masks are written where it reads them."""
        run = self.runs()[-1] if resume else next_run(self.folder)
        words = ["build", str(self._source()), "--out", str(run), *self.options(), *(["--resume"] if resume else [])]
        if not resume:
            self.choose(dropped=())
        title, frames = "Building the model", len(self.sequence.indices)
        return [Job(tuple(words), self.folder / f"{run.name}.log", title, frames=frames), page_job(run)]

    def options(self) -> list[str]:
        """Return the options of the build; masks painted by hand were found within the box."""
        return self.choices.options(within=not self.painted)

    def line(self) -> str:
        """Return the command line of the next build."""
        source = self.folder / (self.choices.masked or "masked-1") if self.painted else self.choices.sequence
        return shlex.join(("modeler", "build", str(source), "--out", str(next_run(self.folder)), *self.options()))

    def edit_jobs(self, dropped: Sequence[int]) -> list[Job]:
        """Return the re-optimisation of the latest run without frames; nothing where all are back: it is as it was."""
        run = self.runs()[-1]
        self.choose(dropped=tuple(sorted(dropped)))
        if not dropped:
            return []
        out = self._edited(run)
        words = ("edit", str(run), "--drop", ",".join(map(str, sorted(dropped))), "--out", str(out), "--overwrite")
        return [Job(words, self.folder / f"{out.name}.log", "Optimising again"), page_job(out)]

    def calibrate_job(self, known: str | None = None) -> Job:
        """Return the estimation of the focal length from the latest run, for the next build.

        Args:
            known: what is accurate in the sequence, `focal-length` or `depth`; None: neither is known to be.
        """
        out = self.folder / f"camera-{len(self.runs())}.json"
        words = ("calibrate-camera", str(self.runs()[-1]), "--out", str(out), "--overwrite")
        words += () if known is None else ("--known", known)
        self.choose(camera=str(out))
        return Job(words, out.with_suffix(".log"), "Estimating the focal length")

    def suggest_job(self) -> Job:
        """Return the ranking of what to do next."""
        run = self._some_run()
        return Job(("suggest", str(run)), self.folder / f"{run.name}-suggest.log", "Looking for the next turn")

    def suggested(self) -> str:
        """Return what was suggested to be done next, for the latest run, a line each; "" before."""
        job = self.suggest_job()
        messages = [words for words in job.said() if not words.startswith("preparing")]
        ranked = job.out.read_text().splitlines()[:3] if job.out.exists() else []
        return "\n".join([*ranked, *messages[-1:]])

    def export_words(self) -> list[str]:
        """Return what exports have said of their files."""
        found = []
        for log in sorted(self.folder.glob("export-*.log"), key=lambda path: path.stat().st_mtime, reverse=True):
            found += Job((), log, "").said()[-1:]
        return found

    def export_job(self, what: str, *, texture: bool) -> Job:
        """Return an export of the latest run.

        Args:
            what: suffix of a mesh file, or the program that a folder is for.
            texture: whether an image is wrapped around the mesh; of files that can have one.
        """
        run, mesh = self._some_run(), what in MESHES
        out = self.shelf / (f"{self.name}.{what}" if mesh else f"{self.name}-{what}")
        if not mesh:
            shutil.rmtree(out, ignore_errors=True)  # an export of ours, of which parts may be others now
        words = ["export", str(run), "--out", str(out), "--overwrite"]
        words += ["--texture"] if texture and what in ("glb", "obj") else [] if mesh else ["--for", what]
        return Job(tuple(words), self.folder / f"export-{what}.log", f"Exporting {out.name}")

    @property
    def shelf(self) -> Path:
        """Folder of the exports."""
        return self.folder / "take-away"

    def exports(self) -> list[Path]:
        """Return what can be taken away, the newest first: files and folders."""
        entries = [path for path in self.shelf.glob("*") if not path.name.startswith(".")]
        return sorted(entries, key=lambda path: path.stat().st_mtime, reverse=True)

    @cached_property
    def usual_prior(self) -> str:
        """The prior where none is chosen."""
        return compose.prior_name(PriorOptions(), self.sequence)

    # Beneath

    def _some_run(self) -> Path:
        run = self.run
        if run is None:
            raise InputError("there is no model yet; build one")
        return run

    @staticmethod
    def _edited(run: Path) -> Path:
        return run.with_name(f"{run.name}-edited")

    def _source(self) -> Path:
        """Return the folder that a build reads: the capture, or its frames with the masks as they are shown."""
        if not self.painted:
            return Path(self.choices.sequence)
        with self._lock:
            if self.choices.masked is not None and (self.folder / self.choices.masked).is_dir():
                return self.folder / self.choices.masked
            if self.looking:
                raise InputError("the object is still being looked for in some frames; wait a moment")
            number = 1
            while (out := self.folder / f"masked-{number}").exists():
                number += 1
            frames = [self.sequence.frame(k) for k in self.sequence.indices]
            farthest_m = max(float(np.nanmax(frame.depth_m, initial=0.0)) for frame in frames)
            robot = self.sequence.robot_path
            write_bop(
                out,
                (replace(frame, mask=self.mask(frame.index)) for frame in frames),
                meta=scene_meta(self.sequence),
                depth_scale_mm=finest_unit_mm(farthest_m),
                files={} if robot is None else {robot.name: read_regular(robot)},
            )
            self.choose(masked=out.name)
            return out

    def _look(self, asked: int) -> None:
        """Find the object in each frame, as a build will, until something else is asked for."""
        segmenter, sequence = Segmenter(roi=self.choices.roi), self.sequence
        try:
            scene = segmenter.scene([sequence.frame(k) for k in scene_frames(sequence.indices)])
            for k in sequence.indices:
                found = segmenter.segment(sequence.frame(k), scene)
                with self._lock:
                    if asked != self._asked:
                        return
                    self.found[k] = found
                    self._changed()
        except InputError as error:
            self.fault = str(error)
            self._changed()

    def _keep_painted(self, frame: int, mask: BoolArray) -> None:
        write_atomically(self._painted_file(frame), encoded(mask.astype(np.uint8) * 255, "PNG"))
        self.painted[frame] = mask
        self.strokes[frame] = self.strokes.get(frame, 0) + 1
        self.choose(masked=None)

    def _painted_file(self, frame: int) -> Path:
        (self.folder / "painted").mkdir(parents=True, exist_ok=True)
        return self.folder / "painted" / f"{frame:06d}.png"

    def _read_painted(self) -> dict[int, BoolArray]:
        found = {}
        for path in sorted((self.folder / "painted").glob("*.png")):
            with contextlib.suppress(OSError, ValueError, InputError):
                found[int(path.stem)] = np.asarray(Image.open(io.BytesIO(read_regular(path)))) > 0
        return found

    def choose(self, **changes: Any) -> None:
        """Change choices by the names of their fields, and keep them: a server that is killed goes on from there."""
        with self._lock:
            self.choices = replace(self.choices, **changes)
            self.folder.mkdir(parents=True, exist_ok=True)
            self.choices.write(self.folder / STATE)
            self._changed()

    def _changed(self) -> None:
        self.version += 1


def _around(column: int, row: int, share: float, camera: Camera) -> tuple[int, int, int, int]:
    """Return the part of a box around a pixel that is in the image, its sides a share of the image's."""
    half_x, half_y = (max(1, round(0.5 * share * side)) for side in (camera.width, camera.height))
    left, top = max(0, column - half_x), max(0, row - half_y)
    return left, top, min(camera.width, column + half_x), min(camera.height, row + half_y)


def _at_edge(mask: BoolArray, roi: tuple[int, int, int, int]) -> bool:
    """Return whether a mask (h, w) reaches the edge of a box."""
    x0, y0, x1, y1 = roi
    inside = mask[y0:y1, x0:x1]
    return bool(inside[[0, -1]].any() or inside[:, [0, -1]].any())


def runs_in(folder: Path) -> list[Path]:
    """Return the runs of `build` in the folder of a scan, from the first."""
    found = ((match, path) for path in folder.glob("run-*") if (match := _RUN.fullmatch(path.name)))
    return [path for _, path in sorted(found, key=lambda one: int(one[0][1]))]


def next_run(folder: Path) -> Path:
    """Return the folder of the next run of a scan."""
    numbers = [int(match[1]) for path in runs_in(folder) if (match := _RUN.fullmatch(path.name))]
    return folder / f"run-{max(numbers, default=0) + 1}"


def page_job(run: Path) -> Job:
    """Return the writing of the page about a run."""
    return Job(("report", str(run), "--overwrite"), run.with_name(f"{run.name}-report.log"), "Drawing the pictures")


def drawn(shape: tuple[int, ...], points: Sequence[tuple[float, float]], radius_px: float) -> BoolArray:
    """Return the pixels (h, w) that a round brush covers along points (x, y) in px."""
    picture = Image.new("L", (shape[1], shape[0]))
    draw, width = ImageDraw.Draw(picture), max(1, round(2.0 * radius_px))
    if len(points) > 1:
        draw.line([*points], fill=255, width=width)
    for x, y in points:
        draw.ellipse((x - radius_px, y - radius_px, x + radius_px, y + radius_px), fill=255)
    return np.asarray(picture) > 0
