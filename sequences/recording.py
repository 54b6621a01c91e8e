"""Sequences stored on disk, and those of two streams whose images are paired by time."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from modeler.sequences.base import AbstractSequence, span
from modeler.sequences.input_files import Node, is_there, read_tree
from modeler.sequences.lens import Lens
from modeler.types import CALIBRATED_FOCAL, MULTIPATH, NOMINAL_FOCAL, Frame, InputError, SensorNoise

_SENSOR: Final = {
    "sigma_wh": (1e-9, 1.0),
    "sigma_r_m": (1e-9, 10.0),
    "sigma_colour_px": (0.0, 100.0),
    "sigma_focal": (0.0, 0.2),
    "sigma_multipath": (0.0, 1.0),
}
"""Range of each value of `sensor`."""


@dataclass(frozen=True)
class AbstractRecording(AbstractSequence):
    """A sequence in a folder or a file, of whatever format.

    Facts outside the format are read from `sequence.json` in the folder, or from `NAME.json` next to a file `NAME.bag`.
    """

    path: Path
    remarks: tuple[str, ...] = field(default=(), kw_only=True)
    """Assumptions and omissions of the reader, and of the format."""
    calibrated: bool = field(default=False, kw_only=True)
    """Whether the intrinsics are of a calibration of this camera, not typed in or nominal."""
    kind: str | None = field(default=None, kw_only=True)
    """Kind of the depth camera, of `MULTIPATH`, where the format states it."""

    def __post_init__(self) -> None:
        """Check `sequence.json`."""
        _ = self.name, self.sensor(), self.motion

    @property
    def notes(self) -> tuple[str, ...]:
        return self.remarks

    @property
    def name(self) -> str:
        """Name of the sequence: from `sequence.json`, else that of the folder or file."""
        node = self.facts.get("name")
        resolved = self.path.resolve()
        return (resolved.name if self._is_folder else resolved.stem) if node is None else node.text()

    @property
    def inputs(self) -> tuple[Path, ...]:
        return (self.path,)

    def sensor(self) -> SensorNoise | None:
        """Return the noise of the camera from `sequence.json` and as the format states it; None if neither says."""
        node = self.facts.get("sensor")
        by_format = SensorNoise(
            sigma_r_m=None,
            sigma_focal=CALIBRATED_FOCAL if self.calibrated else NOMINAL_FOCAL,
            sigma_multipath=0.0 if self.kind is None else MULTIPATH[self.kind],
        )
        if node is None:
            return by_format if self.calibrated or self.kind is not None else None
        kind = node.get("kind")
        if kind is not None and kind.value not in MULTIPATH:
            raise kind.fault(f"one of {', '.join(MULTIPATH)}")
        stated = {name: node.get(name) for name in _SENSOR}
        values = {name: entry.number(*_SENSOR[name]) for name, entry in stated.items() if entry is not None}
        if kind is not None:
            values = {"sigma_multipath": MULTIPATH[str(kind.value)], **values}
        elif not values:
            node.need("sigma_r_m")
        return by_format._replace(**values)

    @property
    def motion(self) -> Mapping[str, Any] | None:
        node = self.facts.get("motion")
        return None if node is None else _motion(node)

    @property
    def robot_path(self) -> Path | None:
        """`robot.txt`, where there is one."""
        return self._beside("robot.txt")

    @property
    def model_path(self) -> Path | None:
        """`model.ply`, where there is one: the true surface in m."""
        return self._beside("model.ply")

    @cached_property
    def facts(self) -> Node:
        """Contents of `sequence.json`; nothing without one."""
        path = self.path / "sequence.json" if self._is_folder else self.path.with_suffix(".json")
        return read_tree(path) if is_there(path) else Node({}, path)

    def absent(self, index: int) -> InputError:
        """Return the error that says that there is no frame of that number."""
        return InputError(f"{self.path}: has no frame {index}; its frames are {span(self.indices)}.")

    def _beside(self, name: str) -> Path | None:
        """Return a file in the folder, where there is one."""
        path = self.path / name
        return path if self._is_folder and is_there(path) else None

    @cached_property
    def _is_folder(self) -> bool:
        return self.path.is_dir()


MOTIONS = ("general", "table", "turntable", "held", "poke")  # kinds of motion, each a prior
_RANGES = {"step_deg": (-360.0, 360.0), "sigma_deg": (0.0, 180.0), "shift_m": (0.0, 10.0)}


def _motion(node: Node) -> dict[str, object]:
    """Return the entry `motion` of `sequence.json` after a check of everything in it."""
    values: dict[str, object] = {}
    for key, entry in node.items().items():
        if key == "kind":
            if entry.value not in MOTIONS:
                raise entry.fault(f"one of {', '.join(MOTIONS)}")
            values[key] = entry.value
        elif key in _RANGES:
            values[key] = entry.number(*_RANGES[key])
        elif key == "pokes":
            values[key] = {str(number): _poke(poke) for number, poke in entry.frames().items()}
        else:
            raise entry.unknown(("kind", *_RANGES, "pokes"))
    return values


def _poke(node: Node) -> dict[str, object]:
    """Return one entry of `pokes`, in camera coordinates."""
    known = ("point_m", "direction", "length_m")
    for key, entry in node.items().items():
        if key not in known:
            raise entry.unknown(known)
    point_m, direction = node.need("point_m").numbers(3), node.need("direction").numbers(3)
    if not direction.any():
        raise node.need("direction").fault("a direction that is not zero")
    length_m = node.need("length_m").number(1e-6, 10.0)
    return {"point_m": point_m.tolist(), "direction": direction.tolist(), "length_m": length_m}


Stamp = TypeVar("Stamp")  # key of an image in its stream
MAX_APART_S = 0.02
"""Depth and colour farther apart in time than this are no pair (the TUM benchmark's own tool has the same)."""


@dataclass(frozen=True)
class ImagePair(Generic[Stamp]):
    """A depth image, and the colour image that was taken with it."""

    time_s: float
    """Time of the depth image in s."""
    depth: Stamp
    colour: Stamp | None
    """The colour image; None if none is near enough in time."""


@dataclass(frozen=True)
class AbstractStreams(AbstractRecording, Generic[Stamp]):
    """Streams of depth and colour images, with lens distortion."""

    lens: Lens
    """The depth camera."""
    pairs: Mapping[int, ImagePair[Stamp]]
    """By frame number: places in order of time."""

    @abstractmethod
    def seen_m(self, index: int, stamp: Stamp) -> npt.NDArray[np.float32]:
        """Return the depth (h, w) in m as the lens shows it, NaN where nothing was measured."""

    @abstractmethod
    def colour_at(self, index: int, stamp: Stamp, depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8] | None:
        """Return colour (h, w, 3) as RGB at the pixels of a depth image (h, w) without distortion; None without."""

    @property
    def indices(self) -> tuple[int, ...]:
        return tuple(self.pairs)

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`, without the lens's distortion."""
        pair = self.pairs.get(index)
        if pair is None:
            raise self.absent(index)
        depth_m = self.lens.undistort(self.seen_m(index, pair.depth), float("nan"))
        colour = None if pair.colour is None else self.colour_at(index, pair.colour, depth_m)
        return Frame(index, pair.time_s, depth_m, self.lens.camera, None, colour)


def paired(
    depth: Sequence[tuple[float, Stamp]], colour: Sequence[tuple[float, Stamp]]
) -> tuple[dict[int, ImagePair[Stamp]], list[str]]:
    """Pair each depth image with the colour image nearest in time; also return remarks.

    Args:
        depth: times in s, ascending, and images; their places become the frame numbers.
        colour: likewise; may be empty.
    """
    partners = nearest([time_s for time_s, _ in depth], [time_s for time_s, _ in colour], MAX_APART_S)
    pairs = {
        index: ImagePair(time_s, image, None if partner is None else colour[partner][1])
        for index, ((time_s, image), partner) in enumerate(zip(depth, partners, strict=True))
    }
    unpaired = partners.count(None)
    remark = f"{unpaired} depth images have no colour image within {MAX_APART_S * 1000:g} ms"
    return pairs, [remark] if colour and unpaired else []


def nearest(times_s: Sequence[float], others_s: Sequence[float], limit_s: float) -> list[int | None]:
    """Return the index of the nearest other time within a limit for each time; None if there is none."""
    if not others_s:
        return [None] * len(times_s)
    all_s = np.asarray(others_s, dtype=np.float64)
    order = np.argsort(all_s, kind="stable")
    right = np.searchsorted(all_s[order], times_s).clip(1, len(all_s)) if len(all_s) > 1 else np.ones(len(times_s), int)
    found: list[int | None] = []
    for time_s, after in zip(times_s, right.tolist(), strict=True):
        candidates = [int(order[place]) for place in (after - 1, after) if place < len(all_s)]
        best = min(candidates, key=lambda place: abs(others_s[place] - time_s))
        found.append(best if abs(others_s[best] - time_s) <= limit_s else None)
    return found
