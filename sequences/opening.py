"""Selects the reader of a path by its contents, and follows a folder that another program is still writing into."""

from __future__ import annotations

import contextlib
import difflib
import logging
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from modeler.sequences.base import FIRST, AbstractDerived, AbstractLive, AbstractSequence
from modeler.sequences.bop import BopSequence
from modeler.sequences.calibrated import AxialSequence
from modeler.sequences.clouds import SUFFIXES as CLOUD_SUFFIXES
from modeler.sequences.clouds import open_clouds
from modeler.sequences.hand_shapes import with_hand
from modeler.sequences.image_folders import (
    COLOUR_FOLDERS,
    DEPTH_FOLDERS,
    images_in_folders,
    images_in_one_folder,
    images_of_transforms,
    open_colour_depth,
)
from modeler.sequences.input_files import check_links, entries, first_folder, is_there
from modeler.sequences.intrinsics import Overrides
from modeler.sequences.live import LIBRARIES, open_camera
from modeler.sequences.survey import survey
from modeler.sequences.tum import open_tum
from modeler.sequences.videos import open_record3d
from modeler.system.regular_files import check_regular, unreadable
from modeler.types import Frame, InputError, checked

FORMATS = (
    "a folder with depth/ (BOP, TUM RGB-D, Open3D, BundleSDF, your own), organised clouds, a ROS bag, a RealSense "
    "recording, an Azure Kinect .mkv, or realsense:, orbbec:, oak: or azure: for a camera"
)
BAGS = (".bag", ".mcap", ".db3")


@checked
def open_sequence(path: str | Path, overrides: Overrides | None = None) -> AbstractSequence:
    """Open the sequence at a path in whichever supported format.

    Args:
        path: a folder or a file, or `realsense:`, `orbbec:`, `oak:` or `azure:` for a live camera.
        overrides: values that take precedence over the files.

    Raises:
        InputError: if it does not hold a readable sequence, or, on request, a link leads out of it.
    """
    path, overrides = Path(path), overrides or Overrides()
    if not _is_text(path):
        raise InputError(f"{path}: its name is not UTF-8; rename it.")
    maker, colon, serial = str(path).partition(":")
    if colon and maker in LIBRARIES and not path.exists():
        return open_camera(maker, serial, overrides)
    try:
        found = with_hand(_open(path, overrides))
        return AxialSequence(found) if overrides.along_ray else found
    except OSError as error:
        raise unreadable(path, error) from None


def _suggestion(path: Path) -> str:
    """Return a suggestion of a similar name in the same folder, "" if there is none."""
    with contextlib.suppress(OSError):  # the error about the path itself follows
        siblings = [other.name for other in path.parent.iterdir()]
        if near := difflib.get_close_matches(path.name, siblings, n=1, cutoff=0.75):
            return f"did you mean {path.parent / near[0]}? Else "
    return ""


def _open(path: Path, overrides: Overrides) -> AbstractSequence:
    if not path.exists():
        raise InputError(f"{path}: no such folder or file; {_suggestion(path)}give {FORMATS}.")
    if not path.is_dir():
        check_regular(path)
    elif overrides.strict_paths:
        check_links(path)
    recorded = [entry for entry in entries(path) if entry.suffix.lower() in BAGS] if path.is_dir() else []
    if len(recorded) == 1 and not is_there(path / "metadata.yaml"):  # which a recorder that crashed does not write
        path = recorded[0]
    if path.suffix.lower() in BAGS or is_there(path / "metadata.yaml"):
        from modeler.sequences.ros import open_ros

        return open_ros(path, overrides)
    if is_there(path / "report.json"):
        raise InputError(f"{path}: is the folder of a run; give the sequence it was made from, or convert its poses.")
    if path.is_file() and path.suffix.lower() == ".mkv":
        from modeler.sequences.videos import open_kinect

        return open_kinect(path, overrides)
    if path.is_file() and path.suffix.lower() == ".r3d":
        return open_record3d(path, overrides)
    if (path.is_file() and path.suffix.lower() in CLOUD_SUFFIXES) or _holds_clouds(path):
        return open_clouds(path, overrides)
    if not path.is_dir():
        raise InputError(f"{path}: a file of this kind holds no sequence; give {FORMATS}.")
    if is_there(path / "scene_camera.json"):
        return BopSequence(path, overrides)
    if is_there(path / "depth.txt"):
        return open_tum(path, overrides)
    if (path / "keyframes" / "depth").is_dir():  # Polycam's
        path = path / "keyframes"
    if (listed := images_of_transforms(path)) is not None:
        return open_colour_depth(path, listed, overrides)
    if first_folder(path, DEPTH_FOLDERS) is not None:
        return open_colour_depth(path, images_in_folders(path), overrides)
    if (found := images_in_one_folder(path)) is not None:
        return open_colour_depth(path, found, overrides)
    raise InputError(f"{path}: {_advice(path)}")


def _is_text(path: Path) -> bool:
    """Return whether a path can be written out: on Linux a name is any bytes."""
    try:
        return bool(str(path).encode())
    except UnicodeEncodeError:
        return False


def _holds_clouds(path: Path) -> bool:
    """Return whether a folder holds clouds and no depth images."""
    marks = ("scene_camera.json", "depth.txt", *DEPTH_FOLDERS)
    if not path.is_dir() or any((path / mark).exists() for mark in marks):
        return False
    clouds = any(entry.suffix.lower() in CLOUD_SUFFIXES for entry in entries(path))
    return clouds and images_in_one_folder(path) is None


def _folders(path: Path) -> list[str]:
    return [entry.name for entry in entries(path) if entry.is_dir()]


def _scenes(path: Path, names: list[str]) -> list[str]:
    """Return which of the folders of these names hold depth as sequences do."""
    return [name for name in names if any((path / name / mark).exists() for mark in ("depth", "depth.txt"))]


def _advice(path: Path) -> str:
    """Return the error for a folder without depth."""
    inner = _folders(path)
    scenes = _scenes(path, inner) or _scenes(
        path, [f"{name}/{deeper}" for name in inner for deeper in _folders(path / name)]
    )
    if scenes:
        more, one = ", ..." if len(scenes) > 3 else "", len(scenes) == 1
        held, which = ("a sequence", "it") if one else (f"{len(scenes)} sequences", "one of them")
        return f"holds {held}; give {which}: {', '.join(scenes[:3])}{more}."
    of_depth = [name for name in inner if "depth" in name.lower()]
    if len(of_depth) == 1:
        return f"holds no folder depth; if its depth images are those in {of_depth[0]}, rename that to depth."
    if any(name in COLOUR_FOLDERS for name in inner):
        return "holds colour but no depth images; only depth can be registered, put it into depth/."
    if path.absolute().name == "depth":
        return f"is the folder of the images alone; give the one it lies in, {path.absolute().parent}."
    if any(entry.suffix.lower() == ".png" for folder in ("", *inner) for entry in entries(path / folder)):
        return (
            "holds images but no folder depth; put the depth images into one, and camera.json or cam_K.txt next to it."
        )
    return f"holds no depth images where they are looked for; give {FORMATS}."


_log = logging.getLogger(__name__)

END = "done"  # a file of this name in the folder marks the end of the sequence
POLL_S = 0.05  # polling interval of the folder
REST = 3.0
"""So many times as long as looking took is rested at least: of 10,000 frames it takes 0.1 s."""


@dataclass(frozen=True)
class WatchLimits:
    """Time limits of watching a folder."""

    idle_s: float = 10.0
    """When nothing has come for so long, the sequence is over."""
    settle_s: float = 0.5
    """The newest frame is taken once the folder has not changed for so long: its colour and mask may come late."""
    first: int = FIRST
    """Number of frames to wait for before the sequence is described."""


@dataclass(frozen=True)
class WatchedSequence(AbstractLive, AbstractDerived):
    """The frames in a folder, and those that will come, each once it is complete.

    `indices`, `name` and the rest keep their values from when the sequence was opened.
    """

    path: Path
    """The folder, in any layout of pictures."""
    overrides: Overrides = field(default_factory=Overrides)
    """Values that take precedence over the files."""
    patience: WatchLimits = field(default_factory=WatchLimits)

    @property
    def indices(self) -> tuple[int, ...]:
        wanted = [index for index in self.whole.indices if self._wants(index)]
        return tuple(wanted[:: self.every])

    def recorded(self) -> AbstractSequence:
        return self.whole

    def __iter__(self) -> Iterator[Frame]:
        """Yield each frame when it is complete, until none has come for a while."""
        wanted = -1
        for frame in arriving(self.path, self.overrides, self.patience, self.stop):
            if self.kept.stop is not None and frame.index >= self.kept.stop:
                return
            if not self._wants(frame.index):
                continue
            wanted += 1
            if wanted % self.every == 0:
                yield frame

    @property
    def layout(self) -> str:
        return f"{self.whole.layout}, being written"

    def _wants(self, index: int) -> bool:
        low, high = self.kept.start, self.kept.stop
        return (low is None or index >= low) and (high is None or index < high)


def arriving(path: Path, overrides: Overrides, patience: WatchLimits, stop: Callable[[], bool]) -> Iterator[Frame]:
    """Yield frames, each once it is complete, until none has come for a while.

    They ascend, but for a frame that comes, or can be read, only after later ones. What can never be read is reported
    to the log and left out, if there are other frames.
    """
    taken: set[int] = set()
    failing: dict[int, _Failing] = {}
    coming: list[int] = []  # those in the folder that are not taken
    known, fault = False, ""  # whether `coming` is as the folder is now, and why it cannot be opened
    came_s = changed_s = time.monotonic()
    before = 0
    while not stop():
        now, ended = time.monotonic(), (path / END).exists()  # what came before it, the look finds
        if (state := _state(path)) != before:
            before, changed_s, known = state, now, False
        idle = now - max(came_s, changed_s) >= patience.idle_s
        settled = ended or now - changed_s >= patience.settle_s
        opened = None
        if not known or any(
            ended or idle or index not in failing or now >= failing[index].again_s
            for index in (coming if settled else coming[:-1])
        ):
            try:
                opened, fault, known = open_sequence(path, overrides), "", True
                coming = [index for index in opened.indices if index not in taken]
            except InputError as error:  # half-written, perhaps
                fault, known, coming = str(error), False, []
        rest_s = max(POLL_S, REST * (time.monotonic() - now))
        for index in () if opened is None else coming if settled else coming[:-1]:
            assert opened is not None
            failed = failing.get(index, _Failing(now, now))
            frame = None
            if ended or idle or now >= failed.again_s:
                try:
                    frame = opened.frame(index)
                except InputError as error:
                    failing[index] = _Failing(failed.since_s, 2.0 * now - failed.since_s, str(error))
            if frame is None and not ended and now - failed.since_s < patience.settle_s:
                break  # it may be being written
            if frame is None:
                continue
            failing.pop(index, None)
            yield frame
            taken.add(index)
            came_s = time.monotonic()  # which the taker may have spent long with
            if stop():
                return
        coming = [index for index in coming if index not in taken]
        if ended or (idle and time.monotonic() - max(came_s, changed_s) >= patience.idle_s):
            for words in [fault] if fault else [failing[index].words for index in coming if index in failing]:
                if not taken:
                    raise InputError(words)
                _log.warning("%s: continuing with the frames so far", words.rstrip("."))
            return
        opened = None  # it has some names for each frame
        time.sleep(rest_s)


@checked
def watch(path: str | Path, overrides: Overrides | None = None, patience: WatchLimits | None = None) -> WatchedSequence:
    """Wait for the first frames in a folder, which need not be there yet, and return the sequence that they begin.

    Raises:
        InputError: if no readable frame comes in time.
    """
    path, overrides, patience = Path(path), overrides or Overrides(), patience or WatchLimits()
    first: list[int] = []
    for frame in arriving(path, overrides, patience, lambda: len(first) == patience.first):
        first.append(frame.index)
    if not first:
        raise InputError(f"{path}: no frame has come in {patience.idle_s:g} s; start the program that writes them.")
    seen = open_sequence(path, overrides).select(frames=slice(None, max(first) + 1))
    survey(seen, truth=False)
    return WatchedSequence(seen, path, overrides, patience)


class _Failing(NamedTuple):
    """A frame that cannot be read."""

    since_s: float
    """Of when."""
    again_s: float
    """When it is tried again: a damaged one costs less the longer it is."""
    words: str = ""
    """Why; not the error itself, which holds the images that were read before it."""


def _state(folder: str | Path, *, deep: bool = True) -> int:
    """Return a number that is another once a file in a folder, or in a folder in it, is made, changes or goes."""
    state = 0
    with contextlib.suppress(OSError), os.scandir(folder) as entries:  # it may go away meanwhile
        for entry in entries:
            with contextlib.suppress(OSError):  # so may a file, or it is a link to nothing
                status = entry.stat()
                state += hash((entry.path, status.st_mtime_ns, status.st_size))
                state += _state(entry.path, deep=False) if deep and entry.is_dir() else 0
    return state
